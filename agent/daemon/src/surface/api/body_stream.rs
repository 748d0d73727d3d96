//! Response bodies that are produced piece by piece while the client reads.

use std::convert::Infallible;

use axum::body::Body;
use axum::http::header::{CACHE_CONTROL, CONTENT_TYPE};
use axum::response::{IntoResponse as _, Response};
use futures_util::stream::{self, Stream};
use serde::Serialize;

/// Produces the pieces of one client's response.
pub(super) trait Pieces: Send + 'static {
    /// Bytes, or a server-sent event.
    type Piece: Send;

    /// Returns the next piece, or `None` at the end of the response.
    fn next(&mut self) -> impl Future<Output = Option<Self::Piece>> + Send;
}

/// Turns `source` into a stream for a response body. The source is dropped with the connection.
pub(super) fn stream_of<S: Pieces>(
    source: S,
) -> impl Stream<Item = Result<S::Piece, Infallible>> + Send {
    stream::unfold(source, |mut source| async {
        let piece = source.next().await?;
        Some((Ok(piece), source))
    })
}

/// Returns an answer of lines of JSON.
pub(super) fn lines_of(body: impl Into<Body>) -> Response {
    let headers = [
        (CACHE_CONTROL, "no-store"),
        (CONTENT_TYPE, "application/x-ndjson"),
    ];
    (headers, body.into()).into_response()
}

/// Appends a line of JSON to `lines`.
pub(super) fn write_line(lines: &mut Vec<u8>, line: &impl Serialize) {
    // Serializing plain numbers and strings into memory cannot fail.
    let _ = serde_json::to_writer(&mut *lines, line);
    lines.push(b'\n');
}
