use std::vec::Vec;

use proptest::prelude::*;

use super::*;
use crate::cursor::{Reason, WireError};
use crate::guid::{Guid, GuidPrefix};
use crate::record::{Body, Sample};
use crate::rtps::{InlineQos, Payload, SequenceNumber, VendorId};

const SOURCE: [u8; 12] = *b"\x01\x0fsourcepref";
const OTHER: [u8; 12] = *b"\x01\x10otherprefi";
const PREFIX: [u8; 12] = [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12];
const READER: [u8; 4] = [0, 0, 0x12, 0x04];
const WRITER: [u8; 4] = [0, 0, 0x11, 0x03];

fn message(submessages: &[Vec<u8>]) -> Vec<u8> {
    let mut bytes = b"RTPS\x02\x03\x01\x0f".to_vec();
    bytes.extend_from_slice(&SOURCE);
    submessages
        .iter()
        .for_each(|submessage| bytes.extend_from_slice(submessage));
    bytes
}

fn submessage(id: u8, flags: u8, body: &[u8]) -> Vec<u8> {
    let len = u16::try_from(body.len()).unwrap();
    let len = if flags & 1 == 1 {
        len.to_le_bytes()
    } else {
        len.to_be_bytes()
    };
    [&[id, flags][..], &len, body].concat()
}

fn data_body(little: bool, sequence_number: u32, tail: &[u8]) -> Vec<u8> {
    let number = |n: u32| {
        if little {
            n.to_le_bytes()
        } else {
            n.to_be_bytes()
        }
    };
    let sixteen = if little { [0, 0, 16, 0] } else { [0, 0, 0, 16] };
    [
        &sixteen[..],
        &READER,
        &WRITER,
        &number(0),
        &number(sequence_number),
        tail,
    ]
    .concat()
}

fn walk_all(bytes: &[u8]) -> (Outcome, Vec<(Record, Vec<u8>)>) {
    let mut found = Vec::new();
    let outcome = datagram(bytes, &Envelope::default(), None, |each| {
        found.push((each.record, each.payload.to_vec()));
    });
    (outcome, found)
}

fn header_stamp(record: &Record) -> Option<(i32, u32)> {
    record.sample().and_then(Sample::header_stamp)
}

fn guid(prefix: [u8; 12], entity: [u8; 4]) -> Guid {
    Guid::new(GuidPrefix(prefix), EntityId(entity))
}

#[test]
fn data_reads_the_same_in_either_byte_order() {
    let payload = [0, 1, 0, 0, 1, 0, 0, 0, 2, 0, 0, 0, 0xaa, 0xbb];
    for little in [true, false] {
        let body = data_body(little, 7, &payload);
        let bytes = message(&[submessage(0x15, 0x04 | u8::from(little), &body)]);
        let (outcome, found) = walk_all(&bytes);
        assert_eq!(outcome, Outcome::Complete);
        let [(record, seen)] = found.as_slice() else {
            panic!("one DATA")
        };
        assert_eq!(record.writer(), guid(SOURCE, WRITER));
        assert_eq!(record.reader(), guid([0; 12], READER));
        assert_eq!(record.sequence_number, 7);
        assert_eq!(record.payload_len, 14);
        assert_eq!(header_stamp(record), Some((1, 2)));
        assert_eq!(seen, &payload);
    }
}

#[test]
fn all_forty_data_of_a_datagram_are_reported() {
    let submessages: Vec<_> = (1..=40)
        .map(|sn| submessage(0x15, 5, &data_body(true, sn, &[0, 1, 0, 0])))
        .collect();
    let (_, found) = walk_all(&message(&submessages));
    let numbers: Vec<_> = found
        .iter()
        .map(|(record, _)| record.sequence_number)
        .collect();
    assert_eq!(numbers, (1..=40).collect::<Vec<u64>>());
}

#[test]
fn info_dst_sets_the_prefix_of_the_reader_and_info_src_that_of_the_writer() {
    let info_source = [&[0; 4][..], &[2, 1, 1, 0x10], &OTHER].concat();
    let bytes = message(&[
        submessage(0x09, 1, &[5, 0, 0, 0, 0, 0, 0, 0x80]),
        submessage(0x0e, 1, &OTHER),
        submessage(0x15, 5, &data_body(true, 1, &[0, 1, 0, 0])),
        submessage(0x0c, 1, &info_source),
        submessage(0x15, 5, &data_body(true, 2, &[0, 1, 0, 0])),
    ]);
    let (_, found) = walk_all(&bytes);
    assert_eq!(found[0].0.reader(), guid(OTHER, READER));
    assert_eq!(found[0].0.writer(), guid(SOURCE, WRITER));
    assert_eq!(found[0].0.source_timestamp, 5 << 32 | 0x8000_0000);
    assert_eq!(found[1].0.writer(), guid(OTHER, WRITER));
    assert_eq!(
        found[1].0.source_timestamp, 0,
        "INFO_SRC resets the timestamp"
    );
}

#[test]
fn status_info_is_big_endian_and_inline_qos_is_not_payload() {
    let tail = [
        0x70, 0, 16, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, // KEY_HASH
        0x71, 0, 4, 0, 0, 0, 0, 3, // STATUS_INFO
        1, 0, 0, 0, // SENTINEL
    ];
    let bytes = message(&[submessage(0x15, 0x03, &data_body(true, 9, &tail))]);
    let (outcome, found) = walk_all(&bytes);
    assert_eq!(outcome, Outcome::Complete);
    assert_eq!((found[0].0.status_info, found[0].0.payload_len), (3, 0));

    let with_data = [&tail[..], &[0, 1, 0, 0, 9, 9, 9, 9]].concat();
    let bytes = message(&[submessage(0x15, 0x07, &data_body(true, 9, &with_data))]);
    assert_eq!(walk_all(&bytes).1[0].0.payload_len, 8);
}

/// Returns the inline QoS of a message with one DATA, whose octetsToInlineQos is `octets`.
fn inline_qos_of(little: bool, octets: u8, tail: &[u8]) -> Result<InlineQos, WireError> {
    let mut body = data_body(little, 9, tail);
    body[if little { 2 } else { 3 }] = octets;
    let bytes = message(&[submessage(0x15, 0x02 | u8::from(little), &body)]);
    let mut found = Vec::new();
    datagram(&bytes, &Envelope::default(), None, |each| {
        found.push(each.inline_qos(VendorId::CYCLONE));
    });
    found.pop().expect("one DATA")
}

#[test]
fn inline_qos_is_read_at_octets_to_inline_qos_in_the_submessages_byte_order() {
    let list = |little: bool| {
        let [key, hash, status, four, end] =
            [0x70_u16, 16, 0x71, 4, 1].map(|number| match little {
                true => number.to_le_bytes(),
                false => number.to_be_bytes(),
            });
        [
            &[key, hash].concat()[..],
            &[7; 16],
            &[status, four].concat(),
            &[0, 0, 0, 3],
            &end,
            &[0; 2],
        ]
        .concat()
    };
    for little in [true, false] {
        let inline_qos = inline_qos_of(little, 16, &list(little)).unwrap();
        assert_eq!(inline_qos.key_hash, Some([7; 16]));
        assert_eq!(inline_qos.status_info.0, 3);
        // A field of a later version precedes the inline QoS.
        let behind = [&b"new!"[..], &list(little)].concat();
        assert_eq!(inline_qos_of(little, 20, &behind), Ok(inline_qos));
    }
}

#[test]
fn inline_qos_beyond_the_limit_of_the_walk_is_read_and_must_be_well_formed() {
    let unknown = [0x00, 0x7a, 0, 0].repeat(INLINE_QOS_PARAMETERS as usize);
    let status = [0x71, 0, 4, 0, 0, 0, 0, 1, 1, 0, 0, 0];
    let inline_qos = inline_qos_of(true, 16, &[&unknown[..], &status].concat()).unwrap();
    assert!(inline_qos.status_info.is_disposed());
    let cut = inline_qos_of(true, 16, &[&unknown[..], &status[..8]].concat());
    assert_eq!(cut.unwrap_err().reason, Reason::Truncated);
}

#[test]
fn flags_distinguish_values_from_keys() {
    let bytes = [0, 1, 0, 0, 5, 5, 5, 5];
    for (flags, expected) in [
        (0x05, Payload::Data(&bytes)),
        (0x09, Payload::Key(&bytes)),
        (0x01, Payload::None),
        // The specification does not define this combination; a value carries more information than
        // a key.
        (0x0d, Payload::Data(&bytes)),
    ] {
        let message = message(&[submessage(0x15, flags, &data_body(true, 1, &bytes))]);
        let mut found = Vec::new();
        datagram(&message, &Envelope::default(), None, |each| {
            assert_eq!(each.inline_qos(VendorId::UNKNOWN), Ok(InlineQos::default()));
            found.push(each.payload() == expected);
        });
        assert_eq!(found, [true], "{flags:#04x}");
    }
}

#[test]
fn a_data_frag_yields_fragment_numbers_and_sizes() {
    let head = [
        &[0, 0, 28, 0][..],
        &READER,
        &WRITER,
        &[0; 4],
        &[3, 0, 0, 0],
        &[11, 0, 0, 0],
        &[10, 0, 0x40, 5],
        &[0xa4, 0xd4, 9, 0],
        &[0xcc; 40],
    ]
    .concat();
    let bytes = message(&[submessage(0x16, 1, &head)]);
    let (_, found) = walk_all(&bytes);
    let record = found[0].0;
    assert_eq!(record.fragment_start, 11);
    assert_eq!(
        (record.fragments_in_submessage(), record.fragment_size()),
        (10, 1344)
    );
    assert_eq!(record.sample_size, 644_260);
    assert_eq!((record.payload_len, header_stamp(&record)), (40, None));
}

/// Returns a DATA_FRAG with two fragments of 16 bytes from `start` of a sample of 160 bytes.
fn two_fragments(little: bool, start: u32) -> Vec<u8> {
    let word = |n: u32| match little {
        true => n.to_le_bytes(),
        false => n.to_be_bytes(),
    };
    let half = |n: u16| match little {
        true => n.to_le_bytes(),
        false => n.to_be_bytes(),
    };
    let mut body = [&[0, 0][..], &half(28), &READER, &WRITER].concat();
    for number in [0, 7, start] {
        body.extend(word(number));
    }
    body.extend([half(2), half(16)].concat());
    body.extend(word(160));
    body.extend([0x33; 32]);
    submessage(0x16, u8::from(little), &body)
}

#[test]
fn continued_fragments_extend_a_record_exactly_as_the_walk_does() {
    for little in [true, false] {
        let whole = message(&[two_fragments(little, 1), two_fragments(little, 3)]);
        let (mut continued, mut others) = (0, 0);
        for at in HEADER_LEN as usize..whole.len() {
            for value in 0..=u8::MAX {
                let mut bytes = whole.clone();
                bytes[at] = value;
                let mut walk = Walk::default();
                walk.record.flags = flag::FRAGMENTED;
                let len = u32::try_from(bytes.len()).unwrap();
                walk.begin([0; 3], len);
                let present = u32::try_from(whole.len()).unwrap();
                if step(&mut walk, &bytes.as_slice(), present) != Step::Endpoint
                    || !may_continue(&walk, &walk.record)
                {
                    continue;
                }
                let (mut short, mut long) = (walk.record, walk.record);
                let bytes = bytes.as_slice();
                let offset = walk.offset;
                let next = continue_fragments(&mut short, &bytes, offset, (present, len));
                let result = step(&mut walk, &bytes, present);
                let extends = result == Step::Endpoint
                    && long.writer == walk.record.writer
                    && long.extend(&walk.record);
                if next == 0 {
                    assert_eq!(short, first_record(bytes), "left as it was");
                    others += 1;
                } else {
                    assert!(extends, "byte {at} is {value}: {result:?}");
                    assert_eq!((next, short), (walk.offset, long), "byte {at} is {value}");
                    continued += 1;
                }
            }
        }
        assert!(continued > 5000 && others > 5000, "{continued}, {others}");
    }
}

/// Returns the record of the first submessage.
fn first_record(bytes: &[u8]) -> Record {
    let mut walk = Walk::default();
    walk.record.flags = flag::FRAGMENTED;
    let len = u32::try_from(bytes.len()).unwrap();
    walk.begin([0; 3], len);
    step(&mut walk, &bytes, len);
    walk.record
}

#[test]
fn a_length_of_zero_extends_to_the_end_except_for_pad_and_info_ts() {
    let mut last = submessage(0x15, 5, &data_body(true, 1, &[0, 1, 0, 0, 7, 7, 7, 7]));
    last[2..4].copy_from_slice(&[0, 0]);
    let bytes = message(&[submessage(0x01, 1, &[]), submessage(0x09, 3, &[]), last]);
    let (outcome, found) = walk_all(&bytes);
    assert_eq!((outcome, found[0].0.payload_len), (Outcome::Complete, 8));
}

#[test]
fn a_message_longer_than_a_datagram_may_end_in_a_sample_of_any_size() {
    // Fast DDS with shared memory as its only transport: the last submessage has the length 0.
    let short = submessage(0x15, 0x05, &data_body(true, 1, &[0, 1, 0, 0]));
    let body = data_body(true, 2, &[7; 200_000]);
    let bytes = message(&[short, [&[0x15, 0x05, 0, 0][..], &body].concat()]);
    let (outcome, found) = walk_all(&bytes);
    assert_eq!(outcome, Outcome::Complete);
    let seen: Vec<_> = found
        .iter()
        .map(|(record, payload)| (record.sequence_number, record.payload_len, payload.len()))
        .collect();
    assert_eq!(seen, [(1, 4, 4), (2, 200_000, 200_000)]);
    let last = found.last().map(|(record, _)| record.datagram_len);
    assert_eq!(last, Some(u16::MAX));
    let long = std::vec![0; MAX_MESSAGE as usize + 1];
    assert_eq!(walk_all(&long).0, Outcome::Malformed);
}

#[test]
fn a_gap_of_256_bits_becomes_two_records() {
    let body = [
        &READER[..],
        &WRITER,
        &[0; 4],
        &[10, 0, 0, 0],
        &[0; 4],
        &[20, 0, 0, 0],
        &[0, 1, 0, 0],
        &[0xff; 32],
    ]
    .concat();
    let (_, found) = walk_all(&message(&[submessage(0x08, 1, &body)]));
    assert_eq!(found.len(), 2);
    let irrelevant = |record: &Record| {
        let Body::Gap(gap) = record.body() else {
            panic!("{record:?}")
        };
        let list = gap.list();
        gap.start()
            .until(list.base)
            .chain(list.iter())
            .collect::<Vec<_>>()
    };
    let all: Vec<_> = found
        .iter()
        .flat_map(|(record, _)| irrelevant(record))
        .collect();
    assert_eq!(all, (10..20 + 256).map(SequenceNumber).collect::<Vec<_>>());
}

#[test]
fn only_discovery_is_captured_without_a_request() {
    let record = |writer: EntityId, kind| Record {
        writer: crate::record::guid_words(Guid::new(GuidPrefix(SOURCE), writer)),
        kind,
        ..Record::default()
    };
    assert_eq!(
        fate(&record(EntityId::SPDP_WRITER, kind::DATA)),
        Fate::Capture
    );
    assert_eq!(
        fate(&record(EntityId::SPDP_WRITER, kind::HEARTBEAT)),
        Fate::Ignore
    );
    assert_eq!(
        fate(&record(EntityId::PARTICIPANT_MESSAGE_WRITER, kind::DATA)),
        Fate::Ignore
    );
    assert_eq!(fate(&record(EntityId(WRITER), kind::GAP)), Fate::Writer);
}

#[test]
fn a_malformed_submessage_ends_the_walk_and_earlier_ones_are_kept() {
    let mut bytes = message(&[
        submessage(0x15, 5, &data_body(true, 1, &[0, 1, 0, 0])),
        submessage(0x15, 5, &data_body(true, 2, &[0, 1, 0, 0])),
    ]);
    bytes.truncate(bytes.len() - 1);
    let (outcome, found) = walk_all(&bytes);
    assert_eq!((outcome, found.len()), (Outcome::Malformed, 1));
}

/// Returns a valid message with several kinds of submessages, to be cut and damaged.
fn sampler() -> Vec<u8> {
    let set = [
        &READER[..],
        &WRITER,
        &[0; 4],
        &[1, 0, 0, 0],
        &[40, 0, 0, 0],
        &[0xff; 8],
        &[0; 4],
    ];
    message(&[
        submessage(0x09, 1, &[5, 0, 0, 0, 0, 0, 0, 0x80]),
        submessage(0x0e, 1, &OTHER),
        submessage(0x06, 1, &set.concat()),
        submessage(0x07, 1, &[&READER[..], &WRITER, &[0; 20]].concat()),
        submessage(
            0x15,
            7,
            &data_body(
                true,
                1,
                &[0x71, 0, 4, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0],
            ),
        ),
        submessage(0x80, 1, &[1, 2, 3, 4]),
    ])
}

#[test]
fn no_truncation_or_corruption_of_one_byte_makes_the_walk_panic() {
    let whole = sampler();
    assert_eq!(walk_all(&whole).0, Outcome::Complete);
    for len in 0..whole.len() {
        walk_all(&whole[..len]);
    }
    for at in 0..whole.len() {
        for value in [0, 1, 0x7f, 0x80, 0xff] {
            let mut damaged = whole.clone();
            damaged[at] = value;
            walk_all(&damaged);
        }
    }
}

proptest! {
    /// The kernel sees a datagram fragment by fragment. A walk that stops anywhere, also within a
    /// submessage, and continues with more bytes must find the same as one pass.
    #[test]
    fn a_paused_walk_finds_the_same_records(cuts in proptest::collection::vec(8u32..300, 1..6)) {
        let bytes = sampler();
        let whole = walk_all(&bytes).1.len();
        let mut walk = Walk::default();
        walk.begin([0; 3], u32::try_from(bytes.len()).unwrap());
        let mut found = 0;
        let mut ends: Vec<u32> = cuts.iter().scan(20, |at, cut| { *at += cut; Some(*at) }).collect();
        ends.push(walk.datagram_len);
        for present in ends {
            let present = present.min(walk.datagram_len);
            loop {
                match step(&mut walk, &bytes.as_slice(), present) {
                    Step::Endpoint => found += 1,
                    Step::Passed => {}
                    Step::Later | Step::End | Step::Split => break,
                    other => panic!("{other:?}"),
                }
            }
        }
        prop_assert_eq!(found, whole);
    }

    #[test]
    fn no_bytes_make_the_walk_panic(tail in proptest::collection::vec(any::<u8>(), 0..600)) {
        let mut bytes = message(&[]);
        bytes.extend(tail);
        walk_all(&bytes);
    }
}

/// Three batches with the numbers 11 to 13, 14 and 19, and 20.
const BATCHES: &[u8] = include_bytes!("../../tests/data/rti-batches.bin");

#[test]
fn a_batch_yields_the_numbers_and_the_sizes_of_its_samples() {
    let (outcome, found) = walk_all(BATCHES);
    assert_eq!(outcome, Outcome::Complete);
    let seen: Vec<_> = found
        .iter()
        .map(|(record, payload)| {
            assert!(payload.is_empty());
            let Body::Batch(batch) = record.body() else {
                panic!("{record:?}")
            };
            assert_eq!(batch.record().writer(), guid(PREFIX, [0, 0, 1, 3]));
            (batch.first().0, batch.last().0, batch.count(), batch.size())
        })
        .collect();
    // The inline QoS of the last batch is not read, so that the size includes it and the list.
    assert_eq!(
        seen,
        [
            (11, 13, 3, 32),
            (14, 19, 2, 12),
            (20, 20, 1, 12 + 4 + 8 + 20)
        ]
    );
    let unread: Vec<_> = found
        .iter()
        .map(|(record, _)| record.flags & flag::INLINE_QOS_UNREAD != 0)
        .collect();
    assert_eq!(unread, [false, false, true]);
}

#[test]
fn a_batch_that_contradicts_its_length_is_malformed() {
    // Offsets of the first batch's distance of the last sample, number of samples, and length of the
    // list.
    let at = |offset: usize| 20 + 12 + 4 + offset;
    for (offset, value) in [(28, 1), (32, 13), (36, 200)] {
        let mut bytes = BATCHES.to_vec();
        bytes[at(offset)..at(offset + 4)].copy_from_slice(&u32::to_le_bytes(value));
        let (outcome, found) = walk_all(&bytes);
        assert_eq!((outcome, found.len()), (Outcome::Malformed, 0), "{offset}");
    }
    crate::testing::hurt(BATCHES, |bytes| {
        for (record, _) in walk_all(bytes).1 {
            if let Body::Batch(batch) = record.body() {
                assert!(batch.count() as usize <= bytes.len() / 8);
                assert!(batch.size() as usize <= bytes.len());
                assert!(batch.last().0 - batch.first().0 + 1 >= batch.count().into());
            }
        }
    });
}
