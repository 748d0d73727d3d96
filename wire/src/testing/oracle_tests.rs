//! Tests of the oracle, which reads messages of real participants and does not panic on malformed
//! ones.

use std::vec::Vec;

use proptest::prelude::*;

use super::oracle::submessage::InfoReply;
use super::oracle::{Body, Header, Message, Submessage};
use crate::cursor::{Endianness, Reason, WireError};
use crate::guid::{EntityId, Guid, GuidPrefix};
use crate::parameters::ParameterId;
use crate::rtps::{InlineQos, Payload, ProtocolVersion, SequenceNumber, SubmessageId, VendorId};
use crate::testing::{self, Encoder, hurt};
use crate::time::RtpsTime;

const PREFIX: GuidPrefix = GuidPrefix([1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12]);
const OTHER: GuidPrefix = GuidPrefix([9; 12]);
const READER: EntityId = EntityId([0, 0, 0x12, 0x04]);
const WRITER: EntityId = EntityId([0, 0, 0x2d, 0x03]);
const BOTH: [Endianness; 2] = [Endianness::Big, Endianness::Little];

fn parse(datagram: &[u8]) -> Vec<Result<Submessage<'_>, WireError>> {
    Message::parse(datagram).unwrap().collect()
}

fn all(datagram: &[u8]) -> Vec<Submessage<'_>> {
    parse(datagram).into_iter().map(Result::unwrap).collect()
}

fn message(endianness: Endianness) -> Encoder {
    let mut message = Encoder::new(endianness);
    message.header([0x01, 0x0f]);
    message
}

/// Writes the body of a DATA up to the inline QoS.
fn data_head(body: &mut Encoder, sequence_number: i64) {
    body.u16(0)
        .u16(16)
        .raw(&READER.0)
        .raw(&WRITER.0)
        .sequence_number(sequence_number);
}

#[test]
fn a_gap_and_its_heartbeat_of_fast_dds_are_read() {
    let source = GuidPrefix(*b"\x01\x0f\x0d\x04\x3f\x47\x52\xad\0\0\0\0");
    let destination = GuidPrefix(*b"\x01\x0f\x2b\x7d\x3b\x48\x35\x74\0\0\0\0");
    let message = Message::parse(testing::FAST_GAP).unwrap();
    assert_eq!(message.header().vendor, VendorId::EPROSIMA);
    assert_eq!(
        message.header().version,
        ProtocolVersion { major: 2, minor: 2 }
    );
    assert_eq!(message.header().prefix, source);
    let [info, gap, heartbeat] = all(testing::FAST_GAP).try_into().unwrap();
    assert!(matches!(info.body, Body::InfoDestination));
    assert_eq!(info.receiver.destination, destination);
    let Body::Gap(gap) = gap.body else {
        panic!("{gap:?}")
    };
    assert_eq!(gap.writer, Guid::new(source, WRITER));
    assert_eq!(gap.reader, Guid::new(destination, READER));
    assert_eq!(
        (gap.start, gap.list.base),
        (SequenceNumber(52), SequenceNumber(58))
    );
    assert_eq!(gap.list.iter().count(), 0);
    let Body::Heartbeat(heartbeat) = heartbeat.body else {
        panic!("{heartbeat:?}")
    };
    assert_eq!(
        (heartbeat.first, heartbeat.last),
        (SequenceNumber(52), SequenceNumber(57))
    );
    assert_eq!(
        (heartbeat.count, heartbeat.is_final, heartbeat.is_liveliness),
        (8, false, false)
    );
}

#[test]
fn an_acknack_identifies_the_senders_reader_and_the_receivers_writer() {
    let [info, first, second, ..] = all(testing::JAZZY_ACKNACK)[..] else {
        panic!()
    };
    let Body::AckNack(acknack) = first.body else {
        panic!("{first:?}")
    };
    assert_eq!(acknack.reader.prefix, first.receiver.source);
    assert_eq!(acknack.writer.prefix, info.receiver.destination);
    assert_eq!(acknack.writer.entity, EntityId::SEDP_PUBLICATIONS_WRITER);
    let missing: Vec<_> = acknack.missing.iter().map(|number| number.0).collect();
    assert_eq!(missing, (1..=33).collect::<Vec<_>>());
    assert_eq!((acknack.count, acknack.is_final), (1, true));
    let Body::AckNack(acknack) = second.body else {
        panic!("{second:?}")
    };
    assert_eq!(acknack.missing.num_bits(), 21);
    assert_eq!(acknack.missing.iter().count(), 21);
}

#[test]
fn a_nack_frag_lists_the_missing_fragments() {
    let [_, nack_frag, ..] = all(testing::FAST_NACK_FRAG)[..] else {
        panic!()
    };
    let Body::NackFrag(nack_frag) = nack_frag.body else {
        panic!("{nack_frag:?}")
    };
    assert_eq!(nack_frag.sequence_number, SequenceNumber(7));
    assert_eq!(
        nack_frag.missing.iter().collect::<Vec<_>>(),
        (3..=10).collect::<Vec<_>>()
    );
    assert_eq!(nack_frag.count, 4);
}

#[test]
fn a_data_frag_of_several_fragments_of_cyclone_dds_is_read() {
    let [fragments, heartbeat] = all(testing::CYCLONE_DATA_FRAG).try_into().unwrap();
    assert!(matches!(heartbeat.body, Body::Heartbeat(_)));
    let Body::DataFrag(fragments) = fragments.body else {
        panic!("{fragments:?}")
    };
    assert_eq!(
        (fragments.fragment_size, fragments.sample_size),
        (1344, 644_148)
    );
    assert_eq!(fragments.total(), 480);
    let numbers: Vec<_> = fragments.fragments().map(|(number, _)| number).collect();
    assert_eq!(numbers, (fragments.starting..=480).collect::<Vec<_>>());
    assert_eq!(numbers.len(), usize::from(fragments.count));
    let last = fragments.fragments().last().unwrap().1;
    assert_eq!(last.len(), 644_148 - 479 * 1344);
    assert_eq!(fragments.offset(), u64::from(fragments.starting - 1) * 1344);
}

#[test]
fn all_data_of_a_datagram_are_found() {
    let kinds: Vec<_> = all(testing::CYCLONE_SEDP)
        .iter()
        .map(|submessage| submessage.id.0)
        .collect();
    assert_eq!(kinds, [7, 7, 7, 7, 7, 9, 0x15, 9, 0x15, 9, 0x15]);
    assert_eq!(testing::data(testing::CYCLONE_SEDP_READERS).len(), 5);
    let data = all(testing::CYCLONE_SPDP)[1];
    assert_eq!(data.receiver.timestamp, RtpsTime(0x6aff_b1b2_11a8_8b29));
}

#[test]
fn status_info_is_big_endian_in_either_byte_order() {
    for endianness in BOTH {
        let mut message = message(endianness);
        message.submessage(0x15, 0x02, |body| {
            data_head(body, 1);
            body.parameter(ParameterId::STATUS_INFO.0, &[0, 0, 0, 3]);
            body.parameter(ParameterId::KEY_HASH.0, &[7; 16]);
            body.u16(1).u16(0);
        });
        let [(_, inline_qos, data)] = testing::data(&message.bytes).try_into().unwrap();
        assert!(inline_qos.status_info.is_disposed() && inline_qos.status_info.is_unregistered());
        assert!(!inline_qos.status_info.is_filtered());
        assert_eq!(inline_qos.key_hash, Some([7; 16]));
        assert_eq!(data.payload, Payload::None);
    }
}

#[test]
fn the_legacy_request_identity_is_read_for_its_vendors_only() {
    let [(vendor, inline_qos, _)] = testing::data(testing::FAST_SPDP_DISPOSE)
        .try_into()
        .unwrap();
    assert_eq!(vendor, VendorId::EPROSIMA);
    let identity = inline_qos.related_sample_identity.unwrap();
    assert_eq!(identity.writer.entity, EntityId::SPDP_WRITER);
    assert_eq!(identity.sequence_number, SequenceNumber(1));
    let mut cyclone = testing::FAST_SPDP_DISPOSE.to_vec();
    cyclone[6..8].copy_from_slice(&VendorId::CYCLONE.0);
    assert_eq!(testing::data(&cyclone)[0].1.related_sample_identity, None);
}

#[test]
fn the_receiver_state_determines_source_and_destination() {
    for endianness in BOTH {
        let mut message = message(endianness);
        let data = |body: &mut Encoder| data_head(body, 5);
        message.submessage(0x09, 0, |body| {
            body.u32(100).u32(1 << 31);
        });
        message.submessage(0x0e, 0, |body| {
            body.raw(&OTHER.0);
        });
        message.submessage(0x15, 0, data);
        message.submessage(0x0c, 0, |body| {
            body.u32(0)
                .raw(&[2, 1])
                .raw(&VendorId::CYCLONE.0)
                .raw(&OTHER.0);
        });
        message.submessage(0x15, 0, data);
        message.submessage(0x0e, 0, |body| {
            body.raw(&[0; 12]);
        });
        message.submessage(0x15, 0, data);
        let [time, _, first, source, second, _, third] = all(&message.bytes).try_into().unwrap();
        assert_eq!(time.receiver.timestamp, RtpsTime(100 << 32 | 1 << 31));
        assert!(matches!(source.body, Body::InfoSource));
        let guids = [first, second, third].map(|submessage| match submessage.body {
            Body::Data(data) => (data.writer.prefix, data.reader.prefix),
            other => panic!("{other:?}"),
        });
        assert_eq!(
            guids,
            [
                (PREFIX, OTHER),
                (OTHER, OTHER),
                (OTHER, GuidPrefix::UNKNOWN)
            ]
        );
        assert_eq!(first.receiver.timestamp, time.receiver.timestamp);
        assert_eq!(first.receiver.vendor, VendorId::EPROSIMA);
        // INFO_SRC resets the timestamp in force.
        assert_eq!(second.receiver.timestamp, RtpsTime(0));
        assert_eq!(second.receiver.vendor, VendorId::CYCLONE);
        assert_eq!(
            second.receiver.version,
            ProtocolVersion { major: 2, minor: 1 }
        );
    }
}

#[test]
fn a_length_of_zero_is_empty_for_pad_and_info_ts_and_the_rest_for_others() {
    let mut message = message(Endianness::Little);
    message
        .raw(&[0x09, 0x03, 0, 0])
        .raw(&[0x01, 0x01, 0, 0])
        .raw(&[0x15, 0x05, 0, 0]);
    data_head(&mut message, 1);
    message.raw(&[0, 1, 0, 0, 1, 2, 3, 4]);
    let [time, pad, data] = all(&message.bytes).try_into().unwrap();
    assert_eq!(
        (time.id, pad.id),
        (SubmessageId::INFO_TS, SubmessageId::PAD)
    );
    let Body::Data(data) = data.body else {
        panic!("{data:?}")
    };
    assert_eq!(data.payload, Payload::Data(&[0, 1, 0, 0, 1, 2, 3, 4]));
    // An INFO_TS without the I flag must contain a timestamp.
    let mut message = self::message(Endianness::Little);
    message.raw(&[0x09, 0x01, 0, 0]).u32(1).u32(2);
    assert_eq!(
        parse(&message.bytes)[0].unwrap_err().reason,
        Reason::Truncated
    );
}

#[test]
fn fields_added_before_the_inline_qos_are_skipped() {
    for endianness in BOTH {
        let mut message = message(endianness);
        message.submessage(0x15, 0x06, |body| {
            body.u16(0)
                .u16(20)
                .raw(&READER.0)
                .raw(&WRITER.0)
                .sequence_number(1)
                .raw(b"new!");
            body.parameter(0x7abc, b"what")
                .u16(1)
                .u16(0)
                .raw(b"payload.");
        });
        let [(_, _, data)] = testing::data(&message.bytes).try_into().unwrap();
        assert_eq!(data.payload, Payload::Data(b"payload."));
    }
    for wrong in [0, 12, 15, 200] {
        let mut message = message(Endianness::Little);
        message.submessage(0x15, 0x04, |body| {
            body.u16(0)
                .u16(wrong)
                .raw(&READER.0)
                .raw(&WRITER.0)
                .sequence_number(1);
        });
        assert!(parse(&message.bytes)[0].is_err(), "{wrong}");
    }
}

#[test]
fn unknown_submessages_are_skipped_by_their_length() {
    let mut message = message(Endianness::Big);
    message.submessage(0x7f, 0xfe, |body| {
        body.raw(&[1; 12]);
    });
    message.submessage(0x81, 0, |body| {
        body.u32(64);
    });
    message.submessage(0x30, 0, |body| {
        body.raw(b"cipher..");
    });
    message.submessage(0x15, 0x08, |body| {
        data_head(body, 9);
        body.raw(&[0, 2, 0, 0]);
    });
    message.raw(&[0, 0]);
    let [unknown, vendors, secure, data] = all(&message.bytes).try_into().unwrap();
    assert!(matches!(unknown.body, Body::Unknown([1, ..])));
    assert!(matches!(vendors.body, Body::Unknown(_)));
    assert!(matches!(secure.body, Body::Secure(b"cipher..")));
    let Body::Data(data) = data.body else {
        panic!("{data:?}")
    };
    assert_eq!(data.payload, Payload::Key(&[0, 2, 0, 0]));
    assert_eq!(
        (data.payload.bytes().len(), data.sequence_number),
        (4, SequenceNumber(9))
    );
}

#[test]
fn submessages_before_a_malformed_one_are_kept() {
    let mut message = message(Endianness::Little);
    message.submessage(0x15, 0, |body| data_head(body, 1));
    message.submessage(0x15, 0x0c, |body| data_head(body, 2));
    message.submessage(0x15, 0, |body| data_head(body, 3));
    let parsed = parse(&message.bytes);
    assert_eq!(parsed.len(), 2);
    assert!(parsed[0].is_ok());
    assert_eq!(parsed[1].unwrap_err().what, "DATA flags");
}

#[test]
fn sequence_numbers_that_rtps_does_not_allow_are_refused() {
    let reason = |message: &Encoder| parse(&message.bytes)[0].map(|_| ()).unwrap_err().reason;
    for number in [0, -1, SequenceNumber::UNKNOWN.0.cast_signed(), i64::MIN] {
        let mut message = message(Endianness::Little);
        message.submessage(0x15, 0, |body| data_head(body, number));
        assert_eq!(reason(&message), Reason::BadValue, "{number}");
    }
    for (first, last) in [(0, 0), (1, -1), (7, 5)] {
        let mut message = message(Endianness::Little);
        message.submessage(0x07, 0, |body| {
            body.raw(&READER.0)
                .raw(&WRITER.0)
                .sequence_number(first)
                .sequence_number(last)
                .u32(1);
        });
        assert_eq!(reason(&message), Reason::BadValue, "{first} {last}");
    }
    let mut message = message(Endianness::Little);
    message.submessage(0x07, 0x06, |body| {
        body.raw(&READER.0)
            .raw(&WRITER.0)
            .sequence_number(7)
            .sequence_number(6)
            .u32(1);
    });
    let Body::Heartbeat(empty) = all(&message.bytes)[0].body else {
        panic!()
    };
    assert!(empty.is_final && empty.is_liveliness);
}

#[test]
fn fragment_numbers_that_contradict_the_bytes_are_refused() {
    let parse = |starting: u32, count: u16, size: u16, sample: u32, bytes: usize| {
        let mut message = message(Endianness::Little);
        message.submessage(0x16, 0x04, |body| {
            body.u16(0)
                .u16(28)
                .raw(&READER.0)
                .raw(&WRITER.0)
                .sequence_number(1);
            body.u32(starting)
                .u16(count)
                .u16(size)
                .u32(sample)
                .raw(&[1; 64][..bytes]);
        });
        parse(&message.bytes)[0].map(|submessage| match submessage.body {
            Body::DataFrag(fragments) => (fragments.bytes.len(), fragments.is_key),
            other => panic!("{other:?}"),
        })
    };
    let reason = |result: Result<_, WireError>| result.unwrap_err().reason;
    assert_eq!(parse(1, 2, 16, 40, 32), Ok((32, true)));
    // The last fragment is shorter, and its submessage may be padded.
    assert_eq!(parse(2, 2, 16, 39, 24), Ok((23, true)));
    assert_eq!(reason(parse(1, 2, 16, 40, 31)), Reason::Truncated);
    for (starting, count, size, sample) in [
        (0, 1, 16, 40),
        (1, 0, 16, 40),
        (1, 1, 0, 40),
        (4, 1, 16, 40),
        (3, 2, 16, 40),
        (1, 1, 16, 0),
        (u32::MAX, u16::MAX, u16::MAX, u32::MAX),
    ] {
        let result = parse(starting, count, size, sample, 64);
        assert_eq!(
            reason(result),
            Reason::BadValue,
            "{starting} {count} {size} {sample}"
        );
    }
    assert_eq!(
        reason(parse(1, u16::MAX, u16::MAX, u32::MAX, 64)),
        Reason::Truncated
    );
}

#[test]
fn reply_locators_and_fragment_heartbeats_are_read() {
    for endianness in BOTH {
        let mut message = message(endianness);
        message.submessage(0x0f, 0x02, |body| {
            body.u32(1)
                .u32(1)
                .u32(7411)
                .raw(&[0; 12])
                .raw(&[10, 0, 0, 1])
                .u32(0);
        });
        message.submessage(0x0d, 0x02, |body| {
            body.u32(0x0a00_0002).u32(7413).u32(0xefff_0001).u32(7400);
        });
        message.submessage(0x13, 0, |body| {
            body.raw(&READER.0)
                .raw(&WRITER.0)
                .sequence_number(3)
                .u32(17)
                .u32(2);
        });
        let [lists, ip4, heartbeat] = all(&message.bytes).try_into().unwrap();
        let Body::InfoReply(InfoReply::Lists(mut unicast, Some(mut multicast))) = lists.body else {
            panic!("{lists:?}")
        };
        assert_eq!(
            unicast.next().unwrap().udp(),
            Some("10.0.0.1:7411".parse().unwrap())
        );
        assert_eq!((unicast.next(), multicast.next()), (None, None));
        let Body::InfoReply(InfoReply::Ip4(unicast, Some(multicast))) = ip4.body else {
            panic!("{ip4:?}")
        };
        assert_eq!(unicast.udp(), Some("10.0.0.2:7413".parse().unwrap()));
        assert_eq!(multicast.udp(), Some("239.255.0.1:7400".parse().unwrap()));
        let Body::HeartbeatFrag(heartbeat) = heartbeat.body else {
            panic!("{heartbeat:?}")
        };
        assert_eq!((heartbeat.last_fragment, heartbeat.count), (17, 2));
    }
    let mut message = message(Endianness::Little);
    message.submessage(0x0f, 0, |body| {
        body.u32(u32::MAX);
    });
    assert_eq!(
        parse(&message.bytes)[0].unwrap_err().reason,
        Reason::Truncated
    );
}

#[test]
fn datagrams_of_other_protocols_are_refused() {
    let reason = |bytes: &[u8]| Header::parse(bytes).unwrap_err().reason;
    assert_eq!(
        reason(b"RTPX\x02\x03\x01\x0f............"),
        Reason::BadMarker
    );
    assert_eq!(
        reason(b"RTPS\x03\x03\x01\x0f............"),
        Reason::BadMarker
    );
    for length in 0..20 {
        assert_eq!(reason(&testing::FAST_GAP[..length]), Reason::Truncated);
    }
}

#[test]
fn damaged_datagrams_never_make_the_oracle_panic() {
    for datagram in testing::CAPTURED {
        hurt(datagram.get(..1500).unwrap_or(datagram), |bytes| {
            let Ok(message) = Message::parse(bytes) else {
                return;
            };
            for submessage in message.flatten() {
                match submessage.body {
                    Body::Data(data) => {
                        if let Some(list) = data.inline_qos {
                            let _ = InlineQos::parse(list, submessage.receiver.vendor);
                        }
                    }
                    Body::DataFrag(fragments) => assert!(fragments.fragments().count() < 65_536),
                    Body::AckNack(acknack) => assert!(acknack.missing.iter().count() <= 256),
                    Body::Gap(gap) => assert!(gap.list.iter().count() <= 256),
                    Body::NackFrag(nack_frag) => assert!(nack_frag.missing.iter().count() <= 256),
                    _ => {}
                }
            }
        });
    }
}

proptest! {
    #[test]
    fn an_encoded_data_submessage_survives_a_round_trip(
        little in any::<bool>(),
        number in 1..i64::MAX,
        key_hash in any::<Option<[u8; 16]>>(),
        payload in prop::collection::vec(any::<u8>(), 0..64),
        is_key in any::<bool>(),
    ) {
        let endianness = if little { Endianness::Little } else { Endianness::Big };
        let mut message = message(endianness);
        let flags = if is_key { 0x08 } else { 0x04 } | u8::from(key_hash.is_some()) << 1;
        message.submessage(0x15, flags, |body| {
            data_head(body, number);
            if let Some(key_hash) = key_hash {
                body.parameter(0x0070, &key_hash).u16(1).u16(0);
            }
            body.raw(&payload);
        });
        let [(_, inline_qos, data)] = testing::data(&message.bytes).try_into().unwrap();
        prop_assert_eq!(data.sequence_number.0, number.cast_unsigned());
        prop_assert_eq!(inline_qos.key_hash, key_hash);
        let expected = if is_key { Payload::Key(&payload) } else { Payload::Data(&payload) };
        prop_assert_eq!(data.payload, expected);
        prop_assert_eq!(data.writer, Guid::new(PREFIX, WRITER));
    }

    #[test]
    fn the_bits_of_an_acknack_are_its_missing_numbers(base in 1..i64::MAX - 256, bits in 0..=256_u32, words: [u32; 8]) {
        let mut message = message(Endianness::Big);
        message.submessage(0x06, 0, |body| {
            body.raw(&READER.0).raw(&WRITER.0).sequence_number(base).u32(bits);
            for word in words.iter().take(bits.div_ceil(32) as usize) {
                body.u32(*word);
            }
            body.u32(1);
        });
        let Body::AckNack(acknack) = all(&message.bytes)[0].body else { panic!() };
        let expected: Vec<_> = (0..bits)
            .filter(|bit| words[*bit as usize / 32] << (bit % 32) >> 31 == 1)
            .map(|bit| SequenceNumber(base.cast_unsigned() + u64::from(bit)))
            .collect();
        prop_assert_eq!(acknack.missing.iter().collect::<Vec<_>>(), expected);
    }

    #[test]
    fn no_bytes_make_the_oracle_panic(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
        let mut datagram = b"RTPS\x02\x01\x01\x0f123456789012".to_vec();
        datagram.extend_from_slice(&bytes);
        prop_assert!(Message::parse(&datagram).unwrap().count() <= bytes.len() / 4 + 1);
    }
}

mod sets;
