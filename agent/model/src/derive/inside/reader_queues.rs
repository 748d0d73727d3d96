//! The queues of all observed processes: their takes, their losses, and findings about them.

use std::collections::{BTreeMap, BTreeSet};

use ros2probe_wire::{DomainId, Guid, GuidPrefix};

use super::Inside;
use super::reader_queue::{Arrivals, ReaderQueue, Takes};
use super::state::Process;
use super::tracked::{Kind, Tracked};
use crate::facts::calls::facts::{self, InsideFacts, Owner};
use crate::facts::diagnosis::Diagnosis;
use crate::facts::model_time::ModelTime;
use crate::facts::names::TopicName;
use crate::facts::naming::Naming;

impl Inside {
    /// Compares, after a report, the messages that arrived at the subscriptions of each process
    /// with those that they took. `arrivals` returns the arrivals of a topic at the participants of
    /// a process; `None` if they are not known.
    pub fn compare_queues(
        &mut self,
        now: ModelTime,
        arrivals: impl Fn(&BTreeSet<GuidPrefix>, DomainId, &Naming) -> Option<Arrivals>,
    ) {
        for process in self.processes.values_mut() {
            let mut queues = std::mem::take(&mut process.queues);
            for (key, takes) in process.takes() {
                let Some(topic) = self.topics.get(key.0, &key.1) else {
                    continue;
                };
                let known = arrivals(&process.participants, key.0, &topic.naming);
                let count = takes.handles.len();
                let Some(arrivals) = known.filter(|known| known.is_comparable(count)) else {
                    continue;
                };
                let same = queues.remove(&key).filter(|it| it.is_of(&arrivals, &takes));
                let mut lost = 0;
                let queue = match same {
                    Some(mut queue) => {
                        lost = queue.compare(&arrivals, &takes, now);
                        self.revision += u64::from(queue.judge(now));
                        queue
                    }
                    None => ReaderQueue::new(&arrivals, &takes, now),
                };
                self.topics.add_queue_losses(&key, lost);
                process.queues.insert(key, queue);
            }
            // The remaining queues can no longer be compared, so their findings end.
            let ended = queues.values().any(|queue| queue.alarm.raised().is_some());
            self.revision += u64::from(ended);
        }
    }

    /// Returns the messages of this writer that were lost in the queue of a topic's subscriptions
    /// at this participant; `None` if that is unknown, or other writers fill the queue, too.
    #[must_use]
    pub fn lost_in_queue(
        &self,
        participant: GuidPrefix,
        (domain_id, naming): (DomainId, &Naming),
        writer: Guid,
    ) -> Option<u64> {
        if !self.observes(participant) {
            return None;
        }
        let mut processes = self.processes.values();
        let process = processes.find(|process| process.participants.contains(&participant))?;
        let queue = process.queues.get(&(domain_id, naming.name.clone()))?;
        let (.., lost) = queue.counts();
        (queue.writer() == Some(writer)).then_some(lost)
    }

    /// Adds the findings about the queues of a process.
    pub(super) fn findings_of_queues(
        &self,
        id: u32,
        process: &Process,
        found: &mut Vec<Diagnosis>,
    ) {
        for ((domain_id, name), queue) in &process.queues {
            if let Some((permille, _)) = queue.alarm.raised()
                && let Some(topic) = self.topics.get(*domain_id, name)
            {
                found.push(Diagnosis::ReaderQueueOverflow {
                    topic: topic.key(*domain_id),
                    queue: process.owner(id, *domain_id, queue),
                    lost_permille: permille,
                    depth: queue.depth(),
                });
            }
        }
    }
}

impl Process {
    /// Adds the queues to the facts.
    pub(super) fn queue_facts(&self, id: u32, into: &mut InsideFacts) {
        for ((domain_id, topic), queue) in &self.queues {
            let (arrived, taken, lost) = queue.counts();
            into.reader_queues.push(facts::ReaderQueue {
                owner: self.owner(id, *domain_id, queue),
                topic: topic.clone(),
                writer: queue.writer(),
                depth: queue.depth(),
                arrived,
                taken,
                lost,
            });
        }
    }

    /// Returns what the subscriptions to each topic have taken. A subscription without a take is
    /// left out, because its calls may not be observed.
    fn takes(&self) -> BTreeMap<(DomainId, TopicName), Takes> {
        let mut all: BTreeMap<(DomainId, TopicName), Takes> = BTreeMap::new();
        if self.facts.is_suspended {
            return all;
        }
        for tracked in self.handles.values() {
            if tracked.figures.kind != Kind::Subscription || tracked.figures.counts.count == 0 {
                continue;
            }
            let Some(topic) = tracked.figures.topic.clone() else {
                continue;
            };
            let takes = all.entry((tracked.domain_id, topic));
            let takes = takes.or_insert_with(|| Takes {
                handles: Vec::new(),
                taken: 0,
                since: self.counted_since,
                published: tracked.published,
                last: tracked.figures.last,
            });
            takes.handles.push(tracked.figures.handle);
            takes.taken += tracked.figures.counts.count;
            takes.published = takes.published.min(tracked.published);
            takes.last = takes.last.min(tracked.figures.last);
        }
        all
    }

    /// Returns the identity of a queue: its first subscription, and the node if all its
    /// subscriptions belong to it.
    fn owner(&self, process: u32, domain_id: DomainId, queue: &ReaderQueue) -> Owner {
        let tracked = |handle: &u64| self.handles.get(&(Kind::Subscription, *handle));
        let all = || queue.handles().iter().filter_map(tracked);
        let node = all().next().and_then(|first: &Tracked| first.node.clone());
        Owner {
            process,
            handle: queue.handles().first().copied().unwrap_or_default(),
            domain_id,
            node: node.filter(|node| all().all(|each| each.node.as_ref() == Some(node))),
        }
    }
}
