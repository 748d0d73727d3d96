//! One viewer: its channels, its subscriptions and its messages.
//!
//! One task reads and writes. It does not read from a viewer that does not read, so no data
//! accumulates for that viewer. The messages of a viewer wait in the queue of one [`Subscription`].
//! A full queue drops the oldest message of the topic with the most bytes. A message is sent in
//! fragments, so each viewer needs memory for two fragments.

mod sending;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use futures_util::{SinkExt as _, StreamExt as _};
use ros2probe_api::topics::UNSUBSCRIBED;
use ros2probe_model::facts::dispatch::{Missed, MissedReason, Sample};
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::sync::watch;
use tokio::time::{Instant, Interval, MissedTickBehavior, interval, timeout};
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::protocol::frame::coding::{CloseCode, Data};
use tokio_tungstenite::tungstenite::protocol::{Role, WebSocketConfig};
use tokio_tungstenite::tungstenite::{Error, Message as Incoming};

use super::Shared;
use super::channels::{Channel, Channels, Content, Table};
use super::figures::Viewer;
use super::graph::Graph;
use super::protocol::{self, Level, Message, Metadata, Request, Subscribe, parse};
use super::statistics::{self, Previous};
use crate::config::Access;
use crate::subscriptions::{Depth, Item, Overflow, Selection, Subscription, TopicKey};
use crate::tables::{ViewerLosses, ViewerSubscriptions};
use ros2probe_model::facts::bounded::Bounded;

/// Maximum size of a message from a client, in bytes.
const MAX_MESSAGE: usize = 256 << 10;
/// Capacity of a client's queue in bytes; `limits.payload_bytes` bounds all queues together.
const QUEUE_BYTES: usize = 16 << 20;
/// Size of a fragment of a message to a client, and of an `advertise` message, in bytes.
const FRAGMENT_BYTES: usize = 64 << 10;
/// Maximum number of messages sent before the agent reads from the client again.
const MAX_BATCH: usize = 64;
/// Interval of statuses, and number of intervals between two pings.
const STATUS_INTERVAL: Duration = Duration::from_secs(1);
const PING_TICKS: u32 = 20;
/// Number of unanswered pings after which a client counts as gone.
const MAX_UNANSWERED: u32 = 3;
/// Seconds without a loss after which the status of losses is removed.
const LOSS_END_TICKS: u32 = 10;
/// Maximum number of topics that a status names.
const MAX_NAMED_TOPICS: usize = 3;

/// Silence of a topic after which a status reports the missing subscriber.
const SILENCE_TIMEOUT: Duration = Duration::from_secs(5);
/// Id of the status that names topics without a subscriber.
const NO_SUBSCRIBER: &str = "no_subscriber";

/// Maximum time for a client to read why its connection is closed.
const CLOSE_TIMEOUT: Duration = Duration::from_secs(1);

/// Losses that a status reports to the client.
const REPORTED_LOSSES: [(MissedReason, &str, &str); 2] = [
    (
        MissedReason::QueueFull,
        "queue_full",
        "dropped because this client reads too slowly",
    ),
    (
        MissedReason::NotCaptured,
        "not_captured",
        "not captured because the agent reads too slowly",
    ),
];

/// One viewer on a connection.
pub(super) struct Client<S> {
    socket: WebSocketStream<S>,
    shared: Arc<Shared>,
    access: Access,
    viewer: Viewer,
    tables: watch::Receiver<Option<Arc<Table>>>,
    channels: Arc<Channels>,
    subscribed: Bounded<ViewerSubscriptions, BTreeMap<u32, Subscribed>>,
    /// Ids of the subscriptions by content.
    ids: Bounded<ViewerSubscriptions, BTreeMap<Content, u32>>,
    /// Messages of all subscribed topics.
    messages: Option<Subscription>,
    graph: Option<Arc<Graph>>,
    losses: [Losses; REPORTED_LOSSES.len()],
    /// The last status about topics without a subscriber; empty without such topics.
    unsubscribed: String,
    unanswered: u32,
}

/// A subscription of the client.
struct Subscribed {
    channel: Arc<Channel>,
    previous: Previous,
    since: Instant,
    /// Whether a message of the subscription was sent.
    has_sent: bool,
}

/// Messages lost for one reason, since the status of that reason was last removed.
#[derive(Default)]
struct Losses {
    /// Number of lost messages of each topic, by the name that the client knows.
    topics: Bounded<ViewerLosses, BTreeMap<String, u64>>,
    messages: u64,
    is_changed: bool,
    quiet: u32,
}

/// Why a connection ends.
enum End {
    /// The client is gone.
    Gone,
    /// The server closes the connection.
    Closed(CloseCode, &'static str),
}

impl From<Error> for End {
    fn from(error: Error) -> Self {
        match error {
            Error::Capacity(_) => Self::Closed(CloseCode::Size, "the message is too large"),
            Error::Utf8(_) => Self::Closed(CloseCode::Invalid, "the text is not UTF-8"),
            Error::Protocol(_) => Self::Closed(CloseCode::Protocol, "the frame breaks RFC 6455"),
            _ => Self::Gone,
        }
    }
}

impl<S: AsyncRead + AsyncWrite + Unpin> Client<S> {
    /// Creates a client on a stream after the handshake.
    pub(super) async fn new(
        stream: S,
        shared: Arc<Shared>,
        access: Access,
        viewer: Viewer,
    ) -> Self {
        let config = WebSocketConfig::default()
            .read_buffer_size(4 << 10)
            .write_buffer_size(FRAGMENT_BYTES)
            .max_message_size(Some(MAX_MESSAGE))
            .max_frame_size(Some(MAX_MESSAGE));
        let socket = WebSocketStream::from_raw_socket(stream, Role::Server, Some(config)).await;
        let mut tables = shared.tables.subscribe();
        tables.mark_unchanged();
        shared.changed.notify_one();
        Self {
            socket,
            shared,
            access,
            viewer,
            tables,
            channels: Arc::default(),
            subscribed: Bounded::default(),
            ids: Bounded::default(),
            messages: None,
            graph: None,
            losses: Default::default(),
            unsubscribed: String::new(),
            unanswered: 0,
        }
    }

    /// Serves the client until one side ends the connection.
    pub(super) async fn run(mut self) {
        let stop = self.shared.stop.clone();
        let end = tokio::select! {
            end = self.serve() => end,
            () = stop.cancelled() => Err(End::Closed(CloseCode::Away, "the agent ends")),
        };
        if let Err(End::Closed(code, reason)) = end {
            tracing::debug!(%code, reason, "closed a viewer");
            // Dropping the subscription ends the interest in its topics first.
            self.messages = None;
            let _ = timeout(CLOSE_TIMEOUT, self.close_with_reason(code, reason)).await;
        }
    }

    async fn serve(&mut self) -> Result<(), End> {
        self.send_server_info().await?;
        let mut ticks = ticks();
        let mut count = 0_u32;
        loop {
            tokio::select! {
                biased;
                incoming = self.socket.next() => match incoming {
                    Some(incoming) => self.take(incoming?).await?,
                    None => return Err(End::Gone),
                },
                changed = self.tables.changed() => {
                    changed.map_err(|_| End::Gone)?;
                    self.send_changes().await?;
                }
                _ = ticks.tick() => {
                    count = count.wrapping_add(1);
                    self.report_losses().await?;
                    self.report_unsubscribed().await?;
                    if count.is_multiple_of(PING_TICKS) {
                        self.ping().await?;
                    }
                }
                item = next(&mut self.messages) => {
                    self.send_item(item).await?;
                    for _ in 1..MAX_BATCH {
                        let next = self.messages.as_mut().and_then(Subscription::try_next);
                        if next.is_none() {
                            break;
                        }
                        self.send_item(next).await?;
                    }
                }
            }
            self.socket.flush().await?;
        }
    }

    /// Sends the description of the server.
    async fn send_server_info(&mut self) -> Result<(), End> {
        let shared = Arc::clone(&self.shared);
        let capabilities: &[_] = match shared.is_replay {
            true => &["connectionGraph", "time"],
            false => &["connectionGraph"],
        };
        self.send(&Message::ServerInfo {
            name: &shared.name,
            capabilities,
            supported_encodings: [],
            metadata: Metadata {
                ros2probe: env!("CARGO_PKG_VERSION"),
                mode: "read-only: no publishing, services or parameters",
            },
            session_id: &shared.session,
        })
        .await?;
        self.socket.flush().await?;
        Ok(())
    }

    /// Processes a message of the client.
    async fn take(&mut self, incoming: Incoming) -> Result<(), End> {
        self.unanswered = 0;
        let text = match incoming {
            Incoming::Text(text) => text,
            Incoming::Binary(_) => return self.unsupported("binary messages").await,
            // The next read answers a close frame, and then ends.
            Incoming::Ping(_) | Incoming::Pong(_) | Incoming::Close(_) | Incoming::Frame(_) => {
                return Ok(());
            }
        };
        match parse(&text) {
            Ok(Request::Subscribe(wanted)) => self.subscribe(&wanted).await,
            Ok(Request::Unsubscribe(ids)) => self.unsubscribe(&ids).await,
            Ok(Request::SubscribeGraph) => {
                if self.graph.is_none() {
                    self.graph = Some(Arc::default());
                    self.shared.change_graphs(1);
                }
                Ok(())
            }
            Ok(Request::UnsubscribeGraph) => {
                self.unsubscribe_graph();
                Ok(())
            }
            Ok(Request::Unsupported(op)) => self.unsupported(&format!("`{op}`")).await,
            Err(protocol::Malformed) => Err(End::Closed(
                CloseCode::Invalid,
                "the text is not an operation of the protocol",
            )),
        }
    }

    async fn unsupported(&mut self, what: &str) -> Result<(), End> {
        let message = format!("{what} have no effect: this server is read-only");
        self.status(Level::Warning, "unsupported", &message).await
    }

    async fn subscribe(&mut self, wanted: &[Subscribe]) -> Result<(), End> {
        if self.subscribed.len() + wanted.len() > ViewerSubscriptions::CAP {
            self.subscribed.refuse();
            let reason = "more than 4096 subscriptions";
            return Err(End::Closed(CloseCode::Policy, reason));
        }
        let (mut refused, mut ignored) = (0_usize, 0_usize);
        let mut fresh = BTreeSet::new();
        for Subscribe { id, channel } in wanted {
            let Some(channel) = self.channels.get(channel) else {
                ignored += 1;
                continue;
            };
            let content = &channel.content;
            if matches!(content, Content::Messages { .. }) && self.access < Access::All {
                refused += 1;
                continue;
            }
            if self.subscribed.contains_key(id) || self.ids.contains_key(content) {
                ignored += 1;
                continue;
            }
            self.ids.insert(content.clone(), *id);
            let subscribed = Subscribed {
                channel: Arc::clone(channel),
                previous: Previous::default(),
                since: Instant::now(),
                has_sent: false,
            };
            self.subscribed.insert(*id, subscribed);
            fresh.extend(content.messages_of());
        }
        if !fresh.is_empty() {
            self.select(fresh).await?;
        }
        self.viewer.set_subscriptions(self.subscribed.len());
        if refused > 0 {
            let message = format!(
                "{refused} topics are not sent: messages need a token. `rp foxglove` prints the \
                 address with a token; `api.loopback: all` grants messages to every local user"
            );
            self.status(Level::Error, "token", &message).await?;
        }
        if ignored > 0 {
            let message = format!(
                "{ignored} subscriptions were ignored: their channel is gone, or channel or id are \
                 in use"
            );
            self.status(Level::Warning, "ignored", &message).await?;
        }
        Ok(())
    }

    async fn unsubscribe(&mut self, ids: &[u32]) -> Result<(), End> {
        let mut unknown = 0_usize;
        for id in ids {
            match self.subscribed.remove(id) {
                Some(gone) => {
                    self.ids.remove(&gone.channel.content);
                }
                None => unknown += 1,
            }
        }
        self.select(BTreeSet::new()).await?;
        self.viewer.set_subscriptions(self.subscribed.len());
        if unknown > 0 {
            let message = format!("{unknown} subscriptions to end were unknown");
            self.status(Level::Warning, "unknown", &message).await?;
        }
        Ok(())
    }

    /// Requests the messages of all subscribed topics, and the retained messages of the topics in
    /// `fresh`.
    async fn select(&mut self, fresh: BTreeSet<TopicKey>) -> Result<(), End> {
        let topics: BTreeSet<_> = self.ids.keys().filter_map(Content::messages_of).collect();
        if topics.is_empty() {
            self.messages = None;
            return Ok(());
        }
        if let Some(messages) = &self.messages {
            messages.select(topics, fresh);
            return Ok(());
        }
        let opened = self
            .shared
            .subscriptions
            .open(crate::subscriptions::Request {
                topics: Selection::of_topics(topics),
                // Each topic has its own domain.
                domain_id: None,
                depth: Depth::Payloads,
                queue_bytes: QUEUE_BYTES,
                // A viewer must not delay a replay.
                overflow: Overflow::DropOldest,
                is_clock_complete: false,
                latched: true,
                label: "foxglove".to_owned(),
            });
        match opened {
            Ok(opened) => self.messages = Some(opened),
            Err(refused) => {
                let is_message = |content: &Content| matches!(content, Content::Messages { .. });
                self.ids.retain(|content, _| !is_message(content));
                let subscribed = &mut self.subscribed;
                subscribed.retain(|_, subscribed| !is_message(&subscribed.channel.content));
                let message = format!("no messages are sent: {refused}");
                self.status(Level::Error, "subscriptions", &message).await?;
            }
        }
        Ok(())
    }

    /// Sends the changes of the channels and the graph, and the statistics.
    async fn send_changes(&mut self) -> Result<(), End> {
        let table = self.tables.borrow_and_update().clone();
        let Some(table) = table else {
            return Ok(());
        };
        if !Arc::ptr_eq(&self.channels, &table.channels) {
            self.change_channels(Arc::clone(&table.channels)).await?;
        }
        if let (Some(shown), Some(graph)) = (&self.graph, &table.graph) {
            let shown = Arc::clone(shown);
            if let Some(update) = graph.update(&shown) {
                self.send(&update).await?;
            }
            self.graph = Some(Arc::clone(graph));
        }
        self.show_statistics().await
    }

    async fn change_channels(&mut self, channels: Arc<Channels>) -> Result<(), End> {
        let before = std::mem::replace(&mut self.channels, Arc::clone(&channels));
        let gone = before.keys().filter(|id| !channels.contains_key(id));
        let gone: Vec<_> = gone.copied().collect();
        if !gone.is_empty() {
            self.subscribed
                .retain(|_, subscribed| channels.contains_key(&subscribed.channel.id()));
            self.ids.retain(|_, id| self.subscribed.contains_key(id));
            self.select(BTreeSet::new()).await?;
            self.viewer.set_subscriptions(self.subscribed.len());
            for channel_ids in gone.chunks(FRAGMENT_BYTES / 16) {
                self.send(&Message::Unadvertise { channel_ids }).await?;
            }
        }
        let new = channels.iter().filter(|(id, _)| !before.contains_key(id));
        let (mut some, mut size) = (Vec::new(), 0);
        for (_, channel) in new {
            some.push(channel.advertised());
            size += channel.size();
            if size >= FRAGMENT_BYTES {
                let channels = std::mem::take(&mut some);
                self.send(&Message::Advertise {
                    channels: &channels,
                })
                .await?;
                size = 0;
            }
        }
        // Even without channels, a client waits for this message.
        if !some.is_empty() || channels.is_empty() {
            self.send(&Message::Advertise { channels: &some }).await?;
        }
        Ok(())
    }

    /// Sends the statistics of the subscribed topics.
    async fn show_statistics(&mut self) -> Result<(), End> {
        let is_statistics = |content: &Content| matches!(content, Content::Statistics { .. });
        if !self.ids.keys().any(is_statistics) {
            return Ok(());
        }
        let state = self.shared.latest.state();
        let snapshot = state.known();
        for topic in &snapshot.topics {
            let content = Content::Statistics {
                domain_id: topic.domain_id,
                dds_name: topic.dds_name.clone(),
            };
            let (Some(measured), Some(id)) = (&topic.measurement, self.ids.get(&content)) else {
                continue;
            };
            let id = *id;
            let Some(subscribed) = self.subscribed.get_mut(&id) else {
                continue;
            };
            let message = statistics::message(topic, measured, &mut subscribed.previous);
            self.send_data(id, snapshot.time(), &message.into()).await?;
        }
        Ok(())
    }

    /// Sends an item of the subscription to the client, or counts its losses.
    async fn send_item(&mut self, item: Option<Item>) -> Result<(), End> {
        match item {
            Some(Item::Sample(sample)) => self.send_sample(&sample).await,
            Some(Item::Missed(missed)) => {
                self.count(&missed);
                Ok(())
            }
            Some(Item::Clock(now)) if self.shared.is_replay => {
                self.frame(protocol::time(now).into(), Data::Binary, true)
                    .await
            }
            Some(Item::Clock(_)) => Ok(()),
            Some(Item::End(reason)) => {
                self.messages = None;
                let message = format!("no further messages: {reason}");
                self.status(Level::Info, "end", &message).await
            }
            None => {
                self.messages = None;
                Ok(())
            }
        }
    }

    async fn send_sample(&mut self, sample: &Sample) -> Result<(), End> {
        let id = self.ids.get(&Content::of(&sample.topic));
        match (id, &sample.payload) {
            (Some(id), Some(payload)) => {
                let id = *id;
                if let Some(subscribed) = self.subscribed.get_mut(&id) {
                    subscribed.has_sent = true;
                }
                self.send_data(id, sample.time, payload).await
            }
            _ => Ok(()),
        }
    }

    /// Counts a loss if a channel of the client has lost the messages. Another type of the topic
    /// has a channel of its own.
    fn count(&mut self, missed: &Missed) {
        let id = self.ids.get(&Content::of(&missed.topic));
        let Some(subscribed) = id.and_then(|id| self.subscribed.get(id)) else {
            return;
        };
        if missed.reason == MissedReason::QueueFull {
            self.viewer.dropped(missed.samples);
        }
        let mut losses = REPORTED_LOSSES.iter().zip(&mut self.losses);
        let losses = losses.find(|((reason, ..), _)| *reason == missed.reason);
        if let Some((_, losses)) = losses {
            losses.add(subscribed.channel.topic(), missed.samples);
        }
    }

    /// Reports new losses, and removes the status of old losses.
    async fn report_losses(&mut self) -> Result<(), End> {
        for (place, (_, id, what)) in REPORTED_LOSSES.iter().enumerate() {
            let Some(losses) = self.losses.get_mut(place) else {
                continue;
            };
            if losses.messages == 0 {
                continue;
            }
            if std::mem::take(&mut losses.is_changed) {
                losses.quiet = 0;
                let message = losses.text(what);
                self.status(Level::Warning, id, &message).await?;
            } else if losses.quiet < LOSS_END_TICKS {
                losses.quiet += 1;
            } else {
                *losses = Losses::default();
                self.send(&Message::RemoveStatus { status_ids: [id] })
                    .await?;
            }
        }
        Ok(())
    }

    /// Reports topics that stay silent because they have no subscriber. The agent does not
    /// subscribe.
    async fn report_unsubscribed(&mut self) -> Result<(), End> {
        let message = self.unsubscribed_now();
        if message == self.unsubscribed {
            return Ok(());
        }
        self.unsubscribed.clone_from(&message);
        if message.is_empty() {
            let status_ids = [NO_SUBSCRIBER];
            return self.send(&Message::RemoveStatus { status_ids }).await;
        }
        self.status(Level::Info, NO_SUBSCRIBER, &message).await
    }

    /// Returns a sentence about the silent topics that have no subscriber; empty without such
    /// topics.
    fn unsubscribed_now(&self) -> String {
        let silent = self.subscribed.values().filter_map(|subscribed| {
            let is_silent = !subscribed.has_sent && subscribed.since.elapsed() >= SILENCE_TIMEOUT;
            let key = subscribed.channel.content.messages_of()?;
            is_silent.then(|| (key, subscribed.channel.topic()))
        });
        let silent: BTreeMap<TopicKey, &str> = silent.collect();
        if silent.is_empty() {
            return String::new();
        }
        let state = self.shared.latest.state();
        let topics = state.known().topics.iter();
        let names = topics.filter_map(|topic| {
            let name = silent.get(&(topic.domain_id, topic.dds_name.clone()))?;
            topic.is_unsubscribed().then_some(*name)
        });
        let names: Vec<&str> = names.collect();
        let named = names.get(..MAX_NAMED_TOPICS).unwrap_or(&names).join(", ");
        match (names.len(), names.len().saturating_sub(MAX_NAMED_TOPICS)) {
            (0, _) => String::new(),
            (_, 0) => format!("{named}: {UNSUBSCRIBED}"),
            (_, more) => format!("{named} and {more} more: {UNSUBSCRIBED}"),
        }
    }

    async fn ping(&mut self) -> Result<(), End> {
        if self.unanswered >= MAX_UNANSWERED {
            return Err(End::Closed(CloseCode::Away, "no answer to pings"));
        }
        self.unanswered += 1;
        self.socket.feed(Incoming::Ping(Bytes::new())).await?;
        Ok(())
    }

    fn unsubscribe_graph(&mut self) {
        if self.graph.take().is_some() {
            self.shared.change_graphs(-1);
        }
    }
}

impl<S> Drop for Client<S> {
    fn drop(&mut self) {
        if self.graph.is_some() {
            self.shared.change_graphs(-1);
        }
    }
}

impl Losses {
    fn add(&mut self, name: &str, messages: u64) {
        self.messages += messages;
        self.is_changed = true;
        if let Some(count) = self.topics.get_mut(name) {
            *count += messages;
        } else {
            self.topics.insert(name.to_owned(), messages);
        }
    }

    /// Returns a sentence with the topics that lost the most messages.
    fn text(&self, what: &str) -> String {
        let mut topics: Vec<_> = self.topics.iter().collect();
        topics.sort_by_key(|(_, messages)| std::cmp::Reverse(**messages));
        let named = topics.iter().take(MAX_NAMED_TOPICS);
        let named: Vec<_> = named
            .map(|(name, messages)| format!("{messages} of {name}"))
            .collect();
        let named = named.join(", ");
        format!("{} messages were {what}: {named}", self.messages)
    }
}

/// Waits for the next item. Without a subscription, it never returns.
async fn next(messages: &mut Option<Subscription>) -> Option<Item> {
    match messages {
        Some(messages) => messages.next().await,
        None => std::future::pending().await,
    }
}

fn ticks() -> Interval {
    let mut ticks = interval(STATUS_INTERVAL);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    ticks
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tables::tests::assert_driven;

    #[test]
    fn losses_of_topics_beyond_the_cap_are_included_in_the_sum() {
        let mut losses = Losses::default();
        for topic in 0..2 * ViewerLosses::CAP as u64 {
            losses.add(&format!("/t{topic}"), topic);
        }
        losses.add("/t63", 1_000);
        assert_driven::<ViewerLosses>();
        let text = losses.text("dropped");
        let sum = (0..128).sum::<u64>() + 1_000;
        let expected = format!("{sum} messages were dropped: 1063 of /t63, 62 of /t62, 61 of /t61");
        assert_eq!(text, expected);
    }
}
