//! Who forges messages with every field another each time fills every table, and none beyond its
//! cap.
#![allow(
    clippy::unwrap_used,
    clippy::indexing_slicing,
    unsafe_code,
    reason = "a test that meets the unexpected has failed; an allocator that counts is unsafe code"
)]

#[path = "model/forge.rs"]
#[allow(dead_code, reason = "shared with other tests")]
mod forge;

use std::alloc::{GlobalAlloc, Layout, System};
use std::collections::BTreeMap;
use std::net::{Ipv4Addr, SocketAddrV4};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};

use forge::{Message, SEDP_READERS, SEDP_WRITERS, SPDP};
use ros2probe::config::{Watch, Watchlist};
use ros2probe::model::observer::{Observer, Settings};
use ros2probe::model::selection::{Depth, Selection, Wish};
use ros2probe_wire::walk::Envelope;
use ros2probe_wire::{EntityId, Guid, GuidPrefix, Timestamp};

const START: u64 = 1_700_000_000_000_000_000;
const MESSAGES: u64 = 200_000;
const DISCOVERY_INFO: EntityId = EntityId([0, 0, 2, 3]);
const SAMPLES: EntityId = EntityId([0, 0, 3, 3]);

struct Counting;

static ALLOCATED: AtomicUsize = AtomicUsize::new(0);

// SAFETY: the system's allocator does the work.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ALLOCATED.fetch_add(layout.size(), Ordering::Relaxed);
        // SAFETY: as the caller warrants.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        ALLOCATED.fetch_sub(layout.size(), Ordering::Relaxed);
        // SAFETY: as the caller warrants.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static COUNTING: Counting = Counting;

/// Held while memory is measured: tests may run beside each other in one process.
static ALONE: Mutex<()> = Mutex::new(());

/// Repeatable random numbers (xorshift64).
struct Dice(u64);

impl Dice {
    fn roll(&mut self) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0
    }

    fn pick(&mut self, sides: u64) -> u64 {
        (self.roll() >> 20) % sides
    }

    fn prefix(&mut self) -> GuidPrefix {
        // Every other one is of a few that are there already.
        let number = match self.pick(2) {
            0 => self.pick(40),
            _ => self.roll(),
        };
        let mut prefix = [7; 12];
        prefix[4..].copy_from_slice(&number.to_be_bytes());
        GuidPrefix(prefix)
    }

    fn locators(&mut self) -> Vec<SocketAddrV4> {
        let any = (0..20).map(|_| self.roll());
        any.map(|bits| SocketAddrV4::new(Ipv4Addr::from(bits as u32 | 1), (bits >> 40) as u16 | 1))
            .collect()
    }

    fn number(&mut self) -> u64 {
        match self.pick(4) {
            0 => self.roll() >> 2,
            1 => 1 << self.pick(62),
            _ => 1 + self.pick(5000),
        }
    }

    fn name(&mut self) -> String {
        format!(
            "rt/{:x}/{}",
            self.roll(),
            "x".repeat(self.pick(200) as usize)
        )
    }
}

fn words(number: u64) -> [u8; 8] {
    let high = ((number >> 32) as u32).to_le_bytes();
    let low = (number as u32).to_le_bytes();
    [high, low].concat().try_into().unwrap()
}

/// HEARTBEAT, GAP or ACKNACK of any numbers.
fn control(dice: &mut Dice, id: u8) -> Vec<u8> {
    let [_, a, b, c, ..] = dice.roll().to_ne_bytes();
    let reader = EntityId([a, b, c, 4]);
    let mut body = [reader.0, SAMPLES.0].concat();
    body.extend_from_slice(&words(dice.number()));
    if id != 0x06 {
        body.extend_from_slice(&words(dice.number()));
    }
    if id != 0x07 {
        body.extend_from_slice(&256_u32.to_le_bytes());
        body.extend((0..4).flat_map(|_| dice.roll().to_ne_bytes()));
    }
    body.extend_from_slice(&(dice.roll() as u32).to_le_bytes());
    body
}

fn forged(dice: &mut Dice) -> Vec<u8> {
    let prefix = dice.prefix();
    let message = Message::from(prefix);
    match dice.pick(12) {
        0 | 1 => {
            let payload =
                forge::participant_at(prefix, 100, Some(dice.roll() as u32), &dice.locators());
            message.data(SPDP, dice.number(), &payload)
        }
        kind @ (2 | 3) => {
            let (by, last) = [(SEDP_WRITERS, 3), (SEDP_READERS, 4)][kind as usize - 2];
            let [_, a, b, c, ..] = dice.roll().to_ne_bytes();
            let guid = Guid::new(prefix, EntityId([a, b, c, last]));
            let (topic, partition) = (dice.name(), "p".repeat(dice.pick(250) as usize));
            let text = [
                &(partition.len() as u32 + 1).to_le_bytes()[..],
                partition.as_bytes(),
                b"\0",
            ];
            let partitions = [&1_u32.to_le_bytes()[..], &text.concat()].concat();
            let others: [(u16, &[u8]); 1] = [(0x29, &partitions)];
            let payload = forge::endpoint_with(guid, &topic, &dice.name(), &others);
            message.data(by, dice.number(), &payload)
        }
        4 => {
            let guid = Guid::new(prefix, SAMPLES);
            let payload = forge::endpoint(guid, "rt/known", "std_msgs::msg::dds_::String_", true);
            message.data(SEDP_WRITERS, dice.number(), &payload)
        }
        5 => {
            let names: Vec<_> = (0..dice.pick(60))
                .map(|_| format!("n{:x}", dice.roll()))
                .collect();
            let mut guid = || Guid::new(prefix, EntityId([0, 0, dice.roll() as u8, 3]));
            let mut nodes = Vec::new();
            for name in &names {
                nodes.push(("/somewhere", name.as_str(), guid()));
            }
            let payload = forge::entities(prefix, 24, &nodes);
            message.data(DISCOVERY_INFO, dice.number(), &payload)
        }
        6 | 7 => {
            let number = dice.number();
            message.info_ts(START + dice.pick(1 << 60)).data(
                SAMPLES,
                number,
                &[0, 1, 0, 0, 5, 5, 5, 5],
            )
        }
        8 => {
            let size = 100 + dice.pick(60_000) as usize;
            let payload = vec![5; size];
            message.fragment(SAMPLES, dice.number(), 1, 64, &payload)
        }
        9 => message.submessage(0x07, 1, &control(dice, 0x07)),
        10 => message.submessage(0x08, 1, &control(dice, 0x08)),
        _ => message.submessage(0x06, 1, &control(dice, 0x06)),
    }
    .bytes()
}

fn observer() -> Observer {
    let mut observer = Observer::new(Settings::default());
    observer.set_watchlist(Watchlist::new(vec![Watch::named("/**").unwrap()]).unwrap());
    observer.set_wishes(Arc::new(vec![Wish {
        id: 1,
        selection: Arc::new(Selection::all()),
        domain_id: None,
        depth: Depth::Payloads,
    }]));
    observer.advance(Timestamp(START));
    observer
}

fn somewhere(dice: &mut Dice, time: u64) -> Envelope {
    let mut envelope = forge::multicast(time, dice.pick(300) as u16 % 200);
    if dice.pick(2) == 0 {
        envelope.destination[12..].copy_from_slice(&(dice.roll() as u32).to_be_bytes());
        envelope.destination_port = dice.roll() as u16;
    }
    envelope
}

/// Drives the model; the largest size of every table, its cap, and how much the heap grew in the
/// second half.
fn drive(
    mut forge: impl FnMut(&mut Dice) -> Vec<u8>,
) -> (BTreeMap<&'static str, (usize, usize)>, usize, usize) {
    let _alone = ALONE
        .lock()
        .unwrap_or_else(std::sync::PoisonError::into_inner);
    let mut dice = Dice(0x9e37_79b9_7f4a_7c15);
    let before = ALLOCATED.load(Ordering::Relaxed);
    let mut observer = observer();
    let mut largest: BTreeMap<&'static str, (usize, usize)> = BTreeMap::new();
    let (mut half, mut now) = (0, START);
    for turn in 0..MESSAGES {
        let message = forge(&mut dice);
        // 50,000 a second.
        now += 20_000;
        let envelope = somewhere(&mut dice, now);
        observer.datagram(&envelope, &message, None);
        if turn % 500 == 0 {
            observer.advance(Timestamp(now));
            for size in observer.sizes() {
                let seen = largest.entry(size.table).or_insert((0, size.cap));
                *seen = (seen.0.max(size.entries), size.cap);
                assert!(size.entries <= size.cap, "{size:?} after {turn} messages");
            }
            observer.take_given();
            observer.take_events();
            observer.take_spans();
            observer.interest_changes();
        }
        if turn == MESSAGES / 2 {
            half = ALLOCATED.load(Ordering::Relaxed).saturating_sub(before);
        }
    }
    let whole = ALLOCATED.load(Ordering::Relaxed).saturating_sub(before);
    (largest, half, whole)
}

#[test]
fn no_table_grows_beyond_its_cap_whatever_is_forged() {
    let (largest, half, whole) = drive(forged);
    println!("{half} bytes after half of it, {whole} at the end\n{largest:#?}");
    for table in [
        "discovery.participants",
        "discovery.pending_endpoints",
        "discovery.pending_nodes",
        "profiler.strangers",
        "receivers.places",
    ] {
        let (entries, cap) = largest[table];
        assert!(
            entries * 10 >= cap * 9,
            "{table} was not filled: {entries} of {cap}"
        );
    }
    assert!(whole < 96 << 20, "{whole} bytes");
}

#[test]
fn one_forged_participant_with_fresh_addresses_keeps_the_last_ones_alone() {
    let prefix = GuidPrefix([9; 12]);
    let (largest, _, whole) = drive(|dice| {
        let payload = forge::participant_at(prefix, 100, None, &dice.locators());
        Message::from(prefix).data(SPDP, 1, &payload).bytes()
    });
    assert_eq!(largest["receivers.places"].0, 16);
    assert!(whole < 2 << 20, "{whole} bytes");
}
