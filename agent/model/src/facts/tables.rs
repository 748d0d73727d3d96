//! Declarations of the model's tables: what foreign input can fill, and how far.

use ros2probe_wire::inside::{HANDLE_CAPACITY, PROCESS_CAPACITY};

use crate::facts::bounded::CONFIGURED;
use crate::facts::bounded::Rule::{LargestOwner, Oldest};

crate::tables! {
    /// Known causes of losses of one receiver
    KnownLosses { name: "loss_causes.known", entries: 8192, rule: Oldest, reported: "table `samples`" }
    /// Runs of losses of one receiver whose cause is open
    OpenLosses {
        name: "loss_causes.pending", entries: 1024, rule: Oldest,
        effect: "the oldest counts as lost before the host",
    }
    /// Losses at a socket of an unknown participant that are reported later, per socket
    WithheldLosses { name: "delivery.withheld", entries: 64, rule: Oldest, effect: "the oldest is only counted" }
    /// Latest retransmissions that reached receivers on this host
    Retransmissions { name: "retransmissions", entries: 4096, rule: Oldest }
    /// Drops at a full socket buffer that wait for the datagram's arrival record, per receiver
    UndeliveredParts { name: "undelivered.waiting", entries: 4096, rule: Oldest, reported: "table `samples`" }
    /// Departures of one writer's latest samples
    LatestDepartures { name: "departures.latest", entries: 64, rule: Oldest }
    /// Destinations of one writer
    WriterRoutes {
        name: "routes.routes", entries: 512, effect: "the one with the longest silence is dropped",
        reported: "table `deliveries`",
    }
    /// Times at which the numbers that left for one destination are remembered
    DepartureTimes { name: "routes.left", entries: 24, rule: Oldest }
    /// Readers of one writer that acknowledge
    AcknowledgingReaders {
        name: "acknowledgements.readers", entries: 512, effect: "the reader is not tracked",
        reported: "table `deliveries`",
    }
    /// Times of one writer's samples that are not acknowledged
    SampleTimes { name: "acknowledgements.times", entries: 256, effect: "every other old one is dropped" }
    /// Times of one window of sequence numbers at which numbers below are decided
    Checkpoints { name: "sequence.checkpoints", entries: 48 }
    /// Latest gaps in the sequence numbers of one writer
    SequenceGaps { name: "sequence.gaps", entries: 32, rule: Oldest }
    /// Ranges of unconfirmed sequence numbers of one writer
    UnconfirmedNumbers {
        name: "sequence.unconfirmed", entries: 32, rule: Oldest,
        effect: "the oldest is dropped; its messages may count twice",
        reported: "`ros2_topic_doubted_sequence_jumps_total`",
    }
    /// Unfinished fragmented messages of one writer
    PartialSamples {
        name: "samples.partial", entries: 16, effect: "the one with the longest wait is lost",
        reported: "table `samples`",
    }
    /// Writers whose messages get spans, or not
    TracedWriters { name: "trace.writers", entries: 4096, effect: "its messages get no spans", reported: "table `spans`" }
    /// Messages with an open span
    OpenSpans { name: "spans", entries: 4096, effect: "the message gets no span" }
    /// Messages of one traced writer that began to leave or to arrive
    MessagesUnderWay {
        name: "trace.writer.under_way", entries: 16, effect: "the oldest gets no span", reported: "table `spans`",
    }
    /// Messages of one traced writer that arrived, or that wait for acknowledgements
    OpenMessages {
        name: "trace.writer.open", entries: 256, effect: "the oldest gets no further span", reported: "table `spans`",
    }
    /// Messages of one traced writer whose span has ended
    FinishedMessages { name: "trace.writer.done", entries: 128, rule: Oldest }
    /// Readers of one message whose acknowledgement has a span
    SettledReaders { name: "trace.message.readers", entries: 32, effect: "the reader gets no span" }
    /// Finished spans that are not yet taken
    FinishedSpans { name: "trace.finished", entries: 2048, effect: "dropped", reported: "`ros2probe_otlp_dropped_total`" }
    /// Aliases of keys on connections of Zenoh
    ZenohAliases { name: "zenoh_aliases", entries: 65_536, bytes: Some(6 << 20), rule: LargestOwner }
    /// Pairs of a direction of a connection of Zenoh and a token that it declares
    ZenohDeclared { name: "zenoh_declared", entries: 131_072, bytes: Some(12 << 20) }
    /// Numbers that connections of Zenoh give their tokens
    ZenohTokenIds { name: "zenoh_token_ids", entries: 65_536, bytes: Some(4 << 20) }
    /// Liveliness tokens of Zenoh, with their sessions and nodes
    ZenohTokens { name: "zenoh_tokens", entries: 16_384, bytes: Some(16 << 20) }
    /// Pairs of a router of Zenoh and a session of which it passes on tokens
    ZenohPassages { name: "zenoh_passages", entries: 32_768, bytes: Some(4 << 20) }
    /// Writers in the tokens of Zenoh, and in the saved state
    ZenohWriters { name: "zenoh.writers", entries: 2 * ZenohTokens::CAP, reported: "table `zenoh_tokens`" }
    /// Sessions of Zenoh in the saved state
    ZenohRestored { name: "zenoh.restored", entries: 2 * ZenohTokens::CAP }
    /// Services in the tokens of Zenoh
    ZenohServers { name: "zenoh.servers", entries: 2 * ZenohTokens::CAP, reported: "table `zenoh_tokens`" }
    /// Directions of connections of Zenoh with state
    ZenohDirections { name: "zenoh_directions", entries: 4096, effect: "the one with the longest silence loses its aliases" }
    /// Messages of one direction of a connection of Zenoh in FRAGMENTs
    ZenohChains {
        name: "zenoh.chains", entries: 16, effect: "its payload is not captured; it counts",
        reported: "`ros2probe_zenoh_incomplete_messages_total`",
    }
    /// Bytes of messages of Zenoh in FRAGMENTs
    ZenohChainBytes {
        name: "zenoh.chains.bytes", entries: 20 << 20, effect: "their payloads are not captured; they count",
        reported: "`ros2probe_zenoh_incomplete_messages_total`",
    }
    /// Routers of Zenoh of which a connection ended
    ZenohCut { name: "zenoh.cut", entries: 256, effect: "its sessions live until their tokens are undeclared" }
    /// Connections of Zenoh that cannot be read
    ZenohUnseen {
        name: "zenoh.unseen", entries: 1024, effect: "further ones do not count",
        reported: "`ros2probe_zenoh_unseen_connections`",
    }
    /// Directions of connections of Zenoh in the saved state
    RememberedDirections { name: "zenoh.remembered", entries: 4096, effect: "further ones are not saved" }
    /// Sessions of Zenoh without a connection in the saved state
    RememberedSessions { name: "zenoh.relayed", entries: 4096, effect: "further ones are not saved" }
    /// Replies of services of Zenoh whose copies are recognized
    ZenohReplies { name: "zenoh.replies", entries: 4096, rule: Oldest }
    /// Writers of replies of Zenoh with numbers
    ZenohReplyWriters { name: "zenoh.replies.writers", entries: ZenohReplies::CAP, effect: "all numbers begin anew" }
    /// Writers of references to buffers
    ReferenceWriters { name: "references.writers", entries: 4096, effect: "further ones count all copies" }
    /// Publishers of references to buffers
    ReferenceLeads { name: "references.leads", entries: 4096, effect: "references of further ones do not count" }
    /// Connections to other hosts that carry RTPS or Zenoh
    LinkConnections {
        name: "links.connections", entries: 4096, effect: "further ones do not count",
        reported: "table `links`",
    }
    /// Pairs of addresses with such connections
    TcpLinks { name: "links", entries: 256, effect: "further ones do not count" }
    /// Connections that began with a handshake of TLS in the last minute
    ClientHellos { name: "client_hellos", entries: 1024, effect: "further ones do not count" }
    /// Writers and readers with a verdict for the kernel, and removed ones that the kernel still has
    InterestEntries {
        name: "interest.entries", entries: CONFIGURED, effect: "treated as unclassified, within that budget",
        reported: "table `interest`",
    }
    /// Sockets of this host
    KnownSockets { name: "sockets", entries: CONFIGURED }
    /// Addresses of all participants
    Addresses { name: "addresses", entries: CONFIGURED, effect: "the one announced longest ago is dropped" }
    /// Sockets with the participants that use them
    UsedSockets { name: "receivers.users", entries: CONFIGURED }
    /// Processes with the participants that send by their sockets
    SocketProcesses { name: "receivers.processes", entries: CONFIGURED }
    /// Participants of one socket or process
    SocketOwners { name: "receivers.owners", entries: 8, rule: Oldest }
    /// Participants for which a socket of this host sends
    LocalParticipants { name: "receivers.local", entries: CONFIGURED }
    /// Participants whose messages left this host by an unseen socket or in shared memory
    ParticipantsHere { name: "receivers.here", entries: CONFIGURED }
    /// Sockets that were closed, for deliveries that still refer to them
    ClosedSockets { name: "receivers.closed", entries: 1024, rule: Oldest }
    /// Transient-local writers whose last message is kept
    RetainedWriters { name: "retained_writers", entries: 1024, effect: "its message is not kept" }
    /// Bytes of these messages
    RetainedBytes {
        name: "retained_bytes", entries: 16 << 20,
        effect: "the participant with the most bytes loses its oldest message",
    }
    /// Writers of standard types that the agent reads
    RobotWriters { name: "robot_writers", entries: 1024, effect: "it is not read until another departs" }
    /// Parts of the robot with diagnostics
    DiagnosticsTable { name: "diagnostics", entries: 1024, effect: "the one with the longest silence is dropped" }
    /// Bytes of the values of diagnostics
    DiagnosticValueBytes { name: "diagnostics.values", entries: 1 << 20, effect: "the values of a status are left out" }
    /// Parameters of nodes with their last known values
    KnownParameters { name: "parameters", entries: 4096, effect: "the one with the oldest value is dropped" }
    /// Latest changes of parameters
    ParameterChanges { name: "parameter_changes", entries: 1000, rule: Oldest }
    /// Parameters in the latest requests to set them
    ParameterRequests { name: "parameter_requests", entries: 256, rule: Oldest, effect: "its effect has no known requester" }
    /// Parameters in the latest requests for values
    AskedParameters { name: "parameter_reads", entries: 1024, rule: Oldest, effect: "the value in the reply is not known" }
    /// Domains and namespaces with transforms
    TransformTrees { name: "transform_trees", entries: 64, effect: "its transforms are not shown" }
    /// Edges of all trees of transforms
    TransformEdges { name: "transforms", entries: 2048, effect: "it is not shown" }
    /// Broadcasters of one edge
    EdgeBroadcasters { name: "transforms.broadcasters", entries: 4, effect: "the one with the longest silence is dropped" }
    /// Publishers of static transforms
    StaticBroadcasters { name: "transforms.static", entries: 1024, effect: "it counts as read" }
    /// Nodes whose changes of parameters are counted
    ChangedNodes { name: "changed_nodes", entries: 512, effect: "its changes are not counted" }
    /// Managed nodes whose lifecycle state is known from their topic
    ManagedNodes { name: "robot_managed_nodes", entries: 256, effect: "its state is not shown" }
    /// Writers of which one message with a header is read
    FrameWriters { name: "robot_frames", entries: 512, effect: "its frame is not compared with the transforms until another departs" }
    /// Writers whose last message is kept, because its fields have metrics
    FieldMessages { name: "robot_fields", entries: 64, effect: "its fields have no metrics" }
    /// Bytes of these messages
    FieldBytes { name: "robot_fields.bytes", entries: 1 << 20, effect: "the fields of the newcomer have no metrics" }
    /// Measured publishers whose stamps are judged
    StampWriters { name: "stamp_writers", entries: 512, effect: "its stamps are not judged" }
    /// Nodes with figures of their logs
    LogNodes { name: "log_nodes", entries: 512, effect: "the one with the longest silence is dropped" }
    /// Messages of logs that wait to be taken
    FreshLogMessages { name: "log_messages.fresh", entries: 1000, effect: "it is not exported", reported: "`ros2probe_otlp_dropped_total`" }
    /// Latest messages of logs, at most 1 KiB each
    LogMessages { name: "log_messages", entries: 1000, rule: Oldest }
    /// Latest discovery events
    DiscoveryEvents { name: "journal.discovery", entries: 1024, rule: Oldest }
    /// Latest losses of writers
    LatestLosses { name: "journal.losses", entries: 1024, rule: Oldest }
    /// Latest losses of receivers
    LatestDeliveryLosses { name: "journal.delivery_losses", entries: 4096, rule: Oldest }
    /// Samples that subscriptions will not receive, until they are reported
    MissingSamples { name: "journal.missing", entries: 16_384 }
    /// Events that wait to be taken; they are taken when 1024 wait
    WaitingEvents { name: "events.waiting", entries: 4096, reported: "`ros2probe.events.suppressed`" }
    /// Writers whose losses in a second are combined in an event
    LossBursts { name: "events.bursts", entries: 1024, effect: "only counted", reported: "`ros2probe.events.suppressed`" }
    /// Receivers of one writer whose losses in a second are compared for an event
    LosingReceivers { name: "events.losers", entries: 32, effect: "the receiver's losses are not added up" }
    /// Seconds of the history of topics
    HistorySeconds { name: "history.seconds", entries: CONFIGURED, rule: Oldest }
    /// Rows of the history, one for each measured topic and second, 24 bytes each
    HistoryRows {
        name: "history.rows", entries: 262_144,
        effect: "the oldest second is dropped before `page.history_s` has passed",
    }
    /// Counts of topics at the end of the second before
    HistoryTotals { name: "history.before", entries: CONFIGURED, reported: "table `history`" }
    /// Counters of changes, by domain, entity and event
    ChurnCounts { name: "discovery.churn", entries: 233 * 4 * 5 }
    /// Discovery data with missing fragments
    DiscoverySamples { name: "discovery_fragments.samples", entries: 64, rule: Oldest, reported: "table `samples`" }
    /// Bytes of fragmented discovery data
    DiscoveryBytes {
        name: "discovery_fragments.bytes", entries: 1 << 20, effect: "the oldest sample is dropped",
        reported: "table `samples`",
    }
    /// Participants
    Participants { name: "participants", entries: CONFIGURED }
    /// Endpoints of all participants
    Endpoints { name: "endpoints", entries: CONFIGURED }
    /// Nodes of all participants
    Nodes { name: "nodes", entries: CONFIGURED }
    /// Endpoints of one participant
    ParticipantEndpoints { name: "discovery.participant.endpoints", entries: 4096, reported: "table `endpoints`" }
    /// Participants that wait for a free entry
    Applicants {
        name: "discovery.applicants", entries: 128, effect: "the oldest of the lowest priority is dropped",
        reported: "table `participants`",
    }
    /// Endpoints that wait for their participant or for a free entry
    PendingEndpoints {
        name: "discovery.pending_endpoints", entries: 1024,
        effect: "the oldest of the lowest priority is dropped", reported: "table `endpoints`",
    }
    /// Participants that wait with nodes
    PendingNodeLists {
        name: "discovery.pending_nodes", entries: 128,
        effect: "the oldest of the lowest priority is dropped", reported: "table `nodes`",
    }
    /// Bytes of these nodes
    PendingNodeBytes {
        name: "discovery.pending_nodes.bytes", entries: 1 << 20,
        effect: "the oldest of the lowest priority is dropped", reported: "table `nodes`",
    }
    /// Latest disposals
    LatestDisposals { name: "discovery.disposals", entries: 256, rule: Oldest }
    /// Writers of requests and replies that are captured
    ServiceWriters {
        name: "services.writers", entries: 4096, effect: "the service's calls are not measured",
        reported: "table `calls`",
    }
    /// Services, and actions, with figures
    ServiceFigures {
        name: "services.services", entries: 512,
        effect: "the one with the oldest request is dropped, unless it waits for a reply",
        reported: "table `calls`",
    }
    /// Calls without a reply, of all services
    OpenCalls { name: "calls", entries: 4096, effect: "the oldest of one client of the service is dropped" }
    /// Requests and replies whose identity is remembered for further copies
    CallIdentities { name: "services.identities", entries: 4096, rule: Oldest }
    /// Clients of one service whose request numbers are remembered
    ServiceClients {
        name: "services.clients", entries: 256, effect: "the one with the longest silence is dropped",
    }
    /// Separate parts of one fragmented reply
    ReplyRuns {
        name: "services.runs", entries: 16, effect: "the call counts as unanswered",
        reported: "`ros2_service_unanswered_requests_total`",
    }
    /// Goals of one action that wait for their result
    ActionGoals {
        name: "services.goals", entries: 64, effect: "the oldest is dropped", reported: "table `calls`",
    }
    /// Responses of `get_type_description` and replies with TypeObjects that wait to be taken, 256 KiB each; they are taken when 8 wait
    WaitingDescriptions { name: "type_descriptions.waiting", entries: 16, rule: Oldest }
    /// Times of one service or action from which quantiles are computed
    RecentDurations { name: "services.recent", entries: 1024, rule: Oldest }
    /// Observed processes
    ObservedProcesses {
        name: "inside.processes", entries: PROCESS_CAPACITY as usize, effect: "the newcomer is not counted",
        reported: "table `inside`",
    }
    /// Handles of observed processes
    InsideHandles { name: "inside", entries: HANDLE_CAPACITY as usize, effect: "the newcomer is not counted" }
    /// Nodes of one observed process
    ReportedNodes { name: "inside.nodes", entries: 256 }
    /// Managed nodes with a lifecycle state
    LifecycleStates {
        name: "inside.states", entries: 1024, effect: "the newcomer has no state", reported: "table `inside`",
    }
    /// Callbacks with late calls
    LateCallbacks {
        name: "inside.late", entries: 128, effect: "the one that was late the longest time ago is dropped",
        reported: "table `inside`",
    }
    /// Late calls of one callback with time and cause
    LateHistory { name: "inside.late.history", entries: 128, rule: Oldest }
    /// The longest late calls of one callback, with all their parts
    LongestLateCalls {
        name: "inside.late.longest", entries: 4, effect: "the shortest is dropped, or one that is older than an hour",
    }
    /// The last late calls of one callback, with all their parts
    LastLateCalls { name: "inside.late.last", entries: 4, rule: Oldest }
    /// Late calls that are not yet taken for export
    WaitingLateCalls {
        name: "inside.late.waiting", entries: 1024, effect: "has no span", reported: "`ros2probe_otlp_dropped_total`",
    }
    /// Topics of observed processes
    InsideTopicSums {
        name: "inside.topics", entries: HANDLE_CAPACITY as usize,
        effect: "the one without a process for longest is dropped, otherwise the newcomer is left out",
        reported: "table `inside`",
    }
    /// Totals of one topic from which its rate inside processes follows
    TopicTotals { name: "inside.past", entries: 12, rule: Oldest }
    /// Totals of one queue of a subscription
    QueueTotals { name: "inside.queue_past", entries: 64, rule: Oldest }
    /// Sockets and their owners, between two evaluations of chains
    ChainOwners { name: "chains.owners", entries: 4096, effect: "all are determined anew" }
    /// Publications within callbacks that others may continue
    CausalPublications { name: "chains.publications", entries: 8192, rule: Oldest }
    /// Finished spans of chains that are not yet taken
    FinishedChainSpans {
        name: "chains.spans", entries: 4096, effect: "dropped", reported: "`ros2probe_otlp_dropped_total`",
    }
    /// Messages that wait for their chains
    ChainMessages { name: "chain_messages", entries: 32_768, effect: "the oldest stamp is evaluated early" }
    /// Stamps of messages that wait for their chains
    ChainStamps {
        name: "chains.stamps", entries: ChainMessages::CAP, effect: "the oldest stamp is evaluated early",
        reported: "table `chain_messages`",
    }
    /// Messages with one stamp
    StampMessages { name: "chains.messages", entries: 64, effect: "the stamp is no evidence for a chain" }
    /// Participants of this host at which one message with a stamp arrived
    StampArrivals { name: "chains.arrivals", entries: 16 }
    /// Latest messages of one writer with a stamp
    RecentMessages { name: "chains.writer.recent", entries: 8, rule: Oldest }
    /// Chains with figures
    ChainPaths { name: "chains", entries: 64, effect: "left out, unless another one was silent for a minute" }
    /// Messages of one chain from which quantiles are computed
    ChainTraces { name: "chains.traces", entries: 256, rule: Oldest }
    /// Figures of configured chains, by domain and method
    ExpectedProgress { name: "chains.expected", entries: 256 }
    /// Messages of one configured chain from which quantiles are computed
    ExpectedTimes { name: "chains.expected.recent", entries: 256, rule: Oldest }
    /// Outputs, and topics, with evidence for chains
    EvidenceOutputs { name: "chains.evidence", entries: 4096 }
    /// Inputs of one output with evidence for chains
    EvidenceInputs { name: "chains.evidence.inputs", entries: 64 }
    /// Latest stamps of one topic
    LatestStamps { name: "chains.latest.stamps", entries: 4, rule: Oldest }
    /// Unknown writers
    UnknownWriters { name: "unknown_writers", entries: CONFIGURED }
    /// Latest observations of unknown writers
    LatestUnknown { name: "unknown_writers.latest", entries: 256, rule: Oldest, effect: "the oldest is not counted for subscribers" }
    /// Samples of one writer that wait for lower numbers
    OrderedSamples { name: "in_order.waiting", entries: 4097, effect: "the lower numbers are given up" }
    /// Sample numbers of one writer that is not announced yet
    UnannouncedNumbers { name: "payloads.unannounced", entries: 1024, rule: Oldest }
    /// Samples that wait to be taken, and reports of missed ones
    WaitingDispatches { name: "payloads.dispatches", entries: 131_072, reported: "table `payloads`" }
    /// Unfinished fragmented messages
    AssembledSamples {
        name: "assembly.parts", entries: 16_384, effect: "the oldest is not captured",
        reported: "table `payloads`",
    }
    /// Hosts whose clocks are compared
    ClockPeers { name: "clock_peers", entries: 32, effect: "its clock is not compared" }
    /// Writers of this host that other hosts acknowledge
    ClockWriters { name: "clock_writers", entries: 256, effect: "it gives no round trips" }
}
