//! The logs of nodes as log records, on request (`otlp.node_logs`).

use std::sync::Arc;
use std::time::{Duration, SystemTime};

use opentelemetry::logs::{AnyValue, LogRecord as _, Logger as _, LoggerProvider as _, Severity};
use opentelemetry::trace::{SpanId, TraceFlags, TraceId};
use opentelemetry_sdk::logs::{SdkLogRecord, SdkLogger, SdkLoggerProvider};
use ros2probe_model::derive::robot::logs::LogMessage;
use ros2probe_wire::Timestamp;
use ros2probe_wire::log::LogLevel;

use super::events::time;
use super::exports::{Exports, Reason, Signal};
use super::own_log::LogQueue;
use super::traces::send_id;

/// The input of the queue, if logs of nodes are exported.
#[derive(Clone, Debug)]
pub struct NodeLogSink {
    queue: Arc<LogQueue>,
    exports: Arc<Exports>,
    /// Minimum level; `None` exports nothing.
    level: Option<LogLevel>,
    /// Creates records.
    logger: SdkLogger,
}

impl NodeLogSink {
    /// Creates the input of a queue for messages of this level and more severe ones.
    #[must_use]
    pub fn new(queue: Arc<LogQueue>, exports: Arc<Exports>, level: Option<LogLevel>) -> Self {
        Self {
            queue,
            exports,
            level,
            logger: SdkLoggerProvider::builder().build().logger("nodes"),
        }
    }

    /// Queues messages, each with the time of its arrival and its trace id. `lost` is the number
    /// of messages that were dropped before.
    pub fn add(&self, messages: &[(Timestamp, Option<u128>, Arc<LogMessage>)], lost: u64) {
        let Some(level) = self.level else { return };
        let mut signals = self.exports.signals();
        if messages.is_empty() || signals.all(|signal| signal != Signal::NodeLogs) {
            return;
        }
        for (arrival, trace, message) in messages {
            if message.level >= level {
                self.queue.put(self.record(*arrival, *trace, message));
            }
        }
        let signal = Signal::NodeLogs;
        self.exports.count_dropped(signal, Reason::Overflow, lost);
    }

    fn record(
        &self,
        arrival: Timestamp,
        trace: Option<u128>,
        message: &LogMessage,
    ) -> SdkLogRecord {
        let mut record = self.logger.create_log_record();
        if let Some(logged) = logged(message.stamp) {
            record.set_timestamp(logged);
        }
        record.set_observed_timestamp(time(arrival));
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
        if let Some(trace) = trace {
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
    use ros2probe_model::facts::model_time::ModelTime;
    use ros2probe_wire::{DomainId, Guid, SequenceNumber};

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

    fn sink(level: Option<LogLevel>) -> NodeLogSink {
        let exports = Arc::<Exports>::default();
        exports.enable(Signal::NodeLogs);
        NodeLogSink::new(Arc::default(), exports, level)
    }

    #[test]
    fn a_record_has_severity_place_times_and_trace_of_its_message() {
        let sink = sink(Some(LogLevel::Warn));
        let record = sink.record(Timestamp(7), Some(9), &message(LogLevel::Fatal));
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
        let all = LogLevel::ALL.map(|level| (Timestamp(7), None, message(level)));
        sink.add(&all, 4);
        assert_eq!(sink.queue.len(), 3);
        assert_eq!(sink.exports.dropped(Signal::NodeLogs, Reason::Overflow), 4);
        let off = self::sink(None);
        off.add(&all, 0);
        assert_eq!(off.queue.len(), 0);
    }

    #[test]
    fn a_stamp_before_1970_has_no_time() {
        assert_eq!(logged((-1, 0)), None);
        assert!(logged((0, u32::MAX)).is_some());
    }
}
