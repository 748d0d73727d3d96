//! Datagrams whose reassembly the kernel gives up.

use super::*;

/// Sets a host's reassembly timeout to a second.
fn shorten_reassembly_timeout(host: &Namespace) {
    netns::within(&host.network(), || {
        for path in ["ipv4/ipfrag_time", "ipv6/ip6frag_time"] {
            std::fs::write(format!("/proc/sys/net/{path}"), "1").unwrap();
        }
    })
    .unwrap();
}

/// Returns a link on which datagrams arrive: their fragments need no time of the reassembly
/// timeout to resolve the address.
fn ready_link() -> Link {
    let link = Link::new().unwrap();
    let of = |host: &Namespace| host.address().to_string();
    wait_for_link(&link, &of(&link.robot), &of(&link.monitor));
    link
}

#[test]
fn a_datagram_without_its_last_fragment_is_reported() {
    let mut observed = Observed::new();
    let link = ready_link();
    shorten_reassembly_timeout(&link.monitor);
    let (mut talker, writer) = talker(1);
    observed
        .filter
        .set_interest(writer, Some(Verdict::Meter))
        .unwrap();
    let mut wire = Wire::new(&link.robot, &link.monitor, INTERFACE).unwrap();
    let before = observed.counted(Counter::NotReassembled);
    wire.send(&talker.sample(30_000)).unwrap();
    wire.shuffle = |packets| drop(packets.pop());
    for _ in 2..=4 {
        wire.send(&talker.sample(30_000)).unwrap();
    }
    wire.shuffle = |packets| drop(packets.remove(3));
    wire.send(&talker.sample(5_000)).unwrap();
    wire.shuffle = |_| {};
    wire.send(&talker.sample(30_000)).unwrap();
    let found = observed.records_of_lost(writer, 4);
    let mut numbers: Vec<_> = found.iter().map(|record| record.sequence_number).collect();
    numbers.sort_unstable();
    assert_eq!(numbers, [2, 3, 4, 5]);
    for record in found {
        assert_eq!(record.kind, kind::DATA);
        assert_eq!(
            record.flags & !flag::STAMP,
            flag::FRAGMENTED | flag::NOT_REASSEMBLED
        );
        assert_eq!(record.destination_port, forged::DISCOVERY_PORT);
        let destination: [u8; 16] = zerocopy::transmute!(record.destination);
        assert_eq!(destination[12..], link.monitor.address().octets());
        assert_eq!(record.socket, 0);
        let payload = if record.sequence_number == 5 {
            5_000
        } else {
            30_000
        };
        assert_eq!(record.payload_len, payload);
    }
    assert!(observed.counted(Counter::NotReassembled) >= before + 4);
}

#[test]
fn a_datagram_without_its_first_fragment_is_counted_but_not_identified() {
    let mut observed = Observed::new();
    let link = ready_link();
    shorten_reassembly_timeout(&link.monitor);
    let (mut talker, writer) = talker(2);
    observed
        .filter
        .set_interest(writer, Some(Verdict::Meter))
        .unwrap();
    let mut wire = Wire::new(&link.robot, &link.monitor, INTERFACE).unwrap();
    let before = observed.counted(Counter::NotReassembledUnnamed);
    wire.shuffle = |packets| drop(packets.remove(0));
    for _ in 0..5 {
        wire.send(&talker.sample(30_000)).unwrap();
    }
    let begun = Instant::now();
    let unnamed = |observed: &Observed| observed.counted(Counter::NotReassembledUnnamed) - before;
    let mut found = Vec::new();
    while unnamed(&observed) < 5 && begun.elapsed() < PATIENCE {
        found.extend(observed.records(writer, Duration::from_millis(50)));
    }
    found.extend(observed.records(writer, SETTLED));
    assert_eq!(found, []);
    // Parallel tests may lose datagrams at the same time, but not one per fragment.
    let unnamed = unnamed(&observed);
    assert!((5..100).contains(&unnamed), "{unnamed}");
}

#[test]
fn a_datagram_with_fragments_too_far_apart_is_reported_when_given_up() {
    static HELD_DATAGRAMS: Mutex<Vec<Vec<u8>>> = Mutex::new(Vec::new());
    let mut observed = Observed::new();
    let link = ready_link();
    shorten_reassembly_timeout(&link.monitor);
    let limit = || std::fs::write("/proc/sys/net/ipv4/ipfrag_max_dist", "2").unwrap();
    netns::within(&link.monitor.network(), limit).unwrap();
    let (mut talker, writer) = talker(8);
    observed
        .filter
        .set_interest(writer, Some(Verdict::Meter))
        .unwrap();
    let mut wire = Wire::new(&link.robot, &link.monitor, INTERFACE).unwrap();
    let begun = Instant::now();
    wire.shuffle = |packets| *HELD_DATAGRAMS.lock().unwrap() = packets.split_off(2);
    wire.send(&talker.sample(20_000)).unwrap();
    wire.shuffle = |packets| packets.truncate(1);
    for _ in 2..=6 {
        wire.send(&talker.sample(20_000)).unwrap();
    }
    wire.shuffle = |packets| *packets = HELD_DATAGRAMS.lock().unwrap().drain(..).collect();
    wire.send(&talker.sample(20_000)).unwrap();
    let at_once = observed.records(writer, SETTLED);
    // On a busy machine, others may have reached their timeout by now.
    if begun.elapsed() < Duration::from_millis(900) {
        assert_eq!(fragment_numbers(&at_once), FragmentNumbers::from([(1, 0)]));
    }
    let missing = 6_usize.saturating_sub(at_once.len());
    let later = observed.records_of_lost(writer, missing);
    let all = at_once.iter().chain(&later);
    assert_eq!(
        fragment_numbers(all),
        (1..=6).map(|number| (number, 0)).collect()
    );
    assert_eq!(at_once.len() + later.len(), 6);
}

#[test]
fn fragments_dropped_for_lack_of_memory_are_reported_immediately() {
    let (mut observed, link, mut talker, writer) = observed_link(12, Verdict::Meter);
    let monitor = link.monitor.address();
    for (family, from, to) in [
        (
            "ipv4/ipfrag",
            format!("{}:0", link.robot.address()),
            format!("{monitor}:7411"),
        ),
        (
            "ipv6/ip6frag",
            "[fd99::1]:0".to_owned(),
            "[fd99::2]:7411".to_owned(),
        ),
    ] {
        let _receiver = observed.socket(&link.monitor, &to);
        let mut sender = forged::Sender::new(&link.robot, &from, &to).unwrap();
        // Half of the first datagram uses up the limit, and keeps it.
        let limit = |bytes: &str| {
            std::fs::write(format!("/proc/sys/net/{family}_low_thresh"), "1").unwrap();
            std::fs::write(format!("/proc/sys/net/{family}_high_thresh"), bytes).unwrap();
        };
        netns::within(&link.monitor.network(), || limit("40000")).unwrap();
        let some = talker.sent() + 1;
        for _ in 0..5 {
            sender.send(&talker.sample(60_000)).unwrap();
            std::thread::sleep(Duration::from_millis(5));
        }
        let found = observed.records_of_lost(writer, 4);
        let lost: Vec<_> = found
            .iter()
            .filter(|record| record.flags & flag::NOT_REASSEMBLED != 0)
            .collect();
        // The first datagram waits; the others did not fit.
        let expected: FragmentNumbers = (some + 1..some + 5)
            .map(|number| (number.into(), 0))
            .collect();
        assert_eq!(
            (fragment_numbers(lost.iter().copied()), lost.len()),
            (expected, 4),
            "{family}"
        );
        netns::within(&link.monitor.network(), || limit("4000000")).unwrap();
    }
}

#[test]
fn an_incomplete_datagram_over_ipv6_or_multicast_is_reported() {
    let group = Ipv4Addr::new(239, 255, 0, 8);
    let (mut observed, link, mut talker, writer) = observed_link(3, Verdict::Meter);
    shorten_reassembly_timeout(&link.monitor);
    let last_v6 = "meta protocol ip6 frag more-fragments 0 frag frag-off > 0";
    let last_v4 = "ip frag-off & 0x2000 == 0 ip frag-off & 0x1fff != 0";
    let ways = [
        (
            "[fd99::1]:0".to_owned(),
            "[fd99::2]:7411".to_owned(),
            last_v6,
            flag::IPV6,
        ),
        (
            format!("{}:0", link.robot.address()),
            format!("{group}:7411"),
            last_v4,
            0,
        ),
    ];
    for (from, to, last_fragment, family) in ways {
        let receiver = observed.socket(&link.monitor, &to);
        if family == 0 {
            receiver
                .join_multicast_v4(&group, &link.monitor.address())
                .unwrap();
        }
        let mut sender = forged::Sender::new(&link.robot, &from, &to).unwrap();
        let lossy = Loss::of(&link.robot, last_fragment, 1000).unwrap();
        let before = talker.sent();
        for _ in 0..3 {
            sender.send(&talker.sample(60_000)).unwrap();
        }
        drop(lossy);
        sender.send(&talker.sample(60_000)).unwrap();
        let mut found = observed.records_of_lost(writer, 3);
        found.retain(|record| record.flags & flag::NOT_REASSEMBLED != 0);
        let expected: FragmentNumbers = (before + 1..before + 4)
            .map(|number| (number.into(), 0))
            .collect();
        assert_eq!(
            (fragment_numbers(&found), found.len()),
            (expected, 3),
            "{to}"
        );
        for record in found {
            let flags = flag::FRAGMENTED | flag::NOT_REASSEMBLED | family;
            assert_eq!(record.flags & !flag::STAMP, flags);
            let destination: [u8; 16] = zerocopy::transmute!(record.destination);
            let to: SocketAddr = to.parse().unwrap();
            let expected = match to.ip() {
                IpAddr::V4(address) => address.to_ipv6_mapped(),
                IpAddr::V6(address) => address,
            };
            assert_eq!(destination, expected.octets());
            assert_eq!(record.payload_len, 60_000);
        }
    }
}
