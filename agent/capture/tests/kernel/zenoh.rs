//! The programs for TCP on real sockets: connections of Zenoh are followed batch by batch, and
//! nothing of other connections leaves the kernel. The tests need root.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Read as _, Write as _};
use std::net::{Ipv4Addr, SocketAddr, TcpListener, TcpStream, UdpSocket};
use std::path::Path;
use std::sync::atomic::{AtomicU16, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, ensure};
use ros2probe_capture::filter::{Filter, FilterSettings};
use ros2probe_capture::interfaces::Selection;
use ros2probe_capture::netns;
use ros2probe_capture::pcap::PcapReader;
use ros2probe_capture::reassembly::Limits;
use ros2probe_capture::settings::WireChoice;
use ros2probe_capture::sockets::Sockets;
use ros2probe_capture::streams::{Chunk, MissingBefore, Protocol, Streamed, Streams, flow};
use ros2probe_capture::system::Clocks;
use ros2probe_capture::tcx;
use ros2probe_capture::wire_tap::{WireTap, WireTapSettings};
use ros2probe_model::facts::route::Destination;
use ros2probe_model::graph::zenoh::{Flow, StreamEvent, StreamId, Unseen};
use ros2probe_model::observe::observer::{Observer, Settings};
use ros2probe_testing::harness::PREFIX;
use ros2probe_testing::harness::cgroup::Cgroup;
use ros2probe_testing::harness::network::Namespace;
use ros2probe_testing::zenoh as forged;
use ros2probe_wire::filter::{Budget, CANDIDATE_CAPACITY, CONNECTION_CAPACITY, Counter};
use ros2probe_wire::frame::{self, Payload};
use ros2probe_wire::host::{Piece, chunk};
use ros2probe_wire::record::flag;
use ros2probe_wire::time::SECOND;
use ros2probe_wire::zenoh::Gid;
use ros2probe_wire::{Expansion, Timestamp};

mod bounds;
mod ends;
mod processes;
mod quic;
mod rtps;
mod send_queue;
mod tapped;
mod verdicts;

static NEXT: AtomicU16 = AtomicU16::new(0);

/// A cgroup, the programs on it, and a network namespace.
struct Observed {
    cgroup: Cgroup,
    filter: Filter,
    host: Namespace,
    streams: Streams,
}

/// What user space reads of one direction at one socket.
#[derive(Default, Debug)]
struct Seen {
    /// Captured beginnings of batches, and their lengths.
    batches: Vec<(Vec<u8>, u16)>,
    begun: u64,
    gaps: u64,
    ended: u64,
    unseen: Vec<Unseen>,
}

impl Observed {
    fn new() -> Result<Self> {
        Self::with(&FilterSettings {
            piece_ring_bytes: 32 << 20,
            ..FilterSettings::default()
        })
    }

    fn with(settings: &FilterSettings) -> Result<Self> {
        Self::with_budget(settings, Some(1 << 30))
    }

    /// Attaches the programs. Without `budget`, they have the budget with which they are loaded.
    fn with_budget(settings: &FilterSettings, budget: Option<u32>) -> Result<Self> {
        let number = NEXT.fetch_add(1, Ordering::Relaxed);
        let cgroup = Cgroup::create(&format!("{PREFIX}-{}-zenoh{number}", std::process::id()))?;
        let mut filter = Filter::load_host(settings)?;
        filter
            .zenoh_programs()
            .context("no host hook")?
            .map_err(|error| anyhow::anyhow!("{error:#?}"))?;
        if let Some(bytes) = budget {
            filter.set_unknown_budget(Budget::CaptureBytes, bytes)?;
        }
        filter.attach(&File::open(cgroup.path())?)?;
        let host = Namespace::isolated()?;
        Ok(Self {
            cgroup,
            filter,
            host,
            streams: Streams::default(),
        })
    }

    /// Runs `make` in the cgroup and the namespace.
    fn make<T: Send>(&self, make: impl FnOnce() -> T + Send) -> Result<T> {
        Ok(self
            .cgroup
            .hold(|| netns::within(&self.host.network(), make))??)
    }

    /// Opens a connection from a client to a server.
    fn connect(&self, address: &str) -> Result<[TcpStream; 2]> {
        self.make(|| connect(address))?
    }

    fn counter(&self, which: Counter) -> Result<u64> {
        let counters = self.filter.counters()?;
        let found = counters.iter().find(|(counter, _)| *counter == which);
        Ok(found.context("no such counter")?.1)
    }

    /// Returns all chunks since the last call.
    fn chunks(&mut self) -> Vec<(Piece, Vec<u8>)> {
        std::iter::from_fn(|| {
            let captured = self.filter.next_piece()?;
            let (piece, bytes) = captured.read().unwrap();
            Some((piece, bytes.to_vec()))
        })
        .collect()
    }

    /// Reads the chunks since the last call as the live source does.
    fn seen(&mut self) -> BTreeMap<StreamId, Seen> {
        let chunks = self.chunks();
        self.read(chunks)
    }

    /// Reads chunks as the live source does.
    fn read(&mut self, chunks: Vec<(Piece, Vec<u8>)>) -> BTreeMap<StreamId, Seen> {
        let mut seen = BTreeMap::new();
        for (piece, bytes) in chunks {
            if piece.chunk & chunk::CLIENT_HELLO != 0 {
                continue;
            }
            assert_ne!(piece.flags & flag::STREAM, 0, "{piece:?}");
            let chunk = Chunk::of_piece(&piece, &bytes, Timestamp(piece.time));
            self.streams.chunk(&chunk, |report| note(&mut seen, report));
        }
        seen
    }

    /// Passes the chunks since the last call to the model as the live source does.
    fn feed(&mut self, observer: &mut Observer) {
        for (piece, bytes) in self.chunks() {
            let chunk = Chunk::of_piece(&piece, &bytes, Timestamp(piece.time));
            self.streams
                .chunk(&chunk, |streamed| streamed.pass_to(observer));
        }
    }
}

/// Opens a connection from a client to a server, in the namespace of the caller.
fn connect(address: &str) -> Result<[TcpStream; 2]> {
    let listener = TcpListener::bind(address)?;
    let client = TcpStream::connect(listener.local_addr()?)?;
    let (server, _) = listener.accept()?;
    client.set_nodelay(true)?;
    server.set_nodelay(true)?;
    Ok([client, server])
}

fn note(seen: &mut BTreeMap<StreamId, Seen>, streamed: &Streamed<'_>) {
    let Streamed::Zenoh(report) = streamed else {
        panic!("{streamed:?}");
    };
    let seen = seen.entry(*report.stream).or_default();
    match report.event {
        StreamEvent::Batch { bytes, length } => seen.batches.push((bytes.to_vec(), length)),
        StreamEvent::Gap => seen.gaps += 1,
        StreamEvent::Begin => seen.begun += 1,
        StreamEvent::End => seen.ended += 1,
        StreamEvent::Unseen(unseen) => seen.unseen.push(unseen),
    }
}

/// A batch of a capture, and whether the side that opened the connection sent it.
type Sent = (bool, Vec<u8>);

/// Returns the batches of each connection of a capture, in their order.
fn connections(capture: &str) -> Result<Vec<Vec<Sent>>> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../..")
        .join(capture);
    let mut reader = PcapReader::open(&path, Expansion::Limited)?;
    let mut streams = Streams::default();
    let mut order: Vec<(Flow, Vec<Sent>)> = Vec::new();
    while let Some(captured) = reader.next_packet()? {
        let parsed = frame::parse(captured.link, captured.bytes, captured.length)?;
        let Some(packet) = parsed.packet else {
            continue;
        };
        let Payload::Segment(segment) = packet.payload else {
            continue;
        };
        let stream = StreamId {
            flow: flow(&packet, &segment),
            ..StreamId::default()
        };
        let chunk = Chunk::of_segment(&segment, captured.time, stream);
        streams.chunk(&chunk, |streamed| {
            let Streamed::Zenoh(report) = streamed else {
                return;
            };
            let StreamEvent::Batch { bytes, .. } = report.event else {
                return;
            };
            let flow = report.stream.flow;
            let known = order
                .iter_mut()
                .rfind(|(opened, _)| [flow, flow.reversed()].contains(opened));
            match known {
                Some((opened, batches)) => batches.push((*opened == flow, bytes.to_vec())),
                None => order.push((flow, vec![(true, bytes.to_vec())])),
            }
        });
    }
    Ok(order.into_iter().map(|(_, batches)| batches).collect())
}

const LIFECYCLE: &str = "agent/testing/data/zenoh/lifecycle-1host/capture.pcap.gz";
const POINTS: &str = "wire/tests/data/zenoh/points-samehost.pcap.gz";

fn with_prefix(batch: &[u8]) -> Vec<u8> {
    let length = u16::try_from(batch.len()).unwrap();
    [&length.to_le_bytes()[..], batch].concat()
}

/// Writes to one side of a connection, and reads it from the other side.
fn pass(connection: &mut [TcpStream; 2], by_client: bool, bytes: &[u8]) -> Result<()> {
    /// Number of bytes that a socket accepts before its peer reads any.
    const BUFFERED: usize = 8_192;
    let [client, server] = connection;
    let (from, to) = match by_client {
        true => (client, server),
        false => (server, client),
    };
    let mut read = vec![0; bytes.len()];
    if bytes.len() <= BUFFERED {
        // A thread would cost more than the message.
        from.write_all(bytes)?;
        to.read_exact(&mut read)?;
    } else {
        std::thread::scope(|scope| -> Result<()> {
            let reading = scope.spawn(|| to.read_exact(&mut read));
            from.write_all(bytes)?;
            reading.join().unwrap()?;
            Ok(())
        })?;
    }
    ensure!(read == bytes, "other bytes arrive");
    Ok(())
}

/// Returns what was seen of each direction of a connection: sent and received by the client, then
/// by the server.
fn directions<'a>(
    seen: &'a BTreeMap<StreamId, Seen>,
    connection: &[TcpStream; 2],
) -> Result<[Option<&'a Seen>; 4]> {
    let [client, server] = connection;
    let (client, server) = (client.local_addr()?.port(), server.local_addr()?.port());
    let find = |from: u16, to: u16, outgoing: bool| {
        let is = |id: &StreamId| {
            (id.flow.source.port, id.flow.destination.port) == (from, to) && id.outgoing == outgoing
        };
        seen.iter().find(|(id, _)| is(id)).map(|(_, seen)| seen)
    };
    Ok([
        find(client, server, true),
        find(client, server, false),
        find(server, client, true),
        find(server, client, false),
    ])
}

/// Returns the batches of a direction, by its index in the result of [`directions`].
fn of_direction<'a>(sent: impl Iterator<Item = &'a Sent>, direction: usize) -> Vec<&'a Vec<u8>> {
    sent.filter(|(by_client, _)| *by_client == (direction < 2))
        .map(|(_, batch)| batch)
        .collect()
}

/// Checks that exactly these batches were seen, and as much of each as is needed.
fn check(seen: &Seen, sent: &[&Vec<u8>], case: &str) -> Result<()> {
    ensure!(seen.gaps == 0, "{case}: {} gaps", seen.gaps);
    ensure!(
        seen.batches.len() == sent.len(),
        "{case}: {} of {} batches",
        seen.batches.len(),
        sent.len()
    );
    for (index, ((bytes, length), sent)) in seen.batches.iter().zip(sent).enumerate() {
        ensure!(
            usize::from(*length) == sent.len() && sent.starts_with(bytes),
            "{case}: batch {index} of {} is {bytes:02x?} of {length}, not {sent:02x?}",
            seen.batches.len()
        );
        let is_whole = bytes.len() == sent.len();
        let is_needed = match sent[0] & 0x1f {
            5 | 6 => sent.windows(2).take(8).any(|pair| pair == [0x31, 0]),
            _ => true,
        };
        ensure!(
            is_whole || !is_needed,
            "{case}: batch {index} is cut: {sent:02x?}"
        );
    }
    Ok(())
}

#[test]
fn each_batch_of_a_recorded_system_is_seen_once_at_its_sender() -> Result<()> {
    for (capture, address) in [
        (LIFECYCLE, "127.0.0.1:0"),
        (LIFECYCLE, "[::1]:0"),
        (POINTS, "127.0.0.1:0"),
        (POINTS, "[::1]:0"),
    ] {
        let mut observed = Observed::new()?;
        let (mut batches, mut bytes) = (0, 0);
        for (number, sent) in connections(capture)?.into_iter().enumerate() {
            let mut connection = observed.connect(address)?;
            for (by_client, batch) in &sent {
                pass(&mut connection, *by_client, &with_prefix(batch))?;
                batches += 1;
                bytes += batch.len();
            }
            let seen = observed.seen();
            let case = format!("{capture} {address} connection {number}");
            let directions = directions(&seen, &connection)?;
            for (direction, seen) in directions.into_iter().enumerate() {
                let expected = of_direction(sent.iter(), direction);
                if expected.is_empty() {
                    continue;
                }
                let case = format!("{case} direction {direction}");
                if direction % 2 == 1 {
                    ensure!(seen.is_none(), "{case}: at the receiver");
                    continue;
                }
                let seen = seen.with_context(|| case.clone())?;
                check(seen, &expected, &case)?;
                assert_eq!(seen.begun, 1, "{case}");
            }
        }
        assert_eq!(observed.counter(Counter::ZenohBatches)?, batches);
        assert_eq!(observed.counter(Counter::ZenohGaps)?, 0);
        assert_eq!(observed.counter(Counter::ZenohChunksLost)?, 0);
        println!("{capture} {address}: {batches} batches of {bytes} bytes");
    }
    Ok(())
}

#[test]
fn packets_that_split_and_join_batches_yield_the_same_batches() -> Result<()> {
    for capture in [LIFECYCLE, POINTS] {
        let mut observed = Observed::new()?;
        let connections = connections(capture)?;
        let longest = connections.iter().max_by_key(|sent| sent.len());
        let by_client: Vec<_> = longest
            .unwrap()
            .iter()
            .map(|(by_client, _)| *by_client)
            .collect();
        let busiest = by_client.iter().filter(|it| **it).count() * 2 > by_client.len();
        let sent: Vec<_> = longest
            .unwrap()
            .iter()
            .filter(|(it, _)| *it == busiest)
            .collect();
        let on_the_wire: Vec<_> = sent
            .iter()
            .enumerate()
            .map(|(index, (_, batch))| {
                // An empty batch now and then stands for the rest of a message that was dropped.
                let empty: &[u8] = if index % 7 == 6 { &[0, 0] } else { &[] };
                [&with_prefix(batch), empty].concat()
            })
            .collect();
        let init = &on_the_wire[0];
        let rest = on_the_wire[1..].concat();
        for size in [1, 2, 3, 1460, 32_768, 62_464, 65_483, 200_000] {
            // Each piece takes a system call, so their number is limited.
            let rest = &rest[..rest.len().min(size * 4000)];
            let mut connection = observed.connect("127.0.0.1:0")?;
            pass(&mut connection, true, init)?;
            for part in rest.chunks(size) {
                pass(&mut connection, true, part)?;
            }
            let seen = observed.seen();
            let mut end = 0;
            let whole = sent.iter().zip(&on_the_wire).map_while(|(sent, bytes)| {
                let is_whole = end + sent.1.len() + 2 <= init.len() + rest.len();
                end += bytes.len();
                is_whole.then_some(&sent.1)
            });
            let whole: Vec<_> = whole.collect();
            let [out, ..] = directions(&seen, &connection)?;
            let case = format!("{capture} in parts of {size}");
            check(out.context("unseen")?, &whole, &case)?;
        }
        println!(
            "{capture}: {} gaps in the kernel, {} chunks of {} batches",
            observed.counter(Counter::ZenohGaps)?,
            observed.counter(Counter::ZenohChunks)?,
            observed.counter(Counter::ZenohBatches)?
        );
    }
    Ok(())
}

/// A stream of numbers that repeats only after a long time (xorshift64).
fn random(seed: u64, length: usize) -> Vec<u8> {
    let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    let mut next = || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        state.to_le_bytes()
    };
    std::iter::repeat_with(&mut next)
        .flatten()
        .take(length)
        .collect()
}

#[test]
fn no_bytes_of_other_connections_leave_the_kernel() -> Result<()> {
    let mut observed = Observed::new()?;
    let request = b"GET /index.html HTTP/1.1\r\nHost: robot\r\nAccept: */*\r\n\r\n".to_vec();
    let lines: Vec<u8> = (0..5_000)
        .flat_map(|line| format!("% line {line}\n").into_bytes())
        .collect();
    let hello = [
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03".as_slice(),
        &random(1, 506),
    ]
    .concat();
    // Batches of fragments whose numbers do not fit.
    let strange: Vec<u8> = (0..1000_u16)
        .flat_map(|number| {
            let number = number.wrapping_mul(7919) & 0x7f;
            with_prefix(&[&[0x26, number as u8][..], &[0x55; 60]].concat())
        })
        .collect();
    let contents = [
        request,
        lines,
        hello,
        strange,
        vec![0; 200_000],
        vec![5; 200_000],
        vec![0x25; 70_000],
    ];
    for (number, bytes) in contents.iter().enumerate() {
        let mut connection = observed.connect("127.0.0.1:0")?;
        for part in bytes.chunks(1 + 3000 * number) {
            pass(&mut connection, true, part)?;
        }
        pass(&mut connection, false, bytes)?;
    }
    for seed in 0..40 {
        let mut connection = observed.connect("[::1]:0")?;
        for (index, part) in random(seed, 500_000)
            .chunks(1 + 700 * seed as usize)
            .take(400)
            .enumerate()
        {
            pass(&mut connection, index % 2 == 0, part)?;
        }
    }
    // Each side has sent a hello of a client of TLS, of which only the addresses are passed on.
    let chunks = observed.chunks();
    let is_hello = |(piece, bytes): &(Piece, Vec<u8>)| {
        piece.chunk & chunk::CLIENT_HELLO != 0 && bytes.is_empty()
    };
    assert!(
        chunks.len() == 2 && chunks.iter().all(is_hello),
        "{chunks:?}"
    );
    assert_eq!(observed.counter(Counter::ZenohChunks)?, 0);
    assert_eq!(observed.counter(Counter::ZenohConnections)?, 0);
    let candidates = observed.counter(Counter::ZenohCandidates)?;
    assert!(
        candidates > 0,
        "random bytes look like a batch now and then"
    );
    println!("{candidates} candidates");
    Ok(())
}

#[test]
fn a_connection_older_than_the_programs_is_found_in_both_directions() -> Result<()> {
    for capture in [LIFECYCLE, POINTS] {
        let mut observed = Observed::new()?;
        let mut found = 0;
        for sent in connections(capture)? {
            let mut connection = observed.connect("127.0.0.1:0")?;
            // INIT, OPEN and declarations were sent before.
            let steady: Vec<_> = sent.iter().filter(|(_, batch)| is_data(batch)).collect();
            for (by_client, batch) in &steady {
                pass(&mut connection, *by_client, &with_prefix(batch))?;
            }
            let seen = observed.seen();
            for (direction, seen) in directions(&seen, &connection)?.into_iter().enumerate() {
                let sent = of_direction(steady.iter().copied(), direction);
                let Some(seen) = seen else {
                    ensure!(
                        sent.len() < 12 || direction % 2 == 1,
                        "{capture}: {} batches are not enough",
                        sent.len()
                    );
                    continue;
                };
                let missed = sent.len() - seen.batches.len();
                check(seen, &sent[missed..], capture)?;
                ensure!(missed <= 10, "{capture}: {missed} of {} missed", sent.len());
                assert_eq!(seen.begun, 0);
                found += 1;
            }
        }
        assert!(found >= 2, "{found}");
        println!("{capture}: {found} directions found");
    }
    Ok(())
}

/// Returns whether a batch is a `FRAME` or FRAGMENT of another lane than that of declarations.
fn is_data(batch: &[u8]) -> bool {
    matches!(batch[0] & 0x9f, 5 | 6)
}

/// Returns a PUSH in a FRAME: number of the FRAME, gid of the publisher, and payload.
fn push(number: u8, gid: [u8; 16], payload: &[u8]) -> Vec<u8> {
    let mut batch = vec![0x25, number, 0x1d, 3, 0x81, 0x43, 33];
    batch.extend_from_slice(&u64::from(number).to_le_bytes());
    batch.extend_from_slice(&[1; 8]);
    batch.push(16);
    batch.extend_from_slice(&gid);
    let mut length = payload.len();
    while length > 0x7f {
        batch.push((length & 0x7f) as u8 | 0x80);
        length >>= 7;
    }
    batch.push(length as u8);
    batch.extend_from_slice(payload);
    batch
}

/// An INIT of a peer.
const INIT: &[u8] = b"\xc1\x09\xf1\xe8\x73\x83\xf7\x0e\xa9\xbd\xcb\x55\x2c\xc6\x2c\x63\xa1\x0c\xd1\x0a\xc8\xff\x81\x27\x01";
