//! Chains of the configuration.

use std::time::Duration;

use ros2probe_model::derive::chain::expected::{ExpectedChain, MAX_CHAINS};
use ros2probe_wire::DomainId;

use super::super::shape::ChainShape;
use super::Reader;

impl Reader {
    pub(super) fn chains(&mut self, shapes: Vec<ChainShape>) -> Vec<ExpectedChain> {
        if shapes.len() > MAX_CHAINS {
            let count = shapes.len();
            let message = format!("has {count} entries, at most {MAX_CHAINS} are allowed");
            self.wrong("chains", message);
            return Vec::new();
        }
        let mut chains: Vec<ExpectedChain> = Vec::with_capacity(shapes.len());
        for (index, shape) in shapes.into_iter().enumerate() {
            let key = format!("chains[{index}]");
            let chain = ExpectedChain {
                domain_id: shape.domain.map(DomainId),
                from: shape.from.into(),
                to: shape.to.into(),
                max_latency: shape
                    .max_latency_ms
                    .map(|limit| Duration::from_secs_f64(limit / 1e3)),
            };
            if chain.from == chain.to {
                let message = "is the same topic as `from`: a chain has two ends";
                self.wrong(&format!("{key}.to"), message);
            }
            let twin = |other: &ExpectedChain| {
                let ends =
                    |chain: &ExpectedChain| (chain.domain_id, chain.from.clone(), chain.to.clone());
                ends(other) == ends(&chain)
            };
            if let Some(first) = chains.iter().position(twin) {
                self.wrong(&key, format!("repeats chains[{first}]"));
            }
            chains.push(chain);
        }
        chains
    }
}
