//! The events of a time: those of the blocks on disk, and those of the log that are in no block
//! yet.

use std::collections::BTreeMap;
use std::ops::RangeInclusive;

use jiff::Timestamp;
use serde::Deserialize;

use super::super::body_stream::write_line;
use super::super::events::event;
use super::query::Times;
use crate::events::{EventLog, Position};

/// Number of events that are read from the log at once.
const LOG_BATCH: usize = 512;

/// Selects the events of a time, each once.
pub(super) struct EventRange<'a> {
    log: &'a EventLog,
    /// Unix times in whole seconds.
    times: RangeInclusive<i64>,
    /// Lines of the events in the log that no visited block has, by number.
    unwritten: BTreeMap<u64, Vec<u8>>,
}

/// The part of a line that is compared.
#[derive(Deserialize)]
struct EventHead<'a> {
    id: &'a str,
    time: &'a str,
}

impl<'a> EventRange<'a> {
    /// Selects the events of a time from the log of now, and from the blocks that follow.
    pub(super) fn new(log: &'a EventLog, times: Times) -> Self {
        let times: RangeInclusive<i64> = times.from.into()..=times.to.into();
        let mut unwritten = BTreeMap::new();
        let mut place = 0;
        loop {
            let batch = log.read(place, LOG_BATCH);
            if batch.records.is_empty() {
                break;
            }
            place = batch.last;
            for record in &batch.records {
                let second = i64::try_from(record.at.whole_seconds()).unwrap_or(i64::MAX);
                if times.contains(&second) {
                    let mut line = Vec::new();
                    write_line(&mut line, &event(log, record));
                    unwritten.insert(record.number, line);
                }
            }
        }
        Self {
            log,
            times,
            unwritten,
        }
    }

    /// Returns the lines of a block whose events are in the time.
    pub(super) fn of_block(&mut self, lines: &[u8]) -> Vec<u8> {
        let mut selected = Vec::new();
        for line in lines.split_inclusive(|byte| *byte == b'\n') {
            let Ok(head) = serde_json::from_slice::<EventHead<'_>>(line) else {
                continue;
            };
            if let Some(Position::After(number)) = self.log.position(head.id) {
                self.unwritten.remove(&number);
            }
            let time = head.time.parse::<Timestamp>();
            if time.is_ok_and(|time| self.times.contains(&time.as_second())) {
                selected.extend_from_slice(line);
            }
        }
        selected
    }

    /// Returns the lines of the events that the visited blocks do not have.
    pub(super) fn unwritten(self) -> Vec<u8> {
        self.unwritten.into_values().flatten().collect()
    }
}

#[cfg(test)]
mod tests {
    use ros2probe_wire::Timestamp as WireTimestamp;
    use ros2probe_wire::time::SECOND;

    use super::*;

    /// Returns the times of the events in lines.
    fn times(lines: &[u8]) -> Vec<String> {
        let lines = str::from_utf8(lines).unwrap().lines();
        let time = |line| serde_json::from_str::<EventHead<'_>>(line).unwrap().time;
        lines
            .map(time)
            .map(|time| time.split(['T', '.']).nth(1).unwrap().to_owned())
            .collect()
    }

    #[test]
    fn events_of_a_time_include_those_that_are_not_on_disk_yet_and_no_others() {
        let log = EventLog::new();
        for second in [10, 20, 30, 40, 50] {
            let at = WireTimestamp(second * SECOND);
            log.lose_messages(1, at, at);
        }
        let mut block = Vec::new();
        for record in &log.read(0, 3).records {
            write_line(&mut block, &event(&log, record));
        }
        // An event of an earlier run has the number of a later one.
        let earlier = b"{\"id\":\"1-4\",\"time\":\"1970-01-01T00:00:15Z\"}\n";
        block.extend_from_slice(earlier);
        let range = Times {
            from: 15,
            to: 40,
            step: 1,
        };
        let mut selected = EventRange::new(&log, range);
        let of_block = times(&selected.of_block(&block));
        assert_eq!(of_block, ["00:00:20", "00:00:30", "00:00:15Z"]);
        assert_eq!(times(&selected.unwritten()), ["00:00:40"]);
    }
}
