//! Reasons why a topic is silent or not measured, in words and as codes.
//!
//! Reasons follow from facts that other answers also show. A missing number alone is not a reason.

use super::index::Index;
use crate::agent_facts::SourceKind;
use crate::config::Watchlist;
use crate::snapshot_cell::Unready;
use ros2probe_api::Open;
use ros2probe_api::topics::{Reason, ReasonCode, UNSUBSCRIBED};
use ros2probe_model::facts::diagnosis::Diagnosis;
use ros2probe_model::report::snapshot::{
    EndpointFacts, Measurement, Snapshot, Source, TopicFacts, Transport,
};

/// Facts, besides the topic, on which reasons depend.
#[derive(Debug)]
pub(super) struct ReasonInputs<'a> {
    pub(super) snapshot: &'a Snapshot,
    pub(super) index: Index<'a>,
    pub(super) watchlist: &'a Watchlist,
    pub(super) source: SourceKind,
    /// Whether the agent samples shared memory.
    pub(super) samples_shared_memory: bool,
    /// Whether the agent could count calls inside processes but does not.
    pub(super) misses_inside_calls: bool,
    /// Why the agent is not ready.
    pub(super) unready: Option<Unready>,
}

impl<'a> ReasonInputs<'a> {
    /// Returns all reasons; empty for a topic whose messages are counted.
    pub(super) fn reasons(&self, topic: &'a TopicFacts) -> Vec<Reason> {
        let mut reasons = Vec::new();
        let mut say = |code, detail: String| {
            reasons.push(Reason {
                code: Open::Known(code),
                detail,
            });
        };
        if let Some(reason) = &self.unready {
            say(ReasonCode::AgentNotReady, reason.to_string());
        }
        let is_connected = match (topic.publishers.len(), topic.subscriptions.len()) {
            (0, _) | (_, 0) if topic.is_connected_inside() => true,
            (0, _) if topic.vanished => {
                say(
                    ReasonCode::NoPublisher,
                    "its last endpoint is gone".to_owned(),
                );
                false
            }
            (0, subscriptions) => {
                let detail = format!("no publishers, {subscriptions} subscribed");
                say(ReasonCode::NoPublisher, detail);
                false
            }
            (_, 0) if topic.is_unsubscribed() => {
                say(ReasonCode::NoSubscriber, UNSUBSCRIBED.to_owned());
                false
            }
            // Messages are counted, so a subscriber exists whose announcement was missed.
            (_, 0) => true,
            (_, _) => match self.unmatched(topic) {
                Some(detail) => {
                    say(ReasonCode::NoMatchedSubscriber, detail);
                    false
                }
                None => true,
            },
        };
        let is_counted = topic.source == Source::Inside;
        if let Some(secured) = self.secured(topic).filter(|_| !is_counted) {
            let detail = format!("participant {secured} uses DDS security");
            say(ReasonCode::Encrypted, detail);
        }
        match topic.measurement.as_deref() {
            None => {
                let (code, detail) = self.unwatched(topic);
                say(code, detail);
            }
            Some(measured) if is_connected && measured.rate_hz == 0.0 => {
                if is_counted {
                    let detail = format!("counted inside its processes: {}", self.quiet(measured));
                    say(ReasonCode::Quiet, detail);
                } else if let Some((code, detail)) = self.off_network(topic) {
                    say(code, detail);
                } else if measured.last_message.is_none() && self.is_on_other_hosts(topic) {
                    let detail = "publishers and subscribers are on other hosts; capture.source: \
                        wire sees traffic that passes this host";
                    say(ReasonCode::OutsideView, detail.to_owned());
                } else {
                    let by_tcp = topic.transports.iter();
                    let is_tcp = by_tcp.clone().all(|it| it.transport == Transport::Tcp);
                    let is_unseen = is_tcp && measured.last_message.is_none();
                    let tls = match is_unseen && by_tcp.len() > 0 {
                        true => "; a TCP connection with TLS cannot be read",
                        false => "",
                    };
                    say(ReasonCode::Quiet, self.quiet(measured) + tls);
                }
            }
            Some(_) => {}
        }
        reasons
    }

    /// Returns why no publisher has a matching subscriber, or `None` if one has.
    fn unmatched(&self, topic: &'a TopicFacts) -> Option<String> {
        let findings = self.index.findings(topic);
        let is_unmatched = |publisher: &EndpointFacts| {
            findings.iter().any(|finding| {
                matches!(finding, Diagnosis::UnmatchedPublisher { writer, .. }
                    if *writer == publisher.guid)
            })
        };
        if !topic.publishers.iter().all(is_unmatched) {
            return None;
        }
        let mut policies: Vec<&str> = Vec::new();
        let mut reasons: Vec<&str> = Vec::new();
        for finding in findings {
            match finding {
                Diagnosis::QosIncompatible { policies: own, .. } => {
                    policies.extend(own.iter().map(|policy| policy.label()));
                }
                Diagnosis::UnmatchedPublisher { reason, .. } => reasons.push(reason.label()),
                _ => {}
            }
        }
        for list in [&mut policies, &mut reasons] {
            list.sort_unstable();
            list.dedup();
        }
        let mut detail = format!("no subscription matches: {}", reasons.join(", "));
        if !policies.is_empty() {
            detail.push_str(" (");
            detail.push_str(&policies.join(", "));
            detail.push(')');
        }
        Some(detail)
    }

    fn secured(&self, topic: &'a TopicFacts) -> Option<ros2probe_wire::Guid> {
        let participants = topic.publishers.iter();
        let mut participants = participants.filter_map(|each| self.index.participant(each.guid));
        let secured = participants.find(|participant| participant.secured)?;
        Some(secured.guid)
    }

    fn unwatched(&self, topic: &'a TopicFacts) -> (ReasonCode, String) {
        let name = match topic.kind.is_service() {
            true => topic.dds_name.as_str(),
            false => topic.name.as_str(),
        };
        let is_covered = !self.watchlist.matching(topic.domain_id, name).is_empty();
        if is_covered && !topic.hidden {
            let detail = "limits.topics is reached, or the watch was added just now";
            return (ReasonCode::WatchRejected, detail.to_owned());
        }
        let detail = match name.strip_prefix('/') {
            Some(path) => format!("not measured: POST /watch/{path}"),
            None => "not measured: add it to the configuration".to_owned(),
        };
        (ReasonCode::NotWatched, detail)
    }

    /// Returns the reason, derived from the most common transport, if no pair of publisher and
    /// subscriber uses the network.
    fn off_network(&self, topic: &TopicFacts) -> Option<(ReasonCode, String)> {
        let passages = topic.transports.iter();
        let most = passages.clone().max_by_key(|count| count.pairs)?;
        if passages.clone().any(|count| count.transport.is_network()) {
            return None;
        }
        let remedy = match self.misses_inside_calls {
            true => "; `capture.inside: topics` counts such messages",
            false => "",
        };
        let detail = |how: &str| format!("{how}; nothing crosses the network{remedy}");
        Some(match most.transport {
            Transport::Network | Transport::Tcp => return None,
            Transport::SharedMemory if self.samples_shared_memory => {
                let how = "messages pass through shared memory; none was seen lately";
                (ReasonCode::SharedMemory, detail(how))
            }
            Transport::SharedMemory => {
                let how = "messages pass through shared memory, which this agent does not read";
                (ReasonCode::SharedMemory, detail(how))
            }
            Transport::DataSharing => {
                let how = "subscribers read the publisher's history in memory (data sharing)";
                (ReasonCode::DataSharing, detail(how))
            }
            Transport::SameProcess => (
                ReasonCode::SameProcess,
                detail(
                    "publisher and subscriber share \
                one process",
                ),
            ),
            Transport::Iceoryx => (ReasonCode::Iceoryx, detail("messages pass through iceoryx")),
        })
    }

    /// Returns whether the agent captures at sockets and no participant of the topic has a known
    /// socket on this host.
    fn is_on_other_hosts(&self, topic: &'a TopicFacts) -> bool {
        let mut all = topic.publishers.iter().chain(&topic.subscriptions);
        self.source == SourceKind::Host
            && all.all(|endpoint| {
                let participant = self.index.participant(endpoint.guid);
                participant.is_none_or(|participant| participant.process.cgroup.is_none())
            })
    }

    fn quiet(&self, measured: &Measurement) -> String {
        match measured.last_message {
            None => "published and subscribed, and no message was seen yet".to_owned(),
            Some(last) => {
                let age = (self.snapshot.at - last).as_secs_f64();
                format!("the last message was seen {age:.1} s ago")
            }
        }
    }
}
