//! Messages with stamps, which chains consist of.

use ros2probe_wire::names::DdsTopic;
use ros2probe_wire::{Guid, Record, Timestamp};

use super::Observer;
use super::lists::traced_share;
use crate::chain::causality::CausalPublication;
use crate::naming::Naming;
use crate::route::Route;
use crate::topic::Topic;
use crate::writer::Counted;

impl Observer {
    /// Adds a counted message to the chains.
    pub(super) fn chain_counted(&mut self, writer: Guid, counted: &Counted) {
        if self.chains.follows(writer) {
            let is_local = !self.settings.directed || self.receivers.is_local(&writer.prefix);
            self.chains
                .counted(writer, counted, is_local, self.wall_clock);
        }
    }

    /// Notes where a copy of a message arrived.
    pub(super) fn chain_seen(&mut self, record: &Record) {
        if let Some(sample) = record.sample()
            && self.chains.follows(record.writer())
        {
            let (receivers, discovery) = (&self.receivers, &self.discovery);
            self.chains.seen(record, sample, self.wall_clock, || {
                receivers.owner(&Route::of(record), discovery)
            });
        }
    }

    /// Adds a publication within a callback to the chains.
    pub(super) fn chain_published(&mut self, publication: &CausalPublication) {
        let Self {
            topics,
            tracer,
            watchlist,
            ..
        } = self;
        let share = || {
            if !tracer.is_wanted() {
                return None;
            }
            let input = DdsTopic::parse(&format!("rt{}", publication.input)).ok()?;
            let input = topics.find(publication.domain_id, &Naming::of(&input))?;
            traced_share(topics.get(input)?, watchlist)
        };
        self.chains.publication(publication, self.clock, share);
    }

    /// Evaluates the chains, and measures the topics that configured chains need.
    pub(super) fn advance_chains(&mut self, now: Timestamp) {
        let graph = (&self.discovery, &self.topics, &self.profiler);
        let watchlist = &self.watchlist;
        let share = |topic: &Topic| traced_share(topic, watchlist);
        let times = (now, self.wall_clock);
        let changed = self.chains.advance(graph, times, share);
        for (domain_id, dds_name) in changed {
            let id = DdsTopic::parse(&dds_name)
                .ok()
                .and_then(|topic| self.topics.find(domain_id, &Naming::of(&topic)));
            if let Some(id) = id {
                self.apply_lists(id, now);
            }
        }
    }

    /// Evaluates the chains at the end of the input.
    pub(super) fn settle_chains(&mut self) {
        let graph = (&self.topics, &self.profiler);
        self.chains.settle(graph, (self.clock, self.wall_clock));
    }
}
