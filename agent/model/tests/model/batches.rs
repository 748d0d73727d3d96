//! Samples in batches, as RTI Connext sends them.

use ros2probe_model::facts::measurement::Measurement;
use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::Settings;
use ros2probe_testing::model::domain::VirtualDomain;
use ros2probe_testing::model::forge::{self, Message, SEDP_READERS, SEDP_WRITERS};
use ros2probe_wire::{EntityId, Guid, GuidPrefix};

/// Batches with the numbers 11 to 13, 14 and 19, and 20.
const BATCHES: &[u8] = include_bytes!("../../../../wire/tests/data/rti-batches.bin");
/// Offsets of the lowest byte of the number of each first sample.
const FIRST_NUMBERS: [usize; 3] = [60, 163, 232];
const PREFIX: GuidPrefix = GuidPrefix([1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12]);
const READER: Guid = Guid::new(GuidPrefix([9; 12]), EntityId([0, 0, 1, 4]));
const WRITER: Guid = Guid::new(PREFIX, EntityId([0, 0, 1, 3]));

struct Batches(VirtualDomain);

impl Batches {
    fn new() -> Self {
        let mut domain = VirtualDomain::new(&["/chatter"], Settings::default());
        domain.participant(PREFIX, 100);
        domain.participant(READER.prefix, 100);
        // Of a reliable writer, missing samples may still be repeated.
        for (guid, sedp) in [(WRITER, SEDP_WRITERS), (READER, SEDP_READERS)] {
            let payload =
                forge::endpoint(guid, "rt/chatter", "std_msgs::msg::dds_::String_", false);
            domain.put(Message::from(guid.prefix).data(sedp, 1, &payload));
        }
        Self(domain)
    }

    /// Sends the three batches with numbers that are higher by `more`.
    fn send(&mut self, more: u8) {
        let mut message = BATCHES.to_vec();
        for at in FIRST_NUMBERS {
            message[at] += more;
        }
        let envelope = forge::multicast(self.0.now, 0);
        self.0.observer.input(Input::Datagram {
            envelope: &envelope,
            payload: &message,
            handover: None,
        });
        self.0.wait(1000);
    }

    fn measurement(&self) -> Measurement {
        let snapshot = self.0.snapshot();
        let topic = snapshot
            .topics
            .iter()
            .find(|topic| &*topic.name == "/chatter");
        *topic.unwrap().measurement.clone().unwrap()
    }
}

// Coverage: UDP, samples in batches | RTI Connext | - | counted
#[test]
fn samples_in_batches_count_and_absent_numbers_within_a_batch_are_not_lost() {
    let mut batches = Batches::new();
    batches.send(0);
    batches.send(10);
    (0..12).for_each(|_| batches.0.wait(1000));
    let measured = batches.measurement();
    assert_eq!((measured.messages, measured.lost), (12, 0));
    assert_eq!(measured.bytes, 2 * (32 + 12 + 44));
}

#[test]
fn repeated_batches_count_once_and_missing_ones_are_lost() {
    let mut batches = Batches::new();
    batches.send(0);
    batches.send(0);
    assert_eq!(batches.measurement().messages, 6);
    batches.send(20);
    (0..12).for_each(|_| batches.0.wait(1000));
    let measured = batches.measurement();
    // The numbers 21 to 30.
    assert_eq!((measured.messages, measured.lost), (12, 10));
}
