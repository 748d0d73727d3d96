//! Findings about measured topics: expectations of watches, and losses. The texts contain limits and
//! names, but no measured numbers: those change each second, and the page has them.

use std::cmp::Reverse;

use super::findings::{Circumstances, finding};
use super::values::{LOSS, lost_lately};
use ros2probe_api::live::{Finding, Severity};
use ros2probe_model::facts::names::NodeName;
use ros2probe_model::facts::route::Direction;
use ros2probe_model::facts::watch::Expectations;
use ros2probe_model::measure::history::Past;
use ros2probe_model::report::snapshot::{TopicFacts, WatchState};

/// Returns a finding for each violated expectation of a watch.
pub(super) fn of_watches(all: &Circumstances<'_>) -> Vec<Finding> {
    let mut list = Vec::new();
    for watch in &all.snapshot.watches {
        for topic in &watch.topics {
            let (kind, text) = match topic.state {
                WatchState::Violated => {
                    let expectations = &watch.watch.expectations;
                    let broken = topic.violations.iter();
                    let broken = broken.map(|key| expected(key, expectations));
                    let broken: Vec<_> = broken.collect();
                    let text = format!("{} is not as expected: {}", topic.topic, broken.join(", "));
                    ("watch_violated", text)
                }
                WatchState::Silent => {
                    let longest = expected("max_silence_s", &watch.watch.expectations);
                    let text = format!("{} is silent: {longest} is expected", topic.topic);
                    ("watch_silent", text)
                }
                WatchState::Ok | WatchState::NotPublished | WatchState::NoSubscriber => continue,
            };
            let mut topics = all.snapshot.topics.iter();
            let facts = topics
                .find(|facts| facts.domain_id == topic.domain_id && facts.name == topic.topic);
            let about = format!(
                "{}|{}|{}",
                topic.domain_id, topic.topic, watch.watch.pattern
            );
            list.push(Finding {
                domain_id: Some(topic.domain_id.0),
                topic: facts.and_then(|facts| all.ids.topic(facts.domain_id, &facts.dds_name)),
                ..finding(kind, Severity::Error, &about, text)
            });
        }
    }
    list
}

/// Returns an expectation in words, by its key in the configuration.
fn expected(key: &str, expectations: &Expectations) -> String {
    let values = expectations.values();
    let number = |limit: Option<f64>| limit.unwrap_or_default();
    let several = |limit: Option<u32>, noun: &str| match limit.unwrap_or_default() {
        1 => format!("at least 1 {noun}"),
        count => format!("at least {count} {noun}s"),
    };
    match key {
        "min_rate_hz" => format!("at least {} Hz", number(values.min_rate_hz)),
        "max_rate_hz" => format!("at most {} Hz", number(values.max_rate_hz)),
        "max_loss_ratio" => {
            // Without the digits that no double has.
            let percent = (number(values.max_loss_ratio) * 1e6).round() / 1e4;
            format!("a loss of at most {percent} %")
        }
        "max_latency_ms" => format!("a latency of at most {} ms", number(values.max_latency_ms)),
        "max_silence_s" => format!(
            "a message at least every {} s",
            number(values.max_silence_s)
        ),
        "publishers" => several(values.publishers, "publisher"),
        "subscribers" => several(values.subscribers, "subscriber"),
        _ => key.to_owned(),
    }
}

/// Returns a finding with the cause for each topic that lost messages recently.
pub(super) fn losses(all: &Circumstances<'_>) -> Vec<Finding> {
    let lost = lost_lately(all.past);
    let topics = all.snapshot.topics.iter();
    let found = topics.filter_map(|topic| {
        let known = all.past.id(topic.domain_id, &topic.dds_name)?;
        lost.get(&known)?;
        let (place, remedy) = died(topic);
        let receiver = worst_receiver(topic).map_or_else(String::new, |name| format!(" to {name}"));
        let text = format!("{} loses messages{receiver}{place}", topic.name);
        let about = format!("{}|{}", topic.domain_id, topic.dds_name);
        let loss = Finding {
            domain_id: Some(topic.domain_id.0),
            topic: all.ids.topic(topic.domain_id, &topic.dds_name),
            since: began(all.past, known),
            ..finding("loss", Severity::Error, &about, text)
        };
        Some(loss.with_remedy(remedy))
    });
    found.collect()
}

/// Returns the nodes, or the process, of the receiver that lost most messages of a topic.
fn worst_receiver(topic: &TopicFacts) -> Option<String> {
    let deliveries = topic.deliveries.iter();
    let lossy = deliveries
        .filter(|each| each.direction == Direction::Received && each.delivered.lost() > 0);
    let worst = lossy.min_by_key(|each| Reverse(each.delivered.lost()))?;
    if !worst.nodes.is_empty() {
        let nodes: Vec<_> = worst.nodes.iter().map(NodeName::as_str).collect();
        return Some(nodes.join(", "));
    }
    let process = worst.process.as_ref().zip(worst.process_id)?;
    Some(format!("{} {}", process.0, process.1))
}

/// Returns where most of a topic's messages were lost, if known, and the remedy.
fn died(topic: &TopicFacts) -> (&'static str, &'static str) {
    let received = topic.received.as_deref();
    let at = received.map_or([0; 4], |received| {
        [
            received.lost_at_sender,
            received.lost_before_host,
            received.lost_in_reassembly,
            received.lost_in_socket_buffer,
        ]
    });
    let most = at.iter().copied().max().unwrap_or_default();
    let [sender, before, reassembly, _] = at;
    if most == 0 {
        (
            "",
            "compare the loss of each subscriber on the topic's page; `rp doctor` checks buffers",
        )
    } else if most == sender {
        (
            ", most of them at the sender, before its TCP connection",
            "send less over this link, or raise the publisher's history depth and TCP send buffer",
        )
    } else if most == before {
        (
            ", most of them before they reach this host",
            "check the network and the sender's host",
        )
    } else if most == reassembly {
        (
            ", most of them in IP reassembly",
            "raise net.ipv4.ipfrag_high_thresh, or send smaller messages; `rp doctor` checks it",
        )
    } else {
        (
            ", most of them in the full buffer of a subscriber's socket",
            "raise net.core.rmem_max and the receive buffer, or read faster; `rp doctor` checks it",
        )
    }
}

/// Returns when the current loss began. Pauses of up to [`LOSS`] seconds do not end a loss. Returns
/// `None` without a recent loss.
fn began(past: &Past, topic: u32) -> Option<f64> {
    let mut began = None;
    let mut pause = 0;
    for second in past.seconds().iter().rev() {
        if second.row(topic).is_some_and(|row| row.lost > 0) {
            (began, pause) = (Some(second.at.seconds()), 0);
        } else {
            pause += 1;
        }
        if pause > LOSS {
            break;
        }
    }
    began
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn every_expectation_has_words_with_its_limit() {
        let expectations = Expectations {
            min_rate_hz: Some(85.0),
            max_rate_hz: Some(95.0),
            window_s: None,
            max_loss_ratio: Some(0.01),
            max_latency: Some(Duration::from_millis(20)),
            max_silence: Some(Duration::from_millis(1500)),
            publishers: Some(2),
            subscribers: Some(3),
        };
        let words = expectations
            .keys()
            .map(|(key, _)| expected(key, &expectations));
        assert_eq!(
            words,
            [
                "at least 85 Hz",
                "at most 95 Hz",
                "a loss of at most 1 %",
                "a latency of at most 20 ms",
                "a message at least every 1.5 s",
                "at least 2 publishers",
                "at least 3 subscribers",
            ]
        );
    }

    #[test]
    fn limits_have_no_digits_of_rounding_and_one_publisher_is_singular() {
        let expectations = Expectations {
            max_loss_ratio: Some(0.07),
            max_latency: Some(Duration::from_micros(1100)),
            publishers: Some(1),
            ..Expectations::default()
        };
        let words = ["max_loss_ratio", "max_latency_ms", "publishers"];
        assert_eq!(
            words.map(|key| expected(key, &expectations)),
            [
                "a loss of at most 7 %",
                "a latency of at most 1.1 ms",
                "at least 1 publisher"
            ]
        );
    }
}
