//! What a refused request is answered with: problem details (RFC 9457), each kind with a stable
//! code. Every code there is stands in [`Code`].

use std::borrow::Cow;

use axum::http::header::{CACHE_CONTROL, CONTENT_TYPE, RETRY_AFTER, WWW_AUTHENTICATE};
use axum::http::{HeaderValue, StatusCode};
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use utoipa::ToSchema;

/// The body's media type.
pub const MEDIA_TYPE: &str = "application/problem+json";

/// A kind of problem. Codes are stable; titles and details are for people.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Code {
    /// The request cannot be read.
    MalformedRequest,
    /// No token, or a wrong one.
    Unauthorized,
    /// The name the request was sent to is not this agent's.
    ForeignHost,
    /// Sent by a web page from elsewhere.
    ForeignOrigin,
    /// The listener does not grant it; the unix socket does.
    NeedsSocket,
    /// No such path.
    NotFound,
    /// No such watch.
    NoSuchWatch,
    /// No such topic.
    NoSuchTopic,
    /// No such node.
    NoSuchNode,
    /// Several things have the name.
    Ambiguous,
    /// The path is there, the method is not.
    MethodNotAllowed,
    /// It is watched with other settings.
    WatchDiffers,
    /// The configuration or the command line lists it.
    WatchGiven,
    /// No room for another watch.
    TooManyWatches,
    /// The agent runs without a configuration file.
    NothingToReload,
    /// More bytes than a request needs.
    BodyTooLarge,
    /// A body that is not said to be JSON.
    UnsupportedMediaType,
    /// JSON that does not say what is possible.
    InvalidRequest,
    /// The configuration file has mistakes.
    InvalidConfiguration,
    /// Too fast.
    TooManyRequests,
    /// As many clients follow events as may.
    TooManyStreams,
    /// As many clients are connected as may.
    TooManyClients,
    /// As many subscriptions are open as may.
    TooManySubscriptions,
    /// No such recording.
    NoSuchRecording,
    /// No such snapshot.
    NoSuchSnapshot,
    /// There is one of that name.
    RecordingExists,
    /// As many recordings as may are under way.
    TooManyRecordings,
    /// The configuration names no directory for them.
    NoPlaceForRecordings,
    /// A bag cannot be written there.
    StorageRefuses,
    /// The agent is about to end.
    Ending,
}

/// Why a request was refused.
#[derive(Clone, Debug)]
pub struct Problem {
    code: Code,
    detail: Cow<'static, str>,
    mistakes: Vec<String>,
}

/// Problem details (RFC 9457).
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Problem)]
pub struct ProblemBody {
    /// What kind of problem this is; stable.
    #[serde(rename = "type")]
    #[schema(example = "urn:ros2probe:problem:no-such-watch")]
    kind: String,
    /// The kind in words.
    #[schema(example = "No such watch")]
    title: &'static str,
    /// The status of the answer.
    #[schema(minimum = 400, maximum = 599)]
    status: u16,
    /// What is wrong with this request, and what would be right.
    detail: String,
    /// Mistakes of the configuration file, one line each: `file:line:column: key: message`.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    #[schema(required = false)]
    mistakes: Vec<String>,
}

impl Code {
    /// The end of the type URN, the status and the title.
    const fn parts(self) -> (&'static str, StatusCode, &'static str) {
        match self {
            Self::MalformedRequest => (
                "malformed-request",
                StatusCode::BAD_REQUEST,
                "The request cannot be read",
            ),
            Self::Unauthorized => (
                "unauthorized",
                StatusCode::UNAUTHORIZED,
                "A bearer token is needed",
            ),
            Self::ForeignHost => (
                "foreign-host",
                StatusCode::FORBIDDEN,
                "The request names another host",
            ),
            Self::ForeignOrigin => (
                "foreign-origin",
                StatusCode::FORBIDDEN,
                "The request comes from a foreign web page",
            ),
            Self::NeedsSocket => (
                "needs-socket",
                StatusCode::FORBIDDEN,
                "Only by the unix socket or with a token",
            ),
            Self::NotFound => ("not-found", StatusCode::NOT_FOUND, "No such path"),
            Self::NoSuchWatch => ("no-such-watch", StatusCode::NOT_FOUND, "No such watch"),
            Self::NoSuchTopic => ("no-such-topic", StatusCode::NOT_FOUND, "No such topic"),
            Self::NoSuchNode => ("no-such-node", StatusCode::NOT_FOUND, "No such node"),
            Self::Ambiguous => (
                "ambiguous",
                StatusCode::CONFLICT,
                "Several things have the name",
            ),
            Self::MethodNotAllowed => (
                "method-not-allowed",
                StatusCode::METHOD_NOT_ALLOWED,
                "Method not allowed",
            ),
            Self::WatchDiffers => (
                "watch-differs",
                StatusCode::CONFLICT,
                "Watched with other settings",
            ),
            Self::WatchGiven => ("watch-given", StatusCode::CONFLICT, "Not a client's watch"),
            Self::TooManyWatches => ("too-many-watches", StatusCode::CONFLICT, "Too many watches"),
            Self::NothingToReload => (
                "nothing-to-reload",
                StatusCode::CONFLICT,
                "No configuration file",
            ),
            Self::BodyTooLarge => (
                "body-too-large",
                StatusCode::PAYLOAD_TOO_LARGE,
                "The body is too large",
            ),
            Self::UnsupportedMediaType => (
                "unsupported-media-type",
                StatusCode::UNSUPPORTED_MEDIA_TYPE,
                "The body must be JSON",
            ),
            Self::InvalidRequest => (
                "invalid-request",
                StatusCode::UNPROCESSABLE_ENTITY,
                "The request cannot be satisfied",
            ),
            Self::InvalidConfiguration => (
                "invalid-configuration",
                StatusCode::UNPROCESSABLE_ENTITY,
                "The configuration has mistakes and was not taken over",
            ),
            Self::TooManyRequests => (
                "too-many-requests",
                StatusCode::TOO_MANY_REQUESTS,
                "Too many requests",
            ),
            Self::TooManyStreams => (
                "too-many-streams",
                StatusCode::SERVICE_UNAVAILABLE,
                "Too many streams of events",
            ),
            Self::TooManyClients => (
                "too-many-clients",
                StatusCode::SERVICE_UNAVAILABLE,
                "Too many connections",
            ),
            Self::TooManySubscriptions => (
                "too-many-subscriptions",
                StatusCode::SERVICE_UNAVAILABLE,
                "Too many streams of messages",
            ),
            Self::NoSuchRecording => (
                "no-such-recording",
                StatusCode::NOT_FOUND,
                "No such recording",
            ),
            Self::NoSuchSnapshot => (
                "no-such-snapshot",
                StatusCode::NOT_FOUND,
                "No such snapshot",
            ),
            Self::RecordingExists => (
                "recording-exists",
                StatusCode::CONFLICT,
                "There is one of that name",
            ),
            Self::TooManyRecordings => (
                "too-many-recordings",
                StatusCode::CONFLICT,
                "Too many recordings",
            ),
            Self::NoPlaceForRecordings => (
                "no-place-for-recordings",
                StatusCode::CONFLICT,
                "The agent has no directory for recordings",
            ),
            Self::StorageRefuses => (
                "storage-refuses",
                StatusCode::INSUFFICIENT_STORAGE,
                "The storage does not take it",
            ),
            Self::Ending => (
                "ending",
                StatusCode::SERVICE_UNAVAILABLE,
                "The agent is shutting down",
            ),
        }
    }
}

impl Problem {
    /// Of this kind; `detail` says what is wrong with this request.
    #[must_use]
    pub fn new(code: Code, detail: impl Into<Cow<'static, str>>) -> Self {
        Self {
            code,
            detail: detail.into(),
            mistakes: Vec::new(),
        }
    }

    /// Its kind.
    #[must_use]
    pub const fn code(&self) -> Code {
        self.code
    }

    /// With the mistakes of a configuration.
    #[must_use]
    pub fn with_mistakes(self, mistakes: Vec<String>) -> Self {
        Self { mistakes, ..self }
    }
}

impl From<Problem> for ProblemBody {
    fn from(problem: Problem) -> Self {
        let (code, status, title) = problem.code.parts();
        Self {
            kind: format!("urn:ros2probe:problem:{code}"),
            title,
            status: status.as_u16(),
            detail: problem.detail.into_owned(),
            mistakes: problem.mistakes,
        }
    }
}

impl IntoResponse for Problem {
    fn into_response(self) -> Response {
        let (kind, (_, status, _)) = (self.code, self.code.parts());
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
