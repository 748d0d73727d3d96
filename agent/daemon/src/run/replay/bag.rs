//! Reads the messages of a bag in the order of its files, as the datagrams of a [`Player`].
//!
//! A thread reads ahead by a bounded number of bytes. It begins with the first request, so that it
//! has the rights of the thread that replays, and ends when the reader is dropped.

use std::collections::{HashSet, VecDeque};
use std::io;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};

use ros2probe_bag::messages::{self, Message, MessagesError, Topic};
use ros2probe_message::{MessageType, TypeName};
use ros2probe_wire::{Expansion, Timestamp};

use super::player::{Datagram, MAX_TOPICS, Player};

/// Number of batches that wait, and the size from which on a batch is passed on: its messages, and
/// their bytes.
const BATCHES: usize = 2;
const BATCH_MESSAGES: usize = 256;
const BATCH_BYTES: usize = 1 << 20;
/// Versions of the encapsulation header's second byte: CDR and XCDR2 (RTPS 2.5, 10.2).
const ENCAPSULATIONS: std::ops::RangeInclusive<u8> = 0..=0x0b;

/// A bag in replay.
#[derive(Debug)]
pub struct BagReader {
    path: PathBuf,
    expansion: Expansion,
    player: Player,
    /// Definitions that were not taken yet.
    definitions: Vec<MessageType>,
    /// Topics that the bag describes, with the hash of their types, until the first message.
    topics: Option<Vec<(Topic, Option<String>)>>,
    items: Option<Receiver<Item>>,
    batch: std::vec::IntoIter<BagMessage>,
    /// Datagrams to deliver before the next message.
    due: VecDeque<(Timestamp, Datagram)>,
    messages: u64,
    /// Number of messages in the bag, if it says so.
    total: Option<u64>,
    /// Messages whose payload is not CDR, or whose topic cannot be published.
    skipped: u64,
    /// Parts of the bag that could not be read, as lines for people.
    faults: Vec<String>,
}

/// A bag cannot be replayed.
#[derive(Debug, thiserror::Error)]
pub enum BagError {
    /// Nothing of it can be read.
    #[error(transparent)]
    Messages(#[from] MessagesError),
    /// The thread that reads it cannot be started.
    #[error("cannot start the thread that reads the bag")]
    Thread(#[source] io::Error),
}

/// What the thread passes on.
enum Item {
    Messages {
        batch: Vec<BagMessage>,
        /// Number of messages in the bag, if metadata.yaml has it.
        total: Option<u64>,
    },
    /// Nothing follows.
    Ended(Result<messages::Read, MessagesError>),
}

/// A message of the bag.
#[derive(Debug)]
struct BagMessage {
    topic: Arc<str>,
    received: Timestamp,
    /// `None` if the bag does not distinguish it from the time of reception.
    written: Option<Timestamp>,
    payload: Vec<u8>,
    /// Type and definition, with the first message of a topic.
    described: Option<Box<Topic>>,
}

/// A datagram of the player.
#[derive(Debug)]
pub(super) struct Due {
    /// Time of reception of its message.
    pub(super) time: Timestamp,
    /// Port to which it is sent.
    pub(super) port: u16,
    /// The RTPS message.
    pub(super) bytes: Vec<u8>,
}

impl BagReader {
    /// Opens a bag. Its files are read from the first [`Self::next`] on.
    #[must_use]
    pub(super) fn open(path: &Path, expansion: Expansion) -> Self {
        let mut definitions = Vec::new();
        let topics = messages::topics(path).into_iter().map(|topic| {
            let hash = defined(&topic, &mut definitions);
            (topic, hash)
        });
        Self {
            topics: Some(topics.collect()),
            path: path.to_owned(),
            expansion,
            player: Player::default(),
            definitions,
            items: None,
            batch: Vec::new().into_iter(),
            due: VecDeque::new(),
            messages: 0,
            total: None,
            skipped: 0,
            faults: Vec::new(),
        }
    }

    /// Returns the next datagram, in `memory` if it is a message; `None` at the end.
    ///
    /// # Errors
    ///
    /// Fails if nothing of the bag can be read, or if no thread can be started.
    pub(super) fn next(&mut self, mut memory: Vec<u8>) -> Result<Option<Due>, BagError> {
        loop {
            if let Some((time, Datagram { port, bytes })) = self.due.pop_front() {
                return Ok(Some(Due { time, port, bytes }));
            }
            let Some(message) = self.message()? else {
                return Ok(None);
            };
            let is_known = self.player.knows(&message.topic);
            if let Some(topic) = message.described.as_deref().filter(|_| !is_known) {
                let hash = defined(topic, &mut self.definitions);
                let announcements = self.player.add(topic, hash.as_deref());
                self.due.extend(at(message.received, announcements));
            }
            let encapsulation = message.payload.get(..2);
            let is_cdr = matches!(encapsulation, Some([0, kind]) if ENCAPSULATIONS.contains(kind));
            let sample = is_cdr.then(|| {
                let BagMessage {
                    topic,
                    written,
                    payload,
                    ..
                } = &message;
                (self.player).sample(topic, *written, payload, std::mem::take(&mut memory))
            });
            match sample.flatten() {
                Some(datagram) => self.due.push_back((message.received, datagram)),
                None => self.skipped += 1,
            }
        }
    }

    /// Returns definitions of types that were not returned yet.
    pub(super) fn take_definitions(&mut self) -> Vec<MessageType> {
        std::mem::take(&mut self.definitions)
    }

    /// Returns the fraction of the messages that was read, 0 to 1; `None` if unknown.
    #[expect(clippy::cast_precision_loss, reason = "a part for people")]
    pub(super) fn part_read(&self) -> Option<f64> {
        let total = self.total.filter(|total| *total > 0)?;
        Some((self.messages as f64 / total as f64).min(1.0))
    }

    /// Returns the parts of the bag that were not replayed, as lines for people. They are complete
    /// at the end.
    pub(super) fn faults(&self) -> Vec<String> {
        let mut faults = self.faults.clone();
        if self.skipped > 0 {
            let path = self.path.display();
            faults.push(format!(
                "{path}: {} messages skipped that are not CDR, or whose topic has an invalid name",
                self.skipped
            ));
        }
        faults
    }

    /// Returns the next message; before the first one, announces the topics that the bag describes.
    fn message(&mut self) -> Result<Option<BagMessage>, BagError> {
        let items = match self.items.take() {
            Some(items) => items,
            None => {
                let (sender, items) = sync_channel(BATCHES);
                let (path, expansion) = (self.path.clone(), self.expansion);
                let thread = std::thread::Builder::new().name("bag".to_owned());
                let work = move || {
                    let ended = Reading::default().read(&path, expansion, &sender);
                    let _ = sender.send(Item::Ended(ended));
                };
                thread.spawn(work).map_err(BagError::Thread)?;
                items
            }
        };
        let items = self.items.insert(items);
        loop {
            if let Some(message) = self.batch.next() {
                self.messages += 1;
                if let Some(topics) = self.topics.take() {
                    let announcements = self.player.announce(&topics);
                    self.due.extend(at(message.received, announcements));
                }
                return Ok(Some(message));
            }
            match items.recv() {
                Ok(Item::Messages { batch, total }) => {
                    self.batch = batch.into_iter();
                    self.total = total;
                }
                Ok(Item::Ended(Ok(read))) => {
                    self.faults
                        .extend(read.faults.iter().map(ToString::to_string));
                }
                Ok(Item::Ended(Err(error))) => return Err(BagError::Messages(error)),
                Err(_) => return Ok(None),
            }
        }
    }
}

/// Returns datagrams with the time at which they are due.
fn at(time: Timestamp, datagrams: Vec<Datagram>) -> impl Iterator<Item = (Timestamp, Datagram)> {
    datagrams.into_iter().map(move |datagram| (time, datagram))
}

/// Returns the RIHS01 hash of a topic's type: that of the definition in the bag, which is added to
/// `definitions`, else the one that the bag names.
fn defined(topic: &Topic, definitions: &mut Vec<MessageType>) -> Option<String> {
    let root: Option<TypeName> = topic.type_name.parse().ok();
    let text = Some(topic.definition.as_str()).filter(|text| !text.is_empty());
    let parsed = root
        .zip(text)
        .map(|(root, text)| MessageType::parse(&root, text));
    match parsed {
        Some(Ok(definition)) => {
            let hash = definition.type_hash();
            definitions.push(definition);
            Some(hash)
        }
        Some(Err(error)) => {
            let (topic, error) = (&topic.name, error.to_string());
            tracing::warn!(
                topic,
                error,
                "the definition of the type in the bag is unusable"
            );
            None
        }
        None => Some(topic.type_description_hash.clone()).filter(|hash| !hash.is_empty()),
    }
}

/// State of the thread that reads the bag.
#[derive(Default)]
struct Reading {
    topics: HashSet<Arc<str>>,
    batch: Vec<BagMessage>,
    bytes: usize,
    total: Option<u64>,
}

impl Reading {
    /// Reads the bag until its end, or until the receiver is dropped.
    fn read(
        mut self,
        path: &Path,
        expansion: Expansion,
        sender: &SyncSender<Item>,
    ) -> Result<messages::Read, MessagesError> {
        let read = messages::read_whole(path, expansion, &mut |message, total| {
            self.total = total;
            self.add(message);
            let is_full = self.batch.len() >= BATCH_MESSAGES || self.bytes >= BATCH_BYTES;
            match is_full {
                true => self.pass_on(sender),
                false => ControlFlow::Continue(()),
            }
        });
        let _ = self.pass_on(sender);
        read
    }

    fn add(&mut self, message: &Message<'_>) {
        let (topic, described) = match self.topics.get(message.topic) {
            Some(topic) => (Arc::clone(topic), None),
            None => {
                let topic: Arc<str> = message.topic.into();
                if self.topics.len() < MAX_TOPICS {
                    self.topics.insert(Arc::clone(&topic));
                }
                let described = Topic {
                    name: message.topic.to_owned(),
                    type_name: message.type_name.to_owned(),
                    definition: message.definition.to_owned(),
                    ..Topic::default()
                };
                (topic, Some(Box::new(described)))
            }
        };
        // Older recorders write the time of reception twice.
        let written = message.publish_time;
        let written = written.filter(|written| *written != message.log_time && *written > 0);
        self.bytes += message.begin.len();
        self.batch.push(BagMessage {
            topic,
            received: Timestamp(message.log_time),
            written: written.map(Timestamp),
            payload: message.begin.to_vec(),
            described,
        });
    }

    fn pass_on(&mut self, sender: &SyncSender<Item>) -> ControlFlow<()> {
        self.bytes = 0;
        let batch = std::mem::take(&mut self.batch);
        let total = self.total;
        match sender.send(Item::Messages { batch, total }) {
            Ok(()) => ControlFlow::Continue(()),
            Err(_) => ControlFlow::Break(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ros2probe_bag::{Options, TopicDescription, Writer};
    use std::collections::BTreeMap;

    /// Writes a bag with messages of these sizes, a nanosecond apart.
    fn bag(path: &Path, sizes: &[usize]) {
        let mut writer = Writer::create(path, Options::default()).unwrap();
        let topic = writer.topic(TopicDescription {
            name: "/data".into(),
            type_name: "std_msgs/msg/String".into(),
            type_hash: None,
            publishers: Vec::new(),
            schema: None,
        });
        let topic = topic.unwrap();
        for (number, size) in (1..).zip(sizes) {
            let mut payload = vec![0; *size];
            payload[1] = 1;
            let time = Timestamp(1_790_000_000_000_000_000 + number);
            writer.write(topic, time, time, number, &payload).unwrap();
        }
        writer.close(BTreeMap::new()).unwrap();
    }

    #[test]
    fn a_batch_ends_with_a_number_of_messages_or_of_bytes() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("bag");
        let sizes: Vec<_> = [100; 300].into_iter().chain([400_000; 7]).collect();
        bag(&path, &sizes);
        let (sender, items) = sync_channel(100);
        let read = Reading::default().read(&path, Expansion::Limited, &sender);
        assert_eq!(read.unwrap().messages, 307);
        drop(sender);
        let batches = items.into_iter().map(|item| match item {
            Item::Messages { batch, total } => (batch.len(), total),
            Item::Ended(_) => panic!("the caller ends"),
        });
        let expected = [256, 47, 3, 1].map(|messages| (messages, Some(307)));
        assert_eq!(batches.collect::<Vec<_>>(), expected);
    }

    #[test]
    fn the_thread_ends_with_its_reader() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("bag");
        bag(&path, &[100; 5000]);
        let (sender, items) = sync_channel(BATCHES);
        let reading =
            std::thread::spawn(move || Reading::default().read(&path, Expansion::Limited, &sender));
        assert!(items.recv().is_ok());
        drop(items);
        let read = reading.join().unwrap().unwrap();
        assert!(read.messages < 5000, "{read:?}");
        assert!(read.faults.is_empty(), "{read:?}");
    }

    #[test]
    fn announcements_precede_the_messages_and_each_has_its_time() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("bag");
        bag(&path, &[8, 70_000]);
        let mut reader = BagReader::open(&path, Expansion::Limited);
        let mut due = Vec::new();
        while let Some(next) = reader.next(Vec::new()).unwrap() {
            due.push((next.time.0 % 10, next.port, next.bytes.len()));
        }
        // SPDP, the writers of nodes and of the topic, the nodes, and both messages.
        let ports: Vec<_> = due.iter().map(|(time, port, _)| (*time, *port)).collect();
        let expected = [
            (1, 7400),
            (1, 7400),
            (1, 7400),
            (1, 7401),
            (1, 7401),
            (2, 7401),
        ];
        assert_eq!(ports, expected);
        assert!(due[5].2 > 70_000);
        assert_eq!(reader.part_read(), Some(1.0));
    }
}
