//! One participant of a crowd: its endpoints and its messages.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use super::super::{
    PARTICIPANT, PUBLICATIONS_WRITER, Parameters, SPDP_WRITER, SUBSCRIPTIONS_WRITER, data, text_of,
};
use super::{ENTITIES_READER, ENTITIES_TYPE, ENTITIES_WRITER, LATE, PERMANENT_MEMBERS, TYPE};

pub(super) struct Member {
    pub(super) prefix: [u8; 12],
    pub(super) slot: usize,
    pub(super) lease: Duration,
    pub(super) node: String,
    pub(super) endpoints: BTreeMap<[u8; 4], String>,
    /// Sequence numbers of announcements of writers, readers and nodes.
    pub(super) numbers: [u32; 3],
    pub(super) entity: u16,
    pub(super) seen: Instant,
}

impl Member {
    pub(super) fn stays(&self) -> bool {
        self.slot < PERMANENT_MEMBERS
    }

    pub(super) fn is_late(&self) -> bool {
        self.seen.elapsed() > self.lease.mul_f64(LATE)
    }

    /// Returns the end of its lease.
    pub(super) fn ends(&self) -> Instant {
        self.seen + self.lease
    }

    pub(super) fn add(&mut self, kind: u8, topic: String) -> [u8; 4] {
        self.entity += 1;
        let entity = entity(self.entity, kind);
        self.endpoints.insert(entity, topic);
        entity
    }

    pub(super) fn next_number(&mut self, entity: [u8; 4]) -> u32 {
        let number = &mut self.numbers[usize::from(entity[3] == 4)];
        *number += 1;
        *number
    }

    pub(super) fn number_endpoints(&mut self) {
        for entity in self.endpoints.keys() {
            self.numbers[usize::from(entity[3] == 4)] += 1;
        }
    }

    /// Returns all its announcements, as a new participant sends them.
    pub(super) fn introduction(&self) -> Vec<Vec<u8>> {
        let mut messages = vec![self.announcement()];
        let mut numbers = self.numbers;
        for entity in self.endpoints.keys().rev() {
            let number = &mut numbers[usize::from(entity[3] == 4)];
            messages.push(self.endpoint(*entity, *number));
            *number -= 1;
        }
        messages.push(self.entities());
        messages
    }

    pub(super) fn announcement(&self) -> Vec<u8> {
        let lease = u32::try_from(self.lease.as_secs()).unwrap_or(u32::MAX);
        let mut list = Parameters::new();
        list.add(0x15, &[2, 3, 0, 0]);
        list.add(0x16, &[1, 0x0f, 0, 0]);
        list.add(0x50, &[&self.prefix[..], &PARTICIPANT].concat());
        list.add(0x02, &[lease.to_le_bytes(), [0; 4]].concat());
        list.add(0x0f, &[0; 4]);
        self.message(SPDP_WRITER, 1, &list.finish())
    }

    pub(super) fn endpoint(&self, entity: [u8; 4], number: u32) -> Vec<u8> {
        let topic = self.endpoints.get(&entity).map_or("", String::as_str);
        let kind = match entity {
            ENTITIES_WRITER | ENTITIES_READER => ENTITIES_TYPE,
            _ => TYPE,
        };
        let mut list = Parameters::new();
        list.add(0x5a, &[&self.prefix[..], &entity].concat());
        list.add_text(0x05, topic);
        list.add_text(0x07, kind);
        list.add(0x1a, &[1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]);
        self.message(announcer(entity), number, &list.finish())
    }

    /// Returns `ros_discovery_info` with 16-byte gids: one node with all endpoints.
    pub(super) fn entities(&self) -> Vec<u8> {
        let mut bytes = vec![0, 1, 0, 0];
        bytes.extend_from_slice(&self.prefix);
        bytes.extend_from_slice(&PARTICIPANT);
        bytes.extend_from_slice(&1_u32.to_le_bytes());
        for text in ["/", &self.node] {
            bytes.extend_from_slice(&text_of(text));
        }
        for kind in [4, 3] {
            let own: Vec<_> = self.endpoints.keys().filter(|it| it[3] == kind).collect();
            let count = u32::try_from(own.len()).unwrap_or(0);
            bytes.extend_from_slice(&count.to_le_bytes());
            for entity in own {
                bytes.extend_from_slice(&self.prefix);
                bytes.extend_from_slice(entity);
            }
        }
        self.message(ENTITIES_WRITER, 1, &bytes)
    }

    /// Returns a disposal in the form of Cyclone DDS (key) or Fast DDS (key hash).
    pub(super) fn disposal(
        &self,
        writer: [u8; 4],
        number: u32,
        entity: [u8; 4],
        by_key: bool,
    ) -> Vec<u8> {
        let guid = [&self.prefix[..], &entity].concat();
        let mut inline = Vec::new();
        let mut parameter = |id: u16, value: &[u8]| {
            inline.extend_from_slice(&id.to_le_bytes());
            inline.extend_from_slice(&u16::try_from(value.len()).unwrap_or(0).to_le_bytes());
            inline.extend_from_slice(value);
        };
        if !by_key {
            parameter(0x70, &guid);
        }
        parameter(0x71, &[0, 0, 0, 3]);
        parameter(1, &[]);
        if by_key {
            let mut key = Parameters::new();
            key.add(if entity == PARTICIPANT { 0x50 } else { 0x5a }, &guid);
            inline.extend_from_slice(&key.finish());
        }
        let mut message = self.message(writer, number, &inline);
        // Flags for inline QoS, and for a key instead of data or no payload.
        message[21] = if by_key { 0x0b } else { 0x03 };
        message
    }

    pub(super) fn message(&self, writer: [u8; 4], number: u32, payload: &[u8]) -> Vec<u8> {
        let mut bytes = [&b"RTPS\x02\x03\x01\x0f"[..], &self.prefix].concat();
        data(&mut bytes, writer, number, payload);
        bytes
    }
}

pub(super) fn entity(number: u16, kind: u8) -> [u8; 4] {
    let [high, low] = number.to_be_bytes();
    [0, high, low, kind]
}

/// Returns the builtin writer that announces an endpoint.
pub(super) fn announcer(entity: [u8; 4]) -> [u8; 4] {
    if entity[3] == 3 {
        PUBLICATIONS_WRITER
    } else {
        SUBSCRIPTIONS_WRITER
    }
}

pub(super) fn role(entity: [u8; 4]) -> &'static str {
    if entity[3] == 3 { "writer" } else { "reader" }
}

/// Returns a GUID in the agent's text form.
pub(super) fn guid(prefix: &[u8; 12], entity: [u8; 4]) -> String {
    let hexadecimal =
        |bytes: &[u8]| -> String { bytes.iter().map(|byte| format!("{byte:02x}")).collect() };
    format!("{}.{}", hexadecimal(prefix), hexadecimal(&entity))
}
