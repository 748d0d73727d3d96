//! Arbitrary forged traffic, as fast as one thread can send it.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::JoinHandle;

use anyhow::{Result, anyhow};

use super::{Carrier, SAMPLES_WRITER, Talker, data, introduce};

/// Number of different datagrams of a storm. Each is sent with changing GUIDs.
const TEMPLATES: usize = 3000;
const PREFIX: std::ops::Range<usize> = 8..20;

/// A thread that sends until [`Storm::end`].
pub struct Storm {
    stop: Arc<AtomicBool>,
    sent: Arc<AtomicU64>,
    thread: JoinHandle<()>,
}

impl Storm {
    /// Sends datagrams made by `forge`, each time with a new GUID prefix.
    pub fn start(carrier: impl Carrier + Send + 'static, forge: fn(&mut Dice) -> Vec<u8>) -> Storm {
        let mut dice = Dice(0x9e37_79b9_7f4a_7c15);
        let moulds: Vec<PacketTemplate> = (0..TEMPLATES)
            .map(|_| PacketTemplate::new(forge(&mut dice)))
            .collect();
        let mut next = (0..moulds.len()).cycle();
        Storm::run(carrier, move |bytes| {
            let mould = next.next().unwrap_or(0);
            moulds[mould].instantiate(&mut dice, bytes);
        })
    }

    /// Sends the samples of one announced writer as fast as possible.
    pub fn of_samples(mut carrier: impl Carrier + Send + 'static, topic: &str) -> Result<Storm> {
        const NUMBER: std::ops::Range<usize> = 40..44;
        let mut talker = Talker::new(1, topic);
        introduce(&talker, &mut carrier)?;
        let sample = talker.sample(320);
        let mut number = 0_u32;
        Ok(Storm::run(carrier, move |bytes| {
            number += 1;
            bytes.clone_from(&sample);
            bytes[NUMBER].copy_from_slice(&number.to_le_bytes());
        }))
    }

    /// Repeatedly announces `participants` participants with `endpoints` endpoints each, every
    /// endpoint on a separate topic.
    pub fn of_a_crowd(
        carrier: impl Carrier + Send + 'static,
        participants: u32,
        endpoints: u8,
    ) -> Storm {
        let mut crowd = Vec::new();
        for number in 0..participants {
            let talker = Talker::new(number, "/crowd");
            let mut bytes = talker.participant();
            for endpoint in 0..endpoints {
                let topic = format!("rt/crowd/{number}/{}/{endpoint}", "x".repeat(80));
                let entity = [0, 1, endpoint, if endpoint % 2 == 0 { 3 } else { 4 }];
                let kind = "sensor_msgs::msg::dds_::PointCloud2_";
                let message = match endpoint % 2 {
                    0 => talker.publication(entity, &topic, kind, endpoint.into()),
                    _ => talker.subscription(entity, &topic, kind, endpoint.into()),
                };
                bytes.extend_from_slice(&message[PREFIX.end..]);
            }
            crowd.push(bytes);
            crowd.push(talker.entities(&format!("node_{number}_{}", "y".repeat(80))));
        }
        let mut next = (0..crowd.len()).cycle();
        Storm::run(carrier, move |bytes| {
            bytes.clone_from(&crowd[next.next().unwrap_or(0)]);
        })
    }

    /// Announces the same participants repeatedly, each time at other addresses.
    pub fn of_addresses(carrier: impl Carrier + Send + 'static) -> Storm {
        const UDP_V4: u8 = 1;
        let mut dice = Dice::new(7);
        let talkers: Vec<_> = (0..64)
            .map(|number| Talker::new(2_000_000 + number, "/moving"))
            .collect();
        let mut next = (0..talkers.len()).cycle();
        Storm::run(carrier, move |bytes| {
            let mut locators = [[0; 24]; 4];
            for locator in &mut locators {
                locator[0] = UDP_V4;
                locator[4..8].copy_from_slice(&(dice.pick(1 << 16) as u32).to_le_bytes());
                locator[20..].copy_from_slice(&dice.bytes(4));
            }
            *bytes = talkers[next.next().unwrap_or(0)].participant_at(&locators);
        })
    }

    /// Announces writers of large messages: half of them send whole messages of 50 kB, the others 1
    /// % of the fragments of 4 MB messages.
    pub fn of_large_samples(mut carrier: impl Carrier + Send + 'static) -> Result<Storm> {
        const WRITERS: u32 = 32;
        let mut talkers = Vec::new();
        for number in 0..WRITERS {
            let talker = Talker::new(1_000_000 + number, &format!("/large_{number}"));
            for message in talker.introduction("large") {
                carrier.send(&message)?;
            }
            talkers.push(talker);
        }
        let mut turn = 0;
        Ok(Storm::run(carrier, move |bytes| {
            turn += 1;
            let talker = &mut talkers[turn % WRITERS as usize];
            let whole = talker.sample(50_000);
            if turn.is_multiple_of(2) {
                *bytes = whole;
                return;
            }
            let mut body = vec![0, 0, 28, 0, 0, 0, 0, 0];
            body.extend_from_slice(&SAMPLES_WRITER);
            body.extend_from_slice(&[0; 4]);
            body.extend_from_slice(&talker.sent().to_le_bytes());
            // First fragment, number of fragments, their size, size of the sample.
            body.extend_from_slice(&1_u32.to_le_bytes());
            body.extend_from_slice(&1_u16.to_le_bytes());
            body.extend_from_slice(&40_000_u16.to_le_bytes());
            body.extend_from_slice(&4_000_000_u32.to_le_bytes());
            body.resize(body.len() + 40_000, 0x44);
            *bytes = talker.header();
            submessage(bytes, 0x16, &body);
        }))
    }

    fn run(
        mut carrier: impl Carrier + Send + 'static,
        mut next: impl FnMut(&mut Vec<u8>) + Send + 'static,
    ) -> Storm {
        let (stop, sent) = (Arc::<AtomicBool>::default(), Arc::<AtomicU64>::default());
        let (stopped, counter) = (stop.clone(), sent.clone());
        let thread = std::thread::spawn(move || {
            let mut bytes = Vec::new();
            while !stopped.load(Ordering::Relaxed) {
                next(&mut bytes);
                // The storm continues if a queue on the path is full.
                let _ = carrier.send(&bytes);
                counter.fetch_add(1, Ordering::Relaxed);
            }
        });
        Storm { stop, sent, thread }
    }

    /// Returns the number of datagrams sent so far.
    pub fn sent(&self) -> u64 {
        self.sent.load(Ordering::Relaxed)
    }

    /// Stops sending. Returns the number of datagrams sent.
    pub fn end(self) -> Result<u64> {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.join().map_err(|_| anyhow!("the storm died"))?;
        Ok(self.sent.load(Ordering::Relaxed))
    }
}

/// A datagram and the offsets of its sender's GUID prefix.
struct PacketTemplate {
    bytes: Vec<u8>,
    places: Vec<usize>,
}

impl PacketTemplate {
    fn new(bytes: Vec<u8>) -> PacketTemplate {
        let prefix = bytes[PREFIX].to_vec();
        let places = (0..=bytes.len() - PREFIX.len())
            .filter(|place| bytes[*place..].starts_with(&prefix))
            .collect();
        PacketTemplate { bytes, places }
    }

    fn instantiate(&self, dice: &mut Dice, bytes: &mut Vec<u8>) {
        bytes.clone_from(&self.bytes);
        let random = [dice.roll().to_ne_bytes(), dice.roll().to_ne_bytes()].concat();
        for place in &self.places {
            bytes[*place..place + PREFIX.len()].copy_from_slice(&random[..PREFIX.len()]);
        }
    }
}

/// Reproducible random numbers (xorshift64).
pub struct Dice(u64);

impl Dice {
    /// Creates a generator; the same seed gives the same numbers. The seed must not be zero.
    pub fn new(seed: u64) -> Dice {
        Dice(seed)
    }

    pub fn roll(&mut self) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0
    }

    /// Returns a number from 0 to `sides` - 1.
    pub fn pick(&mut self, sides: u64) -> u64 {
        self.roll() % sides
    }

    /// Returns an extreme value or a random one.
    fn number(&mut self) -> u64 {
        match self.pick(8) {
            0 => 0,
            1 => u64::MAX,
            2 => i64::MAX.cast_unsigned(),
            3 => 1 << 63,
            4 => u64::from(u32::MAX),
            5 => 1,
            _ => self.roll(),
        }
    }

    fn bytes(&mut self, count: usize) -> Vec<u8> {
        let words = (0..count.div_ceil(8)).flat_map(|_| self.roll().to_ne_bytes());
        words.take(count).collect()
    }
}

/// Returns a datagram with invented content.
pub fn forgery(dice: &mut Dice) -> Vec<u8> {
    let talker = random_participant(dice);
    match dice.pick(10) {
        0 | 1 => participant_and_endpoints(dice, &talker),
        2 => talker.entities(&name(dice)),
        3 | 4 => {
            let payload = vec![0x33; 320];
            talker.message([0, 0, 2, 3], dice.roll() as u32, &payload)
        }
        5 => fragment(dice, &talker),
        6 => sequence_set(dice, &talker, 0x08),
        7 => heartbeat(dice, &talker),
        8 => lying_length(dice, &talker),
        _ => {
            let length = dice.pick(1200) as usize;
            [talker.header(), dice.bytes(length)].concat()
        }
    }
}

/// Returns a datagram in which a participant announces itself, a writer and a reader.
fn participant_and_endpoints(dice: &mut Dice, talker: &Talker) -> Vec<u8> {
    let mut bytes = talker.participant();
    let topic = format!("rt/{}", name(dice));
    for (number, entity) in [(1, 3), (2, 4)] {
        let [high, low, ..] = dice.roll().to_ne_bytes();
        let endpoint = [0, high, low, entity];
        let message = if entity == 3 {
            talker.publication(endpoint, &topic, &name(dice), number)
        } else {
            talker.subscription(endpoint, &topic, &name(dice), number)
        };
        bytes.extend_from_slice(&message[20..]);
    }
    bytes
}

/// Returns a name that would break a metrics page if it were not escaped.
fn name(dice: &mut Dice) -> String {
    match dice.pick(24) {
        0 => "quote\"}\n# HELP injected 1\ninjected{a=\"b\"} 1\n".to_owned(),
        1 => "long/".repeat(2000),
        2 => "back\\slash\\\r\n\0\u{7f}\u{1b}[2J".to_owned(),
        3 => format!("ünïcödé_{}", dice.pick(1 << 20)),
        4 => String::new(),
        _ => format!("topic_{}", dice.roll()),
    }
}

/// Returns a DATA_FRAG that claims any size, up to 4 GB.
fn fragment(dice: &mut Dice, talker: &Talker) -> Vec<u8> {
    let mut bytes = talker.header();
    let number = dice.number();
    let mut body = vec![0, 0, 28, 0, 0, 0, 0, 0, 0, 0, 2, 3];
    body.extend_from_slice(&((number >> 32) as u32).to_le_bytes());
    body.extend_from_slice(&(number as u32).to_le_bytes());
    body.extend_from_slice(&(dice.number() as u32).to_le_bytes());
    body.extend_from_slice(&(dice.number() as u16).to_le_bytes());
    body.extend_from_slice(&(dice.number() as u16).to_le_bytes());
    body.extend_from_slice(&(dice.number() as u32).to_le_bytes());
    body.extend_from_slice(&dice.bytes(400));
    submessage(&mut bytes, 0x16, &body);
    bytes
}

/// Returns a GAP or ACKNACK with a set of up to 256 bits, or more.
fn sequence_set(dice: &mut Dice, talker: &Talker, id: u8) -> Vec<u8> {
    let mut bytes = talker.header();
    let mut body = vec![0, 0, 0, 0, 0, 0, 2, 3];
    for _ in 0..2 {
        let number = dice.number();
        body.extend_from_slice(&((number >> 32) as u32).to_le_bytes());
        body.extend_from_slice(&(number as u32).to_le_bytes());
    }
    let bits = [256, 0, 255, 257, u32::MAX][dice.pick(5) as usize];
    body.extend_from_slice(&bits.to_le_bytes());
    body.extend_from_slice(&[0xff; 32]);
    submessage(&mut bytes, id, &body);
    bytes
}

fn heartbeat(dice: &mut Dice, talker: &Talker) -> Vec<u8> {
    let mut bytes = talker.header();
    let mut body = vec![0, 0, 0, 0, 0, 0, 2, 3];
    for _ in 0..2 {
        let number = dice.number();
        body.extend_from_slice(&((number >> 32) as u32).to_le_bytes());
        body.extend_from_slice(&(number as u32).to_le_bytes());
    }
    body.extend_from_slice(&(dice.roll() as u32).to_le_bytes());
    submessage(&mut bytes, 0x07, &body);
    bytes
}

/// Returns a datagram with random bytes, which falsify length fields of submessages, parameters and
/// strings.
fn lying_length(dice: &mut Dice, talker: &Talker) -> Vec<u8> {
    let mut bytes = match dice.pick(3) {
        0 => talker.participant(),
        1 => talker.publication([0, 0, 2, 3], "rt/lie", "lie", 1),
        _ => {
            let mut bytes = talker.header();
            for number in 0..40 {
                data(&mut bytes, [0, 0, 2, 3], number, &[0; 8]);
            }
            bytes
        }
    };
    for _ in 0..1 + dice.pick(4) {
        let place = 20 + dice.pick(bytes.len() as u64 - 20) as usize;
        bytes[place] = dice.roll() as u8;
    }
    let keep = 20 + dice.pick(bytes.len() as u64 - 20) as usize;
    if dice.pick(2) == 0 {
        bytes.truncate(keep);
    }
    bytes
}

fn submessage(bytes: &mut Vec<u8>, id: u8, body: &[u8]) {
    bytes.extend_from_slice(&[id, 1]);
    bytes.extend_from_slice(&u16::try_from(body.len()).unwrap_or(0).to_le_bytes());
    bytes.extend_from_slice(body);
}

/// Returns a participant with a random GUID.
fn random_participant(dice: &mut Dice) -> Talker {
    let mut talker = Talker::new(0, "/forged");
    let random = [dice.roll().to_ne_bytes(), dice.roll().to_ne_bytes()].concat();
    talker.prefix.copy_from_slice(&random[..12]);
    talker
}
