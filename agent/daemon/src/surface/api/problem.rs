//! Refusals of requests: problem details (RFC 9457), each kind with a stable [`Code`].

use std::borrow::Cow;

use axum::http::header::{CACHE_CONTROL, CONTENT_TYPE, RETRY_AFTER, WWW_AUTHENTICATE};
use axum::http::{HeaderValue, StatusCode};
use axum::response::{IntoResponse, Response};
use ros2probe_api::problem::URN;
pub use ros2probe_api::problem::{Code, MEDIA_TYPE, Problem as ProblemBody};

/// A refusal of a request.
#[derive(Clone, Debug)]
pub struct Problem {
    code: Code,
    detail: Cow<'static, str>,
    mistakes: Vec<String>,
}

impl Problem {
    /// Creates a problem of this kind; `detail` describes it for this request.
    #[must_use]
    pub fn new(code: Code, detail: impl Into<Cow<'static, str>>) -> Self {
        Self {
            code,
            detail: detail.into(),
            mistakes: Vec::new(),
        }
    }

    /// Returns the code of the problem.
    #[must_use]
    pub const fn code(&self) -> Code {
        self.code
    }

    /// Returns the problem with the errors of a configuration.
    #[must_use]
    pub fn with_mistakes(self, mistakes: Vec<String>) -> Self {
        Self { mistakes, ..self }
    }
}

impl From<Problem> for ProblemBody {
    fn from(problem: Problem) -> Self {
        let code = problem.code;
        Self {
            kind: format!("{URN}{}", code.as_str()),
            title: code.title().into(),
            status: code.status(),
            detail: problem.detail.into_owned(),
            mistakes: problem.mistakes,
        }
    }
}

impl IntoResponse for Problem {
    fn into_response(self) -> Response {
        let kind = self.code;
        let status = StatusCode::from_u16(kind.status());
        let status = status.unwrap_or(StatusCode::INTERNAL_SERVER_ERROR);
        let body = ProblemBody::from(self);
        let mut response = (status, axum::Json(body)).into_response();
        let headers = response.headers_mut();
        headers.insert(CONTENT_TYPE, HeaderValue::from_static(MEDIA_TYPE));
        headers.insert(CACHE_CONTROL, HeaderValue::from_static("no-store"));
        match kind {
            Code::Unauthorized => {
                headers.insert(WWW_AUTHENTICATE, HeaderValue::from_static("Bearer"));
            }
            Code::TooManyRequests | Code::TooManyStreams | Code::TooManySubscriptions => {
                headers.insert(RETRY_AFTER, HeaderValue::from_static("1"));
            }
            _ => {}
        }
        response
    }
}
