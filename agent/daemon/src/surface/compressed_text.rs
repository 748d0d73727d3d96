//! Text that is kept compressed until it is sent. A page of metrics repeats the same names
//! thousands of times: 2 MB for 200 topics. The text is compressed piece by piece as it is written,
//! and each piece is read once.

use std::collections::VecDeque;
use std::fmt;
use std::io::{self, Write as _};

use axum::body::{Body, Bytes};
use flate2::Compression;
use flate2::write::GzEncoder;
use futures_util::stream;
use lz4_flex::block::{compress_prepend_size, decompress_size_prepended};

use super::large_responses::Reservation;

/// Approximate size of a piece in bytes, as it is sent.
const PIECE_BYTES: usize = 64 << 10;

/// Encoding of the text for the client.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Encoding {
    /// Uncompressed.
    Identity,
    /// Compressed with gzip (RFC 1952).
    Gzip,
}

/// Accepts text and keeps it compressed.
pub(super) struct TextCompressor {
    pieces: VecDeque<Box<[u8]>>,
    length: usize,
    form: Form,
}

/// Text that is not a complete piece yet.
enum Form {
    Plain(Vec<u8>),
    Gzip(GzEncoder<Vec<u8>>),
}

/// The complete text.
#[derive(Debug)]
pub(super) struct CompressedText {
    encoding: Encoding,
    pieces: VecDeque<Box<[u8]>>,
    length: usize,
}

impl TextCompressor {
    /// Creates an empty text.
    pub(super) fn new(encoding: Encoding) -> Self {
        Self {
            pieces: VecDeque::new(),
            length: 0,
            form: match encoding {
                Encoding::Identity => Form::Plain(Vec::new()),
                Encoding::Gzip => Form::Gzip(GzEncoder::new(Vec::new(), Compression::fast())),
            },
        }
    }

    /// Appends to the text.
    ///
    /// # Errors
    /// Never fails, because it writes to memory.
    pub(super) fn write(&mut self, text: &[u8]) -> io::Result<()> {
        for part in text.chunks(PIECE_BYTES) {
            match &mut self.form {
                Form::Plain(rest) => rest.extend_from_slice(part),
                Form::Gzip(encoder) => encoder.write_all(part)?,
            }
            self.compress_piece(PIECE_BYTES);
        }
        Ok(())
    }

    /// Returns the complete text.
    ///
    /// # Errors
    /// Never fails, because it writes to memory.
    pub(super) fn finish(mut self) -> io::Result<CompressedText> {
        let encoding = match &mut self.form {
            Form::Plain(_) => Encoding::Identity,
            Form::Gzip(encoder) => {
                encoder.try_finish()?;
                Encoding::Gzip
            }
        };
        self.compress_piece(1);
        Ok(CompressedText {
            encoding,
            pieces: self.pieces,
            length: self.length,
        })
    }

    /// Completes a piece if at least this many bytes are pending.
    fn compress_piece(&mut self, least: usize) {
        let rest = match &mut self.form {
            Form::Plain(rest) => rest,
            Form::Gzip(encoder) => encoder.get_mut(),
        };
        if rest.len() < least {
            return;
        }
        self.length += rest.len();
        let piece = match self.form {
            Form::Plain(ref mut rest) => {
                let piece = compress_prepend_size(rest);
                rest.clear();
                piece
            }
            Form::Gzip(ref mut encoder) => std::mem::take(encoder.get_mut()),
        };
        self.pieces.push_back(piece.into_boxed_slice());
    }
}

impl fmt::Write for TextCompressor {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        self.write(text.as_bytes()).map_err(|_| fmt::Error)
    }
}

impl CompressedText {
    /// Returns the number of bytes that the client receives.
    pub(super) const fn len(&self) -> usize {
        self.length
    }

    /// Returns the number of bytes in memory.
    pub(super) fn kept(&self) -> usize {
        self.pieces.iter().map(|piece| piece.len()).sum()
    }

    /// Returns the text as a response body, which ends with an error if its `reservation` is
    /// revoked.
    pub(super) fn into_body(self, reservation: Option<Reservation>) -> Body {
        let encoding = self.encoding;
        let pieces = self.pieces.into_iter().map(move |piece| {
            if reservation.as_ref().is_some_and(Reservation::is_revoked) {
                return Err(io::Error::other("read too slowly while others waited"));
            }
            match encoding {
                Encoding::Identity => decompress_size_prepended(&piece)
                    .map(Bytes::from)
                    .map_err(io::Error::other),
                Encoding::Gzip => Ok(Bytes::from(piece)),
            }
        });
        Body::from_stream(stream::iter(pieces))
    }
}

#[cfg(test)]
mod tests {
    use std::fmt::Write as _;
    use std::io::Read as _;

    use axum::body::to_bytes;

    use super::*;

    #[tokio::test]
    async fn a_page_is_kept_in_a_tenth_of_its_size_and_is_sent_unchanged() {
        for encoding in [Encoding::Identity, Encoding::Gzip] {
            let mut packer = TextCompressor::new(encoding);
            let mut page = String::new();
            for topic in 0..2_000_u32 {
                let line = format!(
                    "ros2_topic_interval_seconds_bucket{{domain_id=\"0\",topic=\"/robot/sensor_{topic}\",le=\"{}\"}} {}\n",
                    f64::from(topic % 20) / 64.0,
                    topic.wrapping_mul(2_654_435_761),
                );
                for _ in 0..8 {
                    packer.write_str(&line).unwrap();
                    page.push_str(&line);
                }
            }
            let packed = packer.finish().unwrap();
            assert!(packed.kept() * 10 < page.len(), "{} kept", packed.kept());
            let length = packed.len();
            let body = to_bytes(packed.into_body(None), usize::MAX).await.unwrap();
            assert_eq!(body.len(), length);
            let text = match encoding {
                Encoding::Identity => String::from_utf8(body.to_vec()).unwrap(),
                Encoding::Gzip => {
                    let mut text = String::new();
                    let mut decoder = flate2::read::GzDecoder::new(&body[..]);
                    decoder.read_to_string(&mut text).unwrap();
                    text
                }
            };
            assert_eq!(text, page);
            let nothing = TextCompressor::new(encoding).finish().unwrap();
            assert!(nothing.len() < 32);
        }
    }
}
