//! Subscriptions that take too slowly, and the messages that they lose in their queues.

use std::collections::VecDeque;

use ros2probe_model::facts::calls::facts::ReaderQueue;
use ros2probe_model::facts::diagnosis::Diagnosis;
use ros2probe_testing::model::host::{BOB, CAROL, CapturePoint, Host, READER};

use super::*;

/// Bob's process, as [`Host::owner`] names it.
const PROCESS: u32 = BOB.0[2] as u32;
/// A participant of Fast DDS 2, which does not announce the depth.
const FAST: GuidPrefix = GuidPrefix(*b"\x01\x0fbobby-host");

/// A subscriber with a queue, and the agent that observes its calls.
struct Robot {
    host: Host,
    bob: CapturePoint,
    prefix: GuidPrefix,
    /// Messages that the queue keeps.
    depth: usize,
    /// Duration of the callback in milliseconds.
    callback: u64,
    queue: VecDeque<u64>,
    busy_until: u64,
    number: u64,
    taken: u64,
    dropped: u64,
    last: u64,
    latency: Durations,
    /// Whether the process is observed, and whether its takes are.
    is_attached: bool,
    is_observed: bool,
    has_findings: bool,
}

impl Robot {
    fn new(prefix: GuidPrefix, depth: usize, callback: u64) -> Self {
        let mut host = Host::new();
        let bob = match prefix {
            FAST => {
                let address = "10.0.0.2:7411".parse().unwrap();
                let payload = forge::participant_at(FAST, 1_000_000, Some(0), &[address]);
                host.announce(Message::from_fast(FAST).data(SPDP, 1, &payload));
                let guid = Guid::new(FAST, READER);
                let payload = forge::endpoint(guid, "rt/chatter", STRING, true);
                host.announce(Message::from_fast(FAST).data(SEDP_READERS, 1, &payload));
                CapturePoint {
                    socket: 7411,
                    address,
                    directed: None,
                    flags: ros2probe_wire::record::flag::HOST,
                }
            }
            _ => host.reader(prefix, 7411),
        };
        host.owner(bob, prefix);
        let mut robot = Self {
            host,
            bob,
            prefix,
            depth,
            callback,
            queue: VecDeque::new(),
            busy_until: 0,
            number: 0,
            taken: 0,
            dropped: 0,
            last: 0,
            latency: Durations::default(),
            is_attached: false,
            is_observed: true,
            has_findings: false,
        };
        robot.report();
        robot.host.wait(1);
        robot.is_attached = true;
        robot
    }

    /// Lets `seconds` pass with a message every `period` milliseconds, or without messages if it is
    /// 0.
    fn run(&mut self, seconds: u64, period: u64) {
        for millisecond in 1..=1000 * seconds {
            self.host.wait(1);
            if period > 0 && millisecond % period == 0 {
                self.number += 1;
                self.host.data(self.bob, self.number);
                self.queue.push_back(self.host.now);
                if self.queue.len() > self.depth {
                    self.queue.pop_front();
                    self.dropped += 1;
                }
            }
            if self.busy_until <= self.host.now
                && let Some(sent) = self.queue.pop_front()
            {
                self.busy_until = self.host.now + self.callback * MILLISECOND;
                self.taken += 1;
                self.last = self.host.now;
                let latency = Duration::from_nanos(self.host.now - sent + 200_000);
                self.latency.observe(latency);
            }
            if millisecond % 1000 == 300 {
                self.report();
            }
        }
    }

    fn report(&mut self) {
        let mut subscriptions = Vec::new();
        if self.is_observed && self.taken > 0 {
            subscriptions.push(SubscriptionReport {
                latency: self.latency.clone(),
                failed: 0,
                ..subscription("/chatter", self.taken, self.last)
            });
        }
        let processes = vec![ProcessReport {
            subscriptions,
            ..process(PROCESS)
        }];
        self.host.observer.input(Input::Inside(Report {
            at: Timestamp(self.host.now),
            has_callbacks: false,
            processes: if self.is_attached {
                processes
            } else {
                Vec::new()
            },
            transitions: Vec::new(),
            late: Vec::new(),
        }));
        if let Some(queue) = self.queue() {
            assert!(queue.lost <= self.dropped, "{queue:?}, {}", self.dropped);
        }
        self.has_findings |= self.finding().is_some();
    }

    fn queue(&self) -> Option<ReaderQueue> {
        let inside = self.host.snapshot().inside?;
        inside.reader_queues.first().cloned()
    }

    fn finding(&self) -> Option<Diagnosis> {
        let found = &self.host.snapshot().diagnoses.list;
        let is_ours = |it: &&Diagnosis| it.kind() == "reader_queue_overflow";
        found.iter().find(is_ours).cloned()
    }

    /// Restarts the counts, as for an agent that starts later.
    fn attach(&mut self) {
        (self.taken, self.dropped) = (0, 0);
        self.latency = Durations::default();
        self.is_attached = true;
    }
}

#[test]
fn messages_that_a_slow_subscriber_never_takes_are_lost_in_its_queue() {
    for prefix in [BOB, FAST] {
        // Cyclone DDS announces the depth if it is not 1; Fast DDS 2 never does.
        let depth = if prefix == BOB { 1 } else { 10 };
        let mut robot = Robot::new(prefix, depth, 110);
        robot.run(30, 20);
        let (queue, finding) = (robot.queue().unwrap(), robot.finding());
        let Some(Diagnosis::ReaderQueueOverflow { lost_permille, .. }) = finding else {
            panic!("no finding: {queue:?}");
        };
        assert!((700..=860).contains(&lost_permille), "{lost_permille}");
        // Once the queue has been emptied, all losses are known, and the finding is resolved.
        robot.run(30, 0);
        let queue = robot.queue().unwrap();
        assert_eq!((queue.arrived, queue.taken), (1500, robot.taken));
        assert_eq!(queue.lost, robot.dropped, "{prefix:?}");
        assert_eq!(queue.taken + queue.lost, queue.arrived);
        assert!(robot.finding().is_none());
        let topic = robot.host.topic();
        assert_eq!(topic.inside.unwrap().lost_in_queues, Some(robot.dropped));
        let [delivery] = &robot.host.deliveries()[..] else {
            panic!("one receiver")
        };
        assert_eq!(delivery.lost_in_reader_queue, Some(robot.dropped));
        assert_eq!(
            (delivery.delivered.messages, delivery.delivered.lost()),
            (1500, 0)
        );
        assert_eq!(robot.prefix, prefix);
    }
}

#[test]
fn a_subscriber_that_keeps_up_has_no_losses_at_any_rate() {
    // A message every 40 s, 1 kHz, and callbacks that take almost the whole period.
    for (period, callback, seconds) in [(40_000, 30, 200), (1, 0, 20), (20, 18, 60), (500, 1, 60)] {
        for prefix in [BOB, FAST] {
            let mut robot = Robot::new(prefix, 1, callback);
            robot.run(seconds, period);
            robot.run(90, 0);
            assert_eq!(robot.dropped, 0, "the test's own robot");
            let lost = robot.queue().map(|queue| queue.lost);
            assert_eq!((lost, robot.has_findings), (Some(0), false), "{period}");
        }
    }
}

#[test]
fn messages_that_wait_in_a_deep_queue_are_not_lost() {
    let mut robot = Robot::new(FAST, 5_000, 5);
    robot.run(10, 10);
    // A callback of 15 s: 1500 messages wait, and are taken within 15 s.
    robot.busy_until = robot.host.now + 15 * SECOND;
    robot.run(60, 10);
    robot.run(60, 0);
    assert_eq!(robot.dropped, 0);
    let queue = robot.queue().unwrap();
    assert_eq!((queue.arrived, queue.taken, queue.lost), (7000, 7000, 0));
    assert!(!robot.has_findings);
    // Whether a message waits or is lost is unknown until the next take.
    let mut stuck = Robot::new(FAST, 5_000, 5);
    stuck.run(10, 10);
    stuck.busy_until = u64::MAX;
    stuck.run(120, 10);
    assert_eq!(stuck.queue().unwrap().lost, 0);
}

#[test]
fn a_late_agent_counts_no_losses_from_before_its_start() {
    for prefix in [BOB, FAST] {
        let mut robot = Robot::new(prefix, 1, 110);
        robot.is_attached = false;
        robot.run(10, 20);
        assert!(robot.queue().is_none());
        robot.attach();
        robot.run(60, 20);
        robot.run(30, 0);
        // The first two seconds only determine the start of the comparison.
        let lost = robot.queue().unwrap().lost;
        let least = robot.dropped - 150;
        assert!(
            (least..=robot.dropped).contains(&lost),
            "{lost} {}",
            robot.dropped
        );
        let mut healthy = Robot::new(prefix, 1, 5);
        healthy.is_attached = false;
        healthy.run(10, 20);
        healthy.attach();
        healthy.run(60, 20);
        healthy.run(30, 0);
        assert_eq!(healthy.queue().unwrap().lost, 0);
        assert!(!healthy.has_findings);
    }
}

#[test]
fn unmatched_takes_and_arrivals_yield_no_reader_queue() {
    // No call is observed, because the process takes messages by other calls.
    let mut robot = Robot::new(BOB, 1, 110);
    robot.is_observed = false;
    robot.run(20, 20);
    assert!(robot.queue().is_none());
    let inside = robot.host.topic().inside;
    assert!(inside.is_none_or(|inside| inside.lost_in_queues.is_none()));
    assert_eq!(robot.host.deliveries()[0].lost_in_reader_queue, None);
    // A second reader in the process, whose calls are not observed.
    let mut robot = Robot::new(BOB, 1, 110);
    robot.host.reader(CAROL, 7412);
    let second = Guid::new(BOB, EntityId([0, 0, 0x15, 0x04]));
    let payload = forge::endpoint(second, "rt/chatter", STRING, true);
    robot
        .host
        .announce(Message::from(BOB).data(SEDP_READERS, 2, &payload));
    robot.run(20, 20);
    assert!(robot.queue().is_none());
}
