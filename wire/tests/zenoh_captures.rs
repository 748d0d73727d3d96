//! Reads captures of real rmw_zenoh nodes and compares their contents with the findings of an
//! independent decoder.
//!
//! Runs on the capture in `tests/data/zenoh`, and on those in `../shared/fixtures/zenoh` beside the
//! workspace if that exists. Every batch must be read without an error.

#![expect(
    clippy::unwrap_used,
    clippy::panic,
    clippy::indexing_slicing,
    reason = "a failed expectation may panic"
)]

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::fs;
use std::io::Read;
use std::net::{IpAddr, SocketAddr};
use std::path::{Path, PathBuf};

use etherparse::{NetSlice, SlicedPacket, TransportSlice};
use ros2probe_wire::zenoh::{
    Attachment, Batch, Declaration, Gid, Init, Key, Lane, Mapping, Message, NetworkMessage,
    Resolution, Sample, Session, Token, WireExpr,
};
use serde_json::Value;

/// One direction of a TCP connection.
#[derive(Default)]
struct Stream {
    bytes: Vec<u8>,
    /// Sequence number of the next byte.
    next: u32,
    /// Offset in `bytes` and packet number of each segment.
    segments: Vec<(usize, usize)>,
    begins_with_syn: bool,
}

impl Stream {
    fn push(&mut self, packet: usize, sequence: u32, payload: &[u8]) {
        // The sequence number of an empty segment may count a preceding FIN.
        if payload.is_empty() {
            return;
        }
        let repeated = self.next.wrapping_sub(sequence);
        // The captures have no gap, so bytes can only be repeated.
        assert!(repeated < 1 << 31, "gap before packet {packet}");
        let Some(new) = payload.get(usize::try_from(repeated).unwrap()..) else {
            return;
        };
        if !new.is_empty() {
            self.segments.push((self.bytes.len(), packet));
            self.bytes.extend(new);
            self.next = self.next.wrapping_add(u32::try_from(new.len()).unwrap());
        }
    }

    /// Returns the offset of the first batch. A capture that begins within a connection may begin
    /// within a batch. Then the first batch is at the first segment from which everything can be
    /// read.
    fn first_batch(&self) -> usize {
        if self.begins_with_syn {
            return 0;
        }
        let is_readable = |start: &usize| {
            let mut rest = &self.bytes[*start..];
            while let Some((batch, next)) = Batch::split(rest) {
                if batch.is_empty() || Batch::whole(batch).any(|message| message.is_err()) {
                    return false;
                }
                rest = next;
            }
            true
        };
        let mut starts = self.segments.iter().map(|(start, _)| *start);
        starts.find(is_readable).unwrap_or(self.bytes.len())
    }

    /// Returns each batch with the packet that completed it.
    fn batches(&self) -> Vec<(usize, &[u8])> {
        let mut batches = Vec::new();
        let mut rest = &self.bytes[self.first_batch()..];
        while let Some((batch, next)) = Batch::split(rest) {
            let end = self.bytes.len() - next.len();
            let index = self.segments.partition_point(|(start, _)| *start < end);
            batches.push((self.segments[index - 1].1, batch));
            rest = next;
        }
        batches
    }
}

/// Sender and receiver of one direction of a connection.
type Ends = (SocketAddr, SocketAddr);

/// Reassembles the streams of a capture of Ethernet frames.
fn streams(capture: &[u8]) -> Vec<(Ends, Stream)> {
    let mut streams: Vec<(Ends, Stream)> = Vec::new();
    let mut current: HashMap<Ends, usize> = HashMap::new();
    let word = |bytes: &[u8]| u32::from_le_bytes(bytes[..4].try_into().unwrap());
    let mut rest = &capture[24..];
    for packet in 0.. {
        if rest.len() < 16 {
            break;
        }
        let captured = usize::try_from(word(&rest[8..])).unwrap();
        let sliced = SlicedPacket::from_ethernet(&rest[16..16 + captured]).unwrap();
        rest = &rest[16 + captured..];
        let Some(TransportSlice::Tcp(tcp)) = sliced.transport else {
            continue;
        };
        let (source, destination): (IpAddr, IpAddr) = match sliced.net.unwrap() {
            NetSlice::Ipv4(ip) => (
                ip.header().source_addr().into(),
                ip.header().destination_addr().into(),
            ),
            NetSlice::Ipv6(ip) => (
                ip.header().source_addr().into(),
                ip.header().destination_addr().into(),
            ),
            NetSlice::Arp(_) => continue,
        };
        let ends = (
            SocketAddr::new(source, tcp.source_port()),
            SocketAddr::new(destination, tcp.destination_port()),
        );
        let (syn, sequence) = (tcp.syn(), tcp.sequence_number());
        if syn || !current.contains_key(&ends) {
            current.insert(ends, streams.len());
            let stream = Stream {
                next: sequence.wrapping_add(u32::from(syn)),
                begins_with_syn: syn,
                ..Stream::default()
            };
            streams.push((ends, stream));
        }
        streams[current[&ends]]
            .1
            .push(packet, sequence, tcp.payload());
    }
    streams
}

/// Publications of one publisher on one connection.
#[derive(Default, PartialEq, Eq, Debug)]
struct Publications {
    messages: u64,
    bytes: u64,
    first: u64,
    last: u64,
}

/// Contents of a capture.
#[derive(Default)]
struct Found {
    counts: BTreeMap<String, u64>,
    tokens: BTreeSet<String>,
    publications: BTreeMap<(String, String, String), Publications>,
    sessions: Vec<Session>,
    fragments: u64,
    heartbeats: u64,
    gaps: u64,
    next: HashMap<(Ends, Lane), (u32, bool)>,
    /// Keys by sender, receiver and alias of the sender.
    aliases: HashMap<(Ends, u16), String>,
    chains: HashMap<(Ends, Lane), Vec<u8>>,
    syns: HashMap<Ends, Vec<u8>>,
}

impl Found {
    fn read(capture: &[u8]) -> Self {
        let streams = streams(capture);
        let mut batches = Vec::new();
        for (ends, stream) in &streams {
            let of_stream = stream.batches().into_iter();
            batches.extend(of_stream.map(|(packet, batch)| (packet, *ends, batch)));
        }
        batches.sort_by_key(|(packet, _, _)| *packet);
        let mut found = Self::default();
        for (packet, ends, batch) in batches {
            found.batch(ends, batch, packet);
        }
        found
    }

    fn batch(&mut self, ends: Ends, batch: &[u8], packet: usize) {
        let mut messages = Batch::whole(batch);
        for message in messages.by_ref() {
            let message = message.unwrap_or_else(|error| panic!("packet {packet}: {error}"));
            match message {
                Message::Init(init) => self.init(ends, &init, batch),
                Message::Network(message) => self.network(ends, &message),
                Message::Frame(frame) => {
                    self.sequence(ends, frame.lane, frame.sequence_number, false);
                }
                Message::Fragment(fragment) => {
                    self.fragments += 1;
                    let is_last = !fragment.has_more;
                    self.sequence(ends, fragment.lane, fragment.sequence_number, is_last);
                    assert!(!fragment.is_dropped);
                    let chain = self.chains.entry((ends, fragment.lane)).or_default();
                    // Both sides have patch 1.
                    assert_eq!(fragment.is_first, chain.is_empty());
                    chain.extend(fragment.bytes.whole().unwrap());
                    if fragment.is_first {
                        let begun = NetworkMessage::beginning(chain).unwrap();
                        assert!(matches!(begun, NetworkMessage::Push(_)));
                    }
                    if !fragment.has_more {
                        let chain = self.chains.remove(&(ends, fragment.lane)).unwrap();
                        self.network(ends, &NetworkMessage::whole(&chain).unwrap());
                    }
                }
                _ => {}
            }
        }
        assert_eq!(messages.offset(), batch.len());
    }

    /// Checks the sequence numbers of a lane. A sender skips one number after each chain of
    /// fragments.
    fn sequence(&mut self, ends: Ends, lane: Lane, number: u32, is_last_fragment: bool) {
        let next = Resolution::DEFAULT.next(number);
        if let Some((expected, is_after_chain)) =
            self.next.insert((ends, lane), (next, is_last_fragment))
        {
            let skipped = Resolution::DEFAULT.next(expected);
            assert_eq!(number, if is_after_chain { skipped } else { expected });
            self.gaps += u64::from(is_after_chain);
        }
    }

    fn init(&mut self, ends: Ends, init: &Init<'_>, batch: &[u8]) {
        if !init.is_ack {
            self.syns.insert(ends, batch.to_vec());
            return;
        }
        let syn = &self.syns[&(ends.1, ends.0)];
        let Some(Ok(Message::Init(syn))) = Batch::whole(syn).next() else {
            unreachable!("it was read before");
        };
        let session = Session::agreed(&syn, init);
        assert_eq!(session.unobservable(), None);
        assert!(session.features.qos && session.patch == 1);
        self.sessions.push(session);
    }

    fn count(&mut self, name: &str) {
        *self.counts.entry(name.to_owned()).or_default() += 1;
    }

    /// Returns the key of an expression; `None` if its alias is older than the capture.
    fn key(&self, (sender, receiver): Ends, expression: WireExpr<'_>) -> Option<String> {
        if let Some(key) = expression.key() {
            return Some(key.to_owned());
        }
        let ends = match expression.mapping {
            Mapping::Sender => (sender, receiver),
            Mapping::Receiver => (receiver, sender),
        };
        let alias = self.aliases.get(&(ends, expression.scope))?;
        Some(format!("{alias}{}", expression.suffix))
    }

    fn network(&mut self, ends: Ends, message: &NetworkMessage<'_>) {
        match message {
            NetworkMessage::Push(push) => {
                self.count("PUSH");
                let Sample::Put(put) = push.sample else {
                    panic!("rmw_zenoh deletes nothing");
                };
                let Some(attachment) = put.attachment else {
                    // A heartbeat of an AdvancedPublisher.
                    let key = self.key(ends, push.key).unwrap();
                    assert_eq!(Key::parse(&key), Ok(Key::Advanced), "{key}");
                    self.heartbeats += 1;
                    return;
                };
                let attachment = Attachment::parse(attachment.whole().unwrap()).unwrap();
                if let Some(key) = self.key(ends, push.key) {
                    assert!(matches!(Key::parse(&key), Ok(Key::Topic(_))), "{key}");
                }
                let key = (
                    ends.0.to_string(),
                    ends.1.to_string(),
                    attachment.gid.to_string(),
                );
                let found = self.publications.entry(key).or_default();
                found.messages += 1;
                found.bytes += u64::try_from(put.payload.length).unwrap();
                let number = attachment.sequence_number.0;
                if found.messages == 1 {
                    found.first = number;
                }
                found.first = found.first.min(number);
                found.last = found.last.max(number);
            }
            NetworkMessage::Declare(declare) => self.declare(ends, declare.declaration),
            NetworkMessage::Request(_) => self.count("REQUEST"),
            NetworkMessage::Response(_) => self.count("RESPONSE"),
            NetworkMessage::ResponseFinal(_) => self.count("RESPONSE_FINAL"),
            NetworkMessage::Interest(_) => self.count("INTEREST"),
            NetworkMessage::Oam(_) => self.count("OAM"),
        }
    }

    fn declare(&mut self, ends: Ends, declaration: Declaration<'_>) {
        match declaration {
            Declaration::KeyExpr { id, key } => {
                self.count("D_KEYEXPR");
                if let Some(key) = self.key(ends, key) {
                    self.aliases.insert((ends, id), key);
                }
            }
            Declaration::UndeclareKeyExpr { id } => {
                self.count("U_KEYEXPR");
                self.aliases.remove(&(ends, id));
            }
            Declaration::Subscriber { key, .. } => {
                self.count("D_SUBSCRIBER");
                self.ros_key(ends, key);
            }
            Declaration::UndeclareSubscriber { .. } => self.count("U_SUBSCRIBER"),
            Declaration::Queryable { key, .. } => {
                self.count("D_QUERYABLE");
                self.ros_key(ends, key);
            }
            Declaration::UndeclareQueryable { .. } => self.count("U_QUERYABLE"),
            Declaration::Token { key, .. } => {
                self.count("D_TOKEN");
                if let Some(token) = self.key(ends, key) {
                    self.tokens.insert(token);
                }
            }
            Declaration::UndeclareToken { .. } => self.count("U_TOKEN"),
            Declaration::Final => self.count("D_FINAL"),
        }
    }

    /// Checks that a declared key is one of ROS or of the liveliness tokens.
    fn ros_key(&self, ends: Ends, expression: WireExpr<'_>) {
        if let Some(key) = self.key(ends, expression) {
            let parsed = Key::parse(&key).unwrap();
            assert!(!matches!(parsed, Key::NotRos), "{key}");
        }
    }
}

fn read(path: &Path) -> Vec<u8> {
    let bytes = fs::read(path).unwrap();
    if path.extension().is_none_or(|extension| extension != "gz") {
        return bytes;
    }
    let mut plain = Vec::new();
    flate2::read::MultiGzDecoder::new(&*bytes)
        .read_to_end(&mut plain)
        .unwrap();
    plain
}

/// Adds the captures with facts under a directory to `found`.
fn captures(directory: &Path, found: &mut Vec<(PathBuf, PathBuf)>) {
    for entry in fs::read_dir(directory).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            captures(&path, found);
            continue;
        }
        let name = path.file_name().unwrap().to_str().unwrap();
        let stem = name.trim_end_matches(".gz");
        if let Some(stem) = stem.strip_suffix(".facts.json") {
            let capture = format!("{}.pcap.gz", stem.trim_end_matches(".pcap"));
            found.push((path.with_file_name(capture), path));
        }
    }
}

/// Compares the parts of a token with the facts.
fn check_token(facts: &Value) {
    let text = facts["token"].as_str().unwrap();
    let token = Token::parse(text).unwrap();
    let name = |text: &str| facts[text].as_str().unwrap().to_owned();
    match token {
        Token::Node(node) => {
            assert_eq!(name("kind"), "node");
            assert_eq!(name("node"), node.full_name());
            assert_eq!(name("zid"), node.session.to_string());
        }
        Token::Endpoint(endpoint) => {
            assert_eq!(name("node"), endpoint.node.full_name());
            assert_eq!(name("zid"), endpoint.node.session.to_string());
            assert_eq!(name("domain"), endpoint.node.domain.to_string());
            assert_eq!(name("name"), endpoint.name.as_str());
            assert_eq!(name("type"), endpoint.type_name.as_str());
            assert!(endpoint.qos.is_some() && endpoint.type_hash.is_none());
            let kind = format!("{:?}", endpoint.kind).to_lowercase();
            assert_eq!(name("kind"), kind.replace("server", "service"));
        }
        Token::Bridge(_) => panic!("{text}"),
        // AdvancedPublishers have tokens too.
        Token::Other => assert_eq!(Key::parse(text), Ok(Key::Advanced), "{text}"),
    }
}

fn check(facts: &Value, found: &Found) {
    let mut counts: BTreeMap<String, u64> = BTreeMap::new();
    for session in facts["sessions"].as_array().unwrap() {
        for (name, count) in session["messages"].as_object().unwrap() {
            *counts.entry(name.clone()).or_default() += count.as_u64().unwrap();
        }
    }
    // The independent decoder requires three consecutive batches before it accepts a boundary. The
    // bytes that it left out contain a few more publications.
    let left_out = facts["stats"]["bytes_before_sync"].as_u64().unwrap_or(0);
    let earlier = found.counts["PUSH"] - counts["PUSH"];
    assert!(earlier <= left_out / 100, "{earlier} in {left_out} bytes");
    *counts.get_mut("PUSH").unwrap() += earlier;
    assert_eq!(found.counts, counts);
    let fragments = facts["stats"]["fragments"].as_u64().unwrap_or(0);
    assert_eq!(found.fragments, fragments);

    let sessions = facts["sessions"].as_array().unwrap().iter();
    let gaps: u64 = sessions.map(|s| s["sn_gaps"].as_u64().unwrap()).sum();
    assert_eq!(found.gaps, gaps);

    let mut gids = HashMap::new();
    let mut tokens = BTreeSet::new();
    for token in facts["tokens"].as_array().unwrap() {
        if let Some(text) = token["token"].as_str() {
            check_token(token);
            gids.insert(Gid::of_token(text).to_string(), text);
            tokens.insert(text.to_owned());
        }
    }
    assert_eq!(found.tokens, tokens);

    let publications = facts["publications"].as_array().unwrap();
    let mut theirs = BTreeMap::new();
    let mut heartbeats = 0;
    for publication in publications {
        if publication["gid"].is_null() {
            heartbeats += publication["messages"].as_u64().unwrap();
            continue;
        }
        let text = |name: &str| publication[name].as_str().unwrap().to_owned();
        let gid = text("gid");
        // The gid is the hash of the token, so it needs no alias.
        assert_eq!(gids.get(&gid).copied(), publication["token"].as_str());
        let numbers = &publication["seq_range"];
        let one = Publications {
            messages: publication["messages"].as_u64().unwrap(),
            bytes: publication["payload_bytes"].as_u64().unwrap(),
            first: numbers[0].as_u64().unwrap(),
            last: numbers[1].as_u64().unwrap(),
        };
        theirs.insert((text("sender"), text("receiver"), gid), one);
    }
    let mut missing = earlier;
    for (key, ours) in &found.publications {
        let theirs = theirs.get_mut(key).unwrap();
        let more = theirs.first - ours.first;
        theirs.first -= more;
        theirs.messages += more;
        theirs.bytes += more * (ours.bytes / ours.messages);
        missing -= more;
    }
    assert_eq!(missing, 0);
    assert_eq!(found.publications, theirs);
    assert_eq!(found.heartbeats, heartbeats);

    let known = facts["sessions"].as_array().unwrap().iter();
    let begun = known.filter(|session| session["from_syn"] == true).count();
    assert_eq!(found.sessions.len(), begun);
}

#[test]
fn captures_yield_the_facts_of_the_independent_decoder() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut all = Vec::new();
    captures(&root.join("tests/data/zenoh"), &mut all);
    assert_eq!(all.len(), 1);
    let shared = root.join("../../shared/fixtures/zenoh");
    if shared.is_dir() {
        captures(&shared, &mut all);
    } else {
        println!("left out: the captures of {}", shared.display());
    }
    for (capture, facts) in all {
        let facts: Value = serde_json::from_slice(&read(&facts)).unwrap();
        let found = Found::read(&read(&capture));
        println!(
            "{}: {} publications, {} tokens, {} sessions",
            capture.display(),
            found.counts["PUSH"],
            found.tokens.len(),
            found.sessions.len()
        );
        check(&facts, &found);
    }
}
