//! Export of spans: a bounded queue that the capture thread fills without waiting, and its
//! requests.
//!
//! A message's trace and its send span have the same ids on every agent. Ids of spans of one host
//! depend on that host.

mod chains;

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use opentelemetry_proto::tonic::collector::trace::v1::ExportTraceServiceRequest;
use opentelemetry_proto::tonic::common::v1::KeyValue;
use opentelemetry_proto::tonic::common::v1::any_value::Value;
use opentelemetry_proto::tonic::resource::v1::Resource;
use opentelemetry_proto::tonic::trace::v1::span::SpanKind;
use opentelemetry_proto::tonic::trace::v1::{ResourceSpans, ScopeSpans, Span as Exported};
use prost::Message as _;
use tokio::sync::Notify;

use super::client::Request;
use super::exports::{Exports, Reason, Signal};
use super::points::{attribute, key_value, scope};
use super::signal_sender::SignalSender;
use crate::tables::WaitingSpans;
use ros2probe_model::bounded::Bounded;
use ros2probe_model::chain::spans::{ChainSpan, ChainSpans};
use ros2probe_model::identity::Identity;
use ros2probe_model::trace::{Span, SpanStage, Spans};

/// Largest number of spans in one request.
const REQUEST: usize = 512;
/// Time for which spans are collected into one request.
const GATHER: Duration = Duration::from_secs(1);
/// W3C trace flags: sampled, and a random trace id.
const FLAGS: u32 = 0b11;

/// The queue of spans between the capture thread and the exporter.
#[derive(Debug, Default)]
pub struct SpanQueue {
    waiting: Mutex<Bounded<WaitingSpans, VecDeque<QueuedSpan>>>,
    news: Notify,
}

/// A span in the queue.
#[derive(Clone, Debug)]
pub enum QueuedSpan {
    /// Of a message.
    Message(Span),
    /// Of a chain.
    Chain(ChainSpan),
}

/// The input of the queue, if traces are exported.
#[derive(Clone, Debug, Default)]
pub struct SpanSink {
    /// The queue of spans.
    pub queue: Arc<SpanQueue>,
    /// Counts spans that do not fit.
    pub exports: Arc<Exports>,
}

impl SpanSink {
    /// Queues spans if the signal is enabled.
    pub fn add(&self, messages: Spans, chains: ChainSpans) {
        let Spans { spans, lost } = messages;
        let spans = spans.into_iter().map(QueuedSpan::Message);
        let of_chains = chains.spans.into_iter().map(QueuedSpan::Chain);
        let lost = lost + chains.lost;
        let mut signals = self.exports.signals();
        if signals.any(|signal| signal == Signal::Traces) {
            let refused = self.queue.put(spans.chain(of_chains));
            self.exports
                .count_dropped(Signal::Traces, Reason::Overflow, refused + lost);
        }
    }
}

impl SpanQueue {
    /// Appends spans and returns how many did not fit.
    pub fn put(&self, spans: impl IntoIterator<Item = QueuedSpan>) -> u64 {
        let mut spans = spans.into_iter().peekable();
        if spans.peek().is_none() {
            return 0;
        }
        let mut waiting = self.waiting();
        let refused = spans.filter_map(|span| waiting.push_back(span)).count();
        drop(waiting);
        self.news.notify_one();
        refused as u64
    }

    fn take(&self) -> Vec<QueuedSpan> {
        let mut waiting = self.waiting();
        let most = waiting.len().min(REQUEST);
        waiting.drain(..most).collect()
    }

    async fn filled(&self) {
        loop {
            let news = self.news.notified();
            if !self.waiting().is_empty() {
                return;
            }
            news.await;
        }
    }

    fn waiting(&self) -> MutexGuard<'_, Bounded<WaitingSpans, VecDeque<QueuedSpan>>> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Encodes spans into requests.
pub(super) struct Tracing {
    resource: Resource,
    /// Identity of this host, for ids of its own spans.
    host: u128,
}

impl Tracing {
    pub(super) const fn new(resource: Resource, host: u128) -> Self {
        Self { resource, host }
    }

    /// Exports spans from the queue until the agent stops.
    pub(super) async fn run(self, mut sender: SignalSender, queue: &SpanQueue) {
        loop {
            let gathered = async {
                queue.filled().await;
                tokio::time::sleep(GATHER).await;
            };
            tokio::select! {
                () = gathered => {}
                () = sender.stopped() => break,
            }
            while !sender.is_stopped() {
                let spans = queue.take();
                if spans.is_empty() {
                    break;
                }
                sender.deliver(vec![self.request(&spans)], None).await;
            }
        }
        let mut last = Vec::new();
        loop {
            let spans = queue.take();
            if spans.is_empty() {
                break;
            }
            last.push(self.request(&spans));
        }
        sender.finish(last, false).await;
    }

    fn request(&self, spans: &[QueuedSpan]) -> Request {
        let exported = |span: &QueuedSpan| match span {
            QueuedSpan::Message(span) => self.exported(span),
            QueuedSpan::Chain(span) => chains::exported(span, self.host),
        };
        let request = ExportTraceServiceRequest {
            resource_spans: vec![ResourceSpans {
                resource: Some(self.resource.clone()),
                scope_spans: vec![ScopeSpans {
                    scope: Some(scope()),
                    spans: spans.iter().map(exported).collect(),
                    schema_url: String::new(),
                }],
                schema_url: String::new(),
            }],
        };
        Request {
            body: request.encode_to_vec().into(),
            items: spans.len() as u64,
        }
    }

    fn exported(&self, span: &Span) -> Exported {
        let (operation, kind) = match span.stage {
            SpanStage::Send => ("send", SpanKind::Producer),
            SpanStage::Receive => ("receive", SpanKind::Consumer),
            SpanStage::Settle(_) => ("settle", SpanKind::Client),
        };
        let message = &span.message;
        let parent = match span.stage {
            SpanStage::Send => Vec::new(),
            SpanStage::Receive | SpanStage::Settle(_) => self.id(span, SpanStage::Send),
        };
        Exported {
            trace_id: message.trace_id.to_be_bytes().to_vec(),
            span_id: self.id(span, span.stage),
            parent_span_id: parent,
            flags: FLAGS,
            name: format!("{operation} {}", message.description.topic),
            kind: kind.into(),
            start_time_unix_nano: span.begin.0,
            end_time_unix_nano: span.end.0,
            attributes: attributes(span, operation),
            ..Exported::default()
        }
    }

    /// Returns the id of the message's span at this stage.
    fn id(&self, span: &Span, stage: SpanStage) -> Vec<u8> {
        let trace_id = span.message.trace_id;
        match stage {
            SpanStage::Send => send_id(trace_id),
            // Each receiving host has its own span.
            SpanStage::Receive => id(b"receive", trace_id, &self.host.to_be_bytes()),
            SpanStage::Settle(reader) => id(b"settle", trace_id, &reader.to_bytes()),
        }
    }
}

/// Returns the id of the span of the message with this trace at its departure.
fn send_id(trace_id: u128) -> Vec<u8> {
    let mut identity = Identity::of(b"send");
    identity.add(&trace_id.to_be_bytes());
    (identity.bits() as u64).to_be_bytes().to_vec()
}

fn id(stage: &[u8], trace_id: u128, of: &[u8]) -> Vec<u8> {
    let mut identity = Identity::of(stage);
    identity.add(&trace_id.to_be_bytes());
    identity.add(of);
    (identity.bits() as u64).to_be_bytes().to_vec()
}

fn int(key: &str, value: u64) -> KeyValue {
    let value = i64::try_from(value).unwrap_or(i64::MAX);
    key_value(key, Value::IntValue(value))
}

/// Returns the attributes: OpenTelemetry's messaging conventions, and the names of the metrics'
/// labels.
fn attributes(span: &Span, operation: &str) -> Vec<KeyValue> {
    let message = &span.message;
    let (writer, number) = (message.writer, message.sequence_number);
    let client = match span.stage {
        SpanStage::Settle(reader) => reader,
        SpanStage::Send | SpanStage::Receive => writer,
    };
    let mut attributes = vec![
        attribute("messaging.system", "dds"),
        attribute("messaging.operation.name", operation),
        attribute("messaging.operation.type", operation),
        attribute("messaging.destination.name", &*message.description.topic),
        attribute("messaging.client.id", client.to_string()),
        attribute("messaging.message.id", format!("{writer}/{number}")),
        int("messaging.message.body.size", message.size.into()),
        int("domain_id", message.description.domain_id.into()),
        attribute("writer", writer.to_string()),
        int("sequence_number", number.0),
        attribute("message_type", &*message.description.message_type),
    ];
    if let Some(time) = message.source.timestamp() {
        attributes.push(int("source_timestamp_unix_nano", time.0));
    }
    let (address, port) = match span.stage {
        SpanStage::Settle(reader) => {
            attributes.push(attribute("reader", reader.to_string()));
            return attributes;
        }
        SpanStage::Send => ("network.peer.address", "network.peer.port"),
        SpanStage::Receive => ("network.local.address", "network.local.port"),
    };
    let to = message.destination.socket_address();
    attributes.push(int("fragments", message.fragments.into()));
    // Shared memory has no address.
    if !to.ip().is_unspecified() {
        attributes.push(attribute(address, to.ip().to_string()));
        attributes.push(int(port, to.port().into()));
    }
    attributes
}

#[cfg(test)]
mod tests {
    use ros2probe_wire::DomainId;
    use std::sync::Arc;

    use ros2probe_wire::{EntityId, Guid, GuidPrefix, RtpsTime, Timestamp};

    use ros2probe_wire::SequenceNumber;

    use super::*;
    use ros2probe_model::route::Destination;
    use ros2probe_model::trace::{Message, WriterDescription};

    fn span(stage: SpanStage) -> Span {
        let writer = Guid::new(GuidPrefix([1; 12]), EntityId([0, 0, 1, 3]));
        Span {
            stage,
            message: Message {
                writer,
                sequence_number: SequenceNumber(42),
                trace_id: Message::identity(writer, SequenceNumber(42)),
                description: Arc::new(WriterDescription {
                    domain_id: DomainId(5),
                    topic: "/points".into(),
                    message_type: "sensor_msgs/msg/PointCloud2".into(),
                    reliable: true,
                }),
                source: RtpsTime::default(),
                size: 7,
                fragments: 1,
                destination: Destination::default(),
            },
            begin: Timestamp(10),
            end: Timestamp(20),
        }
    }

    #[test]
    fn two_hosts_report_one_trace_in_which_each_has_its_own_part() {
        let reader = Guid::new(GuidPrefix([2; 12]), EntityId([0, 0, 1, 4]));
        let (one, two) = (
            Tracing::new(Resource::default(), 1),
            Tracing::new(Resource::default(), 2),
        );
        let sent = one.exported(&span(SpanStage::Send));
        assert_eq!(sent, two.exported(&span(SpanStage::Send)));
        assert_eq!((sent.trace_id.len(), sent.span_id.len()), (16, 8));
        assert_eq!(sent.name, "send /points");
        assert!(sent.parent_span_id.is_empty());
        let received = [&one, &two].map(|tracing| tracing.exported(&span(SpanStage::Receive)));
        let settled = one.exported(&span(SpanStage::Settle(reader)));
        let [first, second] = &received;
        for child in [first, second, &settled] {
            assert_eq!(child.trace_id, sent.trace_id);
            assert_eq!(child.parent_span_id, sent.span_id);
            assert_ne!(child.span_id, sent.span_id);
        }
        assert_ne!(first.span_id, second.span_id);
        assert_ne!(first.span_id, settled.span_id);
        assert_eq!(settled, two.exported(&span(SpanStage::Settle(reader))));
    }

    #[tokio::test]
    async fn the_queue_holds_so_many_and_says_how_many_it_refused() {
        let queue = SpanQueue::default();
        let spans = |count| vec![QueuedSpan::Message(span(SpanStage::Send)); count];
        assert_eq!(queue.put(Vec::new()), 0);
        assert_eq!(queue.put(spans(WaitingSpans::CAP - 1)), 0);
        assert_eq!(queue.put(spans(3)), 2);
        queue.filled().await;
        let mut taken = 0;
        while let more @ 1.. = queue.take().len() {
            assert!(more <= REQUEST);
            taken += more;
        }
        assert_eq!(taken, WaitingSpans::CAP);
        crate::tables::tests::assert_driven::<WaitingSpans>();
    }
}
