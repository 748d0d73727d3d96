//! The programs at the functions of `libtracetools.so`, and their tables.
//!
//! Attached to a library's file, a program runs in every process that maps the file. A probe lives
//! as long as its descriptor: the kernel removes the breakpoint when this process ends, however it
//! ends.

use std::fs::File;
use std::os::fd::{AsFd as _, BorrowedFd};

use aya::EbpfLoader;
use aya::maps::{Array, HashMap, MapData, PerCpuArray, RingBuf};
use ros2probe_wire::inside::{Counter, Figures, Handle, Process, clock};

use crate::breakpoints::{self, Breakpoints, Dispatcher, Means};
use crate::filter::{Aligned, FilterError, absent_is_fine, failed, take};
use crate::system::{Clocks, raw_difference};
use crate::uprobe::library::{self, LibraryError};

/// The object built by `agent-ebpf/build.sh`. Aligned, because ELF is read in place.
static OBJECT: &Aligned<[u8]> = &Aligned(*include_bytes!("../../../../agent-ebpf/inside.bpf.o"));
/// The program of links, which calls the others.
const DISPATCHER: Dispatcher = Dispatcher {
    program: "called",
    array: "CALLS",
};
/// Begin of the functions' names.
const PREFIX: &str = "ros_trace_";
/// The function that reports messages entering a ring buffer, since Iron. Without it, only
/// callbacks show messages within a process.
const ENQUEUE: &str = "rclcpp_ring_buffer_enqueue";

/// Functions of messages, with programs of the same name.
const MESSAGES: [&str; 14] = [
    "rcl_publish",
    "rmw_take",
    "rclcpp_intra_publish",
    "rclcpp_construct_ring_buffer",
    ENQUEUE,
    "rclcpp_ring_buffer_dequeue",
    "rclcpp_ring_buffer_clear",
    "rclcpp_buffer_to_ipb",
    "rclcpp_ipb_to_subscription",
    "rcl_node_init",
    "rcl_publisher_init",
    "rcl_subscription_init",
    "rclcpp_subscription_init",
    "rclcpp_subscription_callback_added",
];
/// Functions of callbacks, likewise.
const CALLBACKS: [&str; 11] = [
    "callback_start",
    "callback_end",
    "rclcpp_executor_execute",
    "rclcpp_executor_get_next_ready",
    "rcl_timer_init",
    "rclcpp_timer_link_node",
    "rclcpp_timer_callback_added",
    "rcl_service_init",
    "rclcpp_service_callback_added",
    "rcl_lifecycle_state_machine_init",
    "rcl_lifecycle_transition",
];
/// Where only messages are observed: this program at `callback_start`.
const RECEIVED: (&str, &str) = ("callback_received", "callback_start");

type FiguresWords = [u64; size_of::<Figures>() / 8];
type ProcessWords = [u64; size_of::<Process>() / 8];
type HandleWords = [u64; size_of::<Handle>() / 8];
const _: () = assert!(size_of::<Figures>().is_multiple_of(8));

/// The loaded programs.
pub struct Programs {
    breakpoints: Breakpoints,
    has_callbacks: bool,
}

/// Tables of the programs.
pub struct Tables {
    processes: HashMap<MapData, u32, ProcessWords>,
    handles: HashMap<MapData, HandleWords, FiguresWords>,
    clocks: Array<MapData, u64>,
    counters: PerCpuArray<MapData, [u64; Counter::ALL.len()]>,
    announcements: RingBuf<MapData>,
}

/// The probes in one library; dropping them removes the breakpoints.
pub struct Attached {
    _attached: breakpoints::Attached,
    /// The library reports messages that enter ring buffers.
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
    means: Means,
) -> Result<(Programs, Tables), FilterError> {
    let architecture = u32::from(cfg!(target_arch = "aarch64"));
    let (callbacks, within) = (u32::from(has_callbacks), within.unwrap_or(0));
    let ebpf = EbpfLoader::new()
        .override_global("ARCHITECTURE", &architecture, true)
        .override_global("CALLBACKS", &callbacks, true)
        .override_global("WITHIN", &within, true)
        .load(&OBJECT.0)
        .map_err(FilterError::load)?;
    let names = used(has_callbacks);
    let mut breakpoints = Breakpoints::load(ebpf, &OBJECT.0, names, Some(DISPATCHER), means)?;
    let ebpf = &mut breakpoints.ebpf;
    let tables = Tables {
        processes: take(ebpf, "PROCESSES")?,
        handles: take(ebpf, "HANDLES")?,
        clocks: take(ebpf, "CLOCKS")?,
        counters: take(ebpf, "INSIDE_COUNTERS")?,
        announcements: take(ebpf, "ANNOUNCEMENTS")?,
    };
    let programs = Programs {
        breakpoints,
        has_callbacks,
    };
    Ok((programs, tables))
}

/// Returns the names of the programs in use.
fn used(has_callbacks: bool) -> impl Iterator<Item = &'static str> {
    let callbacks: &[&str] = match has_callbacks {
        true => &CALLBACKS,
        false => &[RECEIVED.0],
    };
    MESSAGES.into_iter().chain(callbacks.iter().copied())
}

/// Why a library is not observed.
#[derive(Debug, thiserror::Error)]
pub enum AttachError {
    /// The library cannot be read.
    #[error(transparent)]
    Library(#[from] LibraryError),
    /// The library has no functions to attach to.
    #[error("it has no functions ros_trace_rcl_publish and ros_trace_rmw_take")]
    NoFunctions,
    /// The kernel refuses the probes.
    #[error(transparent)]
    Probe(#[from] FilterError),
}

impl Programs {
    /// Attaches to the functions that a library has.
    ///
    /// # Errors
    /// Fails if the library has none of them, or if the kernel refuses a probe.
    pub fn attach(&mut self, file: &File) -> Result<Attached, AttachError> {
        let places: Vec<_> = used(self.has_callbacks)
            .map(|program| match program {
                program if program == RECEIVED.0 => (program, RECEIVED.1),
                program => (program, program),
            })
            .collect();
        let names: Vec<_> = places
            .iter()
            .map(|(_, function)| format!("{PREFIX}{function}"))
            .collect();
        let names: Vec<_> = names.iter().map(String::as_str).collect();
        let offsets = library::functions(file, &names)?;
        let found = || places.iter().zip(&offsets);
        let has = |wanted| found().any(|((each, _), at)| *each == wanted && at.is_some());
        if !has("rcl_publish") && !has("rmw_take") {
            return Err(AttachError::NoFunctions);
        }
        let shows_intra_process = has(ENQUEUE);
        let found = found().filter_map(|((name, _), offset)| Some((*name, (*offset)?)));
        let found: Vec<_> = found
            .filter(|(name, _)| *name != RECEIVED.0 || !shows_intra_process)
            .collect();
        Ok(Attached {
            _attached: self.breakpoints.attach(file, &found)?,
            shows_intra_process,
        })
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

    /// Reads the other clocks, and sets their differences to CLOCK_MONOTONIC.
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
    /// a handle during it; figures are cumulative, so the next one has the rest.
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
