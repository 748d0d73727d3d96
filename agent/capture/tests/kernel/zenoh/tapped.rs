//! The tap on the interfaces: frames of connections of Zenoh pass.

use super::*;

/// Returns the hooks at interfaces that this kernel has.
pub fn hooks() -> Vec<WireChoice> {
    match tcx::check() {
        Ok(()) => vec![WireChoice::Packet, WireChoice::Tcx],
        Err(_) => vec![WireChoice::Packet],
    }
}

/// A tap on the interfaces of a namespace.
pub struct Tapped {
    pub host: Namespace,
    pub tap: WireTap,
    pub observer: Observer,
}

impl Tapped {
    pub fn new(wire: WireChoice) -> Result<Self> {
        let host = Namespace::isolated()?;
        let settings = WireTapSettings {
            wire,
            selection: Selection::new(&[], &[])?,
            ring_bytes: 8 << 20,
            record_ring_bytes: 1 << 20,
            reassembly: Limits::default(),
            zenoh_ports: vec![7447],
        };
        let tap = netns::within(&host.network(), || WireTap::open(&settings, 0, None))??;
        Ok(Self {
            host,
            tap,
            observer: Observer::new(Settings::default()),
        })
    }

    fn connect(&self, address: &str) -> Result<[TcpStream; 2]> {
        netns::within(&self.host.network(), || connect(address))?
    }

    /// Reads until this many batches were read, or for at most a minute.
    fn read(&mut self, batches: u64, at_sockets: Option<&Streams>) -> Result<u64> {
        self.read_within(Duration::from_secs(60), batches, at_sockets)
    }

    fn read_within(
        &mut self,
        limit: Duration,
        batches: u64,
        at_sockets: Option<&Streams>,
    ) -> Result<u64> {
        let deadline = Instant::now() + limit;
        while self.tap.streams().counters().batches < batches && Instant::now() < deadline {
            std::thread::sleep(Duration::from_millis(20));
            self.tap
                .poll(&Clocks::read(), at_sockets, &mut self.observer)?;
        }
        Ok(self.tap.streams().counters().batches)
    }

    pub fn frames(&self) -> u64 {
        self.tap.packets().map(|(_, packets)| packets).sum()
    }
}

#[test]
fn only_frames_of_zenoh_connections_pass_on_any_port() -> Result<()> {
    let addresses = ["127.0.0.1:0", "[::1]:0", "127.0.0.1:7447"];
    let cases = hooks().into_iter();
    for (wire, address) in cases.flat_map(|wire| addresses.map(|address| (wire, address))) {
        let mut tapped = Tapped::new(wire)?;
        let mut connection = tapped.connect(address)?;
        let sent = connections(LIFECYCLE)?.swap_remove(0);
        for (by_client, batch) in &sent {
            pass(&mut connection, *by_client, &with_prefix(batch))?;
        }
        let expected = sent.len() as u64;
        assert_eq!(tapped.read(expected, None)?, expected, "{address}");
        assert_eq!(tapped.tap.streams().counters().gaps, 0);
        let before = tapped.frames();
        let mut other = tapped.connect(address.replace("7447", "0").as_str())?;
        for part in random(3, 300_000).chunks(7000) {
            pass(&mut other, true, part)?;
        }
        tapped.read_within(Duration::from_secs(5), expected + 1, None)?;
        assert_eq!(tapped.frames(), before, "{address}");
    }
    Ok(())
}

#[test]
fn a_connection_older_than_the_tap_is_found_on_any_port() -> Result<()> {
    for wire in hooks() {
        let mut tapped = Tapped::new(wire)?;
        let mut connection = tapped.connect("127.0.0.1:0")?;
        let connections = connections(LIFECYCLE)?;
        let sent = connections.iter().max_by_key(|sent| sent.len()).unwrap();
        let steady: Vec<_> = sent.iter().filter(|(_, batch)| is_data(batch)).collect();
        for (by_client, batch) in &steady {
            pass(&mut connection, *by_client, &with_prefix(batch))?;
        }
        let read = tapped.read(steady.len() as u64 - 20, None)?;
        ensure!(
            read + 20 >= steady.len() as u64,
            "{read} of {}",
            steady.len()
        );
    }
    Ok(())
}

#[test]
fn a_connection_seen_at_the_sockets_is_not_reported_again_on_the_wire() -> Result<()> {
    for wire in hooks() {
        let mut tapped = Tapped::new(wire)?;
        let mut connection = tapped.connect("127.0.0.1:0")?;
        let [client, server] = [connection[0].local_addr()?, connection[1].local_addr()?];
        let place = |address: SocketAddr| Destination {
            address: address
                .ip()
                .to_string()
                .parse::<Ipv4Addr>()
                .unwrap()
                .to_ipv6_mapped()
                .octets(),
            port: address.port(),
        };
        let stream = StreamId {
            flow: Flow {
                source: place(client),
                destination: place(server),
            },
            socket: 1,
            ..StreamId::default()
        };
        let mut at_sockets = Streams::default();
        let init = with_prefix(INIT);
        let chunk = Chunk {
            time: Timestamp(1),
            stream,
            sequence_number: 1,
            syn: true,
            end: false,
            boundary: Some(Protocol::Zenoh),
            before: MissingBefore::Unknown,
            bytes: &init,
            length: init.len() as u32,
        };
        at_sockets.chunk(&chunk, |_| {});
        pass(&mut connection, true, &init)?;
        pass(&mut connection, false, &init)?;
        assert_eq!(tapped.read(1, Some(&at_sockets))?, 1, "the other direction");
        assert!(tapped.tap.streams().follows_flow(&stream.flow.reversed()));
        assert!(!tapped.tap.streams().follows_flow(&stream.flow));
    }
    Ok(())
}
