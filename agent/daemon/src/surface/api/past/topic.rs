//! `/topics/{topic}/history` with times: the rows on disk, and those that are not written yet.

use std::collections::VecDeque;

use axum::Json;
use axum::response::Response;

use super::super::history::{stored_precision, thousandths};
use super::super::problem::{Code, Problem};
use super::super::scope::Domain;
use super::super::topics::find;
use super::super::{Context, in_turn};
use super::query::{self, TimeRange, Times};
use super::writer::{seconds, topic_row};
use ros2probe_api::topics::History;
use ros2probe_history::{Tier, TopicName, TopicRow, merge_into};
use ros2probe_wire::DomainId;

/// Time over which a rate is taken, in seconds.
const RATE_WINDOW_SECONDS: u32 = 10;

/// Answers with the history of a topic, also of one that no longer exists.
pub(in super::super) async fn show(
    context: &Context,
    name: &str,
    domain: Domain,
    range: TimeRange,
) -> Result<Response, Problem> {
    let times = range.checked(query::now(context))?;
    let state = context.latest.state();
    let domain = domain.checked()?;
    let found = find(state.known(), name, domain).map(|topic| {
        let of = TopicName {
            domain_id: topic.domain_id.0,
            dds_name: topic.dds_name.to_string(),
        };
        (of, topic.name.to_string())
    });
    let found = match found {
        Err(problem) if problem.code() != Code::NoSuchTopic => return Err(problem),
        found => found,
    };
    let past = context.latest.past();
    let wanted = found.as_ref().ok().map(|(of, _)| of.clone());
    // Only topics of ROS are found after their end.
    let former = format!("rt{name}");
    let stored = query::read_store(context, move |store| {
        let mut times = times;
        let is_wanted = |of: &TopicName| match &wanted {
            Some(wanted) => of == wanted,
            None => of.dds_name == former && domain.admits(DomainId(of.domain_id)),
        };
        let seconds = store.begin_after(Tier::Seconds, times.from);
        if seconds.is_none_or(|begin| begin > times.from) {
            times.step = times.step.max(RATE_WINDOW_SECONDS);
        }
        let (mut steps, mut first) = (Vec::new(), None::<TopicName>);
        // The rate of the first row needs the time before it.
        let begin = times.from.saturating_sub(RATE_WINDOW_SECONDS);
        store.topics(begin..times.to, times.step, &is_wanted, &mut |of, row| {
            // A former topic of this name may have been in several domains. The first one is
            // shown; `domain_id` selects another.
            if first.get_or_insert_with(|| of.clone()) == of {
                merge_into(&mut steps, row, times.step);
            }
        });
        (times, steps, first)
    });
    let ((times, mut steps, first), _permit) = stored.await?;
    let (of, name) = match (found, first) {
        (Ok(found), _) => found,
        (Err(_), Some(first)) => (first, name.to_owned()),
        (Err(problem), None) => return Err(problem),
    };
    let written = steps.last().map_or(0, |row| row.at);
    let readings = past.topic(DomainId(of.domain_id), &of.dds_name);
    for (at, reading) in readings.into_iter().flatten() {
        let at = seconds(at);
        if let Some(reading) = reading.filter(|_| at > written && at <= times.to) {
            merge_into(&mut steps, topic_row(at, &reading.row), times.step);
        }
    }
    let mut view = columns(&steps, times);
    view.topic = name;
    view.domain_id = of.domain_id;
    view.timestamp_seconds = state.known().time().seconds();
    Ok(in_turn(context, async { Json(view) }).await)
}

/// Returns one row for each step, also for steps without a measurement.
fn columns(steps: &[TopicRow], times: Times) -> History {
    let mut view = History {
        interval_seconds: times.step,
        ..History::default()
    };
    let mut steps = steps.iter().peekable();
    let mut window: VecDeque<&TopicRow> = VecDeque::new();
    let first = (times.from / times.step + 1) * times.step;
    // Steps before the first one only count for its rate.
    while let Some(row) = steps.next_if(|row| row.at <= first.saturating_sub(times.step)) {
        window.push_back(row);
    }
    for end in (first..=times.to.next_multiple_of(times.step)).step_by(times.step as usize) {
        let row = steps.next_if(|row| row.at <= end);
        window.extend(row);
        let reach = RATE_WINDOW_SECONDS.max(times.step);
        while window
            .front()
            .is_some_and(|oldest| oldest.at + reach <= end)
        {
            window.pop_front();
        }
        view.times.push(f64::from(end.min(times.to)));
        view.messages.push(row.map(|row| row.messages));
        view.lost_messages.push(row.map(|row| row.lost));
        let covered: u32 = window.iter().map(|row| row.seconds).sum();
        let rate = |count: u64| row.map(|_| count as f64 / f64::from(covered.max(1)));
        let messages = window.iter().map(|row| u64::from(row.messages)).sum();
        let bytes = window.iter().map(|row| row.bytes).sum();
        view.rate_hertz.push(rate(messages).map(thousandths));
        view.bandwidth_bytes_per_second
            .push(rate(bytes).map(f64::round));
        let latency = row.and_then(|row| row.latency);
        let interarrival = row.and_then(|row| row.interarrival);
        for (column, value) in [
            (
                &mut view.latency_p50_seconds,
                latency.map(|[median, _]| median),
            ),
            (&mut view.latency_p99_seconds, latency.map(|[_, high]| high)),
            (
                &mut view.interarrival_p50_seconds,
                interarrival.map(|[median, _]| median),
            ),
            (
                &mut view.interarrival_p99_seconds,
                interarrival.map(|[_, high]| high),
            ),
        ] {
            column.push(value.map(stored_precision));
        }
    }
    view
}

#[cfg(test)]
mod tests {
    use super::*;
    use ros2probe_history::merged;

    #[test]
    fn each_step_has_a_row_and_the_rate_of_its_window() {
        let row = |at| TopicRow {
            at,
            seconds: 1,
            messages: 5,
            bytes: 500,
            latency: Some([0.001, 0.002]),
            ..TopicRow::default()
        };
        let rows: Vec<_> = (90..=104).chain(108..=110).map(row).collect();
        let times = Times {
            from: 100,
            to: 110,
            step: 1,
        };
        let view = columns(&rows, times);
        assert!(view.times.iter().copied().eq((101..=110).map(f64::from)));
        assert_eq!(view.messages[3..8], [Some(5), None, None, None, Some(5)]);
        assert_eq!(view.rate_hertz[0], Some(5.0));
        assert_eq!((view.rate_hertz[5], view.rate_hertz[9]), (None, Some(5.0)));
        assert_eq!(view.bandwidth_bytes_per_second[9], Some(500.0));
        assert_eq!(view.latency_p99_seconds[0], Some(0.002));
        let times = Times {
            from: 95,
            to: 110,
            step: 10,
        };
        let view = columns(&merged(&rows, 10), times);
        assert_eq!(view.times, [100.0, 110.0]);
        // A step has the whole of its rows, also those before the begin.
        assert_eq!(view.messages, [Some(50), Some(35)]);
        assert_eq!(view.rate_hertz, [Some(5.0), Some(5.0)]);
    }
}
