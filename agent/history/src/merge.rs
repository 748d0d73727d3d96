//! Rows merged into longer steps.

use std::collections::BTreeMap;

use crate::rows::{ProcessRow, TopicRow};

/// A row that can be merged with another one.
pub trait Merge: Copy {
    /// Returns the end of the row, as Unix time.
    fn end_time(&self) -> u32;
    /// Extends this row by another one of the same step, which is usually later.
    fn extend(&mut self, other: &Self);
}

/// Merges rows of one topic or process into steps that end at multiples of `step` seconds, in the
/// order of their times. A merged row has the latest time of its rows.
#[must_use]
pub fn merged<R: Merge>(rows: &[R], step: u32) -> Vec<R> {
    let mut steps = Vec::new();
    for row in rows {
        merge_into(&mut steps, *row, step);
    }
    steps
}

/// Adds a row of a topic or process to its steps, as [`merged`] does.
pub fn merge_into<R: Merge>(steps: &mut Vec<R>, row: R, step: u32) {
    let number = |row: &R| row.end_time().div_ceil(step.max(1));
    let wanted = number(&row);
    let is_latest = steps.last().is_none_or(|last| number(last) < wanted);
    // A clock that was set back wrote earlier rows after later ones.
    let place = match is_latest {
        true => steps.len(),
        false => steps.partition_point(|each| number(each) < wanted),
    };
    match steps.get_mut(place) {
        Some(same) if number(same) == wanted => same.extend(&row),
        _ => steps.insert(place, row),
    }
}

/// Adds a row of one of several topics or processes, as [`merge_into`] does.
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
    fn extend(&mut self, other: &Self) {
        let weights = [self.messages, other.messages];
        self.latency = pair(self.latency, other.latency, weights);
        self.interarrival = pair(self.interarrival, other.interarrival, weights);
        self.at = self.at.max(other.at);
        self.seconds = self.seconds.saturating_add(other.seconds);
        self.messages = self.messages.saturating_add(other.messages);
        self.lost = self.lost.saturating_add(other.lost);
        self.bytes = self.bytes.saturating_add(other.bytes);
    }
}

impl Merge for ProcessRow {
    fn end_time(&self) -> u32 {
        self.at
    }

    fn extend(&mut self, other: &Self) {
        if other.at >= self.at {
            self.memory_kib = other.memory_kib;
        }
        self.at = self.at.max(other.at);
        self.seconds = self.seconds.saturating_add(other.seconds);
        self.cpu_ms = self.cpu_ms.saturating_add(other.cpu_ms);
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
    #[test]
    fn rows_in_the_order_of_a_clock_that_was_set_back_become_ascending_steps() {
        let row = |at| TopicRow {
            at,
            seconds: 1,
            messages: 1,
            ..TopicRow::default()
        };
        let rows: Vec<_> = (1..=30).chain(51..=60).chain(16..=45).map(row).collect();
        let steps = merged(&rows, 10);
        let seen: Vec<_> = steps.iter().map(|step| (step.at, step.messages)).collect();
        assert_eq!(
            seen,
            [(10, 10), (20, 15), (30, 20), (40, 10), (45, 5), (60, 10)]
        );
        let process = |at| ProcessRow {
            at,
            seconds: 1,
            cpu_ms: 1,
            memory_kib: at.into(),
        };
        let steps = merged(&[process(8), process(3)], 10);
        assert_eq!(
            (steps[0].at, steps[0].memory_kib, steps[0].cpu_ms),
            (8, 8, 2)
        );
    }
}
