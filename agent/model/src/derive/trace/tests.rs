use ros2probe_wire::record::{flag, guid_words, kind};
use ros2probe_wire::{EntityId, GuidPrefix, Record, SequenceNumber};

use super::*;
use crate::facts::observation::LOOPBACK;
use crate::facts::observation::tests::observed;
use ros2probe_wire::time::SECOND;

const WRITER: Guid = Guid::new(GuidPrefix([7; 12]), EntityId([0, 0, 1, 3]));

/// Returns the number of open messages, its cap, and the number dropped because of it.
fn size(tracer: &Tracer) -> (usize, usize, u64) {
    let facts = tracer.table();
    (facts.size as usize, facts.limit as usize, facts.evictions)
}

fn reader(number: u8) -> Guid {
    Guid::new(GuidPrefix([number; 12]), EntityId([0, 0, 1, 4]))
}

fn data(number: u64, time: u64, flags: u16) -> Record {
    Record {
        kind: kind::DATA,
        writer: guid_words(WRITER),
        sequence_number: number,
        time,
        flags,
        payload_len: 100,
        interface: 2,
        ..Record::default()
    }
}

/// Returns a record of `count` of ten fragments.
fn fragments(number: u64, start: u32, count: u32, time: u64, elapsed: u32) -> Record {
    Record {
        kind: kind::DATA_FRAG,
        fragment_start: start,
        fragments: count << 16 | 1000,
        sample_size: 10_000,
        elapsed,
        source_timestamp: if start == 1 { 99 } else { 0 },
        ..data(number, time, flag::OUTGOING)
    }
}

fn acknack(reader: Guid, base: u64, time: u64) -> Record {
    Record {
        kind: kind::ACKNACK,
        reader: guid_words(reader),
        ..data(base, time, 0)
    }
}

fn tracer() -> Tracer {
    let mut tracer = Tracer::new(true);
    tracer.restart(true);
    tracer
}

fn description() -> WriterDescription {
    WriterDescription {
        domain_id: DomainId(0),
        topic: "/points".into(),
        message_type: "sensor_msgs/msg/PointCloud2".into(),
        reliable: true,
    }
}

fn take(tracer: &mut Tracer, records: &[Record], ratio: f64) -> Vec<Span> {
    for record in records {
        tracer.observe(&observed(record), false, || {
            Some((description(), Share::of(ratio)))
        });
    }
    tracer.take(WallClock::default()).spans.to_vec()
}

/// Returns the spans of these records, including those that time completes.
fn take_all(tracer: &mut Tracer, records: &[Record], ratio: f64) -> Vec<Span> {
    let mut spans = take(tracer, records, ratio);
    tracer.advance(ModelTime::from_nanoseconds(SECOND));
    spans.extend(tracer.take(WallClock::default()).spans);
    spans
}

fn times(spans: &[Span]) -> Vec<(SpanStage, u64, u64)> {
    let times = |span: &Span| (span.stage, span.begin.0, span.end.0);
    spans.iter().map(times).collect()
}

#[test]
fn a_send_span_covers_all_fragments_and_each_reader_has_a_settle_span() {
    let mut tracer = tracer();
    let spans = take(
        &mut tracer,
        &[
            fragments(5, 1, 4, 1_300, 300),
            fragments(5, 9, 2, 1_800, 50),
            fragments(5, 5, 4, 1_900, 40),
            // The sample leaves for another destination, and a copy arrives on this host.
            fragments(5, 1, 4, 2_000, 10),
            data(5, 2_100, 0),
            acknack(reader(1), 5, 2_200),
            acknack(reader(1), 6, 2_300),
            acknack(reader(1), 6, 2_400),
            acknack(reader(2), 9, 2_500),
        ],
        1.0,
    );
    assert_eq!(
        times(&spans),
        [
            (SpanStage::Send, 1_000, 1_900),
            (SpanStage::Settle(reader(1)), 1_900, 2_300),
            (SpanStage::Settle(reader(2)), 1_900, 2_500),
        ]
    );
    let [sent, settled, ..] = spans.as_slice() else {
        panic!()
    };
    assert_eq!(sent.message, settled.message);
    assert_eq!(
        sent.message.trace_id,
        Message::identity(WRITER, SequenceNumber(5))
    );
    assert_eq!((sent.message.size, sent.message.fragments), (10_000, 10));
    assert_eq!(sent.message.source, RtpsTime(99));
    assert_eq!(size(&tracer).0, 1);
    tracer.advance(ModelTime::from_nanoseconds(1_901) + ACKNACK_TIMEOUT);
    assert_eq!(size(&tracer), (0, OpenSpans::CAP, 0));
    assert_eq!(take(&mut tracer, &[acknack(reader(3), 9, 9_000)], 1.0), []);
}

#[test]
fn a_message_that_only_arrives_has_a_receive_span_in_the_same_trace() {
    let arrives = [data(5, 10, flag::HOST), data(5, 11, flag::HOST)];
    let received = take_all(&mut tracer(), &arrives, 1.0);
    assert_eq!(times(&received), [(SpanStage::Receive, 10, 10)]);
    let sent = take(&mut tracer(), &[data(5, 3, flag::OUTGOING)], 1.0);
    let trace = |spans: &[Span]| spans.first().map(|span| span.message.trace_id);
    assert_eq!(trace(&sent), trace(&received));
    assert_eq!(take(&mut tracer(), &[acknack(reader(1), 9, 20)], 1.0), []);

    let mut undirected = Tracer::new(false);
    undirected.restart(true);
    let spans = take(&mut undirected, &[data(5, 10, 0)], 1.0);
    assert_eq!(times(&spans), [(SpanStage::Send, 10, 10)]);
    let loopback = Record {
        interface: LOOPBACK,
        ..data(6, 10, 0)
    };
    assert_eq!(
        times(&take(&mut tracer(), &[loopback], 1.0)),
        [(SpanStage::Send, 10, 10)]
    );
}

#[test]
fn a_multicast_whose_local_copies_are_seen_first_has_a_send_span() {
    let mut tracer = tracer();
    let records = [
        data(5, 10, flag::HOST),
        data(5, 11, flag::HOST | flag::OUTGOING),
        data(6, 20, flag::HOST),
        data(6, 21, flag::HOST | flag::OUTGOING),
    ];
    let spans = take_all(&mut tracer, &records, 1.0);
    assert_eq!(
        times(&spans),
        [(SpanStage::Send, 11, 11), (SpanStage::Send, 21, 21)]
    );
    assert_eq!(size(&tracer), (2, OpenSpans::CAP, 0));
}

#[test]
fn messages_in_shared_memory_have_send_spans_and_no_receive_spans() {
    let shared = |number, time| Record {
        interface: 0,
        ..data(number, time, flag::SHM)
    };
    let spans = take_all(&mut tracer(), &[shared(5, 10), shared(6, 20)], 1.0);
    assert_eq!(
        times(&spans),
        [(SpanStage::Send, 10, 10), (SpanStage::Send, 20, 20)]
    );
    // For readers on another host, the wire shows the same message.
    let records = [
        fragments(5, 1, 4, 1_300, 300),
        shared(5, 1_500),
        fragments(5, 5, 6, 1_900, 40),
        shared(5, 2_000),
    ];
    let spans = take_all(&mut tracer(), &records, 1.0);
    assert_eq!(times(&spans), [(SpanStage::Send, 1_000, 1_900)]);
}

#[test]
fn a_local_writer_has_no_receive_spans_and_a_router_has_no_send_spans() {
    let taken = |records: &[Record], is_local: bool| {
        let mut tracer = tracer();
        for record in records {
            tracer.observe(&observed(record), is_local, || {
                Some((description(), Share::of(1.0)))
            });
        }
        tracer.advance(ModelTime::from_nanoseconds(SECOND));
        times(&tracer.take(WallClock::default()).spans)
    };
    let copies = [data(5, 10, flag::HOST), data(6, 20, flag::HOST)];
    assert_eq!(taken(&copies, true), []);
    // A router forwards a message of another host to a subscriber on this host.
    let relayed = flag::STREAM | flag::HOST;
    let passes = [
        data(5, 10, relayed | flag::RELAYED),
        data(5, 11, relayed | flag::OUTGOING),
        data(5, 11, relayed),
    ];
    assert_eq!(taken(&passes, false), [(SpanStage::Receive, 10, 10)]);
    let sent = [data(5, 10, relayed | flag::OUTGOING | flag::RELAYED)];
    assert_eq!(taken(&sent, true), [(SpanStage::Send, 10, 10)]);
}

#[test]
fn every_agent_samples_the_same_messages_at_the_configured_ratio() {
    let records: Vec<Record> = (1..=20_000).map(|n| data(n, n, flag::OUTGOING)).collect();
    let sampled = |ratio: f64| {
        let mut tracer = tracer();
        let mut numbers = Vec::new();
        for part in records.chunks(1_000) {
            let spans = take(&mut tracer, part, ratio);
            numbers.extend(spans.iter().map(|span| span.message.sequence_number));
        }
        numbers
    };
    let tenth = sampled(0.1);
    assert!((1_850..2_150).contains(&tenth.len()), "{}", tenth.len());
    assert_eq!(tenth, sampled(0.1));
    let fifth = sampled(0.2);
    assert!(tenth.iter().all(|number| fifth.contains(number)));
    assert_eq!(sampled(1.0).len(), records.len());
    assert_eq!(sampled(0.0).len() + sampled(f64::NAN).len(), 0);
}

#[test]
fn traces_that_never_complete_need_bounded_memory() {
    let mut tracer = tracer();
    for number in 1..=1_000 {
        take(&mut tracer, &[fragments(number, 1, 1, number, 0)], 1.0);
    }
    assert!(size(&tracer).0 <= MessagesUnderWay::CAP && size(&tracer).2 >= 900);
    for number in 1_001..=3_000 {
        take(&mut tracer, &[data(number, number, flag::OUTGOING)], 1.0);
    }
    assert!(size(&tracer).0 <= MessagesUnderWay::CAP + OpenMessages::CAP);
    for number in 1..=20_u64 {
        let other = Guid::new(GuidPrefix([number as u8; 12]), EntityId([0, 0, 9, 3]));
        for sample in 1..=1_000 {
            let record = Record {
                writer: guid_words(other),
                ..data(sample, SECOND, flag::OUTGOING)
            };
            tracer.observe(&observed(&record), false, || {
                Some((description(), Share::of(1.0)))
            });
        }
    }
    assert!(size(&tracer).0 <= OpenSpans::CAP, "{:?}", size(&tracer));
    let taken = tracer.take(WallClock::default());
    assert_eq!(taken.spans.len(), FinishedSpans::CAP);
    assert!(taken.lost > 10_000);
    tracer.forget(WRITER);
    tracer.advance(ModelTime::from_nanoseconds(SECOND + 1) + ACKNACK_TIMEOUT);
    assert_eq!(size(&tracer).0, 0);
}

#[test]
fn a_known_writer_is_looked_up_only_once() {
    let mut tracer = tracer();
    let mut asked = 0;
    for number in 1..=3 {
        tracer.observe(&observed(&data(number, number, 0)), false, || {
            asked += 1;
            // Discovery has not announced the writer at first.
            (asked > 1).then(|| (description(), None))
        });
    }
    assert_eq!(asked, 2);
}
