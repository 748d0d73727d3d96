//! Identities of 128 bits, derived from bytes in the same way on every host, version and byte
//! order. FNV-1a has weak low bits, so a finishing mix follows.

/// The state of a hash.
#[derive(Clone, Copy, Debug)]
pub struct Identity(u128);

const FNV_OFFSET: u128 = 0x6c62_272e_07bb_0142_62b8_2175_6295_c58d;
const FNV_PRIME: u128 = 0x0000_0000_0100_0000_0000_0000_0000_013b;

impl Identity {
    /// Starts an identity of this kind.
    #[must_use]
    pub fn of(kind: &[u8]) -> Self {
        let mut identity = Self(FNV_OFFSET);
        identity.add(kind);
        identity
    }

    /// Adds bytes and a boundary after them.
    pub fn add(&mut self, bytes: &[u8]) {
        for byte in bytes.iter().chain(&[0xff]) {
            self.0 = (self.0 ^ u128::from(*byte)).wrapping_mul(FNV_PRIME);
        }
    }

    /// Returns the identity.
    #[must_use]
    pub const fn bits(self) -> u128 {
        let low = mix(self.0 as u64 ^ mix((self.0 >> 64) as u64));
        let high = mix((self.0 >> 64) as u64 ^ low);
        (high as u128) << 64 | low as u128
    }
}

/// The finisher of `MurmurHash3`: every input bit flips half of the output bits.
const fn mix(mut bits: u64) -> u64 {
    bits = (bits ^ bits >> 33).wrapping_mul(0xff51_afd7_ed55_8ccd);
    bits = (bits ^ bits >> 33).wrapping_mul(0xc4ce_b9fe_1a85_ec53);
    bits ^ bits >> 33
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    #[test]
    fn identities_do_not_change_between_versions() {
        let mut identity = Identity::of(b"kind");
        identity.add(b"one");
        assert_eq!(
            format!("{:032x}", identity.bits()),
            "692553d5012f93e0c6680f66b03ee139"
        );
    }

    #[test]
    fn adjacent_inputs_get_identities_that_differ_in_every_part() {
        let bits = |number: u64| {
            let mut identity = Identity::of(b"kind");
            identity.add(&number.to_be_bytes());
            identity.bits()
        };
        let all: Vec<u128> = (0..4096).map(bits).collect();
        for shift in [0, 56, 64, 112] {
            let parts: BTreeSet<u16> = all.iter().map(|bits| (bits >> shift) as u16).collect();
            // Among 65536 values, 4096 random ones collide in about 124 cases.
            assert!(
                (3_900..4_050).contains(&parts.len()),
                "{shift}: {}",
                parts.len()
            );
        }
        let (mut joined, mut apart) = (Identity::of(b"kind"), Identity::of(b"kind"));
        joined.add(b"ab");
        apart.add(b"a");
        apart.add(b"b");
        assert_ne!(joined.bits(), apart.bits());
    }
}
