//! Last sample of transient-local writers, for topics whose watch has `retain: last`. Samples sent
//! before a recording cannot be requested without joining the domain.
//!
//! Bounded in number and bytes; the oldest are evicted first. Only the capture thread uses this.

use std::collections::BTreeMap;
use std::sync::Arc;

use ros2probe_wire::Guid;
use ros2probe_wire::names::DdsTopic;
use ros2probe_wire::qos::Durability;

use crate::config::{Retain, Watch};
use crate::tables::{RetainedBytes, RetainedWriters};
use ros2probe_model::bounded::{Bounded, Sum};
use ros2probe_model::dispatch::{Sample, Topic};
use ros2probe_model::naming::Naming;
use ros2probe_model::selection::{Depth, SampleRequest, Selection};

/// First id of requests for retention; lower ids belong to readers.
const FIRST: u64 = 1 << 63;

/// Retained samples.
#[derive(Debug, Default)]
pub(super) struct Retained {
    sample_requests: Vec<SampleRequest>,
    samples: Bounded<RetainedWriters, BTreeMap<Guid, Arc<Sample>>>,
    bytes: Sum<RetainedBytes>,
}

impl Retained {
    /// Retains samples for these watches, and drops all others.
    pub(super) fn set<'a>(&mut self, watches: impl Iterator<Item = &'a Watch>) {
        let asking = watches.filter(|watch| watch.retain == Retain::Last);
        let sample_requests = asking.zip(FIRST..).filter_map(|(watch, id)| {
            Some(SampleRequest {
                id,
                // The configuration's check has accepted the pattern.
                selection: Arc::new(Selection::named([watch.pattern.as_str()]).ok()?),
                domain_id: watch.domain_id,
                depth: Depth::Payloads,
            })
        });
        self.sample_requests = sample_requests.collect();
        let sample_requests = &self.sample_requests;
        self.samples.retain(|_, sample| {
            sample_requests
                .iter()
                .any(|request| covers(request, &sample.topic))
        });
        self.bytes.clear();
        self.bytes
            .add(self.samples.values().map(|sample| size(sample)).sum());
    }

    /// Requests to the model for these samples.
    pub(super) fn sample_requests(&self) -> impl Iterator<Item = &SampleRequest> {
        self.sample_requests.iter()
    }

    /// Bytes of retained samples.
    pub(super) const fn bytes(&self) -> usize {
        self.bytes.used()
    }

    /// Retains a sample that was delivered to `to`, if one of these is a retention.
    pub(super) fn keep(&mut self, to: &[u64], sample: &Arc<Sample>) {
        let is_ours = to.iter().any(|id| *id >= FIRST);
        let offered = sample.topic.offered.as_ref();
        let lasts = offered.is_some_and(|offered| offered.qos.durability != Durability::VOLATILE);
        if !is_ours || !lasts || sample.payload.is_none() || size(sample) > RetainedBytes::CAP {
            return;
        }
        self.forget(sample.writer);
        while self.samples.is_full() || size(sample) > self.bytes.room() {
            let oldest = self.samples.iter().min_by_key(|(_, sample)| sample.time);
            let Some(oldest) = oldest.map(|(writer, _)| *writer) else {
                return;
            };
            self.forget(oldest);
        }
        self.bytes.add(size(sample));
        self.samples.insert(sample.writer, Arc::clone(sample));
    }

    /// Samples that a new reader receives first, oldest first, from writers that still exist.
    pub(super) fn for_reader(
        &mut self,
        request: &SampleRequest,
        is_there: impl Fn(Guid) -> bool,
    ) -> Vec<Arc<Sample>> {
        let writers: Vec<Guid> = self.samples.keys().copied().collect();
        for gone in writers.into_iter().filter(|writer| !is_there(*writer)) {
            self.forget(gone);
        }
        let samples = self.samples.values();
        let wanted = samples.filter(|sample| covers(request, &sample.topic));
        let mut wanted: Vec<_> = wanted.map(Arc::clone).collect();
        wanted.sort_by_key(|sample| sample.time);
        wanted
    }

    fn forget(&mut self, writer: Guid) {
        if let Some(sample) = self.samples.remove(&writer) {
            self.bytes.sub(size(&sample));
        }
    }
}

fn size(sample: &Sample) -> usize {
    sample.payload.as_ref().map_or(0, bytes::Bytes::len)
}

fn covers(request: &SampleRequest, topic: &Topic) -> bool {
    DdsTopic::parse(&topic.dds_name)
        .is_ok_and(|name| request.covers(topic.domain_id, &Naming::of(&name)))
}

#[cfg(test)]
mod tests {
    use ros2probe_wire::DomainId;
    use ros2probe_wire::qos::{Qos, Role};
    use ros2probe_wire::rtps::VendorId;
    use ros2probe_wire::{EntityId, GuidPrefix, Timestamp};

    use ros2probe_wire::SequenceNumber;

    use super::*;
    use ros2probe_model::dispatch::Offered;

    fn writer(number: u8) -> Guid {
        Guid {
            prefix: GuidPrefix([number; 12]),
            entity: EntityId([0, 0, 1, 3]),
        }
    }

    fn sample(
        name: &str,
        number: u8,
        time: u64,
        durability: Durability,
        size: usize,
    ) -> Arc<Sample> {
        let qos = Qos {
            durability,
            ..Qos::defaults(Role::Writer, VendorId([0, 0]))
        };
        Arc::new(Sample {
            topic: Arc::new(Topic {
                domain_id: DomainId(0),
                name: name.into(),
                dds_name: format!("rt{name}").into(),
                message_type: "tf2_msgs/msg/TFMessage".into(),
                offered: Some(Arc::new(Offered {
                    type_hash: None,
                    qos: Arc::new(qos),
                })),
            }),
            time: Timestamp(time),
            writer: writer(number),
            sequence_number: SequenceNumber(time),
            source_timestamp: None,
            header_stamp: None,
            size: 0,
            sampled: false,
            payload: Some(vec![0; size].into()),
        })
    }

    fn retaining(pattern: &str) -> (Retained, u64) {
        let watch = Watch {
            retain: Retain::Last,
            ..Watch::named(pattern).unwrap()
        };
        let mut retained = Retained::default();
        retained.set([&watch, &Watch::named("/other").unwrap()].into_iter());
        let ids: Vec<u64> = retained
            .sample_requests()
            .map(|request| request.id)
            .collect();
        assert_eq!(ids.len(), 1);
        (retained, ids[0])
    }

    fn reader() -> SampleRequest {
        SampleRequest {
            id: 7,
            selection: Arc::new(Selection::all()),
            domain_id: Some(DomainId(0)),
            depth: Depth::Payloads,
        }
    }

    fn times(retained: &mut Retained) -> Vec<u64> {
        let samples = retained.for_reader(&reader(), |_| true);
        samples.iter().map(|sample| sample.time.0).collect()
    }

    #[test]
    fn the_last_sample_of_each_writer_that_keeps_its_own_is_there_for_a_new_reader() {
        let (mut retained, id) = retaining("/tf_static");
        let lasting =
            |number, time| sample("/tf_static", number, time, Durability::TRANSIENT_LOCAL, 10);
        for kept in [lasting(1, 1), lasting(2, 2), lasting(1, 3)] {
            retained.keep(&[id], &kept);
        }
        retained.keep(&[id], &sample("/tf_static", 3, 4, Durability::VOLATILE, 10));
        // Delivered only to another reader.
        retained.keep(&[5], &lasting(4, 5));
        assert_eq!((times(&mut retained), retained.bytes()), (vec![2, 3], 20));
        // A late joiner would receive nothing from a stopped node either.
        let left = retained.for_reader(&reader(), |guid| guid == writer(1));
        assert_eq!((left.len(), retained.bytes()), (1, 10));
        retained.set([].into_iter());
        assert_eq!((times(&mut retained), retained.bytes()), (vec![], 0));
    }

    #[test]
    fn bytes_and_writers_stay_bounded_and_the_oldest_go() {
        let (mut retained, id) = retaining("/maps/**");
        for number in 1..=5 {
            let large = sample(
                "/maps/a",
                number,
                number.into(),
                Durability::TRANSIENT_LOCAL,
                RetainedBytes::CAP / 4,
            );
            retained.keep(&[id], &large);
            assert!(retained.bytes() <= RetainedBytes::CAP);
        }
        assert_eq!(times(&mut retained), [2, 3, 4, 5]);
        let huge = sample(
            "/maps/a",
            9,
            9,
            Durability::TRANSIENT_LOCAL,
            RetainedBytes::CAP + 1,
        );
        retained.keep(&[id], &huge);
        assert_eq!(times(&mut retained), [2, 3, 4, 5]);
        crate::tables::tests::assert_driven::<RetainedBytes>();
        for number in 0..300 {
            let mut small = sample("/maps/a", 1, 10 + number, Durability::TRANSIENT_LOCAL, 1);
            let entity = EntityId([1, (number >> 8) as u8, number as u8, 3]);
            Arc::get_mut(&mut small).unwrap().writer.entity = entity;
            retained.keep(&[id], &small);
        }
        crate::tables::tests::assert_driven::<RetainedWriters>();
        assert_eq!(times(&mut retained)[0], 10 + 300 - 256);
    }
}
