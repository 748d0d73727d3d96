//! The graph that liveliness tokens describe: nodes and endpoints by domain.

use std::collections::BTreeMap;

use crate::tables::RouterTokens;
use ros2probe_model::facts::bounded::Bounded;
use ros2probe_wire::DomainId;
pub use ros2probe_wire::zenoh::EndpointKind;
use ros2probe_wire::zenoh::{Gid, Token};

/// Nodes and endpoints of one domain, each list sorted.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct DomainGraph {
    /// Fully qualified names, one for each node.
    pub nodes: Vec<String>,
    /// Topics and services with their types, one for each endpoint.
    pub endpoints: BTreeMap<EndpointKind, Vec<(String, String)>>,
}

impl DomainGraph {
    /// Returns the number of endpoints of a kind.
    #[must_use]
    pub fn count(&self, kind: EndpointKind) -> usize {
        self.endpoints.get(&kind).map_or(0, Vec::len)
    }
}

/// A collection of tokens, each counted once.
#[derive(Debug, Default)]
pub(super) struct Tokens {
    by_gid: Bounded<RouterTokens, BTreeMap<Gid, Described>>,
    unreadable: usize,
}

#[derive(Debug)]
struct Described {
    domain: DomainId,
    /// `None` for a node.
    kind: Option<EndpointKind>,
    name: String,
    ros_type: String,
}

impl Tokens {
    /// Adds a token. Returns `false` if the cap is reached.
    pub(super) fn add(&mut self, token: &str) -> bool {
        let described = match Token::parse(token) {
            Ok(Token::Node(node)) => Described {
                domain: node.domain,
                kind: None,
                name: node.full_name(),
                ros_type: String::new(),
            },
            Ok(Token::Endpoint(endpoint)) => Described {
                domain: endpoint.node.domain,
                kind: Some(endpoint.kind),
                name: endpoint.name.to_string(),
                ros_type: endpoint.ros_type().to_string(),
            },
            Ok(Token::Bridge(_) | Token::Other) | Err(_) => {
                self.unreadable += 1;
                return true;
            }
        };
        let gid = Gid::of_token(token);
        self.by_gid.insert(gid, described).is_none()
    }

    /// Counts a token whose key cannot be resolved.
    pub(super) const fn skip(&mut self) {
        self.unreadable += 1;
    }

    /// Returns the number of tokens of unknown form.
    pub(super) const fn unreadable(&self) -> usize {
        self.unreadable
    }

    /// Returns the graphs of all domains.
    pub(super) fn graphs(&self) -> BTreeMap<DomainId, DomainGraph> {
        let mut graphs: BTreeMap<DomainId, DomainGraph> = BTreeMap::new();
        for described in self.by_gid.values() {
            let graph = graphs.entry(described.domain).or_default();
            let name = described.name.clone();
            match described.kind {
                None => graph.nodes.push(name),
                Some(kind) => {
                    let endpoints = graph.endpoints.entry(kind).or_default();
                    endpoints.push((name, described.ros_type.clone()));
                }
            }
        }
        for graph in graphs.values_mut() {
            graph.nodes.sort_unstable();
            graph.endpoints.values_mut().for_each(|it| it.sort());
        }
        graphs
    }
}
