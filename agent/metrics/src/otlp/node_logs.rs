//! The logs of nodes as log records, on request (`otlp.node_logs`).

use std::sync::Arc;
use std::time::{Duration, SystemTime};

use opentelemetry::logs::{AnyValue, LogRecord as _, Logger as _, LoggerProvider as _, Severity};
use opentelemetry::trace::{SpanId, TraceFlags, TraceId};
use opentelemetry_sdk::logs::{SdkLogRecord, SdkLogger, SdkLoggerProvider};
use ros2probe_model::observe::input::NewLog;
use ros2probe_wire::log::LogLevel;

use super::delivery::Queue;
use super::events::time;
use super::exports::{Exports, Reason, Signal};
use super::traces::send_id;
use super::waiting::Waiting;
use crate::tables::WaitingNodeLogs;

/// Maximum number of messages in one request.
const MAX_PER_REQUEST: usize = 256;
/// Time for which messages are collected into one request.
pub(super) const BATCH_DELAY: Duration = Duration::from_millis(500);

/// The queue of messages between the capture thread and the exporter.
#[derive(Debug, Default)]
pub struct NodeLogQueue(Waiting<WaitingNodeLogs, NewLog>);

/// The input of the queue, if logs of nodes are exported.
#[derive(Clone, Debug, Default)]
pub struct NodeLogSink {
    /// The queue of messages.
    pub queue: Arc<NodeLogQueue>,
    /// Counts messages that do not fit.
    pub exports: Arc<Exports>,
    /// Minimum level; `None` exports nothing.
    pub level: Option<LogLevel>,
}

impl NodeLogSink {
    /// Queues messages. `lost` is the number of messages that were dropped before.
    pub fn add(&self, messages: Vec<NewLog>, lost: u64) {
        let Some(level) = self.level else { return };
        let mut signals = self.exports.signals();
        if messages.is_empty() || signals.all(|signal| signal != Signal::NodeLogs) {
            return;
        }
        let selected = messages
            .into_iter()
            .filter(|log| log.message.level >= level);
        let refused = self.queue.0.put(selected);
        let signal = Signal::NodeLogs;
        self.exports
            .count_dropped(signal, Reason::Overflow, refused + lost);
    }
}

/// Converts messages of the queue to the SDK's form.
pub(super) struct NodeLogs {
    queue: Arc<NodeLogQueue>,
    /// Creates records.
    logger: SdkLogger,
}

impl Queue for NodeLogs {
    type Batch = Vec<SdkLogRecord>;

    async fn wait_filled(&self) {
        self.queue.0.wait_filled().await;
    }

    fn is_half_full(&self) -> bool {
        self.queue.0.is_half_full()
    }

    /// The sink counts messages that do not fit.
    fn take(&mut self) -> (Option<Vec<SdkLogRecord>>, u64) {
        let taken = self.queue.0.take(MAX_PER_REQUEST);
        let records: Vec<_> = taken.iter().map(|log| self.record(log)).collect();
        ((!records.is_empty()).then_some(records), 0)
    }
}

impl NodeLogs {
    pub(super) fn new(queue: Arc<NodeLogQueue>) -> Self {
        Self {
            queue,
            logger: SdkLoggerProvider::builder().build().logger("nodes"),
        }
    }

    fn record(&self, log: &NewLog) -> SdkLogRecord {
        let message = &log.message;
        let mut record = self.logger.create_log_record();
        if let Some(logged) = logged(message.stamp) {
            record.set_timestamp(logged);
        }
        record.set_observed_timestamp(time(log.arrival));
        record.set_severity_text(match message.level {
            LogLevel::Debug => "DEBUG",
            LogLevel::Info => "INFO",
            LogLevel::Warn => "WARN",
            LogLevel::Error => "ERROR",
            LogLevel::Fatal => "FATAL",
        });
        record.set_severity_number(match message.level {
            LogLevel::Debug => Severity::Debug,
            LogLevel::Info => Severity::Info,
            LogLevel::Warn => Severity::Warn,
            LogLevel::Error => Severity::Error,
            LogLevel::Fatal => Severity::Fatal,
        });
        record.set_body(text(&message.text));
        record.add_attribute("domain_id", i64::from(message.domain_id.0));
        record.add_attribute("ros_node", text(&message.node));
        record.add_attribute("logger", text(&message.logger));
        record.add_attribute("code.file.path", text(&message.file));
        record.add_attribute("code.line.number", i64::from(message.line));
        record.add_attribute("code.function.name", text(&message.function));
        if let Some(trace) = log.trace_id {
            record.set_trace_context(
                TraceId::from(trace),
                SpanId::from(send_id(trace)),
                Some(TraceFlags::SAMPLED),
            );
        }
        record
    }
}

fn text(text: &str) -> AnyValue {
    AnyValue::from(text.to_owned())
}

/// Returns the time of a stamp; `None` before 1970.
fn logged((seconds, nanoseconds): (i32, u32)) -> Option<SystemTime> {
    let seconds = u64::try_from(seconds).ok()?;
    SystemTime::UNIX_EPOCH.checked_add(Duration::new(seconds, nanoseconds.min(999_999_999)))
}

#[cfg(test)]
mod tests {
    use ros2probe_model::derive::robot::logs::LogMessage;
    use ros2probe_model::facts::model_time::ModelTime;
    use ros2probe_wire::{DomainId, Guid, SequenceNumber, Timestamp};

    use super::*;

    fn message(level: LogLevel) -> Arc<LogMessage> {
        Arc::new(LogMessage {
            at: ModelTime::ZERO,
            stamp: (1_700_000_000, 5),
            domain_id: DomainId(3),
            writer: Guid::default(),
            number: SequenceNumber(1),
            node: "/lidar".into(),
            level,
            logger: "lidar.driver".into(),
            text: "no data".into(),
            file: "lidar.cpp".into(),
            function: "read".into(),
            line: 81,
        })
    }

    fn new_log(level: LogLevel) -> NewLog {
        NewLog {
            arrival: Timestamp(7),
            trace_id: Some(9),
            message: message(level),
        }
    }

    fn sink(level: Option<LogLevel>) -> NodeLogSink {
        let sink = NodeLogSink {
            level,
            ..NodeLogSink::default()
        };
        sink.exports.enable(Signal::NodeLogs);
        sink
    }

    #[test]
    fn a_log_record_has_severity_location_times_and_trace_of_its_message() {
        let logs = NodeLogs::new(Arc::default());
        let record = logs.record(&new_log(LogLevel::Fatal));
        let logged = SystemTime::UNIX_EPOCH + Duration::new(1_700_000_000, 5);
        assert_eq!(record.timestamp(), Some(logged));
        assert_eq!(record.observed_timestamp(), Some(time(Timestamp(7))));
        assert_eq!(record.severity_number(), Some(Severity::Fatal));
        assert_eq!(record.body(), Some(&text("no data")));
        let attributes: Vec<_> = record.attributes_iter().collect();
        assert_eq!(attributes.len(), 6);
        assert_eq!(attributes[4].1, AnyValue::from(81));
        let context = record.trace_context().unwrap();
        assert_eq!(context.trace_id, TraceId::from(9));
    }

    #[test]
    fn only_messages_of_the_level_are_queued_and_losses_count() {
        let sink = sink(Some(LogLevel::Warn));
        sink.add(LogLevel::ALL.map(new_log).to_vec(), 4);
        assert_eq!(sink.queue.0.take(MAX_PER_REQUEST).len(), 3);
        assert_eq!(sink.exports.dropped(Signal::NodeLogs, Reason::Overflow), 4);
        let off = self::sink(None);
        off.add(LogLevel::ALL.map(new_log).to_vec(), 0);
        assert!(off.queue.0.take(MAX_PER_REQUEST).is_empty());
    }

    #[test]
    fn a_full_queue_counts_further_messages() {
        let sink = sink(Some(LogLevel::Warn));
        sink.add(vec![new_log(LogLevel::Error); WaitingNodeLogs::CAP + 3], 0);
        assert_eq!(sink.exports.dropped(Signal::NodeLogs, Reason::Overflow), 3);
        assert_eq!(sink.queue.0.take(MAX_PER_REQUEST).len(), MAX_PER_REQUEST);
    }

    #[test]
    fn a_stamp_before_1970_has_no_time() {
        assert_eq!(logged((-1, 0)), None);
        assert!(logged((0, u32::MAX)).is_some());
    }
}
