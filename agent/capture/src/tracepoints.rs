//! Programs for losses that the host hook cannot see: at full receive buffers and in reassembly.
//! Another program lists the processes that hold a socket.
//!
//! All programs are optional. A program that this kernel does not support is skipped, and
//! [`Abilities`] holds the reason.

use aya::programs::raw_trace_point::RawTracePointLink;
use aya::programs::{ProgramError, RawTracePoint};
use aya::{Ebpf, EbpfLoader};
use ros2probe_wire::host::Layout;
use ros2probe_wire::inside::accounting;

use super::error_chain::{Reason, in_words};
use super::kernel_types::KernelTypes;
use super::owners::Owners;

/// Facts that this kernel can provide; an error is the reason why it cannot.
#[derive(Clone, Debug)]
pub struct Abilities {
    /// Datagrams dropped at a full socket buffer, by writer and sequence number.
    pub socket_losses: Result<(), Reason>,
    /// Datagrams with missing IP fragments, by writer and sequence number.
    pub reassembly_losses: Result<(), Reason>,
    /// Processes that hold a socket.
    pub owners: Result<(), Reason>,
}

/// The running kernel's types that the programs read.
#[derive(Debug)]
pub struct KernelLayout {
    array: [u32; Layout::COUNT],
    /// Where the kernel keeps the accounting of threads.
    accounting: [u32; accounting::COUNT],
    /// Why no type is known; `None` if types were read.
    unknown: Option<Reason>,
}

/// Enumeration of drop reasons, since Linux 5.17. Reasons for fragments exist since 6.2.
const DROP_REASON_ENUM: &str = "skb_drop_reason";

/// First release that reports IPv6 datagrams dropped at a full socket buffer.
const REPORTS_IPV6: (u32, u32) = (6, 6);

/// Kernel name of each entry: a member of a structure, an enumerator, or a structure whose size is
/// read.
const LAYOUT_MEMBERS: [(Layout, &str, &str); Layout::COUNT] = [
    (Layout::BufferHead, "sk_buff", "head"),
    (Layout::BufferTail, "sk_buff", "tail"),
    (Layout::BufferNetworkHeader, "sk_buff", "network_header"),
    (Layout::BufferTransportHeader, "sk_buff", "transport_header"),
    (Layout::BufferInterface, "sk_buff", "skb_iif"),
    (
        Layout::ReasonBufferFull,
        DROP_REASON_ENUM,
        "SKB_DROP_REASON_SOCKET_RCVBUFF",
    ),
    (
        Layout::ReasonMemory,
        DROP_REASON_ENUM,
        "SKB_DROP_REASON_PROTO_MEM",
    ),
    (
        Layout::ReasonTimeout,
        DROP_REASON_ENUM,
        "SKB_DROP_REASON_FRAG_REASM_TIMEOUT",
    ),
    (
        Layout::ReasonTooFar,
        DROP_REASON_ENUM,
        "SKB_DROP_REASON_FRAG_TOO_FAR",
    ),
    (
        Layout::ReasonNone,
        DROP_REASON_ENUM,
        "SKB_DROP_REASON_NOT_SPECIFIED",
    ),
    (Layout::BufferDevice, "sk_buff", "dev"),
    (Layout::DeviceNamespace, "net_device", "nd_net"),
    (Layout::NamespaceFragments4, "net", "ipv4.fqdir"),
    (Layout::NamespaceFragments6, "net", "ipv6.fqdir"),
    (Layout::FragmentsMemory, "fqdir", "mem"),
    (Layout::FragmentsLimit, "fqdir", "high_thresh"),
    (Layout::SocketCookie, "sock", "__sk_common.skc_cookie"),
    (Layout::SocketDrops, "sock", "sk_drops"),
    (Layout::SocketDropCounters, "sock", "sk_drop_counters"),
    (Layout::SecondDropCounter, "numa_drop_counters", "drops1"),
    (Layout::SocketQueue, "sock", "sk_receive_queue.qlen"),
    (Layout::ReaderQueue, "udp_sock", "reader_queue.qlen"),
    (Layout::FileInode, "file", "f_inode"),
    (Layout::FilePrivate, "file", "private_data"),
    (Layout::InodeMode, "inode", "i_mode"),
    (Layout::InodeNumber, "inode", "i_ino"),
    (Layout::SocketFile, "socket", "file"),
    (Layout::SocketSock, "socket", "sk"),
    (Layout::TaskLeader, "task_struct", "group_leader"),
    (Layout::TaskProcess, "task_struct", "tgid"),
    (Layout::TaskName, "task_struct", "comm"),
    (Layout::TaskPid, "task_struct", "thread_pid"),
    (Layout::PidLevel, "pid", "level"),
    (Layout::PidNumbers, "pid", "numbers"),
    (Layout::PidNumberSize, "upid", ""),
    (Layout::TcpWritten, "tcp_sock", "write_seq"),
];

/// The attached programs; dropping this value detaches them.
pub struct Tracepoints {
    abilities: Abilities,
    owners: Option<Owners>,
    _links: Vec<RawTracePointLink>,
}

/// Returns where the running kernel keeps the accounting of threads, by [`accounting`]. Without its
/// types (CONFIG_DEBUG_INFO_BTF), the states of threads stay unknown.
pub(crate) fn accounting_offsets(types: Option<&KernelTypes>) -> [u32; accounting::COUNT] {
    let members = [
        ("task_struct", "se.sum_exec_runtime"),
        ("task_struct", "sched_info.run_delay"),
        ("task_struct", "nvcsw"),
        ("task_struct", "sched_task_group"),
        ("task_group", "parent"),
        ("task_group", "cfs_bandwidth.throttled_time"),
        ("task_struct", "__state"),
        ("task_struct", "pid"),
        ("task_struct", "prio"),
    ];
    let find = |(structure, member)| types?.offset(structure, member);
    let mut offsets = members.map(|member| find(member).unwrap_or(accounting::ABSENT));
    if let Some(earlier) = find(("task_struct", "state")) {
        offsets[accounting::STATE] = earlier;
    }
    offsets
}

impl KernelLayout {
    /// Reads the types of the running kernel.
    #[must_use]
    pub fn read() -> Self {
        match KernelTypes::read() {
            Ok(types) => Self::of(&types),
            Err(error) => Self::unknown(Reason::of(&error)),
        }
    }

    /// Marks every type as unknown, for this reason.
    #[must_use]
    pub fn unknown(reason: Reason) -> Self {
        Self {
            array: [Layout::ABSENT; Layout::COUNT],
            accounting: accounting_offsets(None),
            unknown: Some(reason),
        }
    }

    fn of(types: &KernelTypes) -> Self {
        let mut array = [Layout::ABSENT; Layout::COUNT];
        for (place, structure, member) in LAYOUT_MEMBERS {
            let value = match (structure, member) {
                (DROP_REASON_ENUM, reason) => types.enumerator(structure, reason),
                (_, "") => types.size(structure),
                (_, member) => types.offset(structure, member),
            };
            if let (Some(slot), Some(value)) = (array.get_mut(place as usize), value) {
                *slot = value;
            }
        }
        Self {
            array,
            accounting: accounting_offsets(Some(types)),
            unknown: None,
        }
    }

    /// Sets the layout globals of an object before it is loaded.
    pub fn set_globals<'a>(&'a self, loader: &mut EbpfLoader<'a>) {
        loader
            .override_global("LAYOUT", &self.array, true)
            .override_global("ACCOUNTING", &self.accounting, true);
    }

    /// Checks that all entries of `layout` are known; otherwise returns why a program cannot run.
    fn need(&self, layout: &[Layout]) -> Result<(), Reason> {
        if let Some(unknown) = &self.unknown {
            return Err(unknown.clone());
        }
        let absent = LAYOUT_MEMBERS.iter().find(|(place, _, _)| {
            layout.contains(place) && self.array.get(*place as usize) == Some(&Layout::ABSENT)
        });
        match absent {
            Some((_, structure, member)) => {
                Err(Reason(format!("this kernel has no {structure} {member}")))
            }
            None => Ok(()),
        }
    }
}

impl Tracepoints {
    /// Loads and attaches the programs that this kernel supports, from an object prepared with
    /// [`KernelLayout::set_globals`]. `whole_host`: the host hook sees every socket.
    #[must_use]
    pub fn attach(ebpf: &mut Ebpf, layout: &KernelLayout, whole_host: bool) -> Self {
        let mut links = Vec::new();
        let socket_losses =
            socket_losses(ebpf, layout, whole_host).map(|mut more| links.append(&mut more));
        let reassembly_losses = reassembly_losses(ebpf, layout).map(|link| links.push(link));
        let owners = owners(ebpf, layout);
        Self {
            abilities: Abilities {
                socket_losses,
                reassembly_losses,
                owners: owners.as_ref().map(|_| ()).map_err(Clone::clone),
            },
            owners: owners.ok(),
            _links: links,
        }
    }

    /// Returns the facts that this kernel can provide.
    #[must_use]
    pub const fn abilities(&self) -> &Abilities {
        &self.abilities
    }

    /// Returns the iterator over owners of sockets, if it is available.
    #[must_use]
    pub const fn owners(&self) -> Option<&Owners> {
        self.owners.as_ref()
    }
}

fn socket_losses(
    ebpf: &mut Ebpf,
    layout: &KernelLayout,
    whole_host: bool,
) -> Result<Vec<RawTracePointLink>, Reason> {
    if !whole_host && let Err(reason) = layout.need(&[Layout::SocketCookie]) {
        // A socket outside of the hook's cgroup could be mistaken for one inside.
        return Err(Reason(format!("limited to one cgroup, and {reason}")));
    }
    let mut links = vec![tracepoint(ebpf, "socket_full", "udp_fail_queue_rcv_skb")?];
    if release().is_none_or(|release| release < REPORTS_IPV6) {
        let reasons = [Layout::ReasonBufferFull, Layout::ReasonMemory];
        let program = if layout.need(&reasons).is_ok() {
            "no_room_freed"
        } else {
            "no_room_unexplained"
        };
        links.push(tracepoint(ebpf, program, "kfree_skb")?);
    }
    Ok(links)
}

/// Returns the kernel's major and minor version.
pub(crate) fn release() -> Option<(u32, u32)> {
    let release = std::fs::read_to_string("/proc/sys/kernel/osrelease").ok()?;
    let mut parts = release.split(['.', '-', '+']);
    Some((parts.next()?.parse().ok()?, parts.next()?.parse().ok()?))
}

fn reassembly_losses(ebpf: &mut Ebpf, layout: &KernelLayout) -> Result<RawTracePointLink, Reason> {
    layout.need(&[
        Layout::BufferHead,
        Layout::BufferTail,
        Layout::BufferNetworkHeader,
        Layout::BufferInterface,
    ])?;
    let program = if layout.need(&[Layout::ReasonNone]).is_ok() {
        "not_reassembled"
    } else {
        "not_reassembled_unexplained"
    };
    tracepoint(ebpf, program, "kfree_skb")
}

fn owners(ebpf: &mut Ebpf, layout: &KernelLayout) -> Result<Owners, Reason> {
    layout.need(&[
        Layout::SocketCookie,
        Layout::FileInode,
        Layout::FilePrivate,
        Layout::InodeMode,
        Layout::InodeNumber,
        Layout::SocketFile,
        Layout::SocketSock,
        Layout::TaskLeader,
        Layout::TaskProcess,
        Layout::TaskName,
        Layout::TaskPid,
        Layout::PidLevel,
        Layout::PidNumbers,
        Layout::PidNumberSize,
    ])?;
    Owners::load(ebpf).map_err(|error| Reason::of(&error))
}

fn tracepoint(
    ebpf: &mut Ebpf,
    program: &'static str,
    tracepoint: &'static str,
) -> Result<RawTracePointLink, Reason> {
    let mut attach = || -> Result<RawTracePointLink, ProgramError> {
        let Some(found) = ebpf.program_mut(program) else {
            return Err(ProgramError::NotLoaded);
        };
        let found: &mut RawTracePoint = found.try_into()?;
        found.load()?;
        let link = found.attach(tracepoint)?;
        found.take_link(link)
    };
    attach().map_err(|error| Reason(format!("tracepoint {tracepoint}: {}", in_words(&error))))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_layout_entry_has_exactly_one_name() {
        for index in 0..Layout::COUNT {
            let named = LAYOUT_MEMBERS
                .iter()
                .filter(|(place, _, _)| *place as usize == index);
            assert_eq!(named.count(), 1, "{index}");
        }
    }

    #[test]
    fn a_reason_names_the_missing_kernel_type() {
        let mut layout = KernelLayout {
            array: [7; Layout::COUNT],
            accounting: accounting_offsets(None),
            unknown: None,
        };
        let needed = [Layout::BufferHead, Layout::ReasonTimeout];
        assert_eq!(layout.need(&needed), Ok(()));
        layout.array[Layout::ReasonTimeout as usize] = Layout::ABSENT;
        let reason = layout.need(&needed).unwrap_err();
        assert_eq!(
            reason.as_str(),
            "this kernel has no skb_drop_reason SKB_DROP_REASON_FRAG_REASM_TIMEOUT"
        );
        assert_eq!(layout.need(&[Layout::BufferHead]), Ok(()));
        let reason = Reason("no types".to_owned());
        let unknown = KernelLayout::unknown(reason.clone());
        assert_eq!(unknown.need(&needed), Err(reason));
    }
}
