//! Export of events as log records with an event name, in the order and with the texts of the event
//! log.
//!
//! No queue in memory is needed: the event log keeps the last events, and the exporter keeps its
//! position in it. Events that are overwritten before they are exported are counted.

use std::sync::Arc;
use std::time::{Duration, SystemTime};

use opentelemetry::InstrumentationScope;
use opentelemetry::logs::{AnyValue, LogRecord as _, Logger as _, LoggerProvider as _, Severity};
use opentelemetry_otlp::LogExporter;
use opentelemetry_proto::tonic::collector::logs::v1::ExportLogsServiceRequest;
use opentelemetry_proto::transform::common::tonic::ResourceAttributesWithSchema;
use opentelemetry_proto::transform::logs::tonic::group_logs_by_resource_and_scope;
use opentelemetry_sdk::error::OTelSdkResult;
use opentelemetry_sdk::logs::{
    LogBatch, LogExporter as _, SdkLogRecord, SdkLogger, SdkLoggerProvider,
};
use prost::Message as _;
use ros2probe_wire::Timestamp;

use super::delivery::{Export, Persist, Queue};
use super::encoded_sender::EncodedSender;
use super::reports;
use crate::event::{self, Batch, EventSource, Record, Value};

/// Time for which events are collected into one request.
pub(super) const BATCH_DELAY: Duration = Duration::from_millis(500);
/// Maximum number of events per request: about 200 KB.
const MAX_EVENTS: usize = 256;

/// Exports log records.
pub(super) struct LogExport {
    pub(super) exporter: LogExporter,
    pub(super) scope: InstrumentationScope,
    pub(super) resource: ResourceAttributesWithSchema,
    /// Sends requests that waited on disk.
    pub(super) encoded: EncodedSender,
}

impl LogExport {
    async fn export_records(&self, batch: &[SdkLogRecord]) -> OTelSdkResult {
        let records: Vec<_> = batch.iter().map(|record| (record, &self.scope)).collect();
        self.exporter.export(LogBatch::new(&records)).await
    }
}

impl Export for LogExport {
    type Batch = Vec<SdkLogRecord>;

    fn items(batch: &Vec<SdkLogRecord>) -> u64 {
        batch.len() as u64
    }

    async fn export(&self, batch: &Vec<SdkLogRecord>) -> OTelSdkResult {
        self.export_records(batch).await
    }
}

impl Persist for LogExport {
    fn encode(&self, batch: &Vec<SdkLogRecord>) -> Vec<u8> {
        let records: Vec<_> = batch.iter().map(|record| (record, &self.scope)).collect();
        let batch = LogBatch::new(&records);
        let resource_logs = group_logs_by_resource_and_scope(&batch, &self.resource);
        ExportLogsServiceRequest { resource_logs }.encode_to_vec()
    }

    async fn export_encoded(&self, request: &[u8]) -> OTelSdkResult {
        if !self.encoded.has_headers() {
            reports::unreported(self.export_records(&[])).await?;
        }
        self.encoded
            .send_encoded::<ExportLogsServiceRequest>(request)
            .await
    }

    fn divided(request: &[u8], place: u64) -> Option<[Vec<u8>; 2]> {
        EncodedSender::divided::<ExportLogsServiceRequest>(request, place)
    }

    fn padded(request: &[u8]) -> Vec<u8> {
        EncodedSender::padded::<ExportLogsServiceRequest>(request)
    }
}

/// Exports the event log.
pub(super) struct Reporter {
    log: Arc<dyn EventSource>,
    /// Creates records.
    logger: SdkLogger,
    /// Number of the last exported event.
    place: u64,
}

impl Reporter {
    /// Creates a reporter that begins with the oldest event.
    pub(super) fn new(log: Arc<dyn EventSource>) -> Self {
        Self {
            log,
            logger: SdkLoggerProvider::builder().build().logger("events"),
            place: 0,
        }
    }

    fn log_record(&self, record: &Record) -> SdkLogRecord {
        let mut exported = self.logger.create_log_record();
        exported.set_timestamp(time(record.at));
        exported.set_observed_timestamp(time(record.observed));
        exported.set_severity_text(record.severity.text());
        exported.set_severity_number(match record.severity {
            event::Severity::Info => Severity::Info,
            event::Severity::Warn => Severity::Warn,
            event::Severity::Error => Severity::Error,
        });
        exported.set_event_name(record.definition.name);
        for (name, value) in &record.attributes {
            exported.add_attribute(*name, any(value));
        }
        exported
    }
}

impl Queue for Reporter {
    type Batch = Vec<SdkLogRecord>;

    async fn wait_filled(&self) {
        self.log.wait_after(self.place).await;
    }

    /// The log keeps more events than its limits of rates permit between two writes.
    fn is_half_full(&self) -> bool {
        false
    }

    fn take(&mut self) -> (Option<Vec<SdkLogRecord>>, u64) {
        let Batch {
            lagged,
            records,
            last,
        } = self.log.read_after(self.place, MAX_EVENTS);
        self.place = last;
        let records = records.iter().map(|record| self.log_record(record));
        let records: Vec<_> = records.collect();
        ((!records.is_empty()).then_some(records), lagged)
    }
}

/// Returns the time in the SDK's form.
pub(super) fn time(time: Timestamp) -> SystemTime {
    SystemTime::UNIX_EPOCH + Duration::from_nanos(time.0)
}

fn any(value: &Value) -> AnyValue {
    match value {
        Value::Text(text) => text.clone().into(),
        Value::Number(number) => i64::try_from(*number).unwrap_or(i64::MAX).into(),
        Value::Real(real) => (*real).into(),
        Value::List(list) => {
            let list = list.iter().map(|text| AnyValue::from(text.clone()));
            AnyValue::ListAny(Box::new(list.collect()))
        }
    }
}

#[cfg(test)]
mod tests {
    use std::pin::Pin;

    use super::*;
    use crate::event::Definition;

    const DROPPED: Definition = Definition::new(
        "ros2probe.capture.dropped",
        event::Severity::Error,
        &["what", "count"],
        "",
    );

    #[derive(Debug)]
    struct Empty;

    impl EventSource for Empty {
        fn wait_after(&self, _: u64) -> Pin<Box<dyn Future<Output = ()> + '_>> {
            Box::pin(std::future::pending())
        }

        fn read_after(&self, _: u64, _: usize) -> Batch {
            Batch::default()
        }
    }

    #[test]
    fn a_log_record_has_the_attributes_of_the_event_with_their_types() {
        let record = Record {
            number: 1,
            at: Timestamp(7),
            observed: Timestamp(8),
            definition: &DROPPED,
            severity: DROPPED.severity,
            attributes: vec![
                ("what", Value::Text("packets".to_owned())),
                ("count", Value::Number(7)),
            ],
        };
        let sent = Reporter::new(Arc::new(Empty)).log_record(&record);
        assert_eq!(sent.event_name(), Some("ros2probe.capture.dropped"));
        assert_eq!(sent.severity_text(), Some("ERROR"));
        assert_eq!(sent.severity_number(), Some(Severity::Error));
        assert_eq!(record.severity.number(), 17, "{:?}", record.severity);
        assert_eq!(sent.timestamp(), Some(time(record.at)));
        assert_eq!(sent.observed_timestamp(), Some(time(record.observed)));
        let attributes = sent.attributes_iter();
        let attributes: Vec<_> = attributes
            .map(|(key, value)| (key.as_str(), value.clone()))
            .collect();
        assert_eq!(
            attributes,
            [
                ("what", AnyValue::from("packets")),
                ("count", AnyValue::from(7))
            ]
        );
    }
}
