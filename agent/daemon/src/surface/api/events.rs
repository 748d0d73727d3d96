//! `GET /events`: events as server-sent events (WHATWG HTML, 9.2).
//!
//! Each stream has its own position in the event log and is read at its client's speed without
//! delaying others. `lagged` reports events that were overwritten before a slow client read them.
//! The number of streams is limited, and all streams end when the agent stops.

use std::borrow::Cow;
use std::collections::VecDeque;
use std::sync::{Arc, LazyLock};
use std::time::Duration;

use axum::extract::{Extension, State};
use axum::http::HeaderMap;
use axum::http::header::CACHE_CONTROL;
use axum::response::sse::{Event, Sse};
use axum::response::{IntoResponse, Response};
use serde::Deserialize;
use tokio::sync::OwnedSemaphorePermit;
use tokio::time::sleep;
use tokio_util::sync::CancellationToken;
use utoipa::IntoParams;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::Context;
use super::body_stream::{Pieces, stream_of};
use super::endpoint::texts;
use super::parameters::Parameters;
use super::problem::{Code, Problem, ProblemBody};
use super::security::Rights;
use crate::config::{Watch, Watchlist};
use crate::events::EventLog;
use crate::events::{EVENTS, Position, Reader, Record, Value};
use crate::surface::places::Places;
use crate::tables::StreamEvents;
use ros2probe_api::attributes::{self, Attributes};
use ros2probe_api::events::{self as answers, Lagged};
use ros2probe_model::facts::bounded::Bounded;
use ros2probe_wire::DomainId;

/// Slots for the event streams of all listeners. There are fewer slots than connections, so that
/// other requests still get a connection.
static STREAM_SLOTS: LazyLock<Places> = LazyLock::new(|| Places::new(MAX_STREAMS));
const MAX_STREAMS: usize = 16;
/// Time without an event after which a stream sends a comment.
const HEARTBEAT_INTERVAL: Duration = Duration::from_secs(15);
/// Time after which a disconnected client should reconnect.
const RECONNECT_DELAY: Duration = Duration::from_secs(2);
/// Maximum number of events formatted per batch, besides the notice of overwritten events.
const MAX_BATCH: usize = StreamEvents::CAP - 1;
/// Maximum number of names or topics per filter.
const MAX_FILTERS: usize = 32;
/// Maximum number of characters in a filter by name, and in a filter by topic.
const MAX_NAMES: usize = 1_024;
const MAX_TOPICS: usize = 4_096;
/// Id of the position before the oldest event in the log.
const BEFORE_OLDEST_ID: &str = "0";

#[derive(Clone, Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields, default)]
#[into_params(parameter_in = Query)]
struct Selection {
    /// Events after this id; `0` for all events in the log. The header `Last-Event-ID` takes
    /// precedence. Without both, only future events are sent.
    #[param(pattern = r"^(0|[0-9a-f]{1,16}-[0-9]{1,19})$", example = "0")]
    after: Option<String>,
    /// Event names to include, separated by commas; a final `*` matches any ending.
    #[param(max_length = 1024, example = "ros2.message.lost,ros2.topic.*")]
    name: Option<String>,
    /// Topics whose events to include, separated by commas: ROS names or globs as in a watch.
    #[param(max_length = 4096, example = "/points")]
    topic: Option<String>,
    /// Whether to wait for future events; `false` ends the stream after the latest event.
    follow: Option<bool>,
}

/// The events that one client selects.
#[derive(Debug, Default)]
struct Filter {
    names: Vec<String>,
    topics: Option<Watchlist>,
}

/// The stream of one client.
struct Stream {
    log: Arc<EventLog>,
    stop: CancellationToken,
    filter: Filter,
    follow: bool,
    /// Number of the last event that was processed.
    place: u64,
    waiting: Bounded<StreamEvents, VecDeque<Event>>,
    _permit: OwnedSemaphorePermit,
}

pub(super) fn routes() -> OpenApiRouter<Context> {
    OpenApiRouter::new().routes(routes!(events))
}

/// Events as they occur
///
/// Each server-sent event has the event's name as `event`, its id as `id` and an `Event` as `data`.
/// A client that reconnects with the last id receives the events in between, if the log still has
/// them (the last 4096 events). Otherwise it receives an event named `lagged`. Its data contain
/// `missed`, a number or null, and `reason`. `overwritten`: the log dropped the events before they
/// were sent. `restarted`: the id belongs to an earlier run of the agent. Comments keep the
/// connection alive.
#[utoipa::path(
    get,
    path = "/events",
    tag = "events",
    params(
        Selection,
        ("Last-Event-ID" = Option<String>, Header,
            description = "Id of the last event that was received, as a browser sends it."),
    ),
    responses(
        (status = 200, description = "Events, until the client disconnects or the agent stops.",
            body = answers::Event<'static>, content_type = "text/event-stream"),
        (status = 422, description = "An event name, topic or id is invalid.",
            body = ProblemBody, content_type = "application/problem+json"),
        (status = 503, description = "Too many streams, or the agent is shutting down.",
            body = ProblemBody, content_type = "application/problem+json"),
    )
)]
async fn events(
    State(context): State<Context>,
    Extension(granted): Extension<Rights>,
    headers: HeaderMap,
    Parameters(selection): Parameters<Selection>,
) -> Result<Response, Problem> {
    let filter = Filter::parse(&selection)?;
    let last_event_id = headers.get("last-event-id").map(|id| id.to_str());
    let last_event_id = last_event_id
        .transpose()
        .map_err(|_| no_id("Last-Event-ID"))?;
    // An empty id means that the client has not received an event yet.
    let last_event_id = last_event_id.filter(|id| !id.is_empty());
    let log = Arc::clone(&context.events);
    let (place, restarted) = match last_event_id.or(selection.after.as_deref()) {
        None => (log.last(), false),
        Some(BEFORE_OLDEST_ID) => (0, false),
        Some(id) => match log.position(id).ok_or_else(|| no_id(id))? {
            Position::After(number) => (number, false),
            Position::Unknown => (0, true),
        },
    };
    let has_token = granted.has_token();
    let permit = STREAM_SLOTS.take(has_token).ok_or_else(|| {
        let detail = STREAM_SLOTS.refusal("streams", has_token);
        Problem::new(Code::TooManyStreams, detail)
    })?;
    let mut stream = Stream {
        log,
        stop: context.stop.clone(),
        filter,
        follow: selection.follow.unwrap_or(true),
        place,
        waiting: Bounded::default(),
        _permit: permit,
    };
    stream.begin(restarted);
    Ok(([(CACHE_CONTROL, "no-store")], Sse::new(stream_of(stream))).into_response())
}

fn no_id(text: &str) -> Problem {
    let text: String = text.chars().take(64).collect();
    Problem::new(
        Code::InvalidRequest,
        format!("`{text}` is not an event id; `after=0` requests all kept events"),
    )
}

impl Pieces for Stream {
    type Piece = Event;

    async fn next(&mut self) -> Option<Event> {
        loop {
            if let Some(message) = self.waiting.pop_front() {
                return Some(message);
            }
            if self.read() {
                continue;
            }
            if !self.follow {
                return None;
            }
            tokio::select! {
                biased;
                () = self.log.wait(self.place) => {}
                () = self.stop.cancelled() => return None,
                () = sleep(HEARTBEAT_INTERVAL) => {
                    // The id covers events that the filter left out, so that a reconnecting client
                    // skips them.
                    let beat = Event::default().comment("").id(self.log.id(self.place));
                    return Some(beat);
                }
            }
        }
    }
}

impl Stream {
    /// Queues a first message with the position, so that a client that disconnects before the first
    /// event can resume there.
    fn begin(&mut self, restarted: bool) {
        let greeting = Event::default().comment("ros2probe").retry(RECONNECT_DELAY);
        self.waiting.push_back(greeting.id(self.log.id(self.place)));
        if restarted {
            self.lag(None, "restarted");
        }
    }
    /// Moves the next selected events into `waiting`. Returns whether the log had new events.
    fn read(&mut self) -> bool {
        let batch = self.log.read(self.place, MAX_BATCH);
        if batch.lagged > 0 {
            self.log.count_overwritten(Reader::Stream, batch.lagged);
            self.place += batch.lagged;
            self.lag(Some(batch.lagged), "overwritten");
        }
        for record in batch
            .records
            .iter()
            .filter(|record| self.filter.is_selected(record))
        {
            let message = Event::default()
                .event(record.definition.name)
                .id(self.log.id(record.number));
            self.waiting.push_back(message.data(self.text(record)));
        }
        let is_new = batch.last > self.place || batch.lagged > 0;
        self.place = batch.last;
        is_new
    }

    fn lag(&mut self, missed: Option<u64>, reason: &'static str) {
        let message = Event::default().event("lagged").id(self.log.id(self.place));
        let reason = Cow::Borrowed(reason);
        let lagged = Lagged { missed, reason };
        let text = serde_json::to_string(&lagged).unwrap_or_default();
        self.waiting.push_back(message.data(text));
    }

    fn text(&self, record: &Record) -> String {
        let view = event(&self.log, record);
        // Serializing into memory cannot fail.
        serde_json::to_string(&view).unwrap_or_default()
    }
}

/// Returns the API representation of an event.
pub(super) fn event<'a>(log: &EventLog, record: &'a Record) -> answers::Event<'a> {
    let attributes = record.attributes.iter();
    let attributes = attributes.map(|(name, value)| {
        let value = match value {
            Value::Text(text) => attributes::Value::Text(Cow::Borrowed(text)),
            Value::Number(number) => attributes::Value::Number(*number),
            Value::Real(real) => attributes::Value::Real(*real),
            Value::List(list) => attributes::Value::List(texts(list)),
        };
        (Cow::Borrowed(*name), value)
    });
    answers::Event {
        id: log.id(record.number),
        time: record.time(),
        name: record.definition.name.into(),
        severity: record.severity.text().into(),
        attributes: Attributes(attributes.collect()),
    }
}

impl Filter {
    fn parse(selection: &Selection) -> Result<Self, Problem> {
        let invalid = |detail: String| Problem::new(Code::InvalidRequest, detail);
        let names = split(selection.name.as_deref(), MAX_NAMES)?;
        let unknown = |name: &&String| !EVENTS.iter().any(|event| covers(name, event.name));
        if let Some(name) = names.iter().find(unknown) {
            return Err(invalid(format!("no event has the name `{name}`")));
        }
        let topics = split(selection.topic.as_deref(), MAX_TOPICS)?;
        if topics.is_empty() {
            let topics = None;
            return Ok(Self { names, topics });
        }
        let watch = |topic: &String| {
            Watch::named(topic).map_err(|error| invalid(format!("the topic `{topic}` {error}")))
        };
        let watches = topics.iter().map(watch).collect::<Result<Vec<_>, _>>()?;
        let topics = Watchlist::new(watches).map_err(|error| invalid(error.to_string()))?;
        Ok(Self {
            names,
            topics: Some(topics),
        })
    }

    fn is_selected(&self, record: &Record) -> bool {
        let name = record.definition.name;
        let named = self.names.is_empty() || self.names.iter().any(|each| covers(each, name));
        named
            && self.topics.as_ref().is_none_or(|topics| {
                matches!(record.attribute("topic"),
                    Some(Value::Text(topic)) if !topics.matching(DomainId(0), topic).is_empty())
            })
    }
}

fn split(list: Option<&str>, most: usize) -> Result<Vec<String>, Problem> {
    if list.is_some_and(|list| list.chars().count() > most) {
        let detail = format!("a filter has at most {most} characters");
        return Err(Problem::new(Code::InvalidRequest, detail));
    }
    let parts = list.into_iter().flat_map(|list| list.split(','));
    let parts: Vec<_> = parts.map(|part| part.trim().to_owned()).collect();
    if parts.len() > MAX_FILTERS {
        let detail = format!("a filter has at most {MAX_FILTERS} parts");
        return Err(Problem::new(Code::InvalidRequest, detail));
    }
    Ok(parts)
}

fn covers(pattern: &str, name: &str) -> bool {
    match pattern.strip_suffix('*') {
        Some(beginning) => name.starts_with(beginning),
        None => pattern == name,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::events::AgentEvent;

    fn selection(name: &str, topic: &str) -> Selection {
        let given = |text: &str| (!text.is_empty()).then(|| text.to_owned());
        Selection {
            name: given(name),
            topic: given(topic),
            ..Selection::default()
        }
    }

    #[test]
    fn a_filter_that_can_never_match_is_refused() {
        for (name, topic) in [
            ("ros2.message.lost", ""),
            ("ros2.message.lost, ros2probe.*", "/points,/camera/**"),
            ("*", ""),
        ] {
            assert!(
                Filter::parse(&selection(name, topic)).is_ok(),
                "{name} {topic}"
            );
        }
        let many = vec!["/a"; MAX_FILTERS + 1].join(",");
        for (name, topic) in [
            ("ros2.message", ""),
            ("ros3.*", ""),
            (",", ""),
            ("", "points"),
            ("", "/a,,/b"),
            ("", many.as_str()),
        ] {
            let refused = Filter::parse(&selection(name, topic));
            assert_eq!(refused.unwrap_err().code(), Code::InvalidRequest);
        }
    }

    fn stream(log: &Arc<EventLog>, stop: &CancellationToken) -> Stream {
        Stream {
            log: Arc::clone(log),
            stop: stop.clone(),
            filter: Filter::default(),
            follow: true,
            place: 0,
            waiting: Bounded::default(),
            _permit: STREAM_SLOTS.take(true).unwrap(),
        }
    }

    #[tokio::test]
    async fn a_slow_client_receives_the_number_of_events_that_it_missed() {
        let (log, stop) = (Arc::new(EventLog::new()), CancellationToken::new());
        let mut stream = stream(&log, &stop);
        log.record(AgentEvent::Reloaded { watches: 0 });
        assert!(format!("{:?}", stream.next().await).contains("watches"));
        log.overwrite(7);
        assert!(format!("{:?}", stream.next().await).contains("lagged"));
        assert!(log.dropped().contains(&("stream_lagged", 7)));
        log.record(AgentEvent::Reloaded { watches: 0 });
        assert!(format!("{:?}", stream.next().await).contains("watches"));
        assert_eq!(stream.place, 9);
    }

    #[tokio::test]
    async fn a_stream_reads_a_long_log_in_batches() {
        let (log, stop) = (Arc::new(EventLog::new()), CancellationToken::new());
        log.overwrite(7);
        for watches in 0..150 {
            log.record(AgentEvent::Reloaded { watches });
        }
        let mut stream = stream(&log, &stop);
        stream.follow = false;
        let mut count = 0;
        while stream.next().await.is_some() {
            count += 1;
        }
        assert_eq!(count, 151, "the events, and `lagged`");
        crate::tables::tests::assert_driven::<StreamEvents>();
    }

    #[tokio::test]
    async fn a_stream_sends_pending_events_before_it_ends_with_the_agent() {
        let (log, stop) = (Arc::new(EventLog::new()), CancellationToken::new());
        log.record(AgentEvent::Reloaded { watches: 1 });
        stop.cancel();
        let mut stream = stream(&log, &stop);
        stream.begin(true);
        let mut count = 0;
        while stream.next().await.is_some() {
            count += 1;
        }
        // The messages are the greeting, `lagged` and the event.
        assert_eq!(count, 3);
    }
}
