use std::collections::BTreeMap;

use ros2probe_wire::{DomainId, EntityId, Guid, GuidPrefix, SequenceNumber};

use super::*;
use crate::agent_facts::SourceKind;
use crate::snapshot_cell::SnapshotCell;
use crate::tables::QueueLosses;

const LONG: Duration = Duration::from_secs(60);

fn subscriptions(caps: Caps) -> Arc<Subscriptions> {
    let latest = Arc::new(SnapshotCell::new(SourceKind::Wire));
    Arc::new(Subscriptions::new(latest, caps, CancellationToken::new()))
}

fn caps() -> Caps {
    Caps {
        subscriptions: 4,
        bytes: 1 << 20,
    }
}

fn request(depth: Depth, queue_bytes: usize, overflow: Overflow) -> Request {
    Request {
        topics: Selection::all(),
        domain_id: None,
        depth,
        queue_bytes,
        overflow,
        is_clock_complete: false,
        latched: true,
        label: "test".to_owned(),
    }
}

fn sample(number: u64, payload: Option<usize>) -> Arc<Sample> {
    sample_of("points", number, payload)
}

fn sample_of(topic: &str, number: u64, payload: Option<usize>) -> Arc<Sample> {
    Arc::new(Sample {
        topic: Arc::new(Topic {
            domain_id: DomainId(0),
            name: format!("/{topic}").into(),
            dds_name: format!("rt/{topic}").into(),
            message_type: "a/msg/B".into(),
            offered: None,
        }),
        time: Timestamp(number),
        writer: Guid::new(GuidPrefix([1; 12]), EntityId([0, 0, 1, 3])),
        sequence_number: SequenceNumber(number),
        source_timestamp: None,
        header_stamp: None,
        size: 10_000,
        sampled: false,
        payload: payload.map(|len| vec![7; len].into()),
    })
}

fn enqueued(to: &[u64], number: u64, payload: Option<usize>) -> Dispatch {
    enqueued_of("points", to, number, payload)
}

fn enqueued_of(topic: &str, to: &[u64], number: u64, payload: Option<usize>) -> Dispatch {
    Dispatch {
        to: to.into(),
        outcome: SampleOutcome::Sample(sample_of(topic, number, payload)),
    }
}

fn numbers(subscription: &mut Subscription) -> Vec<u64> {
    let mut numbers = Vec::new();
    while let Some(item) = subscription.try_next() {
        if let Item::Sample(sample) = item {
            numbers.push(sample.sequence_number.0);
        }
    }
    numbers
}

#[test]
fn each_reader_gets_its_samples_and_payloads_only_on_request() {
    let all = subscriptions(caps());
    let mut arrivals = all.open(request(Depth::Arrivals, 1 << 16, Overflow::DropOldest));
    let mut payloads = all.open(request(Depth::Payloads, 1 << 16, Overflow::DropOldest));
    let (arrivals, payloads) = (arrivals.as_mut().unwrap(), payloads.as_mut().unwrap());
    let sample_requests = all.take_changed().unwrap();
    assert_eq!(sample_requests.len(), 2);
    all.deliver(
        vec![enqueued(&[1, 2], 1, Some(5)), enqueued(&[2], 2, Some(6))],
        Some(Timestamp(9)),
    );
    assert_eq!(arrivals.try_next(), Some(Item::Sample(sample(1, None))));
    assert_eq!(arrivals.try_next(), Some(Item::Clock(Timestamp(9))));
    assert_eq!(arrivals.try_next(), None);
    assert_eq!(payloads.try_next(), Some(Item::Sample(sample(1, Some(5)))));
    assert_eq!(all.facts().queued_bytes, 6);
    assert_eq!(payloads.try_next(), Some(Item::Sample(sample(2, Some(6)))));
    assert_eq!((all.facts().queued_bytes, all.facts().enqueued), (0, 3));
}

#[test]
fn a_slow_reader_loses_the_oldest_samples_and_receives_their_number_first() {
    let all = subscriptions(caps());
    let mut slow = all
        .open(request(Depth::Payloads, 4 * 1256, Overflow::DropOldest))
        .unwrap();
    for number in 1..=10 {
        all.deliver(vec![enqueued(&[1], number, Some(1000))], None);
    }
    let Some(Item::Missed(missed)) = slow.try_next() else {
        panic!("nothing was reported");
    };
    assert_eq!((missed.first.0, missed.last.0, missed.samples), (1, 6, 6));
    assert_eq!(missed.reason, MissedReason::QueueFull);
    assert_eq!(numbers(&mut slow), [7, 8, 9, 10]);
    assert_eq!(all.facts().missed, [0, 0, 0, 0, 6]);
    assert_eq!(all.facts().queued_bytes, 0);
}

#[test]
fn a_full_queue_drops_the_oldest_samples_of_its_largest_topic() {
    let all = subscriptions(caps());
    let mut slow = all
        .open(request(Depth::Payloads, 20_000, Overflow::DropOldest))
        .unwrap();
    for number in 1..=10 {
        let clouds = enqueued(&[1], number, Some(4000));
        let small = enqueued_of("tf", &[1], number, Some(100));
        all.deliver(vec![small, clouds], Some(Timestamp(number)));
    }
    let mut left: BTreeMap<String, Vec<u64>> = BTreeMap::new();
    let mut dropped = Vec::new();
    while let Some(item) = slow.try_next() {
        match item {
            Item::Sample(sample) => left
                .entry(sample.topic.name.to_string())
                .or_default()
                .push(sample.sequence_number.0),
            Item::Missed(missed) => dropped.push(missed),
            // The last clock item supersedes the others.
            Item::Clock(now) => assert_eq!(now, Timestamp(10)),
            Item::End(reason) => panic!("{reason}"),
        }
    }
    assert_eq!(left["/tf"], (1..=10).collect::<Vec<_>>());
    assert_eq!(left["/points"], [8, 9, 10]);
    let [dropped] = &dropped[..] else {
        panic!("{dropped:?}");
    };
    assert_eq!(&*dropped.topic.name, "/points");
    assert_eq!(
        (dropped.first.0, dropped.last.0, dropped.samples),
        (1, 7, 7)
    );
    assert_eq!(all.facts().queued_bytes, 0);
}

#[test]
fn a_message_larger_than_the_queue_evicts_no_other_message() {
    let all = subscriptions(caps());
    let mut slow = all
        .open(request(Depth::Payloads, 2000, Overflow::DropOldest))
        .unwrap();
    all.deliver(vec![enqueued_of("tf", &[1], 1, Some(100))], None);
    all.deliver(vec![enqueued(&[1], 1, Some(5000))], None);
    let Some(Item::Missed(missed)) = slow.try_next() else {
        panic!("nothing was reported");
    };
    assert_eq!((&*missed.topic.name, missed.samples), ("/points", 1));
    assert_eq!(numbers(&mut slow), [1]);
}

#[test]
fn all_queues_together_stay_within_their_cap_and_a_payload_counts_once() {
    let all = subscriptions(Caps {
        subscriptions: 12,
        bytes: 10_000,
    });
    let mut readers: Vec<_> = (0..10)
        .map(|_| all.open(request(Depth::Payloads, 1 << 20, Overflow::DropOldest)))
        .map(Result::unwrap)
        .collect();
    let everybody: Vec<u64> = (1..=10).collect();
    for number in 1..=10 {
        all.deliver(vec![enqueued(&everybody, number, Some(1000))], None);
    }
    assert_eq!(all.facts().queued_bytes, 10_000);
    for number in 11..=100 {
        all.deliver(vec![enqueued(&everybody, number, Some(1000))], None);
        assert!(all.facts().queued_bytes <= 10_000);
    }
    for reader in &mut readers {
        assert_eq!(numbers(reader).last(), Some(&100));
    }
    assert_eq!(all.facts().queued_bytes, 0);
}

#[test]
fn room_is_not_made_in_the_queue_of_a_reader_that_closed() {
    let all = subscriptions(caps());
    let open = || all.open(request(Depth::Payloads, 1 << 16, Overflow::DropOldest));
    let (closed, mut open) = (open().unwrap(), open().unwrap());
    all.deliver(vec![enqueued(&[1], 1, Some(5000))], None);
    all.deliver(vec![enqueued(&[2], 2, Some(1000))], None);
    // The capture thread has loaded its list when the reader closes.
    let channels = all.channels.load_full();
    drop(closed);
    let droppable: Vec<usize> = channels.iter().map(|channel| channel.droppable()).collect();
    assert_eq!(droppable, [0, 1256]);
    let _other = channel::QueuedBytes::new(&all.queued, caps().bytes);
    all.make_room(&channels);
    assert_eq!(all.facts().crowded_out, 1);
    assert!(numbers(&mut open).is_empty());
}

#[test]
fn during_a_replay_the_source_waits_for_readers_but_not_for_closed_ones() {
    let all = subscriptions(caps());
    let mut reader = all
        .open(request(Depth::Payloads, 3000, Overflow::Wait))
        .unwrap();
    let source = std::thread::spawn({
        let all = Arc::clone(&all);
        move || {
            for number in 1..=200 {
                all.deliver(
                    vec![enqueued(&[1], number, Some(1000))],
                    Some(Timestamp(number)),
                );
            }
        }
    });
    let mut expected = 1;
    while expected <= 100 {
        match reader.next_blocking(LONG).unwrap() {
            Item::Sample(sample) => {
                assert_eq!(sample.sequence_number, SequenceNumber(expected));
                expected += 1;
            }
            Item::Clock(now) => assert_eq!(now.0, expected - 1),
            other => panic!("{other:?}"),
        }
    }
    drop(reader);
    source.join().unwrap();
    assert!(!all.is_open());
}

#[test]
fn a_waiting_source_continues_when_the_agent_ends() {
    let all = subscriptions(caps());
    let _reader = all
        .open(request(Depth::Payloads, 1, Overflow::Wait))
        .unwrap();
    let source = std::thread::spawn({
        let all = Arc::clone(&all);
        move || {
            for number in 1..=10 {
                all.deliver(vec![enqueued(&[1], number, Some(1000))], None);
            }
        }
    });
    all.stop.cancel();
    source.join().unwrap();
}

#[test]
fn dropping_a_subscription_ends_its_request_and_allows_another_one() {
    let all = subscriptions(caps());
    let open = || all.open(request(Depth::Arrivals, 1 << 16, Overflow::DropOldest));
    let mut readers: Vec<_> = (0..4).map(|_| open().unwrap()).collect();
    assert_eq!(open().unwrap_err(), Refused::TooMany(4));
    all.deliver(vec![enqueued(&[4], 1, Some(1000))], None);
    readers.pop();
    assert_eq!((all.facts().open, all.facts().queued_bytes), (3, 0));
    let sample_requests = all.take_changed().unwrap();
    assert_eq!(
        sample_requests.iter().map(|request| request.id).max(),
        Some(3)
    );
    assert!(all.take_changed().is_none());
    assert!(open().is_ok());
    assert_eq!(all.facts().refused, 1);
}

#[test]
fn globs_and_regular_expressions_of_all_subscriptions_are_bounded() {
    let all = subscriptions(Caps {
        subscriptions: 100,
        ..caps()
    });
    let open = |include: Vec<Choice>| {
        all.open(Request {
            topics: Selection {
                include,
                ..Selection::default()
            },
            ..request(Depth::Arrivals, 1 << 16, Overflow::DropOldest)
        })
    };
    let globs = |count| (0..count).map(|number| Choice::parse(&format!("/*a*{number}")).unwrap());
    let names = |count| (0..count).map(|number| Choice::parse(&format!("/a{number}")).unwrap());
    let mut readers = vec![open(globs(200).collect()).unwrap()];
    assert_eq!(open(globs(200).collect()).unwrap_err(), Refused::Patterns);
    readers.push(open(names(1000).collect()).unwrap());
    for _ in 0..MAX_REGEXES {
        readers.push(open(vec![Choice::regex("^/cam").unwrap()]).unwrap());
    }
    let regex = || open(vec![Choice::regex("^/cam").unwrap()]);
    assert_eq!(regex().unwrap_err(), Refused::Patterns);
    assert_eq!(all.facts().refused, 2);
    readers.clear();
    assert!(open(globs(200).collect()).is_ok() && regex().is_ok());
}

#[tokio::test]
async fn a_reader_receives_its_items_and_then_the_end() {
    let all = subscriptions(caps());
    let mut reader = all
        .open(request(Depth::Arrivals, 1 << 16, Overflow::DropOldest))
        .unwrap();
    assert!(!reader.in_force(Duration::from_millis(1)).await);
    let requests = all.take_changed().unwrap();
    all.confirm_applied(&requests, Timestamp(0), |_| Vec::new());
    assert!(!reader.in_force(Duration::from_millis(1)).await);
    all.confirm(&requests);
    assert!(reader.in_force(LONG).await);
    let source = std::thread::spawn({
        let all = Arc::clone(&all);
        move || {
            all.deliver(vec![enqueued(&[1], 1, None)], Some(Timestamp(3)));
            all.end("end of capture");
        }
    });
    assert_eq!(reader.next().await, Some(Item::Sample(sample(1, None))));
    assert_eq!(reader.next().await, Some(Item::Clock(Timestamp(3))));
    assert_eq!(reader.next().await, Some(Item::End("end of capture")));
    assert_eq!(reader.next().await, None);
    source.join().unwrap();
    let mut late = all
        .open(request(Depth::Arrivals, 1 << 16, Overflow::DropOldest))
        .unwrap();
    assert_eq!(late.next().await, Some(Item::End("end of capture")));
}

#[test]
fn kept_messages_are_sent_first_unless_the_request_excludes_them() {
    let all = subscriptions(caps());
    for (latched, received) in [(true, vec![1, 2]), (false, vec![2])] {
        let mut reader = all
            .open(Request {
                latched,
                ..request(Depth::Payloads, 1 << 16, Overflow::DropOldest)
            })
            .unwrap();
        let requests = all.take_changed().unwrap();
        all.confirm_applied(&requests, Timestamp(9), |_| vec![sample(1, Some(5))]);
        let id = requests[0].id;
        all.deliver(vec![enqueued(&[id], 2, Some(5))], None);
        assert_eq!(numbers(&mut reader), received);
    }
}

/// Earlier, the bag of a late recording began when its latched messages were sent.
#[test]
fn a_recording_receives_kept_messages_at_its_start_and_a_viewer_at_their_arrival() {
    let all = subscriptions(caps());
    for (is_clock_complete, times) in [(true, [9, 12]), (false, [3, 12])] {
        let mut reader = all
            .open(Request {
                is_clock_complete,
                ..request(Depth::Payloads, 1 << 16, Overflow::DropOldest)
            })
            .unwrap();
        let requests = all.take_changed().unwrap();
        // The clock of the source was set back after the second arrived.
        let kept = |_: &SampleRequest| vec![sample(3, Some(5)), sample(12, Some(5))];
        all.confirm_applied(&requests, Timestamp(9), kept);
        for time in times {
            let Some(Item::Sample(sample)) = reader.try_next() else {
                panic!("a kept message is missing");
            };
            assert_eq!(sample.time, Timestamp(time));
        }
    }
}

#[test]
fn losses_of_further_writers_count_with_the_last_reported_writer() {
    const WRITERS: u64 = 2 * QueueLosses::CAP as u64;
    let all = subscriptions(caps());
    let mut slow = all
        .open(request(Depth::Payloads, 1256, Overflow::DropOldest))
        .unwrap();
    for number in 0..=WRITERS {
        let mut sample = Sample::clone(&sample(number, Some(1000)));
        let entity = u32::try_from(number).unwrap().to_be_bytes();
        sample.writer = Guid::new(GuidPrefix([1; 12]), EntityId(entity));
        let dispatch = Dispatch {
            to: [1].into(),
            outcome: SampleOutcome::Sample(Arc::new(sample)),
        };
        all.deliver(vec![dispatch], None);
    }
    let (mut reports, mut samples, mut kept) = (0, 0, 0);
    while let Some(item) = slow.try_next() {
        match item {
            Item::Missed(missed) => (reports, samples) = (reports + 1, samples + missed.samples),
            _ => kept += 1,
        }
    }
    assert_eq!((reports, samples, kept), (QueueLosses::CAP, WRITERS, 1));
    crate::tables::tests::assert_driven::<QueueLosses>();
}
