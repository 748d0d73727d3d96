//! Participants that join and leave while a robot runs leave no growing state behind. A
//! counting allocator measures the heap exactly.

use crate::allocator;
use ros2probe_model::facts::limits::Limits;
use ros2probe_model::facts::watch::{Watch, Watchlist};
use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::{Observer, Settings};
use ros2probe_testing::model::forge::{self, Message, SEDP_READERS, SEDP_WRITERS, SPDP};
use ros2probe_wire::time::SECOND;
use ros2probe_wire::{EntityId, Guid, GuidPrefix, Timestamp};
use std::sync::Arc;

const START: u64 = 1_795_143_000 * SECOND;
const WRITER: EntityId = EntityId([0, 0, 0x11, 0x03]);
const READER: EntityId = EntityId([0, 0, 0x13, 0x04]);
const NODES: EntityId = EntityId([0, 0, 0x04, 0x03]);
/// Number of participants alive at a time.
const ALIVE: u32 = 60;

struct Robot {
    observer: Observer,
    now: u64,
    created: u32,
}

impl Robot {
    fn put(&mut self, message: Message) {
        let envelope = forge::multicast(self.now, 3);
        self.observer.input(Input::Datagram {
            envelope: &envelope,
            payload: &message.bytes(),
            handover: None,
        });
    }

    fn prefix(number: u32) -> GuidPrefix {
        let [a, b, c, d] = number.to_be_bytes();
        GuidPrefix([1, 0x10, 0, 0, 0, 0, 0, 0, a, b, c, d])
    }

    /// Adds a participant with a new name that sends data, and removes another. Every second one is
    /// removed by its expired lease.
    fn step(&mut self) {
        let number = self.created;
        let prefix = Self::prefix(number);
        self.created += 1;
        let announcement = forge::participant(prefix, 4, None);
        self.put(Message::from(prefix).data(SPDP, 1, &announcement));
        let own = format!("rt/robot_{number}/points");
        let shared = format!("rt/shared_{}", number % 40);
        let writer = Guid::new(prefix, WRITER);
        for (sedp, guid, topic, sequence) in [
            (SEDP_WRITERS, writer, &own, 7),
            (SEDP_READERS, Guid::new(prefix, READER), &shared, 8),
        ] {
            let payload = forge::endpoint(guid, topic, "std_msgs::msg::dds_::String_", true);
            self.put(Message::from(prefix).data(sedp, sequence, &payload));
        }
        let name = format!("node_{number}");
        let payload = forge::entities(prefix, 24, &[("/", &name, writer)]);
        self.put(Message::from(prefix).data(NODES, 4, &payload));
        for sequence in 1..4 {
            self.now += SECOND / 60;
            self.put(Message::from(prefix).data(WRITER, sequence, b"\0\x01\0\0\x04\0\0\0abc\0"));
        }
        // Participants that stay renew their announcements in time.
        for other in number.saturating_sub(ALIVE)..number {
            if other % 8 == number % 8 {
                let prefix = Self::prefix(other);
                let payload = forge::participant(prefix, 4, None);
                self.put(Message::from(prefix).data(SPDP, 2, &payload));
            }
        }
        if let Some(gone) = number.checked_sub(ALIVE)
            && gone % 2 == 0
        {
            let guid = Guid::new(Self::prefix(gone), EntityId([0, 0, 1, 0xc1]));
            let prefix = Self::prefix(gone);
            self.put(Message::from(prefix).dispose_by_hash(SPDP, 3, guid));
        }
        self.observer.input(Input::Time(Timestamp(self.now)));
        drop((self.observer.drain().events, self.observer.drain().interest));
    }

    /// Returns the bytes held after this many more participants.
    fn bytes_after(&mut self, more: u32) -> usize {
        (0..more).for_each(|_| self.step());
        let snapshot = self.observer.snapshot(Timestamp(self.now));
        let alive = snapshot.participants.len();
        assert!((30..400).contains(&alive), "{alive}");
        drop(snapshot);
        allocator::held()
    }
}

#[test]
fn thousands_of_participants_that_left_leave_no_state() {
    // Small limits fill the tables of former participants early.
    let limits = Limits {
        topics: 200,
        ..Limits::default()
    };
    let mut observer = Observer::new(Settings::default().with_limits(&limits));
    let watch = Watch::named("/**").unwrap();
    observer.input(Input::Watchlist(Arc::new(
        Watchlist::new(vec![watch]).unwrap(),
    )));
    let mut robot = Robot {
        observer,
        now: START,
        created: 0,
    };
    robot.bytes_after(14_000);
    let held: Vec<_> = (0..4).map(|_| robot.bytes_after(1_000)).collect();
    let (least, most) = (held.iter().min().unwrap(), held.iter().max().unwrap());
    // The bound is less than 7 bytes for each of the 3000 participants that left in between.
    assert!(most - least < 20_000, "{held:?}");
}
