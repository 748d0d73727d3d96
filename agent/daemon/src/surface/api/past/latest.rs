//! The latest part of an answer that has a cap: rows of processes, and events. Both are added in
//! the order of their times.

use std::collections::{BTreeMap, VecDeque};

use super::super::processes::MAX_PROCESSES;
use ros2probe_history::{ProcessName, ProcessRow, merge_by_name};

/// Maximum length of the events in one answer, in bytes.
const MAX_EVENT_BYTES: usize = 8 << 20;

/// Rows of processes. Beyond [`MAX_PROCESSES`], those that ended first are left out.
#[derive(Debug, Default)]
pub(super) struct LatestProcesses {
    rows: BTreeMap<ProcessName, Vec<ProcessRow>>,
    is_truncated: bool,
}

/// Blocks of events. Beyond [`MAX_EVENT_BYTES`], the oldest are left out.
#[derive(Debug, Default)]
pub(super) struct LatestEvents {
    blocks: VecDeque<Vec<u8>>,
    bytes: usize,
    is_truncated: bool,
}

impl LatestProcesses {
    /// Adds the next row of a process, merged into steps of `step` seconds.
    pub(super) fn add(&mut self, name: &ProcessName, row: ProcessRow, step: u32) {
        if self.rows.len() >= MAX_PROCESSES && !self.rows.contains_key(name) {
            self.is_truncated = true;
            let end = |rows: &[ProcessRow]| rows.last().map_or(0, |row| row.at);
            let first = self.rows.iter().min_by_key(|(_, rows)| end(rows));
            if let Some(first) = first.map(|(name, _)| name.clone()) {
                self.rows.remove(&first);
            }
        }
        merge_by_name(&mut self.rows, name, row, step);
    }

    /// Returns whether processes, or rows of them, are missing.
    pub(super) const fn is_truncated(&self) -> bool {
        self.is_truncated
    }

    /// Returns the processes in the order of their ids.
    pub(super) fn into_rows(self) -> impl Iterator<Item = (ProcessName, Vec<ProcessRow>)> {
        self.rows.into_iter()
    }
}

impl LatestEvents {
    /// Adds the next block of lines.
    pub(super) fn add(&mut self, lines: Vec<u8>) {
        self.bytes += lines.len();
        self.blocks.push_back(lines);
        while self.bytes > MAX_EVENT_BYTES
            && let Some(first) = self.blocks.pop_front()
        {
            self.bytes -= first.len();
            self.is_truncated = true;
        }
    }

    /// Returns whether events are missing.
    pub(super) const fn is_truncated(&self) -> bool {
        self.is_truncated
    }

    /// Returns the lines of all events, the oldest first.
    pub(super) fn into_lines(self) -> Vec<u8> {
        let mut lines = Vec::with_capacity(self.bytes);
        for block in self.blocks {
            lines.extend_from_slice(&block);
        }
        lines
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Earlier, the processes of the first hours filled the answer, and the running ones were
    /// missing.
    #[test]
    fn processes_beyond_the_cap_of_an_answer_are_those_that_ended_first() {
        let name = |id| ProcessName {
            id,
            name: "node".to_owned(),
        };
        let row = |at| ProcessRow {
            at,
            seconds: 1,
            ..ProcessRow::default()
        };
        let cap = u32::try_from(MAX_PROCESSES).unwrap();
        let mut latest = LatestProcesses::default();
        // The first process runs all the time, and each minute brings another one.
        for minute in 1..=cap + 9 {
            latest.add(&name(0), row(60 * minute), 1);
            latest.add(&name(minute), row(60 * minute), 1);
            assert_eq!(latest.is_truncated(), minute >= cap, "{minute}");
        }
        let rows: Vec<_> = latest.into_rows().collect();
        assert_eq!(rows.len(), MAX_PROCESSES);
        assert_eq!((rows[0].0.id, rows[0].1.len()), (0, MAX_PROCESSES + 9));
        assert_eq!((rows[1].0.id, rows[511].0.id), (11, cap + 9));
    }

    /// Earlier, a block that did not fit was skipped, and smaller ones after it were not.
    #[test]
    fn events_beyond_the_cap_of_an_answer_are_the_oldest_without_a_hole() {
        let mut latest = LatestEvents::default();
        let block = |letter: char, length: usize| letter.to_string().repeat(length);
        let half = MAX_EVENT_BYTES / 2;
        for (letter, length) in [('a', 10), ('b', half), ('c', half - 10)] {
            latest.add(block(letter, length).into_bytes());
        }
        assert!(!latest.is_truncated());
        latest.add(block('d', 11).into_bytes());
        latest.add(block('e', 1).into_bytes());
        assert!(latest.is_truncated());
        let lines = String::from_utf8(latest.into_lines()).unwrap();
        assert_eq!(lines.len(), half + 2);
        assert!(lines.starts_with("cc") && lines.ends_with("cddddddddddde"));
    }
}
