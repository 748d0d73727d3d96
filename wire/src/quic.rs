//! Recognizes the start of a QUIC connection, over which Zenoh can run. Only unprotected header
//! fields are read; everything after them is encrypted.

/// Number of bytes of a datagram that [`is_initial`] reads.
pub const HEAD: usize = 6;
/// Minimum length of a datagram with an Initial packet, in bytes (RFC 9000, 14.1).
const LEAST: u32 = 1200;
/// Maximum length of a connection id, in bytes (RFC 9000, 17.2).
const LONGEST_ID: u8 = 20;

/// Returns whether a UDP datagram of `length` bytes that begins with `head` has an Initial packet.
/// Such a packet has a long header: type 0 in version 1 (RFC 9000, 17.2.2), type 1 in version 2
/// (RFC 9369, 3.2).
#[must_use]
pub const fn is_initial(head: [u8; HEAD], length: u32) -> bool {
    let [first, version @ .., id_length] = head;
    let packet_type = match u32::from_be_bytes(version) {
        1 => 0x00,
        0x6b33_43cf => 0x10,
        _ => return false,
    };
    // Compares header form, fixed bit and type. The other bits are protected.
    first & 0xf0 == 0xc0 | packet_type && id_length <= LONGEST_ID && length >= LEAST
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The client's Initial packet of RFC 9001, A.2.
    const CLIENT: [u8; HEAD] = [0xc0, 0, 0, 0, 1, 8];
    /// The client's Initial packet of RFC 9369, A.2.
    const CLIENT_V2: [u8; HEAD] = [0xd7, 0x6b, 0x33, 0x43, 0xcf, 8];

    #[test]
    fn example_packets_of_the_specifications_are_initial_packets() {
        for head in [CLIENT, CLIENT_V2, [0xcf, 0, 0, 0, 1, 0]] {
            assert!(is_initial(head, 1200), "{head:02x?}");
            assert!(!is_initial(head, 1199), "{head:02x?}: too short");
        }
    }

    #[test]
    fn other_packets_are_not_initial_packets() {
        for head in [
            *b"RTPS\x02\x03",
            [0x40, 0, 0, 0, 1, 8],
            [0x80, 0, 0, 0, 1, 8],
            // Handshake packets of version 1 and of version 2.
            [0xe0, 0, 0, 0, 1, 8],
            [0xf0, 0x6b, 0x33, 0x43, 0xcf, 8],
            // Version negotiation, a draft version, and a connection id that is too long.
            [0xc0, 0, 0, 0, 0, 8],
            [0xc0, 0xff, 0, 0, 0x1d, 8],
            [0xc0, 0, 0, 0, 1, 21],
            [0; HEAD],
            [0xff; HEAD],
        ] {
            assert!(!is_initial(head, 1252), "{head:02x?}");
        }
    }
}
