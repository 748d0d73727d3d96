//! The conversation of `rp discover --router`. Its messages are compared with those of Zenoh's own
//! codec. Its session gets the answers of a real router and hostile answers. The command runs with
//! a scripted server.

mod answers;
mod command;

use std::path::Path;

use proptest::prelude::*;
use ros2probe::discover::zenoh::graph::EndpointKind;
use ros2probe::discover::zenoh::message;
use ros2probe::discover::zenoh::session::{
    MOST_BYTES, MOST_MESSAGE_BYTES, Session, Step, Unusable,
};
use ros2probe::tables::RouterTokens;
use ros2probe_wire::DomainId;
use ros2probe_wire::zenoh::{Batch, Message, NetworkMessage, WhatAmI};
use zenoh_buffers::reader::{HasReader, Reader as _};
use zenoh_buffers::writer::HasWriter;
use zenoh_codec::{RCodec, WCodec, Zenoh080};
use zenoh_protocol::core::{Priority, WhatAmI as TheirWhatAmI};
use zenoh_protocol::network::interest::{InterestMode, ext::QoSType};
use zenoh_protocol::network::{NetworkBody, NetworkMessage as TheirNetworkMessage};
use zenoh_protocol::transport::{TransportBody, TransportMessage};

use answers::{alias, aliased, final_, fragments, frame, init, open, token};

const ID: [u8; 16] = [0x81, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 0x96];

/// Returns both directions of the recorded conversation, as segments in their order.
fn recorded() -> Vec<(bool, Vec<u8>)> {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/discover/zenoh.txt");
    let text = std::fs::read_to_string(file).unwrap();
    let segment = |line: &str| {
        let [_, way, digits] = line.split(' ').collect::<Vec<_>>().try_into().unwrap();
        let pairs = digits.as_bytes().chunks(2);
        let byte = |pair| u8::from_str_radix(str::from_utf8(pair).unwrap(), 16).unwrap();
        (way == ">", pairs.map(byte).collect())
    };
    text.lines().map(segment).collect()
}

/// Returns the batches that the recorded router sent, without their lengths.
fn recorded_answers() -> Vec<Vec<u8>> {
    let answers = recorded().into_iter().filter(|(is_sent, _)| !is_sent);
    let stream = answers.flat_map(|(_, bytes)| bytes).collect::<Vec<_>>();
    let mut rest = &stream[..];
    let mut batches = Vec::new();
    while let Some((batch, behind)) = Batch::split(rest) {
        batches.push(batch.to_vec());
        rest = behind;
    }
    assert!(rest.is_empty());
    batches
}

/// Returns a session that has sent its request.
fn asked() -> Session {
    let mut session = Session::new(None);
    session.receive(&init(&[7; 49], 9, &[])).unwrap();
    session.receive(&open()).unwrap();
    assert_eq!(session.step(), Step::Request);
    session
}

/// Returns the token of a publisher in domain 0.
fn publisher(number: usize) -> String {
    format!(
        "@ros2_lv/0/a1/0/{number}/MP/%/%/talker/%chatter/std_msgs::msg::dds_::String_/\
         TypeHashNotSupported/::,7:,:,:,,"
    )
}

fn publishers(session: &Session) -> usize {
    let graphs = session.graphs();
    graphs
        .values()
        .map(|it| it.count(EndpointKind::Publisher))
        .sum()
}

/// Decodes a batch with Zenoh's codec, and returns the message with its encoding by the same codec.
fn through_their_codec(batch: &[u8]) -> (TransportBody, Vec<u8>) {
    let mut reader = batch.reader();
    let read: TransportMessage = Zenoh080::new().read(&mut reader).unwrap();
    assert!(!reader.can_read());
    let mut written = Vec::new();
    Zenoh080::new().write(&mut written.writer(), &read).unwrap();
    (read.body, written)
}

#[test]
fn the_messages_equal_those_that_zenoh_encodes() {
    let cookie = [5; 200];
    let all = [
        message::introduction(ID),
        message::opening(&cookie),
        message::request("@ros2_lv/**", true),
        message::goodbye(),
    ];
    let [init, open, frame, close] = all.map(|bytes| {
        let (batch, rest) = Batch::split(&bytes).unwrap();
        assert!(rest.is_empty());
        let (body, written) = through_their_codec(batch);
        assert_eq!(written, batch);
        body
    });
    let TransportBody::InitSyn(init) = init else {
        panic!("{init:?}");
    };
    assert_eq!((init.version, init.whatami), (9, TheirWhatAmI::Client));
    assert_eq!(init.zid.to_le_bytes(), ID);
    assert!(init.ext_qos.is_some() && init.ext_auth.is_none());
    assert!(init.ext_lowlatency.is_none() && init.ext_compression.is_none());
    let TransportBody::OpenSyn(open) = open else {
        panic!("{open:?}");
    };
    assert_eq!((open.lease.as_secs(), open.initial_sn), (60, 0));
    assert_eq!(open.cookie.as_slice(), cookie);
    let TransportBody::Frame(frame) = frame else {
        panic!("{frame:?}");
    };
    assert_eq!((frame.sn, frame.ext_qos.priority()), (0, Priority::Control));
    let [TheirNetworkMessage { body, .. }] = &frame.payload[..] else {
        panic!("{frame:?}");
    };
    let NetworkBody::Interest(interest) = body else {
        panic!("{body:?}");
    };
    // The message requests only current declarations.
    assert_eq!(interest.mode, InterestMode::Current);
    assert!(interest.options.keyexprs() && interest.options.tokens());
    assert!(!interest.options.subscribers() && !interest.options.queryables());
    let key = interest.wire_expr.as_ref().unwrap();
    assert_eq!((key.scope, &*key.suffix), (0, "@ros2_lv/**"));
    assert_eq!(interest.ext_qos, QoSType::INTEREST);
    let TransportBody::Close(close) = close else {
        panic!("{close:?}");
    };
    assert_eq!((close.reason, close.session), (0, true));
}

#[test]
fn a_router_without_priorities_gets_the_request_with_the_default_priority() {
    for (extensions, priority) in [(&[1][..], Priority::Control), (&[], Priority::DEFAULT)] {
        let mut session = Session::new(None);
        session.receive(&init(&[], 9, extensions)).unwrap();
        let [request] = &session.receive(&open()).unwrap()[..] else {
            panic!("no request");
        };
        let (batch, _) = Batch::split(&request.bytes).unwrap();
        let (body, written) = through_their_codec(batch);
        assert_eq!(written, batch);
        let TransportBody::Frame(frame) = body else {
            panic!("{body:?}");
        };
        assert_eq!(frame.ext_qos.priority(), priority);
    }
}

#[test]
fn the_decoder_of_the_agent_reads_the_messages() {
    let all = [
        message::introduction(ID),
        message::opening(&[]),
        message::request("@ros2_lv/7/**", true),
        message::goodbye(),
    ];
    let stream = all.concat();
    let mut rest = &stream[..];
    let mut read = Vec::new();
    while let Some((batch, behind)) = Batch::split(rest) {
        read.extend(Batch::whole(batch).map(Result::unwrap));
        rest = behind;
    }
    let [
        Message::Init(init),
        Message::Open(open),
        Message::Frame(frame),
        Message::Network(NetworkMessage::Interest(interest)),
        Message::Close(close),
    ] = read[..]
    else {
        panic!("{read:?}");
    };
    assert_eq!((init.whatami, init.patch), (WhatAmI::Client, 1));
    assert!(!open.is_ack && frame.lane.is_reliable && close.is_session);
    assert!(interest.is_current && !interest.is_future);
    assert_eq!(interest.key.unwrap().key(), Some("@ros2_lv/7/**"));
}

#[test]
fn the_session_with_a_recorded_router_sends_the_recorded_messages_and_is_complete() {
    let mut session = Session::new(None);
    let mut sent = vec![message::introduction(
        // The identifier follows the length, header, version and role.
        recorded()[0].1[5..21].try_into().unwrap(),
    )];
    for batch in recorded_answers() {
        let outgoing = session.receive(&batch).unwrap();
        sent.extend(outgoing.into_iter().map(|it| it.bytes));
    }
    sent.push(message::goodbye());
    let recorded = recorded().into_iter().filter(|(is_sent, _)| *is_sent);
    assert_eq!(sent, recorded.map(|it| it.1).collect::<Vec<_>>());

    assert_eq!((session.step(), session.unreadable()), (Step::Complete, 0));
    let graphs = session.graphs();
    let counts = |domain: u32| {
        use EndpointKind::{Client, Publisher, Server, Subscription};
        let graph = &graphs[&DomainId(domain)];
        [Publisher, Subscription, Server, Client].map(|kind| graph.count(kind))
    };
    assert_eq!(graphs.len(), 2);
    assert_eq!(
        graphs[&DomainId(0)].nodes,
        ["/add_two_ints_server", "/talker"]
    );
    assert_eq!(graphs[&DomainId(7)].nodes, ["/robot2/listener"]);
    assert_eq!((counts(0), counts(7)), ([5, 2, 13, 0], [2, 2, 6, 0]));
    let published = &graphs[&DomainId(0)].endpoints[&EndpointKind::Publisher];
    let chatter = ("/chatter".to_owned(), "std_msgs/msg/String".to_owned());
    assert_eq!(published[0], chatter);
}

#[test]
fn aliases_and_fragments_lead_to_the_same_tokens() {
    let (long, short) = (publisher(1), publisher(2));
    let (prefix, suffix) = long.split_at(20);
    let mut session = asked();
    // One FRAME has an alias, an alias of that alias, and both tokens, one of them twice.
    let messages = [
        alias(1, 0, prefix),
        alias(2, 1, &suffix[..30]),
        aliased(2, &suffix[30..]),
        token(&short),
        token(&long),
    ];
    session.receive(&frame(&messages.concat())).unwrap();
    assert_eq!(publishers(&session), 2);
    // Fragments of 50 bytes, with and without the mark of the first fragment.
    for (number, is_marked) in [(3, true), (4, false)] {
        for fragment in fragments(&token(&publisher(number)), 50, is_marked) {
            session.receive(&fragment).unwrap();
        }
    }
    assert_eq!(publishers(&session), 4);
    // Fragments of a message that the router dropped are discarded.
    let [first, ..] = &fragments(&token(&publisher(5)), 50, true)[..] else {
        panic!("no fragment");
    };
    session.receive(first).unwrap();
    session.receive(&[0xe6, 1, 0xb1, 0, 0x03]).unwrap();
    for fragment in fragments(&token(&publisher(6)), 50, false) {
        session.receive(&fragment).unwrap();
    }
    assert_eq!((publishers(&session), session.unreadable()), (5, 0));
    // An unknown alias makes only one token unreadable.
    session.receive(&frame(&aliased(9, "x"))).unwrap();
    session.receive(&frame(&final_())).unwrap();
    assert_eq!((session.step(), session.unreadable()), (Step::Complete, 1));
}

#[test]
fn a_missing_fragment_ends_the_conversation() {
    let mut session = asked();
    let fragments = fragments(&token(&publisher(1)), 50, true);
    session.receive(&fragments[0]).unwrap();
    let missing = session.receive(&fragments[2]);
    assert!(
        matches!(missing, Err(Unusable::Unexpected(_))),
        "{missing:?}"
    );
}

#[test]
fn tokens_beyond_the_cap_end_the_conversation() {
    let mut session = asked();
    for number in 0..RouterTokens::CAP {
        session.receive(&frame(&token(&publisher(number)))).unwrap();
    }
    assert_eq!(
        (session.step(), publishers(&session)),
        (Step::Request, RouterTokens::CAP)
    );
    // A known token needs no additional entry.
    session.receive(&frame(&token(&publisher(5)))).unwrap();
    assert_eq!(session.step(), Step::Request);
    session
        .receive(&frame(&token(&publisher(RouterTokens::CAP))))
        .unwrap();
    assert_eq!(
        (session.step(), publishers(&session)),
        (Step::Full, RouterTokens::CAP)
    );
}

#[test]
fn responses_beyond_the_byte_cap_end_the_session_even_through_aliases() {
    let mut session = asked();
    let batch = [0x04; 60_000];
    for _ in 0..MOST_BYTES / batch.len() {
        session.receive(&batch).unwrap();
        assert_eq!(session.step(), Step::Request);
    }
    session.receive(&batch).unwrap();
    assert_eq!(session.step(), Step::Full);

    // Each token of ten bytes uses an alias of 30,000 bytes.
    let mut session = asked();
    session
        .receive(&frame(&alias(1, 0, &"x".repeat(30_000))))
        .unwrap();
    let tokens = aliased(1, "").repeat(100);
    let mut batches = 0;
    while session.step() == Step::Request {
        session.receive(&frame(&tokens)).unwrap();
        batches += 1;
    }
    assert!((5..=6).contains(&batches), "{batches}");
    assert_eq!(session.step(), Step::Full);
}

#[test]
fn a_message_in_fragments_beyond_the_cap_ends_the_conversation() {
    let mut session = asked();
    let message = vec![0; MOST_MESSAGE_BYTES + 1];
    let fragments = fragments(&message, 40_000, true);
    let (last, others) = fragments.split_last().unwrap();
    for fragment in others {
        session.receive(fragment).unwrap();
        assert_eq!(session.step(), Step::Request);
    }
    session.receive(last).unwrap();
    assert_eq!(session.step(), Step::Full);
}

#[test]
fn answers_in_the_wrong_order_are_refused() {
    let mut session = Session::new(None);
    assert!(session.receive(&open()).is_err());
    let mut session = Session::new(None);
    assert!(session.receive(&frame(&token(&publisher(1)))).is_err());
    let introduction = message::introduction(ID);
    assert!(session.receive(&introduction[2..]).is_err());
    let mut session = asked();
    assert!(session.receive(&init(&[], 9, &[])).is_err());
    for feature in [5, 6] {
        let answer = Session::new(None).receive(&init(&[], 9, &[feature]));
        assert_eq!(answer, Err(Unusable::Framing));
    }
}

proptest! {
    #[test]
    fn arbitrary_batches_never_panic(batches: Vec<Vec<u8>>, answers: bool) {
        let mut session = if answers { asked() } else { Session::new(None) };
        for batch in &batches {
            let _ = session.beginning(batch);
            if session.receive(batch).is_err() {
                break;
            }
        }
        let _ = session.graphs();
    }

    #[test]
    fn changed_answers_are_read_or_refused(batch in 0_usize..3, at: prop::sample::Index, to: u8) {
        let mut answers = recorded_answers();
        let changed = answers.get_mut(batch).unwrap();
        let at = at.index(changed.len());
        changed[at] = to;
        let mut session = Session::new(None);
        let tokens = answers.iter().try_for_each(|batch| session.receive(batch).map(drop));
        prop_assert!(tokens.is_err() || session.graphs().len() <= 4);
    }
}
