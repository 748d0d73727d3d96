//! Metrics of the agent itself (`ros2probe_*`, `process_*`): drops, decode errors, limits.

use super::Metric;

pub const BUILD_INFO: Metric = Metric::info(
    "ros2probe_build_info",
    &["version", "arch"],
    "Version and build of the agent.",
);
pub const SOURCE_INFO: Metric = Metric::info(
    "ros2probe_capture_source_info",
    &["source", "reason"],
    "The source of packets: the host's sockets, the wire or a replay, and why a source that \
     shows more is not used.",
);
pub const WIRE_INFO: Metric = Metric::info(
    "ros2probe_capture_wire_info",
    &["hook", "reason"],
    "How interfaces are observed: by programs at `tcx`, or by `packet` sockets and why tcx is not \
     used. Absent if no interface is observed.",
);
pub const SANDBOX_INFO: Metric = Metric::info(
    "ros2probe_sandbox_info",
    &["system_calls", "reason"],
    "System calls that the kernel permits the agent: `filtered` (only those that it makes), \
     or `all` with the reason.",
);
pub const ABILITY: Metric = Metric::gauge(
    "ros2probe_capture_ability",
    &["ability"],
    "1 if the source provides the ability: each subscriber, messages sent, losses in socket buffers and in \
     reassembly, socket owners, containers, forwarded traffic, shared memory, every message in \
     it.",
);
pub const READY: Metric = Metric::gauge(
    "ros2probe_ready",
    &[],
    "1 while packets are captured and the model is fresh: the condition of /readyz.",
);
pub const CAPTURE_PACKETS: Metric = Metric::counter(
    "ros2probe_capture_packets_total",
    &["interface"],
    "Packets passed by the filter to user space; `sockets` are datagrams captured at the host's \
     sockets, `processes` messages captured in processes that send into shared memory.",
);
pub const CAPTURE_DROPPED: Metric = Metric::counter(
    "ros2probe_capture_dropped_packets_total",
    &["interface"],
    "Packets lost because the ring was full, by socket (`any`: all interfaces of a namespace); \
     above 0, all other counts are lower bounds.",
);
pub const CAPTURE_COPIED: Metric = Metric::counter(
    "ros2probe_capture_copied_bytes_total",
    &[],
    "Bytes copied to user space, packets and records.",
)
.unit("bytes");
pub const FILTER_EVENTS: Metric = Metric::counter(
    "ros2probe_filter_events_total",
    &["event"],
    "Events of the kernel filter.",
)
.experimental();
pub const FILTER_REFUSED: Metric = Metric::counter(
    "ros2probe_filter_refused_updates_total",
    &[],
    "Changes of interest refused because the kernel filter's table was full; those writers stay \
     unknown to it.",
);
pub const RECORDS_DROPPED: Metric = Metric::counter(
    "ros2probe_records_dropped_total",
    &[],
    "Measurement records lost because their ring was full: above 0, counts are lower bounds.",
);
pub const PIECES_DROPPED: Metric = Metric::counter(
    "ros2probe_dropped_datagrams_total",
    &[],
    "Datagrams captured at the host's sockets that were lost because their ring was full: discovery may be incomplete.",
);
pub const CONTENDED: Metric = Metric::counter(
    "ros2probe_contended_datagrams_total",
    &[],
    "Frames and datagrams that the kernel programs skipped because they interrupted each other \
     too often; above 0, counts are lower bounds.",
);
pub const INCOMPLETE_DATAGRAMS: Metric = Metric::counter(
    "ros2probe_incomplete_datagrams_total",
    &[],
    "Fragmented datagrams that never became complete.",
);
pub const REASSEMBLY: Metric = Metric::gauge(
    "ros2probe_reassembly_bytes",
    &[],
    "Memory for reassembling captured datagrams: IP fragments up to limits.reassembly_bytes, and \
     pieces from the sockets up to 4 MiB.",
)
.unit("bytes");
pub const SHM_OPEN: Metric = Metric::gauge(
    "ros2probe_shm_open",
    &["kind"],
    "Open ports and segments of Fast DDS's shared memory, and their directories.",
);
pub const SHM_EVENTS: Metric = Metric::counter(
    "ros2probe_shm_events_total",
    &["event"],
    "Shared-memory polling: messages announced at ports, read, captured and missed, and errors.",
)
.experimental();
pub const SHM_LOOKS: Metric =
    Metric::counter("ros2probe_shm_looks_total", &[], "Polls of shared memory.");
pub const SHM_CPU: Metric = Metric::counter(
    "ros2probe_shm_cpu_seconds_total",
    &[],
    "CPU time of these polls: up to capture.shm.cpu_percent of a CPU, and briefly more while \
     participants discover each other.",
)
.unit("seconds");
pub const SHM_EXACT_INFO: Metric = Metric::info(
    "ros2probe_shm_exact_info",
    &["library", "state", "reason"],
    "With capture.shm.exact: Fast DDS libraries in use, attached or refused with the reason; \
     without a library: why messages are only sampled.",
);
pub const DATAGRAMS: Metric = Metric::counter(
    "ros2probe_datagrams_total",
    &[],
    "Datagrams parsed in user space.",
);
pub const TLS_CONNECTIONS: Metric = Metric::counter(
    "ros2probe_rtps_tcp_tls_connections_total",
    &[],
    "TCP connections with TLS to addresses that participants announce; nothing in them is read.",
)
.experimental();
pub const RECORDS: Metric =
    Metric::counter("ros2probe_records_total", &[], "Measurement records read.");
pub const DECODE_ERRORS: Metric = Metric::counter(
    "ros2probe_decode_errors_total",
    &["stage", "reason"],
    "Packets and submessages that could not be parsed, by element and reason.",
);
pub const TABLE_ENTRIES: Metric = Metric::gauge(
    "ros2probe_table_entries",
    &["table"],
    "Entries of a bounded table; bytes for samples.",
);
pub const TABLE_LIMIT: Metric = Metric::gauge(
    "ros2probe_table_limit",
    &["table"],
    "Cap of a bounded table.",
);
pub const TABLE_BYTES: Metric = Metric::gauge(
    "ros2probe_table_bytes",
    &["table"],
    "Memory of a table with a cap in bytes, in bytes.",
);
pub const TABLE_BYTES_LIMIT: Metric = Metric::gauge(
    "ros2probe_table_bytes_limit",
    &["table"],
    "Cap of a table in bytes.",
);
pub const TABLE_EVICTIONS: Metric = Metric::counter(
    "ros2probe_table_evictions_total",
    &["table"],
    "Entries evicted because of the cap.",
);
pub const LIMIT: Metric = Metric::gauge(
    "ros2probe_limit",
    &["limit"],
    "Caps of the configuration, by their key below `limits`: entries, connections or bytes.",
);
pub const LIMIT_USED: Metric = Metric::gauge(
    "ros2probe_limit_used",
    &["limit"],
    "Use of each cap; for api_clients, at the busiest listener.",
);
pub const LIMIT_REACHED: Metric = Metric::counter(
    "ros2probe_limit_reached_total",
    &["limit"],
    "Entries refused or evicted because of each cap; tables, topics, subscriptions and messages \
     also have metrics of their own.",
);
pub const AT_LIMIT: Metric = Metric::gauge(
    "ros2probe_at_limit",
    &["limit"],
    "1 while a cap is reached, and for a minute after it caused a refusal or eviction.",
);
pub const TRACKED_TOPICS: Metric = Metric::gauge(
    "ros2probe_tracked_topics",
    &[],
    "Topics with series, measured now or earlier.",
);
pub const TOPICS_REJECTED: Metric = Metric::counter(
    "ros2probe_topics_rejected_total",
    &[],
    "Topics that match a watch but are not measured because of the cap.",
);
pub const TOPICS_HIDDEN: Metric = Metric::gauge(
    "ros2probe_topics_not_shown",
    &[],
    "Topics without series of their own because of the cap or an ambiguous name.",
);
pub const DELIVERIES_HIDDEN: Metric = Metric::gauge(
    "ros2probe_deliveries_not_shown",
    &[],
    "Deliveries and acknowledging readers of per_subscriber topics beyond the first 1000 of \
     each: they are only in the topic's sums.",
);
pub const SNAPSHOT_AGE: Metric = Metric::gauge(
    "ros2probe_snapshot_age_seconds",
    &[],
    "Age of the state on this page.",
)
.unit("seconds");
pub const SCRAPE_DURATION: Metric = Metric::gauge(
    "ros2probe_scrape_duration_seconds",
    &[],
    "Time taken to write the previous scrape.",
)
.unit("seconds");
pub const RELOAD_SUCCESSFUL: Metric = Metric::gauge(
    "ros2probe_config_last_reload_successful",
    &[],
    "1 unless the last reload of the configuration was refused.",
);
pub const RELOAD_TIMESTAMP: Metric = Metric::gauge(
    "ros2probe_config_last_reload_success_timestamp_seconds",
    &[],
    "Unix time of the last successful load of the configuration.",
)
.unit("seconds");

pub const STATE_WRITES: Metric = Metric::counter(
    "ros2probe_state_writes_total",
    &["outcome"],
    "Writes of discovery state and added watches, by result; absent if no state is kept.",
);
pub const RESTORED: Metric = Metric::gauge(
    "ros2probe_restored_participants",
    &[],
    "Participants restored from saved state and not heard since; removed when their lease ends.",
);
pub const HISTORY_WRITES: Metric = Metric::counter(
    "ros2probe_history_writes_total",
    &["outcome"],
    "Minutes of history on disk, by result; absent if none is kept.",
);
pub const HISTORY_BYTES: Metric = Metric::gauge(
    "ros2probe_history_bytes",
    &[],
    "Size of the history on disk.",
)
.unit("bytes");
pub const OTLP_EXPORTS: Metric = Metric::counter(
    "ros2probe_otlp_exports_total",
    &["signal", "outcome"],
    "Requests to the OTLP endpoint: delivered, partial (taken in part), retried or failed; absent where nothing is exported.",
);
pub const OTLP_DROPPED: Metric = Metric::counter(
    "ros2probe_otlp_dropped_total",
    &["signal", "reason"],
    "Data points, log records and spans that were not delivered: overflow (queue full), \
     superseded (by newer points), refused, rejected (in part), too_large \
     or shutdown.",
);
pub const OTLP_QUEUE: Metric = Metric::gauge(
    "ros2probe_otlp_queue_bytes",
    &["signal"],
    "Events, spans and log records that wait on disk for the OTLP endpoint, in bytes; at most otlp.queue_bytes.",
)
.unit("bytes");
pub const REMOTE_WRITE_REQUESTS: Metric = Metric::counter(
    "ros2probe_remote_write_requests_total",
    &["outcome"],
    "Requests of remote write: delivered, retried or refused; absent without a receiver.",
);
pub const REMOTE_WRITE_SAMPLES: Metric = Metric::counter(
    "ros2probe_remote_write_samples_total",
    &["outcome"],
    "Samples of remote write: delivered, refused, or lost by overflow (queue full), series_limit \
     (too many new ones in an hour) or shutdown.",
);
pub const REMOTE_WRITE_SENT: Metric = Metric::counter(
    "ros2probe_remote_write_sent_bytes_total",
    &[],
    "Compressed bodies of the requests of remote write, in bytes.",
)
.unit("bytes");
pub const REMOTE_WRITE_QUEUE: Metric = Metric::gauge(
    "ros2probe_remote_write_queue_bytes",
    &[],
    "Samples that wait on disk for remote write, in bytes; at most remote_write.queue_bytes.",
)
.unit("bytes");
pub const REMOTE_WRITE_BEHIND: Metric = Metric::gauge(
    "ros2probe_remote_write_behind_seconds",
    &[],
    "Age of the oldest samples that the receiver does not have; 0 if it has all.",
)
.unit("seconds");

pub const SUBSCRIPTIONS: Metric = Metric::gauge(
    "ros2probe_subscriptions",
    &[],
    "Clients that receive single messages, and recordings; at most limits.subscriptions.",
);
pub const SUBSCRIPTIONS_REFUSED: Metric = Metric::counter(
    "ros2probe_subscriptions_refused_total",
    &[],
    "Clients and recordings refused because of that cap.",
);
pub const SAMPLES_GIVEN: Metric = Metric::counter(
    "ros2probe_given_messages_total",
    &[],
    "Messages put into the queues of subscriptions, counted per subscription.",
);
pub const SAMPLES_MISSED: Metric = Metric::counter(
    "ros2probe_missed_messages_total",
    &["reason"],
    "Messages that a subscription missed, as reported to it: incomplete (fragments were never \
     seen), lost (no part was seen), unannounced (sent before the writer's announcement), not_captured (the bytes could not be captured), queue_full (a slow reader).",
);
pub const SAMPLES_QUEUED: Metric = Metric::gauge(
    "ros2probe_queued_bytes",
    &[],
    "Bytes of messages waiting in the queues of subscriptions, at most half of \
     limits.payload_bytes; messages being reassembled are in the table payloads.",
)
.unit("bytes");

pub const SAMPLES_RETAINED: Metric = Metric::gauge(
    "ros2probe_retained_bytes",
    &[],
    "Bytes of last messages of transient-local writers that are kept for later recordings and \
     viewers, at most 16 MiB.",
)
.unit("bytes");
pub const FOXGLOVE_CLIENTS: Metric = Metric::gauge(
    "ros2probe_foxglove_clients",
    &[],
    "Viewers connected over the Foxglove protocol.",
)
.experimental();
pub const FOXGLOVE_SUBSCRIPTIONS: Metric = Metric::gauge(
    "ros2probe_foxglove_subscriptions",
    &[],
    "Channels that these viewers subscribe to.",
)
.experimental();
pub const FOXGLOVE_REFUSED: Metric = Metric::counter(
    "ros2probe_foxglove_refused_total",
    &[],
    "Viewers that were refused: without a right, from a web page elsewhere, or without the \
     protocol.",
)
.experimental();
pub const FOXGLOVE_SENT: Metric = Metric::counter(
    "ros2probe_foxglove_sent_messages_total",
    &[],
    "Messages sent to viewers, statistics included.",
)
.experimental();
pub const FOXGLOVE_SENT_BYTES: Metric = Metric::counter(
    "ros2probe_foxglove_sent_bytes_total",
    &[],
    "Bytes of those messages.",
)
.unit("bytes")
.experimental();
pub const FOXGLOVE_DROPPED: Metric = Metric::counter(
    "ros2probe_foxglove_dropped_messages_total",
    &[],
    "Messages dropped because a viewer reads too slowly; each is in \
     ros2probe_missed_messages_total, too.",
)
.experimental();
pub const ROS2_DAEMON_PORTS: Metric = Metric::gauge(
    "ros2probe_ros2_daemon_ports",
    &["state"],
    "Domains by the state of their port as the ros2 daemon: listening, \
     occupied (by another process), released (by ros2 daemon stop), failed, limit (more \
     domains than ports).",
)
.experimental();
pub const ROS2_DAEMON_CLIENTS: Metric = Metric::gauge(
    "ros2probe_ros2_daemon_clients",
    &[],
    "Connections of the ros2 command line.",
)
.experimental();
pub const ROS2_DAEMON_REQUESTS: Metric = Metric::counter(
    "ros2probe_ros2_daemon_requests_total",
    &["function"],
    "Requests of the ros2 command line, by function; unknown functions share one value.",
)
.experimental();
pub const ROS2_DAEMON_REFUSED: Metric = Metric::counter(
    "ros2probe_ros2_daemon_refused_total",
    &["reason"],
    "Requests refused as the ros2 daemon: full (too many connections), host (another header), \
     origin (a web page), path (or method), size, malformed (not a \
     call), memory (slow readers).",
)
.experimental();
pub const RECORDINGS: Metric = Metric::gauge("ros2probe_recordings", &[], "Bags being written.");
pub const RECORDED_MESSAGES: Metric = Metric::counter(
    "ros2probe_recorded_messages_total",
    &[],
    "Messages written into the agent's bags.",
);
pub const RECORDED_BYTES: Metric = Metric::counter(
    "ros2probe_recorded_bytes_total",
    &[],
    "Bytes of those messages.",
)
.unit("bytes");
pub const RECORDINGS_MISSING: Metric = Metric::counter(
    "ros2probe_recordings_missing_messages_total",
    &[],
    "Messages sent but missing in a bag: incomplete on the wire, not captured, or dropped \
     because the storage was too slow.",
);
pub const SNAPSHOT_MESSAGES: Metric = Metric::gauge(
    "ros2probe_snapshot_messages",
    &["snapshot"],
    "Messages that a snapshot keeps in memory.",
);
pub const SNAPSHOT_BYTES: Metric = Metric::gauge(
    "ros2probe_snapshot_bytes",
    &["snapshot"],
    "Memory of a snapshot, at most its max_bytes.",
)
.unit("bytes");
pub const SNAPSHOT_CROWDED_OUT: Metric = Metric::counter(
    "ros2probe_snapshot_crowded_out_messages_total",
    &["snapshot"],
    "Messages evicted from a snapshot's memory before its time span; above 0, the snapshot is \
     shorter than configured.",
);
pub const SNAPSHOTS_WRITTEN: Metric = Metric::counter(
    "ros2probe_snapshots_written_total",
    &["snapshot"],
    "Bags written from a snapshot.",
);
pub const SNAPSHOTS_FAILED: Metric = Metric::counter(
    "ros2probe_snapshots_failed_total",
    &["snapshot"],
    "Bags of a snapshot that could not be written.",
);
pub const SNAPSHOTS_SUPPRESSED: Metric = Metric::counter(
    "ros2probe_snapshots_suppressed_total",
    &["snapshot"],
    "Events that met a trigger of a snapshot and began no bag: one was being written, or \
     min_interval_s had not passed.",
);
pub const SNAPSHOTS_REMOVED: Metric = Metric::counter(
    "ros2probe_snapshots_removed_total",
    &["snapshot"],
    "Old triggered bags of a snapshot that were removed for new ones.",
);
pub const EVENTS: Metric = Metric::counter(
    "ros2probe_events_total",
    &["name"],
    "Events emitted, by name.",
);
pub const EVENTS_DROPPED: Metric = Metric::counter(
    "ros2probe_events_dropped_total",
    &["reason"],
    "Events counted but not emitted in a storm, or overwritten before a slow reader read them.",
);
pub const LOG_LINES_LOST: Metric = Metric::counter(
    "ros2probe_log_lines_lost_total",
    &[],
    "Log lines lost because standard error was full, closed or not read.",
);

// Metrics of the process, under the names that all exporters use.
pub const PROCESS_CPU: Metric = Metric::counter(
    "process_cpu_seconds_total",
    &[],
    "User and system CPU time.",
)
.unit("seconds");
pub const PROCESS_RESIDENT: Metric =
    Metric::gauge("process_resident_memory_bytes", &[], "Resident memory.").unit("bytes");
pub const PROCESS_UNRECLAIMABLE: Metric = Metric::gauge(
    "process_unreclaimable_memory_bytes",
    &[],
    "Memory that the kernel cannot reclaim: anonymous and changed pages, swap, rings.",
)
.unit("bytes");
pub const PROCESS_VIRTUAL: Metric =
    Metric::gauge("process_virtual_memory_bytes", &[], "Virtual memory.").unit("bytes");
pub const PROCESS_OPEN_FDS: Metric =
    Metric::gauge("process_open_fds", &[], "Open file descriptors.");
pub const PROCESS_MAX_FDS: Metric =
    Metric::gauge("process_max_fds", &[], "Limit of open file descriptors.");
pub const PROCESS_START_TIME: Metric = Metric::gauge(
    "process_start_time_seconds",
    &[],
    "Unix time when the process started.",
)
.unit("seconds");
