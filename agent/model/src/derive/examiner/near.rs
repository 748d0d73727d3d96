//! Finds a publisher without a subscription and a subscription without a publisher that were
//! probably meant for each other.

use std::collections::BTreeMap;

use ros2probe_wire::Guid;

use super::Findings;
use super::nodes::is_one_host;
use crate::facts::diagnosis::{Diagnosis, Difference, TopicKey, Unmatched};
use crate::facts::names::TypeName;
use crate::graph::discovery::Discovery;

/// Steps that the comparison of two names takes.
const STEPS_PER_PAIR: usize = 100;
/// Maximum number of topics of each role that are compared.
const MAX_TOPICS: usize = 512;

/// Topics that lack endpoints of a role, by type, each with one endpoint that it has.
#[derive(Debug, Default)]
pub(super) struct LonelyTopics {
    types: BTreeMap<TypeName, OfType>,
    publishers: usize,
    subscriptions: usize,
}

/// Lonely topics of one type.
#[derive(Debug, Default)]
struct OfType {
    publishers: BTreeMap<TopicKey, Guid>,
    subscriptions: BTreeMap<TopicKey, Guid>,
}

impl LonelyTopics {
    /// Adds the topic of an endpoint without a counterpart, if nothing else hinders it.
    pub(super) fn add(
        &mut self,
        diagnosis: &Diagnosis,
        discovery: &Discovery,
        findings: &mut Findings,
    ) {
        let (topic, guid, is_publisher) = match diagnosis {
            Diagnosis::UnmatchedPublisher {
                topic,
                writer,
                reason: Unmatched::NoEndpoint,
            } => (topic, *writer, true),
            Diagnosis::UnmatchedSubscription {
                topic,
                reader,
                reason: Unmatched::NoEndpoint,
            } => (topic, *reader, false),
            _ => return,
        };
        let Some(endpoint) = discovery.endpoints().get(&guid) else {
            return;
        };
        let of_type = self.types.entry(endpoint.message_type.clone());
        let of_type = of_type.or_default();
        let (topics, count) = match is_publisher {
            true => (&mut of_type.publishers, &mut self.publishers),
            false => (&mut of_type.subscriptions, &mut self.subscriptions),
        };
        if topics.contains_key(topic) {
            return;
        }
        if *count >= MAX_TOPICS {
            findings.unexamined += 1;
            return;
        }
        *count += 1;
        topics.insert(topic.clone(), guid);
    }

    /// Adds the near misses.
    pub(super) fn examine(&self, discovery: &Discovery, findings: &mut Findings) {
        for of_type in self.types.values() {
            findings.start_topic();
            findings.unexamined += u64::from(!of_type.examine(discovery, findings));
        }
    }
}

impl OfType {
    /// Adds the near misses of the type. Returns false if the steps do not suffice for all pairs.
    fn examine(&self, discovery: &Discovery, findings: &mut Findings) -> bool {
        for publisher in &self.publishers {
            for subscription in &self.subscriptions {
                if !findings.spend_steps(STEPS_PER_PAIR) {
                    return false;
                }
                if let Some(difference) = difference(publisher, subscription, discovery) {
                    findings.add(Diagnosis::NearMiss {
                        topic: publisher.0.clone(),
                        subscription: subscription.0.clone(),
                        difference,
                    });
                }
            }
        }
        true
    }
}

/// Returns how the topics differ, if one is probably a mistake.
fn difference(
    publisher: (&TopicKey, &Guid),
    subscription: (&TopicKey, &Guid),
    discovery: &Discovery,
) -> Option<Difference> {
    let (topic, other) = (publisher.0, subscription.0);
    if topic.domain_id == other.domain_id {
        return Difference::of(&topic.name, &other.name);
    }
    // Domains that separate hosts separate them on purpose.
    let participant = |guid: &Guid| discovery.participants().get(&guid.prefix);
    let hosts = (participant(publisher.1)?, participant(subscription.1)?);
    (topic.name == other.name && is_one_host(hosts.0, hosts.1)).then_some(Difference::Domain)
}
