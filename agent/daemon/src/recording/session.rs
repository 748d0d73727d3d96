//! The life of a recording: what comes is handed to the recorder until somebody ends it, the source
//! ends, or the storage takes no more. The same within the agent and in a client.
//!
//! What was sent before the end was asked for is still taken. Whole files are compressed beside it,
//! by a thread that ends with it.

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, TryRecvError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use ros2probe_wire::Timestamp;

use super::recorder::{Finished, Recorder};
use crate::subscriptions::{Item, NextItem};
use ros2probe_bag::{Compressed, Error, FileCompression, Progress};

/// How long orders wait at most.
const POLL_INTERVAL: Duration = Duration::from_millis(100);
/// How often the state of a recording is reported.
const REPORT_INTERVAL: Duration = Duration::from_millis(500);
/// How long what was sent before the end is waited for.
const FAREWELL: Duration = Duration::from_secs(2);

/// What may be asked of a recording under way.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Command {
    /// Let samples go by from now on.
    Pause,
    /// Take them again.
    Resume,
    /// The one or the other.
    Toggle,
    /// Go on in a new file.
    Split,
    /// Write what waits in memory.
    Snapshot,
    /// Complete the bag.
    Stop,
    /// Complete it without what takes long: messages on their way, compression of whole files.
    Hurry,
}

/// What a recording is doing.
#[derive(Clone, Copy, Debug)]
pub enum Activity<'a> {
    /// It takes messages.
    Recording(&'a Recorder<'a>),
    /// It takes the last messages and completes the bag.
    Completing,
    /// It compresses a whole file.
    Compressing {
        /// Bytes compressed so far.
        done: u64,
        /// Bytes of the file.
        of: u64,
    },
}

/// Whole files on their way to being compressed, one after the other.
#[derive(Default)]
struct Compressing {
    waiting: VecDeque<FileCompression>,
    task: Option<CompressionTask>,
}

/// A file that is being compressed by a thread of its own.
struct CompressionTask {
    thread: JoinHandle<Result<Compressed, Error>>,
    progress: Arc<Progress>,
    bytes: u64,
}

/// Orders and the one who listens, while the bag is being completed.
struct Completion<'a, T> {
    commands: &'a Receiver<Command>,
    report_activity: T,
    reported: Instant,
    hurry: bool,
}

/// Records until it ends; the second value is why the source did, if it broke. `report_activity` hears of the
/// recording now and then, and whenever an order was carried out.
pub fn record<E>(
    mut recorder: Recorder<'_>,
    mut next: impl FnMut(Duration) -> Result<NextItem, E>,
    commands: &Receiver<Command>,
    mut report_activity: impl FnMut(Activity<'_>),
) -> (Finished, Option<E>) {
    let mut compressing = Compressing::default();
    let mut stopping: Option<(Timestamp, Instant)> = None;
    let mut hurry = false;
    let mut reported = Instant::now();
    report_activity(Activity::Recording(&recorder));
    let (refused, broke) = loop {
        match carry_out(commands, &mut recorder) {
            Ok(CommandOutcome::Nothing) => {}
            Ok(CommandOutcome::Out) => report_activity(Activity::Recording(&recorder)),
            Ok(CommandOutcome::Stop) => {
                if stopping.is_none() {
                    stopping = Some((now(), Instant::now() + FAREWELL));
                    report_activity(Activity::Completing);
                }
            }
            Ok(CommandOutcome::Hurry) => {
                hurry = true;
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
        if stopping.is_some_and(|(_, deadline)| Instant::now() >= deadline) {
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
            _ => {}
        }
    };
    report_activity(Activity::Recording(&recorder));
    let mut completion = Completion {
        commands,
        report_activity,
        reported: Instant::now(),
        hurry,
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
    Out,
    Stop,
    Hurry,
}

fn carry_out(
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
            Ok(Command::Hurry) => return Ok(CommandOutcome::Hurry),
            // Who could give orders has gone.
            Ok(Command::Stop) | Err(TryRecvError::Disconnected) => return Ok(CommandOutcome::Stop),
            Err(TryRecvError::Empty) => return Ok(outcome),
        }
        outcome = CommandOutcome::Out;
    }
}

impl Compressing {
    /// Takes over what is done, and begins with what waits.
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

    /// Waits for what was begun and for what waits.
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
    /// `None` without a thread: then the file stays as it is, which is no loss.
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

    /// Waits until the file is compressed; `None` where that was given up.
    fn wait(
        self,
        completion: &mut Completion<'_, impl FnMut(Activity<'_>)>,
    ) -> Result<Option<Compressed>, Error> {
        while !self.thread.is_finished() {
            if completion.is_hurried() {
                self.progress.give_up();
                break;
            }
            completion.compressing(self.progress.read(), self.bytes);
            std::thread::sleep(POLL_INTERVAL);
        }
        let is_given_up = self.progress.is_given_up();
        match self.join() {
            Some(Ok(done)) => Ok(Some(done)),
            Some(Err(error)) if !is_given_up => Err(error),
            Some(Err(_)) | None => Ok(None),
        }
    }
}

impl<T: FnMut(Activity<'_>)> Completion<'_, T> {
    fn is_hurried(&mut self) -> bool {
        self.hurry |= self
            .commands
            .try_iter()
            .any(|order| order == Command::Hurry);
        self.hurry
    }

    fn compressing(&mut self, done: u64, of: u64) {
        if self.reported.elapsed() >= REPORT_INTERVAL {
            self.reported = Instant::now();
            (self.report_activity)(Activity::Compressing { done, of });
        }
    }
}

fn now() -> Timestamp {
    let now = SystemTime::now().duration_since(UNIX_EPOCH);
    let nanoseconds = now.unwrap_or_default().as_nanos();
    Timestamp(u64::try_from(nanoseconds).unwrap_or(u64::MAX))
}
