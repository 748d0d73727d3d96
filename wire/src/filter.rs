//! Counters and limits shared by the kernel filter and its loader.

/// Counters of the filter, per CPU. The value is the index in the counter array.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
#[repr(u32)]
pub enum Counter {
    /// UDP frames read.
    Frames = 0,
    /// RTPS messages, counted at their first or only IP fragment.
    Messages,
    /// Datagrams that were ignored.
    Ignored,
    /// Datagrams reported as records only.
    Metered,
    /// Datagrams copied to user space as a whole.
    Captured,
    /// Captured datagrams with a writer that was not classified yet.
    CapturedUnknown,
    /// Bytes of captured frames and datagrams.
    CapturedBytes,
    /// Submessages of unclassified writers beyond their capture budget, reported as records.
    MeteredUnknown,
    /// Submessages of unclassified writers beyond all budgets, not reported.
    UnknownOverBudget,
    /// Records written to the ring.
    Records,
    /// Records lost because the ring was full.
    RecordsLost,
    /// IP fragments read.
    Fragments,
    /// Duplicate IP fragments.
    FragmentsRepeated,
    /// IP fragments of a datagram whose first fragment is unknown: it arrives later, or the flow
    /// was evicted.
    FragmentsWithoutFlow,
    /// Fragmented datagrams of interest that became complete.
    FragmentedComplete,
    /// Fragmented datagrams handed over to user space.
    HandedOver,
    /// Fragmented datagrams that did not fit the flow table.
    FlowTableFull,
    /// Submessages or headers that contradict their datagram's length.
    Malformed,
    /// Second copies of loopback frames.
    LoopbackCopies,
    /// Frames of interfaces that the configuration excludes.
    InterfaceExcluded,
    /// Frames with several datagrams (UDP segmentation offload), which are not read.
    Segmented,
    /// Frames or datagrams skipped because too many runs of the program interrupted each other on
    /// one CPU.
    Contended,
    /// Captured datagrams and messages that could not be written to the ring as a whole.
    PiecesLost,
    /// Host hook: copies of a datagram that had just been captured; they are not captured again.
    CopiesNotCaptured,
    /// RTPS datagrams dropped at a full socket buffer.
    SocketFull,
    /// Datagrams dropped at a full socket buffer that do not match the host hook's last datagram.
    SocketFullUnseen,
    /// Received datagrams whose arrival is not known, while a client requests causes of late
    /// calls.
    ReceivedUnmatched,
    /// RTPS datagrams with a known first fragment that the kernel did not reassemble: fragments
    /// were missing, or the memory for fragments was full.
    NotReassembled,
    /// UDP datagrams that the kernel did not reassemble and whose first fragment is missing or
    /// unreadable.
    NotReassembledUnnamed,
    /// Messages into shared memory that could not be read from the memory of their sender.
    Unreadable,
    /// Zenoh: batches in followed directions of connections.
    ZenohBatches,
    /// Zenoh: batches of which no byte was passed on.
    ZenohSkipped,
    /// Zenoh: chunks written to the ring.
    ZenohChunks,
    /// Zenoh: chunks lost because the ring was full.
    ZenohChunksLost,
    /// Zenoh: losses of the boundary between batches, for example after reordered TCP segments.
    ZenohGaps,
    /// Zenoh: unrecognized directions of TCP connections with a segment that looked like a batch.
    ZenohCandidates,
    /// Zenoh: directions of connections that were recognized.
    ZenohConnections,
    /// On interfaces: TCP frames copied to user space.
    ZenohFrames,
    /// RTPS over TCP: directions of connections that were recognized.
    TcpConnections,
    /// RTPS over TCP: frames in followed directions of connections.
    TcpFrames,
    /// RTPS over TCP: chunks lost because the ring was full.
    TcpChunksLost,
    /// RTPS over TCP: losses of the boundary between frames.
    TcpGaps,
}

impl Counter {
    /// Every counter, in index order.
    pub const ALL: [Self; 42] = [
        Self::Frames,
        Self::Messages,
        Self::Ignored,
        Self::Metered,
        Self::Captured,
        Self::CapturedUnknown,
        Self::CapturedBytes,
        Self::MeteredUnknown,
        Self::UnknownOverBudget,
        Self::Records,
        Self::RecordsLost,
        Self::Fragments,
        Self::FragmentsRepeated,
        Self::FragmentsWithoutFlow,
        Self::FragmentedComplete,
        Self::HandedOver,
        Self::FlowTableFull,
        Self::Malformed,
        Self::LoopbackCopies,
        Self::InterfaceExcluded,
        Self::Segmented,
        Self::Contended,
        Self::PiecesLost,
        Self::CopiesNotCaptured,
        Self::SocketFull,
        Self::SocketFullUnseen,
        Self::ReceivedUnmatched,
        Self::NotReassembled,
        Self::NotReassembledUnnamed,
        Self::Unreadable,
        Self::ZenohBatches,
        Self::ZenohSkipped,
        Self::ZenohChunks,
        Self::ZenohChunksLost,
        Self::ZenohGaps,
        Self::ZenohCandidates,
        Self::ZenohConnections,
        Self::ZenohFrames,
        Self::TcpConnections,
        Self::TcpFrames,
        Self::TcpChunksLost,
        Self::TcpGaps,
    ];

    /// Returns the label value.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Frames => "frames",
            Self::Messages => "messages",
            Self::Ignored => "ignored",
            Self::Metered => "metered",
            Self::Captured => "captured",
            Self::CapturedUnknown => "captured_unknown",
            Self::CapturedBytes => "captured_bytes",
            Self::MeteredUnknown => "metered_unknown",
            Self::UnknownOverBudget => "unknown_over_budget",
            Self::Records => "records",
            Self::RecordsLost => "records_lost",
            Self::Fragments => "fragments",
            Self::FragmentsRepeated => "fragments_repeated",
            Self::FragmentsWithoutFlow => "fragments_without_flow",
            Self::FragmentedComplete => "fragmented_complete",
            Self::HandedOver => "handed_over",
            Self::FlowTableFull => "flow_table_full",
            Self::Malformed => "malformed",
            Self::LoopbackCopies => "loopback_copies",
            Self::InterfaceExcluded => "interface_excluded",
            Self::Segmented => "segmented",
            Self::Contended => "contended",
            Self::PiecesLost => "pieces_lost",
            Self::CopiesNotCaptured => "copies_not_captured",
            Self::SocketFull => "no_room",
            Self::SocketFullUnseen => "no_room_unseen",
            Self::ReceivedUnmatched => "received_unmatched",
            Self::NotReassembled => "not_reassembled",
            Self::NotReassembledUnnamed => "not_reassembled_unnamed",
            Self::Unreadable => "unreadable",
            Self::ZenohBatches => "zenoh_batches",
            Self::ZenohSkipped => "zenoh_skipped",
            Self::ZenohChunks => "zenoh_chunks",
            Self::ZenohChunksLost => "zenoh_chunks_lost",
            Self::ZenohGaps => "zenoh_gaps",
            Self::ZenohCandidates => "zenoh_candidates",
            Self::ZenohConnections => "zenoh_connections",
            Self::ZenohFrames => "zenoh_frames",
            Self::TcpConnections => "rtps_tcp_connections",
            Self::TcpFrames => "rtps_tcp_frames",
            Self::TcpChunksLost => "rtps_tcp_chunks_lost",
            Self::TcpGaps => "rtps_tcp_gaps",
        }
    }
}

/// Entries of the budget array, which user space refills.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
#[repr(u32)]
pub enum Budget {
    /// Bytes of datagrams of unclassified writers that may still be captured.
    CaptureBytes = 0,
    /// Records of unclassified writers that may still be written.
    Records = 1,
}

/// Number of counter sets per CPU, a power of two: one per slot of working memory, and one for
/// events outside of slots.
pub const COUNTER_SLOTS: usize = 8;
/// Maximum number of writers and readers in the interest map.
pub const INTEREST_CAPACITY: u32 = 16_384;
/// Maximum number of participants for which the filter notes the time of the last message.
pub const PARTICIPANT_CAPACITY: u32 = 4_096;
/// Maximum number of unclassified writers that the filter remembers.
pub const UNKNOWN_CAPACITY: u32 = 1_024;
/// Maximum number of fragmented datagrams in flight.
pub const FLOW_CAPACITY: u32 = 1_024;
/// Maximum number of interfaces of one network namespace.
pub const INTERFACE_CAPACITY: u32 = 1_024;
/// Maximum number of incomplete runs of DATA_FRAGs.
pub const RUN_CAPACITY: u32 = 512;
/// Maximum number of directions of recognized TCP connections, of Zenoh or of RTPS.
pub const CONNECTION_CAPACITY: u32 = 4_096;
/// Maximum number of directions of other TCP connections in which the filter searches for batches
/// of Zenoh.
pub const CANDIDATE_CAPACITY: u32 = 1_024;
/// Maximum number of TCP ports of Zenoh that can be configured.
pub const PORT_CAPACITY: usize = 8;
/// Bytes captured per unclassified writer before it is only metered. They suffice for the whole
/// `ros_discovery_info` burst of a starting node, or a few datagrams of a point cloud.
pub const UNKNOWN_CAPTURE_BYTES: u32 = 256 * 1024;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counters_are_listed_in_index_order() {
        for (index, counter) in Counter::ALL.into_iter().enumerate() {
            assert_eq!(counter as usize, index, "{}", counter.label());
        }
    }
}
