//! Request bodies: a JSON object, or an empty body if every field has a default.

use axum::body::Bytes;
use axum::extract::rejection::BytesRejection;
use axum::extract::{FromRequest, Request};
use axum::http::header::CONTENT_TYPE;
use axum::http::{HeaderMap, StatusCode};
use serde::de::{DeserializeOwned, IgnoredAny};

use super::problem::{Code, Problem};
use super::security::too_large;

/// A parsed body, or the default value if the body is empty.
pub(super) struct Body<T>(pub(super) T);

impl<S: Send + Sync, T: DeserializeOwned + Default> FromRequest<S> for Body<T> {
    type Rejection = Problem;

    async fn from_request(request: Request, state: &S) -> Result<Self, Problem> {
        let is_json = is_json(request.headers());
        let body = Bytes::from_request(request, state).await;
        let body = body.map_err(|error| match error {
            BytesRejection::FailedToBufferBody(error)
                if error.status() == StatusCode::PAYLOAD_TOO_LARGE =>
            {
                too_large()
            }
            error => Problem::new(Code::MalformedRequest, error.body_text()),
        })?;
        if body.is_empty() {
            return Ok(Self(T::default()));
        }
        if !is_json {
            let detail = "send the body with `Content-Type: application/json`, or send no body";
            return Err(Problem::new(Code::UnsupportedMediaType, detail));
        }
        let problem = |error: serde_json::Error| {
            let code = if error.is_data() {
                Code::InvalidRequest
            } else {
                Code::MalformedRequest
            };
            Problem::new(code, format!("the body: {error}"))
        };
        // serde would accept an array as an object.
        if !body.trim_ascii_start().starts_with(b"{") {
            serde_json::from_slice::<IgnoredAny>(&body).map_err(problem)?;
            let detail = "the body must be a JSON object";
            return Err(Problem::new(Code::InvalidRequest, detail));
        }
        serde_json::from_slice(&body).map(Self).map_err(problem)
    }
}

fn is_json(headers: &HeaderMap) -> bool {
    let media = headers.get(CONTENT_TYPE).and_then(|it| it.to_str().ok());
    let media = media.and_then(|media| media.split(';').next());
    media.is_some_and(|media| media.trim().eq_ignore_ascii_case("application/json"))
}
