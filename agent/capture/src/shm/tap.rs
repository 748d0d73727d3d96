//! Polls all ports, reads the announced messages and passes on those of interest.
//!
//! The tap never writes, locks or registers, so participants cannot detect it. A message that
//! several ports announce is read once. Silent ports are polled less often, so that a hundred idle
//! ports cost little. The caller sleeps between polls.

mod recent_messages;

use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};

use ros2probe_wire::record::{Record, flag};
use ros2probe_wire::{EntityId, Guid, GuidPrefix};

use super::cell::{Descriptor, SegmentId};
use super::classifier::{MessageClassifier, MessageVerdict};
use super::cpu_allowance::CpuAllowance;
use super::directories::{Generation, Name, ShmDirectories, ShmDirectoryId};
use super::inbox::Item;
use super::owner::Locks;
use super::port::Port;
use super::segment::{Buffer, Message, Refusal};
use super::source::SharedFile;
use crate::system::thread_cpu;
use crate::tables::{AbandonedPorts, InboxBytes, InboxItems, Ports, Segments};
use recent_messages::{Identity, RecentMessages};
use ros2probe_model::facts::bounded::Bounded;
use ros2probe_model::facts::shared_memory::MemoryUse;

/// Maximum number of messages per poll. The next poll reads the rest of a flood.
const MAX_PER_POLL: usize = 2048;
const MAX_PER_URGENT_POLL: usize = 64;
/// Maximum number of ports per urgent poll: an announcement to all participants is in every port.
const PORTS_PER_URGENT_POLL: usize = 8;
/// Number of bytes at the start of a message in which an announcement of its participant's nodes
/// begins.
const HEAD_BYTES: usize = 4096;
/// Silence after which a port is polled less often, and the interval of those polls.
const SILENT_AFTER: u64 = 2_000_000_000;
const SILENT_POLL_INTERVAL: u64 = 10_000_000;
/// Pause before another attempt to open a segment.
const RETRY_NANOSECONDS: u64 = 50_000_000;
/// Interval of listing directories.
const LIST_INTERVAL: u64 = 100_000_000;
/// Interval of polling a port that is not initialized yet.
const OPEN_RETRY_INTERVAL: u64 = 1_000_000;
const FIND_INTERVAL: u64 = 1_000_000_000;
const URGENT_FIND_INTERVAL: u64 = 10_000_000_000;
/// Interval between two measurements of the directories' use.
const MEMORY_USE_INTERVAL: u64 = 5_000_000_000;

/// The open files and the read positions.
pub struct Tap {
    directories: ShmDirectories,
    /// Ports, by number.
    ports: Bounded<Ports, Vec<Open>>,
    /// Ports that are listed but not initialized yet.
    uninitialized: Vec<(PortKey, PathBuf)>,
    /// Ports of dead processes, with their inodes. They are tried again after the next search.
    abandoned: Bounded<AbandonedPorts, HashSet<(PortKey, u64)>>,
    segments: Bounded<Segments, HashMap<SegmentKey, Segment>>,
    remembered: RecentMessages,
    /// The rules and the interest map.
    pub classifier: MessageClassifier,
    /// Whether the next poll is urgent: slow work is postponed.
    pub is_urgent: bool,
    /// Whether every message is needed: silent ports are polled as often as others.
    pub needs_every_message: bool,
    /// The wall clock, in nanoseconds since the Unix epoch.
    wall_clock: Box<dyn FnMut() -> u64>,
    counters: Counters,
    opened: u64,
    discovery_seen: bool,
    now: u64,
    last_listing: u64,
    last_open_attempt: u64,
    last_search: u64,
    last_memory_use: u64,
    announced: Vec<Descriptor>,
    latest: HashMap<(SegmentId, u32), usize>,
    records: Vec<Record>,
    allowance: CpuAllowance,
    /// Index of the port that is polled first.
    first_port: usize,
    /// Number of items of the current poll, and bytes of the messages among them.
    taken_items: usize,
    taken_bytes: usize,
    refused: u64,
}

/// Counters of the tap.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counters {
    /// Ports open now.
    pub ports: u64,
    /// Segments open now.
    pub segments: u64,
    /// Directories of shared memory.
    pub directories: u64,
    /// Messages announced at ports, counted per port.
    pub announced: u64,
    /// Messages read, each counted once.
    pub read: u64,
    /// Messages read that were captured whole.
    pub captured: u64,
    /// Bytes of the captured messages.
    pub captured_bytes: u64,
    /// Messages that were overwritten in the ring or in a reused buffer before they were read.
    pub missed: u64,
    /// Messages that were announced but never filled in, because their writer died.
    pub unfilled: u64,
    /// Messages in segments that could not be opened.
    pub unreachable: u64,
    /// Messages that are malformed or not RTPS.
    pub malformed: u64,
    /// Messages that were read but discarded, because their process was already dead.
    pub abandoned: u64,
    /// Number of polls so late that a ring may have wrapped around unnoticed.
    pub uncertain: u64,
    /// Files and directories skipped because of a cap.
    pub left_out: u64,
    /// Use of the directories.
    pub memory_use: MemoryUse,
}

type PortKey = (ShmDirectoryId, Generation, u32);
type SegmentKey = (ShmDirectoryId, Generation, SegmentId);

struct Open {
    key: PortKey,
    file: SharedFile,
    port: Port,
    /// Time of its last announcement, and of its next poll.
    busy: u64,
    due: u64,
}

enum Segment {
    /// An open file with a unique number: another file may get the same name and inode later.
    Open(SharedFile, u64),
    /// A file that could not be opened at this time.
    Missing(u64),
}

/// Times of reading a message, and whether they show when it was sent.
#[derive(Clone, Copy)]
struct Reading {
    monotonic: u64,
    /// Wall clock after the announcement was read, so never before the message was sent.
    wall_time: u64,
    /// Whether the message was announced since the previous poll.
    is_timely: bool,
}

impl Tap {
    /// Creates a tap without open files. `wall_clock` returns nanoseconds since the Unix epoch.
    #[must_use]
    pub fn new(directories: ShmDirectories, wall_clock: impl FnMut() -> u64 + 'static) -> Self {
        Self {
            directories,
            ports: Bounded::default(),
            uninitialized: Vec::new(),
            abandoned: Bounded::default(),
            segments: Bounded::default(),
            remembered: RecentMessages::default(),
            classifier: MessageClassifier::default(),
            is_urgent: false,
            needs_every_message: false,
            wall_clock: Box::new(wall_clock),
            counters: Counters::default(),
            opened: 0,
            discovery_seen: false,
            now: 0,
            last_listing: 0,
            last_open_attempt: 0,
            last_search: 0,
            last_memory_use: 0,
            announced: Vec::new(),
            latest: HashMap::new(),
            records: Vec::new(),
            allowance: CpuAllowance::default(),
            first_port: 0,
            taken_items: 0,
            taken_bytes: 0,
            refused: 0,
        }
    }

    /// Returns whether directories are listed at `now`; `false` if listing has used up its CPU
    /// share.
    pub fn may_list(&mut self, now: u64) -> bool {
        self.allowance.has_time_left(now)
    }

    /// Charges CPU time spent on listing directories and opening ports, in nanoseconds.
    pub const fn spend(&mut self, nanoseconds: u64) {
        self.allowance.spend(nanoseconds);
    }

    /// Makes the next poll list directories and poll every port, even silent ones. If no directory
    /// is known, the poll also searches for directories.
    pub fn expect_participant(&mut self) {
        self.last_listing = 0;
        if self.directories.directories.is_empty() {
            self.last_search = 0;
        }
        for open in self.ports.iter_mut() {
            (open.due, open.busy) = (0, open.busy.max(self.now));
        }
    }

    /// Measures the use of the directories if that is due, without a poll.
    pub fn measure_memory_use(&mut self, now: u64) {
        if !self.is_memory_use_due(now) || !self.may_list(now) {
            return;
        }
        let before = thread_cpu();
        self.directories.find();
        self.directories.list();
        self.last_memory_use = now;
        self.counters.memory_use = self.directories.memory_use();
        self.spend(thread_cpu().saturating_sub(before));
    }

    const fn is_memory_use_due(&self, now: u64) -> bool {
        self.last_memory_use == 0 || now.saturating_sub(self.last_memory_use) >= MEMORY_USE_INTERVAL
    }

    /// Closes every file. The next poll opens the existing ones again.
    pub fn close_all(&mut self) {
        self.ports.clear();
        self.abandoned.clear();
        self.segments.clear();
        (self.last_listing, self.last_search) = (0, 0);
    }

    /// Returns whether participants discovered each other since the last call: a port appeared, or
    /// an endpoint was announced.
    pub fn take_discovery_seen(&mut self) -> bool {
        std::mem::take(&mut self.discovery_seen)
    }

    /// Iterates over the observed directories and paths that reach them.
    pub fn directories(&self) -> impl Iterator<Item = (ShmDirectoryId, &Path)> {
        let directories = self.directories.directories.iter();
        directories.map(|(id, directory)| (*id, directory.path.as_path()))
    }

    /// Returns the number of observed directories.
    #[must_use]
    pub fn directory_count(&self) -> usize {
        self.directories.directories.len()
    }

    /// Returns whether any port exists.
    #[must_use]
    pub fn has_ports(&self) -> bool {
        !self.ports.is_empty()
    }

    /// Returns the nanoseconds from `now` to the next search for directories. In between, only a
    /// created file requires a poll. Returns `None` if a port exists or waits to be opened, or if
    /// the next poll is urgent.
    #[must_use]
    pub fn until_next_search(&self, now: u64) -> Option<u64> {
        let is_idle = self.ports.is_empty() && self.uninitialized.is_empty() && !self.is_urgent;
        is_idle.then(|| (self.last_search + FIND_INTERVAL).saturating_sub(now))
    }

    /// Returns the number of messages that were left out, because one poll would have found more
    /// than its queue holds.
    #[must_use]
    pub const fn refused(&self) -> u64 {
        self.refused
    }

    /// Returns the counters.
    #[must_use]
    pub fn counters(&self) -> Counters {
        let open = |segment: &&Segment| matches!(segment, Segment::Open(..));
        Counters {
            ports: self.ports.len() as u64,
            segments: self.segments.values().filter(open).count() as u64,
            directories: self.directories.directories.len() as u64,
            left_out: self.counters.left_out + self.directories.left_out,
            ..self.counters
        }
    }

    /// Polls the ports that are due, up to a limit of messages, at `now` nanoseconds of the
    /// monotonic clock; appends items of interest. Returns the number of announced messages.
    pub fn poll(&mut self, now: u64, found: &mut Vec<Item>) -> usize {
        self.now = now;
        (self.taken_items, self.taken_bytes) = (0, 0);
        self.classifier.refill(now);
        let lists =
            now.saturating_sub(self.last_listing) >= LIST_INTERVAL || self.last_listing == 0;
        let tries = !self.uninitialized.is_empty()
            && now.saturating_sub(self.last_open_attempt) >= OPEN_RETRY_INTERVAL;
        if (lists || tries) && self.may_list(now) {
            let before = thread_cpu();
            if lists {
                self.last_listing = now;
                self.scan(now, found);
            } else {
                self.attach(now, found);
            }
            self.spend(thread_cpu().saturating_sub(before));
        }
        let most = if self.is_urgent {
            MAX_PER_URGENT_POLL
        } else {
            MAX_PER_POLL
        };
        let most_ports = match self.is_urgent && !self.needs_every_message {
            true => PORTS_PER_URGENT_POLL,
            false => usize::MAX,
        };
        let (mut announced, mut polled) = (0, 0);
        let ports = self.ports.len();
        let first = std::mem::take(&mut self.first_port);
        for step in 0..ports {
            let index = (first + step) % ports;
            if self.ports.get(index).is_some_and(|open| open.due <= now) {
                announced += self.poll_port(index, now, found);
                polled += 1;
                if announced >= most || polled >= most_ports {
                    // A flood at one port must not starve the others.
                    self.first_port = index + 1;
                    break;
                }
            }
        }
        announced
    }

    fn poll_port(&mut self, index: usize, now: u64, found: &mut Vec<Item>) -> usize {
        let Some(open) = self.ports.get_mut(index) else {
            return 0;
        };
        let key = open.key;
        let mut announced = std::mem::take(&mut self.announced);
        let look = open.port.poll(&open.file, now, &mut announced);
        let number = announced.len();
        let is_uncertain = look.is_some_and(|look| look.is_uncertain);
        let wall_time = match number > 0 || is_uncertain {
            true => (self.wall_clock)(),
            false => 0,
        };
        match look {
            Some(look) => {
                if look.pushed > 0 {
                    open.busy = now;
                }
                let is_silent = now.saturating_sub(open.busy) > SILENT_AFTER;
                let is_resting = is_silent && !self.needs_every_message;
                open.due = now + if is_resting { SILENT_POLL_INTERVAL } else { 0 };
                self.counters.announced += look.pushed;
                self.counters.missed += look.overwritten;
                self.counters.unfilled += look.unfilled;
                if is_uncertain {
                    self.counters.uncertain += 1;
                    found.push(Item::Uncertain(wall_time));
                }
            }
            None => {
                // The file was truncated or overwritten. If it becomes a port again, the next
                // listing finds it.
                self.counters.malformed += 1;
                self.ports.remove(index);
            }
        }
        // A reused buffer has lost its previous content: only the last use can be read.
        let mut latest = std::mem::take(&mut self.latest);
        let directories = announced.iter().enumerate();
        latest.extend(directories.map(|(index, it)| ((it.segment, it.node), index)));
        let reading = Reading {
            monotonic: now,
            wall_time,
            is_timely: true,
        };
        for (index, descriptor) in announced.drain(..).enumerate() {
            if latest.get(&(descriptor.segment, descriptor.node)) == Some(&index) {
                self.read(key, &descriptor, reading, found);
            } else {
                self.counters.missed += 1;
            }
        }
        latest.clear();
        (self.announced, self.latest) = (announced, latest);
        number
    }

    /// Reads one message. For messages that were in a ring before it was opened, the time of
    /// sending is unknown.
    fn read(
        &mut self,
        (directory, generation, port): PortKey,
        descriptor: &Descriptor,
        reading: Reading,
        found: &mut Vec<Item>,
    ) {
        let key = (directory, generation, descriptor.segment);
        self.open_segment(key, reading.monotonic);
        let Some(Segment::Open(segment, serial)) = self.segments.get(&key) else {
            self.counters.unreachable += 1;
            return;
        };
        let identity = Identity {
            serial: *serial,
            node: descriptor.node,
            validity: descriptor.validity,
        };
        if self.remembered.set.contains(&identity) {
            return;
        }
        let buffer = match Buffer::find(segment, descriptor) {
            Ok(buffer) => buffer,
            Err(Refusal::Expired) => {
                self.counters.missed += 1;
                return;
            }
            Err(Refusal::Malformed) => {
                self.counters.malformed += 1;
                return;
            }
        };
        let template = Record {
            time: reading.wall_time,
            destination_port: u16::try_from(port).unwrap_or(0),
            flags: flag::SHM,
            ..Record::default()
        };
        self.records.clear();
        let message = Message::new(segment, buffer);
        let judgement =
            self.classifier
                .classify(&message, buffer.length, template, &mut self.records);
        // The queue would refuse what one poll finds beyond its caps, but only after the poll.
        let is_captured = judgement == MessageVerdict::Captured;
        let (items, length) = match is_captured {
            true => (1, buffer.length as usize),
            false => (self.records.len(), 0),
        };
        let (items, length) = (self.taken_items + items, self.taken_bytes + length);
        if items > InboxItems::CAP || length > InboxBytes::CAP {
            self.refused += 1;
            return;
        }
        let mut bytes = Vec::new();
        let is_whole = !is_captured || buffer.read(segment, &mut bytes);
        if !buffer.is_valid(segment) {
            self.counters.missed += 1;
            return;
        }
        self.remembered.add(identity);
        if judgement == MessageVerdict::Foreign || !is_whole {
            self.counters.malformed += 1;
            return;
        }
        self.counters.read += 1;
        (self.taken_items, self.taken_bytes) = (items, length);
        if is_captured {
            self.counters.captured += 1;
            // Samples that are read do not indicate a new participant.
            let may_be_new = !(self.needs_every_message && self.classifier.is_wanted);
            self.discovery_seen |= may_be_new
                && self.classifier.announces
                && (self.classifier.is_builtin || may_announce_nodes(&bytes));
            self.counters.captured_bytes += bytes.len() as u64;
            found.push(Item::Message {
                time: reading.wall_time,
                port: template.destination_port,
                bytes,
            });
        }
        for mut record in self.records.drain(..) {
            if !reading.is_timely {
                record.source_timestamp = 0;
                record.flags &= !flag::STAMP;
            }
            found.push(Item::Record(record));
        }
    }

    fn open_segment(&mut self, key: SegmentKey, now: u64) {
        match self.segments.get(&key) {
            Some(Segment::Open(..)) => return,
            Some(Segment::Missing(since)) if now.saturating_sub(*since) < RETRY_NANOSECONDS => {
                return;
            }
            _ => {}
        }
        if self.segments.is_full() && !self.segments.contains_key(&key) {
            self.counters.left_out += 1;
            return;
        }
        let (directory, generation, id) = key;
        let Some(directory) = self.directories.directories.get(&directory) else {
            return;
        };
        let name = Name::Segment(generation, id).file_name();
        let segment = SharedFile::open(&directory.path.join(name));
        self.opened += 1;
        let segment = segment.map_or(Segment::Missing(now), |segment| {
            Segment::Open(segment, self.opened)
        });
        self.segments.insert(key, segment);
    }

    /// Opens new files and closes files that are gone or were replaced.
    fn scan(&mut self, now: u64, found: &mut Vec<Item>) {
        let every = if self.is_urgent {
            URGENT_FIND_INTERVAL
        } else {
            FIND_INTERVAL
        };
        let is_lost = self.last_search == 0 || !self.directories.are_reachable();
        let finds = is_lost || now.saturating_sub(self.last_search) >= every;
        if finds {
            self.last_search = now;
            if !is_lost && self.ports.is_empty() && self.uninitialized.is_empty() {
                self.directories.find_new();
            } else {
                self.directories.find();
            }
            self.abandoned.clear();
            if self.is_memory_use_due(now) {
                self.last_memory_use = now;
                self.counters.memory_use = self.directories.memory_use();
            }
        }
        if !self.directories.list() && !finds {
            return;
        }
        let directories = &self.directories.directories;
        let inode = |directory: &ShmDirectoryId, name| {
            directories.get(directory)?.files.get(&name).copied()
        };
        self.ports.retain(|open| {
            let (directory, generation, number) = &open.key;
            inode(directory, Name::Port(*generation, *number)) == Some(open.file.inode())
        });
        self.segments
            .retain(|(directory, generation, id), segment| match segment {
                Segment::Open(file, _) => {
                    let listed = inode(directory, Name::Segment(*generation, *id));
                    listed == Some(file.inode()) && !file.is_unlinked()
                }
                Segment::Missing(_) => false,
            });
        let known: HashSet<_> = self.ports.iter().map(|open| open.key).collect();
        self.uninitialized.clear();
        for (id, directory) in directories {
            for (name, inode) in &directory.files {
                let Name::Port(generation, number) = name else {
                    continue;
                };
                let key = (*id, *generation, *number);
                if !known.contains(&key) && !self.abandoned.contains(&(key, *inode)) {
                    self.uninitialized
                        .push((key, directory.path.join(name.file_name())));
                }
            }
        }
        self.attach(now, found);
    }

    /// Opens ports that have been initialized. Their existing messages count only if the sending
    /// process lives: files of a killed process stay until another process reuses their names.
    fn attach(&mut self, now: u64, found: &mut Vec<Item>) {
        self.last_open_attempt = now;
        let mut attached = Vec::new();
        for (key, path) in std::mem::take(&mut self.uninitialized) {
            let Ok(file) = SharedFile::open(&path) else {
                continue;
            };
            if self.ports.len() + attached.len() >= Ports::CAP && !self.make_room(file.user()) {
                self.counters.left_out += 1;
                continue;
            }
            let (_, _, number) = key;
            let Some((port, backlog)) = Port::attach(&file, number, now) else {
                // The port is not initialized yet, or has an unknown layout.
                self.uninitialized.push((key, path));
                continue;
            };
            let open = Open {
                key,
                file,
                port,
                busy: now,
                due: now,
            };
            let reading = Reading {
                monotonic: now,
                wall_time: (self.wall_clock)(),
                is_timely: false,
            };
            // Messages are read first, because names are overwritten within 50 us.
            let read = backlog.iter().map(|descriptor| {
                let mut items = Vec::new();
                self.read(key, descriptor, reading, &mut items);
                ((key.0, key.1, descriptor.segment), items)
            });
            let read: Vec<_> = read.filter(|(_, items)| !items.is_empty()).collect();
            attached.push((open, path, read));
        }
        if attached.is_empty() {
            return;
        }
        let locks = Locks::read();
        for (open, path, read) in attached {
            for (segment, mut items) in read {
                if self.is_abandoned(&locks, segment) {
                    self.counters.abandoned += 1;
                } else {
                    found.append(&mut items);
                }
            }
            if locks.is_abandoned(&path) {
                self.abandoned.insert((open.key, open.file.inode()));
                continue;
            }
            let (_, _, number) = open.key;
            let at = self.ports.partition_point(|open| open.key.2 <= number);
            self.ports.insert(at, open);
            self.discovery_seen = true;
        }
    }

    /// Closes the longest idle port of another user in favour of this one, and returns whether it
    /// did. It does so only if the other user has more ports than this one would have, so no user
    /// can exclude another.
    fn make_room(&mut self, user: u32) -> bool {
        let mut open: HashMap<u32, usize> = HashMap::new();
        for port in &self.ports {
            *open.entry(port.file.user()).or_default() += 1;
        }
        let own = open.get(&user).copied().unwrap_or(0);
        let most = open.into_iter().max_by_key(|(user, count)| (*count, *user));
        let Some((other, _)) = most.filter(|(_, count)| *count > own + 1) else {
            return false;
        };
        let ports = self.ports.iter().enumerate();
        let theirs = ports.filter(|(_, port)| port.file.user() == other);
        let idle = theirs.min_by_key(|(_, port)| port.busy);
        let Some((index, _)) = idle else {
            return false;
        };
        self.ports.remove(index);
        self.counters.left_out += 1;
        true
    }

    /// Returns whether the process that created this segment is dead.
    fn is_abandoned(&self, locks: &Locks, (directory, generation, id): SegmentKey) -> bool {
        let directory = self.directories.directories.get(&directory);
        let name = Name::Segment(generation, id).file_name();
        directory.is_some_and(|directory| locks.is_abandoned(&directory.path.join(name)))
    }
}

/// Returns whether a sample in this message may announce the nodes of its participant: such a
/// sample begins with the participant's GUID.
fn may_announce_nodes(message: &[u8]) -> bool {
    let Some(prefix) = message.get(8..20).and_then(|bytes| bytes.try_into().ok()) else {
        return false;
    };
    let participant = Guid::new(GuidPrefix(prefix), EntityId::PARTICIPANT).to_bytes();
    let begin = message.get(20..message.len().min(HEAD_BYTES));
    let mut guids = begin.unwrap_or_default().windows(participant.len());
    guids.any(|bytes| *bytes == participant)
}

#[cfg(test)]
mod tests;
