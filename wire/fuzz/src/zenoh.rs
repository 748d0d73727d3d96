//! Fuzz target of the Zenoh decoder. The first byte of the input is the number of bytes that the
//! capture lacks.

use ros2probe_wire::Reason;
use ros2probe_wire::zenoh::{
    Attachment, Batch, Bytes, Declaration, Key, Message, NetworkMessage, ResponseBody, Sample,
    Session, Token, WireExpr,
};

/// Reads a batch, of which the capture may lack the end, with every parser.
pub fn read(bytes: &[u8]) {
    let Some((missing, batch)) = bytes.split_first() else {
        return;
    };
    let length = batch.len() + usize::from(*missing);
    let mut messages = Batch::new(batch, length);
    let mut count = 0;
    for message in messages.by_ref() {
        count += 1;
        match message {
            Ok(message) => self::message(&message, batch, length),
            Err(error) => {
                assert!(error.offset <= batch.len());
                assert!(*missing > 0 || error.reason != Reason::Truncated);
            }
        }
    }
    assert!(messages.next().is_none());
    assert!(messages.offset() <= batch.len());
    // Each message has at least one byte. In a cut batch, an error may follow the messages.
    assert!(count <= batch.len() + 1);
    if *missing > 0 {
        prefix(batch, length);
    }
    let _ = NetworkMessage::whole(batch);
    let _ = NetworkMessage::beginning(batch);
    let _ = Attachment::parse(batch);
    if let Ok(text) = str::from_utf8(batch) {
        name(text);
    }
    if let Some((first, rest)) = Batch::split(batch) {
        assert_eq!(first.len() + rest.len() + 2, batch.len());
    }
}

/// Checks that a cut batch has the same messages as the same bytes without a cut, except for the
/// last one.
fn prefix(batch: &[u8], length: usize) {
    let cut: Vec<_> = Batch::new(batch, length).map_while(Result::ok).collect();
    let whole: Vec<_> = Batch::whole(batch).map_while(Result::ok).collect();
    let common = cut.len().min(whole.len()).saturating_sub(1);
    assert_eq!(cut.get(..common), whole.get(..common));
    assert!(whole.len() <= cut.len() + 1);
}

fn message(message: &Message<'_>, batch: &[u8], length: usize) {
    let bytes = |bytes: Bytes<'_>| {
        assert!(bytes.captured.len() <= bytes.length && bytes.captured.len() <= batch.len());
        assert!(bytes.length <= length);
        let _ = bytes.whole().map(Attachment::parse);
    };
    let sample = |sample: &Sample<'_>| match sample {
        Sample::Put(put) => {
            put.attachment.map(bytes);
            // A slice in shared memory may have any length.
            if !put.is_shared {
                bytes(put.payload);
            }
        }
        Sample::Del(del) => {
            del.attachment.map(bytes);
        }
    };
    match message {
        Message::Init(init) => {
            let session = Session::agreed(init, init);
            assert_eq!(session.batch_size, init.batch_size);
            assert_eq!(session.unobservable(), session.unobservable());
            assert!(session.resolution.next(u32::MAX) <= session.resolution.sequence_number_mask());
        }
        Message::Fragment(fragment) => bytes(fragment.bytes),
        Message::Oam(oam) | Message::Network(NetworkMessage::Oam(oam)) => {
            oam.bytes.map(bytes);
        }
        Message::Network(message) => match message {
            NetworkMessage::Push(push) => {
                key(push.key);
                sample(&push.sample);
            }
            NetworkMessage::Declare(declare) => declaration(declare.declaration),
            NetworkMessage::Request(request) => {
                key(request.key);
                request.query.attachment.map(bytes);
                if let Some((_, payload)) = request.query.body {
                    bytes(payload);
                }
            }
            NetworkMessage::Response(response) => {
                key(response.key);
                match &response.body {
                    ResponseBody::Reply { sample: reply, .. } => sample(reply),
                    ResponseBody::Error { .. } => {}
                }
            }
            NetworkMessage::Interest(interest) => {
                interest.key.map(key);
            }
            NetworkMessage::ResponseFinal(_) | NetworkMessage::Oam(_) => {}
        },
        _ => {}
    }
}

fn declaration(declaration: Declaration<'_>) {
    match declaration {
        Declaration::KeyExpr { key: name, .. }
        | Declaration::Subscriber { key: name, .. }
        | Declaration::Queryable { key: name, .. }
        | Declaration::Token { key: name, .. } => key(name),
        Declaration::UndeclareSubscriber { key: name, .. }
        | Declaration::UndeclareQueryable { key: name, .. }
        | Declaration::UndeclareToken { key: name, .. } => {
            name.map(key);
        }
        Declaration::UndeclareKeyExpr { .. } | Declaration::Final => {}
    }
}

fn key(expression: WireExpr<'_>) {
    name(expression.suffix);
}

fn name(text: &str) {
    if let Ok(Key::Topic(topic)) = Key::parse(text) {
        assert!(topic.name.as_str().starts_with('/'));
        let _ = (topic.ros_type(), topic.is_service(), topic.name.action());
    }
    if let Ok(Token::Endpoint(endpoint)) = Token::parse(text) {
        assert!(endpoint.node.full_name().starts_with('/'));
        let _ = endpoint.ros_type();
    }
}
