//! The programs attached to the functions of `libtracetools.so`, and their tables.
//!
//! A program attached to a library's file runs in every process that maps the file. A probe lives
//! as long as its descriptor: the kernel removes the breakpoint when this process ends, however it
//! ends.

use std::ffi::CStr;
use std::fs::File;
use std::io;
use std::os::fd::{AsFd as _, BorrowedFd, OwnedFd};

use aya::maps::{Array, HashMap, MapData, MapError, PerCpuArray, RingBuf};
use aya::programs::{ProgramError, RawTracePoint};
use aya::{Ebpf, EbpfLoader, Pod};
use ros2probe_attach::attach::AttachError;
use ros2probe_attach::client::Broker;
use ros2probe_attach::functions::{Calls, ENQUEUE};
use ros2probe_attach::request::Place;
use ros2probe_wire::inside::late::{self, Activity, Blocked, Bound, Handoff};
use ros2probe_wire::inside::{Counter, Figures, Handle, Process, accounting, clock, kind};
use zerocopy::FromZeros as _;

use crate::bpf;
use crate::breakpoints::{self, AttachMethod, Breakpoints, Dispatcher};
use crate::error_chain::Reason;
use crate::filter::{Aligned, FilterError, absent_is_fine, failed, take};
use crate::kernel_types::KernelTypes;
use crate::system::{Clocks, raw_difference};
use crate::tracepoints::accounting_offsets;
use crate::uprobe::attachments::Refusal;

/// The object built by `agent-ebpf/build.sh`. It is aligned because the ELF file is read in place.
static OBJECT: &Aligned<[u8]> = &Aligned(*include_bytes!("inside.bpf.o"));
/// The program that links attach. It tail-calls the other programs.
const DISPATCHER: Dispatcher = Dispatcher {
    program: "called",
    array: "CALLS",
};
type FiguresWords = [u64; size_of::<Figures>() / 8];
type ProcessWords = [u64; size_of::<Process>() / 8];
type HandleWords = [u64; size_of::<Handle>() / 8];
/// Words of `Thread` and `Entry` in the kernel programs. The second and third word of `Thread` are a
/// `Handle`. `Entry` has the process at the same place as `Handle`.
type ThreadWords = [u64; 22];
type EntryWords = [u64; 2];
type BoundWords = [u64; size_of::<Bound>() / 8];
/// Words of `Followed` in the kernel programs.
type FollowedWords = [u64; 24 + FOLLOWED_STATES + 15];
const FOLLOWED_STATES: usize =
    (2 * (size_of::<Blocked>() + size_of::<Activity>()) + size_of::<Handoff>()) / 8;
/// Flag of an update that creates no entry (BPF_EXIST, bpf(2)).
const EXISTING: u64 = 2;
/// The first word of a followed thread that can run and does not.
const RUNNABLE: u64 = 1;
/// Number of comparisons in a row after which a wrong number of runnable threads is corrected.
const WRONG_COMPARISONS: u32 = 5;
/// Tracepoints of the scheduler. The programs have the same names.
const SCHEDULER_EVENTS: [&CStr; 2] = [c"sched_switch", c"sched_waking"];
const _: () = assert!(size_of::<Figures>().is_multiple_of(8));

/// The loaded programs.
pub struct Programs {
    breakpoints: Breakpoints,
    /// Programs at the scheduler's [`SCHEDULER_EVENTS`].
    scheduler: Result<[OwnedFd; 2], NoEvents>,
}

/// Programs that run at the events of the scheduler. They end with the value.
pub struct Events(#[expect(dead_code, reason = "the drop matters")] [OwnedFd; 2]);

/// Tables of the programs.
pub struct Tables {
    processes: HashMap<MapData, u32, ProcessWords>,
    handles: HashMap<MapData, HandleWords, FiguresWords>,
    clocks: Array<MapData, u64>,
    counters: PerCpuArray<MapData, [u64; Counter::ALL.len()]>,
    announcements: RingBuf<MapData>,
    /// The last calls of each thread.
    threads: HashMap<MapData, u32, ThreadWords>,
    /// Times at which messages entered ring buffers.
    waiting: HashMap<MapData, EntryWords, u64>,
    late_mode: Array<MapData, u32>,
    bounds: HashMap<MapData, HandleWords, BoundWords>,
    /// Threads that call callbacks.
    followed: HashMap<MapData, u32, FollowedWords>,
    /// Number of these threads that can run and do not.
    runnable: Array<MapData, i64>,
    /// Number of comparisons in a row at which that number was wrong.
    wrong_runnable: u32,
}

/// The probes in one library; dropping the value removes the breakpoints.
pub struct Attached {
    _attached: breakpoints::Attached,
    /// Whether the library reports messages that enter ring buffers.
    pub shows_intra_process: bool,
}

/// Loads the programs without attaching them. `within`: restricts them to processes of this control
/// group, given by the inode of its directory.
///
/// # Errors
/// Returns [`FilterError::NotPermitted`] without the capabilities, other errors if the kernel
/// refuses them.
pub fn load(
    has_callbacks: bool,
    within: Option<u64>,
    means: AttachMethod,
) -> Result<(Programs, Tables), FilterError> {
    let architecture = u32::from(cfg!(target_arch = "aarch64"));
    let offsets = accounting_offsets(KernelTypes::read().ok().as_ref());
    let tail_calls = breakpoints::permits_tail_calls();
    let (callbacks, within) = (u32::from(has_callbacks), within.unwrap_or(0));
    let ebpf = EbpfLoader::new()
        .override_global("ARCHITECTURE", &architecture, true)
        .override_global("CALLBACKS", &callbacks, true)
        .override_global("WITHIN", &within, true)
        .override_global("TAIL_CALLS", &tail_calls, true)
        .override_global("ACCOUNTING", &offsets, true)
        .load(&OBJECT.0)
        .map_err(FilterError::load)?;
    let calls = match has_callbacks {
        true => Calls::Callbacks,
        false => Calls::Messages,
    };
    let mut breakpoints = Breakpoints::load(ebpf, &OBJECT.0, calls, Some(DISPATCHER), means)?;
    let ebpf = &mut breakpoints.ebpf;
    let scheduler = load_scheduler(ebpf, &offsets);
    let tables = Tables {
        processes: take(ebpf, "PROCESSES")?,
        handles: take(ebpf, "HANDLES")?,
        clocks: take(ebpf, "CLOCKS")?,
        counters: take(ebpf, "INSIDE_COUNTERS")?,
        announcements: take(ebpf, "ANNOUNCEMENTS")?,
        threads: take(ebpf, "THREADS")?,
        waiting: take(ebpf, "WAITING")?,
        late_mode: take(ebpf, "LATE_MODE")?,
        bounds: take(ebpf, "BOUNDS")?,
        followed: take(ebpf, "FOLLOWED_THREADS")?,
        runnable: take(ebpf, "RUNNABLE_THREADS")?,
        wrong_runnable: 0,
    };
    let programs = Programs {
        breakpoints,
        scheduler,
    };
    Ok((programs, tables))
}

/// Loads the programs at the scheduler's events.
fn load_scheduler(ebpf: &mut Ebpf, offsets: &[u32]) -> Result<[OwnedFd; 2], NoEvents> {
    let needed = [
        accounting::RUNTIME,
        accounting::RUN_DELAY,
        accounting::STATE,
        accounting::THREAD,
        accounting::PRIORITY,
    ];
    let is_known = |member: &usize| {
        offsets
            .get(*member)
            .is_some_and(|at| *at != accounting::ABSENT)
    };
    if !needed.iter().all(is_known) {
        return Err(NoEvents::Types);
    }
    let mut load = |name: &CStr| {
        let name = name.to_str().unwrap_or_default();
        let program = ebpf.program_mut(name).ok_or(NoEvents::Missing)?;
        let program: &mut RawTracePoint = program.try_into()?;
        program.load()?;
        let descriptor = program.fd()?.as_fd().try_clone_to_owned();
        descriptor.map_err(NoEvents::Kernel)
    };
    let [switch, waking] = SCHEDULER_EVENTS;
    Ok([load(switch)?, load(waking)?])
}

/// Why the events of the scheduler are not observed.
#[derive(Debug, thiserror::Error)]
pub enum NoEvents {
    /// The kernel does not describe its types, or has other ones.
    #[error("the kernel does not describe its scheduler (needs CONFIG_DEBUG_INFO_BTF)")]
    Types,
    /// The object lacks a program.
    #[error("a program is missing")]
    Missing,
    /// The kernel refuses a program.
    #[error("the kernel refuses a program at the scheduler's events (needs Linux 5.15)")]
    Program(#[from] ProgramError),
    /// The kernel refuses to run a program.
    #[error("the kernel refuses to observe the scheduler's events")]
    Kernel(#[source] io::Error),
}

impl Programs {
    /// Lets the broker attach the programs to a library's functions, or only to those of `part`.
    ///
    /// # Errors
    /// Returns why the broker refuses.
    pub fn attach(
        &self,
        broker: &mut Broker,
        part: Option<Calls>,
        place: Place,
    ) -> Result<Attached, Refusal> {
        let calls = part.unwrap_or(self.breakpoints.calls);
        let attached = self.breakpoints.attach(broker, calls, place)?;
        Ok(Attached::new(attached))
    }

    /// Attaches to a library's file with the rights of this process, for tests and examples.
    ///
    /// # Errors
    /// Fails if the library has none of the functions, or if the kernel refuses.
    pub fn attach_here(&self, file: &File) -> Result<Attached, AttachError> {
        let calls = self.breakpoints.calls;
        Ok(Attached::new(self.breakpoints.attach_here(calls, file)?))
    }

    /// Returns why this kernel refused the programs at the scheduler's events.
    pub(super) fn without_scheduler(&self) -> Option<Reason> {
        let refused = self.scheduler.as_ref().err();
        refused.map(|error| Reason::of(error))
    }

    /// Runs the programs at the scheduler's events.
    ///
    /// # Errors
    /// Fails if the kernel has no such events, or refused the programs when they were loaded.
    pub fn observe_scheduler(&self) -> Result<Events, Reason> {
        let programs = self.scheduler.as_ref();
        let [switch, waking] = programs.map_err(|error| Reason::of(error))?;
        let open = |name, program: &OwnedFd| {
            let opened = bpf::open_tracepoint(name, program.as_fd());
            opened.map_err(|error| Reason::of(&NoEvents::Kernel(error)))
        };
        let [of_switch, of_waking] = SCHEDULER_EVENTS;
        Ok(Events([open(of_switch, switch)?, open(of_waking, waking)?]))
    }
}

/// Removes all entries.
fn clear<K: Pod, V: Pod>(map: &mut HashMap<MapData, K, V>) -> Result<(), MapError> {
    let keys: Vec<_> = map.keys().filter_map(Result::ok).collect();
    keys.iter()
        .try_for_each(|key| absent_is_fine(map.remove(key)))
}

impl Attached {
    fn new(attached: breakpoints::Attached) -> Self {
        let mut functions = attached.functions.iter();
        let shows_intra_process = functions.any(|function| function == ENQUEUE);
        Self {
            _attached: attached,
            shows_intra_process,
        }
    }
}

impl Tables {
    /// Returns a descriptor that is readable when many announcements wait.
    #[must_use]
    pub fn descriptor(&self) -> BorrowedFd<'_> {
        self.announcements.as_fd()
    }

    /// Removes the oldest announcement and calls `with` with its bytes; returns `None` if the ring
    /// is empty.
    pub fn next_announcement<T>(&mut self, with: impl FnOnce(&[u8]) -> T) -> Option<T> {
        let item = self.announcements.next()?;
        Some(with(&item))
    }

    /// Sets the differences of the wall clock and of CLOCK_MONOTONIC_RAW to CLOCK_MONOTONIC.
    ///
    /// # Errors
    /// Fails if the kernel refuses the update.
    pub fn set_clocks(&mut self, clocks: &Clocks) -> Result<(), FilterError> {
        let realtime = clocks.now.0.wrapping_sub(clocks.monotonic);
        for (clock, difference) in [
            (clock::REALTIME, realtime),
            (clock::MONOTONIC_RAW, raw_difference()),
        ] {
            let set = self.clocks.set(clock, difference, 0);
            set.map_err(failed("CLOCKS", "set"))?;
        }
        Ok(())
    }

    /// Iterates over the processes by thread group id.
    pub fn processes(&self) -> impl Iterator<Item = (u32, Process)> + '_ {
        let entries = self.processes.iter().filter_map(Result::ok);
        entries.map(|(id, words)| (id, zerocopy::transmute!(words)))
    }

    /// Changes the state of a process.
    ///
    /// # Errors
    /// Fails if the kernel refuses the update.
    pub fn set_process(&mut self, id: u32, process: Process) -> Result<(), FilterError> {
        let words: ProcessWords = zerocopy::transmute!(process);
        let set = self.processes.insert(id, words, 0);
        set.map_err(failed("PROCESSES", "update"))
    }

    /// Removes a process; its next call creates a new entry.
    ///
    /// # Errors
    /// Fails if the kernel refuses the update.
    pub fn remove_process(&mut self, id: u32) -> Result<(), FilterError> {
        absent_is_fine(self.processes.remove(&id)).map_err(failed("PROCESSES", "remove"))
    }

    /// Iterates over the figures of all handles. The iteration may end early if the programs remove
    /// a handle during it. Figures are cumulative, so the next iteration includes the rest.
    pub fn figures(&self) -> impl Iterator<Item = (Handle, Figures)> + '_ {
        let entries = self.handles.iter().filter_map(Result::ok);
        entries.map(|(handle, words)| (zerocopy::transmute!(handle), zerocopy::transmute!(words)))
    }

    /// Removes the figures of a handle.
    ///
    /// # Errors
    /// Fails if the kernel refuses the update.
    pub fn remove_handle(&mut self, handle: Handle) -> Result<(), FilterError> {
        let key: HandleWords = zerocopy::transmute!(handle);
        absent_is_fine(self.handles.remove(&key)).map_err(failed("HANDLES", "remove"))
    }

    /// Forgets all calls so far, while the programs of [`Calls::Runtime`] are detached: later calls
    /// are unrelated to them. Announced objects stay announced.
    ///
    /// # Errors
    /// Fails if the kernel refuses an update.
    pub fn forget_calls(&mut self) -> Result<(), FilterError> {
        let handles: Vec<_> = self.figures().collect();
        for (handle, figures) in handles {
            let new = Figures {
                announced: figures.announced,
                ..Figures::new_zeroed()
            };
            let (key, words): (HandleWords, FiguresWords) =
                (zerocopy::transmute!(handle), zerocopy::transmute!(new));
            let set = self.handles.insert(key, words, 0);
            set.map_err(failed("HANDLES", "update"))?;
        }
        clear(&mut self.threads).map_err(failed("THREADS", "remove"))?;
        clear(&mut self.waiting).map_err(failed("WAITING", "remove"))
    }

    /// Forgets the base delay of each subscription, from which waits are measured: the wall clock was
    /// set.
    ///
    /// # Errors
    /// Fails if the kernel refuses an update.
    pub fn forget_delays(&mut self) -> Result<(), FilterError> {
        let handles = self.figures().map(|(handle, _)| handle);
        let subscriptions = handles.filter(|handle| handle.kind == kind::SUBSCRIPTION);
        let subscriptions: Vec<_> = subscriptions.collect();
        for handle in subscriptions {
            let key: HandleWords = zerocopy::transmute!(handle);
            // The programs may count between the read and the write, which must follow at once.
            let Ok(words) = self.handles.get(&key, 0) else {
                continue;
            };
            let mut figures: Figures = zerocopy::transmute!(words);
            if std::mem::take(&mut figures.base_delay) == 0 {
                continue;
            }
            let words: FiguresWords = zerocopy::transmute!(figures);
            match self.handles.insert(key, words, EXISTING) {
                // The subscription was destroyed.
                Ok(()) | Err(MapError::ElementNotFound | MapError::KeyNotFound) => {}
                Err(MapError::SyscallError(error))
                    if error.io_error.kind() == io::ErrorKind::NotFound => {}
                Err(error) => return Err(failed("HANDLES", "update")(error)),
            }
        }
        Ok(())
    }

    /// Forgets when the calls of a process happened, or with `None` those of all processes, while the
    /// programs do not count them. Otherwise the next call would seem to have lasted since then.
    /// Counts stay.
    ///
    /// # Errors
    /// Fails if the kernel refuses an update.
    pub fn forget_times(&mut self, process: Option<u32>) -> Result<(), FilterError> {
        let is_of = |id: u32| process.is_none_or(|process| process == id);
        let handles: Vec<_> = self.figures().collect();
        for (handle, figures) in handles {
            if is_of(handle.process) && (figures.last, figures.due) != (0, 0) {
                let (last, due) = (0, 0);
                let new = Figures {
                    last,
                    due,
                    ..figures
                };
                let (key, words): (HandleWords, FiguresWords) =
                    (zerocopy::transmute!(handle), zerocopy::transmute!(new));
                let set = self.handles.insert(key, words, 0);
                set.map_err(failed("HANDLES", "update"))?;
            }
        }
        let is_thread = |words: &ThreadWords| {
            let [_, address, rest, ..] = *words;
            let input: Handle = zerocopy::transmute!([address, rest]);
            // A thread that has taken nothing yet has no process.
            input.process == 0 || is_of(input.process)
        };
        let threads = self.threads.iter().filter_map(Result::ok);
        let threads: Vec<_> = threads.filter(|(_, words)| is_thread(words)).collect();
        for (id, _) in threads {
            let removed = absent_is_fine(self.threads.remove(&id));
            removed.map_err(failed("THREADS", "remove"))?;
        }
        let is_entry = |words: &EntryWords| {
            let entry: Handle = zerocopy::transmute!(*words);
            is_of(entry.process)
        };
        let entries = self.waiting.keys().filter_map(Result::ok);
        let entries: Vec<_> = entries.filter(is_entry).collect();
        for entry in entries {
            let removed = absent_is_fine(self.waiting.remove(&entry));
            removed.map_err(failed("WAITING", "remove"))?;
        }
        Ok(())
    }

    /// Sets what the programs observe about late calls, one of [`late::mode`]. Threads are followed
    /// anew, because their states are unknown between two observations.
    ///
    /// # Errors
    /// Fails if the kernel refuses an update.
    pub fn set_late_mode(&mut self, mode: u32) -> Result<(), FilterError> {
        let set = self.late_mode.set(0, late::mode::OFF, 0);
        set.map_err(failed("LATE_MODE", "set"))?;
        clear(&mut self.followed).map_err(failed("FOLLOWED_THREADS", "remove"))?;
        let set = self.runnable.set(0, 0, 0);
        set.map_err(failed("RUNNABLE_THREADS", "set"))?;
        let set = self.late_mode.set(0, mode, 0);
        set.map_err(failed("LATE_MODE", "set"))
    }

    /// Corrects the number of followed threads that can run and do not. A thread that the full table
    /// drops stays in that number, and then the programs store all switches of all threads. The
    /// number is wrong if [`WRONG_COMPARISONS`] calls in a row find no such thread: one may run before
    /// its row is read.
    ///
    /// # Errors
    /// Fails if the kernel refuses the lookup or the update.
    pub fn correct_runnable(&mut self) -> Result<(), FilterError> {
        let number = self.runnable.get(&0, 0);
        let number = number.map_err(failed("RUNNABLE_THREADS", "read"))?;
        let is_runnable = |(_, [state, ..]): (u32, FollowedWords)| state == RUNNABLE;
        let is_any = || self.followed.iter().filter_map(Result::ok).any(is_runnable);
        let is_same = || self.runnable.get(&0, 0).is_ok_and(|now| now == number);
        let is_wrong = number != 0 && !is_any() && is_same();
        self.wrong_runnable = if is_wrong { self.wrong_runnable + 1 } else { 0 };
        if self.wrong_runnable >= WRONG_COMPARISONS {
            self.wrong_runnable = 0;
            let set = self.runnable.set(0, 0, 0);
            set.map_err(failed("RUNNABLE_THREADS", "set"))?;
        }
        Ok(())
    }

    /// Sets from when on calls of a callback are late.
    ///
    /// # Errors
    /// Fails if the kernel refuses the update, for example because its table is full.
    pub fn set_bound(&mut self, callback: Handle, bound: Bound) -> Result<(), FilterError> {
        let key: HandleWords = zerocopy::transmute!(callback);
        let words: BoundWords = zerocopy::transmute!(bound);
        let set = self.bounds.insert(key, words, 0);
        set.map_err(failed("BOUNDS", "update"))
    }

    /// Removes the bound of a callback.
    ///
    /// # Errors
    /// Fails if the kernel refuses the update.
    pub fn remove_bound(&mut self, callback: Handle) -> Result<(), FilterError> {
        let key: HandleWords = zerocopy::transmute!(callback);
        absent_is_fine(self.bounds.remove(&key)).map_err(failed("BOUNDS", "remove"))
    }

    /// Returns all counters, summed over CPUs.
    ///
    /// # Errors
    /// Fails if the kernel refuses the lookup.
    pub fn counters(&self) -> Result<[u64; Counter::ALL.len()], FilterError> {
        let values = self.counters.get(&0, 0);
        let values = values.map_err(failed("INSIDE_COUNTERS", "read"))?;
        let mut sums = [0; Counter::ALL.len()];
        for counters in values.iter() {
            for (sum, value) in sums.iter_mut().zip(counters) {
                *sum += value;
            }
        }
        Ok(sums)
    }
}

#[cfg(test)]
mod tests {
    use std::io::{BufRead as _, BufReader, Write as _};
    use std::process::{Command, Stdio};

    use ros2probe_testing::harness::traced_program::TracedProgram;
    use ros2probe_wire::inside::late::mode;

    use super::*;

    /// Word of a followed thread with its process.
    const PROCESS: usize = 5;

    fn loaded() -> (Programs, Tables) {
        load(true, None, AttachMethod::of_this_kernel())
            .expect("loading the kernel programs needs root: run the tests with sudo")
    }

    fn runnable(tables: &Tables) -> i64 {
        tables.runnable.get(&0, 0).unwrap()
    }

    #[test]
    fn a_number_of_runnable_threads_without_such_a_thread_is_corrected_after_some_rounds() {
        let (_programs, mut tables) = loaded();
        for number in [2, -1] {
            tables.runnable.set(0, number, 0).unwrap();
            for _ in 1..WRONG_COMPARISONS {
                tables.correct_runnable().unwrap();
                assert_eq!(runnable(&tables), number);
            }
            tables.correct_runnable().unwrap();
            assert_eq!(runnable(&tables), 0);
        }
        let mut thread: FollowedWords = [0; size_of::<FollowedWords>() / 8];
        thread[0] = RUNNABLE;
        tables.followed.insert(1, thread, 0).unwrap();
        tables.runnable.set(0, 1, 0).unwrap();
        for _ in 0..2 * WRONG_COMPARISONS {
            tables.correct_runnable().unwrap();
            assert_eq!(runnable(&tables), 1);
        }
    }

    #[test]
    fn a_thread_whose_id_another_one_had_leaves_no_runnable_thread() {
        let (programs, mut tables) = loaded();
        let program = TracedProgram::build(248, &[]).unwrap();
        let library = File::open(program.library()).unwrap();
        let _attached = programs.attach_here(&library).unwrap();
        tables.set_late_mode(mode::SUMS).unwrap();
        let mut process = Command::new(program.program())
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let mut commands = process.stdin.take().unwrap();
        let mut answers = BufReader::new(process.stdout.take().unwrap()).lines();
        let mut run = |command: &str| {
            writeln!(commands, "{command}").unwrap();
            answers.next().unwrap().unwrap();
        };
        run("compute 1 10");
        // The thread before was in another process, and its end was not observed.
        let mut thread = tables.followed.get(&process.id(), 0).unwrap();
        (thread[0], thread[PROCESS]) = (RUNNABLE, 1);
        tables.followed.insert(process.id(), thread, 0).unwrap();
        tables.runnable.set(0, 1, 0).unwrap();
        run("compute 1 10");
        let thread = tables.followed.get(&process.id(), 0).unwrap();
        assert_eq!(thread[PROCESS], u64::from(process.id()));
        assert_eq!(runnable(&tables), 0);
        process.kill().unwrap();
        process.wait().unwrap();
    }
}
