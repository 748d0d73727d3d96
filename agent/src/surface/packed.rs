//! Text that is kept compressed until it is sent: a page of metrics repeats the same names thousands of
//! times, 2 MB for 200 topics. Compressed piece by piece as it is written, and read piece by piece once.

use std::collections::VecDeque;
use std::fmt;

use axum::body::{Body, Bytes};
use futures_util::stream;
use lz4_flex::block::{DecompressError, compress_prepend_size, decompress_size_prepended};

/// Bytes of text in a piece, or a little more.
const PIECE: usize = 64 << 10;

/// The text, begun or whole.
#[derive(Debug, Default)]
pub(super) struct Packed {
    pieces: VecDeque<Box<[u8]>>,
    rest: String,
    length: usize,
}

impl Packed {
    /// Bytes of the text.
    pub(super) const fn len(&self) -> usize {
        self.length
    }

    /// The text as an answer, which lives as long as `company`.
    pub(super) fn into_body(mut self, company: impl Send + 'static) -> Body {
        self.pack();
        let pieces = self.pieces.into_iter().map(move |piece| {
            let _company = &company;
            unpack(&piece)
        });
        Body::from_stream(stream::iter(pieces))
    }

    fn pack(&mut self) {
        let piece = compress_prepend_size(self.rest.as_bytes());
        self.pieces.push_back(piece.into_boxed_slice());
        self.rest.clear();
    }
}

fn unpack(piece: &[u8]) -> Result<Bytes, DecompressError> {
    decompress_size_prepended(piece).map(Bytes::from)
}

impl fmt::Write for Packed {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        self.rest.push_str(text);
        self.length += text.len();
        if self.rest.len() >= PIECE {
            self.pack();
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use std::fmt::Write as _;
    use std::sync::Arc;

    use axum::body::to_bytes;

    use super::*;

    #[tokio::test]
    async fn a_page_takes_a_tenth_of_its_length_and_comes_back_as_it_was() {
        let mut packed = Packed::default();
        let mut page = String::new();
        for topic in 0..2_000_u32 {
            let line = format!(
                "ros2_topic_interval_seconds_bucket{{domain_id=\"0\",topic=\"/robot/sensor_{topic}\",le=\"{}\"}} {}\n",
                f64::from(topic % 20) / 64.0,
                topic.wrapping_mul(2_654_435_761),
            );
            for _ in 0..8 {
                packed.write_str(&line).unwrap();
                page.push_str(&line);
            }
        }
        assert_eq!(packed.len(), page.len());
        let kept: usize = packed.pieces.iter().map(|piece| piece.len()).sum();
        assert!(kept * 10 < page.len(), "{kept} of {}", page.len());
        let company = Arc::new(());
        let body = packed.into_body(Arc::clone(&company));
        assert_eq!(Arc::strong_count(&company), 2);
        assert_eq!(to_bytes(body, usize::MAX).await.unwrap(), page);
        assert_eq!(Arc::strong_count(&company), 1);
        let nothing = Packed::default().into_body(());
        assert!(to_bytes(nothing, 1).await.unwrap().is_empty());
    }
}
