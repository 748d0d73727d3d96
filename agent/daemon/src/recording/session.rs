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

use super::recorder::{Ended, Recorder};
use crate::subscriptions::{Got, Item};
use ros2probe_bag::{Compressed, Error, FileCompression, Progress};

/// How long orders wait at most.
const LOOK: Duration = Duration::from_millis(100);
/// How often whoever watches is told.
const TELL: Duration = Duration::from_millis(500);
/// How long what was sent before the end is waited for.
const FAREWELL: Duration = Duration::from_secs(2);

/// What may be asked of a recording under way.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Order {
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
pub enum Going<'a> {
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
    under_way: Option<UnderWay>,
}

/// A file that is being compressed by a thread of its own.
struct UnderWay {
    thread: JoinHandle<Result<Compressed, Error>>,
    progress: Arc<Progress>,
    bytes: u64,
}

/// Orders and the one who listens, while the bag is being completed.
struct Completion<'a, T> {
    orders: &'a Receiver<Order>,
    tell: T,
    told: Instant,
    hurry: bool,
}

/// Records until it ends; the second value is why the source did, if it broke. `tell` hears of the
/// recording now and then, and whenever an order was carried out.
pub fn record<E>(
    mut recorder: Recorder<'_>,
    mut next: impl FnMut(Duration) -> Result<Got, E>,
    orders: &Receiver<Order>,
    mut tell: impl FnMut(Going<'_>),
) -> (Ended, Option<E>) {
    let mut compressing = Compressing::default();
    let mut stopping: Option<(Timestamp, Instant)> = None;
    let mut hurry = false;
    let mut told = Instant::now();
    tell(Going::Recording(&recorder));
    let (refused, broke) = loop {
        match carry_out(orders, &mut recorder) {
            Ok(Carried::Nothing) => {}
            Ok(Carried::Out) => tell(Going::Recording(&recorder)),
            Ok(Carried::Stop) => {
                if stopping.is_none() {
                    stopping = Some((now(), Instant::now() + FAREWELL));
                    tell(Going::Completing);
                }
            }
            Ok(Carried::Hurry) => {
                hurry = true;
                break (None, None);
            }
            Err(error) => break (Some(error), None),
        }
        let got = match next(LOOK) {
            Ok(got) => got,
            Err(error) => break (None, Some(error)),
        };
        if told.elapsed() >= TELL {
            told = Instant::now();
            tell(Going::Recording(&recorder));
            if let Err(error) = compressing.look(&mut recorder) {
                break (Some(error), None);
            }
        }
        if stopping.is_some_and(|(_, deadline)| Instant::now() >= deadline) {
            break (None, None);
        }
        let item = match got {
            Got::Item(item) => item,
            Got::Nothing => continue,
            Got::Gone => break (None, None),
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
    tell(Going::Recording(&recorder));
    let mut completion = Completion {
        orders,
        tell,
        told: Instant::now(),
        hurry,
    };
    let compressed = compressing.finish(&mut recorder, &mut completion);
    let refused = refused.or(compressed.err());
    let compress = |work| match UnderWay::begin(work) {
        Some(under_way) => under_way.wait(&mut completion),
        None => Ok(None),
    };
    (recorder.finish_with(refused, compress), broke)
}

enum Carried {
    Nothing,
    Out,
    Stop,
    Hurry,
}

fn carry_out(orders: &Receiver<Order>, recorder: &mut Recorder<'_>) -> Result<Carried, Error> {
    let mut carried = Carried::Nothing;
    loop {
        match orders.try_recv() {
            Ok(Order::Pause) => recorder.pause(true),
            Ok(Order::Resume) => recorder.pause(false),
            Ok(Order::Toggle) => recorder.pause(!recorder.is_paused()),
            Ok(Order::Split) => recorder.split()?,
            Ok(Order::Snapshot) => recorder.snapshot()?,
            Ok(Order::Hurry) => return Ok(Carried::Hurry),
            // Who could give orders has gone.
            Ok(Order::Stop) | Err(TryRecvError::Disconnected) => return Ok(Carried::Stop),
            Err(TryRecvError::Empty) => return Ok(carried),
        }
        carried = Carried::Out;
    }
}

impl Compressing {
    /// Takes over what is done, and begins with what waits.
    fn look(&mut self, recorder: &mut Recorder<'_>) -> Result<(), Error> {
        if let Some(under_way) = &self.under_way
            && !under_way.thread.is_finished()
        {
            return Ok(());
        }
        if let Some(done) = self.under_way.take().and_then(UnderWay::join) {
            recorder.compressed(&done?)?;
        }
        self.waiting.extend(recorder.take_compressions());
        self.under_way = self.waiting.pop_front().and_then(UnderWay::begin);
        Ok(())
    }

    /// Waits for what was begun and for what waits.
    fn finish(
        &mut self,
        recorder: &mut Recorder<'_>,
        completion: &mut Completion<'_, impl FnMut(Going<'_>)>,
    ) -> Result<(), Error> {
        let waiting = std::mem::take(&mut self.waiting).into_iter();
        let waiting = waiting.filter_map(UnderWay::begin);
        for under_way in self.under_way.take().into_iter().chain(waiting) {
            if let Some(done) = under_way.wait(completion)? {
                recorder.compressed(&done)?;
            }
        }
        Ok(())
    }
}

impl UnderWay {
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
        completion: &mut Completion<'_, impl FnMut(Going<'_>)>,
    ) -> Result<Option<Compressed>, Error> {
        while !self.thread.is_finished() {
            if completion.is_hurried() {
                self.progress.give_up();
                break;
            }
            completion.compressing(self.progress.read(), self.bytes);
            std::thread::sleep(LOOK);
        }
        let is_given_up = self.progress.is_given_up();
        match self.join() {
            Some(Ok(done)) => Ok(Some(done)),
            Some(Err(error)) if !is_given_up => Err(error),
            Some(Err(_)) | None => Ok(None),
        }
    }
}

impl<T: FnMut(Going<'_>)> Completion<'_, T> {
    fn is_hurried(&mut self) -> bool {
        self.hurry |= self.orders.try_iter().any(|order| order == Order::Hurry);
        self.hurry
    }

    fn compressing(&mut self, done: u64, of: u64) {
        if self.told.elapsed() >= TELL {
            self.told = Instant::now();
            (self.tell)(Going::Compressing { done, of });
        }
    }
}

fn now() -> Timestamp {
    let now = SystemTime::now().duration_since(UNIX_EPOCH);
    let nanoseconds = now.unwrap_or_default().as_nanos();
    Timestamp(u64::try_from(nanoseconds).unwrap_or(u64::MAX))
}
