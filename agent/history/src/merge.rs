//! Rows merged into longer steps.

use std::collections::BTreeMap;

use crate::rows::{ProcessRow, TopicRow};

/// A row that can be merged with a later one.
pub trait Merge: Copy {
    /// Returns the end of the row, as Unix time.
    fn end_time(&self) -> u32;
    /// Extends this row by a later one.
    fn extend(&mut self, later: &Self);
}

/// Merges rows of one topic or process into steps that end at multiples of `step` seconds. A merged
/// row has the time of its last row. Rows must be in the order of their times.
#[must_use]
pub fn merged<R: Merge>(rows: &[R], step: u32) -> Vec<R> {
    let mut steps = Vec::new();
    for row in rows {
        merge_into(&mut steps, *row, step);
    }
    steps
}

/// Appends the next row of a topic or process to its steps, as [`merged`] does.
pub fn merge_into<R: Merge>(steps: &mut Vec<R>, row: R, step: u32) {
    let end = |row: &R| row.end_time().div_ceil(step.max(1));
    match steps.last_mut() {
        Some(last) if end(last) == end(&row) => last.extend(&row),
        _ => steps.push(row),
    }
}

/// Adds the next row of one of several topics or processes, as [`merge_into`] does.
pub fn merge_by_name<N: Ord + Clone, R: Merge>(
    all: &mut BTreeMap<N, Vec<R>>,
    name: &N,
    row: R,
    step: u32,
) {
    match all.get_mut(name) {
        Some(steps) => merge_into(steps, row, step),
        None => drop(all.insert(name.clone(), vec![row])),
    }
}

impl Merge for TopicRow {
    fn end_time(&self) -> u32 {
        self.at
    }

    /// Adds the counts. The medians become their mean, weighted by the messages; of the 99th
    /// percentiles the higher one stays.
    fn extend(&mut self, later: &Self) {
        let weights = [self.messages, later.messages];
        self.latency = pair(self.latency, later.latency, weights);
        self.interarrival = pair(self.interarrival, later.interarrival, weights);
        self.at = later.at;
        self.seconds = self.seconds.saturating_add(later.seconds);
        self.messages = self.messages.saturating_add(later.messages);
        self.lost = self.lost.saturating_add(later.lost);
        self.bytes = self.bytes.saturating_add(later.bytes);
    }
}

impl Merge for ProcessRow {
    fn end_time(&self) -> u32 {
        self.at
    }

    fn extend(&mut self, later: &Self) {
        self.at = later.at;
        self.seconds = self.seconds.saturating_add(later.seconds);
        self.cpu_ms = self.cpu_ms.saturating_add(later.cpu_ms);
        self.memory_kib = later.memory_kib;
    }
}

fn pair(one: Option<[f32; 2]>, other: Option<[f32; 2]>, weights: [u32; 2]) -> Option<[f32; 2]> {
    let (Some([median, high]), Some([later_median, later_high])) = (one, other) else {
        return one.or(other);
    };
    let [weight, later_weight] = weights.map(|weight| f64::from(weight.max(1)));
    let sum = f64::from(median) * weight + f64::from(later_median) * later_weight;
    #[expect(clippy::cast_possible_truncation, reason = "between two f32")]
    let mean = (sum / (weight + later_weight)) as f32;
    Some([mean, high.max(later_high)])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_have_the_sums_of_their_rows() {
        let row = |at, messages, median| TopicRow {
            at,
            seconds: 1,
            messages,
            lost: 1,
            bytes: 10,
            latency: Some([median, 2.0 * median]),
            interarrival: None,
        };
        let rows = [
            row(9, 1, 1.0),
            row(10, 3, 5.0),
            row(11, 1, 1.0),
            row(35, 1, 1.0),
        ];
        let steps = merged(&rows, 10);
        assert_eq!(
            steps[0],
            TopicRow {
                at: 10,
                seconds: 2,
                messages: 4,
                lost: 2,
                bytes: 20,
                latency: Some([4.0, 10.0]),
                interarrival: None,
            }
        );
        assert_eq!(
            steps.iter().map(|step| step.at).collect::<Vec<_>>(),
            [10, 11, 35]
        );
        let process = |at, cpu_ms| ProcessRow {
            at,
            seconds: 10,
            cpu_ms,
            memory_kib: at.into(),
        };
        let rows = [process(10, 5), process(20, 7)];
        let whole = ProcessRow {
            at: 20,
            seconds: 20,
            cpu_ms: 12,
            memory_kib: 20,
        };
        assert_eq!(merged(&rows, 60), [whole]);
        assert_eq!(merged(&rows, 0), rows);
    }
}
