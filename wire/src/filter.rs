//! Names and limits that the kernel filter and its loader agree on.

/// Counters of the filter, per CPU; the value is the index in its counter array.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
#[repr(u32)]
pub enum Counter {
    /// UDP frames read.
    Frames = 0,
    /// RTPS messages begun (first or only IP fragment).
    Messages,
    /// Datagrams of no interest.
    Ignored,
    /// Datagrams reported as records only.
    Metered,
    /// Datagrams handed to user space whole.
    Captured,
    /// Datagrams among them captured because a writer was not classified yet.
    CapturedUnknown,
    /// Frame bytes handed to user space.
    CapturedBytes,
    /// Submessages of unclassified writers, beyond their capture budget, reported as records.
    MeteredUnknown,
    /// Submessages of unclassified writers beyond all budgets.
    UnknownOverBudget,
    /// Records written to the ring.
    Records,
    /// Records lost because the ring was full.
    RecordsLost,
    /// IP fragments read.
    Fragments,
    /// Duplicate IP fragments.
    FragmentsRepeated,
    /// IP fragments whose first fragment is unknown: reordered, or the flow was evicted.
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
    /// Frames that hold several datagrams (UDP segmentation offload); not read.
    Segmented,
    /// Frames or datagrams skipped because too many runs of the program interrupted each other on
    /// one CPU.
    Contended,
    /// Host hook: captured datagrams with a piece that did not fit the ring.
    PiecesLost,
    /// Host hook: copies of a datagram that was captured just before, not captured again.
    CopiesNotCaptured,
    /// RTPS datagrams dropped at a full socket buffer.
    SocketFull,
    /// Datagrams dropped at a full socket buffer that the host hook had not just seen there.
    SocketFullUnseen,
    /// RTPS datagrams with missing IP fragments that the kernel gave up, or refused for lack of
    /// memory for fragments, whose first fragment is known.
    NotReassembled,
    /// The same of UDP datagrams whose first fragment is missing or unreadable.
    NotReassembledUnnamed,
    /// Messages for shared memory that could not be read in their sender's memory.
    Unreadable,
    /// Zenoh: batches that began in a followed direction of a connection.
    ZenohBatches,
    /// Zenoh: batches among them of which nothing was passed on.
    ZenohSkipped,
    /// Zenoh: chunks written to the ring.
    ZenohChunks,
    /// Zenoh: chunks lost because the ring was full.
    ZenohChunksLost,
    /// Zenoh: times that the boundary of a batch was lost, as after TCP segments out of order.
    ZenohGaps,
    /// Zenoh: places in other TCP connections that looked like a batch.
    ZenohCandidates,
    /// Zenoh: directions of connections found.
    ZenohConnections,
    /// Zenoh: frames of connections handed to user space, on interfaces.
    ZenohFrames,
}

impl Counter {
    /// Every counter, in index order.
    pub const ALL: [Self; 37] = [
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
        }
    }
}

/// Entries of the budget array, refilled by user space.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
#[repr(u32)]
pub enum Budget {
    /// Bytes of datagrams of unclassified writers that may still be captured.
    CaptureBytes = 0,
    /// Records of unclassified writers that may still be written.
    Records = 1,
}

/// Working areas with counters of their own, and one for what happens outside of them; a power of
/// two.
pub const COUNTER_SLOTS: usize = 8;
/// Writers and readers in the interest map.
pub const INTEREST_CAPACITY: u32 = 16_384;
/// Participants whose last message the filter notes.
pub const PARTICIPANT_CAPACITY: u32 = 4_096;
/// Unclassified writers that the filter remembers.
pub const UNKNOWN_CAPACITY: u32 = 1_024;
/// Fragmented datagrams in flight.
pub const FLOW_CAPACITY: u32 = 1_024;
/// Interfaces of one network namespace.
pub const INTERFACE_CAPACITY: u32 = 1_024;
/// Incomplete runs of DATA_FRAGs.
pub const RUN_CAPACITY: u32 = 512;
/// Directions of TCP connections of Zenoh that the filter follows.
pub const CONNECTION_CAPACITY: u32 = 4_096;
/// Directions of other TCP connections in which batches of Zenoh are searched for.
pub const CANDIDATE_CAPACITY: u32 = 1_024;
/// TCP ports of Zenoh that can be configured.
pub const PORT_CAPACITY: usize = 8;
/// Bytes captured per unclassified writer before it is only metered: enough for the whole
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
