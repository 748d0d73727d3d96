//! Messages with stamps, which chains consist of.

use ros2probe_wire::GuidPrefix;
use ros2probe_wire::names::DdsTopic;

use super::lists::traced_share;
use super::{Derive, Observer};
use crate::derive::chain::causality::{CausalPublication, Origin};
use crate::derive::chain::graph::publisher;
use crate::facts::model_time::ModelTime;
use crate::facts::names::{NodeName, TopicName};
use crate::facts::naming::Naming;
use crate::facts::observation::Sample;
use crate::measure::topic::Topic;
use crate::measure::writer::Counted;

impl Observer {
    /// Adds the message that this sample completed to the chains, and records where it arrived.
    pub(super) fn add_to_chains(&mut self, sample: &Sample, completed: Option<&Counted>) {
        let (writer, clock) = (sample.head.writer, self.graph.wall_clock);
        if !self.derive.chains.follows(writer) {
            return;
        }
        if let Some(counted) = completed {
            let is_local = !self.settings.directed || self.graph.receivers.is_local(&writer.prefix);
            self.derive.chains.counted(writer, counted, is_local, clock);
        }
        let (receivers, discovery) = (&self.graph.receivers, &self.graph.discovery);
        self.derive.chains.seen(sample, clock, || {
            receivers.owner(&sample.head.route(), discovery)
        });
    }

    /// Adds a publication within a callback to the chains.
    pub(super) fn add_causal_publication(&mut self, publication: &CausalPublication) {
        let Derive {
            chains,
            tracer,
            inside,
            ..
        } = &mut self.derive;
        let (topics, discovery) = (&self.graph.topics, &self.graph.discovery);
        let watchlist = &self.requested.watchlist;
        let topic = |name: &TopicName| {
            let name = DdsTopic::parse(&format!("rt{name}")).ok()?;
            topics.get(topics.find(publication.domain_id, &Naming::of(&name))?)
        };
        // A process that is older than the agent has announced its nodes to discovery only.
        let named = publication.node.is_none().then(|| {
            let is_of_process = |node: &NodeName| inside.has_node(publication.process, node);
            let node = publisher(discovery, topic(&publication.output)?, is_of_process);
            Some(CausalPublication {
                node: Some(node?),
                ..publication.clone()
            })
        });
        let named = named.flatten();
        let publication = named.as_ref().unwrap_or(publication);
        let origin = || {
            let input = topic(&publication.input);
            let share = input.filter(|_| tracer.is_wanted());
            Origin {
                node: input.and_then(|input| publisher(discovery, input, |_| false)),
                share: share.and_then(|input| traced_share(input, watchlist)),
            }
        };
        chains.publication(publication, self.clock, origin);
    }

    /// Evaluates the chains, and measures the topics that configured chains need.
    pub(super) fn advance_chains(&mut self, now: ModelTime) {
        let graph = (
            &self.graph.discovery,
            &self.graph.topics,
            &self.measure.profiler,
        );
        let watchlist = &self.requested.watchlist;
        let share = |topic: &Topic| traced_share(topic, watchlist);
        let (is_directed, receivers) = (self.settings.directed, &self.graph.receivers);
        let is_local = |prefix: &GuidPrefix| !is_directed || receivers.is_local(prefix);
        let times = (now, self.graph.wall_clock);
        let changed = self.derive.chains.advance(graph, times, share, is_local);
        for (domain_id, dds_name) in changed {
            let id = DdsTopic::parse(&dds_name)
                .ok()
                .and_then(|topic| self.graph.topics.find(domain_id, &Naming::of(&topic)));
            if let Some(id) = id {
                self.apply_lists(id, now);
            }
        }
    }

    /// Evaluates the chains at the end of the input.
    pub(super) fn settle_chains(&mut self) {
        let graph = (&self.graph.topics, &self.measure.profiler);
        self.derive
            .chains
            .settle(graph, (self.clock, self.graph.wall_clock));
    }
}
