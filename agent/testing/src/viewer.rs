//! A strict client of the Foxglove WebSocket protocol, written from its specification. It fails on
//! anything that the specification does not allow a server to send.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{self, ErrorKind};
use std::net::{SocketAddr, TcpStream};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, bail, ensure};
use serde::Deserialize;
use serde_json::{Value, json};
use tokio_tungstenite::tungstenite::client::{ClientRequestBuilder, IntoClientRequest as _};
use tokio_tungstenite::tungstenite::{self, HandshakeError, Message, WebSocket};

/// Names of the subprotocol.
pub const SUBPROTOCOLS: [&str; 2] = ["foxglove.websocket.v1", "foxglove.sdk.v1"];
/// Maximum wait for an expected message.
pub const PATIENCE: Duration = Duration::from_secs(60);

/// `serverInfo`.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "camelCase")]
pub struct ServerInfo {
    op: String,
    pub name: String,
    pub capabilities: Vec<String>,
    pub supported_encodings: Vec<String>,
    pub metadata: BTreeMap<String, String>,
    pub session_id: String,
}

/// A channel of `advertise`.
#[derive(Clone, Debug, Deserialize, PartialEq, Eq)]
#[serde(deny_unknown_fields, rename_all = "camelCase")]
pub struct Channel {
    pub id: u32,
    pub topic: String,
    pub encoding: String,
    pub schema_name: String,
    pub schema: String,
    pub schema_encoding: Option<String>,
}

/// `status`.
#[derive(Clone, Debug, Deserialize, PartialEq, Eq)]
#[serde(deny_unknown_fields, rename_all = "camelCase")]
pub struct Status {
    op: String,
    pub level: u8,
    pub message: String,
    pub id: String,
}

/// `connectionGraphUpdate`.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "camelCase")]
struct GraphUpdate {
    #[serde(rename = "op")]
    _op: String,
    published_topics: Vec<Published>,
    subscribed_topics: Vec<Subscribed>,
    advertised_services: Vec<Provided>,
    removed_topics: Vec<String>,
    removed_services: Vec<String>,
}

#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "camelCase")]
struct Published {
    name: String,
    publisher_ids: Vec<String>,
}

#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "camelCase")]
struct Subscribed {
    name: String,
    subscriber_ids: Vec<String>,
}

#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "camelCase")]
struct Provided {
    name: String,
    provider_ids: Vec<String>,
}

/// Ids of the nodes at each topic or service.
pub type Parties = BTreeMap<String, BTreeSet<String>>;

/// The connection graph after all updates.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Graph {
    pub published: Parties,
    pub subscribed: Parties,
    pub services: Parties,
}

/// A message of a channel.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Data {
    pub subscription: u32,
    pub time: u64,
    pub payload: Vec<u8>,
}

/// A message or change from the server.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ServerMessage {
    /// Channels were advertised or unadvertised; see [`Viewer::channels`].
    Channels,
    Data(Data),
    Time(u64),
    Status(Status),
    Removed(Vec<String>),
    /// The graph changed; see [`Viewer::graph`].
    Graph,
    /// The server closed the connection, with this code and reason.
    Closed(u16, String),
}

/// A refused handshake.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Refused {
    pub status: u16,
    pub body: String,
}

/// A connected client.
pub struct Viewer {
    socket: WebSocket<TcpStream>,
    pub info: ServerInfo,
    pub channels: BTreeMap<u32, Channel>,
    pub graph: Graph,
    /// Channels of the subscriptions.
    pub subscriptions: BTreeMap<u32, u32>,
    /// Subscriptions that ended: their messages may be in transit.
    ended: BTreeSet<u32>,
    next: u32,
}

impl Viewer {
    /// Connects to an agent on this host.
    pub fn connect(address: SocketAddr) -> Result<Self> {
        let opened = open(TcpStream::connect(address)?, "/", &SUBPROTOCOLS, &[])?;
        opened.map_err(|refused| anyhow::anyhow!("{refused:?}"))
    }

    /// Returns the next message, or `None` if no message arrives in time.
    pub fn next_within(&mut self, patience: Duration) -> Result<Option<ServerMessage>> {
        let deadline = Instant::now() + patience;
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Ok(None);
            }
            self.socket.get_ref().set_read_timeout(Some(left))?;
            let message = match self.socket.read() {
                Ok(message) => message,
                Err(tungstenite::Error::Io(error)) if is_timeout(&error) => return Ok(None),
                Err(error) => return Err(error.into()),
            };
            match message {
                Message::Text(text) => return self.text(&text).map(Some),
                Message::Binary(bytes) => return self.binary(&bytes).map(Some),
                Message::Close(Some(frame)) => {
                    let reason = frame.reason.as_str().to_owned();
                    return Ok(Some(ServerMessage::Closed(frame.code.into(), reason)));
                }
                Message::Close(None) => bail!("closed without a code"),
                Message::Ping(_) | Message::Pong(_) => {}
                Message::Frame(_) => bail!("a raw frame"),
            }
        }
    }

    /// Returns the first result of `wanted`. Fails if the server closes the connection before.
    pub fn wait_for<T>(
        &mut self,
        what: &str,
        mut wanted: impl FnMut(&Self, &ServerMessage) -> Option<T>,
    ) -> Result<T> {
        let deadline = Instant::now() + PATIENCE;
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            let server_message = self.next_within(left)?;
            let server_message = server_message.with_context(|| format!("no {what}"))?;
            if let Some(found) = wanted(self, &server_message) {
                return Ok(found);
            }
            if let ServerMessage::Closed(code, reason) = server_message {
                bail!("closed with {code} ({reason}) before {what}");
            }
        }
    }

    /// Waits until channels with all of these topics are advertised.
    pub fn wait_for_topics(&mut self, topics: &[&str]) -> Result<()> {
        let has_all = |viewer: &Self| {
            let mut topics = topics.iter();
            topics.all(|topic| viewer.channel(topic).is_some())
        };
        if has_all(self) {
            return Ok(());
        }
        self.wait_for("topics", |viewer, _| has_all(viewer).then_some(()))
            .with_context(|| format!("{topics:?} in {:?}", self.topics()))
    }

    /// Returns the channel of a topic.
    pub fn channel(&self, topic: &str) -> Option<&Channel> {
        self.channels
            .values()
            .find(|channel| channel.topic == topic)
    }

    /// Returns the advertised topics.
    pub fn topics(&self) -> BTreeSet<&str> {
        let channels = self.channels.values();
        channels.map(|channel| channel.topic.as_str()).collect()
    }

    /// Subscribes to a topic; returns the id.
    pub fn subscribe(&mut self, topic: &str) -> Result<u32> {
        let channel = self.channel(topic).with_context(|| topic.to_owned())?.id;
        let ids = self.subscribe_to(&[channel])?;
        Ok(ids[0])
    }

    /// Subscribes to channels; returns the ids.
    pub fn subscribe_to(&mut self, channels: &[u32]) -> Result<Vec<u32>> {
        let mut ids = Vec::new();
        for channel in channels {
            ids.push(self.next);
            self.subscriptions.insert(self.next, *channel);
            self.next += 1;
        }
        let wanted: Vec<Value> = ids
            .iter()
            .zip(channels)
            .map(|(id, channel)| json!({"id": id, "channelId": channel}))
            .collect();
        self.send(&json!({"op": "subscribe", "subscriptions": wanted}))?;
        Ok(ids)
    }

    /// Ends a subscription.
    pub fn unsubscribe(&mut self, id: u32) -> Result<()> {
        self.subscriptions.remove(&id);
        self.ended.insert(id);
        self.send(&json!({"op": "unsubscribe", "subscriptionIds": [id]}))
    }

    /// Sends a JSON message.
    pub fn send(&mut self, message: &Value) -> Result<()> {
        self.send_raw(Message::Text(message.to_string().into()))
    }

    /// Sends any message.
    pub fn send_raw(&mut self, message: Message) -> Result<()> {
        self.socket.send(message)?;
        Ok(())
    }

    /// Returns the stream, for bytes that are not WebSocket frames.
    pub fn stream(&mut self) -> &mut TcpStream {
        self.socket.get_mut()
    }

    /// Waits until the server closes the connection. Returns code and reason.
    pub fn wait_for_close(&mut self) -> Result<(u16, String)> {
        self.wait_for("close", |_, server_message| match server_message {
            ServerMessage::Closed(code, reason) => Some((*code, reason.clone())),
            _ => None,
        })
    }

    fn text(&mut self, text: &str) -> Result<ServerMessage> {
        #[derive(Deserialize)]
        #[serde(deny_unknown_fields, rename_all = "camelCase")]
        struct Advertise {
            #[serde(rename = "op")]
            _op: String,
            channels: Vec<Channel>,
        }
        #[derive(Deserialize)]
        #[serde(deny_unknown_fields, rename_all = "camelCase")]
        struct Unadvertise {
            #[serde(rename = "op")]
            _op: String,
            channel_ids: Vec<u32>,
        }
        #[derive(Deserialize)]
        #[serde(deny_unknown_fields, rename_all = "camelCase")]
        struct RemoveStatus {
            #[serde(rename = "op")]
            _op: String,
            status_ids: Vec<String>,
        }
        let value: Value = serde_json::from_str(text)?;
        match value["op"].as_str().context("no op")? {
            "advertise" => {
                let Advertise { channels, .. } = serde_json::from_value(value)?;
                for channel in channels {
                    let schema = (channel.schema.is_empty(), &channel.schema_encoding);
                    ensure!(
                        matches!(schema, (true, None) | (false, Some(_))),
                        "{channel:?}"
                    );
                    let before = self.channels.insert(channel.id, channel);
                    ensure!(before.is_none(), "{before:?} was advertised twice");
                }
                Ok(ServerMessage::Channels)
            }
            "unadvertise" => {
                let Unadvertise { channel_ids, .. } = serde_json::from_value(value)?;
                for id in channel_ids {
                    ensure!(self.channels.remove(&id).is_some(), "{id} is no channel");
                    let gone = self
                        .subscriptions
                        .extract_if(.., |_, channel| *channel == id);
                    self.ended.extend(gone.map(|(id, _)| id));
                }
                Ok(ServerMessage::Channels)
            }
            "status" => {
                let status: Status = serde_json::from_value(value)?;
                ensure!(status.level <= 2 && status.op == "status", "{status:?}");
                Ok(ServerMessage::Status(status))
            }
            "removeStatus" => {
                let RemoveStatus { status_ids, .. } = serde_json::from_value(value)?;
                Ok(ServerMessage::Removed(status_ids))
            }
            "connectionGraphUpdate" => {
                self.graph.update(serde_json::from_value(value)?);
                Ok(ServerMessage::Graph)
            }
            op => bail!("a server sends no {op}: {text}"),
        }
    }

    fn binary(&self, bytes: &[u8]) -> Result<ServerMessage> {
        let (opcode, rest) = bytes.split_first().context("an empty message")?;
        let number = |bytes: &[u8]| u64::from_le_bytes(bytes.try_into().unwrap());
        match opcode {
            1 => {
                let (subscription, rest) = rest.split_first_chunk::<4>().context("no id")?;
                let subscription = u32::from_le_bytes(*subscription);
                let (time, payload) = rest.split_at_checked(8).context("no time")?;
                ensure!(
                    self.subscriptions.contains_key(&subscription)
                        || self.ended.contains(&subscription),
                    "{subscription} is no subscription"
                );
                Ok(ServerMessage::Data(Data {
                    subscription,
                    time: number(time),
                    payload: payload.to_vec(),
                }))
            }
            2 => {
                ensure!(self.info.capabilities.iter().any(|each| each == "time"));
                ensure!(rest.len() == 8, "{} bytes", rest.len());
                Ok(ServerMessage::Time(number(rest)))
            }
            opcode => bail!("a server sends no binary {opcode}"),
        }
    }
}

impl Graph {
    fn update(&mut self, update: GraphUpdate) {
        let mut put = |parties: fn(&mut Self) -> &mut Parties, name: String, ids: Vec<String>| {
            if ids.is_empty() {
                parties(self).remove(&name);
            } else {
                parties(self).insert(name, ids.into_iter().collect());
            }
        };
        for each in update.published_topics {
            put(|graph| &mut graph.published, each.name, each.publisher_ids);
        }
        for each in update.subscribed_topics {
            put(
                |graph| &mut graph.subscribed,
                each.name,
                each.subscriber_ids,
            );
        }
        for each in update.advertised_services {
            put(|graph| &mut graph.services, each.name, each.provider_ids);
        }
        for name in update.removed_topics {
            self.published.remove(&name);
            self.subscribed.remove(&name);
        }
        for name in update.removed_services {
            self.services.remove(&name);
        }
    }
}

/// Opens a WebSocket on a connected stream and reads `serverInfo`, which is the first message.
pub fn open(
    stream: TcpStream,
    path: &str,
    subprotocols: &[&str],
    headers: &[(&str, &str)],
) -> Result<Result<Viewer, Refused>> {
    let address = stream.peer_addr()?;
    stream.set_read_timeout(Some(PATIENCE))?;
    stream.set_write_timeout(Some(PATIENCE))?;
    let mut request = ClientRequestBuilder::new(format!("ws://{address}{path}").parse()?);
    for subprotocol in subprotocols {
        request = request.with_sub_protocol(*subprotocol);
    }
    let mut request = request.into_client_request()?;
    for (name, value) in headers {
        let name: tungstenite::http::HeaderName = name.parse()?;
        request.headers_mut().insert(name, value.parse()?);
    }
    let (mut socket, response) = match tungstenite::client(request, stream) {
        Ok(opened) => opened,
        Err(HandshakeError::Failure(tungstenite::Error::Http(response))) => {
            let body = response.body().clone().unwrap_or_default();
            return Ok(Err(Refused {
                status: response.status().as_u16(),
                body: String::from_utf8_lossy(&body).into_owned(),
            }));
        }
        Err(error) => bail!("{error}"),
    };
    let spoken = response.headers().get("sec-websocket-protocol");
    let spoken = spoken.context("no subprotocol")?.to_str()?;
    ensure!(spoken == subprotocols[0], "{spoken} of {subprotocols:?}");
    let Message::Text(first) = socket.read()? else {
        bail!("the first message is no text");
    };
    let info: ServerInfo = serde_json::from_str(&first)?;
    ensure!(info.op == "serverInfo", "{info:?}");
    Ok(Ok(Viewer {
        socket,
        info,
        channels: BTreeMap::new(),
        graph: Graph::default(),
        subscriptions: BTreeMap::new(),
        ended: BTreeSet::new(),
        next: 1,
    }))
}

fn is_timeout(error: &io::Error) -> bool {
    matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut)
}
