//! Messages as Zenoh's codec writes and reads them, in the text form of both decoders.

use zenoh_buffers::buffer::SplitBuffer;
use zenoh_buffers::reader::{HasReader, Reader};
use zenoh_buffers::writer::HasWriter;
use zenoh_buffers::{ZBuf, ZSlice};
use zenoh_codec::{RCodec, WCodec, Zenoh080};
use zenoh_protocol::common::{ZExtBody, ZExtZ64};
use zenoh_protocol::core::{Encoding, Reliability, Timestamp, WireExpr, ZenohIdProto};
use zenoh_protocol::network::declare::common::ext::WireExprType;
use zenoh_protocol::network::interest::InterestMode;
use zenoh_protocol::network::{
    self, DeclareBody, Interest, Mapping, NetworkBody, NetworkMessage, NetworkMessageExt,
};
use zenoh_protocol::transport::{self, FrameHeader, PrioritySn, TransportBody, TransportMessage};
use zenoh_protocol::zenoh::query::ConsolidationMode;
use zenoh_protocol::zenoh::{PushBody, RequestBody, ResponseBody, ext};

/// A batch that Zenoh's codec accepts.
pub struct Read {
    pub messages: Vec<String>,
    pub has_timestamp_stack: bool,
}

/// Writes a transport message.
pub fn transport(message: &TransportMessage) -> Vec<u8> {
    let mut batch = Vec::new();
    Zenoh080::new().write(&mut batch.writer(), message).unwrap();
    batch
}

/// Writes a FRAME with one network message.
pub fn frame(message: &NetworkMessage) -> Vec<u8> {
    let header = FrameHeader {
        reliability: Reliability::Reliable,
        sn: 1,
        ext_qos: transport::frame::ext::QoSType::DEFAULT,
    };
    let mut batch = Vec::new();
    let mut writer = batch.writer();
    Zenoh080::new().write(&mut writer, &header).unwrap();
    Zenoh080::new()
        .write(&mut writer, message.as_ref())
        .unwrap();
    batch
}

/// Returns a random INTEREST, which is not among the random network messages.
pub fn interest() -> NetworkMessage {
    NetworkBody::Interest(Interest::rand()).into()
}

/// Reads a batch as `zenoh-transport` does; `None` if any message is malformed.
pub fn read(batch: &[u8]) -> Option<Read> {
    let mut reader = batch.reader();
    let mut read = Read {
        messages: Vec::new(),
        has_timestamp_stack: false,
    };
    while reader.can_read() {
        let message: TransportMessage = Zenoh080::new().read(&mut reader).ok()?;
        read.transport(&message.body);
    }
    Some(read)
}

impl Read {
    fn transport(&mut self, body: &TransportBody) {
        let text = match body {
            TransportBody::OAM(oam) => format!("transport {}", self::oam(oam.id, &oam.body)),
            TransportBody::InitSyn(init) => format!(
                "INIT {:?}",
                (
                    (false, init.version, init.whatami.to_string()),
                    (id(&init.zid), init.resolution.as_u8(), init.batch_size),
                    [0_u8; 0],
                    (
                        init.ext_qos.is_some() || init.ext_qos_link.is_some(),
                        init.ext_auth.is_some()
                    ),
                    (init.ext_mlink.is_some(), init.ext_lowlatency.is_some()),
                    (
                        init.ext_compression.is_some(),
                        ZExtZ64::from(init.ext_patch).value
                    ),
                    init.ext_region_name.as_ref().map(|name| bytes(&name.value)),
                )
            ),
            TransportBody::InitAck(init) => format!(
                "INIT {:?}",
                (
                    (true, init.version, init.whatami.to_string()),
                    (id(&init.zid), init.resolution.as_u8(), init.batch_size),
                    init.cookie.as_slice(),
                    (
                        init.ext_qos.is_some() || init.ext_qos_link.is_some(),
                        init.ext_auth.is_some()
                    ),
                    (init.ext_mlink.is_some(), init.ext_lowlatency.is_some()),
                    (
                        init.ext_compression.is_some(),
                        ZExtZ64::from(init.ext_patch).value
                    ),
                    init.ext_region_name.as_ref().map(|name| bytes(&name.value)),
                )
            ),
            TransportBody::OpenSyn(open) => {
                format!("OPEN {:?}", (false, open.lease, open.initial_sn))
            }
            TransportBody::OpenAck(open) => {
                format!("OPEN {:?}", (true, open.lease, open.initial_sn))
            }
            TransportBody::Close(close) => format!("CLOSE {:?}", (close.session, close.reason)),
            TransportBody::KeepAlive(_) => "KEEP_ALIVE".to_owned(),
            TransportBody::Frame(frame) => {
                let qos: ZExtZ64<{ transport::frame::ext::QoS::ID }> = frame.ext_qos.into();
                self.messages.push(format!(
                    "FRAME {:?}",
                    (
                        frame.reliability == Reliability::Reliable,
                        frame.sn,
                        qos.value & 7
                    )
                ));
                for message in &frame.payload {
                    let text = self.network(&message.body);
                    self.messages.push(text);
                }
                return;
            }
            TransportBody::Fragment(fragment) => {
                let qos: ZExtZ64<{ transport::fragment::ext::QoS::ID }> = fragment.ext_qos.into();
                format!(
                    "FRAGMENT {:?}",
                    (
                        (fragment.reliability == Reliability::Reliable, qos.value & 7),
                        (fragment.sn, fragment.more),
                        (fragment.ext_first.is_some(), fragment.ext_drop.is_some()),
                        fragment.payload.as_slice(),
                    )
                )
            }
            TransportBody::Join(join) => format!(
                "JOIN {:?}",
                (
                    (join.version, join.whatami.to_string()),
                    (id(&join.zid), join.resolution.as_u8(), join.batch_size),
                    (join.lease, numbers(&join.next_sn)),
                    join.ext_qos.as_ref().map(|all| all.each_ref().map(numbers)),
                    ZExtZ64::from(join.ext_patch).value,
                )
            ),
        };
        self.messages.push(text);
    }

    fn network(&mut self, body: &NetworkBody) -> String {
        match body {
            NetworkBody::Push(push) => {
                self.has_timestamp_stack |= push.ext_ts_stack.is_some();
                format!(
                    "PUSH {:?}",
                    (
                        key(&push.wire_expr),
                        common(
                            push.ext_qos,
                            push.ext_tstamp.as_ref(),
                            push.ext_nodeid.node_id
                        ),
                        sample(&push.payload)
                    )
                )
            }
            NetworkBody::Declare(declare) => format!(
                "DECLARE {:?}",
                (
                    declare.interest_id,
                    common(
                        declare.ext_qos,
                        declare.ext_tstamp.as_ref(),
                        declare.ext_nodeid.node_id
                    ),
                    declaration(&declare.body)
                )
            ),
            NetworkBody::Request(request) => {
                self.has_timestamp_stack |= request.ext_ts_stack.is_some();
                let RequestBody::Query(query) = &request.payload;
                format!(
                    "REQUEST {:?}",
                    (
                        (
                            request.id,
                            key(&request.wire_expr),
                            common(
                                request.ext_qos,
                                request.ext_tstamp.as_ref(),
                                request.ext_nodeid.node_id
                            )
                        ),
                        (
                            request.ext_target as u8,
                            request.ext_timeout.map(|timeout| timeout.as_millis())
                        ),
                        request.ext_budget,
                        (
                            consolidation(query.consolidation),
                            &query.parameters,
                            query.ext_sinfo.as_ref().map(source),
                            query
                                .ext_body
                                .as_ref()
                                .map(|body| (encoding(&body.encoding), bytes(&body.payload))),
                            query
                                .ext_attachment
                                .as_ref()
                                .map(|attachment| bytes(&attachment.buffer)),
                        )
                    )
                )
            }
            NetworkBody::Response(response) => {
                self.has_timestamp_stack |= response.ext_ts_stack.is_some();
                format!(
                    "RESPONSE {:?}",
                    (
                        (
                            response.rid,
                            key(&response.wire_expr),
                            common(response.ext_qos, response.ext_tstamp.as_ref(), 0)
                        ),
                        response
                            .ext_respid
                            .as_ref()
                            .map(|responder| (id(&responder.zid), responder.eid)),
                        match &response.payload {
                            ResponseBody::Reply(reply) => format!(
                                "REPLY {} {}",
                                consolidation(reply.consolidation),
                                sample(&reply.payload)
                            ),
                            ResponseBody::Err(error) => format!(
                                "ERR {:?}",
                                (
                                    encoding(&error.encoding),
                                    error.ext_sinfo.as_ref().map(source),
                                    bytes(&error.payload)
                                )
                            ),
                        }
                    )
                )
            }
            NetworkBody::ResponseFinal(last) => format!(
                "RESPONSE_FINAL {:?}",
                (last.rid, common(last.ext_qos, last.ext_tstamp.as_ref(), 0))
            ),
            NetworkBody::Interest(interest) => {
                let options = interest.options;
                let bits = [
                    options.keyexprs(),
                    options.subscribers(),
                    options.queryables(),
                    options.tokens(),
                    options.restricted(),
                    false,
                    false,
                    options.aggregate(),
                ];
                let options = bits
                    .iter()
                    .rev()
                    .fold(0_u8, |all, bit| all << 1 | u8::from(*bit));
                format!(
                    "INTEREST {:?}",
                    (
                        (
                            interest.id,
                            matches!(
                                interest.mode,
                                InterestMode::Current | InterestMode::CurrentFuture
                            ),
                            matches!(
                                interest.mode,
                                InterestMode::Future | InterestMode::CurrentFuture
                            )
                        ),
                        options,
                        interest.wire_expr.as_ref().map(key),
                        common(
                            interest.ext_qos,
                            interest.ext_tstamp.as_ref(),
                            interest.ext_nodeid.node_id
                        ),
                    )
                )
            }
            NetworkBody::OAM(oam) => self::oam(oam.id, &oam.body),
        }
    }
}

fn oam(id: u16, body: &ZExtBody) -> String {
    let (number, bytes) = match body {
        ZExtBody::Unit => (None, None),
        ZExtBody::Z64(number) => (Some(*number), None),
        ZExtBody::ZBuf(value) => (None, Some(bytes(value))),
    };
    format!("OAM {:?}", (id, number, bytes))
}

fn declaration(body: &DeclareBody) -> String {
    let undeclared = |expression: &WireExprType| key(&expression.wire_expr);
    match body {
        DeclareBody::DeclareKeyExpr(declared) => format!(
            "D_KEYEXPR {} {} {:?}",
            declared.id, declared.wire_expr.scope, declared.wire_expr.suffix
        ),
        DeclareBody::UndeclareKeyExpr(gone) => format!("U_KEYEXPR {}", gone.id),
        DeclareBody::DeclareSubscriber(declared) => {
            format!("D_SUBSCRIBER {} {}", declared.id, key(&declared.wire_expr))
        }
        DeclareBody::UndeclareSubscriber(gone) => {
            format!(
                "U_SUBSCRIBER {} {}",
                gone.id,
                undeclared(&gone.ext_wire_expr)
            )
        }
        DeclareBody::DeclareQueryable(declared) => format!(
            "D_QUERYABLE {} {} {} {}",
            declared.id,
            key(&declared.wire_expr),
            declared.ext_info.complete,
            declared.ext_info.distance
        ),
        DeclareBody::UndeclareQueryable(gone) => {
            format!(
                "U_QUERYABLE {} {}",
                gone.id,
                undeclared(&gone.ext_wire_expr)
            )
        }
        DeclareBody::DeclareToken(declared) => {
            format!("D_TOKEN {} {}", declared.id, key(&declared.wire_expr))
        }
        DeclareBody::UndeclareToken(gone) => {
            format!("U_TOKEN {} {}", gone.id, undeclared(&gone.ext_wire_expr))
        }
        DeclareBody::DeclareFinal(_) => "D_FINAL".to_owned(),
    }
}

fn sample(body: &PushBody) -> String {
    match body {
        PushBody::Put(put) => format!(
            "PUT {:?}",
            (
                put.timestamp.as_ref().map(time),
                encoding(&put.encoding),
                put.ext_sinfo.as_ref().map(source),
                put.ext_attachment
                    .as_ref()
                    .map(|attachment| bytes(&attachment.buffer)),
                bytes(&put.payload),
            )
        ),
        PushBody::Del(del) => format!(
            "DEL {:?}",
            (
                del.timestamp.as_ref().map(time),
                del.ext_sinfo.as_ref().map(source),
                del.ext_attachment
                    .as_ref()
                    .map(|attachment| bytes(&attachment.buffer)),
            )
        ),
    }
}

fn bytes(value: &ZBuf) -> Vec<u8> {
    value.contiguous().into_owned()
}

fn key(expression: &WireExpr<'_>) -> String {
    let mapping = match expression.mapping {
        Mapping::Sender => "Sender",
        Mapping::Receiver => "Receiver",
    };
    format!("{mapping} {} {:?}", expression.scope, expression.suffix)
}

fn common<const QOS: u8, const TIMESTAMP: u8>(
    qos: network::ext::QoSType<QOS>,
    timestamp: Option<&network::ext::TimestampType<TIMESTAMP>>,
    node: u16,
) -> (u64, Option<(u64, String)>, u16) {
    let qos: ZExtZ64<QOS> = qos.into();
    let timestamp = timestamp.map(|extension| time(&extension.timestamp));
    (qos.value, timestamp, node)
}

fn id(zid: &ZenohIdProto) -> String {
    zid.to_string()
}

fn source<const ID: u8>(source: &ext::SourceInfoType<ID>) -> (String, u32, u32) {
    (id(&source.id.zid), source.id.eid, source.sn)
}

fn encoding(encoding: &Encoding) -> (u16, Option<&[u8]>) {
    (encoding.id, encoding.schema.as_ref().map(ZSlice::as_slice))
}

fn consolidation(mode: ConsolidationMode) -> u64 {
    match mode {
        ConsolidationMode::Auto => 0,
        ConsolidationMode::None => 1,
        ConsolidationMode::Monotonic => 2,
        ConsolidationMode::Latest => 3,
    }
}

fn numbers(next: &PrioritySn) -> (u32, u32) {
    (next.reliable, next.best_effort)
}

fn time(timestamp: &Timestamp) -> (u64, String) {
    let clock = u128::from_le_bytes(timestamp.get_id().to_le_bytes());
    (timestamp.get_time().as_u64(), format!("{clock:x}"))
}
