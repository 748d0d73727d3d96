//! Connections over QUIC, of which only the first datagrams can be recognized.

use super::tapped::{Tapped, hooks};
use super::*;

/// Datagrams with their server's port, and whether a QUIC connection of Zenoh begins with them.
fn datagrams() -> [(u16, Vec<u8>, bool); 6] {
    let initial = |version: [u8; 4]| [&[0xc3][..], &version, &[8], &[0x5a; 1194]].concat();
    let mut version_2 = initial([0x6b, 0x33, 0x43, 0xcf]);
    version_2[0] = 0xd3;
    [
        (7447, initial([0, 0, 0, 1]), true),
        (7447, version_2, true),
        (7447, random(5, 1252), false),
        (7447, initial([0, 0, 0, 1])[..1199].to_vec(), false),
        (7447, vec![0xc3, 0, 0], false),
        (7446, initial([0, 0, 0, 1]), false),
    ]
}

/// Sends a datagram from a new client to a server, and back.
fn exchange(address: &str, port: u16, bytes: &[u8]) -> Result<()> {
    let server = UdpSocket::bind(format!("{address}:{port}"))?;
    let client = UdpSocket::bind(format!("{address}:0"))?;
    let mut received = vec![0; 2000];
    for (from, to) in [(&client, &server), (&server, &client)] {
        from.send_to(bytes, to.local_addr()?)?;
        let length = to.recv(&mut received)?;
        ensure!(&received[..length] == bytes, "other bytes arrive");
    }
    Ok(())
}

// Coverage: Zenoh over QUIC | - | - | named
#[test]
fn quic_at_sockets_is_reported_only_on_a_port_of_zenoh() -> Result<()> {
    let mut observed = Observed::new()?;
    for address in ["127.0.0.1", "[::1]"] {
        for (port, bytes, is_quic) in datagrams() {
            observed.make(|| exchange(address, port, &bytes))??;
            let mut reported = Vec::new();
            for (piece, head) in observed.chunks() {
                assert_eq!(piece.chunk, chunk::QUIC, "{piece:?}");
                let chunk = Chunk::of_piece(&piece, &head, Timestamp(1));
                let note = |streamed: &Streamed<'_>| {
                    let Streamed::Zenoh(report) = streamed else {
                        panic!("{streamed:?}");
                    };
                    let StreamEvent::Unseen(reason) = report.event else {
                        panic!("{report:?}");
                    };
                    reported.push((reason, report.stream.flow));
                };
                let seen = (chunk.time, chunk.stream);
                observed.streams.datagram(seen, &head, chunk.length, note);
            }
            // Each datagram is reported at its sender and at its receiver.
            assert_eq!(
                reported.len(),
                if is_quic { 4 } else { 0 },
                "{address} {port}"
            );
            for (reason, flow) in reported {
                assert_eq!(reason, Unseen::Quic);
                let ports = (flow.source.port, flow.destination.port);
                assert!([(0, 7447), (7447, 0)].contains(&ports), "{flow:?}");
            }
        }
    }
    Ok(())
}

#[test]
fn quic_on_interfaces_is_reported_only_on_a_port_of_zenoh() -> Result<()> {
    let cases = hooks().into_iter();
    let cases = cases.flat_map(|wire| ["127.0.0.1", "[::1]"].map(|address| (wire, address)));
    for (wire, address) in cases {
        for (port, bytes, is_quic) in datagrams() {
            let mut tapped = Tapped::new(wire)?;
            netns::within(&tapped.host.network(), || exchange(address, port, &bytes))??;
            let deadline = Instant::now() + Duration::from_secs(if is_quic { 60 } else { 1 });
            let mut facts = None;
            while facts.is_none() && Instant::now() < deadline {
                std::thread::sleep(Duration::from_millis(20));
                tapped
                    .tap
                    .poll(&Clocks::read(), None, &mut tapped.observer)?;
                facts = tapped.observer.snapshot(Clocks::read().now).zenoh;
            }
            let unseen: Vec<_> = facts.iter().flat_map(|facts| facts.unseen()).collect();
            let expected = if is_quic {
                vec![(Unseen::Quic, 1)]
            } else {
                vec![]
            };
            assert_eq!(unseen, expected, "{address} {port}");
            assert_eq!(
                tapped.frames(),
                if is_quic { 2 } else { 0 },
                "{address} {port}"
            );
        }
    }
    Ok(())
}
