//! Rates of the minutes before a moment, for the small charts of the page.

use std::collections::BTreeMap;

use serde::Deserialize;

use super::super::body_stream::write_line;
use super::super::live::rate_steps::{MAX_STEPS, Part, RateSteps, STEP_SECONDS};
use ros2probe_api::live::{History, Line};
use ros2probe_history::{Store, TopicName};

/// The part of the line with the graph that names the topics.
#[derive(Deserialize)]
struct GraphLine {
    graph: Topics,
}

#[derive(Deserialize)]
struct Topics {
    topics: Vec<ros2probe_api::live::Topic<'static>>,
}

/// Returns the lines of a state with the rates of the ten minutes before `at`, which stand in front
/// of the last line.
pub(super) fn with_rates(lines: &[u8], store: &Store, at: u32) -> Vec<u8> {
    let begin = lines.strip_suffix(b"\n").unwrap_or(lines);
    let last = begin.iter().rposition(|byte| *byte == b'\n');
    let last = last.map_or(0, |place| place + 1);
    let (before, values) = lines.split_at_checked(last).unwrap_or((lines, &[]));
    let mut all = before.to_vec();
    write_line(&mut all, &Line::History(rates(&topics(before), store, at)));
    all.extend_from_slice(values);
    all
}

/// Returns the numbers of the topics in the lines.
fn topics(lines: &[u8]) -> BTreeMap<TopicName, u32> {
    let mut lines = lines.split(|byte| *byte == b'\n');
    let graph = lines.find_map(|line| serde_json::from_slice::<GraphLine>(line).ok());
    let topics = graph.map_or_else(Vec::new, |line| line.graph.topics);
    let named = topics.into_iter().map(|topic| {
        let name = TopicName {
            domain_id: topic.1,
            dds_name: topic.3.into_owned(),
        };
        (name, topic.0)
    });
    named.collect()
}

fn rates(topics: &BTreeMap<TopicName, u32>, store: &Store, at: u32) -> History {
    let end = at.div_ceil(STEP_SECONDS);
    let first = end.saturating_sub(MAX_STEPS);
    let mut sums = RateSteps::new((end - first) as usize);
    store.topics(
        first * STEP_SECONDS..at,
        STEP_SECONDS,
        &|_| true,
        &mut |name, row| {
            let place = row.at.div_ceil(STEP_SECONDS).saturating_sub(first + 1);
            let part = Part {
                messages: row.messages,
                bytes: row.bytes as f64,
                lost: row.lost,
                seconds: row.seconds,
            };
            sums.add(place as usize, topics.get(name).copied(), part);
        },
    );
    let ends = (first + 1..=end).map(|step| f64::from((step * STEP_SECONDS).min(at)));
    sums.history(ends.map(|end| (end, f64::from(STEP_SECONDS))))
}

#[cfg(test)]
mod tests {
    use super::*;
    use ros2probe_api::live::Rates;
    use ros2probe_history::{Block, Series, Tier, TopicRow};

    #[test]
    fn rates_of_the_preceding_minute_are_inserted_before_the_values() {
        let directory = tempfile::tempdir().unwrap();
        let store = Store::open(directory.path(), 1 << 20).unwrap();
        let row = |at| TopicRow {
            at,
            seconds: 1,
            messages: 5,
            bytes: 500,
            lost: 1,
            ..TopicRow::default()
        };
        let of = TopicName {
            domain_id: 0,
            dds_name: "rt/imu".to_owned(),
        };
        let rows = (951..=985).map(row).collect();
        let block = Block::of_topics(950, 985, &[Series { of, rows }]);
        store.append(Tier::Seconds, &[block]).unwrap();
        let lines = "{\"open\":{}}\n\
            {\"graph\":{\"topics\":[[7,0,\"/imu\",\"rt/imu\",\"topic\",[],0,0,1,0]]}}\n\
            {\"values\":{}}\n";
        let all = String::from_utf8(with_rates(lines.as_bytes(), &store, 983)).unwrap();
        let all: Vec<&str> = all.lines().collect();
        assert_eq!((all.len(), all[3]), (4, "{\"values\":{}}"));
        let Line::History(history) = serde_json::from_str(all[2]).unwrap() else {
            panic!("{}", all[2]);
        };
        assert_eq!((history.t.len(), history.t[59]), (60, 983.0));
        let Rates(id, rates) = &history.topics[0];
        assert_eq!((*id, rates[55]), (7, None));
        // The last step is not whole.
        assert_eq!(rates[56..], [Some(5.0); 4]);
        assert_eq!(history.totals[0][56..], [5.0, 5.0, 5.0, 1.5]);
        assert_eq!(history.totals[2][59], 3.0);
    }
}
