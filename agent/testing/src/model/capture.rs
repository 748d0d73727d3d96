//! Writes captures of participants' messages, as tcpdump does.

use std::path::Path;

use ros2probe_wire::GuidPrefix;

use super::forge::{self, Message, SEDP_READERS, SEDP_WRITERS, SPDP};
use ros2probe_wire::{EntityId, Guid};

pub const ETHERNET: u32 = 1;

/// A classic pcap file with nanoseconds.
pub struct Capture(Vec<u8>);

impl Capture {
    pub fn new(link: u32) -> Self {
        let mut bytes = 0xa1b2_3c4d_u32.to_le_bytes().to_vec();
        bytes.extend_from_slice(&[2, 0, 4, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 4, 0]);
        bytes.extend_from_slice(&link.to_le_bytes());
        Self(bytes)
    }

    /// Adds a message to the discovery multicast address of a domain.
    pub fn put(&mut self, time: u64, domain_id: u16, message: Message) {
        let message = message.bytes();
        let length = |header: usize| u16::try_from(message.len() + header).unwrap();
        let port = 7400 + 250 * domain_id;
        let mut frame = vec![1, 0, 0x5e, 0x7f, 0, 1, 2, 0, 0, 0, 0, 1, 8, 0, 0x45, 0];
        frame.extend_from_slice(&length(28).to_be_bytes());
        // UDP from 10.0.0.1 to 239.255.0.1, not fragmented, no checksum.
        frame.extend_from_slice(&[0, 0, 0x40, 0, 64, 17, 0, 0, 10, 0, 0, 1, 239, 255, 0, 1]);
        frame.extend_from_slice(
            &[40_000_u16, port, length(8), 0]
                .map(u16::to_be_bytes)
                .concat(),
        );
        frame.extend_from_slice(&message);
        self.frame(time, &frame);
    }

    /// Adds a frame unchanged.
    pub fn frame(&mut self, time: u64, frame: &[u8]) {
        let length = u32::try_from(frame.len()).unwrap();
        let seconds = u32::try_from(time / 1_000_000_000).unwrap();
        let rest = u32::try_from(time % 1_000_000_000).unwrap();
        let header = [seconds, rest, length, length].map(u32::to_le_bytes);
        self.0.extend_from_slice(&header.concat());
        self.0.extend_from_slice(frame);
    }

    pub fn participant(&mut self, time: u64, domain_id: u16, prefix: GuidPrefix) {
        let payload = forge::participant(prefix, 100, Some(domain_id.into()));
        self.put(
            time,
            domain_id,
            Message::from(prefix).data(SPDP, 1, &payload),
        );
    }

    /// Adds the `number`th announcement of a writer of `std_msgs/msg/String`.
    pub fn writer(&mut self, time: u64, domain_id: u16, guid: Guid, topic: &str, number: u64) {
        let payload = forge::endpoint(guid, topic, "std_msgs::msg::dds_::String_", true);
        let message = Message::from(guid.prefix).data(SEDP_WRITERS, number, &payload);
        self.put(time, domain_id, message);
    }

    /// Adds the `number`th announcement of a reader.
    pub fn reader(&mut self, time: u64, domain_id: u16, guid: Guid, topic: &str, number: u64) {
        let payload = forge::endpoint(guid, topic, "std_msgs::msg::dds_::String_", true);
        let message = Message::from(guid.prefix).data(SEDP_READERS, number, &payload);
        self.put(time, domain_id, message);
    }

    /// Adds a sample of `std_msgs/msg/String`.
    pub fn sample(&mut self, time: u64, domain_id: u16, guid: Guid, number: u64) {
        let payload = b"\0\x01\0\0\x06\0\0\0hello\0\0\0";
        let message = Message::from(guid.prefix).info_ts(time);
        self.put(time, domain_id, message.data(guid.entity, number, payload));
    }

    pub fn write(&self, path: &Path) {
        std::fs::write(path, &self.0).unwrap();
    }
}

/// Returns the GUID of the `number`th writer of a participant.
pub fn writer(prefix: GuidPrefix, number: usize) -> Guid {
    let [_, .., high, low] = u32::try_from(number + 0x100).unwrap().to_be_bytes();
    Guid::new(prefix, EntityId([0, high, low, 0x03]))
}

/// Returns the GUID of the `number`th reader.
pub fn reader(prefix: GuidPrefix, number: usize) -> Guid {
    let [_, .., high, low] = u32::try_from(number + 0x100).unwrap().to_be_bytes();
    Guid::new(prefix, EntityId([0, high, low, 0x04]))
}
