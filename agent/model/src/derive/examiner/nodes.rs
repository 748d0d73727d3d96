//! Examines nodes: duplicate names, and nodes in several domains.

use std::collections::{BTreeMap, BTreeSet};
use std::net::IpAddr;

use ros2probe_wire::{DomainId, EntityId, Guid, GuidPrefix};

use super::Findings;
use crate::facts::diagnosis::Diagnosis;
use crate::facts::names::NodeName;
use crate::graph::discovery::{Discovery, Node, Participant};

/// A node with its participant.
#[derive(Clone, Copy, Debug)]
struct HostedNode<'a> {
    prefix: GuidPrefix,
    participant: &'a Participant,
    node: &'a Node,
}

/// Adds the findings about nodes.
pub(super) fn examine(discovery: &Discovery, findings: &mut Findings) {
    let mut names: BTreeMap<&NodeName, Vec<HostedNode<'_>>> = BTreeMap::new();
    for (prefix, participant) in discovery.participants() {
        // A restored participant without a packet so far may be an earlier run of the same node.
        if participant.restored.is_some() {
            continue;
        }
        for node in participant.nodes.iter().filter(|node| !is_hidden(node)) {
            let prefix = *prefix;
            names.entry(&node.name).or_default().push(HostedNode {
                prefix,
                participant,
                node,
            });
        }
    }
    for (name, nodes) in &mut names {
        nodes.sort_by_key(|each| (each.participant.domain_id, each.prefix));
        let domains =
            nodes.chunk_by(|one, other| one.participant.domain_id == other.participant.domain_id);
        for nodes in domains.filter(|nodes| nodes.len() > 1) {
            findings.add(Diagnosis::DuplicateNode {
                domain_id: nodes
                    .first()
                    .map_or(DomainId(0), |each| each.participant.domain_id),
                node: (*name).clone(),
                participants: nodes.iter().map(HostedNode::guid).collect(),
            });
        }
        several_domains(name, nodes, discovery, findings);
    }
}

/// Returns whether both participants are on one host, as far as announcements show it.
pub(super) fn is_one_host(one: &Participant, other: &Participant) -> bool {
    let shared = || Some(!addresses(one)?.is_disjoint(&addresses(other)?));
    one.local && other.local || shared().unwrap_or(false)
}

/// Returns the addresses of a participant other than those of loopback; `None` without one.
fn addresses(participant: &Participant) -> Option<BTreeSet<IpAddr>> {
    let addresses = &participant.addresses;
    let all = addresses.default.iter().chain(&addresses.metatraffic);
    let all = all.map(std::net::SocketAddr::ip);
    let found: BTreeSet<_> = all.filter(|address| !address.is_loopback()).collect();
    (!found.is_empty()).then_some(found)
}

/// Adds nodes in several domains: their endpoints are announced in several domains, or nodes of the
/// same name run in several domains on one machine. Equal names on different machines are normal
/// for a fleet that is separated by domains.
fn several_domains(
    name: &NodeName,
    nodes: &[HostedNode<'_>],
    discovery: &Discovery,
    findings: &mut Findings,
) {
    let mut machines: BTreeMap<BTreeSet<IpAddr>, (Guid, BTreeSet<DomainId>)> = BTreeMap::new();
    let unmatched = nodes.len() == 1;
    for placed in nodes {
        let mut domains = placed.domains(discovery);
        let machine = if unmatched { None } else { placed.machine() };
        if let Some(machine) = machine {
            let (guid, all) = machines
                .entry(machine)
                .or_insert_with(|| (placed.guid(), BTreeSet::new()));
            *guid = placed.guid().min(*guid);
            all.append(&mut domains);
        } else if domains.len() > 1 {
            findings.add(finding(name, placed.guid(), &domains));
        }
    }
    for (guid, domains) in machines
        .into_values()
        .filter(|(_, domains)| domains.len() > 1)
    {
        findings.add(finding(name, guid, &domains));
    }
}

fn finding(name: &NodeName, participant: Guid, domains: &BTreeSet<DomainId>) -> Diagnosis {
    Diagnosis::NodeInSeveralDomains {
        node: name.clone(),
        participant,
        domains: domains.iter().copied().collect(),
    }
}

impl HostedNode<'_> {
    fn guid(&self) -> Guid {
        Guid::new(self.prefix, EntityId::PARTICIPANT)
    }

    /// Returns the domains of its participant and of its endpoints.
    fn domains(&self, discovery: &Discovery) -> BTreeSet<DomainId> {
        let guids = self.node.writers.iter().chain(&self.node.readers);
        // Endpoints of its own participant are in the participant's domain.
        let foreign = guids.filter(|guid| guid.prefix != self.prefix);
        let endpoints = foreign.filter_map(|guid| discovery.endpoints().get(guid));
        let mut domains: BTreeSet<_> = endpoints.map(|endpoint| endpoint.domain_id).collect();
        domains.insert(self.participant.domain_id);
        domains
    }

    /// Returns the machine's addresses. Host names do not suffice, because robots of one series may
    /// share them. `None` without an address.
    fn machine(&self) -> Option<BTreeSet<IpAddr>> {
        let addresses = &self.participant.addresses;
        let all = addresses.default.iter().chain(&addresses.metatraffic);
        let machine: BTreeSet<_> = all.map(std::net::SocketAddr::ip).collect();
        (!machine.is_empty()).then_some(machine)
    }
}

/// Returns whether `ros2 node list` hides the node, such as short-lived command-line tools.
fn is_hidden(node: &Node) -> bool {
    node.name.split('/').any(|token| token.starts_with('_'))
}
