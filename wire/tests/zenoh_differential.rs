//! Compares the Zenoh decoder of this crate with Zenoh's own, `zenoh-codec` 1.10. The inputs are
//! random messages that `zenoh-codec` encodes, these messages with changed bytes, and random bytes.
//! If `zenoh-codec` accepts an input, this crate must read the same fields.
//!
//! There are exceptions, which no sender of Zenoh produces:
//! - A number too large for its field: Zenoh keeps the lower bits, this crate refuses it.
//! - An extension whose fields do not fill its length: Zenoh reads on after the fields, this crate
//!   refuses it. This crate skips the stack of timestamps (0x47 of PUSH, REQUEST and RESPONSE), so
//!   the stack is not compared in changed messages.
//!
//! This crate also accepts payloads with slices in shared memory, which Zenoh reads with a feature
//! only.

#![expect(
    clippy::unwrap_used,
    clippy::panic,
    clippy::indexing_slicing,
    reason = "a failed expectation may panic"
)]

#[path = "zenoh_differential/ours.rs"]
mod ours;
#[path = "zenoh_differential/theirs.rs"]
mod theirs;

use ros2probe_wire::{Reason, WireError};
use zenoh_protocol::network::NetworkMessage;
use zenoh_protocol::transport::TransportMessage;

/// Pseudo-random numbers from a seed (xorshift64).
struct Numbers(u64);

impl Numbers {
    fn next(&mut self) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0
    }

    fn below(&mut self, end: usize) -> usize {
        usize::try_from(self.next() % u64::try_from(end).unwrap()).unwrap()
    }
}

fn hexadecimal(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Returns whether an error is one of the exceptions.
fn is_excepted(error: WireError) -> bool {
    match error.reason {
        Reason::BadValue => [
            "sequence number",
            "id of a",
            "scope of a key",
            "entity id",
            "OAM",
            "initial sequence number",
            "next sequence number",
        ]
        .iter()
        .any(|what| error.what.starts_with(what)),
        Reason::BadLength => [
            "extension",
            "timestamp",
            "clock of a timestamp",
            "entity id",
            "Zenoh id",
            "SourceInfo",
            "sequence number of SourceInfo",
            "next sequence number",
            "sequence numbers by priority",
        ]
        .contains(&error.what),
        _ => false,
    }
}

/// Compares both decoders; returns whether Zenoh's accepts the batch.
fn compare(batch: &[u8], is_changed: bool) -> bool {
    let Some(theirs) = theirs::read(batch) else {
        return false;
    };
    if is_changed && theirs.has_timestamp_stack {
        return true;
    }
    match ours::read(batch) {
        Ok(ours) => assert_eq!(ours, theirs.messages, "{}", hexadecimal(batch)),
        Err(error) if is_changed && is_excepted(error) => {}
        Err(error) => panic!("{error}\n{}\n{:#?}", hexadecimal(batch), theirs.messages),
    }
    true
}

/// Changes some bytes; returns how often Zenoh's decoder accepts the result.
fn change(batch: &[u8], numbers: &mut Numbers) -> usize {
    let mut accepted = 0;
    for _ in 0..8 {
        let mut batch = batch.to_vec();
        for _ in 0..=numbers.below(2) {
            // Most fields are at the beginning.
            let end = batch.len().min(64);
            let position = numbers.below(end);
            batch[position] = match numbers.below(3) {
                0 => batch[position] ^ (1 << numbers.below(8)),
                1 => batch[position].wrapping_add(1),
                _ => u8::try_from(numbers.below(256)).unwrap(),
            };
        }
        accepted += usize::from(compare(&batch, true));
    }
    accepted
}

#[test]
fn both_decoders_read_the_same_fields_of_transport_messages() {
    let mut numbers = Numbers(0x5eed);
    let mut accepted = 0;
    for _ in 0..400 {
        let batch = theirs::transport(&TransportMessage::rand());
        assert!(compare(&batch, false), "{}", hexadecimal(&batch));
        accepted += change(&batch, &mut numbers);
    }
    println!("{accepted} of 3200 changed batches accepted");
    assert!(accepted > 300);
}

#[test]
fn both_decoders_read_the_same_fields_of_network_messages() {
    let mut numbers = Numbers(0xfeed);
    let mut accepted = 0;
    for _ in 0..1200 {
        let batch = theirs::frame(&NetworkMessage::rand());
        assert!(compare(&batch, false), "{}", hexadecimal(&batch));
        accepted += change(&batch, &mut numbers);
    }
    for _ in 0..200 {
        let batch = theirs::frame(&theirs::interest());
        assert!(compare(&batch, false), "{}", hexadecimal(&batch));
        accepted += change(&batch, &mut numbers);
    }
    println!("{accepted} of 11200 changed batches accepted");
    assert!(accepted > 1000);
}

#[test]
fn both_decoders_read_the_same_fields_of_random_bytes() {
    let mut numbers = Numbers(0xbeef);
    let mut accepted = 0;
    for _ in 0..60_000 {
        let length = 1 + numbers.below(24);
        let mut batch: Vec<u8> = (0..length)
            .map(|_| u8::try_from(numbers.below(256)).unwrap())
            .collect();
        // Most headers exist, and most numbers are small.
        batch[0] = batch[0] & 0xe0 | u8::try_from(numbers.below(8)).unwrap();
        for byte in &mut batch[1..] {
            if numbers.below(3) > 0 {
                *byte &= 0x1f;
            }
        }
        accepted += usize::from(compare(&batch, true));
    }
    println!("{accepted} of 60000 random batches accepted");
    assert!(accepted > 1000);
}
