//! Messages as this crate reads them, in the text form of both decoders.

use ros2probe_wire::WireError;
use ros2probe_wire::zenoh::{
    Batch, Bytes, Common, Declaration, Encoding, HlcTimestamp, Mapping, Message, NetworkMessage,
    NextSequenceNumbers, Oam, ResponseBody, Sample, SourceInfo, WireExpr,
};

/// Reads a batch.
pub fn read(batch: &[u8]) -> Result<Vec<String>, WireError> {
    let mut all = Vec::new();
    let mut messages = Batch::whole(batch);
    for message in messages.by_ref() {
        all.push(transport(message?));
    }
    assert_eq!(messages.offset(), batch.len());
    Ok(all)
}

fn transport(message: Message<'_>) -> String {
    match message {
        Message::Oam(oam) => format!("transport {}", self::oam(&oam)),
        Message::Init(init) => format!(
            "INIT {:?}",
            (
                (init.is_ack, init.version, init.whatami.to_string()),
                (init.zid.to_string(), init.resolution.0, init.batch_size),
                init.cookie,
                (init.features.qos, init.features.auth),
                (init.features.multi_link, init.features.low_latency),
                // Zenoh keeps 8 bits of the patch level.
                (init.features.compression, init.patch & 0xff),
                init.region.map(whole),
            )
        ),
        Message::Open(open) => format!(
            "OPEN {:?}",
            (open.is_ack, open.lease, open.initial_sequence_number)
        ),
        Message::Close(close) => format!("CLOSE {:?}", (close.is_session, close.reason)),
        Message::KeepAlive => "KEEP_ALIVE".to_owned(),
        Message::Frame(frame) => format!(
            "FRAME {:?}",
            (
                frame.lane.is_reliable,
                frame.sequence_number,
                frame.lane.priority.0
            )
        ),
        Message::Network(message) => network(&message),
        Message::Fragment(fragment) => format!(
            "FRAGMENT {:?}",
            (
                (fragment.lane.is_reliable, fragment.lane.priority.0),
                (fragment.sequence_number, fragment.has_more),
                (fragment.is_first, fragment.is_dropped),
                whole(fragment.bytes),
            )
        ),
        Message::Join(join) => format!(
            "JOIN {:?}",
            (
                (join.version, join.whatami.to_string()),
                (join.zid.to_string(), join.resolution.0, join.batch_size),
                (join.lease, numbers(join.next)),
                join.next_by_priority.map(|all| all.map(numbers)),
                join.patch & 0xff,
            )
        ),
    }
}

fn network(message: &NetworkMessage<'_>) -> String {
    match message {
        NetworkMessage::Push(push) => format!(
            "PUSH {:?}",
            (key(push.key), common(push.common), sample(&push.sample))
        ),
        NetworkMessage::Declare(declare) => format!(
            "DECLARE {:?}",
            (
                declare.interest,
                common(declare.common),
                declaration(declare.declaration)
            )
        ),
        NetworkMessage::Request(request) => format!(
            "REQUEST {:?}",
            (
                (request.id, key(request.key), common(request.common)),
                (request.target, request.timeout),
                // Zenoh keeps 32 bits, and treats zero as no budget.
                request
                    .budget
                    .map(|budget| budget & u64::from(u32::MAX))
                    .filter(|budget| *budget > 0),
                (
                    consolidation(request.query.consolidation),
                    request.query.parameters,
                    request.query.source.map(source),
                    request
                        .query
                        .body
                        .map(|(encoding, bytes)| (self::encoding(encoding), whole(bytes))),
                    request.query.attachment.map(whole),
                )
            )
        ),
        NetworkMessage::Response(response) => format!(
            "RESPONSE {:?}",
            (
                (response.id, key(response.key), common(response.common)),
                response
                    .responder
                    .map(|id| (id.session.to_string(), id.entity)),
                match response.body {
                    ResponseBody::Reply {
                        consolidation: mode,
                        sample: body,
                    } => format!("REPLY {} {}", consolidation(mode), sample(&body)),
                    ResponseBody::Error {
                        encoding: kind,
                        source: from,
                        payload,
                    } => format!(
                        "ERR {:?}",
                        (encoding(kind), from.map(source), whole(payload))
                    ),
                }
            )
        ),
        NetworkMessage::ResponseFinal(last) => {
            format!("RESPONSE_FINAL {:?}", (last.id, common(last.common)))
        }
        NetworkMessage::Interest(interest) => format!(
            "INTEREST {:?}",
            (
                (interest.id, interest.is_current, interest.is_future),
                // The bits 0x20 and 0x40 are the flags N and M of the key.
                interest.options & 0x9f,
                interest.key.map(key),
                common(interest.common),
            )
        ),
        NetworkMessage::Oam(oam) => self::oam(oam),
    }
}

fn oam(oam: &Oam<'_>) -> String {
    format!("OAM {:?}", (oam.id, oam.number, oam.bytes.map(whole)))
}

fn declaration(declaration: Declaration<'_>) -> String {
    // An absent key of an undeclaration is an empty one in Zenoh.
    let optional = |expression: Option<WireExpr<'_>>| match expression {
        Some(expression) => key(expression),
        None => "Receiver 0 \"\"".to_owned(),
    };
    match declaration {
        Declaration::KeyExpr { id, key } => {
            format!("D_KEYEXPR {id} {} {:?}", key.scope, key.suffix)
        }
        Declaration::UndeclareKeyExpr { id } => format!("U_KEYEXPR {id}"),
        Declaration::Subscriber { id, key: name } => format!("D_SUBSCRIBER {id} {}", key(name)),
        Declaration::UndeclareSubscriber { id, key } => {
            format!("U_SUBSCRIBER {id} {}", optional(key))
        }
        Declaration::Queryable {
            id,
            key: name,
            is_complete,
            distance,
        } => format!("D_QUERYABLE {id} {} {is_complete} {distance}", key(name)),
        Declaration::UndeclareQueryable { id, key } => {
            format!("U_QUERYABLE {id} {}", optional(key))
        }
        Declaration::Token { id, key: name } => format!("D_TOKEN {id} {}", key(name)),
        Declaration::UndeclareToken { id, key } => format!("U_TOKEN {id} {}", optional(key)),
        Declaration::Final => "D_FINAL".to_owned(),
    }
}

fn sample(sample: &Sample<'_>) -> String {
    match sample {
        Sample::Put(put) => format!(
            "PUT {:?}",
            (
                put.timestamp.map(time),
                encoding(put.encoding),
                put.source.map(source),
                put.attachment.map(whole),
                whole(put.payload),
            )
        ),
        Sample::Del(del) => format!(
            "DEL {:?}",
            (
                del.timestamp.map(time),
                del.source.map(source),
                del.attachment.map(whole),
            )
        ),
    }
}

fn whole(bytes: Bytes<'_>) -> &[u8] {
    bytes.whole().unwrap()
}

fn key(key: WireExpr<'_>) -> String {
    let mapping = match key.mapping {
        Mapping::Sender => "Sender",
        Mapping::Receiver => "Receiver",
    };
    format!("{mapping} {} {:?}", key.scope, key.suffix)
}

fn common(common: Common) -> (u8, Option<(u64, String)>, u16) {
    (common.qos.0, common.timestamp.map(time), common.node)
}

fn time(timestamp: HlcTimestamp) -> (u64, String) {
    (timestamp.time.0, timestamp.clock.to_string())
}

fn source(source: SourceInfo) -> (String, u32, u32) {
    (
        source.publisher.session.to_string(),
        source.publisher.entity,
        source.sequence_number,
    )
}

fn encoding(encoding: Encoding<'_>) -> (u32, Option<&[u8]>) {
    // Zenoh keeps 16 bits of the id.
    (encoding.id & 0xffff, encoding.schema)
}

fn consolidation(mode: u64) -> u64 {
    if mode <= 3 { mode } else { 0 }
}

fn numbers(next: NextSequenceNumbers) -> (u32, u32) {
    (next.reliable, next.best_effort)
}
