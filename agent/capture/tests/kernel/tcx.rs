//! The programs at tcx on real interfaces: they count what a packet socket counts, change no packet,
//! stand beside others, and leave nothing behind. The tests need root, and Linux 6.6.

use std::collections::BTreeMap;
use std::io::{Read as _, Write as _};
use std::net::{Ipv4Addr, TcpListener, TcpStream, UdpSocket};
use std::os::fd::{AsFd as _, AsRawFd as _, FromRawFd as _, OwnedFd};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, ensure};
use ros2probe_capture::filter::{Filter, FilterSettings};
use ros2probe_capture::interfaces::Selection;
use ros2probe_capture::netns;
use ros2probe_capture::reassembly::Limits;
use ros2probe_capture::settings::WireChoice;
use ros2probe_capture::system::Clocks;
use ros2probe_capture::tcx::{self, Tcx, TcxError};
use ros2probe_capture::wire_tap::{WireTap, WireTapSettings};
use ros2probe_model::observe::observer::{Observer, Settings};
use ros2probe_testing::harness::network::{INTERFACE, Link, Namespace};
use ros2probe_testing::harness::run;
use ros2probe_testing::harness::tcx::{attached, interface_index, wait_attached};
use ros2probe_testing::program_run;
use ros2probe_wire::filter::Counter;
use ros2probe_wire::record::Verdict;
use ros2probe_wire::{EntityId, Guid, GuidPrefix};

const METERED: Guid = Guid::new(GuidPrefix(*b"\x01\x0fattcxmeter"), EntityId([0, 0, 1, 3]));
const CAPTURED: Guid = Guid::new(GuidPrefix(*b"\x01\x0fattcxcaptu"), EntityId([0, 0, 1, 3]));
/// Sizes of samples: in one frame of MTU 1500, and in IP fragments.
const SIZES: [usize; 5] = [64, 1_300, 1_500, 16_384, 60_000];
/// Bytes of a stream of TCP, which Linux sends in large segments.
const STREAM_BYTES: usize = 4 << 20;
/// Maximum number of programs at one hook (`BPF_MPROG_MAX` of Linux).
const MAX_PROGRAMS: usize = 64;
/// Index of the loopback interface in every network namespace.
const LOOPBACK: u32 = 1;
/// Maximum wait for a packet.
const PATIENCE: Duration = Duration::from_secs(60);

/// Returns whether this kernel has tcx. Without it, the tests of this module have nothing to test.
fn has_tcx() -> bool {
    match tcx::check() {
        Ok(()) => true,
        Err(TcxError::Unsupported) => false,
        Err(error) => panic!("{error}: run the tests with sudo"),
    }
}

fn settings(wire: WireChoice) -> Result<WireTapSettings> {
    Ok(WireTapSettings {
        wire,
        selection: Selection::new(&[], &[])?,
        ring_bytes: 16 << 20,
        record_ring_bytes: 1 << 20,
        reassembly: Limits::default(),
        zenoh_ports: vec![7447],
    })
}

/// Opens a tap on a host.
fn tap(host: &Namespace, wire: WireChoice) -> Result<WireTap> {
    let settings = settings(wire)?;
    let mut tap = netns::within(&host.network(), || WireTap::open(&settings, 0, None))??;
    let filter = tap.filter_mut();
    filter.set_interest(METERED, Some(Verdict::Meter))?;
    filter.set_interest(CAPTURED, Some(Verdict::Capture))?;
    Ok(tap)
}

/// Loads a program that only passes packets on.
fn other_program() -> Result<OwnedFd> {
    const PROG_LOAD: libc::c_int = 5;
    const SCHED_CLS: u32 = 3;
    /// `r0 = -1; exit`, in memory order.
    const PASS_ON: [u64; 2] = [0xffff_ffff_0000_00b7, 0x95];
    #[repr(C)]
    struct Load {
        program_type: u32,
        instruction_count: u32,
        instructions: u64,
        license: u64,
        unused: [u64; 4],
    }
    let load = Load {
        program_type: SCHED_CLS,
        instruction_count: 2,
        instructions: PASS_ON.as_ptr() as u64,
        license: c"GPL".as_ptr() as u64,
        unused: [0; 4],
    };
    // SAFETY: the attributes outlive the call, and their size is passed.
    let program = unsafe {
        libc::syscall(
            libc::SYS_bpf,
            PROG_LOAD,
            &raw const load,
            size_of_val(&load),
        )
    };
    ensure!(
        program >= 0,
        "BPF_PROG_LOAD: {}",
        std::io::Error::last_os_error()
    );
    // SAFETY: the descriptor is new and has no other owner.
    Ok(unsafe { OwnedFd::from_raw_fd(i32::try_from(program)?) })
}

fn socket(host: &Namespace, address: Ipv4Addr) -> Result<UdpSocket> {
    let socket = netns::within(&host.network(), || UdpSocket::bind((address, 0)))??;
    socket.set_read_timeout(Some(PATIENCE))?;
    Ok(socket)
}

/// Sends samples of each size between two sockets, and compares each one with what arrives.
fn exchange(sender: &UdpSocket, receiver: &UdpSocket) -> Result<()> {
    let to = receiver.local_addr()?;
    let mut buffer = vec![0; 65_536];
    for number in 1..=10 {
        for size in SIZES {
            for writer in [METERED, CAPTURED] {
                let payload = program_run::message(writer, number..=number, size);
                sender.send_to(&payload, to)?;
                let len = receiver.recv(&mut buffer)?;
                ensure!(buffer[..len] == payload, "{size} bytes are not those sent");
            }
        }
    }
    Ok(())
}

/// Sends several datagrams by one call, which Linux passes through an interface of veth in one packet
/// (UDP_SEGMENT).
fn send_segments(sender: &UdpSocket, receiver: &UdpSocket) -> Result<()> {
    const SEGMENT: usize = 1000;
    let segment = SEGMENT as libc::c_int;
    // SAFETY: the option is an integer that outlives the call, and its size is passed.
    let result = unsafe {
        libc::setsockopt(
            sender.as_raw_fd(),
            libc::SOL_UDP,
            libc::UDP_SEGMENT,
            (&raw const segment).cast(),
            libc::socklen_t::try_from(size_of_val(&segment))?,
        )
    };
    ensure!(
        result == 0,
        "UDP_SEGMENT: {}",
        std::io::Error::last_os_error()
    );
    let sent: Vec<u8> = (0..10 * SEGMENT)
        .map(|at| (at * 7 + at / 256) as u8)
        .collect();
    sender.send_to(&sent, receiver.local_addr()?)?;
    let mut received = Vec::new();
    let mut buffer = vec![0; 65_536];
    while received.len() < sent.len() {
        let len = receiver.recv(&mut buffer)?;
        ensure!(len == SEGMENT, "{len} bytes instead of a segment");
        received.extend_from_slice(&buffer[..len]);
    }
    ensure!(received == sent, "the segments are not those sent");
    Ok(())
}

/// Sends a stream by TCP, which Linux segments late, and compares it with what arrives.
fn stream(from: &Namespace, to: &Namespace, address: Ipv4Addr) -> Result<()> {
    let listener = netns::within(&to.network(), || TcpListener::bind((address, 0)))??;
    let place = listener.local_addr()?;
    let sent: Vec<u8> = (0..STREAM_BYTES)
        .map(|at| (at * 7 + at / 256) as u8)
        .collect();
    let mut sender = netns::within(&from.network(), || TcpStream::connect(place))??;
    let (mut receiver, _) = listener.accept()?;
    receiver.set_read_timeout(Some(PATIENCE))?;
    std::thread::scope(|scope| -> Result<()> {
        let sending = scope.spawn(|| sender.write_all(&sent));
        let mut received = vec![0; STREAM_BYTES];
        receiver.read_exact(&mut received)?;
        ensure!(received == sent, "the stream is not the one sent");
        sending.join().map_err(|_| anyhow::anyhow!("panicked"))??;
        Ok(())
    })
}

/// Sends in both directions of the link and on the loopback interface, and streams.
fn send_all(link: &Link) -> Result<()> {
    let Link { robot, monitor, .. } = link;
    let at_robot = socket(robot, robot.address())?;
    let at_monitor = socket(monitor, monitor.address())?;
    let on_loopback = [
        socket(robot, Ipv4Addr::LOCALHOST)?,
        socket(robot, Ipv4Addr::LOCALHOST)?,
    ];
    exchange(&at_robot, &at_monitor)?;
    exchange(&at_monitor, &at_robot)?;
    exchange(&on_loopback[0], &on_loopback[1])?;
    // A multicast datagram is sent to the link, and comes back for the member on its own host.
    let group = Ipv4Addr::new(239, 255, 17, 1);
    let member = socket(robot, group)?;
    member.join_multicast_v4(&group, &robot.address())?;
    exchange(&at_robot, &member)?;
    stream(robot, monitor, monitor.address())?;
    stream(monitor, robot, robot.address())
}

/// Sets whether the interface computes checksums and segments packets.
fn set_offload(host: &Namespace, is_on: bool) -> Result<()> {
    let state = if is_on { "on" } else { "off" };
    let features = ["tx", "tso", "gso", "tx-udp-segmentation"];
    let features = features
        .map(|feature| format!("{feature} {state}"))
        .join(" ");
    let name = host.name();
    run(&format!(
        "ip netns exec {name} ethtool -K {INTERFACE} {features}"
    ))?;
    Ok(())
}

/// Returns the counters that are equal at both hooks. tcx is not attached to the sending side of the
/// loopback interface, and sees segments of TCP before the interface cuts them.
fn comparable(tap: &WireTap) -> Result<BTreeMap<&'static str, u64>> {
    let others = [Counter::LoopbackCopies, Counter::ZenohCandidates];
    let counters = tap.filter().counters()?.into_iter();
    let same = counters.filter(|(counter, _)| !others.contains(counter));
    Ok(same
        .map(|(counter, count)| (counter.label(), count))
        .collect())
}

fn value(counters: &BTreeMap<&'static str, u64>, counter: Counter) -> u64 {
    counters[counter.label()]
}

#[test]
fn tcx_counts_what_a_packet_socket_counts_and_passes_on_the_same_frames() -> Result<()> {
    if !has_tcx() {
        return Ok(());
    }
    for offload in [false, true] {
        let link = Link::new()?;
        for host in [&link.robot, &link.monitor] {
            set_offload(host, offload)?;
        }
        let mut taps = [WireChoice::Packet, WireChoice::Tcx]
            .map(|wire| tap(&link.robot, wire).map(|tap| (tap, Observer::new(Settings::default()))))
            .into_iter()
            .collect::<Result<Vec<_>>>()?;
        ensure!(taps[1].0.hook() == WireChoice::Tcx, "not at tcx");
        send_all(&link)?;
        let counters = taps.iter().map(|(tap, _)| comparable(tap));
        let counters = counters.collect::<Result<Vec<_>>>()?;
        let [packet, tcx] = [&counters[0], &counters[1]];
        for counter in [
            Counter::Metered,
            Counter::Captured,
            Counter::FragmentedComplete,
        ] {
            let sent = value(packet, counter);
            ensure!(sent > 0, "no traffic of {counter:?}: {packet:?}");
        }
        ensure!(tcx == packet, "offload {offload}: {tcx:?}, not {packet:?}");

        let frames = |tap: &WireTap| tap.packets().collect::<BTreeMap<_, _>>();
        let deadline = Instant::now() + PATIENCE;
        loop {
            for (tap, observer) in &mut taps {
                tap.poll(&Clocks::read(), None, observer)?;
            }
            let seen = [frames(&taps[0].0), frames(&taps[1].0)];
            if seen[0] == seen[1] && !seen[0].is_empty() {
                break;
            }
            ensure!(Instant::now() < deadline, "frames passed on: {seen:?}");
            std::thread::sleep(Duration::from_millis(20));
        }
        for (tap, _) in &mut taps {
            ensure!(tap.drops()? == 0, "frames were dropped");
        }
        let at_robot = socket(&link.robot, link.robot.address())?;
        let at_monitor = socket(&link.monitor, link.monitor.address())?;
        send_segments(&at_robot, &at_monitor)?;
        send_segments(&at_monitor, &at_robot)?;
        let segmented = taps.iter().map(|(tap, _)| comparable(tap));
        let segmented = segmented.map(|counters| Ok(value(&counters?, Counter::Segmented)));
        let segmented = segmented.collect::<Result<Vec<_>>>()?;
        // Without offload, the packet socket sees the packet of this host in segments.
        let expected = if offload { [2, 2] } else { [0, 1] };
        ensure!(segmented == expected, "offload {offload}: {segmented:?}");
    }
    Ok(())
}

#[test]
fn programs_before_and_after_still_run_and_nothing_stays_behind() -> Result<()> {
    if !has_tcx() {
        return Ok(());
    }
    let link = Link::new()?;
    let (robot, monitor) = (&link.robot, &link.monitor);
    let sockets = [
        socket(robot, robot.address())?,
        socket(monitor, monitor.address())?,
    ];
    let other = || -> Result<(Filter, Tcx)> {
        let filter = Filter::load_tcx(&FilterSettings::default())?;
        let programs = filter.tcx_programs().context("no programs")?;
        let mut tcx = Tcx::new(programs)?;
        let attach = || -> Result<()> { Ok(tcx.attach(interface_index(INTERFACE)?)?) };
        netns::within(&robot.network(), attach)??;
        Ok((filter, tcx))
    };
    let frames = |filter: &Filter| -> Result<u64> {
        let counters = filter.counters()?;
        let found = counters.iter().find(|(it, _)| *it == Counter::Frames);
        Ok(found.context("not a counter")?.1)
    };
    let (after, after_links) = other()?;
    let tap = tap(robot, WireChoice::Tcx)?;
    let (before, before_links) = other()?;
    ensure!(attached(robot, INTERFACE)? == [3, 3]);
    ensure!(
        attached(robot, "lo")? == [1, 0],
        "sent packets count once on lo"
    );
    exchange(&sockets[0], &sockets[1])?;
    exchange(&sockets[1], &sockets[0])?;
    let seen = [frames(&before)?, frames(tap.filter())?, frames(&after)?];
    ensure!(seen[0] > 0 && seen == [seen[0]; 3], "{seen:?}");
    drop(tap);
    wait_attached(robot, INTERFACE, [2, 2], PATIENCE)?;
    wait_attached(robot, "lo", [0, 0], PATIENCE)?;
    exchange(&sockets[0], &sockets[1])?;
    ensure!(frames(&before)? == frames(&after)?);
    ensure!(frames(&before)? > seen[0], "they run on");
    drop((before_links, after_links));
    wait_attached(robot, INTERFACE, [0, 0], PATIENCE)
}

#[test]
fn a_refused_attachment_selects_the_packet_socket_and_gives_the_reason() -> Result<()> {
    if !has_tcx() {
        return Ok(());
    }
    let host = Namespace::isolated()?;
    let mut others = Vec::new();
    for _ in 0..MAX_PROGRAMS {
        let program = other_program()?;
        let mut tcx = Tcx::new([program.as_fd(), program.as_fd()])?;
        let attached = netns::within(&host.network(), || tcx.attach(LOOPBACK))?;
        others.push(tcx);
        if attached.is_err() {
            break;
        }
    }
    let refused = tap(&host, WireChoice::Tcx);
    ensure!(refused.is_err(), "tcx was required");
    let tap = tap(&host, WireChoice::Auto)?;
    ensure!(tap.hook() == WireChoice::Packet);
    let reason = tap.without_tcx().context("no reason")?;
    ensure!(reason.contains("cannot attach"), "{reason}");
    ensure!(
        attached(&host, INTERFACE)? == [0, 0],
        "the rest was removed"
    );
    Ok(())
}

#[test]
fn a_packet_socket_on_request_gives_no_reason() -> Result<()> {
    let host = Namespace::isolated()?;
    let tap = tap(&host, WireChoice::Packet)?;
    ensure!(tap.hook() == WireChoice::Packet && tap.without_tcx().is_none());
    Ok(())
}

#[test]
fn a_later_interface_is_observed_until_it_leaves_the_namespace() -> Result<()> {
    if !has_tcx() {
        return Ok(());
    }
    let (host, other) = (Namespace::isolated()?, Namespace::isolated()?);
    let settings = settings(WireChoice::Tcx)?;
    netns::within(&host.network(), || -> Result<()> {
        let mut tap = WireTap::open(&settings, 0, None)?;
        let mut observer = Observer::new(Settings::default());
        let mut poll = || tap.poll(&Clocks::read(), None, &mut observer);
        let name = host.name();
        run(&format!(
            "ip -n {name} link add late type veth peer name far"
        ))?;
        poll()?;
        ensure!(attached(&host, "late")? == [1, 1]);
        run(&format!(
            "ip -n {name} link set late netns {}",
            other.name()
        ))?;
        poll()?;
        wait_attached(&other, "late", [0, 0], PATIENCE)?;
        ensure!(attached(&host, "far")? == [1, 1]);
        Ok(())
    })?
}

#[test]
fn programs_at_tcx_change_no_byte_of_a_packet() {
    use program_run::{Hook, Kernel};
    for hook in Hook::at_interfaces() {
        let mut kernel = Kernel::load_hook(hook);
        kernel.set_interest(&BTreeMap::from([(METERED, Verdict::Meter)]));
        kernel.set_unknown_budget(1 << 20, 1 << 20);
        for size in SIZES.map(|size| size.min(2000)) {
            for packet in program_run::fragments(
                &program_run::message(METERED, 1..=1, size),
                1480,
                false,
                u32::try_from(size).unwrap(),
            ) {
                assert_eq!(kernel.after_run(&packet), packet, "{hook:?}");
                kernel.drain();
            }
        }
    }
}
