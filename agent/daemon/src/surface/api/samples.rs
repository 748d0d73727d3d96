//! `GET /samples`: messages of topics as they arrive, as long as the client is connected. The
//! topics are measured while the stream is open.
//!
//! Each stream is a subscription with a bounded queue. A client of a live agent that reads slowly
//! misses messages and receives their number. It does not delay other clients. A replay waits for
//! its clients.

use std::collections::HashSet;
use std::time::Duration;

use axum::body::Body;
use axum::extract::{Extension, State};
use axum::http::header::{CACHE_CONTROL, CONTENT_TYPE};
use axum::response::{IntoResponse, Response};
use bytes::Bytes;
use ros2probe_wire::{DomainId, Guid};
use serde::Deserialize;
use tokio_util::sync::CancellationToken;
use utoipa::IntoParams;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::Context;
use super::body_stream::{Pieces, stream_of};
use super::endpoint::printed;
use super::parameters::Parameters;
use super::problem::{Code, Problem, ProblemBody};
use super::scope::domain;
use super::security::Rights;
use crate::agent_facts::SourceKind;
use crate::config::Access;
use crate::subscriptions::line::{line, offered};
use crate::subscriptions::{
    Candidate, Choice, Depth, Item, Overflow, Refused, Request, Selection, Subscription,
};
use crate::tables::DescribedWriters;
use ros2probe_api::samples::{LINES, Line, Open, OpenTopic, SAMPLES};
use ros2probe_model::facts::bounded::Bounded;
use ros2probe_model::report::snapshot::Snapshot;

/// Maximum number of names and globs per request, of characters in a list of them, and of
/// characters in a regular expression.
const MAX_PATTERNS: usize = 256;
const MAX_LIST: usize = 16_384;
const MAX_REGEX: usize = 4_096;
/// Size of a piece of the answer, in bytes. A larger payload is a piece of its own, without a copy.
const BATCH_BYTES: usize = 16 * 1024;
/// Time for which a live stream collects messages after the first one. One piece for many small
/// messages saves system calls in agent and client. The times of the messages are still their
/// capture times.
const BATCH_DELAY: Duration = Duration::from_millis(20);
/// Default queue sizes in bytes: for a few thousand arrivals, and for messages with payloads.
const ARRIVALS_BYTES: usize = 1 << 20;
const PAYLOADS_BYTES: usize = 16 << 20;
const LEAST_BYTES: usize = 64 << 10;
/// Maximum time that the first line waits for the capture to apply the subscription, and for
/// breakpoints in the processes that send the samples.
const CONFIRMATION_TIMEOUT: Duration = Duration::from_secs(6);

#[derive(Clone, Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields, default)]
#[into_params(parameter_in = Query)]
struct Wanted {
    /// Topics, separated by commas: ROS names, globs as in a watch, or exact DDS names. Topics that
    /// appear later are included.
    #[param(max_length = 16384, example = "/points,/robot1/**")]
    topic: Option<String>,
    /// Regular expression; topics are included if it matches a part of their name.
    #[param(max_length = 4096)]
    regex: Option<String>,
    /// Whether to include every topic that `ros2 topic list` shows.
    all: bool,
    /// Topics to exclude, in the form of `topic`.
    #[param(max_length = 16384)]
    exclude: Option<String>,
    /// Regular expression; topics are excluded if it matches a part of their name.
    #[param(max_length = 4096)]
    exclude_regex: Option<String>,
    /// Whether globs, `regex` and `all` include hidden topics. An exact name always does.
    hidden: bool,
    /// Domain id of the topics; by default every domain.
    #[param(maximum = 232)]
    domain_id: Option<u32>,
    /// Whether to send the payloads of the messages.
    payload: bool,
    /// Whether `payload` first sends the last messages that the agent keeps of latched topics; by
    /// default true.
    latched: Option<bool>,
    /// Size of the queue for this client in bytes, at least 64 KiB; `limits.payload_bytes` bounds
    /// the queues of all streams together. A full queue drops the oldest message of the topic with
    /// the most bytes in the queue.
    queue_bytes: Option<usize>,
}

/// The stream of one client.
struct Stream {
    subscription: Subscription,
    stop: CancellationToken,
    /// Payload to send next, after the line of its message.
    payload: Option<Bytes>,
    first: Option<Line>,
    /// Whether to collect small messages for [`BATCH_DELAY`].
    collects: bool,
    /// Writers whose QoS has been sent.
    introduced: Bounded<DescribedWriters, HashSet<Guid>>,
    ended: bool,
}

pub(super) fn routes() -> OpenApiRouter<Context> {
    OpenApiRouter::new().routes(routes!(samples))
}

/// Messages of topics, as they arrive
///
/// Each line is a JSON object with one key. The first line is `open`, with the selected topics that
/// are known. `sample` is a message; each message has one line, even if it was captured several
/// times. `clock` follows at least ten times per second and contains the time up to which the
/// stream is complete. `missed` reports messages that are missing from the stream, with the reason.
/// `end` is the last line. With `payload=true`, a sample's line is followed by `payload_bytes` raw
/// bytes: the serialized message with its encapsulation. The topics are measured while the stream
/// is open, but are not listed as watches.
#[utoipa::path(
    get,
    path = "/samples",
    tag = "samples",
    params(Wanted),
    responses(
        (status = 200, description = "Lines, until the client disconnects, or the capture or the \
            agent ends.",
            content((Line = "application/x-ndjson"), (Line = "application/vnd.ros2probe.samples"))),
        (status = 422, description = "No topic requested, or an invalid topic name.",
            body = ProblemBody, content_type = "application/problem+json"),
        (status = 503, description = "The limit of subscriptions is reached, or their patterns are too many.",
            body = ProblemBody, content_type = "application/problem+json"),
    )
)]
async fn samples(
    State(context): State<Context>,
    Extension(granted): Extension<Rights>,
    Parameters(wanted): Parameters<Wanted>,
) -> Result<Response, Problem> {
    if wanted.payload {
        granted.require(Access::All)?;
    }
    let domain_id = domain(wanted.domain_id, Code::InvalidRequest)?;
    let is_replay = context.latest.state().agent.source == SourceKind::Replay;
    let (depth, queue_bytes, media_type) = if wanted.payload {
        (Depth::Payloads, PAYLOADS_BYTES, SAMPLES)
    } else {
        (Depth::Arrivals, ARRIVALS_BYTES, LINES)
    };
    // A smaller queue might overflow during a pause, and a pause would slow down a replay.
    let collects = !is_replay && wanted.queue_bytes.is_none_or(|bytes| bytes >= queue_bytes);
    let queue_bytes = wanted.queue_bytes.unwrap_or(queue_bytes).max(LEAST_BYTES);
    let request = Request {
        topics: selection(&wanted)?,
        domain_id,
        depth,
        queue_bytes,
        overflow: if is_replay {
            Overflow::Wait
        } else {
            Overflow::DropOldest
        },
        is_clock_complete: depth == Depth::Payloads,
        latched: wanted.latched.unwrap_or(true),
        label: "GET /samples".to_owned(),
    };
    let opened = context.subscriptions.open(request);
    let subscription = opened.map_err(|refused: Refused| {
        Problem::new(Code::TooManySubscriptions, refused.to_string())
    })?;
    let known = if is_replay {
        context.latest.state()
    } else {
        tokio::select! {
            _ = subscription.in_force(CONFIRMATION_TIMEOUT) => {}
            // The stream then ends with the reason `agent ends`.
            () = context.stop.cancelled() => {}
        }
        context.state().await
    };
    let most = context.limits.caps().topics;
    let first = Line::Open(Open {
        topics: topics(known.known(), &subscription.selection(), domain_id, most),
    });
    let stream = Stream {
        subscription,
        stop: context.stop.clone(),
        payload: None,
        first: Some(first),
        collects,
        introduced: Bounded::default(),
        ended: false,
    };
    let headers = [(CACHE_CONTROL, "no-store"), (CONTENT_TYPE, media_type)];
    Ok((headers, Body::from_stream(stream_of(stream))).into_response())
}

impl Pieces for Stream {
    type Piece = Bytes;

    /// Returns the next piece of the answer: some lines, or the payload of the last line. Returns
    /// `None` at the end of the answer.
    async fn next(&mut self) -> Option<Bytes> {
        if let Some(payload) = self.payload.take() {
            return Some(payload);
        }
        let mut lines = Vec::new();
        if let Some(first) = self.first.take() {
            write(&mut lines, &first);
        }
        while !self.ended && self.payload.is_none() && lines.len() < BATCH_BYTES {
            let item = match self.subscription.try_next() {
                Some(item) => item,
                None if !lines.is_empty() => break,
                None => self.wait().await,
            };
            write(&mut lines, &self.line(&item));
            match item {
                Item::Sample(sample) => match &sample.payload {
                    Some(payload) if lines.len() + payload.len() <= BATCH_BYTES => {
                        lines.extend_from_slice(payload);
                    }
                    payload => self.payload.clone_from(payload),
                },
                Item::End(_) => self.ended = true,
                Item::Clock(_) | Item::Missed(_) => {}
            }
        }
        (!lines.is_empty()).then(|| lines.into())
    }
}

impl Stream {
    /// Returns the line of an item. The first sample of each writer contains the writer's QoS.
    fn line(&mut self, item: &Item) -> Line {
        let mut line = line(item);
        if let (Line::Sample(facts), Item::Sample(sample)) = (&mut line, item)
            && sample.payload.is_some()
            && let Some(announced) = &sample.topic.offered
            && self.introduced.insert(sample.writer)
        {
            facts.offered = Some(Box::new(offered(announced)));
        }
        line
    }

    async fn wait(&mut self) -> Item {
        let item = tokio::select! {
            biased;
            item = self.subscription.next() => item,
            () = self.stop.cancelled() => None,
        };
        if self.collects && matches!(item, Some(Item::Sample(_) | Item::Clock(_))) {
            tokio::select! {
                () = tokio::time::sleep(BATCH_DELAY) => {}
                () = self.stop.cancelled() => {}
            }
        }
        item.unwrap_or(Item::End("agent ends"))
    }
}

fn write(lines: &mut Vec<u8>, line: &Line) {
    // Serializing plain numbers and strings into memory cannot fail.
    let _ = serde_json::to_writer(&mut *lines, line);
    lines.push(b'\n');
}

fn selection(wanted: &Wanted) -> Result<Selection, Problem> {
    let mut include = patterns(wanted.topic.as_deref(), wanted.regex.as_deref())?;
    if wanted.all {
        include.push(Choice::All);
    }
    if include.is_empty() {
        let detail = "no topic requested: use `topic`, `regex` or `all=true`";
        return Err(Problem::new(Code::InvalidRequest, detail));
    }
    Ok(Selection {
        include,
        exclude: patterns(wanted.exclude.as_deref(), wanted.exclude_regex.as_deref())?,
        hidden: wanted.hidden,
    })
}

fn patterns(names: Option<&str>, regex: Option<&str>) -> Result<Vec<Choice>, Problem> {
    for (text, most) in [(names, MAX_LIST), (regex, MAX_REGEX)] {
        if text.is_some_and(|text| text.chars().count() > most) {
            let detail = format!("a list or an expression of more than {most} characters");
            return Err(Problem::new(Code::InvalidRequest, detail));
        }
    }
    let names: Vec<_> = names.into_iter().flat_map(|list| list.split(',')).collect();
    if names.len() > MAX_PATTERNS {
        let detail = format!("at most {MAX_PATTERNS} topics can be named; use globs");
        return Err(Problem::new(Code::InvalidRequest, detail));
    }
    let names = names.into_iter().map(|name| Choice::parse(name.trim()));
    let choices: Result<_, _> = names.chain(regex.map(Choice::regex)).collect();
    choices.map_err(|error| {
        let detail = format!("{:#}", anyhow::anyhow!(error));
        Problem::new(Code::InvalidRequest, detail)
    })
}

/// Returns the selected topics that are known, at most `most` of them.
fn topics(
    snapshot: &Snapshot,
    selection: &Selection,
    domain_id: Option<DomainId>,
    most: usize,
) -> Vec<OpenTopic> {
    let topics = snapshot.topics.iter().filter(|topic| {
        domain_id.is_none_or(|wanted| wanted == topic.domain_id)
            && selection.covers(&Candidate::from(*topic))
    });
    topics
        .take(most)
        .map(|topic| OpenTopic {
            topic: topic.name.to_string(),
            domain_id: topic.domain_id.0,
            types: printed(&topic.message_types),
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_invalid_selection_is_refused() {
        let wanted = |topic: &str, regex: &str| Wanted {
            topic: (!topic.is_empty()).then(|| topic.to_owned()),
            regex: (!regex.is_empty()).then(|| regex.to_owned()),
            ..Wanted::default()
        };
        for (topic, regex) in [("/points, /robot1/**,rq/addRequest", ""), ("", "^/cam.*,x")] {
            assert!(selection(&wanted(topic, regex)).is_ok(), "{topic} {regex}");
        }
        let many = vec!["/a"; MAX_PATTERNS + 1].join(",");
        for (topic, regex) in [
            ("", ""),
            ("/a//b", ""),
            ("/a,,/b", ""),
            (&many, ""),
            ("", "("),
        ] {
            let refused = selection(&wanted(topic, regex)).unwrap_err();
            assert_eq!(refused.code(), Code::InvalidRequest, "{topic} {regex}");
        }
    }
}
