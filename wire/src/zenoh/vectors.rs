//! Captured batches of a router and two peers (eclipse-zenoh 1.10.2 with rmw_zenoh's
//! configuration). Cookies, and the key and payload of the reply, are replaced by other bytes of
//! the same length.

use std::string::ToString;
use std::time::Duration;
use std::vec;
use std::vec::Vec;

use super::*;
use crate::{Reason, SequenceNumber};

const INIT_SYN: &str = "c109f1e87383f70ea9bdcb552cc62c63a10cd10ac8ff812701";
const INIT_ACK: &str = "e109f01c97340b5e72da4e0cde924bdf41c3e40a00c031";
const OPEN_SYN: &str = "420adaec8a3c31";
const OPEN_ACK: &str = "620ad3a2ec5f";
const D_SUB: &str = "a5e9bde92e31009e2108420302";
const PUSH: &str = "25daec8a3c1d03a1b094c0afbb8ec0806b10e87383f70ea9bdcb552cc62c63a10cd143210400000000\
                    0000000036e4ba23eee91810000102030405060708090a0b0c0d0e0f14000100000c00000068656c6c\
                    6f20776f726c6400";
const REQUEST: &str = "25d3a2ec5f9c0104a10db40226904ea303c30800000100007265714521020000000000000000\
                       36e4ba23eee91810000102030405060708090a0b0c0d0e0f";
const U_TOKEN: &str = "a5dcec8a3c31009e210887015f020000";

fn bytes(hexadecimal: &str) -> Vec<u8> {
    let digit = |c: u8| u8::try_from(char::from(c).to_digit(16).unwrap()).unwrap();
    hexadecimal
        .as_bytes()
        .chunks(2)
        .map(|pair| digit(pair[0]) << 4 | digit(pair[1]))
        .collect()
}

fn read(batch: &[u8]) -> Vec<Message<'_>> {
    Batch::whole(batch).collect::<Result<_, _>>().unwrap()
}

/// Returns all batches, each of them whole.
fn all() -> Vec<Vec<u8>> {
    let cookie = [7; 49];
    let plain = [D_SUB, PUSH, REQUEST, U_TOKEN, INIT_SYN, OPEN_ACK, "04"];
    let mut all: Vec<Vec<u8>> = plain.into_iter().map(bytes).collect();
    all.push([&bytes(INIT_ACK)[..], &cookie, &[0x81, 0x27, 0x01]].concat());
    all.push([&bytes(OPEN_SYN)[..], &cookie].concat());
    all.push(response());
    all
}

fn attachment() -> Vec<u8> {
    let mut bytes = vec![2, 0, 0, 0, 0, 0, 0, 0];
    bytes.extend([0x00, 0x36, 0xe4, 0xba, 0x23, 0xee, 0xe9, 0x18, 0x10]);
    bytes.extend(0..16);
    bytes
}

fn response() -> Vec<u8> {
    let mut batch = bytes("25e5ec8a3cfb010043");
    batch.extend([b'k'; 67]);
    // QoS, then the responder: a session of one byte and entity 3.
    batch.extend(bytes("a10d4303000503048143"));
    batch.push(0x21);
    batch.extend(attachment());
    batch.push(9);
    batch.extend([0, 1, 0, 0, 1, 2, 3, 4, 5]);
    batch.extend(bytes("9a01210d"));
    batch
}

#[test]
fn two_init_messages_establish_a_session() {
    let syn = bytes(INIT_SYN);
    let [Message::Init(syn)] = read(&syn)[..] else {
        panic!("no INIT");
    };
    assert!(!syn.is_ack && syn.cookie.is_empty());
    assert_eq!((syn.version, syn.whatami), (VERSION, WhatAmI::Peer));
    assert_eq!(syn.zid.to_string(), "d10ca1632cc62c55cbbda90ef78373e8");
    assert_eq!((syn.resolution, syn.batch_size), (Resolution(0x0a), 65480));
    assert!(syn.features.qos && syn.patch == 1);

    let ack = &all()[7];
    let [Message::Init(ack)] = read(ack)[..] else {
        panic!("no INIT");
    };
    assert!(ack.is_ack);
    assert_eq!((ack.batch_size, ack.cookie.len()), (49152, 0x31));

    let mut session = Session::agreed(&syn, &ack);
    assert_eq!((session.batch_size, session.patch), (49152, 1));
    assert_eq!(session.acceptor.whatami.to_string(), "router");
    assert_eq!(session.resolution.sequence_number_mask(), 0x0fff_ffff);
    assert_eq!(session.resolution.next(0x0fff_ffff), 0);
    assert_eq!(session.unobservable(), None);
    session.features.compression = true;
    assert_eq!(session.unobservable(), Some(Unobservable::Compression));
    session.features.low_latency = true;
    assert_eq!(session.unobservable(), Some(Unobservable::LowLatency));
    session.version = 8;
    let why = session.unobservable().unwrap();
    assert_eq!(why.to_string(), "unsupported Zenoh version 8");
}

#[test]
fn each_side_opens_with_its_sequence_number() {
    let [Message::Open(syn)] = read(&all()[8])[..] else {
        panic!("no OPEN");
    };
    assert!(!syn.is_ack);
    assert_eq!(syn.lease, Duration::from_secs(10));
    assert_eq!(syn.initial_sequence_number, 126_006_874);
    let [Message::Open(ack)] = read(&all()[5])[..] else {
        panic!("no OPEN");
    };
    assert!(ack.is_ack);
    assert_eq!(ack.initial_sequence_number, 201_003_347);
    assert_eq!(read(&[4]), [Message::KeepAlive]);
}

#[test]
fn a_subscriber_is_declared_on_the_control_lane() {
    let batch = bytes(D_SUB);
    let [
        Message::Frame(frame),
        Message::Network(NetworkMessage::Declare(declare)),
    ] = read(&batch)[..]
    else {
        panic!("no DECLARE");
    };
    assert!(frame.lane.is_reliable);
    assert_eq!(frame.lane.priority, Priority::CONTROL);
    assert!(declare.common.qos.is_blocking());
    let Declaration::Subscriber { id, key } = declare.declaration else {
        panic!("no subscriber");
    };
    assert_eq!((id, key.scope, key.mapping), (3, 2, Mapping::Sender));
    assert_eq!(key.key(), None);
}

#[test]
fn a_publication_yields_its_attachment_and_payload() {
    let batch = bytes(PUSH);
    let [
        Message::Frame(frame),
        Message::Network(NetworkMessage::Push(push)),
    ] = read(&batch)[..]
    else {
        panic!("no PUSH");
    };
    assert_eq!(frame.sequence_number, 126_006_874);
    assert_eq!(frame.lane.priority, Priority::DATA);
    assert_eq!((push.key.scope, push.key.mapping), (3, Mapping::Receiver));
    let Sample::Put(put) = push.sample else {
        panic!("no PUT");
    };
    let timestamp = put.timestamp.unwrap();
    assert_eq!(
        timestamp.clock.to_string(),
        "d10ca1632cc62c55cbbda90ef78373e8"
    );
    let attachment = Attachment::parse(put.attachment.unwrap().whole().unwrap()).unwrap();
    assert_eq!(attachment.sequence_number, SequenceNumber(4));
    // Both clocks were read at about the same time.
    let source = attachment.source_timestamp.unwrap();
    let distance = source.distance(timestamp.timestamp().unwrap());
    assert!(distance < Duration::from_secs(1), "{distance:?}");
    let payload = put.payload.whole().unwrap();
    assert_eq!(&payload[8..], b"hello world\0");
}

#[test]
fn a_request_and_its_reply_have_the_same_number() {
    let batch = bytes(REQUEST);
    let [_, Message::Network(NetworkMessage::Request(request))] = read(&batch)[..] else {
        panic!("no REQUEST");
    };
    assert_eq!((request.id, request.key.scope), (1, 4));
    assert_eq!(request.key.mapping, Mapping::Receiver);
    assert_eq!(request.common.qos, MessageQos(13));
    assert_eq!((request.target, request.timeout), (2, Some(10_000)));
    assert_eq!(request.query.consolidation, 3);
    let (encoding, payload) = request.query.body.unwrap();
    assert_eq!((encoding, payload.length), (Encoding::default(), 7));
    let attached = Attachment::parse(request.query.attachment.unwrap().captured).unwrap();
    assert_eq!(attached.sequence_number, SequenceNumber(2));

    let batch = response();
    let [
        _,
        Message::Network(NetworkMessage::Response(response)),
        Message::Network(NetworkMessage::ResponseFinal(last)),
    ] = read(&batch)[..]
    else {
        panic!("no RESPONSE");
    };
    assert_eq!((response.id, last.id), (1, 1));
    assert_eq!(response.key.key(), Some(&"k".repeat(67)[..]));
    assert_eq!(response.responder.unwrap().entity, 3);
    let ResponseBody::Reply {
        sample: Sample::Put(put),
        ..
    } = response.body
    else {
        panic!("no reply");
    };
    assert_eq!(put.payload.length, 9);
    assert_eq!(
        Attachment::parse(put.attachment.unwrap().captured),
        Ok(attached)
    );
}

#[test]
fn a_token_is_undeclared_without_its_key() {
    let batch = bytes(U_TOKEN);
    let [_, Message::Network(NetworkMessage::Declare(declare))] = read(&batch)[..] else {
        panic!("no DECLARE");
    };
    let Declaration::UndeclareToken { id, key: Some(key) } = declare.declaration else {
        panic!("no token");
    };
    assert_eq!((id, key.scope, key.suffix), (1, 0, ""));
    assert_eq!(key.mapping, Mapping::Receiver);
}

#[test]
fn a_cut_capture_yields_its_complete_messages() {
    let batch = bytes(PUSH);
    // Length of the batch before the payload.
    let head = batch.len() - 20;
    for captured in 0..batch.len() {
        let messages: Vec<_> = Batch::new(&batch[..captured], batch.len()).collect();
        let whole: Vec<_> = messages.iter().filter_map(|m| m.as_ref().ok()).collect();
        if captured < head {
            let error = messages.last().unwrap().unwrap_err();
            assert_eq!(error.reason, Reason::Truncated, "{captured}");
            continue;
        }
        let [_, Message::Network(NetworkMessage::Push(push))] = whole[..] else {
            panic!("no PUSH of {captured} bytes");
        };
        let Sample::Put(put) = push.sample else {
            panic!("no PUT");
        };
        assert_eq!(
            (put.payload.length, put.payload.captured.len()),
            (20, captured - head)
        );
        assert!(put.attachment.unwrap().whole().is_some());
        assert_eq!(whole.len(), messages.len());
    }
}

#[test]
fn a_cut_request_keeps_its_number_and_size() {
    let batch = bytes(REQUEST);
    let captured = batch.len() - 36;
    let messages: Vec<_> = Batch::new(&batch[..captured], batch.len()).collect();
    let [
        _,
        Ok(Message::Network(NetworkMessage::Request(request))),
        Err(error),
    ] = messages[..]
    else {
        panic!("{messages:?}");
    };
    assert_eq!(error.reason, Reason::Truncated);
    assert!(request.query.is_cut && request.query.attachment.is_none());
    assert_eq!(request.query.body.unwrap().1.length, 7);
}

#[test]
fn a_batch_that_ends_early_is_malformed_and_not_truncated() {
    for batch in all() {
        read(&batch);
        for length in 1..batch.len() {
            for message in Batch::whole(&batch[..length]) {
                if let Err(error) = message {
                    assert_ne!(error.reason, Reason::Truncated);
                }
            }
        }
    }
}

#[test]
fn no_changed_byte_makes_the_decoder_panic() {
    for batch in all() {
        for position in 0..batch.len() {
            for changed in 0..=255 {
                let mut batch = batch.clone();
                batch[position] = changed;
                let mut messages = Batch::whole(&batch);
                let count = messages.by_ref().count();
                assert!(count <= batch.len() && messages.offset() <= batch.len());
            }
        }
    }
}

#[test]
fn a_frame_ends_at_a_transport_message() {
    let mut batch = bytes(D_SUB);
    batch.push(0x04);
    assert!(matches!(
        read(&batch)[..],
        [Message::Frame(_), Message::Network(_), Message::KeepAlive]
    ));
    // A network message needs a FRAME before it.
    batch.push(0x1d);
    assert!(Batch::whole(&batch).last().unwrap().is_err());
}

#[test]
fn fragments_are_joined_into_one_message() {
    let push = &bytes(PUSH)[5..];
    let first = [&[0x66, 0x05][..], &push[..70]].concat();
    let last = [&[0x26, 0x06][..], &push[70..]].concat();
    let mut whole = Vec::new();
    for (batch, has_more) in [(&first, true), (&last, false)] {
        let [Message::Fragment(fragment)] = read(batch)[..] else {
            panic!("no FRAGMENT");
        };
        assert_eq!(fragment.has_more, has_more);
        whole.extend(fragment.bytes.whole().unwrap());
    }
    let Ok(NetworkMessage::Push(begun)) = NetworkMessage::beginning(&push[..70]) else {
        panic!("no PUSH");
    };
    let Ok(NetworkMessage::Push(push)) = NetworkMessage::whole(&whole) else {
        panic!("no PUSH");
    };
    assert_eq!(begun.key, push.key);
    whole.push(0);
    assert_eq!(
        NetworkMessage::whole(&whole).unwrap_err().reason,
        Reason::BadLength
    );
}

#[test]
fn a_stream_is_split_at_its_length_prefixes() {
    let stream = [2, 0, 4, 4, 1, 0, 4, 9];
    let (batch, rest) = Batch::split(&stream).unwrap();
    assert_eq!((batch, rest), (&[4, 4][..], &[1, 0, 4, 9][..]));
    assert_eq!(Batch::split(&rest[..2]), None);
}
