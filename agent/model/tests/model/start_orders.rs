//! Discovery of a running stream in every order. Once all of it is discovered, the same messages
//! yield the same figures. No figure is wrong before.

use std::net::SocketAddrV4;
use std::sync::Arc;

use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::{Observer, Settings};
use ros2probe_model::report::snapshot::{Delivered, TopicFacts};
use ros2probe_testing::model::domain::watchlist;
use ros2probe_testing::model::host::{ALICE, BOB, CAROL, CapturePoint, Host, READER, START};
use ros2probe_testing::permutations;
use ros2probe_wire::record::flag;
use ros2probe_wire::{Guid, GuidPrefix, Timestamp};

/// Milliseconds between messages: 50 Hz.
const PERIOD: u64 = 20;
const RATE: f64 = 50.0;
/// Messages between two steps of discovery, and afterwards.
const BETWEEN: u64 = 15;
const AFTERWARDS: u64 = 1000;

/// A step of discovery. Alice publishes, Bob subscribes, and Carol shares the host.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Step {
    Alice,
    Writer,
    Bob,
    Reader,
    BobSocket,
    Carol,
}

const STEPS: [Step; 6] = [
    Step::Alice,
    Step::Writer,
    Step::Bob,
    Step::Reader,
    Step::BobSocket,
    Step::Carol,
];

struct Scene {
    host: Host,
    sent: u64,
    /// Participants whose sockets are known, and whose readers acknowledge repeatedly.
    acknowledging: Vec<GuidPrefix>,
}

/// Figures of the last messages.
#[derive(Debug, PartialEq, Eq)]
struct Figures {
    messages: u64,
    lost: u64,
    /// Participant, readers, delivered and lost messages of each receiver.
    deliveries: Vec<(Option<Guid>, Vec<Guid>, u64, u64)>,
    unknown_writers: usize,
    publishers: usize,
    subscriptions: usize,
}

impl Scene {
    fn new() -> Self {
        let mut observer = Observer::new(Settings::default());
        observer.input(Input::Watchlist(Arc::new(watchlist(&["/**"]))));
        observer.input(Input::Time(Timestamp(START)));
        let host = Host {
            observer,
            now: START,
        };
        Self {
            host,
            sent: 0,
            acknowledging: Vec::new(),
        }
    }

    /// Returns the multicast socket of a process.
    fn receiver(prefix: GuidPrefix) -> CapturePoint {
        let unicast = CapturePoint {
            socket: 0,
            address: SocketAddrV4::new([10, 0, 0, 2].into(), 7411),
            directed: None,
            flags: flag::HOST,
        };
        unicast.multicast(if prefix == BOB { 7401 } else { 7403 })
    }

    fn learn(&mut self, step: Step) {
        let host = &mut self.host;
        match step {
            Step::Alice => host.participant(ALICE, "10.0.0.1:7411".parse().unwrap()),
            Step::Writer => host.writer(true),
            Step::Bob => host.participant(BOB, "10.0.0.2:7411".parse().unwrap()),
            Step::Reader => host.subscribe(BOB, 1),
            Step::BobSocket => self.acknowledging.push(BOB),
            Step::Carol => {
                host.bystander(CAROL, 7413);
                self.acknowledging.push(CAROL);
            }
        }
    }

    /// Sends messages by multicast, which reach both sockets of the port. The topic's rate must
    /// never exceed the real one.
    fn send(&mut self, count: u64) {
        for _ in 0..count {
            self.host.wait(PERIOD);
            self.sent += 1;
            for prefix in [BOB, CAROL] {
                self.host.data(Self::receiver(prefix), self.sent);
            }
            if self.sent.is_multiple_of(5) {
                for prefix in self.acknowledging.clone() {
                    self.host.owner(Self::receiver(prefix), prefix);
                }
                self.is_plausible();
            }
        }
    }

    fn is_plausible(&self) {
        let Some(topic) = self.topic() else { return };
        if let Some(measurement) = topic.measurement {
            let rate = measurement.rate_hz;
            assert!(rate <= RATE * 1.1, "{rate} Hz after {}", self.sent);
            assert_eq!(measurement.lost, 0);
        }
        for delivery in topic.deliveries {
            assert!(!delivery.readers.is_empty(), "{delivery:?}");
            assert_eq!(lost(&delivery.delivered), 0, "{delivery:?}");
        }
    }

    fn topic(&self) -> Option<TopicFacts> {
        let mut topics = self.host.snapshot().topics.into_iter();
        topics.find(|topic| topic.name == "/chatter")
    }

    fn figures(&self) -> Figures {
        let topic = self.topic().unwrap();
        let measurement = topic.measurement.unwrap();
        let deliveries = topic.deliveries.into_iter().map(|delivery| {
            let delivered = delivery.delivered;
            (
                delivery.participant,
                delivery.readers,
                delivered.messages,
                lost(&delivered),
            )
        });
        Figures {
            messages: measurement.messages,
            lost: measurement.lost,
            deliveries: deliveries.collect(),
            unknown_writers: self.host.snapshot().unknown_writers.len(),
            publishers: topic.publishers.len(),
            subscriptions: topic.subscriptions.len(),
        }
    }
}

#[test]
fn discovery_in_any_order_yields_the_same_figures() {
    for order in permutations(&STEPS) {
        let mut scene = Scene::new();
        for step in &order {
            scene.send(BETWEEN);
            scene.learn(*step);
        }
        // The last messages that were sent before all was known settle.
        scene.send(100);
        let before = scene.figures();
        scene.send(AFTERWARDS);
        let after = scene.figures();
        assert_eq!(after.messages - before.messages, AFTERWARDS, "{order:?}");
        assert_eq!(after.lost, 0, "{order:?}");
        assert_eq!(after.unknown_writers, 0, "{order:?}");
        assert_eq!((after.publishers, after.subscriptions), (1, 1), "{order:?}");
        let bob = Guid::new(BOB, READER);
        assert_eq!(after.deliveries.len(), 1, "{order:?}: {after:#?}");
        let (participant, readers, delivered, lost) = &after.deliveries[0];
        assert_eq!(participant.map(|guid| guid.prefix), Some(BOB), "{order:?}");
        assert_eq!(readers, &[bob], "{order:?}");
        assert_eq!(*lost, 0, "{order:?}");
        let delivered_before = before.deliveries.first().map_or(0, |each| each.2);
        assert_eq!(delivered - delivered_before, AFTERWARDS, "{order:?}");
        let rate = scene.topic().unwrap().measurement.unwrap().rate_hz;
        assert!((rate - RATE).abs() < 1.0, "{order:?}: {rate} Hz");
    }
}

fn lost(delivered: &Delivered) -> u64 {
    delivered.lost_at_sender
        + delivered.lost_before_host
        + delivered.lost_in_reassembly
        + delivered.lost_in_socket_buffer
        + delivered.pending
}
