//! Findings about measured topics: expectations of watches, and losses. The texts contain limits
//! and names, but no measured numbers: those change each second, and the page has them.

use std::cmp::Reverse;

use super::super::watch::expectations;
use super::findings::{FindingInputs, finding};
use super::values::{LOSS_FLAG_SECONDS, recent_losses};
use ros2probe_api::live::{Finding, Severity};
use ros2probe_model::facts::names::NodeName;
use ros2probe_model::facts::route::Direction;
use ros2probe_model::measure::history::Past;
use ros2probe_model::report::snapshot::{TopicFacts, WatchState};

/// Returns a finding for each violated expectation of a watch.
pub(super) fn of_watches(all: &FindingInputs<'_>) -> Vec<Finding> {
    let mut list = Vec::new();
    for watch in &all.snapshot.watches {
        for topic in &watch.topics {
            let (kind, text) = match topic.state {
                WatchState::Violated => {
                    let expectations = expectations(&watch.watch.expectations);
                    let broken = topic.violations.iter();
                    let broken = broken.map(|key| expectations.in_words(key));
                    let broken: Vec<_> = broken.collect();
                    let text = format!("{} is not as expected: {}", topic.topic, broken.join(", "));
                    ("watch_violated", text)
                }
                WatchState::Silent => {
                    let expectations = expectations(&watch.watch.expectations);
                    let longest = expectations.in_words("max_silence_s");
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

/// Returns a finding for each topic that lost messages recently. Receivers and causes are counted
/// since the topic is measured, so the text says that they are not only of the current loss.
pub(super) fn losses(all: &FindingInputs<'_>) -> Vec<Finding> {
    let lost = recent_losses(all.past);
    let topics = all.snapshot.topics.iter();
    let found = topics.filter_map(|topic| {
        let known = all.past.id(topic.domain_id, &topic.dds_name)?;
        lost.get(&known)?;
        let (place, remedy) = main_loss_cause(topic);
        let receiver = worst_receiver(topic);
        let text = loss_in_words(&topic.name, receiver.as_deref(), place);
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

/// Returns the text of a loss, with the worst receiver and the main place, if known.
fn loss_in_words(topic: &str, receiver: Option<&str>, place: Option<&str>) -> String {
    let most = "since it is measured, most of them";
    match (receiver, place) {
        (None, None) => format!("{topic} loses messages"),
        (Some(name), None) => format!("{topic} loses messages; {most} to {name}"),
        (None, Some(place)) => format!("{topic} loses messages; {most} {place}"),
        (Some(name), Some(place)) => {
            format!("{topic} loses messages; {most} to {name}, and most of them {place}")
        }
    }
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
fn main_loss_cause(topic: &TopicFacts) -> (Option<&'static str>, &'static str) {
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
            None,
            "compare the loss of each subscriber on the topic's page; `rp doctor` checks buffers",
        )
    } else if most == sender {
        (
            Some("at the sender, before its TCP connection"),
            "send less over this link, or raise the publisher's history depth and TCP send buffer",
        )
    } else if most == before {
        (
            Some("before they reach this host"),
            "check the network and the sender's host",
        )
    } else if most == reassembly {
        (
            Some("in IP reassembly"),
            "raise net.ipv4.ipfrag_high_thresh, or send smaller messages; `rp doctor` checks it",
        )
    } else {
        (
            Some("in the full buffer of a subscriber's socket"),
            "raise net.core.rmem_max and the receive buffer, or read faster; `rp doctor` checks it",
        )
    }
}

/// Returns when the current loss began. Pauses of up to [`LOSS_FLAG_SECONDS`] seconds do not end a
/// loss. Returns `None` without a recent loss.
fn began(past: &Past, topic: u32) -> Option<f64> {
    let mut began = None;
    let mut pause = 0;
    for second in past.seconds().iter().rev() {
        if second.row(topic).is_some_and(|row| row.lost > 0) {
            (began, pause) = (Some(second.at.seconds()), 0);
        } else {
            pause += 1;
        }
        if pause > LOSS_FLAG_SECONDS {
            break;
        }
    }
    began
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn receiver_and_place_of_a_loss_are_named_as_those_since_the_topic_is_measured() {
        let place = Some("in IP reassembly");
        let texts = [
            loss_in_words("/imu", None, None),
            loss_in_words("/imu", Some("/base"), None),
            loss_in_words("/imu", None, place),
            loss_in_words("/imu", Some("/base"), place),
        ];
        let expected = [
            "/imu loses messages",
            "/imu loses messages; since it is measured, most of them to /base",
            "/imu loses messages; since it is measured, most of them in IP reassembly",
            "/imu loses messages; since it is measured, most of them to /base, and most of them in \
             IP reassembly",
        ];
        assert_eq!(texts, expected);
    }
}
