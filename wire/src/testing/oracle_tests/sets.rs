//! Sets of sequence numbers (RTPS 2.5, 9.4.2.6).

use std::vec::Vec;

use crate::cursor::{Cursor, Endianness, Reason, WireError};
use crate::rtps::SequenceNumber;
use crate::testing::oracle::sets::SequenceNumberSet;

fn sequence_numbers(bytes: &[u8], endianness: Endianness) -> Result<Vec<u64>, WireError> {
    let mut cursor = Cursor::new(bytes, endianness);
    Ok(SequenceNumberSet::read(&mut cursor)?
        .iter()
        .map(|number| number.0)
        .collect())
}

/// The example of RTPS 2.5, 9.4.2.6: `1234:/12:00110` is 1236 and 1237. The bitmap here has 30
/// bits.
const EXAMPLE: [u8; 16] = [
    0,
    0,
    0,
    0,
    0,
    0,
    0x04,
    0xd2,
    0,
    0,
    0,
    30,
    0b0011_0000,
    0,
    0,
    0,
];

#[test]
fn bits_are_counted_from_the_most_significant_one() {
    assert_eq!(
        sequence_numbers(&EXAMPLE, Endianness::Big),
        Ok([1236, 1237].into())
    );
    let mut little = EXAMPLE;
    for word in little.chunks_exact_mut(4) {
        word.reverse();
    }
    assert_eq!(
        sequence_numbers(&little, Endianness::Little),
        Ok([1236, 1237].into())
    );
}

#[test]
fn bits_after_num_bits_are_ignored() {
    let mut bytes = EXAMPLE;
    bytes[11] = 3;
    assert_eq!(sequence_numbers(&bytes, Endianness::Big), Ok([1236].into()));
    bytes[11] = 0;
    assert_eq!(sequence_numbers(&bytes, Endianness::Big), Ok([].into()));
}

#[test]
fn a_set_of_more_than_256_bits_is_refused() {
    let mut bytes = [0xff; 12 + 36];
    bytes[..12].copy_from_slice(&[0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 1, 0]);
    let all = sequence_numbers(&bytes, Endianness::Big).unwrap();
    assert_eq!((all.len(), all[0], all[255]), (256, 1, 256));
    bytes[11] = 1;
    assert_eq!(
        sequence_numbers(&bytes, Endianness::Big).map_err(|error| error.reason),
        Err(Reason::BadValue)
    );
}

#[test]
fn members_beyond_the_largest_number_are_left_out() {
    let mut bytes = EXAMPLE;
    bytes[..8].copy_from_slice(&i64::MAX.to_be_bytes());
    bytes[12] = 0xff;
    assert_eq!(
        sequence_numbers(&bytes, Endianness::Big),
        Ok([SequenceNumber::MAX.0].into())
    );
}

#[test]
fn a_truncated_set_is_an_error() {
    for length in 0..EXAMPLE.len() {
        assert!(
            sequence_numbers(&EXAMPLE[..length], Endianness::Big).is_err(),
            "{length}"
        );
    }
}
