//! Topic names for viewers, which have no domains. A name in several domains belongs to one of
//! them. In the other domains, the name has the domain as a prefix.

use std::collections::BTreeMap;

use ros2probe_model::facts::names::TopicName;
use ros2probe_model::report::snapshot::Snapshot;
use ros2probe_wire::DomainId;

/// The domain that each plain name belongs to.
#[derive(Debug, Default)]
pub(super) struct DomainNames(BTreeMap<TopicName, DomainId>);

impl DomainNames {
    /// Assigns new names to the first domain that has them. A name stays with its domain as long as
    /// the domain has it.
    pub(super) fn update(&mut self, snapshot: &Snapshot) {
        let mut owners: BTreeMap<TopicName, DomainId> = BTreeMap::new();
        for topic in &snapshot.topics {
            let owner = owners.entry(topic.name.clone()).or_insert(topic.domain_id);
            if self.0.get(&topic.name) == Some(&topic.domain_id) {
                *owner = topic.domain_id;
            }
        }
        self.0 = owners;
    }

    /// Returns the name that viewers show.
    pub(super) fn display_name(&self, domain_id: DomainId, name: &TopicName) -> String {
        match self.0.get(name) {
            Some(owner) if *owner != domain_id => format!("/domain_{domain_id}{name}"),
            _ => name.to_string(),
        }
    }
}
