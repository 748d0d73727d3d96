//! Converts spans of chains from the model's form to that of the SDK.

use opentelemetry::KeyValue;
use opentelemetry::trace::{Link, SpanKind};
use opentelemetry_sdk::trace::SpanLinks;

use super::{Parts, attribute, context, int, send_id};
use ros2probe_model::derive::chain::spans::{ChainMessage, ChainSpan, ChainStage, SpanId};
use ros2probe_model::facts::identity::Identity;

/// Returns the span as it is exported by the agent of this host.
pub(super) fn parts(span: &ChainSpan, host: u128) -> Parts {
    let kind = match span.stage {
        ChainStage::Publish => SpanKind::Producer,
        ChainStage::Callback | ChainStage::Node => SpanKind::Consumer,
        ChainStage::Transit | ChainStage::Wait | ChainStage::Hop => SpanKind::Internal,
    };
    Parts {
        trace_id: span.trace_id,
        id: bits(span.id, host),
        parent: span.parent.map(|id| bits(id, host)),
        kind,
        name: format!("{} {}", span.stage.label(), span.topic),
        times: [span.begin, span.end],
        attributes: attributes(span),
        links: links(span),
    }
}

fn bits(id: SpanId, host: u128) -> u64 {
    let mut bits = id.bits;
    if id.is_of_host {
        let mut identity = Identity::of(b"span of a host");
        identity.add(&bits.to_be_bytes());
        identity.add(&host.to_be_bytes());
        bits = identity.bits() as u64;
    }
    bits
}

/// Returns the link from a publication to the message's own trace.
fn links(span: &ChainSpan) -> SpanLinks {
    let message = span.message.as_ref();
    let own_trace = message.and_then(|message| message.own_trace);
    let own_trace = own_trace.filter(|_| span.stage == ChainStage::Publish);
    let link = own_trace.map(|trace_id| Link::with_context(context(trace_id, send_id(trace_id))));
    let mut links = SpanLinks::default();
    links.links.extend(link);
    links
}

/// Returns the attributes: OpenTelemetry's messaging conventions, and the names of the metrics'
/// labels.
fn attributes(span: &ChainSpan) -> Vec<KeyValue> {
    // Calls inside processes do not show the middleware.
    let system = match span.message {
        Some(_) => "dds",
        None => "ros2",
    };
    let mut attributes = vec![
        attribute("messaging.system", system),
        attribute("messaging.operation.name", span.stage.label()),
        attribute("messaging.destination.name", span.topic.to_string()),
        int("domain_id", span.domain_id.into()),
        attribute("method", span.method.label()),
    ];
    let operation_type = match span.stage {
        ChainStage::Publish => Some("send"),
        ChainStage::Callback | ChainStage::Node => Some("process"),
        ChainStage::Transit | ChainStage::Wait | ChainStage::Hop => None,
    };
    let texts = [
        ("messaging.operation.type", operation_type),
        ("ros_node", span.node.as_deref()),
        ("output", span.output.as_deref()),
    ];
    for (key, value) in texts {
        attributes.extend(value.map(|value| attribute(key, value.to_owned())));
    }
    let Some(message) = &span.message else {
        return attributes;
    };
    let ChainMessage {
        writer,
        sequence_number,
        message_type,
        size,
        stamp: (seconds, nanoseconds),
        own_trace: _,
    } = &**message;
    if span.stage == ChainStage::Publish {
        attributes.push(attribute("messaging.client.id", writer.to_string()));
    }
    attributes.extend([
        attribute(
            "messaging.message.id",
            format!("{writer}/{sequence_number}"),
        ),
        int("messaging.message.body.size", (*size).into()),
        attribute("writer", writer.to_string()),
        int("sequence_number", sequence_number.0),
        attribute("message_type", message_type.to_string()),
        attribute("stamp", format!("{seconds}.{nanoseconds:09}")),
    ]);
    attributes
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use ros2probe_model::derive::chain::trace::Method;
    use ros2probe_wire::{DomainId, EntityId, Guid, GuidPrefix, SequenceNumber, Timestamp};

    use super::*;

    fn span(stage: ChainStage, message: Option<ChainMessage>) -> ChainSpan {
        let id = |bits, is_of_host| SpanId { bits, is_of_host };
        ChainSpan {
            stage,
            trace_id: 5,
            id: id(7, stage == ChainStage::Hop),
            parent: Some(id(6, false)),
            begin: Timestamp(10),
            end: Timestamp(20),
            domain_id: DomainId(3),
            method: Method::Stamps,
            topic: "/points".into(),
            node: Some("/filter".into()),
            output: Some("/filtered".into()),
            message: message.map(Arc::new),
        }
    }

    fn message(own_trace: Option<u128>) -> ChainMessage {
        ChainMessage {
            writer: Guid::new(GuidPrefix([1; 12]), EntityId([0, 0, 1, 3])),
            sequence_number: SequenceNumber(42),
            message_type: "sensor_msgs/msg/PointCloud2".into(),
            size: 9,
            stamp: (12, 345),
            own_trace,
        }
    }

    fn text(exported: &Parts, key: &str) -> Option<String> {
        let mut attributes = exported.attributes.iter();
        let found = attributes.find(|each| each.key.as_str() == key)?;
        Some(found.value.to_string())
    }

    #[test]
    fn the_id_of_a_hop_depends_on_the_host_and_other_ids_do_not() {
        for stage in [ChainStage::Node, ChainStage::Hop] {
            let span = span(stage, None);
            let (one, two) = (parts(&span, 1), parts(&span, 2));
            assert_eq!(one.id == two.id, stage == ChainStage::Node);
            assert_eq!(one.trace_id, two.trace_id);
            assert_eq!(one.parent, two.parent);
        }
    }

    #[test]
    fn attributes_name_the_message_the_node_and_the_method() {
        let exported = parts(&span(ChainStage::Node, Some(message(Some(9)))), 1);
        assert_eq!(exported.name, "node /points");
        for (key, value) in [
            ("messaging.system", "dds"),
            ("messaging.operation.type", "process"),
            ("messaging.message.body.size", "9"),
            ("domain_id", "3"),
            ("method", "stamps"),
            ("ros_node", "/filter"),
            ("output", "/filtered"),
            ("sequence_number", "42"),
            ("stamp", "12.000000345"),
        ] {
            assert_eq!(text(&exported, key).as_deref(), Some(value), "{key}");
        }
        assert_eq!(text(&exported, "messaging.client.id"), None);
        assert!(exported.links.is_empty(), "only a publication has a link");
    }

    #[test]
    fn a_publication_links_to_the_trace_of_its_message_if_that_is_exported() {
        let with = |own| parts(&span(ChainStage::Publish, Some(message(own))), 1);
        let [link] = &with(Some(9)).links[..] else {
            panic!("no link")
        };
        assert_eq!(link.span_context, context(9, send_id(9)));
        assert!(with(None).links.is_empty());
        let inside = parts(&span(ChainStage::Publish, None), 1);
        assert_eq!(text(&inside, "messaging.system").as_deref(), Some("ros2"));
        assert_eq!(text(&inside, "writer"), None);
    }
}
