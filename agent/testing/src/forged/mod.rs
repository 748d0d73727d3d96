//! Hand-made RTPS traffic: for links on which no DDS implementation can run, and for messages that
//! no implementation sends.

pub mod crowd;
pub mod frames;
pub mod storm;

use std::net::{SocketAddr, UdpSocket};
use std::sync::mpsc::{self, RecvTimeoutError};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result};
use ros2probe_capture::netns;

use crate::harness::network::Namespace;

/// Discovery port of participants in domain 0.
pub const DISCOVERY_PORT: u16 = 7400;

const SPDP_WRITER: [u8; 4] = [0, 1, 0, 0xc2];
const PUBLICATIONS_WRITER: [u8; 4] = [0, 0, 3, 0xc2];
const SUBSCRIPTIONS_WRITER: [u8; 4] = [0, 0, 4, 0xc2];
const PARTICIPANT: [u8; 4] = [0, 0, 1, 0xc1];
/// Writer of `ros_discovery_info`. The entity ids of user topics follow it.
const ENTITIES_WRITER: [u8; 4] = [0, 0, 1, 3];
pub const SAMPLES_WRITER: [u8; 4] = [0, 0, 2, 3];
pub const FINITE_LEASE_SECONDS: u32 = 12;

/// A participant with one node and one writer that only sends.
pub struct Talker {
    pub prefix: [u8; 12],
    topic: String,
    sent: u32,
}

impl Talker {
    pub fn new(number: u32, topic: &str) -> Talker {
        let mut prefix = *b"\x01\x0fforged....";
        prefix[8..].copy_from_slice(&number.to_be_bytes());
        Talker {
            prefix,
            topic: topic.to_owned(),
            sent: 0,
        }
    }

    /// Returns SPDP, SEDP and `ros_discovery_info`, each in a separate message.
    pub fn introduction(&self, node: &str) -> [Vec<u8>; 4] {
        let entities_topic = "ros_discovery_info";
        let entities_type = "rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_";
        let cloud_type = "sensor_msgs::msg::dds_::PointCloud2_";
        [
            self.participant(),
            self.publication(ENTITIES_WRITER, entities_topic, entities_type, 1),
            self.publication(SAMPLES_WRITER, &format!("rt{}", self.topic), cloud_type, 2),
            self.entities(node),
        ]
    }

    /// Returns an SPDP message.
    pub fn participant(&self) -> Vec<u8> {
        self.participant_at(&[])
    }

    /// Returns an SPDP message with locators (RTPS 2.5, 9.4.2.10).
    pub fn participant_at(&self, locators: &[[u8; 24]]) -> Vec<u8> {
        let mut list = Parameters::new();
        list.add(0x15, &[2, 3, 0, 0]);
        list.add(0x16, &[1, 0x0f, 0, 0]);
        list.add(0x50, &[&self.prefix[..], &PARTICIPANT].concat());
        list.add(0x02, &[FINITE_LEASE_SECONDS.to_le_bytes(), [0; 4]].concat());
        list.add(0x0f, &[0; 4]);
        for locator in locators {
            list.add(0x31, locator);
            list.add(0x32, locator);
        }
        self.message(SPDP_WRITER, 1, &list.finish())
    }

    /// Returns the SEDP message of a best-effort, volatile writer.
    pub fn publication(
        &self,
        writer: [u8; 4],
        dds_topic: &str,
        dds_type: &str,
        number: u32,
    ) -> Vec<u8> {
        self.endpoint(PUBLICATIONS_WRITER, writer, dds_topic, dds_type, number)
    }

    /// Returns the SEDP message of a reader.
    pub fn subscription(
        &self,
        reader: [u8; 4],
        dds_topic: &str,
        dds_type: &str,
        number: u32,
    ) -> Vec<u8> {
        self.endpoint(SUBSCRIPTIONS_WRITER, reader, dds_topic, dds_type, number)
    }

    /// Returns the number of the last sample.
    pub fn sent(&self) -> u32 {
        self.sent
    }

    /// Returns the next sample of `size` bytes, including its encapsulation header.
    pub fn sample(&mut self, size: usize) -> Vec<u8> {
        self.sent += 1;
        let mut payload = vec![0, 1, 0, 0];
        payload.resize(size, 0x33);
        self.message(SAMPLES_WRITER, self.sent, &payload)
    }

    /// Returns a message with one DATA.
    pub fn message(&self, writer: [u8; 4], number: u32, payload: &[u8]) -> Vec<u8> {
        let mut bytes = self.header();
        data(&mut bytes, writer, number, payload);
        bytes
    }

    /// Returns the header of a message.
    pub fn header(&self) -> Vec<u8> {
        [&b"RTPS\x02\x03\x01\x0f"[..], &self.prefix].concat()
    }

    fn endpoint(
        &self,
        from: [u8; 4],
        endpoint: [u8; 4],
        dds_topic: &str,
        dds_type: &str,
        number: u32,
    ) -> Vec<u8> {
        let mut list = Parameters::new();
        list.add(0x5a, &[&self.prefix[..], &endpoint].concat());
        list.add_text(0x05, dds_topic);
        list.add_text(0x07, dds_type);
        list.add(0x1a, &[1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]);
        self.message(from, number, &list.finish())
    }

    /// Returns `ros_discovery_info` with 16-byte gids: one node with the writer of samples.
    pub fn entities(&self, node: &str) -> Vec<u8> {
        let mut bytes = vec![0, 1, 0, 0];
        bytes.extend_from_slice(&self.prefix);
        bytes.extend_from_slice(&PARTICIPANT);
        bytes.extend_from_slice(&1_u32.to_le_bytes());
        for text in ["/", node] {
            bytes.extend_from_slice(&text_of(text));
        }
        bytes.extend_from_slice(&0_u32.to_le_bytes());
        bytes.extend_from_slice(&1_u32.to_le_bytes());
        bytes.extend_from_slice(&self.prefix);
        bytes.extend_from_slice(&SAMPLES_WRITER);
        self.message(ENTITIES_WRITER, 1, &bytes)
    }
}

/// Carries UDP payloads to the observed host.
pub trait Carrier {
    fn send(&mut self, payload: &[u8]) -> Result<()>;
}

/// A UDP socket in a host's network, and its destination.
pub struct Sender {
    pub socket: UdpSocket,
    to: SocketAddr,
}

impl Sender {
    pub fn new(host: &Namespace, from: &str, to: &str) -> Result<Sender> {
        let (from, to): (SocketAddr, SocketAddr) = (from.parse()?, to.parse()?);
        let socket = netns::within(&host.network(), || UdpSocket::bind(from))?
            .with_context(|| format!("cannot bind {from}"))?;
        Ok(Sender { socket, to })
    }

    /// Sends from one IPv4 host to another's discovery port.
    pub fn between(host: &Namespace, other: &Namespace) -> Result<Sender> {
        Sender::new(
            host,
            &format!("{}:0", host.address()),
            &format!("{}:{DISCOVERY_PORT}", other.address()),
        )
    }
}

impl Carrier for Sender {
    fn send(&mut self, payload: &[u8]) -> Result<()> {
        self.socket
            .send_to(payload, self.to)
            .with_context(|| format!("cannot send to {}", self.to))?;
        Ok(())
    }
}

/// Interval of repeated announcements, as of real participants.
const REPEAT: Duration = Duration::from_secs(3);

/// Repeats an announcement until it is dropped, so that no lease ends while a test waits.
pub struct Renewal {
    /// Ends the announcements when it is dropped.
    _stop: mpsc::Sender<()>,
}

impl Renewal {
    pub fn start(mut carrier: impl Carrier + Send + 'static, announcement: Vec<u8>) -> Renewal {
        let (stop, stopped) = mpsc::channel();
        std::thread::spawn(move || {
            while stopped.recv_timeout(REPEAT) == Err(RecvTimeoutError::Timeout) {
                let _ = carrier.send(&announcement);
            }
        });
        Renewal { _stop: stop }
    }
}

/// Sends all announcements of the talker.
pub fn introduce(talker: &Talker, carrier: &mut impl Carrier) -> Result<()> {
    for message in talker.introduction("talker") {
        carrier.send(&message)?;
    }
    std::thread::sleep(Duration::from_millis(300));
    Ok(())
}

/// Sends one sample of each size.
pub fn send_sizes(
    talker: &mut Talker,
    carrier: &mut impl Carrier,
    sizes: impl IntoIterator<Item = usize>,
) -> Result<()> {
    let mut pace = Pace::new(Duration::from_millis(2));
    for size in sizes {
        carrier.send(&talker.sample(size))?;
        pace.wait();
    }
    Ok(())
}

/// Maximum delay that a sender makes up for, so that a long one causes no burst.
const MAX_CATCH_UP: Duration = Duration::from_millis(20);

/// Paces messages by the elapsed time, because a thread of a busy machine wakes late.
pub struct Pace {
    interval: Duration,
    due: Instant,
}

impl Pace {
    /// Starts with a message that is sent now.
    pub fn new(interval: Duration) -> Pace {
        Pace {
            interval,
            due: Instant::now() + interval,
        }
    }

    /// Waits until the next message is due.
    pub fn wait(&mut self) {
        let now = Instant::now();
        std::thread::sleep(self.due.saturating_duration_since(now));
        let earliest = now.checked_sub(MAX_CATCH_UP).unwrap_or(now);
        self.due = self.due.max(earliest) + self.interval;
    }
}

/// Returns the frame in which Fast DDS sends a message of user data by TCP, without a checksum.
pub fn framed(message: &[u8]) -> Vec<u8> {
    let mut frame = b"RTCP".to_vec();
    frame.extend((message.len() as u32 + 14).to_le_bytes());
    frame.extend([0; 4]);
    frame.extend(7411_u16.to_le_bytes());
    frame.extend(message);
    frame
}

/// Appends a DATA submessage (RTPS 2.5, 9.4.5.3).
pub fn data(bytes: &mut Vec<u8>, writer: [u8; 4], number: u32, payload: &[u8]) {
    let length = u16::try_from(20 + payload.len()).unwrap_or(0);
    bytes.extend_from_slice(&[0x15, 5]);
    bytes.extend_from_slice(&length.to_le_bytes());
    bytes.extend_from_slice(&[0, 0, 16, 0, 0, 0, 0, 0]);
    bytes.extend_from_slice(&writer);
    bytes.extend_from_slice(&[0; 4]);
    bytes.extend_from_slice(&number.to_le_bytes());
    bytes.extend_from_slice(payload);
}

/// A parameter list (RTPS 2.5, 9.4.2.11) with its encapsulation header.
struct Parameters(Vec<u8>);

impl Parameters {
    fn new() -> Parameters {
        Parameters(vec![0, 3, 0, 0])
    }

    fn add(&mut self, id: u16, value: &[u8]) {
        let length = u16::try_from(value.len()).unwrap_or(u16::MAX);
        self.0.extend_from_slice(&id.to_le_bytes());
        self.0.extend_from_slice(&length.to_le_bytes());
        self.0.extend_from_slice(value);
    }

    fn add_text(&mut self, id: u16, text: &str) {
        self.add(id, &text_of(text));
    }

    fn finish(mut self) -> Vec<u8> {
        self.add(1, &[]);
        self.0
    }
}

/// Returns a CDR string, padded to four bytes.
fn text_of(text: &str) -> Vec<u8> {
    let length = u32::try_from(text.len() + 1).unwrap_or(u32::MAX);
    let mut bytes = length.to_le_bytes().to_vec();
    bytes.extend_from_slice(text.as_bytes());
    bytes.resize((bytes.len() + 1).next_multiple_of(4), 0);
    bytes
}
