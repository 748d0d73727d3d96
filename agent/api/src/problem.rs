//! Refused requests: problem details (RFC 9457) with stable codes.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

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

/// Problem details (RFC 9457).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Problem {
    /// What kind of problem this is; stable.
    #[serde(rename = "type")]
    #[cfg_attr(
        feature = "openapi",
        schema(example = "urn:ros2probe:problem:no-such-watch")
    )]
    pub kind: String,
    /// The kind in words.
    #[serde(default)]
    #[cfg_attr(
        feature = "openapi",
        schema(required = true, example = "No such watch")
    )]
    pub title: Cow<'static, str>,
    /// The status of the answer.
    #[serde(default)]
    #[cfg_attr(
        feature = "openapi",
        schema(required = true, minimum = 400, maximum = 599)
    )]
    pub status: u16,
    /// What is wrong with this request, and what would be right.
    pub detail: String,
    /// Mistakes of the configuration file, one line each: `file:line:column: key: message`.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub mistakes: Vec<String>,
}

/// The beginning of each problem's `type`.
pub const URN: &str = "urn:ros2probe:problem:";
/// The media type of a problem.
pub const MEDIA_TYPE: &str = "application/problem+json";

impl Code {
    /// The end of the type URN, the status and the title.
    const fn parts(self) -> (&'static str, u16, &'static str) {
        match self {
            Self::MalformedRequest => ("malformed-request", 400, "The request cannot be read"),
            Self::Unauthorized => ("unauthorized", 401, "A bearer token is needed"),
            Self::ForeignHost => ("foreign-host", 403, "The request names another host"),
            Self::ForeignOrigin => (
                "foreign-origin",
                403,
                "The request comes from a foreign web page",
            ),
            Self::NeedsSocket => (
                "needs-socket",
                403,
                "Only by the unix socket or with a token",
            ),
            Self::NotFound => ("not-found", 404, "No such path"),
            Self::NoSuchWatch => ("no-such-watch", 404, "No such watch"),
            Self::NoSuchTopic => ("no-such-topic", 404, "No such topic"),
            Self::NoSuchNode => ("no-such-node", 404, "No such node"),
            Self::Ambiguous => ("ambiguous", 409, "Several things have the name"),
            Self::MethodNotAllowed => ("method-not-allowed", 405, "Method not allowed"),
            Self::WatchDiffers => ("watch-differs", 409, "Watched with other settings"),
            Self::WatchGiven => ("watch-given", 409, "Not a client's watch"),
            Self::TooManyWatches => ("too-many-watches", 409, "Too many watches"),
            Self::NothingToReload => ("nothing-to-reload", 409, "No configuration file"),
            Self::BodyTooLarge => ("body-too-large", 413, "The body is too large"),
            Self::UnsupportedMediaType => ("unsupported-media-type", 415, "The body must be JSON"),
            Self::InvalidRequest => ("invalid-request", 422, "The request cannot be satisfied"),
            Self::InvalidConfiguration => (
                "invalid-configuration",
                422,
                "The configuration has mistakes and was not taken over",
            ),
            Self::TooManyRequests => ("too-many-requests", 429, "Too many requests"),
            Self::TooManyStreams => ("too-many-streams", 503, "Too many streams of events"),
            Self::TooManyClients => ("too-many-clients", 503, "Too many connections"),
            Self::TooManySubscriptions => (
                "too-many-subscriptions",
                503,
                "Too many streams of messages",
            ),
            Self::NoSuchRecording => ("no-such-recording", 404, "No such recording"),
            Self::NoSuchSnapshot => ("no-such-snapshot", 404, "No such snapshot"),
            Self::RecordingExists => ("recording-exists", 409, "There is one of that name"),
            Self::TooManyRecordings => ("too-many-recordings", 409, "Too many recordings"),
            Self::NoPlaceForRecordings => (
                "no-place-for-recordings",
                409,
                "The agent has no directory for recordings",
            ),
            Self::StorageRefuses => ("storage-refuses", 507, "The storage does not take it"),
            Self::Ending => ("ending", 503, "The agent is shutting down"),
        }
    }

    /// The last segment of its `type`, which identifies the kind of problem.
    #[must_use]
    pub const fn as_str(self) -> &'static str {
        self.parts().0
    }

    /// The status of the answer.
    #[must_use]
    pub const fn status(self) -> u16 {
        self.parts().1
    }

    /// In words.
    #[must_use]
    pub const fn title(self) -> &'static str {
        self.parts().2
    }
}
