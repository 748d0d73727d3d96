//! Rows of the history, for each topic and each process.

/// Rows of one topic or process, in the order of their times.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Series<N, R> {
    /// Topic or process.
    pub of: N,
    /// Its rows.
    pub rows: Vec<R>,
}

/// A topic.
#[derive(Clone, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct TopicName {
    /// Domain id.
    pub domain_id: u32,
    /// DDS name, such as `rt/points`.
    pub dds_name: String,
}

/// Measurements of one topic over some seconds.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TopicRow {
    /// End of these seconds, as Unix time.
    pub at: u32,
    /// Number of measured seconds.
    pub seconds: u32,
    /// Messages received whole.
    pub messages: u32,
    /// Messages that the worst subscriber lost.
    pub lost: u32,
    /// Payload bytes.
    pub bytes: u64,
    /// Median and 99th percentile of the time from the writer's timestamp to the capture, in
    /// seconds; `None` without a message. Stored with 8 significant bits.
    pub latency: Option<[f32; 2]>,
    /// The same of the time between messages of one writer; `None` without two messages.
    pub interarrival: Option<[f32; 2]>,
}

/// A process of the host.
#[derive(Clone, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct ProcessName {
    /// Process id.
    pub id: u32,
    /// Its script, or the name of its program.
    pub name: String,
}

/// Usage of one process over some seconds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ProcessRow {
    /// End of these seconds, as Unix time.
    pub at: u32,
    /// Number of seconds to which the CPU time belongs.
    pub seconds: u32,
    /// CPU time of all threads in these seconds, in milliseconds.
    pub cpu_ms: u32,
    /// Resident memory at the end, in KiB.
    pub memory_kib: u64,
}
