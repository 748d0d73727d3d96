//! Capture file or bag as a source: delivers packets at the requested pace, in short slices so that
//! the agent stays responsive.

mod bag;
mod player;

use std::collections::BTreeMap;
use std::io::IsTerminal as _;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{self, RecvTimeoutError};
use std::time::{Duration, Instant};

use ros2probe_bag::messages;
use ros2probe_message::MessageType;
use ros2probe_wire::frame::Link;
use ros2probe_wire::walk::Envelope;
use ros2probe_wire::{Expansion, Timestamp};
use tokio::sync::watch;

pub use self::bag::BagError;
use self::bag::{BagReader, Due};
use super::CaptureTime;
use crate::recording::TriggeredBag;
use crate::replay_pace::{Jump, Pace};
use ros2probe_api::recordings::BagTrigger;
use ros2probe_capture::frame_decoder::FrameDecoder;
use ros2probe_capture::pcap::{Captured, Pacer, PcapError, PcapReader, Speed, link_name};
use ros2probe_capture::reassembly::{Limits, Reassembly};
use ros2probe_capture::streams::Streams;
use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::Observer;

/// Interval of progress reports on a terminal.
const PROGRESS_INTERVAL: Duration = Duration::from_secs(1);
/// Minimum gap between packets that the replay skips in one step.
const MIN_SKIPPED_GAP: Duration = Duration::from_secs(3600);

/// Polling interval of requests while a replay is paused.
const PAUSE_POLL: Duration = Duration::from_millis(5);

/// Polling interval of requests while a client holds a replay.
const HELD_POLL: Duration = Duration::from_millis(50);

/// Creates a pause point and its control, which ends the pause.
#[must_use]
pub fn pause_at(at: Option<CaptureTime>) -> (PausePoint, ReplayControl) {
    let (resume, resumed) = mpsc::channel();
    let (reports, reached) = watch::channel(0);
    let pause = PausePoint {
        at,
        resumed,
        is_reported: false,
        reports,
    };
    (pause, ReplayControl { resume, reached })
}

/// Point at which a replay pauses.
#[derive(Debug)]
pub struct PausePoint {
    /// Time of the pause. `None` means the beginning.
    at: Option<CaptureTime>,
    /// Receives the time of the next pause; `None` resumes without another pause.
    resumed: mpsc::Receiver<Option<CaptureTime>>,
    is_reported: bool,
    /// Number of pauses so far.
    reports: watch::Sender<u64>,
}

/// Waits for the pauses of a replay, and ends them.
#[derive(Debug)]
pub struct ReplayControl {
    resume: mpsc::Sender<Option<CaptureTime>>,
    reached: watch::Receiver<u64>,
}

impl ReplayControl {
    /// Returns when the replay pauses, or has ended earlier.
    pub async fn paused(&mut self) {
        let _ = self.reached.wait_for(|pauses| *pauses > 0).await;
    }

    /// Resumes the replay.
    pub fn resume(&self) {
        let _ = self.resume.send(None);
    }

    /// Resumes a paused replay and waits for its pause at this time. Returns `false` if the replay
    /// has ended.
    pub async fn advance(&self, to: CaptureTime) -> bool {
        let mut reached = self.reached.clone();
        let before = *reached.borrow();
        if self.resume.send(Some(to)).is_err() {
            return false;
        }
        reached.wait_for(|pauses| *pauses > before).await.is_ok()
    }
}

/// Address of the messages of a bag: that of discovery, IPv4-mapped (RTPS 2.5, 9.6.2.4).
const MULTICAST_ADDRESS: [u8; 16] = [0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0xff, 0xff, 239, 255, 0, 1];

/// A capture or a bag cannot be replayed further.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// The capture cannot be read.
    #[error(transparent)]
    Capture(#[from] PcapError),
    /// The bag cannot be read.
    #[error(transparent)]
    Bag(#[from] BagError),
}

/// What is replayed.
enum Packets {
    Capture(PcapReader),
    Bag(BagReader),
}

impl Packets {
    /// Opens a capture or a bag.
    fn open(path: &Path, expansion: Expansion) -> Result<Self, ReplayError> {
        if messages::is_bag(path) {
            messages::check(path).map_err(BagError::from)?;
            return Ok(Self::Bag(BagReader::open(path, expansion)));
        }
        let reader = PcapReader::open(path, expansion)?;
        if let Some(link) = reader.link().filter(|link| !link.is_supported()) {
            return Err(PcapError::UnsupportedLink { link }.into());
        }
        Ok(Self::Capture(reader))
    }
}

/// A capture or a bag in replay.
pub struct Replay {
    path: PathBuf,
    expansion: Expansion,
    limits: Limits,
    /// What triggered the bag of a snapshot, and its time.
    incident: Option<(Timestamp, BagTrigger)>,
    file: Packets,
    decoder: FrameDecoder,
    pacer: Pacer,
    /// Speed at the start, and now.
    started_speed: Speed,
    speed: Speed,
    /// Whether a client holds it.
    is_held: bool,
    /// Time to which it goes without waiting.
    target: Option<Timestamp>,
    /// Packet that is read but not due yet.
    waiting: Option<Waiting>,
    clock: Timestamp,
    packets: u64,
    bytes: u64,
    /// Packets of unsupported link layers, by number.
    unsupported: BTreeMap<u16, u64>,
    began: Option<Timestamp>,
    progress: Option<Instant>,
    until: Option<CaptureTime>,
    pause: Option<PausePoint>,
    /// Whether the replay ended before the end of the capture.
    cut: bool,
    finished: bool,
}

/// A packet that was read but is not due yet.
struct Waiting {
    time: Timestamp,
    layer: Layer,
    bytes: Vec<u8>,
}

/// The layer at which the bytes of a packet begin.
#[derive(Clone, Copy)]
enum Layer {
    /// A captured frame.
    Frame {
        link: Link,
        interface: u32,
        length: u32,
    },
    /// A datagram at this port, with a message of a bag.
    Datagram { port: u16 },
}

impl Replay {
    /// Opens a capture, or a bag in either storage of rosbag2.
    ///
    /// # Errors
    ///
    /// Fails if the file cannot be read, is neither, or has an unsupported link layer.
    pub fn open(
        path: &Path,
        expansion: Expansion,
        speed: Speed,
        limits: Limits,
    ) -> Result<Self, ReplayError> {
        Ok(Self {
            path: path.to_owned(),
            expansion,
            limits,
            incident: TriggeredBag::read(path).and_then(|bag| {
                let time: jiff::Timestamp = bag.trigger.time.parse().ok()?;
                let time = u64::try_from(time.as_nanosecond()).ok()?;
                Some((Timestamp(time), bag.trigger))
            }),
            file: Packets::open(path, expansion)?,
            decoder: FrameDecoder::new(limits),
            pacer: Pacer::new(speed),
            started_speed: speed,
            speed,
            is_held: false,
            target: None,
            waiting: None,
            clock: Timestamp::default(),
            packets: 0,
            bytes: 0,
            unsupported: BTreeMap::new(),
            began: None,
            progress: std::io::stderr().is_terminal().then(Instant::now),
            until: None,
            pause: None,
            cut: false,
            finished: false,
        })
    }

    /// Begins again, at the speed of now.
    ///
    /// # Errors
    ///
    /// Fails if the file cannot be opened again. The replay then stays as it is.
    pub(super) fn begin_again(&mut self) -> Result<(), ReplayError> {
        self.file = Packets::open(&self.path, self.expansion)?;
        self.decoder = FrameDecoder::new(self.limits);
        self.pacer = Pacer::new(self.speed);
        (self.waiting, self.clock) = (None, self.began.unwrap_or_default());
        (self.packets, self.bytes) = (0, 0);
        self.unsupported.clear();
        (self.cut, self.finished) = (false, false);
        Ok(())
    }

    /// Makes the replay end at this time, as if the capture ended there.
    #[must_use]
    pub fn ending_at(self, until: Option<CaptureTime>) -> Self {
        Self { until, ..self }
    }

    /// Disables progress reports, for commands that use the terminal.
    #[must_use]
    pub fn without_progress(self) -> Self {
        Self {
            progress: None,
            ..self
        }
    }

    /// Makes the replay pause at this point until it is resumed.
    #[must_use]
    pub fn pausing_at(self, pause: PausePoint) -> Self {
        Self {
            pause: Some(pause),
            ..self
        }
    }

    /// Goes on as clients request it.
    pub fn follow(&mut self, pace: &Pace) {
        let is_held = pace.is_paused();
        let speed = match pace.jump {
            Some(_) => Speed::Max,
            None => pace.speed.unwrap_or(self.started_speed),
        };
        self.target = match pace.jump {
            Some(Jump::To(time)) => Some(time),
            Some(Jump::NextEvent) | None => None,
        };
        if (speed, is_held) != (self.speed, self.is_held) {
            (self.speed, self.is_held) = (speed, is_held);
            self.pacer = match self.began {
                Some(_) => Pacer::from(speed, self.clock, Instant::now()),
                None => Pacer::new(speed),
            };
        }
    }

    /// Returns whether the time was reached to which it goes without waiting.
    #[must_use]
    pub fn has_reached_target(&self) -> bool {
        self.finished || self.target.is_some_and(|target| self.clock >= target)
    }

    /// Returns what triggered the bag of a snapshot, and its time.
    #[must_use]
    pub const fn incident(&self) -> Option<&(Timestamp, BagTrigger)> {
        self.incident.as_ref()
    }

    /// Returns the speed at the start.
    #[must_use]
    pub const fn started_speed(&self) -> Speed {
        self.started_speed
    }

    /// Delivers packets that are due within `timeout`. Returns earlier at the end of the capture,
    /// before a packet at or after `ending_at`, and when the model has much output.
    ///
    /// # Errors
    ///
    /// Fails if the rest cannot be read; earlier packets have been delivered.
    pub fn poll(
        &mut self,
        timeout: Duration,
        until: Option<Timestamp>,
        observer: &mut Observer,
    ) -> Result<(), ReplayError> {
        let end = Instant::now() + timeout;
        let until = until.into_iter().chain(self.target).min();
        if self.is_held && self.began.is_some() {
            std::thread::sleep(timeout.min(HELD_POLL));
            return Ok(());
        }
        while !self.finished {
            let now = Instant::now();
            if now >= end || observer.has_much_output() {
                break;
            }
            if let Some(waiting) = &self.waiting {
                let (time, beginning) = (waiting.time, self.began.unwrap_or_default());
                let pause = self.pause.as_ref();
                if pause.is_some_and(|pause| pause.is_at_or_after(time, beginning)) {
                    self.wait();
                    break;
                }
                let last = self.until.map(|moment| moment.in_capture(beginning));
                let last = last.filter(|last| *last < time);
                let time = last.unwrap_or(time);
                let delay = self.pacer.delay(waiting.time, now);
                let later = until.filter(|until| time > *until);
                if let Some(until) = later
                    && delay.is_zero()
                {
                    let is_far = time - until > MIN_SKIPPED_GAP;
                    let time = if is_far { time.0 - 1 } else { until.0 };
                    self.clock = self.clock.max(Timestamp(time));
                    break;
                }
                if last.is_some() {
                    self.clock = self.clock.max(time);
                    (self.cut, self.finished) = (true, true);
                    break;
                }
                let slice = delay.min(end.saturating_duration_since(now));
                let slice = slice.min(until.map_or(slice, |_| step(self.speed)));
                if !slice.is_zero() {
                    std::thread::sleep(slice);
                }
                if slice < delay {
                    let clock = before(waiting.time, delay - slice, self.speed);
                    self.clock = until
                        .map_or(clock, |until| clock.min(until))
                        .max(self.clock);
                    break;
                }
                if later.is_some() {
                    continue;
                }
                self.clock = self.clock.max(waiting.time);
                deliver(&mut self.decoder, waiting, self.clock, observer);
            }
            self.next()?;
        }
        self.show_progress();
        Ok(())
    }

    /// Reads one packet ahead, into the memory of the previous one.
    fn next(&mut self) -> Result<(), ReplayError> {
        let memory = self.waiting.take().map(|waiting| waiting.bytes);
        let memory = memory.unwrap_or_default();
        let next = match &mut self.file {
            Packets::Capture(reader) => next_frame(reader, memory).map_err(ReplayError::from),
            Packets::Bag(reader) => next_message(reader, memory).map_err(ReplayError::from),
        };
        let waiting = next.inspect_err(|_| self.finished = true)?;
        let Some(waiting) = waiting else {
            self.finished = true;
            self.report_skipped();
            return Ok(self.is_readable()?);
        };
        self.packets += 1;
        self.bytes += waiting.bytes.len() as u64;
        if let Layer::Frame { link, .. } = waiting.layer
            && !link.is_supported()
        {
            *self.unsupported.entry(link.0).or_default() += 1;
        }
        if self.began.is_none() {
            (self.began, self.clock) = (Some(waiting.time), waiting.time);
        }
        self.waiting = Some(waiting);
        Ok(())
    }

    /// Logs what was not replayed.
    fn report_skipped(&self) {
        for (link, packets) in &self.unsupported {
            let link_type = link_name(Link(*link));
            tracing::warn!(
                link_type,
                packets,
                "packets of an unsupported link type skipped"
            );
        }
        for fault in self.faults() {
            tracing::warn!("{fault}");
        }
    }

    /// Fails if every packet has an unsupported link layer.
    fn is_readable(&self) -> Result<(), PcapError> {
        match self.unsupported.first_key_value() {
            Some((link, _)) if self.unsupported.values().sum::<u64>() == self.packets => {
                let link = Link(*link);
                Err(PcapError::UnsupportedLink { link })
            }
            _ => Ok(()),
        }
    }

    /// Waits briefly for the end of the pause. New requests are handled before the next packets.
    fn wait(&mut self) {
        let Some(pause) = &mut self.pause else { return };
        if pause.is_reported {
            match pause.resumed.recv_timeout(PAUSE_POLL) {
                Ok(Some(next)) => (pause.at, pause.is_reported) = (Some(next), false),
                Ok(None) | Err(RecvTimeoutError::Disconnected) => {
                    self.pause = None;
                    return;
                }
                Err(RecvTimeoutError::Timeout) => return,
            }
        }
        let beginning = self.began.unwrap_or_default();
        let time = self.waiting.as_ref().map(|waiting| waiting.time);
        if time.is_some_and(|time| pause.is_at_or_after(time, beginning)) {
            let begins = pause.at.map(|moment| moment.in_capture(beginning));
            self.clock = self.clock.max(begins.unwrap_or_default());
        }
    }

    /// Returns whether the pause is reached and not reported yet.
    #[must_use]
    pub fn reached_pause(&self) -> bool {
        let time = self.waiting.as_ref().map(|waiting| waiting.time);
        let beginning = self.began.unwrap_or_default();
        time.zip(self.pause.as_ref()).is_some_and(|(time, pause)| {
            pause.is_at_or_after(time, beginning) && !pause.is_reported
        })
    }

    /// Returns whether the replay is paused and the pause was reported.
    #[must_use]
    pub fn is_paused(&self) -> bool {
        self.pause.as_ref().is_some_and(|pause| pause.is_reported)
    }

    /// Reports the pause to [`ReplayControl`].
    pub fn report_pause(&mut self) {
        if let Some(pause) = &mut self.pause {
            pause.is_reported = true;
            pause.reports.send_modify(|pauses| *pauses += 1);
        }
    }

    /// Returns the time at which the replay ended, if that was before the end of the capture.
    #[must_use]
    pub fn cut(&self) -> Option<Timestamp> {
        self.cut.then_some(self.clock)
    }

    /// Returns the clock of the capture: the time of its last packet, which advances during the
    /// wait for the next one.
    #[must_use]
    pub const fn clock(&self) -> Timestamp {
        self.clock
    }

    /// Returns whether all packets were delivered.
    #[must_use]
    pub const fn is_finished(&self) -> bool {
        self.finished
    }

    /// Returns the start of the capture; `None` until its first packet is read.
    #[must_use]
    pub const fn began(&self) -> Option<Timestamp> {
        self.began
    }

    /// Returns the fraction of the file that was read, 0 to 1; `None` if unknown.
    #[must_use]
    pub fn part_read(&self) -> Option<f64> {
        if self.finished {
            return Some(1.0);
        }
        match &self.file {
            Packets::Capture(reader) => reader.part_read(),
            Packets::Bag(reader) => reader.part_read(),
        }
    }

    /// Returns the parts of a bag that were not replayed, as lines for people. They are complete at
    /// the end.
    #[must_use]
    pub fn faults(&self) -> Vec<String> {
        match &self.file {
            Packets::Capture(_) => Vec::new(),
            Packets::Bag(reader) => reader.faults(),
        }
    }

    /// Returns definitions of types in a bag that were not returned yet.
    pub(super) fn take_definitions(&mut self) -> Vec<MessageType> {
        match &mut self.file {
            Packets::Capture(_) => Vec::new(),
            Packets::Bag(reader) => reader.take_definitions(),
        }
    }

    /// Returns the number of packets and of their bytes so far.
    #[must_use]
    pub const fn progress(&self) -> (u64, u64) {
        (self.packets, self.bytes)
    }

    /// Returns the number of packets of unsupported link layers, by the layer's number.
    #[must_use]
    pub const fn unsupported(&self) -> &BTreeMap<u16, u64> {
        &self.unsupported
    }

    /// Returns the connections of Zenoh, for their counters.
    #[must_use]
    pub const fn streams(&self) -> &Streams {
        self.decoder.streams()
    }

    /// Returns the reassembly of fragments, for its counters.
    #[must_use]
    pub const fn reassembly(&self) -> &Reassembly {
        self.decoder.reassembly()
    }

    fn show_progress(&mut self) {
        let Some(last) = self.progress else { return };
        if self.finished {
            eprint!("\r\x1b[K");
            self.progress = None;
        } else if last.elapsed() >= PROGRESS_INTERVAL {
            self.progress = Some(Instant::now());
            let seconds =
                self.clock.nanoseconds_since(self.began.unwrap_or_default()) / 1_000_000_000;
            let (packets, whole) = match self.file {
                Packets::Capture(_) => ("packets", "capture"),
                Packets::Bag(_) => ("messages", "bag"),
            };
            eprint!(
                "\rreplayed {} {packets}, {seconds} s of the {whole}\x1b[K",
                self.packets
            );
        }
    }
}

/// Reads a frame of a capture.
fn next_frame(reader: &mut PcapReader, mut memory: Vec<u8>) -> Result<Option<Waiting>, PcapError> {
    let Some(captured) = reader.next_packet()? else {
        return Ok(None);
    };
    memory.clear();
    memory.extend_from_slice(captured.bytes);
    Ok(Some(Waiting {
        time: captured.time,
        layer: Layer::Frame {
            link: captured.link,
            interface: captured.interface,
            length: captured.length,
        },
        bytes: memory,
    }))
}

/// Reads a message of a bag.
fn next_message(reader: &mut BagReader, memory: Vec<u8>) -> Result<Option<Waiting>, BagError> {
    let due = reader.next(memory)?;
    Ok(due.map(|Due { time, port, bytes }| Waiting {
        time,
        layer: Layer::Datagram { port },
        bytes,
    }))
}

/// Delivers a packet that is due at `clock`.
fn deliver(
    decoder: &mut FrameDecoder,
    waiting: &Waiting,
    clock: Timestamp,
    observer: &mut Observer,
) {
    let Waiting { time, bytes, .. } = waiting;
    match waiting.layer {
        Layer::Frame {
            link,
            interface,
            length,
        } => {
            let captured = Captured {
                time: *time,
                link,
                interface,
                bytes,
                length,
            };
            decoder.packet(&captured, observer);
        }
        Layer::Datagram { port } => {
            observer.input(Input::Time(clock));
            let envelope = Envelope {
                time: time.0,
                destination: MULTICAST_ADDRESS,
                destination_port: port,
                ..Envelope::default()
            };
            observer.input(Input::Datagram {
                envelope: &envelope,
                payload: bytes,
                handover: None,
            });
        }
    }
}

/// Returns the real duration of a tenth of a second of the capture.
fn step(speed: Speed) -> Duration {
    match speed {
        Speed::Max => Duration::ZERO,
        Speed::Times(factor) => Duration::try_from_secs_f64(0.1 / factor).unwrap_or(Duration::MAX),
    }
}

impl PausePoint {
    fn is_at_or_after(&self, time: Timestamp, beginning: Timestamp) -> bool {
        self.at.is_none_or(|at| at.in_capture(beginning) <= time)
    }
}

/// Returns the time of the capture at which the packet of `time` is still `delay` away.
fn before(time: Timestamp, delay: Duration, speed: Speed) -> Timestamp {
    let Speed::Times(factor) = speed else {
        return time;
    };
    let distance =
        Duration::try_from_secs_f64(delay.as_secs_f64() * factor).unwrap_or(Duration::MAX);
    time - distance
}
