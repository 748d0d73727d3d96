//! A peer's log of the samples that it sent or received: one JSON object per line.

use std::collections::BTreeSet;
use std::path::Path;

use anyhow::{Context as _, Result, ensure};
use serde::Deserialize;

/// One line. The fields present depend on `ev`.
#[derive(Clone, Debug, Deserialize)]
pub struct Event {
    /// Kind of event: `start`, `endpoint`, `pub`, `pub_failed`, `sub`, `error`, `stop` or `exit`.
    /// Peers of shapes also log `matched` and `incompatible`.
    pub ev: String,
    /// Unix time in nanoseconds.
    pub t: u64,
    /// The application's sequence number from 0; the DDS writer counts from 1.
    pub seq: Option<u64>,
    /// The DDS writer's sequence number, if the stack exposes it to a subscriber.
    pub sn: Option<u64>,
    /// Serialized size, including the encapsulation header.
    pub len: Option<u64>,
    pub stamp_ns: Option<u64>,
    pub kind: Option<String>,
    /// GUID: prefix and entity id, 32 hexadecimal digits.
    pub guid: Option<String>,
    pub topic: Option<String>,
    pub node: Option<String>,
    /// Process, in `start`.
    pub pid: Option<u64>,
    /// Key of a shape, in `sub`.
    pub color: Option<String>,
    /// Name of the incompatible policy.
    pub policy: Option<String>,
    /// Number of matched endpoints, in `matched`.
    pub total: Option<u64>,
}

pub struct EventLog(pub Vec<Event>);

impl EventLog {
    pub fn read(path: &Path) -> Result<EventLog> {
        let text = std::fs::read_to_string(path)
            .with_context(|| format!("cannot read {}", path.display()))?;
        let whole_lines = text.rfind('\n').map_or("", |end| &text[..end]);
        let events = whole_lines.lines().map(|line| {
            serde_json::from_str(line).with_context(|| format!("not an event: {line}"))
        });
        Ok(EventLog(events.collect::<Result<_>>()?))
    }

    /// Returns the application's sequence numbers of the events of one kind, in order of time.
    pub fn sequences(&self, ev: &str) -> Vec<u64> {
        self.0
            .iter()
            .filter(|event| event.ev == ev)
            .filter_map(|event| event.seq)
            .collect()
    }

    /// Returns the DDS writer's sequence numbers of the events of one kind.
    pub fn writer_numbers(&self, ev: &str) -> Result<BTreeSet<u64>> {
        let mut numbers = BTreeSet::new();
        for event in self.0.iter().filter(|event| event.ev == ev) {
            let number = event.seq.context("an event without a number")? + 1;
            ensure!(
                event.sn.is_none_or(|sn| sn == number),
                "the writer did not number its samples one by one: {event:?}"
            );
            ensure!(numbers.insert(number), "twice: {event:?}");
        }
        Ok(numbers)
    }

    /// Returns the number of samples missing between the first and the last one of this subscriber:
    /// the losses that an observer of the same link can detect.
    pub fn missing(&self) -> u64 {
        let received: BTreeSet<u64> = self.sequences("sub").into_iter().collect();
        match (received.first(), received.last()) {
            (Some(first), Some(last)) => last - first + 1 - received.len() as u64,
            _ => 0,
        }
    }

    pub fn endpoints(&self) -> impl Iterator<Item = &Event> {
        self.0.iter().filter(|event| event.ev == "endpoint")
    }
}
