//! The kernel filter from user space: loads it, sets its interest map, reads its records.
//!
//! The object is committed beside its source (`agent-ebpf/`), so no BPF toolchain is needed here.
//! Loading needs CAP_BPF and CAP_PERFMON (CAP_SYS_ADMIN before Linux 5.8). Attaching the host hook
//! to a cgroup also needs CAP_NET_ADMIN.

mod deliveries;
mod host_hook;
mod uprobe;

use std::io;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};

use aya::maps::{Array, HashMap, Map, MapData, MapError, PerCpuArray, ProgramArray, RingBuf};
use aya::programs::{Program, ProgramError, ProgramFd};
use aya::{Ebpf, EbpfError, EbpfLoader};
use ros2probe_wire::filter::{Budget, COUNTER_SLOTS, Counter, PORT_CAPACITY};
use ros2probe_wire::record::{Verdict, guid_words};
use ros2probe_wire::{Guid, GuidPrefix, Record};
use rustix::thread::{CapabilitySet, capabilities};
use zerocopy::FromBytes;

use super::bpf::failed_lookup;
use super::breakpoints::permits_tail_calls;
use super::container::{self, add};
use super::tracepoints::KernelLayout;

pub use deliveries::Deliveries;
pub use host_hook::{CapturedPiece, Links};
pub use uprobe::{Form, Probes};

/// The object built by `agent-ebpf/build.sh`, through a link, which cargo packs as a file. It is
/// aligned because the ELF file is read in place.
static OBJECT: &Aligned<[u8]> = &Aligned(*include_bytes!("filter.bpf.o"));

/// Capture budget of all unknown writers, in bytes per second. It suffices for a dozen nodes that
/// start simultaneously, and bounds a storm of forged writers.
pub(crate) const UNKNOWN_BYTES_PER_SECOND: u32 = 4 << 20;
/// Record budget of all unknown writers per tenth of a second. Because refills are small, a storm
/// during a delay of this process leaves most of the record ring to known writers.
pub(crate) const UNKNOWN_RECORDS_PER_TENTH: u32 = 410;
/// Maximum number of tenths per refill: a fifth of a ring of the default size.
pub(crate) const UNKNOWN_PORTIONS: u32 = 4;

/// Bytes with the alignment of an ELF header.
#[repr(align(8))]
pub(crate) struct Aligned<T: ?Sized>(pub(crate) T);

/// The kernel filter's key of a run: writer, destination, port, interface, socket, CPU.
type RunKey = [u32; 13];

/// Why the filter is not running.
#[derive(Debug, thiserror::Error)]
pub enum FilterError {
    /// The kernel refuses BPF to this process.
    #[error("loading the kernel filter is not permitted")]
    NotPermitted(#[source] io::Error),
    /// A filter of system calls refuses BPF.
    #[error(
        "the seccomp profile refuses the system call bpf{}",
        add(container::SECCOMP_OPTION)
    )]
    Seccomp,
    /// Capabilities of this user namespace do not apply to BPF.
    #[error(
        "a user namespace of its own has no right to load the kernel filter{}",
        container::otherwise("--userns host, and start the container as root", "")
    )]
    UserNamespace,
    /// The system call does not exist.
    #[error("BPF is not available: not supported by this kernel or emulator")]
    NoBpf(#[source] io::Error),
    /// The object cannot be loaded.
    #[error("failed to load the kernel filter")]
    Load(#[source] EbpfError),
    /// The verifier refuses the program.
    #[error("the kernel refuses the filter program")]
    Program(#[source] ProgramError),
    /// The process may not attach a program to a cgroup.
    #[error("CAP_NET_ADMIN is missing{}", add("--cap-add NET_ADMIN"))]
    NetAdmin,
    /// The kernel refuses to attach a program to the cgroup.
    #[error(
        "attaching the host hook to the cgroup needs CAP_NET_ADMIN and no exclusive program on that \
         cgroup"
    )]
    AttachNotPermitted(#[source] io::Error),
    /// The verifier refuses a program for functions of libraries.
    #[error("the kernel refuses a program for functions of libraries")]
    BreakpointProgram(#[source] io::Error),
    /// The cgroup accepts no program.
    #[error("failed to attach the host hook to the cgroup")]
    Attach(#[source] io::Error),
    /// The object lacks a part that this binary needs.
    #[error("the kernel filter object has no {0}")]
    Missing(&'static str),
    /// A map operation failed.
    #[error("the kernel filter's {map} map: {action}")]
    Map {
        /// Name of the map.
        map: &'static str,
        /// The failed action.
        action: &'static str,
        /// Cause of the failure.
        #[source]
        source: MapError,
    },
}

/// Sizes and defaults of one loaded filter.
#[derive(Clone, Copy, Debug)]
pub struct FilterSettings {
    /// Bytes of the record ring; rounded up to a power of two of at least a page.
    pub record_ring_bytes: u32,
    /// Host hook: bytes of the ring for captured datagrams, rounded up in the same way.
    pub piece_ring_bytes: u32,
    /// Whether to read interfaces not passed to [`Filter::accept_interface`].
    pub accept_new_interfaces: bool,
    /// Host hook: whether to use the kernel's types. Without them the hook works as on a kernel
    /// without BTF.
    pub kernel_types: bool,
    /// Host hook: whether deliveries of messages can be followed.
    pub deliveries: bool,
    /// TCP ports of Zenoh; 0 = unused.
    pub zenoh_ports: [u16; PORT_CAPACITY],
}

/// Returns the ports in the form that the programs read, without those that do not fit.
#[must_use]
pub fn ports(ports: &[u16]) -> [u16; PORT_CAPACITY] {
    let mut all = [0; PORT_CAPACITY];
    all.iter_mut().zip(ports).for_each(|(to, from)| *to = *from);
    all
}

impl Default for FilterSettings {
    fn default() -> Self {
        Self {
            record_ring_bytes: 1024 * 1024,
            piece_ring_bytes: 1024 * 1024,
            accept_new_interfaces: true,
            kernel_types: true,
            deliveries: false,
            zenoh_ports: ports(&[ros2probe_wire::zenoh::PORT]),
        }
    }
}

/// One loaded filter with its maps: of the wire hook, of the host hook, or of the uprobe.
pub struct Filter {
    /// Entry of the wire hook, the host hook's program for received datagrams, tcx' program for
    /// received packets, or the uprobe's first program.
    program: OwnedFd,
    /// tcx' program for sent packets.
    tcx_egress: Option<ProgramFd>,
    /// The wire hook's program, which its entry tail-calls; the kernel empties the array when it is
    /// closed.
    _wire: Option<ProgramArray<MapData>>,
    host: Option<host_hook::HostHook>,
    /// Ring of captured datagrams, or of captured packets at tcx; `None` for the wire hook.
    pieces: Option<RingBuf<MapData>>,
    interest: HashMap<MapData, [u32; 4], u32>,
    participants: HashMap<MapData, [u32; 3], u64>,
    interfaces: HashMap<MapData, u32, u32>,
    budget: Array<MapData, i64>,
    /// Values are [`Record`]s.
    runs: HashMap<MapData, RunKey, [u64; 17]>,
    /// Counters of each CPU, by slot.
    counters: PerCpuArray<MapData, [[u64; Counter::ALL.len()]; COUNTER_SLOTS]>,
    records: RingBuf<MapData>,
}

impl Filter {
    /// Loads the wire hook's program and its maps, without attaching it.
    ///
    /// # Errors
    /// Returns [`FilterError::NotPermitted`] without the capabilities, other errors if the kernel
    /// refuses it.
    pub fn load(settings: &FilterSettings) -> Result<Self, FilterError> {
        let mut sizes = vec![("PIECES", page_size()), ("SOCKETS", UNUSED_MAP_ENTRIES)];
        sizes.extend(NO_DELIVERIES);
        let mut ebpf = open(settings, Reads::WithHelper, &sizes, None, 0)?;
        let program = load_program(&mut ebpf, "wire")?;
        let mut wire: ProgramArray<_> = take(&mut ebpf, "WIRE")?;
        wire.set(0, &program, 0).map_err(failed("WIRE", "set"))?;
        let entry = load_program(&mut ebpf, "wire_entry")?;
        let filter = Self::with_maps(&mut ebpf, entry.as_fd(), None)?;
        Ok(Self {
            _wire: Some(wire),
            ..filter
        })
    }

    /// Loads the programs for tcx and their maps, without attaching them.
    ///
    /// # Errors
    /// Fails as [`Self::load`] does, and without CAP_NET_ADMIN.
    pub fn load_tcx(settings: &FilterSettings) -> Result<Self, FilterError> {
        let pieces = ring_size(settings.piece_ring_bytes);
        let mut sizes = vec![("PIECES", pieces), ("SOCKETS", UNUSED_MAP_ENTRIES)];
        sizes.extend(NO_DELIVERIES);
        let mut ebpf = open(settings, Reads::InPlace, &sizes, None, 0)?;
        let ingress = load_program(&mut ebpf, "tcx_ingress")?;
        let egress = load_program(&mut ebpf, "tcx_egress")?;
        let pieces = take(&mut ebpf, "PIECES")?;
        let filter = Self::with_maps(&mut ebpf, ingress.as_fd(), None)?;
        Ok(Self {
            tcx_egress: Some(egress),
            pieces: Some(pieces),
            ..filter
        })
    }

    fn with_maps(
        ebpf: &mut Ebpf,
        program: BorrowedFd<'_>,
        host: Option<host_hook::HostHook>,
    ) -> Result<Self, FilterError> {
        let mut budget: Array<_, i64> = take(ebpf, "BUDGET")?;
        // The programs run as soon as they are attached, which may be long before the first refill.
        let records = UNKNOWN_RECORDS_PER_TENTH * UNKNOWN_PORTIONS;
        for (index, amount) in [
            (Budget::CaptureBytes, UNKNOWN_BYTES_PER_SECOND),
            (Budget::Records, records),
        ] {
            budget
                .set(index as u32, i64::from(amount), 0)
                .map_err(failed("BUDGET", "fill"))?;
        }
        let program = program.try_clone_to_owned();
        Ok(Self {
            program: program.map_err(FilterError::Attach)?,
            tcx_egress: None,
            _wire: None,
            host,
            pieces: None,
            interest: take(ebpf, "INTEREST")?,
            participants: take(ebpf, "PARTICIPANTS")?,
            interfaces: take(ebpf, "INTERFACES")?,
            budget,
            runs: take(ebpf, "RUNS")?,
            counters: take(ebpf, "COUNTERS")?,
            records: take(ebpf, "RECORDS")?,
        })
    }

    /// Returns the loaded program of the wire hook, for attaching it to a socket.
    #[must_use]
    pub fn program(&self) -> BorrowedFd<'_> {
        self.program.as_fd()
    }

    /// Returns the programs for received and sent packets at tcx; `None` on other hooks.
    #[must_use]
    pub fn tcx_programs(&self) -> Option<[BorrowedFd<'_>; 2]> {
        let egress = self.tcx_egress.as_ref()?;
        Some([self.program(), egress.as_fd()])
    }

    /// Returns a descriptor that is readable when the record ring is half full.
    #[must_use]
    pub fn record_ring(&self) -> BorrowedFd<'_> {
        self.records.as_fd()
    }

    /// Sets or removes the verdict of a writer or reader.
    ///
    /// # Errors
    /// Fails if the map is full or the kernel refuses the update.
    pub fn set_interest(
        &mut self,
        endpoint: Guid,
        verdict: Option<Verdict>,
    ) -> Result<(), FilterError> {
        let key = guid_words(endpoint);
        match verdict {
            Some(verdict) => self.interest.insert(key, verdict as u32, 0),
            None => absent_is_fine(self.interest.remove(&key)),
        }
        .map_err(failed("INTEREST", "update"))
    }

    /// Starts or stops recording the time of a participant's last message.
    ///
    /// # Errors
    /// Fails if the map is full or the kernel refuses the update.
    pub fn follow_participant(
        &mut self,
        participant: GuidPrefix,
        follow: bool,
    ) -> Result<(), FilterError> {
        let key = zerocopy::transmute!(participant);
        if follow {
            self.participants.insert(key, 0, 0)
        } else {
            absent_is_fine(self.participants.remove(&key))
        }
        .map_err(failed("PARTICIPANTS", "update"))
    }

    /// Iterates over followed participants and the CLOCK_MONOTONIC nanoseconds of their last
    /// message. Omits participants that have sent nothing since they were followed.
    pub fn participants(&self) -> impl Iterator<Item = (GuidPrefix, u64)> + '_ {
        self.participants.iter().filter_map(|entry| {
            let (key, last): ([u32; 3], u64) = entry.ok()?;
            (last != 0).then(|| (zerocopy::transmute!(key), last))
        })
    }

    /// Includes or excludes an interface's frames.
    ///
    /// # Errors
    /// Fails if the map is full or the kernel refuses the update.
    pub fn accept_interface(&mut self, index: u32, accept: bool) -> Result<(), FilterError> {
        self.interfaces
            .insert(index, u32::from(accept), 0)
            .map_err(failed("INTERFACES", "update"))
    }

    /// Removes the entry of an interface that is gone.
    ///
    /// # Errors
    /// Fails if the kernel refuses the update.
    pub fn forget_interface(&mut self, index: u32) -> Result<(), FilterError> {
        absent_is_fine(self.interfaces.remove(&index)).map_err(failed("INTERFACES", "update"))
    }

    /// Sets a budget of unknown writers.
    ///
    /// # Errors
    /// Fails if the kernel refuses the update.
    pub fn set_unknown_budget(&mut self, budget: Budget, amount: u32) -> Result<(), FilterError> {
        self.budget
            .set(budget as u32, i64::from(amount), 0)
            .map_err(failed("BUDGET", "refill"))
    }

    /// Returns all counters, summed over CPUs and slots.
    ///
    /// # Errors
    /// Fails if the kernel refuses the lookup.
    pub fn counters(&self) -> Result<Vec<(Counter, u64)>, FilterError> {
        let mut sums = Counter::ALL.map(|counter| (counter, 0));
        let values = self.counters.get(&0, 0);
        let values = values.map_err(failed("COUNTERS", "read"))?;
        for counters in values.iter().flatten() {
            for ((_, sum), value) in sums.iter_mut().zip(counters) {
                *sum += value;
            }
        }
        Ok(sums.to_vec())
    }

    /// Removes and returns the runs of DATA_FRAGs that have not grown since `before`
    /// (CLOCK_MONOTONIC nanoseconds): their samples lack fragments, or another CPU continues them.
    pub fn stalled_runs(&mut self, before: u64) -> Vec<Record> {
        let stalled: Vec<_> = self
            .runs
            .iter()
            .filter_map(Result::ok)
            .map(|(key, run)| (key, zerocopy::transmute!(run)))
            .filter(|(_, run): &(RunKey, Record)| run.time <= before)
            .collect();
        // A fragment that arrives between lookup and removal is not counted. It would have to
        // arrive within that microsecond, after a pause long enough for the run to stall.
        stalled
            .into_iter()
            .filter(|(key, _)| self.runs.remove(key).is_ok())
            .map(|(_, run)| run)
            .collect()
    }

    /// Removes and returns the oldest record; `None` if the ring is empty.
    pub fn next_record(&mut self) -> Option<Record> {
        let item = self.records.next()?;
        Record::read_from_bytes(&item).ok()
    }
}

impl FilterError {
    /// Maps the loader's error, and distinguishes a missing privilege from a defect of the object.
    pub(crate) fn load(error: EbpfError) -> Self {
        if let Some(error) = not_permitted(&error) {
            Self::refused(error)
        } else if let Some(error) = caused_by(&error, libc::ENOSYS) {
            // Some profiles answer a refused call as a kernel without it does.
            match is_refused_by_seccomp() {
                true => Self::Seccomp,
                false => Self::NoBpf(error),
            }
        } else {
            Self::Load(error)
        }
    }

    /// Finds what refuses BPF.
    fn refused(error: io::Error) -> Self {
        if container::has_own_users() {
            Self::UserNamespace
        } else if holds(CapabilitySet::BPF) && is_refused_by_seccomp() {
            Self::Seccomp
        } else {
            Self::NotPermitted(error)
        }
    }

    /// Finds what refuses the attachment of a program to the cgroup.
    pub(super) fn attachment_refused(error: io::Error) -> Self {
        match holds(CapabilitySet::NET_ADMIN) {
            true => Self::AttachNotPermitted(error),
            false => Self::NetAdmin,
        }
    }

    pub(crate) fn program(error: ProgramError) -> Self {
        match not_permitted(&error) {
            Some(error) => Self::refused(error),
            None => Self::Program(error),
        }
    }

    pub(crate) fn breakpoint_program(error: io::Error) -> Self {
        match error.raw_os_error() {
            Some(libc::EPERM) => Self::refused(error),
            _ => Self::BreakpointProgram(error),
        }
    }
}

/// Returns the EPERM at the end of an error's chain of causes. EACCES does not count: the verifier
/// returns it for a refused program.
fn not_permitted(error: &(dyn std::error::Error + 'static)) -> Option<io::Error> {
    caused_by(error, libc::EPERM)
}

/// Returns whether the calling thread has a capability. Like the kernel, `CAP_SYS_ADMIN` includes
/// `CAP_BPF`.
pub(crate) fn holds(capability: CapabilitySet) -> bool {
    let effective = capabilities(None).map_or_else(|_| CapabilitySet::empty(), |s| s.effective);
    let wider = capability == CapabilitySet::BPF && effective.contains(CapabilitySet::SYS_ADMIN);
    wider || effective.contains(capability)
}

/// Returns whether a filter of system calls refuses every call of bpf. The calling thread has
/// `CAP_BPF`, so that the kernel itself would permit a lookup.
fn is_refused_by_seccomp() -> bool {
    container::is_filtered() && failed_lookup().raw_os_error() != Some(libc::EBADF)
}

fn caused_by(error: &(dyn std::error::Error + 'static), wanted: i32) -> Option<io::Error> {
    let mut cause = Some(error);
    while let Some(error) = cause {
        let code = error
            .downcast_ref::<io::Error>()
            .and_then(io::Error::raw_os_error);
        if code == Some(wanted) {
            return Some(io::Error::from_raw_os_error(wanted));
        }
        cause = error.source();
    }
    None
}

/// Number of entries of a map that the loaded programs do not use: an LRU map cannot be empty.
const UNUSED_MAP_ENTRIES: u32 = 64;

/// Sizes of the maps of deliveries where they are not followed.
const NO_DELIVERIES: [(&str, u32); 4] = [
    ("QUEUES", UNUSED_MAP_ENTRIES),
    ("QUEUED", UNUSED_MAP_ENTRIES),
    ("DELIVERIES", UNUSED_MAP_ENTRIES),
    ("SENT", UNUSED_MAP_ENTRIES),
];

/// How programs read packets.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Reads {
    /// In place where a packet is contiguous: programs at a cgroup and at tcx.
    InPlace,
    /// By calls of a helper only: programs of packet sockets.
    WithHelper,
}

/// Opens the object and creates its maps with the given `sizes`. `reads` selects the kind of
/// programs. `layout` is for programs that read the kernel's structures. `within` is the control group of the
/// processes whose shared-memory messages are read; 0 = all.
fn open(
    settings: &FilterSettings,
    reads: Reads,
    sizes: &[(&'static str, u32)],
    layout: Option<&KernelLayout>,
    within: u64,
) -> Result<Ebpf, FilterError> {
    let in_place = u32::from(reads == Reads::InPlace);
    let preempted = u32::from(preempts_everything());
    let tail_calls = permits_tail_calls();
    let ring = ring_size(settings.record_ring_bytes);
    let accept = u32::from(settings.accept_new_interfaces);
    let architecture = u32::from(cfg!(target_arch = "aarch64"));
    let (wake, wake_pieces) = (
        u64::from(ring / 2),
        u64::from(ring_size(settings.piece_ring_bytes) / 2),
    );
    let mut loader = EbpfLoader::new();
    loader
        .override_global("NEW_INTERFACES", &accept, true)
        .override_global("IN_PLACE", &in_place, true)
        .override_global("PREEMPTED", &preempted, true)
        .override_global("ARCHITECTURE", &architecture, true)
        .override_global("WITHIN", &within, true)
        .override_global("TAIL_CALLS", &tail_calls, true)
        .override_global("ZENOH_PORTS", &settings.zenoh_ports, true)
        .override_global("WAKE_BYTES", &wake, true)
        .override_global("WAKE_PIECE_BYTES", &wake_pieces, true)
        .map_max_entries("RECORDS", ring);
    for (map, size) in sizes {
        loader.map_max_entries(map, *size);
    }
    if let Some(layout) = layout {
        layout.set_globals(&mut loader);
    }
    loader.load(&OBJECT.0).map_err(FilterError::load)
}

/// Loads a program, which the kernel verifies.
fn load_program(ebpf: &mut Ebpf, name: &'static str) -> Result<ProgramFd, FilterError> {
    let program = ebpf.program_mut(name).ok_or(FilterError::Missing(name))?;
    match program {
        Program::SocketFilter(program) => program.load(),
        Program::CgroupSkb(program) => program.load(),
        Program::SchedClassifier(program) => program.load(),
        _ => return Err(FilterError::Missing(name)),
    }
    .map_err(FilterError::program)?;
    program
        .fd()
        .map_err(FilterError::Program)?
        .try_clone()
        .map_err(|error| FilterError::Program(ProgramError::IOError(error)))
}

/// Returns whether this kernel preempts code that runs with bottom halves disabled: PREEMPT_RT.
fn preempts_everything() -> bool {
    std::fs::read_to_string("/proc/sys/kernel/version")
        .map_or(true, |version| version.contains("PREEMPT_RT"))
}

fn ring_size(bytes: u32) -> u32 {
    ring_size_with(bytes, page_size())
}

/// Rounds up to a power of two of whole pages, as the kernel requires.
fn ring_size_with(bytes: u32, page: u32) -> u32 {
    bytes.next_power_of_two().max(page)
}

pub(crate) fn take<T>(ebpf: &mut Ebpf, name: &'static str) -> Result<T, FilterError>
where
    T: TryFrom<Map, Error = MapError>,
{
    let map = ebpf.take_map(name).ok_or(FilterError::Missing(name))?;
    T::try_from(map).map_err(failed(name, "open"))
}

pub(crate) fn failed(map: &'static str, action: &'static str) -> impl Fn(MapError) -> FilterError {
    move |source| FilterError::Map {
        map,
        action,
        source,
    }
}

/// Treats the removal of a missing element as a success.
pub(crate) fn absent_is_fine(result: Result<(), MapError>) -> Result<(), MapError> {
    match result {
        Err(MapError::KeyNotFound) => Ok(()),
        Err(MapError::SyscallError(error)) if error.io_error.kind() == io::ErrorKind::NotFound => {
            Ok(())
        }
        other => other,
    }
}

fn page_size() -> u32 {
    // SAFETY: sysconf has no preconditions.
    let size = unsafe { libc::sysconf(libc::_SC_PAGESIZE) };
    u32::try_from(size).unwrap_or(65_536)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ring_size_is_a_power_of_two_and_whole_pages_for_every_page_size() {
        for page in [4096, 16_384, 65_536] {
            for bytes in [0, 1, 65_536, 65_537, 300_000, 1 << 20] {
                let size = ring_size_with(bytes, page);
                assert!(size.is_power_of_two() && size.is_multiple_of(page));
                assert!(size >= bytes && size / 2 < bytes.max(page));
            }
        }
    }
}
