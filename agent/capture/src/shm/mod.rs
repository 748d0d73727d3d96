//! Traffic between processes of one host through Fast DDS's shared memory, read and never written.
//!
//! A separate thread polls the ports (see [`tap`]), so that polls, process scans and the capture do
//! not delay each other. The view is sampled: messages overwritten before a poll are not seen, but
//! sequence numbers show that they existed. The thread opens files for reading, takes no lock,
//! registers nowhere and wakes no process.

pub mod cell;
pub mod classifier;
mod cpu_allowance;
pub mod directories;
mod inbox;
mod memory_use;
mod owner;
pub mod poll_interval;
pub mod port;
pub mod segment;
pub mod source;
pub mod tap;

#[cfg(test)]
mod image;

use std::collections::HashMap;
use std::io::{self, PipeReader, PipeWriter};
use std::os::fd::{AsFd as _, BorrowedFd};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicU8, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use ros2probe_wire::record::Verdict;
use ros2probe_wire::walk::Envelope;
use ros2probe_wire::{Guid, Record, Timestamp};

use self::directories::{Name, ShmDirectories, ShmDirectoryId};
use self::inbox::{Inbox, Item};
use self::poll_interval::{Budget, Need, PollInterval};
use self::tap::{Counters, Tap};
use super::border::observe;
use super::container::{is_container, is_service};
use super::reorder_buffer::ReorderBuffer;
use super::system::{
    Clocks, DirectoryWatch, monotonic, run_first, thread_cpu, wait, wall_clock_nanoseconds,
};
use crate::threads::{Progress, Spawn, Task};
use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::{Observer, Wanted};

/// Interval at which the counters are published.
const REPORT_INTERVAL: u64 = 200_000_000;
/// Length of one sleep while polling is paused.
const PAUSE_SLEEP: Duration = Duration::from_millis(50);

/// Number of polls in close succession between two readings of their CPU time.
const ACCOUNT_INTERVAL: u64 = 16;

/// Handle of the thread that polls shared memory.
pub struct SharedMemory {
    shared: Arc<Shared>,
    /// Closed to end the thread's sleep.
    end: Option<PipeWriter>,
    thread: Option<JoinHandle<()>>,
}

/// Report of the tap.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Facts {
    /// Counters of the tap.
    pub counters: Counters,
    /// CPU time of the tap's thread, in seconds.
    pub cpu_seconds: f64,
    /// Number of polls.
    pub polls: u64,
    /// Factor by which sleeps are extended to stay within the CPU share.
    pub stretch: f64,
    /// Items lost because the queue was full, and messages of one poll beyond its caps.
    pub refused: u64,
}

#[derive(Default)]
struct Shared {
    inbox: Inbox,
    interest: Mutex<Vec<(Guid, Option<Verdict>)>>,
    is_interest_changed: AtomicBool,
    wanted: AtomicU8,
    facts: Mutex<Facts>,
    progress: Progress,
    /// Whether polling is paused, because the probes see every message.
    is_paused: AtomicBool,
    stop: AtomicBool,
}

impl SharedMemory {
    /// Starts polling, within shares of a CPU. The thread keeps those capabilities of the caller
    /// that it needs. It reports a missing priority, unless breakpoints read the names.
    ///
    /// # Errors
    /// Fails if the thread cannot be started.
    pub fn start(
        directories: ShmDirectories,
        budget: Budget,
        has_breakpoints: bool,
        spawn: Spawn,
    ) -> io::Result<Self> {
        let (ended, end) = io::pipe()?;
        let shared = Arc::new(Shared {
            inbox: Inbox::with_bell(),
            ..Shared::default()
        });
        let thread = std::thread::Builder::new().name("shm".to_owned());
        let looks = Arc::clone(&shared);
        let remedy = (!has_breakpoints).then(priority_remedy);
        let thread = spawn(
            Task::SharedMemory,
            thread.stack_size(256 << 10),
            Box::new(move || poll(&looks, directories, budget, remedy, &ended)),
        )?;
        Ok(Self {
            shared,
            end: Some(end),
            thread: Some(thread),
        })
    }

    /// Updates the interest map.
    pub fn apply(&self, changes: &[(Guid, Option<Verdict>)]) {
        if changes.is_empty() {
            return;
        }
        let interest = self.shared.interest.lock();
        let mut interest = interest.unwrap_or_else(PoisonError::into_inner);
        interest.extend_from_slice(changes);
        self.shared
            .is_interest_changed
            .store(true, Ordering::Release);
    }

    /// Pauses polling while the probes see every message in the sending processes, or resumes it.
    pub fn pause(&self, is_paused: bool) {
        self.shared.is_paused.store(is_paused, Ordering::Release);
    }

    /// Returns a descriptor that is readable when the queue fills up; `None` without a bell.
    #[must_use]
    pub fn descriptor(&self) -> Option<BorrowedFd<'_>> {
        self.shared.inbox.descriptor()
    }

    /// Passes everything found since the last call to the model. With `order`, records of user data
    /// wait in that buffer for older ones.
    pub fn poll(
        &self,
        clocks: &Clocks,
        mut order: Option<&mut ReorderBuffer>,
        observer: &mut Observer,
    ) {
        for item in self.shared.inbox.take() {
            match item {
                Item::Record(record) => {
                    let time = clocks.stamped(Timestamp(record.time));
                    let record = Record {
                        time: time.0,
                        ..record
                    };
                    let at = clocks.monotonic_of(time);
                    let record = match &mut order {
                        Some(order) => order.add_polled(at, record),
                        None => Some(record),
                    };
                    if let Some(record) = record {
                        observe(observer, &record);
                    }
                }
                Item::Message { time, port, bytes } => {
                    let time = clocks.stamped(Timestamp(time));
                    let envelope = Envelope {
                        time: time.0,
                        destination_port: port,
                        ..Envelope::default()
                    };
                    let (envelope, payload) = (&envelope, &*bytes);
                    match &mut order {
                        Some(order) => {
                            let at = clocks.monotonic_of(time);
                            order.polled_message(at, envelope, payload, observer);
                        }
                        None => observer.input(Input::SharedMemory { envelope, payload }),
                    }
                }
                Item::Uncertain(time) => {
                    observer.input(Input::SharedMemoryGap(clocks.stamped(Timestamp(time))));
                }
            }
        }
    }

    /// Sets the current need, which determines how often the thread polls.
    pub fn set_need(&self, wanted: Wanted) {
        let need = match wanted {
            Wanted::Nothing => Need::Unneeded,
            Wanted::Names => Need::Names,
            Wanted::Samples => Need::Watching,
            Wanted::EverySample => Need::Every,
        };
        self.shared.wanted.store(need as u8, Ordering::Relaxed);
    }

    /// Returns for how long the thread has made no progress; `None` if it makes progress.
    #[must_use]
    pub fn stalled(&self) -> Option<Duration> {
        self.shared.progress.stalled()
    }

    /// Returns the report of the tap.
    #[must_use]
    pub fn facts(&self) -> Facts {
        let facts = self.shared.facts.lock();
        let facts = *facts.unwrap_or_else(PoisonError::into_inner);
        Facts {
            refused: facts.refused + self.shared.inbox.refused(),
            ..facts
        }
    }
}

impl Drop for SharedMemory {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Release);
        self.end = None;
        // A stalled thread is not joined: it ends with the process.
        if let Some(thread) = self.thread.take()
            && self.shared.progress.stalled().is_none()
        {
            // The result of the thread is not needed.
            let _ = thread.join();
        }
    }
}

impl Shared {
    /// Publishes the tap's report.
    fn report(&self, tap: &Tap, looks: u64, stretch: f64) {
        let facts = self.facts.lock();
        *facts.unwrap_or_else(PoisonError::into_inner) = Facts {
            counters: tap.counters(),
            cpu_seconds: seconds(thread_cpu()),
            polls: looks,
            stretch,
            refused: tap.refused(),
        };
    }
}

/// Returns what grants real-time priority to this process.
fn priority_remedy() -> &'static str {
    match (is_container(), is_service()) {
        (true, _) => "add --ulimit rtprio=1",
        (false, true) => {
            "the unit needs `LimitRTPRIO=1`, `RestrictRealtime=no` and \
             `SystemCallFilter=sched_setscheduler` (`systemctl edit`)"
        }
        (false, false) => "the agent needs CAP_SYS_NICE",
    }
}

/// The thread's main function. `remedy` is reported if the thread gets no priority.
fn poll(
    shared: &Shared,
    directories: ShmDirectories,
    budget: Budget,
    remedy: Option<&str>,
    ended: &PipeReader,
) {
    let mut tap = Tap::new(directories, wall_clock_nanoseconds);
    let cpus = std::thread::available_parallelism().map_or(1, usize::from);
    let mut interval = PollInterval::new(budget).with_cpus(cpus);
    // Without inotify, a new file is noticed at the next listing.
    let mut watch = DirectoryWatch::new().ok();
    let mut watched: HashMap<ShmDirectoryId, PathBuf> = HashMap::new();
    let mut watches_all = false;
    let (mut is_first, mut may_be_first) = (false, true);
    let (mut found, mut looks, mut reported, mut cpu) = (Vec::new(), 0, 0, 0.0);
    while !shared.stop.load(Ordering::Acquire) {
        shared.progress.step();
        if shared.is_interest_changed.swap(false, Ordering::Acquire) {
            let interest = shared.interest.lock();
            let mut interest = interest.unwrap_or_else(PoisonError::into_inner);
            for (guid, verdict) in interest.drain(..) {
                tap.classifier.set(guid, verdict);
            }
        }
        if shared.is_paused.load(Ordering::Acquire) {
            tap.close_all();
            tap.measure_memory_use(monotonic());
            reported = 0;
            shared.report(&tap, looks, interval.stretch());
            shared.progress.set_idle();
            std::thread::sleep(PAUSE_SLEEP);
            continue;
        }
        let now = monotonic();
        let at = seconds(now);
        let announced = tap.poll(now, &mut found);
        shared.inbox.add_all(&mut found);
        looks += 1;
        if looks % ACCOUNT_INTERVAL == 0 || !(tap.is_urgent || tap.needs_every_message) {
            cpu = seconds(thread_cpu());
        }
        if now.saturating_sub(reported) >= REPORT_INTERVAL {
            reported = now;
            shared.report(&tap, looks, interval.stretch());
        }
        let wanted = shared.wanted.load(Ordering::Relaxed);
        let need = if tap.has_ports() {
            Need::ALL
                .into_iter()
                .find(|need| *need as u8 == wanted)
                .unwrap_or(Need::Names)
        } else {
            Need::Unneeded
        };
        if tap.take_discovery_seen() {
            interval.announcement_read(at);
        }
        let sleep = interval.sleep(at, cpu, announced, need);
        tap.is_urgent = interval.is_polling_closely(at);
        tap.needs_every_message = need == Need::Every;
        if may_be_first && (tap.is_urgent || tap.needs_every_message) != is_first {
            is_first = !is_first;
            if let Err(error) = run_first(is_first) {
                (may_be_first, is_first) = (false, false);
                if let Some(remedy) = remedy {
                    tracing::info!(%error, remedy, "names announced in shared memory may be \
                        missed on a busy host");
                }
            }
        }
        // While listing has used up its CPU share, events about new files wait as well.
        let Some(watch) = watch.as_mut().filter(|_| tap.may_list(now)) else {
            shared.progress.set_idle();
            std::thread::sleep(sleep);
            continue;
        };
        let is_same = tap.directory_count() == watched.len()
            && tap
                .directories()
                .all(|(id, path)| watched.get(&id).is_some_and(|known| known == path));
        let idle = tap
            .until_next_search(now)
            .filter(|_| is_same && watches_all);
        if !is_same {
            // A file may have appeared just before: the next listing follows soon.
            let paths = tap.directories();
            watched = paths.map(|(id, path)| (id, path.to_path_buf())).collect();
            // The kernel ignores a repeated addition.
            let paths = watched.values();
            watches_all = paths.filter(|path| !watch.add(path)).count() == 0;
        }
        // The creation of a file ends the sleep, so an idle tap may sleep longer.
        let sleep = idle.map_or(sleep, |idle| sleep.max(Duration::from_nanos(idle)));
        let before = thread_cpu();
        shared.progress.set_idle();
        let ready = wait(&[watch.as_fd(), ended.as_fd()], sleep);
        shared.progress.step();
        if matches!(ready, Ok(Some(0))) && watch.created(|name| Name::parse(name).is_some()) {
            tap.spend(thread_cpu().saturating_sub(before));
            tap.expect_participant();
            interval.participant_starting(at);
        }
    }
    shared.progress.set_idle();
}

#[expect(
    clippy::cast_precision_loss,
    reason = "nanoseconds of an uptime stay exact to 104 days, and then to the microsecond"
)]
fn seconds(nanoseconds: u64) -> f64 {
    nanoseconds as f64 / 1e9
}
