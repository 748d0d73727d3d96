//! `tf2_msgs/msg/TFMessage`: transforms between frames, as published on `/tf` and `/tf_static`.
//!
//! The layout is the same in all distributions since Foxy: transforms of stamp, parent frame, child
//! frame, translation and rotation.

use crate::cursor::WireError;
use crate::plain::{PlainCursor, Sequence};

/// Name of the type, as ROS writes it.
pub const TYPE: &str = "tf2_msgs/msg/TFMessage";

/// A transform. It converts coordinates in the child frame into those in the parent frame.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Transform<'a> {
    /// Seconds and nanoseconds of the broadcaster's clock.
    pub stamp: (i32, u32),
    /// Name of the parent frame, of unverified bytes.
    pub parent: &'a [u8],
    /// Name of the child frame, of unverified bytes.
    pub child: &'a [u8],
    /// Pose of the child frame in the parent frame.
    pub pose: Pose,
}

/// Position and orientation.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Pose {
    /// x, y and z in metres.
    pub translation: [f64; 3],
    /// Quaternion: x, y, z and w.
    pub rotation: [f64; 4],
}

/// The transforms of a message, one after the other. It ends at the first malformed one.
#[derive(Clone, Debug)]
pub struct Transforms<'a>(Sequence<'a>);

impl<'a> Transforms<'a> {
    /// Begins to read a sample's payload, encapsulation header included.
    ///
    /// # Errors
    /// Returns [`Reason::BadMarker`](crate::cursor::Reason::BadMarker) if the payload is not plain
    /// CDR.
    pub fn parse(payload: &'a [u8]) -> Result<Self, WireError> {
        let cursor = PlainCursor::of(payload)?;
        Sequence::at(cursor, "transforms").map(Self)
    }
}

impl<'a> Transform<'a> {
    fn read(cursor: &mut PlainCursor<'a>) -> Result<Self, WireError> {
        let seconds = cursor.count("header.stamp.sec")?.cast_signed();
        let nanoseconds = cursor.count("header.stamp.nanosec")?;
        let parent = cursor.text("header.frame_id")?;
        let child = cursor.text("child_frame_id")?;
        let mut pose = Pose {
            translation: [0.0; 3],
            rotation: [0.0; 4],
        };
        for number in &mut pose.translation {
            *number = cursor.double("transform.translation")?;
        }
        for number in &mut pose.rotation {
            *number = cursor.double("transform.rotation")?;
        }
        Ok(Self {
            stamp: (seconds, nanoseconds),
            parent,
            child,
            pose,
        })
    }
}

impl<'a> Iterator for Transforms<'a> {
    type Item = Result<Transform<'a>, WireError>;

    fn next(&mut self) -> Option<Self::Item> {
        self.0.next(Transform::read)
    }
}

#[cfg(test)]
mod tests {
    use std::vec::Vec;

    use super::*;
    use crate::cursor::{Endianness, Reason};
    use crate::testing::{Encoder, hurt};

    fn encoded(endianness: Endianness, alignment: usize) -> Vec<u8> {
        let mut encoder = Encoder::new(endianness);
        encoder.u32(2);
        for (parent, child) in [("map", "odom"), ("odom", "base_link")] {
            encoder
                .u32(1_700_000_000)
                .u32(5)
                .unpadded(parent)
                .unpadded(child);
            for number in [1.0, -2.0, 0.5, 0.0, 0.0, 0.6, 0.8_f64] {
                encoder.wide(number.to_bits(), alignment);
            }
        }
        let little = u8::from(endianness == Endianness::Little);
        let kind = if alignment == 4 { 6 } else { 0 };
        [&[0, kind | little, 0, 0], &encoder.bytes[..]].concat()
    }

    #[test]
    fn transforms_read_the_same_in_each_encoding() {
        for (endianness, alignment) in [
            (Endianness::Big, 8),
            (Endianness::Little, 8),
            (Endianness::Big, 4),
            (Endianness::Little, 4),
        ] {
            let bytes = encoded(endianness, alignment);
            let transforms: Result<Vec<_>, _> = Transforms::parse(&bytes).unwrap().collect();
            let [first, second] = transforms.unwrap()[..] else {
                panic!("two transforms");
            };
            assert_eq!((first.parent, first.child), (&b"map"[..], &b"odom"[..]));
            assert_eq!(
                (second.parent, second.child),
                (&b"odom"[..], &b"base_link"[..])
            );
            assert_eq!(second.stamp, (1_700_000_000, 5));
            assert_eq!(second.pose.translation, [1.0, -2.0, 0.5]);
            assert_eq!(second.pose.rotation, [0.0, 0.0, 0.6, 0.8]);
        }
    }

    #[test]
    fn a_truncated_message_yields_its_whole_transforms_and_one_error() {
        let bytes = encoded(Endianness::Little, 8);
        let mut transforms = Transforms::parse(&bytes[..bytes.len() - 1]).unwrap();
        assert!(transforms.next().unwrap().is_ok());
        assert_eq!(
            transforms.next().unwrap().unwrap_err().reason,
            Reason::Truncated
        );
        assert!(transforms.next().is_none());
    }

    #[test]
    fn a_count_beyond_the_bytes_ends_at_once() {
        let mut bytes = encoded(Endianness::Little, 8);
        bytes[4..8].fill(0xff);
        assert_eq!(Transforms::parse(&bytes).unwrap().count(), 3);
    }

    #[test]
    fn no_truncation_or_corruption_of_one_byte_makes_the_parser_panic() {
        hurt(&encoded(Endianness::Little, 8), |bytes| {
            let _ = Transforms::parse(bytes).map(Iterator::count);
        });
    }
}
