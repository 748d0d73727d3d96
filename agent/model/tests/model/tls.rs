//! TCP connections that are encrypted with TLS.

use std::net::SocketAddr;

use ros2probe_model::facts::tables::ClientHellos;
use ros2probe_model::graph::zenoh::Flow;
use ros2probe_model::observe::input::Input;
use ros2probe_testing::model::forge::{self, Message};
use ros2probe_testing::model::host::{BOB, Host};
use ros2probe_wire::EntityId;

const SPDP: EntityId = EntityId([0, 1, 0, 0xc2]);

/// Passes the hello of a client with this port, and waits until connections are counted.
fn hello(host: &mut Host, from: u16, to: &str) -> u64 {
    let to: SocketAddr = to.parse().unwrap();
    let source = SocketAddr::new([10, 0, 0, 9].into(), from);
    host.observer.input(Input::ClientHello(Flow {
        source: source.into(),
        destination: to.into(),
    }));
    host.wait(1000);
    host.snapshot().tls_connections
}

fn announce(host: &mut Host) {
    let payload = forge::participant_by_tcp(BOB, "10.0.0.2:5100".parse().unwrap());
    host.announce(Message::from_fast(BOB).data(SPDP, 1, &payload));
    host.wait(1000);
}

#[test]
fn connections_to_announced_addresses_count_once_and_others_never() {
    let mut host = Host::new();
    announce(&mut host);
    assert_eq!(hello(&mut host, 1, "10.0.0.2:5100"), 1);
    // Both ends of the connection report it, and TCP repeats the segment.
    assert_eq!(hello(&mut host, 1, "10.0.0.2:5100"), 1);
    for other in ["10.0.0.2:5101", "10.0.0.3:5100", "10.0.0.2:7411"] {
        assert_eq!(hello(&mut host, 2, other), 1, "{other}");
    }
    // Fast DDS reaches participants of its host by loopback.
    assert_eq!(hello(&mut host, 2, "127.0.0.1:5100"), 2);
}

#[test]
fn an_announcement_may_follow_the_connection() {
    let mut host = Host::new();
    assert_eq!(hello(&mut host, 1, "10.0.0.2:5100"), 0);
    announce(&mut host);
    assert_eq!(host.snapshot().tls_connections, 1);
    // After more than a minute, the connection is forgotten.
    let mut host = Host::new();
    hello(&mut host, 1, "10.0.0.2:5100");
    host.wait(61_000);
    announce(&mut host);
    assert_eq!(host.snapshot().tls_connections, 0);
}

#[test]
fn hellos_beyond_the_cap_do_not_count() {
    let mut host = Host::new();
    let to: SocketAddr = "10.0.0.2:5100".parse().unwrap();
    for from in 0..ClientHellos::CAP as u16 + 10 {
        let source = SocketAddr::new([10, 0, 0, 9].into(), from);
        host.observer.input(Input::ClientHello(Flow {
            source: source.into(),
            destination: to.into(),
        }));
    }
    announce(&mut host);
    let snapshot = host.snapshot();
    assert_eq!(snapshot.tls_connections, ClientHellos::CAP as u64);
    let mut tables = snapshot.tables.iter();
    let table = tables.find(|table| table.table == "client_hellos").unwrap();
    assert_eq!(table.evictions, 10);
}
