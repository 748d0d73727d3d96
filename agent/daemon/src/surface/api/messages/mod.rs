//! `GET /topics/{topic}/messages`: decoded messages of a topic, a few per second.
//!
//! The stream takes messages as they arrive and shows the newest one. The topic is measured while
//! the stream is open. Blocking threads read definitions and decode payloads, so neither the
//! capture nor other answers wait.

mod tree;

use std::sync::Arc;
use std::time::Duration;

use axum::Json;
use axum::body::Body;
use axum::response::{IntoResponse, Response};
use base64::Engine as _;
use base64::prelude::BASE64_STANDARD;
use bytes::Bytes;
use serde::{Deserialize, Serialize};
use serde_json::value::RawValue;
use tokio::sync::{Semaphore, SemaphorePermit};
use tokio::task::spawn_blocking;
use tokio::time::{Instant, sleep_until};
use utoipa::{IntoParams, ToSchema};

use super::Context;
use super::body_stream::{Pieces, lines_of, stream_of, write_line};
use super::problem::{Code, Problem, ProblemBody};
use super::scope::Domain;
use super::security::Rights;
use super::topics::{TopicParameter, find};
use crate::config::Access;
use crate::subscriptions::{Depth, Item, Overflow, Refused, Request, Selection, Subscription};
use ros2probe_api::messages::{self, Beat, Definition, End, Message, Missed};
use ros2probe_message::preview::{self, Preview, PreviewError};
use ros2probe_message::{DecodeError, Library, Limits, MessageType, decode};
use ros2probe_model::facts::dispatch::Sample;
use ros2probe_model::facts::names::{DdsName, TypeName};
use ros2probe_model::report::snapshot::EndpointFacts;
use ros2probe_wire::DomainId;
use ros2probe_wire::discovery::{EquivalenceHash, TypeHash};
use tree::{MAX_ELEMENTS, Tree};

/// Slots for streams of all listeners. Each stream makes the agent capture all payloads of its
/// topic.
static STREAM_PERMITS: Semaphore = Semaphore::const_new(MAX_READERS);
const MAX_READERS: usize = 8;
/// Default and maximum rate of shown messages, in hertz.
const MAX_HERTZ: f64 = 5.0;
const MIN_HERTZ: f64 = 0.1;
/// Maximum size of messages that wait while one is shown, in bytes.
const QUEUE_BYTES: usize = 16 << 20;
/// Maximum time without a line.
const HEARTBEAT_INTERVAL: Duration = Duration::from_secs(1);

#[derive(Clone, Copy, Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields, default)]
#[into_params(parameter_in = Query)]
pub(super) struct Wanted {
    /// Domain id; required only if the name exists in several domains.
    #[param(minimum = 0, maximum = 232)]
    domain_id: Option<u32>,
    /// Maximum number of messages shown per second; by default 5.
    #[param(minimum = 0.1, maximum = 5)]
    max_hertz: Option<f64>,
    /// Whether messages have a small picture: images, maps, scans, point clouds and poses.
    preview: Option<bool>,
}

/// A decoded message as JSON text.
#[derive(Debug, Serialize, ToSchema)]
#[serde(transparent)]
#[schema(value_type = Object)]
pub(super) struct JsonText(Box<RawValue>);

pub(super) type MessageLine = Message<JsonText>;
pub(super) type Line = messages::Line<MessageLine>;

/// The stream of one client.
struct Stream {
    context: Context,
    subscription: Subscription,
    pause: Duration,
    has_previews: bool,
    /// When the last message was shown, and when the last line was sent.
    shown: Option<Instant>,
    written: Instant,
    newest: Option<Arc<Sample>>,
    skipped: u64,
    /// Messages that cannot be shown, with the latest reason.
    missed: Option<Missed>,
    clock: Option<f64>,
    known: Option<Known>,
    ended: bool,
    _permit: SemaphorePermit<'static>,
}

/// The type in the last `type` line.
#[derive(Clone)]
struct Known {
    name: TypeName,
    hashes: (Option<TypeHash>, Option<EquivalenceHash>),
    found: Option<Arc<MessageType>>,
    /// Revision of the library. A node may describe the type later.
    revision: u64,
}

/// The definition of a topic's type
///
/// Discovery announces the name and the hash of a type. The definition matches both. For the form
/// of the path, see `/topics/{topic}/history`.
#[utoipa::path(
    get,
    path = "/topics/{topic}/definition",
    tag = "graph",
    params(TopicParameter, Domain),
    responses(
        (status = 200, description = "The type of the topic, even if its definition is unknown.", body = Definition),
        (status = 404, description = "The topic does not exist.",
            body = ProblemBody, content_type = "application/problem+json"),
        (status = 409, description = "The name exists in several domains; add `domain_id`.",
            body = ProblemBody, content_type = "application/problem+json"),
    )
)]
pub(super) async fn definition(
    context: &Context,
    name: &str,
    domain: Domain,
) -> Result<Response, Problem> {
    let state = context.state().await;
    let topic = find(state.known(), name, domain.checked()?)?;
    let hash = topic.type_hashes.first().map(ToString::to_string);
    let hash = hash.or_else(|| {
        topic
            .publishers
            .iter()
            .find_map(EndpointFacts::definition_hash)
    });
    let name = topic.message_types.first().cloned().unwrap_or_default();
    let library = Arc::clone(&context.library);
    let found = spawn_blocking(move || look_up(&library, &name, hash.as_deref()).0).await;
    let found = found.map_err(|_| Problem::new(Code::Ending, "the agent is shutting down"))?;
    Ok(Json(found).into_response())
}

/// Decoded messages of a topic
///
/// The stream shows at most five messages per second, the newest one each time, and the topic is
/// measured while it is open. Each line is a JSON object with one member. `type` precedes the first
/// message and follows each change of the type. `message` is a message, and `missed` counts
/// messages that cannot be shown. `beat` is sent once in each second without another line, and
/// `end` is the last line. For the form of the path, see `/topics/{topic}/history`.
#[utoipa::path(
    get,
    path = "/topics/{topic}/messages",
    tag = "samples",
    params(TopicParameter, Wanted),
    responses(
        (status = 200, description = "Lines, until the client disconnects, or the capture or the \
            agent ends.",
            body = Line, content_type = "application/x-ndjson"),
        (status = 404, description = "The topic does not exist.",
            body = ProblemBody, content_type = "application/problem+json"),
        (status = 409, description = "The name exists in several domains; add `domain_id`.",
            body = ProblemBody, content_type = "application/problem+json"),
        (status = 503, description = "Too many streams.",
            body = ProblemBody, content_type = "application/problem+json"),
    )
)]
pub(super) async fn follow(
    context: Context,
    granted: &Rights,
    name: &str,
    wanted: Wanted,
) -> Result<Response, Problem> {
    granted.require(Access::All)?;
    let hertz = wanted.max_hertz.unwrap_or(MAX_HERTZ);
    if !(MIN_HERTZ..=MAX_HERTZ).contains(&hertz) {
        let detail = format!("max_hertz is {hertz}, must be {MIN_HERTZ} to {MAX_HERTZ}");
        return Err(Problem::new(Code::InvalidRequest, detail));
    }
    let state = context.state().await;
    let topic = find(state.known(), name, Domain::of(wanted.domain_id).checked()?)?;
    let permit = STREAM_PERMITS.try_acquire().map_err(|_| {
        let detail = format!("{MAX_READERS} topics are being read, which is the limit");
        Problem::new(Code::TooManyStreams, detail)
    })?;
    let opened = context
        .subscriptions
        .open(request(topic.domain_id, &topic.dds_name));
    let subscription = opened.map_err(|refused: Refused| {
        Problem::new(Code::TooManySubscriptions, refused.to_string())
    })?;
    let stream = Stream {
        subscription,
        pause: Duration::from_secs_f64(1.0 / hertz),
        has_previews: wanted.preview == Some(true),
        shown: None,
        written: Instant::now(),
        newest: None,
        skipped: 0,
        missed: None,
        clock: None,
        known: None,
        ended: false,
        _permit: permit,
        context,
    };
    Ok(lines_of(Body::from_stream(stream_of(stream))))
}

/// Returns the subscription of a stream. A request topic has the ROS name of its service, so only
/// the DDS name is exact.
fn request(domain_id: DomainId, dds_name: &DdsName) -> Request {
    Request {
        topics: Selection::of_topics([(domain_id, dds_name.clone())]),
        domain_id: Some(domain_id),
        depth: Depth::Payloads,
        queue_bytes: QUEUE_BYTES,
        // A slow client must not delay the agent, nor a replay.
        overflow: Overflow::DropOldest,
        is_clock_complete: false,
        latched: true,
        label: "GET /topics/{topic}/messages".to_owned(),
    }
}

impl Pieces for Stream {
    type Piece = Bytes;

    /// Returns the next lines; `None` at the end of the stream.
    async fn next(&mut self) -> Option<Bytes> {
        if self.ended {
            return None;
        }
        let mut lines = Vec::new();
        while lines.is_empty() {
            let due = self.shown.map_or(self.written, |shown| shown + self.pause);
            let due = if self.newest.is_some() {
                due
            } else {
                self.written + HEARTBEAT_INTERVAL
            };
            tokio::select! {
                biased;
                () = sleep_until(due) => self.show(&mut lines).await,
                () = self.context.stop.cancelled() => self.end("the agent ends", &mut lines).await,
                item = self.subscription.next() => match item {
                    Some(Item::End(reason)) => self.end(reason, &mut lines).await,
                    None => self.end("the stream has ended", &mut lines).await,
                    Some(item) => self.take(item),
                },
            }
        }
        self.written = Instant::now();
        Some(lines.into())
    }
}

impl Stream {
    fn take(&mut self, item: Item) {
        match item {
            Item::Sample(sample) => {
                let before = self.newest.replace(sample);
                self.skipped += u64::from(before.is_some());
            }
            Item::Clock(clock) => self.clock = Some(clock.seconds()),
            Item::Missed(missed) => {
                let messages = self.missed.as_ref().map_or(0, |missed| missed.messages);
                self.missed = Some(Missed {
                    messages: messages + missed.samples,
                    reason: missed.reason.label().into(),
                });
            }
            Item::End(_) => {}
        }
    }

    async fn end(&mut self, reason: &'static str, lines: &mut Vec<u8>) {
        self.ended = true;
        if self.newest.is_some() {
            self.show(lines).await;
        }
        write_line(
            lines,
            &Line::End(End {
                reason: reason.into(),
            }),
        );
    }

    /// Appends the newest message, or a keep-alive.
    async fn show(&mut self, lines: &mut Vec<u8>) {
        if let Some(missed) = self.missed.take() {
            write_line(lines, &Line::Missed(missed));
        }
        let Some(sample) = self.newest.take() else {
            write_line(lines, &Line::Beat(Beat { t: self.clock }));
            return;
        };
        self.shown = Some(Instant::now());
        let message_type = self.find(&sample, lines).await;
        let shown = Arc::clone(&sample);
        let has_previews = self.has_previews;
        let decoded = spawn_blocking(move || {
            let preview = has_previews.then(|| preview(&shown));
            let value = value(message_type.as_deref(), &shown);
            (value, preview.transpose())
        });
        let (decoded, preview) = match decoded.await {
            Ok((value, preview)) => (Ok(value), preview),
            Err(error) => (Err(error), Ok(None)),
        };
        let (preview, preview_error) = match preview {
            Ok(preview) => (preview.flatten(), None),
            Err(error) => (None, Some(error.to_string())),
        };
        let (value, error) = match decoded {
            Ok(Ok(value)) => (value, None),
            Ok(Err(error)) => (None, Some(error.to_string())),
            Err(_) => (None, Some("decoding it failed".to_owned())),
        };
        let state = self.context.latest.state();
        let mut topics = state.known().topics.iter();
        let node = topics.find_map(|topic| {
            let mut publishers = topic.publishers.iter();
            let publisher = publishers.find(|publisher| publisher.writes_as(sample.writer))?;
            publisher.node.as_ref().map(ToString::to_string)
        });
        let line = Message {
            time: sample.time.seconds(),
            source_time: sample.source_timestamp.map(|time| time.seconds()),
            writer: sample.writer.to_string(),
            node,
            sequence_number: sample.sequence_number.0,
            bytes: sample.size,
            skipped: std::mem::take(&mut self.skipped),
            value,
            error,
            preview,
            preview_error,
        };
        write_line(lines, &Line::Message(line));
    }

    /// Returns the type of a message; appends a `type` line if it differs from the previous
    /// message's.
    async fn find(&mut self, sample: &Sample, lines: &mut Vec<u8>) -> Option<Arc<MessageType>> {
        let name = &sample.topic.message_type;
        let offered = sample.topic.offered.as_ref();
        let hashes = offered.map_or((None, None), |offered| {
            (offered.type_hash, offered.equivalence_hash)
        });
        let revision = self.context.library.revision();
        if let Some(known) = &self.known
            && known.name == *name
            && known.hashes == hashes
            && (known.found.is_some() || known.revision == revision)
        {
            return known.found.clone();
        }
        let library = Arc::clone(&self.context.library);
        let (wanted, announced) = (name.clone(), offered.and_then(|it| it.definition_hash()));
        let found = spawn_blocking(move || look_up(&library, &wanted, announced.as_deref())).await;
        let (line, found) = found.unwrap_or_else(|_| {
            let reason = "looking for its definition failed".to_owned();
            (unknown(name, reason), None)
        });
        write_line(lines, &Line::Type(line));
        self.known = Some(Known {
            name: name.clone(),
            hashes,
            found: found.clone(),
            revision,
        });
        found
    }
}

fn look_up(
    library: &Library,
    name: &str,
    hash: Option<&str>,
) -> (Definition, Option<Arc<MessageType>>) {
    match library.find(name, hash) {
        Ok(found) => {
            let line = Definition {
                name: name.to_owned(),
                known: true,
                reason: None,
                definition: Some(found.schema_text().1),
                equivalence_hash: hash
                    .filter(|hash| EquivalenceHash::parse(hash).is_some())
                    .map(str::to_owned),
            };
            (line, Some(found))
        }
        Err(error) => (unknown(name, error.to_string()), None),
    }
}

fn unknown(name: &str, reason: String) -> Definition {
    Definition {
        name: name.to_owned(),
        known: false,
        reason: Some(reason),
        definition: None,
        equivalence_hash: None,
    }
}

/// Why the fields of a message cannot be shown.
#[derive(Debug, thiserror::Error)]
enum ValueError {
    #[error(transparent)]
    Decode(#[from] DecodeError),
    #[error(transparent)]
    Json(#[from] serde_json::Error),
}

/// Decodes the fields of a message; returns `None` if its type or its bytes are unknown.
fn value(
    message_type: Option<&MessageType>,
    sample: &Sample,
) -> Result<Option<JsonText>, ValueError> {
    let (Some(message_type), Some(payload)) = (message_type, &sample.payload) else {
        return Ok(None);
    };
    let limits = Limits {
        kept: MAX_ELEMENTS,
        ..Limits::default()
    };
    let decoded = decode(message_type, payload, &limits)?;
    let shown = serde_json::value::to_raw_value(&Tree::new(&decoded.message))?;
    Ok(Some(JsonText(shown)))
}

/// Returns the small picture of a message; `None` if its type has none or its bytes are unknown.
fn preview(sample: &Sample) -> Result<Option<messages::Preview>, PreviewError> {
    let Some(payload) = &sample.payload else {
        return Ok(None);
    };
    let found = preview::preview(&sample.topic.message_type, payload)?;
    Ok(found.map(|found| match found {
        Preview::Picture(picture) => messages::Preview::Picture {
            width: picture.width,
            height: picture.height,
            source: picture.source,
            rgb: BASE64_STANDARD.encode(picture.rgb),
        },
        Preview::Encoded { format, bytes } => messages::Preview::Encoded {
            format,
            data: BASE64_STANDARD.encode(bytes),
        },
        Preview::Points { points, total } => {
            let numbers = points.as_flattened().iter();
            let bytes: Vec<u8> = numbers.flat_map(|number| number.to_le_bytes()).collect();
            let xyz = BASE64_STANDARD.encode(bytes);
            messages::Preview::Points { total, xyz }
        }
        Preview::Poses(poses) => {
            let poses = poses.iter().map(|pose| [pose.x, pose.y, pose.yaw]);
            messages::Preview::Poses(poses.collect())
        }
    }))
}

#[cfg(test)]
mod tests {
    use ros2probe_wire::{EntityId, Guid, GuidPrefix, Timestamp};
    use tokio_util::sync::CancellationToken;

    use ros2probe_wire::SequenceNumber;

    use super::*;
    use crate::agent_facts::SourceKind;
    use crate::snapshot_cell::SnapshotCell;
    use crate::subscriptions::{Caps, Subscriptions};
    use ros2probe_model::facts::dispatch::{Dispatch, SampleOutcome, Topic};

    #[test]
    fn messages_beyond_the_size_of_the_queue_are_dropped_and_counted() {
        const MESSAGES: u64 = 40;
        let latest = Arc::new(SnapshotCell::new(SourceKind::Wire));
        let caps = Caps {
            subscriptions: 1,
            bytes: 64 << 20,
        };
        let all = Arc::new(Subscriptions::new(latest, caps, CancellationToken::new()));
        let asked = request(DomainId(0), &"rt/points".into());
        let mut subscription = all.open(asked).unwrap();
        let topic = Arc::new(Topic {
            domain_id: DomainId(0),
            name: "/points".into(),
            dds_name: "rt/points".into(),
            message_type: "a/msg/B".into(),
            offered: None,
        });
        for number in 1..=MESSAGES {
            let sample = Sample {
                topic: Arc::clone(&topic),
                time: Timestamp(number),
                writer: Guid::new(GuidPrefix([1; 12]), EntityId([0, 0, 1, 3])),
                sequence_number: SequenceNumber(number),
                source_timestamp: None,
                header_stamp: None,
                size: 1 << 20,
                sampled: false,
                payload: Some(vec![7; 1 << 20].into()),
            };
            let outcome = SampleOutcome::Sample(Arc::new(sample));
            let to = [1].into();
            all.deliver(vec![Dispatch { to, outcome }], None);
        }
        assert!(all.facts().queued_bytes <= QUEUE_BYTES);
        let (mut missed, mut kept) = (0, Vec::new());
        while let Some(item) = subscription.try_next() {
            match item {
                Item::Missed(missed_run) => missed += missed_run.samples,
                Item::Sample(sample) => kept.push(sample.sequence_number.0),
                Item::Clock(_) | Item::End(_) => {}
            }
        }
        assert_eq!(missed + kept.len() as u64, MESSAGES);
        assert_eq!(kept.last(), Some(&MESSAGES), "the newest is kept");
        assert!((14..=16).contains(&kept.len()), "{kept:?}");
    }
}
