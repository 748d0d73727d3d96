//! Refused requests: problem details (RFC 9457) with stable codes.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

/// A kind of problem. Codes are stable; titles and details may change.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Code {
    /// The request is not valid HTTP, or its path or query cannot be decoded.
    MalformedRequest,
    /// The request has no token, or an unknown token.
    Unauthorized,
    /// The request's `Host` is not a name of this agent.
    ForeignHost,
    /// A web page of another origin sent the request.
    ForeignOrigin,
    /// This listener does not grant the request, but the unix socket grants it.
    NeedsSocket,
    /// The path does not exist.
    NotFound,
    /// The watch does not exist.
    NoSuchWatch,
    /// The topic does not exist.
    NoSuchTopic,
    /// The node does not exist.
    NoSuchNode,
    /// No history is kept, or none of that time.
    NoHistory,
    /// The agent replays no capture.
    NoReplay,
    /// The agent has no engine of a fleet.
    NoFleet,
    /// The name exists several times; the request must select one of them.
    Ambiguous,
    /// The path exists, but not with this method.
    MethodNotAllowed,
    /// The topic is already watched with other settings.
    WatchDiffers,
    /// The configuration or the command line lists the watch, so a client cannot change it.
    WatchGiven,
    /// The maximum number of watches is reached.
    TooManyWatches,
    /// The agent runs without a configuration file.
    NothingToReload,
    /// The request's body is too large.
    BodyTooLarge,
    /// The request's body is not declared as JSON.
    UnsupportedMediaType,
    /// The body or a parameter has an invalid value.
    InvalidRequest,
    /// The configuration file has errors.
    InvalidConfiguration,
    /// The client sends requests too fast.
    TooManyRequests,
    /// The maximum number of streams is open.
    TooManyStreams,
    /// The maximum number of clients is connected.
    TooManyClients,
    /// The maximum number of subscriptions is open.
    TooManySubscriptions,
    /// The recording does not exist.
    NoSuchRecording,
    /// The snapshot does not exist.
    NoSuchSnapshot,
    /// A recording of this name exists.
    RecordingExists,
    /// The maximum number of recordings is running.
    TooManyRecordings,
    /// The configuration names no directory for recordings.
    NoPlaceForRecordings,
    /// The bag cannot be written to the storage.
    StorageRefuses,
    /// The agent is shutting down.
    Ending,
}

/// Problem details (RFC 9457).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Problem {
    /// URN that identifies the kind of problem; it is stable.
    #[serde(rename = "type")]
    #[cfg_attr(
        feature = "openapi",
        schema(example = "urn:ros2probe:problem:no-such-watch")
    )]
    pub kind: String,
    /// Title of this kind of problem.
    #[serde(default)]
    #[cfg_attr(
        feature = "openapi",
        schema(required = true, example = "No such watch")
    )]
    pub title: Cow<'static, str>,
    /// HTTP status of the answer.
    #[serde(default)]
    #[cfg_attr(
        feature = "openapi",
        schema(required = true, minimum = 400, maximum = 599)
    )]
    pub status: u16,
    /// What is wrong with this request, and how to correct it.
    pub detail: String,
    /// Errors of the configuration file, one per line: `file:line:column: key: message`.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub mistakes: Vec<String>,
}

/// Prefix of each problem's `type`.
pub const URN: &str = "urn:ros2probe:problem:";
/// Media type of a problem.
pub const MEDIA_TYPE: &str = "application/problem+json";

impl Code {
    /// Returns the end of the type URN, the HTTP status and the title.
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
                "The unix socket or a token is required",
            ),
            Self::NotFound => ("not-found", 404, "No such path"),
            Self::NoSuchWatch => ("no-such-watch", 404, "No such watch"),
            Self::NoSuchTopic => ("no-such-topic", 404, "No such topic"),
            Self::NoSuchNode => ("no-such-node", 404, "No such node"),
            Self::NoHistory => ("no-history", 404, "No history"),
            Self::NoReplay => ("no-replay", 404, "No replay"),
            Self::NoFleet => ("no-fleet", 404, "No fleet"),
            Self::Ambiguous => ("ambiguous", 409, "The name is ambiguous"),
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
                "The configuration has errors and was not applied",
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
            Self::RecordingExists => ("recording-exists", 409, "A recording of this name exists"),
            Self::TooManyRecordings => ("too-many-recordings", 409, "Too many recordings"),
            Self::NoPlaceForRecordings => (
                "no-place-for-recordings",
                409,
                "The agent has no directory for recordings",
            ),
            Self::StorageRefuses => (
                "storage-refuses",
                507,
                "The bag cannot be written to the storage",
            ),
            Self::Ending => ("ending", 503, "The agent is shutting down"),
        }
    }

    /// Returns the last segment of `type`, which identifies the kind of problem.
    #[must_use]
    pub const fn as_str(self) -> &'static str {
        self.parts().0
    }

    /// Returns the HTTP status of the answer.
    #[must_use]
    pub const fn status(self) -> u16 {
        self.parts().1
    }

    /// Returns the title of this kind of problem.
    #[must_use]
    pub const fn title(self) -> &'static str {
        self.parts().2
    }
}
