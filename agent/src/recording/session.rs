//! The life of a recording: what comes is handed to the recorder until somebody ends it, the source
//! ends, or the storage takes no more. The same within the agent and in a client.
//!
//! What was sent before the end was asked for is still taken. Whole files are compressed beside it,
//! by a thread that ends with it.

use std::sync::mpsc::{Receiver, TryRecvError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use ros2probe_wire::Timestamp;

use super::recorder::{Ended, Recorder};
use crate::bag::{Compressed, Error};
use crate::client::Got;
use crate::subscriptions::Item;

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
}

/// Whole files on their way to being compressed, one after the other.
#[derive(Default)]
struct Compressing {
    thread: Option<JoinHandle<Vec<Result<Compressed, Error>>>>,
}

/// Records until it ends; the second value is why the source did, if it broke. `tell` hears of the
/// recorder now and then, and whenever an order was carried out.
pub fn record<E>(
    mut recorder: Recorder<'_>,
    mut next: impl FnMut(Duration) -> Result<Got, E>,
    orders: &Receiver<Order>,
    mut tell: impl FnMut(&Recorder<'_>),
) -> (Ended, Option<E>) {
    let mut compressing = Compressing::default();
    let mut stopping: Option<(Timestamp, Instant)> = None;
    let mut told = Instant::now();
    tell(&recorder);
    let (refused, broke) = loop {
        match carry_out(orders, &mut recorder) {
            Ok(Carried::Nothing) => {}
            Ok(Carried::Out) => tell(&recorder),
            Ok(Carried::Stop) => {
                stopping.get_or_insert_with(|| (now(), Instant::now() + FAREWELL));
            }
            Err(error) => break (Some(error), None),
        }
        let got = match next(LOOK) {
            Ok(got) => got,
            Err(error) => break (None, Some(error)),
        };
        if told.elapsed() >= TELL {
            told = Instant::now();
            tell(&recorder);
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
    tell(&recorder);
    let compressed = compressing.finish(&mut recorder);
    let refused = refused.or(compressed.err());
    (recorder.finish(refused), broke)
}

enum Carried {
    Nothing,
    Out,
    Stop,
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
        if self
            .thread
            .as_ref()
            .is_some_and(|thread| !thread.is_finished())
        {
            return Ok(());
        }
        self.finish(recorder)?;
        let work = recorder.take_compressions();
        if !work.is_empty() {
            let run = move || work.iter().map(crate::bag::FileCompression::run).collect();
            let thread = std::thread::Builder::new().name("compress".to_owned());
            // Without a thread the files stay as they are, which is no loss.
            self.thread = thread.spawn(run).ok();
        }
        Ok(())
    }

    /// Waits for what is under way.
    fn finish(&mut self, recorder: &mut Recorder<'_>) -> Result<(), Error> {
        let Some(done) = self.thread.take().and_then(|thread| thread.join().ok()) else {
            return Ok(());
        };
        for done in done {
            recorder.compressed(&done?)?;
        }
        Ok(())
    }
}

fn now() -> Timestamp {
    let now = SystemTime::now().duration_since(UNIX_EPOCH);
    let nanoseconds = now.unwrap_or_default().as_nanos();
    Timestamp(u64::try_from(nanoseconds).unwrap_or(u64::MAX))
}
