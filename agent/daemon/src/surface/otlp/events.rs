//! Export of events as log records with an event name, in the order and with the texts of the event
//! log.
//!
//! No queue is needed: the event log keeps the last events, and the exporter keeps its position in
//! it. Events that are overwritten while the receiver is unavailable are counted.

use std::sync::Arc;
use std::time::Duration;

use opentelemetry_proto::tonic::collector::logs::v1::ExportLogsServiceRequest;
use opentelemetry_proto::tonic::common::v1::any_value::Value as Any;
use opentelemetry_proto::tonic::common::v1::{
    AnyValue, ArrayValue, InstrumentationScope, KeyValue,
};
use opentelemetry_proto::tonic::logs::v1::{LogRecord, ResourceLogs, ScopeLogs};
use opentelemetry_proto::tonic::resource::v1::Resource;
use prost::Message as _;

use super::client::Request;
use super::signal_sender::SignalSender;
use crate::events::EventLog;
use crate::events::{Batch, Reader, Record, Value};

/// Time for which events are collected into one request.
const GATHER: Duration = Duration::from_millis(500);
/// Largest number of events per request: about 200 KB.
const MOST: usize = 256;

/// Exports the event log.
pub(super) struct Reporter {
    log: Arc<EventLog>,
    resource: Resource,
    /// Number of the last exported event.
    place: u64,
}

impl Reporter {
    /// Creates a reporter that begins with the oldest event.
    pub(super) fn new(log: Arc<EventLog>, resource: Resource) -> Self {
        Self {
            log,
            resource,
            place: 0,
        }
    }

    /// Exports until the agent stops.
    pub(super) async fn run(mut self, mut sender: SignalSender) {
        while self.gather(&sender).await {
            while let Some(request) = self.take(&sender, MOST) {
                sender.deliver(vec![request], None).await;
                if sender.is_stopped() {
                    break;
                }
            }
        }
        let rest = std::iter::from_fn(|| self.take(&sender, MOST));
        let rest = rest.collect();
        sender.finish(rest, false).await;
    }

    /// Waits for events and for those that follow shortly; returns `false` when the agent stops.
    async fn gather(&self, sender: &SignalSender) -> bool {
        let news = async {
            self.log.wait(self.place).await;
            tokio::time::sleep(GATHER).await;
        };
        tokio::select! {
            () = news => true,
            () = sender.stopped() => false,
        }
    }

    /// Returns the next events as a request; `None` if there are no new ones.
    fn take(&mut self, sender: &SignalSender, most: usize) -> Option<Request> {
        let Batch {
            lagged,
            records,
            last,
        } = self.log.read(self.place, most);
        if lagged > 0 {
            self.log.overtook(Reader::Otlp, lagged);
            sender.overflowed(lagged);
        }
        self.place = last;
        (!records.is_empty()).then(|| request(&self.resource, &records))
    }
}

fn request(resource: &Resource, records: &[Record]) -> Request {
    let scope = InstrumentationScope {
        name: "ros2probe".to_owned(),
        version: env!("CARGO_PKG_VERSION").to_owned(),
        ..InstrumentationScope::default()
    };
    let logs = ScopeLogs {
        scope: Some(scope),
        log_records: records.iter().map(log_record).collect(),
        ..ScopeLogs::default()
    };
    let request = ExportLogsServiceRequest {
        resource_logs: vec![ResourceLogs {
            resource: Some(resource.clone()),
            scope_logs: vec![logs],
            ..ResourceLogs::default()
        }],
    };
    Request {
        body: request.encode_to_vec().into(),
        items: records.len() as u64,
    }
}

fn log_record(record: &Record) -> LogRecord {
    let attributes = record.attributes.iter().map(|(name, value)| KeyValue {
        key: (*name).to_owned(),
        value: Some(any(value)),
        ..KeyValue::default()
    });
    LogRecord {
        time_unix_nano: record.at.0,
        observed_time_unix_nano: record.observed.0,
        severity_number: record.severity.number().into(),
        severity_text: record.severity.text().to_owned(),
        event_name: record.definition.name.to_owned(),
        attributes: attributes.collect(),
        ..LogRecord::default()
    }
}

fn any(value: &Value) -> AnyValue {
    let text = |text: &str| Any::StringValue(text.to_owned());
    let value = match value {
        Value::Text(value) => text(value),
        Value::Number(number) => Any::IntValue(i64::try_from(*number).unwrap_or(i64::MAX)),
        Value::Real(real) => Any::DoubleValue(*real),
        Value::List(list) => Any::ArrayValue(ArrayValue {
            values: list
                .iter()
                .map(|value| AnyValue {
                    value: Some(text(value)),
                })
                .collect(),
        }),
    };
    AnyValue { value: Some(value) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::events::AgentEvent;

    #[test]
    fn a_record_says_what_the_event_says_with_its_types() {
        let log = EventLog::new();
        log.record(AgentEvent::Dropped {
            what: "packets",
            count: 7,
        });
        let record = log.read(0, 1).records.remove(0);
        let sent = log_record(&record);
        assert_eq!(sent.event_name, "ros2probe.capture.dropped");
        assert_eq!((sent.severity_number, &*sent.severity_text), (17, "ERROR"));
        assert_eq!(sent.time_unix_nano, record.at.0);
        assert!(sent.observed_time_unix_nano >= sent.time_unix_nano);
        let values: Vec<_> = sent
            .attributes
            .into_iter()
            .map(|attribute| (attribute.key, attribute.value.and_then(|any| any.value)))
            .collect();
        let text = Any::StringValue("packets".to_owned());
        assert_eq!(
            values,
            [
                ("what".to_owned(), Some(text)),
                ("count".to_owned(), Some(Any::IntValue(7)))
            ]
        );
    }

    #[test]
    fn a_request_holds_all_records_under_one_resource() {
        let log = EventLog::new();
        for watches in 0..3 {
            log.record(AgentEvent::Reloaded { watches });
        }
        let records = log.read(0, 10).records;
        let Request { body, items } = request(&Resource::default(), &records);
        assert_eq!(items, 3);
        let read = ExportLogsServiceRequest::decode(body).unwrap();
        let logs = &read.resource_logs[0].scope_logs[0];
        assert_eq!(logs.log_records.len(), 3);
        assert_eq!(logs.scope.as_ref().unwrap().name, "ros2probe");
    }
}
