//! The connection graph of the viewers: nodes that publish, subscribe and serve, by name.

use std::collections::{BTreeMap, BTreeSet};

use ros2probe_model::facts::topic_kind::TopicKind;
use ros2probe_model::report::snapshot::{EndpointFacts, Snapshot};

use super::names::DomainNames;
use super::protocol::{Message, Providers, Publishers, Subscribers};

/// Nodes of each topic or service, by its name.
type Parties = BTreeMap<String, BTreeSet<String>>;

/// Publishers, subscribers and servers at one moment.
#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct Graph {
    published: Parties,
    subscribed: Parties,
    services: Parties,
}

impl Graph {
    /// Returns the graph of topics that `ros2 topic list` shows, and of services.
    pub(super) fn of(snapshot: &Snapshot, names: &DomainNames) -> Self {
        let mut graph = Self::default();
        for topic in snapshot.topics.iter().filter(|topic| !topic.hidden) {
            let (writers, readers) = match topic.kind {
                kind if kind.is_ros_topic() => (&mut graph.published, &mut graph.subscribed),
                // A server reads requests.
                TopicKind::ServiceRequest => {
                    let name = names.display_name(topic.domain_id, &topic.name);
                    add(&mut graph.services, name, &topic.subscriptions);
                    continue;
                }
                _ => continue,
            };
            let name = names.display_name(topic.domain_id, &topic.name);
            add(writers, name.clone(), &topic.publishers);
            add(readers, name, &topic.subscriptions);
        }
        graph
    }

    /// Returns the message that turns `before` into this graph; `None` if they are equal.
    pub(super) fn update<'a>(&'a self, before: &'a Self) -> Option<Message<'a>> {
        if self == before {
            return None;
        }
        let is_topic =
            |name: &String| self.published.contains_key(name) || self.subscribed.contains_key(name);
        let topics: BTreeSet<_> = before
            .published
            .keys()
            .chain(before.subscribed.keys())
            .collect();
        let removed = topics.into_iter().filter(|name| !is_topic(name));
        let services = before.services.keys();
        let removed_services = services.filter(|name| !self.services.contains_key(*name));
        Some(Message::ConnectionGraphUpdate {
            published_topics: changed(&self.published, &before.published)
                .map(|(name, publisher_ids)| Publishers {
                    name,
                    publisher_ids,
                })
                .collect(),
            subscribed_topics: changed(&self.subscribed, &before.subscribed)
                .map(|(name, subscriber_ids)| Subscribers {
                    name,
                    subscriber_ids,
                })
                .collect(),
            advertised_services: changed(&self.services, &before.services)
                .map(|(name, provider_ids)| Providers { name, provider_ids })
                .filter(|service| !service.provider_ids.is_empty())
                .collect(),
            removed_topics: removed.map(String::as_str).collect(),
            removed_services: removed_services.map(String::as_str).collect(),
        })
    }
}

/// Adds the nodes of `endpoints`. The GUID represents an endpoint without a known node.
fn add(parties: &mut Parties, name: String, endpoints: &[EndpointFacts]) {
    if endpoints.is_empty() {
        return;
    }
    let nodes = endpoints.iter().map(|endpoint| match &endpoint.node {
        Some(node) => node.to_string(),
        None => endpoint.guid.to_string(),
    });
    parties.entry(name).or_default().extend(nodes);
}

/// Returns the entries that differ from `before`. A removed entry has no nodes.
fn changed<'a>(
    now: &'a Parties,
    before: &'a Parties,
) -> impl Iterator<Item = (&'a str, Vec<&'a str>)> {
    let new = now
        .iter()
        .filter(|(name, nodes)| before.get(*name) != Some(nodes));
    let new = new.map(|(name, nodes)| (name.as_str(), nodes.iter().map(String::as_str).collect()));
    let gone = before.keys().filter(|name| !now.contains_key(*name));
    new.chain(gone.map(|name| (name.as_str(), Vec::new())))
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    fn parties(entries: &[(&str, &[&str])]) -> Parties {
        let entries = entries.iter();
        let nodes = |nodes: &[&str]| nodes.iter().map(ToString::to_string).collect();
        entries
            .map(|(name, each)| ((*name).to_owned(), nodes(each)))
            .collect()
    }

    fn update(now: &Graph, before: &Graph) -> Value {
        serde_json::to_value(now.update(before).unwrap()).unwrap()
    }

    #[test]
    fn an_update_contains_the_changed_and_the_removed_entries() {
        let before = Graph {
            published: parties(&[("/a", &["/one"]), ("/gone", &["/one"])]),
            subscribed: parties(&[("/a", &["/two"]), ("/b", &["/two"])]),
            services: parties(&[("/old", &["/one"])]),
        };
        let first = update(&before, &Graph::default());
        assert_eq!(
            first["publishedTopics"],
            json!([{"name": "/a", "publisherIds": ["/one"]}, {"name": "/gone", "publisherIds": ["/one"]}])
        );
        assert_eq!(
            (&first["removedTopics"], &first["op"]),
            (&json!([]), &json!("connectionGraphUpdate"))
        );
        let now = Graph {
            published: parties(&[("/a", &["/one", "/three"])]),
            subscribed: parties(&[("/a", &["/two"])]),
            services: parties(&[("/new", &["/one"])]),
        };
        assert_eq!(
            update(&now, &before),
            json!({
                "op": "connectionGraphUpdate",
                "publishedTopics": [
                    {"name": "/a", "publisherIds": ["/one", "/three"]},
                    {"name": "/gone", "publisherIds": []},
                ],
                "subscribedTopics": [{"name": "/b", "subscriberIds": []}],
                "advertisedServices": [{"name": "/new", "providerIds": ["/one"]}],
                "removedTopics": ["/b", "/gone"],
                "removedServices": ["/old"],
            })
        );
        assert!(now.update(&now).is_none());
    }
}
