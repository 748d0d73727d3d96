//! `std_msgs/msg/Header`, with which many messages begin.

use crate::cursor::WireError;
use crate::text;

/// Reads the frame from the beginning of a message, encapsulation header included.
///
/// # Errors
/// Returns [`Reason::BadMarker`](crate::cursor::Reason::BadMarker) if the payload is not plain CDR.
pub fn frame_id(payload: &[u8]) -> Result<&[u8], WireError> {
    let mut cursor = text::plain_cdr(payload)?;
    cursor.u32("header.stamp.sec")?;
    cursor.u32("header.stamp.nanosec")?;
    text::unterminated(&mut cursor, "header.frame_id")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cursor::{Endianness, Reason};
    use crate::testing::{Encoder, hurt};

    #[test]
    fn the_frame_is_read_from_the_beginning_of_a_message() {
        for (endianness, marker) in [(Endianness::Big, 0), (Endianness::Little, 1)] {
            let mut encoder = Encoder::new(endianness);
            encoder.u32(1_700_000_000).u32(5).string("lidar_link");
            encoder.raw(&[7; 3]);
            let mut bytes = [&[0, marker, 0, 0], &encoder.bytes[..]].concat();
            assert_eq!(frame_id(&bytes), Ok(&b"lidar_link"[..]));
            hurt(&bytes, |bytes| {
                let _ = frame_id(bytes);
            });
            bytes[1] = 3;
            assert_eq!(frame_id(&bytes).unwrap_err().reason, Reason::BadMarker);
        }
    }
}
