//! Datagrams dropped at a full socket buffer.

use super::*;

fn read_all(socket: &UdpSocket) -> FragmentNumbers {
    socket.set_nonblocking(true).unwrap();
    let mut buffer = vec![0; 65_536];
    let mut got = FragmentNumbers::new();
    while let Ok(len) = socket.recv(&mut buffer) {
        got.extend(samples(&buffer[..len]));
    }
    got
}

fn samples(payload: &[u8]) -> FragmentNumbers {
    let mut found = FragmentNumbers::new();
    walk::datagram(payload, &Envelope::default(), None, |each| {
        found.insert((each.record.sequence_number, each.record.fragment_start));
    });
    found
}

/// Returns a message with one DATA_FRAG: one fragment of `size` bytes.
fn fragment(talker: &Talker, number: u32, start: u32, size: u16) -> Vec<u8> {
    let mut bytes = talker.header();
    bytes.extend_from_slice(&[0x16, 1]);
    // The last submessage of a message may omit its length (RTPS 2.5, 9.4.5.1.3).
    bytes.extend_from_slice(&[0, 0, 0, 0, 28, 0, 0, 0, 0, 0]);
    bytes.extend_from_slice(&SAMPLES_WRITER);
    for word in [0, number, start] {
        bytes.extend_from_slice(&word.to_le_bytes());
    }
    bytes.extend_from_slice(&1_u16.to_le_bytes());
    bytes.extend_from_slice(&size.to_le_bytes());
    bytes.extend_from_slice(&(u32::from(size) * 4).to_le_bytes());
    bytes.resize(bytes.len() + usize::from(size), 0x33);
    bytes
}

/// Returns the receive buffer errors of a host, over IPv4 and over IPv6.
fn full_buffers(host: &Namespace) -> (u64, u64) {
    let read = |path: &str| std::fs::read_to_string(format!("/proc/thread-self/net/{path}"));
    let (v4, v6) = netns::within(&host.network(), || {
        (read("snmp").unwrap(), read("snmp6").unwrap())
    })
    .unwrap();
    let mut udp = v4.lines().filter_map(|line| line.strip_prefix("Udp: "));
    let names = udp.next().unwrap().split(' ');
    let mut values = names.zip(udp.next().unwrap().split(' '));
    let v4 = values.find(|(name, _)| *name == "RcvbufErrors").unwrap().1;
    let v6 = v6.lines().find(|line| line.starts_with("Udp6RcvbufErrors"));
    let v6 = v6.unwrap().split_whitespace().last().unwrap();
    (v4.parse().unwrap(), v6.parse().unwrap())
}

#[test]
fn only_datagrams_dropped_at_a_full_socket_are_reported() {
    let (mut observed, link, mut talker, writer) = observed_link(4, Verdict::Meter);
    let robot = link.robot.address();
    let monitor = link.monitor.address();
    for (from, to) in [
        (format!("{robot}:0"), format!("{monitor}:7411")),
        ("[fd99::1]:0".to_owned(), "[fd99::2]:7411".to_owned()),
    ] {
        let receiver = observed.socket(&link.monitor, &to);
        set(&receiver, libc::SO_RCVBUF, 32 * 1024);
        let mut sender = forged::Sender::new(&link.robot, &from, &to).unwrap();
        let before = full_buffers(&link.monitor);
        let mut sent = FragmentNumbers::new();
        // Half of the datagrams fit again.
        let mut got = FragmentNumbers::new();
        for round in 0..2 {
            for _ in 0..150 {
                let message = talker.sample(1_000 + 4 * round);
                sent.extend(samples(&message));
                sender.send(&message).unwrap();
            }
            std::thread::sleep(SETTLED);
            got.extend(read_all(&receiver));
        }
        let missing: FragmentNumbers = sent.difference(&got).copied().collect();
        assert!(
            missing.len() > 100 && got.len() > 20,
            "{} of {}",
            got.len(),
            sent.len()
        );
        let records = observed.records(writer, SETTLED);
        let (refused, seen): (Vec<_>, Vec<_>) = records
            .iter()
            .partition(|record| record.flags & flag::SOCKET_FULL != 0);
        assert_eq!(fragment_numbers(refused.iter().copied()), missing);
        assert_eq!(refused.len(), missing.len());
        assert_eq!(fragment_numbers(seen.iter().copied()), sent);
        for record in &refused {
            // Each loss cancels one arrival: the records are equal except for the flag.
            let arrival = Record {
                flags: record.flags & !flag::SOCKET_FULL,
                ..**record
            };
            assert!(seen.contains(&&arrival), "{record:?}");
            assert_eq!(record.socket, cookie(&receiver));
        }
        let after = full_buffers(&link.monitor);
        let errors = after.0 + after.1 - before.0 - before.1;
        assert_eq!(errors, missing.len() as u64);
        let socket = observed.filter.socket(cookie(&receiver)).unwrap().unwrap();
        assert_eq!(socket.rcvbuf_errors, errors);
        let owner = &observed.owners(cookie(&receiver))[&cookie(&receiver)];
        assert_eq!(owner.drops.map(u64::from), Some(errors));
    }
}

#[test]
fn full_sockets_are_reported_without_btf_if_every_socket_is_seen() {
    let settings = FilterSettings {
        kernel_types: false,
        ..FilterSettings::default()
    };
    let one_cgroup = Observed::with(&settings);
    let abilities = one_cgroup.filter.tracepoints().unwrap().abilities();
    let reason = abilities.socket_losses.clone().unwrap_err();
    assert!(
        reason.as_str().contains("limited to one cgroup"),
        "{reason}"
    );
    assert!(abilities.owners.is_err() && abilities.reassembly_losses.is_err());

    let mut filter = Filter::load_host(&settings).unwrap();
    let all = File::open(cgroup::hierarchy().unwrap()).unwrap();
    filter.attach(&all).unwrap();
    filter.attach_tracepoints(true);
    let (mut talker, writer) = talker(9);
    filter.set_interest(writer, Some(Verdict::Meter)).unwrap();
    let host = Namespace::isolated().unwrap();
    let receiver = one_cgroup.socket(&host, "127.0.0.1:7411");
    set(&receiver, libc::SO_RCVBUF, 32 * 1024);
    let mut sender = forged::Sender::new(&host, "127.0.0.1:0", "127.0.0.1:7411").unwrap();
    let mut sent = FragmentNumbers::new();
    for _ in 0..100 {
        let message = talker.sample(1_000);
        sent.extend(samples(&message));
        sender.send(&message).unwrap();
    }
    std::thread::sleep(SETTLED);
    let missing: FragmentNumbers = sent.difference(&read_all(&receiver)).copied().collect();
    assert!(!missing.is_empty() && missing.len() < sent.len());
    let records = std::iter::from_fn(|| filter.next_record());
    let refused: Vec<_> = records
        .filter(|record| record.writer() == writer && record.flags & flag::SOCKET_FULL != 0)
        .collect();
    assert_eq!(
        (fragment_numbers(&refused), refused.len()),
        (missing.clone(), missing.len())
    );
}

#[test]
fn only_the_full_one_of_two_sockets_in_a_group_is_reported() {
    let (mut observed, link, mut talker, writer) = observed_link(5, Verdict::Meter);
    let group = Ipv4Addr::new(239, 255, 0, 7);
    let join = |socket: &UdpSocket| {
        socket
            .join_multicast_v4(&group, &link.monitor.address())
            .unwrap();
    };
    let slow = observed.socket(&link.monitor, &format!("{group}:7411"));
    let quick = observed.socket(&link.monitor, &format!("{group}:7411"));
    set(&slow, libc::SO_RCVBUF, 32 * 1024);
    join(&slow);
    join(&quick);
    let from = format!("{}:0", link.robot.address());
    let mut sender = forged::Sender::new(&link.robot, &from, &format!("{group}:7411")).unwrap();
    let (mut sent, mut got) = (FragmentNumbers::new(), FragmentNumbers::new());
    for _ in 0..200 {
        let message = talker.sample(2_000);
        sent.extend(samples(&message));
        sender.send(&message).unwrap();
        std::thread::sleep(Duration::from_micros(200));
        got.extend(read_all(&quick));
    }
    std::thread::sleep(SETTLED);
    got.extend(read_all(&quick));
    assert_eq!(got, sent);
    let missing: FragmentNumbers = sent.difference(&read_all(&slow)).copied().collect();
    assert!(!missing.is_empty() && missing.len() < sent.len());
    let records = observed.records(writer, SETTLED);
    let refused: Vec<_> = records
        .iter()
        .filter(|record| record.flags & flag::SOCKET_FULL != 0)
        .collect();
    assert!(refused.iter().all(|record| record.socket == cookie(&slow)));
    assert_eq!(fragment_numbers(refused.iter().copied()), missing);
    assert_eq!(refused.len(), missing.len());
    let rcvbuf_errors = |socket| {
        observed
            .filter
            .socket(cookie(socket))
            .unwrap()
            .unwrap()
            .rcvbuf_errors
    };
    assert_eq!(
        (rcvbuf_errors(&slow), rcvbuf_errors(&quick)),
        (missing.len() as u64, 0)
    );
}

#[test]
fn lost_fragments_of_a_large_sample_are_reported() {
    let (mut observed, link, talker, writer) = observed_link(6, Verdict::Meter);
    let to = format!("{}:7411", link.monitor.address());
    let receiver = observed.socket(&link.monitor, &to);
    set(&receiver, libc::SO_RCVBUF, 200 * 1024);
    let from = format!("{}:0", link.robot.address());
    let mut sender = forged::Sender::new(&link.robot, &from, &to).unwrap();
    let mut sent = FragmentNumbers::new();
    for number in 1..=10 {
        for start in 1..=4 {
            let message = fragment(&talker, number, start, 60_000);
            sent.extend(samples(&message));
            sender.send(&message).unwrap();
        }
    }
    std::thread::sleep(SETTLED);
    let missing: FragmentNumbers = sent.difference(&read_all(&receiver)).copied().collect();
    assert!(
        !missing.is_empty() && missing.len() < sent.len(),
        "{missing:?}"
    );
    let records = observed.records(writer, SETTLED);
    let refused = || {
        let refused = |record: &&Record| record.flags & flag::SOCKET_FULL != 0;
        records.iter().filter(refused)
    };
    assert_eq!(
        (fragment_numbers(refused()), refused().count()),
        (missing.clone(), missing.len())
    );
    assert!(refused().all(|record| record.kind == kind::DATA_FRAG));
    assert!(refused().all(|record| record.payload_len == 60_000));
}

#[test]
fn a_captured_datagram_dropped_at_a_full_socket_is_reported_by_its_token() {
    let (mut observed, link, mut talker, _) = observed_link(7, Verdict::Capture);
    let to = format!("{}:7411", link.monitor.address());
    let receiver = observed.socket(&link.monitor, &to);
    set(&receiver, libc::SO_RCVBUF, 32 * 1024);
    let from = format!("{}:0", link.robot.address());
    let mut sender = forged::Sender::new(&link.robot, &from, &to).unwrap();
    let mut sent = FragmentNumbers::new();
    for _ in 0..150 {
        let message = talker.sample(2_000);
        sent.extend(samples(&message));
        sender.send(&message).unwrap();
    }
    std::thread::sleep(SETTLED);
    let missing: FragmentNumbers = sent.difference(&read_all(&receiver)).copied().collect();
    assert!(!missing.is_empty() && missing.len() < sent.len());
    let mut captured = BTreeMap::new();
    while let Some(piece) = observed.filter.next_piece() {
        let (piece, bytes) = piece.read().unwrap();
        captured.insert((piece.datagram, piece.socket), samples(bytes));
    }
    assert_eq!(captured.len(), sent.len());
    let mut refused = FragmentNumbers::new();
    while let Some(record) = observed.filter.next_record() {
        if record.socket == cookie(&receiver) {
            assert_eq!(record.kind, kind::UNDELIVERED);
            refused.extend(&captured[&(record.datagram, record.socket)]);
        }
    }
    assert_eq!(refused, missing);
}

/// Samples by writer.
type Sent = BTreeSet<(Guid, u64)>;

/// Sends this many samples of each talker from a separate thread, with noise to port 7500 between
/// them. Returns what was sent, and what the receiver read while it was sent.
fn send_at_once(
    host: &Namespace,
    receiver: &UdpSocket,
    talkers: [(forged::Talker, Guid); 2],
    count: usize,
) -> (Sent, Sent) {
    let (mut sent, mut got) = (Sent::new(), Sent::new());
    std::thread::scope(|scope| {
        let path = host.network();
        let mut writers = Vec::new();
        for (mut talker, writer) in talkers {
            let noise = netns::within(&path, || UdpSocket::bind("127.0.0.1:0").unwrap()).unwrap();
            let mut sender = forged::Sender::new(host, "127.0.0.1:0", "127.0.0.1:7411").unwrap();
            writers.push(scope.spawn(move || {
                let mut sent = Sent::new();
                for _ in 0..count {
                    noise.send_to(&[7; 500], "127.0.0.1:7500").unwrap();
                    let message = talker.sample(1_000);
                    sent.extend(
                        samples(&message)
                            .iter()
                            .map(|(number, _)| (writer, *number)),
                    );
                    sender.send(&message).unwrap();
                }
                sent
            }));
        }
        let mut buffer = vec![0; 65_536];
        let mut read = || {
            while let Ok(len) = receiver.recv(&mut buffer) {
                walk::datagram(&buffer[..len], &Envelope::default(), None, |each| {
                    got.insert((each.record.writer(), each.record.sequence_number));
                });
            }
        };
        receiver.set_nonblocking(true).unwrap();
        while !writers
            .iter()
            .all(std::thread::ScopedJoinHandle::is_finished)
        {
            read();
            std::thread::sleep(Duration::from_millis(1));
        }
        std::thread::sleep(SETTLED);
        read();
        for writer in writers {
            sent.extend(writer.join().unwrap());
        }
    });
    (sent, got)
}

#[test]
fn losses_from_several_cpus_are_not_mixed_with_those_of_other_sockets() {
    const SAMPLES: usize = 2_000;
    let mut observed = Observed::with(&FilterSettings {
        record_ring_bytes: 8 << 20,
        ..FilterSettings::default()
    });
    let host = Namespace::isolated().unwrap();
    let receiver = observed.socket(&host, "127.0.0.1:7411");
    let other = observed.socket(&host, "127.0.0.1:7500");
    for socket in [&receiver, &other] {
        set(socket, libc::SO_RCVBUF, 32 * 1024);
    }
    let talkers = [talker(10), talker(11)];
    for (_, writer) in &talkers {
        let verdict = Some(Verdict::Meter);
        observed.filter.set_interest(*writer, verdict).unwrap();
    }
    let (sent, got) = send_at_once(&host, &receiver, talkers, SAMPLES);
    assert_eq!(sent.len(), 2 * SAMPLES);
    let missing: BTreeSet<_> = sent.difference(&got).copied().collect();
    assert!(missing.len() > 100 && got.len() > 100, "{}", missing.len());
    let mut refused = Vec::new();
    let mut arrived = 0;
    while let Some(record) = observed.filter.next_record() {
        if record.socket != cookie(&receiver) {
            continue;
        }
        if record.flags & flag::SOCKET_FULL == 0 {
            arrived += 1;
        } else {
            refused.push((record.writer(), record.sequence_number));
        }
    }
    assert_eq!(observed.counted(Counter::RecordsLost), 0);
    assert_eq!(arrived, sent.len());
    assert_eq!(refused.len(), missing.len());
    assert_eq!(refused.into_iter().collect::<BTreeSet<_>>(), missing);
    let (errors, _) = full_buffers(&host);
    let others = observed.owners(cookie(&other))[&cookie(&other)]
        .drops
        .unwrap();
    assert_eq!(errors, missing.len() as u64 + u64::from(others));
}
