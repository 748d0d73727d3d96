//! The way of a message to the process that is late: its publisher, the network, the socket, and
//! the thread that receives.

use std::fs::File;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, UdpSocket};
use std::process::Command;
use std::thread::sleep;
use std::time::{Duration, Instant};

use anyhow::Result;
use ros2probe_capture::filter::{Filter, FilterSettings};
use ros2probe_capture::netns;
use ros2probe_capture::system::Clocks;
use ros2probe_model::facts::calls::late::{Cause, LateCall, Part, Stage};
use ros2probe_model::facts::calls::report::ThreadStates;
use ros2probe_testing::harness::network::Namespace;
use ros2probe_testing::program_run;
use ros2probe_wire::delivery::{DELIVERY_CAPACITY, QUEUE_CAPACITY};
use ros2probe_wire::filter::Counter;
use ros2probe_wire::{EntityId, Guid, GuidPrefix};

use super::late::{late, set_bounds};
use super::thread_states::{Hog, exhaust, limit_to_five_percent, wait_until_stopped};
use super::{Process, Robot};

const WRITER: Guid = Guid::new(GuidPrefix(*b"\x01\x0fdeliveries"), EntityId([0, 0, 1, 3]));
/// Time for which a message is late in each test: longer than the waits of a busy machine.
pub(super) const LATE: Duration = Duration::from_millis(100);
/// Part of that time which another stage may have.
const IMPRECISION: Duration = Duration::from_millis(20);

/// A subscriber on a host of its own, and sockets that send to it.
struct DeliveryBench {
    host: Namespace,
    filter: Filter,
    robot: Robot,
    process: Process,
    subscriber: SocketAddr,
    /// A socket whose datagrams the agent sees when they are sent.
    near: UdpSocket,
    /// A socket that is not observed, like those of another host.
    far: UdpSocket,
    sequence_number: u32,
}

impl DeliveryBench {
    fn new() -> Result<DeliveryBench> {
        Self::over(Ipv4Addr::LOCALHOST.into())
    }

    fn over(address: IpAddr) -> Result<DeliveryBench> {
        let host = Namespace::isolated()?;
        let mut filter = Filter::load_host(&FilterSettings {
            deliveries: true,
            ..FilterSettings::default()
        })?;
        filter.attach_tracepoints(false);
        let cgroup = File::open(host.cgroup())?;
        filter.attach(&cgroup)?;
        let mut deliveries = filter.take_deliveries().unwrap();
        deliveries.follow(&cgroup).unwrap();
        let mut robot = Robot::new(248, &[], true);
        robot.deliveries = Some(deliveries);
        robot.attach();
        let program = robot.program.program();
        let start = || Process::start(&program);
        let mut process = host.hold(|| netns::within(&host.network(), start))??;
        process.run("init");
        let port = process.run(if address.is_ipv6() {
            "socket 6"
        } else {
            "socket 4"
        });
        let port = port.split(' ').next().unwrap().parse()?;
        let open = || netns::within(&host.network(), || UdpSocket::bind((address, 0)));
        let (near, far) = (host.hold(open)???, open()??);
        let mut way = DeliveryBench {
            filter,
            robot,
            process,
            subscriber: SocketAddr::from((address, port)),
            near,
            far,
            sequence_number: 0,
            host,
        };
        // The delay of a message is its time beyond the fastest one.
        let (mut passes, mut is_fast) = (0, false);
        while passes < 3 || !is_fast {
            assert!(passes < 1000, "no message passes fast");
            let begun = Instant::now();
            way.send(Duration::ZERO)?;
            way.process.run("network 1 0");
            is_fast |= begun.elapsed() < IMPRECISION / 2;
            passes += 1;
        }
        set_bounds(&mut way.robot, &way.process);
        // The states of the thread before a call are known from the second call on.
        way.send(Duration::ZERO)?;
        way.process.run("network 1 0");
        // On a busy machine, this call may be late itself.
        way.robot.round();
        Ok(way)
    }

    /// Sends a message that was published some time ago.
    fn send(&mut self, ago: Duration) -> Result<()> {
        let datagram = self.datagram(ago);
        self.near.send_to(&datagram, self.subscriber)?;
        Ok(())
    }

    fn datagram(&mut self, ago: Duration) -> Vec<u8> {
        self.sequence_number += 1;
        program_run::stamped(WRITER, Clocks::read().now - ago, self.sequence_number)
    }

    /// Receives the message that waits, and returns the late call.
    fn receive(&mut self, command: &str) -> LateCall {
        let mut calls = late(&mut self.robot, &mut self.process, command);
        assert_eq!(calls.len(), 1, "{calls:#?}");
        calls.remove(0)
    }

    /// Returns the number of received datagrams whose arrival was not known.
    fn unmatched(&self) -> Result<u64> {
        let counters = self.filter.counters()?.into_iter();
        let of = |(counter, count)| (counter == Counter::ReceivedUnmatched).then_some(count);
        Ok(counters.filter_map(of).sum())
    }
}

/// Is true for the time that a thread waits for a CPU of a busy machine.
pub(super) fn is_busy(part: &Part) -> bool {
    matches!(part.cause, Cause::Runnable | Cause::Stolen)
}

/// Asserts that a call is late for this part, and that the part has the injected length or more.
/// Returns the part. On a busy machine, the process may wait for a CPU for even longer.
pub(super) fn assert_late_for(call: &LateCall, stage: Stage, cause: Cause) -> Part {
    let parts = call.parts();
    let sum: Duration = parts.iter().map(|part| part.duration).sum();
    assert_eq!(sum, call.total(), "{call:#?}");
    let main = call.main_part(ThreadStates::default()).unwrap();
    let is_injected = |part: &Part| (part.stage, part.cause) == (stage, cause);
    // While the thread waits for a CPU, the message waits in its socket.
    let is_later = is_busy(&main) || main.cause == Cause::Queue;
    assert!(is_injected(&main) || is_later, "{parts:?} {call:#?}");
    let injected = parts.iter().find(|part| is_injected(part)).copied();
    let injected = injected.unwrap_or_else(|| panic!("{parts:?} {call:#?}"));
    assert!(
        injected.duration >= LATE - IMPRECISION,
        "{parts:?} {call:#?}"
    );
    injected
}

/// Asserts that a message that no thread receives is late for that reason.
fn assert_waits_in_socket(way: &mut DeliveryBench) -> Result<()> {
    way.send(Duration::ZERO)?;
    sleep(LATE);
    let call = way.receive("network 1 0");
    assert_late_for(&call, Stage::Socket, Cause::Queue);
    Ok(())
}

#[test]
fn a_message_that_its_publisher_sends_late_names_the_publisher() -> Result<()> {
    let mut way = DeliveryBench::new()?;
    way.send(LATE)?;
    let call = way.receive("network 1 0");
    assert_late_for(&call, Stage::Publish, Cause::Send);
    let delivery = call.delivery.as_ref().unwrap();
    assert!(delivery.sent_before.is_some());
    assert_eq!(delivery.receiver_thread, call.thread);
    assert_eq!(way.unmatched()?, 0);
    Ok(())
}

#[test]
fn a_message_of_another_host_that_arrives_late_names_the_network() -> Result<()> {
    let mut way = DeliveryBench::new()?;
    let datagram = way.datagram(LATE);
    way.far.send_to(&datagram, way.subscriber)?;
    let call = way.receive("network 1 0");
    assert_late_for(&call, Stage::Network, Cause::Transit);
    Ok(())
}

#[test]
fn an_unreceived_message_names_the_socket() -> Result<()> {
    let mut way = DeliveryBench::new()?;
    assert_waits_in_socket(&mut way)?;
    Ok(())
}

#[test]
fn a_message_that_the_middleware_keeps_names_the_middleware() -> Result<()> {
    let mut way = DeliveryBench::new()?;
    way.send(Duration::ZERO)?;
    let call = way.receive(&format!("network 1 {}", LATE.as_micros()));
    let parts = call.parts();
    let (busy, own): (Vec<Part>, Vec<Part>) = parts.iter().copied().partition(is_busy);
    let main = own.iter().max_by_key(|part| part.duration).unwrap();
    assert_eq!(
        (main.stage, main.cause),
        (Stage::Wait, Cause::Middleware),
        "{parts:?} {call:#?}"
    );
    // The wait for a CPU on a busy machine is no part of the middleware's time.
    let busy: Duration = busy.iter().map(|part| part.duration).sum();
    assert!(
        main.duration + busy >= LATE - IMPRECISION,
        "{parts:?} {call:#?}"
    );
    Ok(())
}

#[test]
fn queue_times_are_known_behind_other_messages_and_at_a_full_buffer() -> Result<()> {
    let mut way = DeliveryBench::new()?;
    way.send(Duration::ZERO)?;
    way.send(Duration::ZERO)?;
    // The buffer has room for some of these only.
    let foreign = vec![0; 30_000];
    for _ in 0..50 {
        way.near.send_to(&foreign, way.subscriber)?;
    }
    sleep(LATE);
    let calls = late(&mut way.robot, &mut way.process, "network 2 0");
    assert_eq!(calls.len(), 2, "{calls:#?}");
    for call in &calls {
        assert_late_for(call, Stage::Socket, Cause::Queue);
    }
    let drained = way.process.run("drain");
    let drained: u32 = drained.split(' ').next().unwrap().parse()?;
    assert!((1..50).contains(&drained), "{drained}");
    assert_eq!(way.unmatched()?, 0);
    Ok(())
}

#[test]
fn a_message_over_ipv6_has_a_delivery_too() -> Result<()> {
    let mut way = DeliveryBench::over(Ipv6Addr::LOCALHOST.into())?;
    assert_waits_in_socket(&mut way)?;
    Ok(())
}

#[test]
fn a_stopped_process_is_the_cause_of_a_wait_in_its_socket() -> Result<()> {
    let mut way = DeliveryBench::new()?;
    let process = way.process.child.id().to_string();
    let signal = |name: &str| -> Result<()> {
        let sent = Command::new("kill").args([name, &process]).status()?;
        anyhow::ensure!(sent.success());
        Ok(())
    };
    // It is stopped while it waits for the message.
    way.process.begin("network 5 0");
    sleep(Duration::from_millis(20));
    signal("-STOP")?;
    wait_until_stopped(&way.process);
    for _ in 0..5 {
        way.send(Duration::ZERO)?;
    }
    sleep(LATE);
    signal("-CONT")?;
    way.process.end("network");
    let calls = way.robot.round().report.late;
    assert_eq!(calls.len(), 5, "{calls:#?}");
    for call in &calls {
        let stopped = assert_late_for(call, Stage::Socket, Cause::Stopped);
        let named = call.named_by(stopped);
        assert!(
            named.is_some_and(|thread| &*thread.name == "kill"),
            "{named:?}"
        );
    }
    Ok(())
}

#[test]
fn a_quota_is_the_cause_of_the_waits_of_messages() -> Result<()> {
    let mut way = DeliveryBench::new()?;
    // The process waits for the messages while another thread of its group computes.
    const MESSAGES: usize = 60;
    way.process.begin(&format!("network {MESSAGES} 0"));
    sleep(Duration::from_millis(20));
    let quota = limit_to_five_percent(&way.process);
    let hog = Hog::on("0-1");
    exhaust(&quota, &hog);
    for _ in 0..MESSAGES {
        way.send(Duration::ZERO)?;
        sleep(Duration::from_millis(15));
    }
    way.process.end("network");
    drop(hog);
    drop(quota);
    let calls = way.robot.round().report.late;
    let mains = calls
        .iter()
        .map(|call| call.main_part(ThreadStates::default()).unwrap());
    // On a busy machine, other threads make some messages late.
    let mains: Vec<_> = mains.filter(|main| !is_busy(main)).collect();
    // Since Linux 6.18, a thread is throttled at the end of its system call.
    let throttled = mains.iter().filter(|main| {
        let is_in_process = matches!(main.stage, Stage::Socket | Stage::Wait);
        is_in_process && main.cause == Cause::Throttled
    });
    let throttled = throttled.count();
    assert!(throttled > 0 && throttled * 2 >= mains.len(), "{calls:#?}");
    Ok(())
}

#[test]
fn a_message_has_a_delivery_after_more_messages_than_the_cap() -> Result<()> {
    let mut way = DeliveryBench::new()?;
    for _ in 0..2 * DELIVERY_CAPACITY / 50 {
        for _ in 0..50 {
            way.send(Duration::ZERO)?;
        }
        assert_eq!(way.process.run("drain"), "50 drain\n");
    }
    assert_eq!(way.unmatched()?, 0);
    assert_waits_in_socket(&mut way)?;
    Ok(())
}

#[test]
fn a_socket_keeps_its_numbers_while_more_sockets_than_the_cap_receive() -> Result<()> {
    let mut way = DeliveryBench::new()?;
    let address = way.subscriber.ip();
    for _ in 0..2 * QUEUE_CAPACITY / 64 {
        for _ in 0..64 {
            let datagram = way.datagram(Duration::ZERO);
            let open = || netns::within(&way.host.network(), || UdpSocket::bind((address, 0)));
            let other = way.host.hold(open)???;
            way.near.send_to(&datagram, other.local_addr()?)?;
        }
        way.send(Duration::ZERO)?;
        assert_eq!(way.process.run("drain"), "1 drain\n");
    }
    assert_waits_in_socket(&mut way)?;
    Ok(())
}

#[test]
fn a_buffer_filled_before_the_first_request_is_not_a_wait() -> Result<()> {
    let mut way = DeliveryBench::new()?;
    let mut deliveries = way.robot.deliveries.take().unwrap();
    deliveries.leave();
    way.send(LATE)?;
    way.send(LATE)?;
    deliveries.follow(&File::open(way.host.cgroup())?).unwrap();
    way.robot.deliveries = Some(deliveries);
    way.send(LATE)?;
    let mut calls = late(&mut way.robot, &mut way.process, "network 3 0");
    assert_eq!(calls.len(), 3, "{calls:#?}");
    let last = calls.pop().unwrap();
    assert_late_for(&last, Stage::Publish, Cause::Send);
    for call in calls {
        assert!(call.delivery.is_none(), "{call:#?}");
    }
    Ok(())
}
