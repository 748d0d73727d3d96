//! `rcl_interfaces/msg/Log`: a message of a node's log, as published on `/rosout`.
//!
//! The layout is the same in all distributions since Foxy: stamp, level, name of the logger, text,
//! file, function, and line.

use crate::cursor::WireError;
use crate::text;

/// Name of the type, as ROS writes it.
pub const TYPE: &str = "rcl_interfaces/msg/Log";

/// One message of a log. Texts are unverified bytes: nodes may log any encoding, of any length.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Log<'a> {
    /// Seconds and nanoseconds of the node's clock.
    pub stamp: (i32, u32),
    /// Severity.
    pub level: LogLevel,
    /// Name of the logger: the node's name with dots, perhaps with further parts.
    pub logger: &'a [u8],
    /// The text.
    pub text: &'a [u8],
    /// Source file.
    pub file: &'a [u8],
    /// Function.
    pub function: &'a [u8],
    /// Line in the file.
    pub line: u32,
}

/// Severity of a message (`rcl_interfaces/msg/Log`). Numbers between two levels count as the lower
/// one.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
#[repr(u8)]
pub enum LogLevel {
    /// 10, and all lower numbers.
    Debug,
    /// 20.
    Info,
    /// 30.
    Warn,
    /// 40.
    Error,
    /// 50, and all higher numbers.
    Fatal,
}

impl LogLevel {
    /// All levels, the least severe first.
    pub const ALL: [Self; 5] = [
        Self::Debug,
        Self::Info,
        Self::Warn,
        Self::Error,
        Self::Fatal,
    ];

    /// Returns the level of a number.
    #[must_use]
    pub const fn of(number: u8) -> Self {
        match number {
            0..20 => Self::Debug,
            20..30 => Self::Info,
            30..40 => Self::Warn,
            40..50 => Self::Error,
            50.. => Self::Fatal,
        }
    }

    /// Returns the level with this label.
    #[must_use]
    pub fn named(label: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|level| level.label() == label)
    }

    /// Returns the label value.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Debug => "debug",
            Self::Info => "info",
            Self::Warn => "warn",
            Self::Error => "error",
            Self::Fatal => "fatal",
        }
    }
}

impl<'a> Log<'a> {
    /// Parses a sample's payload, encapsulation header included.
    ///
    /// # Errors
    /// Fails if the payload is not plain CDR ([`Reason::BadMarker`](crate::cursor::Reason::BadMarker)),
    /// or if a field cannot be read.
    pub fn parse(payload: &'a [u8]) -> Result<Self, WireError> {
        let mut cursor = text::plain_cdr(payload)?;
        let stamp = (cursor.u32("stamp.sec")?, cursor.u32("stamp.nanosec")?);
        let level = cursor.u8("level")?;
        Ok(Self {
            stamp: (stamp.0.cast_signed(), stamp.1),
            level: LogLevel::of(level),
            logger: text::unterminated(&mut cursor, "name")?,
            text: text::unterminated(&mut cursor, "msg")?,
            file: text::unterminated(&mut cursor, "file")?,
            function: text::unterminated(&mut cursor, "function")?,
            line: {
                cursor.align(4);
                cursor.u32("line")?
            },
        })
    }
}

#[cfg(test)]
mod tests {
    use std::vec::Vec;

    use super::*;
    use crate::cursor::{Endianness, Reason};
    use crate::testing::{Encoder, hurt};

    fn encoded(endianness: Endianness) -> Vec<u8> {
        let mut encoder = Encoder::new(endianness);
        encoder.u32(1_700_000_000).u32(5).raw(&[40]);
        for text in ["robot1.lidar", "no data", "lidar.cpp", "read"] {
            encoder.string(text);
        }
        encoder.u32(81);
        let little = u8::from(endianness == Endianness::Little);
        [&[0, little, 0, 0], &encoder.bytes[..]].concat()
    }

    #[test]
    fn a_message_reads_the_same_in_either_byte_order() {
        for endianness in [Endianness::Big, Endianness::Little] {
            let bytes = encoded(endianness);
            let log = Log::parse(&bytes).unwrap();
            assert_eq!(log.stamp, (1_700_000_000, 5));
            assert_eq!(log.level, LogLevel::Error);
            assert_eq!(
                (log.logger, log.text),
                (&b"robot1.lidar"[..], &b"no data"[..])
            );
            assert_eq!((log.file, log.function), (&b"lidar.cpp"[..], &b"read"[..]));
            assert_eq!(log.line, 81);
        }
    }

    #[test]
    fn text_of_another_encoding_is_read_and_another_encapsulation_is_refused() {
        let mut bytes = encoded(Endianness::Little);
        let at = bytes.windows(4).position(|four| four == b"no d").unwrap();
        bytes[at] = 0xe9;
        assert_eq!(Log::parse(&bytes).unwrap().text[0], 0xe9);
        bytes[1] = 3;
        assert_eq!(Log::parse(&bytes).unwrap_err().reason, Reason::BadMarker);
    }

    #[test]
    fn numbers_between_two_levels_count_as_the_lower_one() {
        let levels = [0, 10, 19, 20, 29, 30, 40, 49, 50, 255].map(LogLevel::of);
        let counts =
            LogLevel::ALL.map(|level| levels.iter().filter(|each| **each == level).count());
        assert_eq!(counts, [3, 2, 1, 2, 2]);
    }

    #[test]
    fn no_truncation_or_corruption_of_one_byte_makes_the_parser_panic() {
        hurt(&encoded(Endianness::Little), |bytes| {
            let _ = Log::parse(bytes);
        });
    }
}
