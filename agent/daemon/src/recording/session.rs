//! Runs a recording: passes items to the recorder until a command, the end of the source, or an
//! error of the storage. The agent and clients share this code.
//!
//! Messages sent before the end was requested are still recorded. Whole files are compressed on a
//! separate thread that ends with the recording.

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, TryRecvError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use ros2probe_wire::Timestamp;

use super::recorder::{Finished, Recorder};
use crate::subscriptions::{Item, NextItem};
use ros2probe_bag::{Compressed, Error, FileCompression, Progress};

/// Maximum delay of a command.
const POLL_INTERVAL: Duration = Duration::from_millis(100);
/// Interval of status reports.
const REPORT_INTERVAL: Duration = Duration::from_millis(500);
/// Maximum time to wait for messages that were sent before the end. Samples wait for a repeated one
/// for up to 4 s.
#[cfg(not(test))]
pub(super) const DRAIN_TIMEOUT: Duration = Duration::from_secs(5);
/// Longer than a busy machine delays a test that must not wait for it.
#[cfg(test)]
pub(super) const DRAIN_TIMEOUT: Duration = Duration::from_secs(120);

/// Minimum time by which the clock of a replay differs from that of this host.
const REPLAY_AGE: Duration = Duration::from_secs(60);

/// Command to a recording.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Command {
    /// Ignore samples from now on.
    Pause,
    /// Record samples again.
    Resume,
    /// Pause or resume.
    Toggle,
    /// Continue in a new file.
    Split,
    /// Write the samples in memory.
    Snapshot,
    /// Complete the bag.
    Stop,
    /// Complete the bag without waiting for messages in flight or compressing whole files.
    Abort,
}

/// Current activity of a recording.
#[derive(Clone, Copy, Debug)]
pub enum Activity<'a> {
    /// It records messages.
    Recording(&'a Recorder<'a>),
    /// It records the last messages and completes the bag.
    Completing,
    /// It compresses a whole file.
    Compressing {
        /// Bytes compressed so far.
        done: u64,
        /// Bytes of the file.
        of: u64,
    },
}

/// Files to compress, one after the other.
#[derive(Default)]
struct Compressing {
    waiting: VecDeque<FileCompression>,
    task: Option<CompressionTask>,
}

/// Compression of a file on its own thread.
struct CompressionTask {
    thread: JoinHandle<Result<Compressed, Error>>,
    progress: Arc<Progress>,
    bytes: u64,
}

/// Commands and the callback for reports during the completion of the bag.
struct Completion<'a, T> {
    commands: &'a Receiver<Command>,
    report_activity: T,
    reported: Instant,
    is_aborted: bool,
}

/// Records until the end. The second value is the source's error, if it failed. `report_activity`
/// is called regularly and after each command. `is_behind` returns whether items wait that `next`
/// has already received: they are recorded before the end, however long it takes.
pub fn record<E>(
    mut recorder: Recorder<'_>,
    mut next: impl FnMut(Duration) -> Result<NextItem, E>,
    is_behind: impl Fn() -> bool,
    commands: &Receiver<Command>,
    mut report_activity: impl FnMut(Activity<'_>),
) -> (Finished, Option<E>) {
    let mut compressing = Compressing::default();
    let mut stopping: Option<(Timestamp, Instant)> = None;
    let mut abort = false;
    let mut reported = Instant::now();
    let mut last_clock = None;
    report_activity(Activity::Recording(&recorder));
    let (refused, broke) = loop {
        match execute(commands, &mut recorder) {
            Ok(CommandOutcome::Nothing) => {}
            Ok(CommandOutcome::Executed) => report_activity(Activity::Recording(&recorder)),
            Ok(CommandOutcome::Stop) => {
                if stopping.is_none() {
                    let since = end_of(last_clock);
                    stopping = Some((since, Instant::now() + DRAIN_TIMEOUT));
                    report_activity(Activity::Completing);
                }
            }
            Ok(CommandOutcome::Abort) => {
                abort = true;
                break (None, None);
            }
            Err(error) => break (Some(error), None),
        }
        let got = match next(POLL_INTERVAL) {
            Ok(got) => got,
            Err(error) => break (None, Some(error)),
        };
        if reported.elapsed() >= REPORT_INTERVAL {
            reported = Instant::now();
            report_activity(Activity::Recording(&recorder));
            if let Err(error) = compressing.poll(&mut recorder) {
                break (Some(error), None);
            }
        }
        if stopping.is_some_and(|(_, deadline)| Instant::now() >= deadline && !is_behind()) {
            break (None, None);
        }
        let item = match got {
            NextItem::Item(item) => item,
            NextItem::Pending => continue,
            NextItem::Closed => break (None, None),
        };
        if let Err(error) = recorder.take(&item) {
            break (Some(error), None);
        }
        match (&item, stopping) {
            (Item::End(_), _) => break (None, None),
            (Item::Clock(clock), Some((since, _))) if *clock >= since => break (None, None),
            (Item::Clock(clock), _) => last_clock = Some(*clock),
            _ => {}
        }
    };
    report_activity(Activity::Recording(&recorder));
    let mut completion = Completion {
        commands,
        report_activity,
        reported: Instant::now(),
        is_aborted: abort,
    };
    let compressed = compressing.finish(&mut recorder, &mut completion);
    let refused = refused.or(compressed.err());
    let compress = |work| match CompressionTask::begin(work) {
        Some(task) => task.wait(&mut completion),
        None => Ok(None),
    };
    (recorder.finish_with(refused, compress), broke)
}

enum CommandOutcome {
    Nothing,
    Executed,
    Stop,
    Abort,
}

fn execute(
    commands: &Receiver<Command>,
    recorder: &mut Recorder<'_>,
) -> Result<CommandOutcome, Error> {
    let mut outcome = CommandOutcome::Nothing;
    loop {
        match commands.try_recv() {
            Ok(Command::Pause) => recorder.pause(true),
            Ok(Command::Resume) => recorder.pause(false),
            Ok(Command::Toggle) => recorder.pause(!recorder.is_paused()),
            Ok(Command::Split) => recorder.split()?,
            Ok(Command::Snapshot) => recorder.snapshot()?,
            Ok(Command::Abort) => return Ok(CommandOutcome::Abort),
            // All senders of commands were dropped.
            Ok(Command::Stop) | Err(TryRecvError::Disconnected) => return Ok(CommandOutcome::Stop),
            Err(TryRecvError::Empty) => return Ok(outcome),
        }
        outcome = CommandOutcome::Executed;
    }
}

impl Compressing {
    /// Handles finished compressions and starts the next one.
    fn poll(&mut self, recorder: &mut Recorder<'_>) -> Result<(), Error> {
        if let Some(task) = &self.task
            && !task.thread.is_finished()
        {
            return Ok(());
        }
        if let Some(done) = self.task.take().and_then(CompressionTask::join) {
            recorder.compressed(&done?)?;
        }
        self.waiting.extend(recorder.take_compressions());
        self.task = self.waiting.pop_front().and_then(CompressionTask::begin);
        Ok(())
    }

    /// Waits for all running and pending compressions.
    fn finish(
        &mut self,
        recorder: &mut Recorder<'_>,
        completion: &mut Completion<'_, impl FnMut(Activity<'_>)>,
    ) -> Result<(), Error> {
        let waiting = std::mem::take(&mut self.waiting).into_iter();
        let waiting = waiting.filter_map(CompressionTask::begin);
        for task in self.task.take().into_iter().chain(waiting) {
            if let Some(done) = task.wait(completion)? {
                recorder.compressed(&done)?;
            }
        }
        Ok(())
    }
}

impl CompressionTask {
    /// Starts the compression; returns `None` if no thread can be spawned. The file then stays
    /// uncompressed, which loses nothing.
    fn begin(work: FileCompression) -> Option<Self> {
        let progress = Arc::new(Progress::default());
        let (watched, bytes) = (Arc::clone(&progress), work.bytes());
        let thread = std::thread::Builder::new().name("compress".to_owned());
        let thread = thread.spawn(move || work.run_watched(&watched)).ok()?;
        Some(Self {
            thread,
            progress,
            bytes,
        })
    }

    fn join(self) -> Option<Result<Compressed, Error>> {
        self.thread.join().ok()
    }

    /// Waits for the compression of the file; returns `None` if it was cancelled or its thread
    /// panicked.
    fn wait(
        self,
        completion: &mut Completion<'_, impl FnMut(Activity<'_>)>,
    ) -> Result<Option<Compressed>, Error> {
        while !self.thread.is_finished() {
            if completion.is_aborted() {
                self.progress.cancel();
                break;
            }
            completion.compressing(self.progress.read(), self.bytes);
            std::thread::sleep(POLL_INTERVAL);
        }
        let is_given_up = self.progress.is_cancelled();
        match self.join() {
            Some(Ok(done)) => Ok(Some(done)),
            Some(Err(error)) if !is_given_up => Err(error),
            Some(Err(_)) | None => Ok(None),
        }
    }
}

impl<T: FnMut(Activity<'_>)> Completion<'_, T> {
    fn is_aborted(&mut self) -> bool {
        self.is_aborted |= self
            .commands
            .try_iter()
            .any(|order| order == Command::Abort);
        self.is_aborted
    }

    fn compressing(&mut self, done: u64, of: u64) {
        if self.reported.elapsed() >= REPORT_INTERVAL {
            self.reported = Instant::now();
            (self.report_activity)(Activity::Compressing { done, of });
        }
    }
}

/// Returns the time up to which messages are recorded when the end is requested now. `last_clock` is
/// the latest clock of the source, which in a replay is that of the capture.
fn end_of(last_clock: Option<Timestamp>) -> Timestamp {
    let now = now();
    match last_clock {
        Some(clock) if now.distance(clock) > REPLAY_AGE => clock,
        _ => now,
    }
}

fn now() -> Timestamp {
    let now = SystemTime::now().duration_since(UNIX_EPOCH);
    let nanoseconds = now.unwrap_or_default().as_nanos();
    Timestamp(u64::try_from(nanoseconds).unwrap_or(u64::MAX))
}
