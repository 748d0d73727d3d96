//! Live tests in separate network namespaces. They need root.

use std::net::UdpSocket;
use std::time::Instant;

use ros2probe_wire::filter::Counter;
use ros2probe_wire::frame::{self, PacketType, Payload};
use rustix::thread::{CapabilitySet, capabilities, set_capabilities};

use super::*;
use crate::filter::{Filter, FilterSettings};
use crate::netns::tests::{in_new_namespace, ip};
use crate::reassembly::{FlowKey, Limits, Reassembly};

const SMALL: Settings = Settings {
    block_size: 16 << 10,
    blocks: 4,
    retire: Duration::from_millis(10),
};

/// Timeout of a test; generous for a busy machine.
const PATIENCE: Duration = Duration::from_secs(20);

/// UDP payloads, by interface.
type Payloads = Vec<(u32, Vec<u8>)>;

/// Collects UDP payloads of frames that this host sends until `done` accepts them.
fn sent_until(ring: &mut Ring, done: impl Fn(&Payloads) -> bool) -> Payloads {
    let mut payloads = Payloads::new();
    let start = Instant::now();
    while !done(&payloads) && start.elapsed() < PATIENCE {
        ring.wait(Duration::from_millis(20)).unwrap();
        payloads.extend(ready(ring));
    }
    payloads
}

/// Collects UDP payloads of frames that this host sends during `patience`.
fn sent(ring: &mut Ring, patience: Duration) -> Payloads {
    let mut payloads = Payloads::new();
    let start = Instant::now();
    while start.elapsed() < patience {
        ring.wait(Duration::from_millis(20)).unwrap();
        payloads.extend(ready(ring));
    }
    payloads
}

/// Returns UDP payloads of frames that this host sends, in released blocks.
fn ready(ring: &mut Ring) -> Payloads {
    let mut payloads = Payloads::new();
    while let Some(block) = ring.block() {
        let mut frames = block.frames();
        for frame in frames.by_ref() {
            let packet =
                frame::parse_cooked(frame.protocol, frame.packet_type, frame.bytes, frame.length);
            if let Ok(Some(packet)) = packet
                && frame.packet_type == PacketType::OUTGOING
                && let Payload::Datagram(datagram) = packet.payload
            {
                payloads.push((frame.interface, datagram.payload.to_vec()));
            }
        }
        assert!(!frames.damaged());
    }
    payloads
}

/// Loads a socket filter that returns `keep`.
fn filter(keep: i32) -> OwnedFd {
    #[repr(C)]
    #[derive(Default)]
    struct Load {
        kind: u32,
        count: u32,
        instructions: u64,
        license: u64,
        rest: [u64; 13],
    }
    let constant = u64::from(keep.cast_unsigned()) << 32 | 0xb7;
    let program = [constant, 0x95];
    let load = Load {
        kind: 1,
        count: 2,
        instructions: program.as_ptr() as u64,
        license: c"GPL".as_ptr() as u64,
        ..Load::default()
    };
    // SAFETY: BPF_PROG_LOAD with a zero-padded attribute whose pointers outlive the call.
    let fd = unsafe { libc::syscall(libc::SYS_bpf, 5, &raw const load, size_of::<Load>()) };
    assert!(fd >= 0, "{}", io::Error::last_os_error());
    // SAFETY: the descriptor is new and has no other owner.
    unsafe { OwnedFd::from_raw_fd(i32::try_from(fd).unwrap()) }
}

#[test]
fn the_kernel_filter_fits_the_option_memory_of_a_socket_up_to_linux_6_7() {
    in_new_namespace(|| {
        // Since Linux 6.8, each network namespace has its own value, 128 KB. Before, the host's
        // value applies.
        let _ = std::fs::write("/proc/sys/net/core/optmem_max", "20480");
        let filter = Filter::load(&FilterSettings::default()).unwrap();
        let ring = Ring::open(SMALL, Some(filter.program())).unwrap();
        let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
        socket.send_to(b"RTPS", "127.0.0.1:7400").unwrap();
        let counters = filter.counters().unwrap();
        let looked_at = |frames: &(Counter, u64)| *frames == (Counter::Frames, 1);
        assert!(counters.iter().any(looked_at), "{counters:?}");
        drop(ring);
    });
}

#[test]
fn frames_on_loopback_arrive_with_kernel_time_and_direction() {
    in_new_namespace(|| {
        let mut ring = Ring::open(SMALL, None).unwrap();
        let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
        let now = || std::time::UNIX_EPOCH.elapsed().unwrap().as_nanos();
        let before = now();
        socket.send_to(b"RTPS", "127.0.0.1:7400").unwrap();
        let after = now();
        assert!(ring.wait(PATIENCE).unwrap());
        let block = ring.block().unwrap();
        let frames: Vec<_> = block
            .frames()
            .filter(|frame| frame.bytes.get(9) == Some(&17))
            .collect();
        // Loopback shows each frame twice: sent, then received.
        assert_eq!(frames.len(), 2);
        assert_eq!(
            [frames[0].packet_type, frames[1].packet_type],
            [PacketType::OUTGOING, PacketType::HOST]
        );
        for frame in &frames {
            let expected = (0x0800, 32, 1, None);
            assert_eq!(
                (frame.protocol, frame.length, frame.interface, frame.vlan),
                expected
            );
            assert!(frame.bytes.ends_with(b"RTPS"));
            let time = u128::from(frame.time.0);
            assert!(
                time >= before && time <= after + 1_000_000_000,
                "{before} {time} {after}"
            );
        }
    });
}

#[test]
fn a_ring_that_wraps_many_times_loses_no_frame() {
    in_new_namespace(|| {
        let mut ring = Ring::open(SMALL, None).unwrap();
        let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
        let mut seen = Payloads::new();
        // 4 blocks hold about 60 frames; 3000 packets with two copies each fill them 100 times. On
        // a busy machine each block may be closed with two frames, so available frames are read
        // first.
        for number in 0..3000_u32 {
            let mut payload = [0; 800];
            payload[..4].copy_from_slice(&number.to_be_bytes());
            socket.send_to(&payload, "127.0.0.1:7400").unwrap();
            seen.extend(ready(&mut ring));
        }
        let left = 3000 - seen.len();
        seen.extend(sent_until(&mut ring, |payloads| payloads.len() >= left));
        let numbers = seen.iter().map(|(_, payload)| payload.first_chunk());
        let numbers: Vec<u32> = numbers
            .map(|bytes| u32::from_be_bytes(*bytes.unwrap()))
            .collect();
        // Not `assert_eq`: two lists of 3000 numbers are unreadable.
        assert!(
            numbers.iter().copied().eq(0..3000),
            "{:?}",
            &numbers[..200.min(numbers.len())]
        );
        let statistics = ring.statistics().unwrap();
        assert_eq!(statistics.drops, 0);
        assert!(statistics.packets >= 6000);
    });
}

#[test]
fn a_request_for_a_block_that_is_not_ready_changes_nothing() {
    in_new_namespace(|| {
        let mut ring = Ring::open(SMALL, None).unwrap();
        for _ in 0..7 {
            assert!(ring.block().is_none());
        }
        assert_eq!(ring.turns.next(), 0);
        assert!(!ring.wait(Duration::from_millis(1)).unwrap());
        let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
        socket.send_to(b"RTPS", "127.0.0.1:7400").unwrap();
        let seen = sent_until(&mut ring, |payloads| !payloads.is_empty());
        assert_eq!(seen, [(1, b"RTPS".to_vec())]);
        assert_eq!(ring.turns.next(), 1);
    });
}

#[test]
fn frames_that_a_slow_reader_misses_are_counted_once() {
    in_new_namespace(|| {
        let mut ring = Ring::open(SMALL, None).unwrap();
        let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
        for _ in 0..500 {
            socket.send_to(&[7; 1000], "127.0.0.1:7400").unwrap();
        }
        let first = ring.statistics().unwrap();
        assert!(first.drops > 800 && first.freezes >= 1, "{first:?}");
        // The kernel resets its counters on each read, the ring does not.
        assert_eq!(ring.statistics().unwrap(), first);
        let kept = sent(&mut ring, Duration::from_millis(100)).len();
        assert!(kept > 10, "{kept}");
        // The kernel has the blocks back, and can store frames again.
        socket.send_to(b"again", "127.0.0.1:7400").unwrap();
        sent_until(&mut ring, |payloads| {
            payloads
                .last()
                .is_some_and(|(_, payload)| payload == b"again")
        });
        assert_eq!(ring.statistics().unwrap().drops, first.drops);
    });
}

#[test]
fn a_truncating_filter_keeps_the_original_length_of_frames() {
    in_new_namespace(|| {
        let program = filter(28);
        let mut ring = Ring::open(SMALL, Some(program.as_fd())).unwrap();
        let nothing = filter(0);
        let mut silent = Ring::open(SMALL, Some(nothing.as_fd())).unwrap();
        let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
        socket.send_to(&[1; 5000], "127.0.0.1:7400").unwrap();
        assert!(ring.wait(PATIENCE).unwrap());
        let block = ring.block().unwrap();
        let frame = block.frames().next().unwrap();
        assert_eq!((frame.bytes.len(), frame.length), (28, 5028));
        assert_eq!(silent.statistics().unwrap().packets, 0);
    });
}

#[test]
fn an_interface_that_appears_later_is_seen() {
    in_new_namespace(|| {
        let mut ring = Ring::open(SMALL, None).unwrap();
        ip("link add later type veth peer name far");
        ip("address add 10.99.0.1/24 dev later");
        ip("link set later up");
        ip("link set far up");
        let socket = UdpSocket::bind("10.99.0.1:0").unwrap();
        ip("neighbour add 10.99.0.2 lladdr 02:00:00:00:00:02 dev later");
        // A link needs a moment until it is up.
        let hello = (0..400).find_map(|_| {
            socket.send_to(b"hello", "10.99.0.2:7400").unwrap();
            let seen = sent(&mut ring, Duration::from_millis(50));
            seen.into_iter().find(|(_, payload)| payload == b"hello")
        });
        assert_ne!(hello.unwrap().0, 1);
    });
}

#[test]
fn a_link_that_goes_down_does_not_make_the_reader_spin() {
    in_new_namespace(|| {
        ip("link add gone type veth peer name far");
        ip("link set gone up");
        ip("link set far up");
        // SAFETY: the argument is a terminated string.
        let index = unsafe { libc::if_nametoindex(c"gone".as_ptr()) };
        let index = i32::try_from(index).unwrap();
        // The kernel reports only to sockets bound to the interface. The agent's sockets are not
        // bound, and must not spin either.
        let mut bound = Ring::open_on(SMALL, None, index).unwrap();
        let mut unbound = Ring::open(SMALL, None).unwrap();
        sent(&mut bound, Duration::from_millis(50));
        sent(&mut unbound, Duration::from_millis(50));
        ip("link set gone down");
        ip("link delete gone");
        for (ring, errors) in [(&mut bound, 1..=2), (&mut unbound, 0..=0)] {
            let start = Instant::now();
            let mut rounds = 0;
            while start.elapsed() < Duration::from_millis(300) {
                ring.wait(Duration::from_millis(50)).unwrap();
                while let Some(block) = ring.block() {
                    drop(block);
                }
                rounds += 1;
            }
            assert!(rounds < 40, "{rounds} rounds in 300 ms");
            let statistics = ring.statistics().unwrap();
            assert!(errors.contains(&statistics.socket_errors), "{statistics:?}");
        }
    });
}

#[test]
fn impossible_sizes_are_refused() {
    for (block_size, blocks) in [
        (4096, 0),
        (usize::MAX, 2),
        (1 << 20, usize::MAX),
        (1 << 29, 3),
    ] {
        let settings = Settings {
            block_size,
            blocks,
            ..SMALL
        };
        assert!(matches!(
            Ring::open(settings, None),
            Err(RingError::Size { .. })
        ));
    }
}

#[test]
fn blocks_have_whole_pages_for_every_page_size() {
    for page in [4096, 16_384, 65_536] {
        for (wanted, given) in [(1, page), (page + 1, 2 * page), (BLOCK_BYTES, BLOCK_BYTES)] {
            let settings = Settings {
                block_size: wanted,
                ..SMALL
            };
            let (request, block_size) = request(settings, page).unwrap();
            assert_eq!(block_size, given, "{wanted} bytes in pages of {page}");
            // packet_set_ring() has these requirements.
            let (size, frame) = (request.tp_block_size, request.tp_frame_size);
            assert_eq!(size as usize, block_size);
            assert!(frame > 0 && frame % libc::TPACKET_ALIGNMENT as u32 == 0);
            assert_eq!(size / frame * request.tp_block_nr, request.tp_frame_nr);
        }
    }
}

#[test]
fn a_ring_of_any_memory_size_fits_the_largest_frames() {
    assert_eq!(Settings::with_memory(4 << 20), Settings::default());
    for (memory, block_size, blocks) in [
        (0, 128 << 10, 2),
        (300_000, 128 << 10, 2),
        (1 << 20, 128 << 10, 8),
        (16 << 20, 128 << 10, 128),
    ] {
        let settings = Settings::with_memory(memory);
        assert_eq!((settings.block_size, settings.blocks), (block_size, blocks));
        assert!(page_bytes().is_some_and(|page| request(settings, page).is_some()));
    }
    in_new_namespace(|| {
        let mut ring = Ring::open(Settings::with_memory(0), None).unwrap();
        let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
        socket.send_to(&[5; 65_507], "127.0.0.1:7400").unwrap();
        let seen = sent_until(&mut ring, |payloads| !payloads.is_empty());
        assert_eq!(seen, [(1, vec![5; 65_507])]);
    });
}

#[test]
fn fragments_from_the_ring_become_datagrams_in_both_ip_versions() {
    in_new_namespace(|| {
        ip("link set lo mtu 1500");
        let mut ring = Ring::open(Settings::default(), None).unwrap();
        let mut reassembly = Reassembly::new(Limits::default());
        let payload: Vec<u8> = (0..60_000_u32)
            .map(|at| at.to_le_bytes()[(at % 3) as usize])
            .collect();
        for (from, to) in [("127.0.0.1:0", "127.0.0.1:7400"), ("[::1]:0", "[::1]:7400")] {
            let socket = UdpSocket::bind(from).unwrap();
            socket.send_to(&payload, to).unwrap();
        }
        let mut seen = Vec::new();
        while seen.len() < 4 && ring.wait(PATIENCE).unwrap() {
            while let Some(block) = ring.block() {
                for frame in block.frames() {
                    let outgoing = frame.packet_type == PacketType::OUTGOING;
                    let packet = frame::parse_cooked(
                        frame.protocol,
                        frame.packet_type,
                        frame.bytes,
                        frame.length,
                    );
                    let Some(packet) = packet.unwrap() else {
                        continue;
                    };
                    let Payload::Fragment(part) = packet.payload else {
                        continue;
                    };
                    let key = FlowKey::new(0, frame.interface, outgoing, &packet, &part);
                    if let Some(done) = reassembly.fragment(frame.time, key, &part) {
                        assert_eq!(done.payload(), payload);
                        assert_eq!(done.destination_port, 7400);
                        seen.push((packet.source.starts_with(&[0; 15]), outgoing));
                    }
                }
            }
        }
        seen.sort_unstable();
        assert_eq!(
            seen,
            [(false, false), (false, true), (true, false), (true, true)]
        );
        assert_eq!(
            (reassembly.flows(), reassembly.counters().completed),
            (0, 4)
        );
    });
}

#[test]
fn a_missing_capability_is_named_in_the_error() {
    let thread = std::thread::spawn(|| {
        let mut sets = capabilities(None).unwrap();
        sets.effective = CapabilitySet::empty();
        if set_capabilities(None, sets).is_err() {
            return None;
        }
        Some(Ring::open(SMALL, None).unwrap_err())
    });
    if let Some(error) = thread.join().unwrap() {
        assert!(matches!(error, RingError::NotPermitted { .. }), "{error:?}");
        assert!(error.to_string().contains("CAP_NET_RAW"), "{error}");
    }
}
