//! Declarations of the capture's tables: collections that foreign input can fill, and their bounds.

use ros2probe_model::facts::bounded::CONFIGURED;
use ros2probe_model::facts::bounded::Rule::Oldest;
use ros2probe_wire::filter::UNKNOWN_CAPACITY;
use ros2probe_wire::inside::{HANDLE_CAPACITY, late};

ros2probe_model::tables! {
    /// Datagrams with missing IP fragments
    Flows {
        name: "reassembly.flows", entries: 256, effect: "the oldest is dropped",
        reported: "`ros2probe_limit_reached_total{limit=\"reassembly_bytes\"}`",
    }
    /// Bytes of these datagrams
    FlowBytes {
        name: "reassembly.bytes", entries: CONFIGURED, effect: "the oldest datagram is dropped",
        reported: "`ros2probe_limit_reached_total{limit=\"reassembly_bytes\"}`",
    }
    /// Reassembled datagrams whose duplicate fragments are ignored
    FinishedFlows { name: "reassembly.finished", entries: 1024, rule: Oldest }
    /// Fragmented datagrams whose records wait for the last fragment
    AheadDatagrams {
        name: "ahead.datagrams", entries: 1024, rule: Oldest, effect: "the oldest is lost",
        reported: "`ros2probe_incomplete_datagrams_total`",
    }
    /// Records of one such datagram. A UDP payload has room for 2,047 empty submessages
    AheadRecords { name: "ahead.records", entries: 2048 }
    /// Bytes of these records and of handed-over datagrams
    AheadBytes {
        name: "ahead.bytes", entries: 4 << 20, effect: "the oldest datagram is lost",
        reported: "`ros2probe_incomplete_datagrams_total`",
    }
    /// Captured datagrams that wait for further pieces, 4 MB
    OpenPieces {
        name: "pieces.open", entries: 64, rule: Oldest, reported: "`ros2probe_incomplete_datagrams_total`",
    }
    /// Captured datagrams that wait for older records, 4 MB
    FreshDatagrams { name: "filter_reader.fresh", entries: 64, effect: "the rest stays in the ring" }
    /// Records of the kernel that wait to be counted, 18 MB
    WaitingRecords {
        name: "order.records", entries: 131_072, effect: "the rest stays in the ring",
        reported: "`ros2probe_records_dropped_total`",
    }
    /// Records of captured datagrams that wait. A hostile datagram has two thousand
    WalkedRecords { name: "order.walked", entries: 16_384, effect: "counted before their turn" }
    /// Records of polled messages that wait while uprobes are attached
    PolledRecords { name: "order.polled", entries: 16_384, effect: "counted before their turn" }
    /// Bytes of segments of Zenoh that wait for older records
    SegmentBytes { name: "order.segments.bytes", entries: 8 << 20, effect: "the oldest is read before its turn" }
    /// Captured datagrams that a full socket buffer refused, of the last second
    UndeliveredDatagrams {
        name: "order.undelivered", entries: 65_536, rule: Oldest, effect: "the oldest counts as delivered",
    }
    /// Directions of TCP connections of Zenoh and RTPS
    ZenohStreams { name: "zenoh_streams", entries: 4096, effect: "the oldest is dropped, other protocols first" }
    /// Bytes of their unfinished batches, and of waiting segments
    ZenohStreamBytes {
        name: "zenoh_stream_bytes", entries: 12 << 20,
        effect: "a frame or direction is dropped",
    }
    /// Directions of TCP connections in the order of their beginnings, with some that ended
    ZenohOrder { name: "zenoh.order", entries: 2 * ZenohStreams::CAP, effect: "those that ended are removed" }
    /// TCP segments of a direction that wait for missing ones
    SegmentsAhead {
        name: "zenoh.ahead", entries: 4097, effect: "the missing bytes are given up",
        reported: "`ros2probe_filter_events_total{event=\"zenoh_read_gaps\"}`",
    }
    /// Bytes of these segments
    SegmentsAheadBytes {
        name: "zenoh.ahead.bytes", entries: 4 << 20, effect: "the missing bytes are given up",
        reported: "`ros2probe_filter_events_total{event=\"zenoh_read_gaps\"}`",
    }
    /// Bytes collected to find a boundary in a direction: three of the largest batches
    SearchedBytes {
        name: "zenoh.search", entries: 3 * (2 + u16::MAX as usize), effect: "the search begins anew",
    }
    /// Interfaces of a network namespace
    KnownInterfaces { name: "interfaces", entries: 4096, effect: "further ones have no name" }
    /// Directories of shared memory, one for each mount namespace
    Directories {
        name: "shm.directories", entries: 64, reported: "`ros2probe_shm_events_total{event=\"left_out\"}`",
    }
    /// Files of one directory of shared memory
    DirectoryFiles {
        name: "shm.files", entries: 2048,
        effect: "files of living processes stay first, then an equal number per user, oldest first",
        reported: "`ros2probe_shm_events_total{event=\"left_out\"}`",
    }
    /// Processes in scope, in which directories and libraries are searched
    ScopeProcesses { name: "shm.processes", entries: 8192, effect: "further ones are not inspected" }
    /// Open ports of shared memory
    Ports {
        name: "shm.ports", entries: 512,
        effect: "left out; a user with fewer open ports displaces the longest idle port of a user with more",
        reported: "`ros2probe_shm_events_total{event=\"left_out\"}`",
    }
    /// Cells of one port. Fast DDS has 512 by default
    PortCells { name: "shm.port.cells", entries: 2048, effect: "the port is not read" }
    /// Ports of dead processes that are not opened again until the next search
    AbandonedPorts { name: "shm.abandoned", entries: 4096, effect: "the port is opened again" }
    /// Open segments of shared memory
    Segments {
        name: "shm.segments", entries: 512, reported: "`ros2probe_shm_events_total{event=\"left_out\"}`",
    }
    /// Messages in shared memory that are not read again at another port
    RememberedMessages { name: "shm.recent", entries: 8192, rule: Oldest }
    /// Unclassified writers in shared memory with a budget
    UnknownShmWriters {
        name: "shm.unknown", entries: UNKNOWN_CAPACITY as usize, effect: "metered within the common budget",
    }
    /// Items from shared memory that wait for the worker
    InboxItems {
        name: "shm.inbox", entries: 16_384, reported: "`ros2probe_shm_events_total{event=\"refused\"}`",
    }
    /// Bytes of messages among them
    InboxBytes {
        name: "shm.inbox.bytes", entries: 16 << 20, effect: "not captured",
        reported: "`ros2probe_shm_events_total{event=\"refused\"}`",
    }
    /// Libraries of exact mode, and of `capture.inside`
    Libraries {
        name: "uprobe.libraries", entries: 64, effect: "not attached to", reported: "`ros2probe_shm_exact_info`",
    }
    /// Files of these libraries in one process
    MappedLibraries { name: "uprobe.mapped", entries: Libraries::CAP + 1, effect: "not attached to" }
    /// Names and relations of one observed process
    InsideNames { name: "inside.names", entries: 16_384, effect: "the newcomer has no name" }
    /// New nodes of one observed process until the next report
    NewNodes { name: "inside.new_nodes", entries: 1024 }
    /// Handles of one observed process whose figures were reported
    ReportedHandles { name: "inside.reported", entries: HANDLE_CAPACITY as usize, effect: "all are reported again" }
    /// Ring buffers of one observed process with their publishers
    InsideBuffers { name: "inside.buffers", entries: HANDLE_CAPACITY as usize, effect: "all are reported again" }
    /// Causal publications until the next report
    CausalHops { name: "inside.hops", entries: 16_384, effect: "further ones are in no chain" }
    /// Callbacks whose usual durations are learnt
    CallbackBounds {
        name: "inside.bounds", entries: late::BOUND_CAPACITY as usize, effect: "further ones are never late",
    }
    /// Control groups of the threads that late calls name
    NamedCgroups { name: "inside.cgroups", entries: 1024, effect: "all are searched again" }
    /// Late calls until the next report
    LateCalls { name: "inside.late", entries: 1024 }
    /// Changes of managed nodes' states until the next report
    Transitions { name: "inside.transitions", entries: 1024 }
    /// Reports of observed processes that wait for the model. Figures are cumulative
    WaitingRounds { name: "inside.rounds", entries: 4, effect: "the next report is made later" }
}

#[cfg(test)]
pub(crate) mod tests {
    use ros2probe_model::facts::bounded::{Declared, ledger};

    /// Asserts that this test filled a table to its cap, and not beyond.
    pub(crate) fn assert_driven<D: Declared>() {
        let used = ledger()[D::TABLE.name];
        assert!(used.is_driven(), "{}: {used:?}", D::TABLE.name);
    }
}
