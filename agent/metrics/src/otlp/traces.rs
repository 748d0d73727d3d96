//! Export of spans: a bounded queue that the capture thread fills without waiting, and its
//! batches.
//!
//! A message's trace and its send span have the same ids on every agent. Ids of spans of one host
//! depend on that host.

mod chains;
mod late_calls;

use std::sync::Arc;
use std::time::Duration;

use opentelemetry::trace::{
    SpanContext, SpanId, SpanKind, Status, TraceFlags, TraceId, TraceState,
};
use opentelemetry::{InstrumentationScope, KeyValue, StringValue};
use opentelemetry_otlp::SpanExporter;
use opentelemetry_proto::tonic::collector::trace::v1::ExportTraceServiceRequest;
use opentelemetry_proto::transform::common::tonic::ResourceAttributesWithSchema;
use opentelemetry_proto::transform::trace::tonic::group_spans_by_resource_and_scope;
use opentelemetry_sdk::error::OTelSdkResult;
use opentelemetry_sdk::trace::{SpanData, SpanEvents, SpanExporter as _, SpanLinks};
use prost::Message as _;
use ros2probe_wire::Timestamp;

use self::late_calls::LateSpan;
use super::delivery::{Export, Persist, Queue};
use super::encoded_sender::EncodedSender;
use super::events::time;
use super::exports::{Exports, Reason, Signal};
use super::points::scope;
use super::reports;
use super::waiting::Waiting;
use crate::tables::WaitingSpans;
use ros2probe_model::derive::chain::spans::{ChainSpan, ChainSpans};
use ros2probe_model::derive::trace::{Span, SpanStage, Spans};
use ros2probe_model::facts::calls::facts::NewLateCalls;
use ros2probe_model::facts::identity::Identity;

/// Maximum number of spans in one request.
const MAX_PER_REQUEST: usize = 512;
/// Time for which spans are collected into one request.
pub(super) const BATCH_DELAY: Duration = Duration::from_secs(1);
/// W3C trace flags: sampled, and a random trace id.
const TRACE_FLAGS: u8 = 0b11;

/// The queue of spans between the capture thread and the exporter.
#[derive(Debug, Default)]
pub struct SpanQueue(Waiting<WaitingSpans, QueuedSpan>);

/// A span in the queue.
#[derive(Clone, Debug)]
enum QueuedSpan {
    /// A span of a message.
    Message(Span),
    /// A span of a chain.
    Chain(ChainSpan),
    /// A span of a late call.
    LateCall(LateSpan),
}

/// The input of the queue, if traces are exported.
#[derive(Clone, Debug, Default)]
pub struct SpanSink {
    /// The queue of spans.
    pub queue: Arc<SpanQueue>,
    /// Counts spans that do not fit.
    pub exports: Arc<Exports>,
    /// Whether late calls are exported.
    pub exports_late_calls: bool,
}

impl SpanSink {
    /// Queues spans if the signal is enabled.
    pub fn add(&self, messages: Spans, chains: ChainSpans, late: &NewLateCalls) {
        let Spans { spans, lost } = messages;
        let spans = spans.into_iter().map(QueuedSpan::Message);
        let of_chains = chains.spans.into_iter().map(QueuedSpan::Chain);
        let lost = lost + chains.lost;
        let mut signals = self.exports.signals();
        if signals.any(|signal| signal == Signal::Traces) {
            let refused = self.queue.0.put(spans.chain(of_chains));
            let refused = refused + self.add_late_calls(late);
            self.exports
                .count_dropped(Signal::Traces, Reason::Overflow, refused + lost);
        }
    }
}

impl SpanSink {
    /// Queues the spans of late calls, if they are exported. Returns the number of spans that did
    /// not fit: those of whole calls. A call that the model left out counts as one.
    fn add_late_calls(&self, late: &NewLateCalls) -> u64 {
        if !self.exports_late_calls {
            return 0;
        }
        let calls = late.calls.iter();
        let refused = calls.map(|(domain_id, example)| {
            let spans = LateSpan::of(*domain_id, example).into_iter();
            self.queue
                .0
                .add_all_or_none(spans.map(QueuedSpan::LateCall))
        });
        late.lost + refused.sum::<u64>()
    }
}

/// Exports spans.
pub(super) struct SpanExport {
    pub(super) exporter: SpanExporter,
    pub(super) resource: ResourceAttributesWithSchema,
    /// Sends requests that waited on disk.
    pub(super) encoded: EncodedSender,
}

impl Export for SpanExport {
    type Batch = Vec<SpanData>;

    fn items(batch: &Vec<SpanData>) -> u64 {
        batch.len() as u64
    }

    async fn export(&self, batch: &Vec<SpanData>) -> OTelSdkResult {
        self.exporter.export(batch.clone()).await
    }
}

impl Persist for SpanExport {
    fn encode(&self, batch: &Vec<SpanData>) -> Vec<u8> {
        let resource_spans = group_spans_by_resource_and_scope(batch.clone(), &self.resource);
        ExportTraceServiceRequest { resource_spans }.encode_to_vec()
    }

    async fn export_encoded(&self, request: &[u8]) -> OTelSdkResult {
        if !self.encoded.has_headers() {
            reports::unreported(self.exporter.export(Vec::new())).await?;
        }
        self.encoded
            .send_encoded::<ExportTraceServiceRequest>(request)
            .await
    }

    fn divided(request: &[u8], place: u64) -> Option<[Vec<u8>; 2]> {
        EncodedSender::divided::<ExportTraceServiceRequest>(request, place)
    }

    fn padded(request: &[u8]) -> Vec<u8> {
        EncodedSender::padded::<ExportTraceServiceRequest>(request)
    }
}

/// Converts spans of the queue to the SDK's form.
pub(super) struct Tracing {
    queue: Arc<SpanQueue>,
    /// Identity of this host, for ids of its own spans.
    host: u128,
    scope: InstrumentationScope,
}

impl Queue for Tracing {
    type Batch = Vec<SpanData>;

    async fn wait_filled(&self) {
        self.queue.0.wait_filled().await;
    }

    fn is_half_full(&self) -> bool {
        self.queue.0.is_half_full()
    }

    /// The sink counts spans that do not fit.
    fn take(&mut self) -> (Option<Vec<SpanData>>, u64) {
        let spans = self.queue.0.take(MAX_PER_REQUEST);
        let exported = spans.iter().map(|span| match span {
            QueuedSpan::Message(span) => self.of_message(span),
            QueuedSpan::Chain(span) => self.exported(chains::parts(span, self.host)),
            QueuedSpan::LateCall(span) => self.exported(span.parts(self.host)),
        });
        let exported: Vec<_> = exported.collect();
        ((!exported.is_empty()).then_some(exported), 0)
    }
}

/// The parts of a span that depend on its kind.
struct Parts {
    trace_id: u128,
    id: u64,
    parent: Option<u64>,
    kind: SpanKind,
    name: String,
    times: [Timestamp; 2],
    attributes: Vec<KeyValue>,
    links: SpanLinks,
}

impl Tracing {
    pub(super) fn new(host: u128, queue: Arc<SpanQueue>) -> Self {
        Self {
            queue,
            host,
            scope: scope(),
        }
    }

    fn of_message(&self, span: &Span) -> SpanData {
        let (operation, kind) = match span.stage {
            SpanStage::Send => ("send", SpanKind::Producer),
            SpanStage::Receive => ("receive", SpanKind::Consumer),
            SpanStage::Settle(_) => ("settle", SpanKind::Client),
        };
        let message = &span.message;
        self.exported(Parts {
            trace_id: message.trace_id,
            id: self.id(span, span.stage),
            parent: match span.stage {
                SpanStage::Send => None,
                SpanStage::Receive | SpanStage::Settle(_) => Some(self.id(span, SpanStage::Send)),
            },
            kind,
            name: format!("{operation} {}", message.description.topic),
            times: [span.begin, span.end],
            attributes: attributes(span, operation),
            links: SpanLinks::default(),
        })
    }

    fn exported(&self, parts: Parts) -> SpanData {
        let [begin, end] = parts.times;
        SpanData {
            span_context: context(parts.trace_id, parts.id),
            parent_span_id: parts.parent.map_or(SpanId::INVALID, SpanId::from),
            parent_span_is_remote: false,
            span_kind: parts.kind,
            name: parts.name.into(),
            start_time: time(begin),
            end_time: time(end),
            attributes: parts.attributes,
            dropped_attributes_count: 0,
            events: SpanEvents::default(),
            links: parts.links,
            status: Status::Unset,
            instrumentation_scope: self.scope.clone(),
        }
    }

    /// Returns the id of the message's span at this stage.
    fn id(&self, span: &Span, stage: SpanStage) -> u64 {
        let trace_id = span.message.trace_id;
        match stage {
            SpanStage::Send => send_id(trace_id),
            // Each receiving host has its own span.
            SpanStage::Receive => id(b"receive", trace_id, &self.host.to_be_bytes()),
            SpanStage::Settle(reader) => id(b"settle", trace_id, &reader.to_bytes()),
        }
    }
}

fn context(trace_id: u128, id: u64) -> SpanContext {
    let flags = TraceFlags::new(TRACE_FLAGS);
    let (trace_id, id) = (TraceId::from(trace_id), SpanId::from(id));
    SpanContext::new(trace_id, id, flags, false, TraceState::NONE)
}

/// Returns the id of the send span of the message with this trace.
pub(super) fn send_id(trace_id: u128) -> u64 {
    let mut identity = Identity::of(b"send");
    identity.add(&trace_id.to_be_bytes());
    identity.bits() as u64
}

fn id(stage: &[u8], trace_id: u128, of: &[u8]) -> u64 {
    let mut identity = Identity::of(stage);
    identity.add(&trace_id.to_be_bytes());
    identity.add(of);
    identity.bits() as u64
}

fn int(key: &'static str, value: u64) -> KeyValue {
    KeyValue::new(key, i64::try_from(value).unwrap_or(i64::MAX))
}

fn attribute(key: &'static str, value: impl Into<StringValue>) -> KeyValue {
    KeyValue::new(key, value.into())
}

/// Returns the attributes: OpenTelemetry's messaging conventions, and the names of the metrics'
/// labels.
fn attributes(span: &Span, operation: &'static str) -> Vec<KeyValue> {
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
        attribute(
            "messaging.destination.name",
            message.description.topic.to_string(),
        ),
        attribute("messaging.client.id", client.to_string()),
        attribute("messaging.message.id", format!("{writer}/{number}")),
        int("messaging.message.body.size", message.size.into()),
        int("domain_id", message.description.domain_id.into()),
        attribute("writer", writer.to_string()),
        int("sequence_number", number.0),
        attribute("message_type", message.description.message_type.to_string()),
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
    use ros2probe_model::derive::trace::{Message, WriterDescription};
    use ros2probe_model::facts::route::Destination;

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
    fn two_hosts_share_the_send_span_of_a_trace_and_have_own_receive_spans() {
        let reader = Guid::new(GuidPrefix([2; 12]), EntityId([0, 0, 1, 4]));
        let (one, two) = (
            Tracing::new(1, Arc::default()),
            Tracing::new(2, Arc::default()),
        );
        let sent = one.of_message(&span(SpanStage::Send));
        assert_eq!(sent, two.of_message(&span(SpanStage::Send)));
        assert_eq!(sent.span_context.trace_flags().to_u8(), TRACE_FLAGS);
        assert_eq!(sent.name, "send /points");
        assert_eq!(sent.parent_span_id, SpanId::INVALID);
        let received = [&one, &two].map(|tracing| tracing.of_message(&span(SpanStage::Receive)));
        let settled = one.of_message(&span(SpanStage::Settle(reader)));
        let [first, second] = &received;
        let id = |span: &SpanData| span.span_context.span_id();
        for child in [first, second, &settled] {
            assert_eq!(child.span_context.trace_id(), sent.span_context.trace_id());
            assert_eq!(child.parent_span_id, id(&sent));
            assert_ne!(id(child), id(&sent));
        }
        assert_ne!(id(first), id(second));
        assert_ne!(id(first), id(&settled));
        assert_eq!(settled, two.of_message(&span(SpanStage::Settle(reader))));
    }

    #[tokio::test]
    async fn the_queue_is_bounded_and_counts_refused_spans() {
        let queue = SpanQueue::default();
        let spans = |count| vec![QueuedSpan::Message(span(SpanStage::Send)); count];
        assert_eq!(queue.0.put(Vec::new()), 0);
        assert_eq!(queue.0.put(spans(WaitingSpans::CAP - 1)), 0);
        assert_eq!(queue.0.put(spans(3)), 2);
        queue.0.wait_filled().await;
        let mut taken = 0;
        while let more @ 1.. = queue.0.take(MAX_PER_REQUEST).len() {
            assert!(more <= MAX_PER_REQUEST);
            taken += more;
        }
        assert_eq!(taken, WaitingSpans::CAP);
        crate::tables::tests::assert_driven::<WaitingSpans>();
    }
}
