//! A robot whose graph changes constantly, and the truth about it: its entities, and how former
//! entities ended.
//!
//! Participants send the same messages as DDS implementations, at a bounded rate. The sender's
//! knowledge is exact: a lease that it could not renew in time has expired.

mod member;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Result, anyhow};

use super::storm::Dice;
use super::{Carrier, PARTICIPANT, SPDP_WRITER};
use member::{Member, announcer, entity, guid, role};

/// Maximum number of datagrams per second.
const PACE: f64 = 2500.0;
/// A participant that could not send for this part of its lease no longer renews it, because the
/// renewal might be too late.
const LATE: f64 = 0.8;
/// Time within which an observer notices the end of a lease.
const GREY: Duration = Duration::from_millis(2500);
/// Numbers of permanent participants, and of measured topics of each.
const PERMANENT_MEMBERS: usize = 20;
const MEASURED: usize = 10;
const ENTITIES_WRITER: [u8; 4] = [0, 0, 1, 3];
const ENTITIES_READER: [u8; 4] = [0, 0, 1, 4];
const ENTITIES_TOPIC: &str = "ros_discovery_info";
const ENTITIES_TYPE: &str = "rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_";
const TYPE: &str = "sensor_msgs::msg::dds_::PointCloud2_";

/// Size and rate of change of the crowd.
#[derive(Clone, Copy, Debug)]
pub struct Scale {
    /// Maximum number of participants that an observer may consider alive at a time.
    pub participants: usize,
    /// Mean lifetime of a participant.
    pub life: Duration,
    /// Endpoints created or deleted per second.
    pub endpoint_changes: f64,
    /// Messages per second on all measured topics.
    pub messages: f64,
    /// Leases in seconds, each with the percentage of participants that have it.
    pub leases: &'static [(u64, u64)],
}

/// The entities that exist.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct Graph {
    /// GUIDs of participants.
    pub participants: BTreeSet<String>,
    /// DDS topic, role and GUID of endpoints.
    pub endpoints: BTreeSet<(String, &'static str, String)>,
    /// Participant and name of nodes.
    pub nodes: BTreeSet<(String, String)>,
}

/// Number of events, by entity and event.
pub type Tally = BTreeMap<(&'static str, &'static str), u64>;

pub struct Crowd<C> {
    carrier: C,
    dice: Dice,
    scale: Scale,
    target: usize,
    members: Vec<Member>,
    /// Participants that left without a disposal, until their leases end.
    silent: Vec<Member>,
    tally: Tally,
    /// Number of messages on each measured topic.
    messages: Vec<u32>,
    /// Disposals of participants and endpoints since [`Crowd::forget`].
    disposals: Vec<Vec<u8>>,
    participants_created: u32,
    due: Instant,
    ticked: Instant,
    pending_messages: [f64; 3],
    next_topic: usize,
}

impl<C: Carrier> Crowd<C> {
    pub fn new(carrier: C, scale: Scale) -> Crowd<C> {
        let now = Instant::now();
        Crowd {
            carrier,
            dice: Dice::new(0x2545_f491_4f6c_dd1d),
            scale,
            target: scale.participants,
            members: Vec::new(),
            silent: Vec::new(),
            tally: Tally::new(),
            messages: vec![0; PERMANENT_MEMBERS * MEASURED],
            disposals: Vec::new(),
            participants_created: 0,
            due: now,
            ticked: now,
            pending_messages: [0.0; 3],
            next_topic: 0,
        }
    }

    /// Sets the target number of participants.
    pub fn aim(&mut self, participants: usize) {
        self.target = participants.clamp(PERMANENT_MEMBERS, self.scale.participants);
    }

    /// Changes the graph for this long.
    pub fn live(&mut self, span: Duration) -> Result<()> {
        let end = Instant::now() + span;
        while Instant::now() < end {
            self.tick(true)?;
        }
        Ok(())
    }

    /// Keeps the graph unchanged for this long, and sends only renewals of leases.
    pub fn idle(&mut self, span: Duration) -> Result<()> {
        let end = Instant::now() + span;
        while Instant::now() < end {
            self.tick(false)?;
        }
        Ok(())
    }

    /// Renews leases on another thread while `work` runs.
    pub fn idle_during<T>(&mut self, work: impl FnOnce() -> Result<T>) -> Result<T>
    where
        C: Send,
    {
        let is_done = AtomicBool::new(false);
        std::thread::scope(|scope| {
            let idling = scope.spawn(|| -> Result<()> {
                while !is_done.load(Ordering::Relaxed) {
                    self.idle(Duration::from_millis(10))?;
                }
                Ok(())
            });
            let result = work();
            is_done.store(true, Ordering::Relaxed);
            idling.join().map_err(|_| anyhow!("the crowd died"))??;
            result
        })
    }

    /// Returns whether a lease ends so soon that an observer may or may not have noticed its end.
    pub fn is_grey(&self) -> bool {
        let now = Instant::now();
        self.silent.iter().any(|member| member.ends() < now + GREY)
    }

    /// Returns the current graph.
    pub fn graph(&self) -> Graph {
        let mut graph = Graph::default();
        for member in self.members.iter().chain(&self.silent) {
            let participant = guid(&member.prefix, PARTICIPANT);
            for (entity, topic) in &member.endpoints {
                let role = role(*entity);
                let guid = guid(&member.prefix, *entity);
                graph.endpoints.insert((topic.clone(), role, guid));
            }
            let name = format!("/{}", member.node);
            graph.nodes.insert((participant.clone(), name));
            graph.participants.insert(participant);
        }
        graph
    }

    /// Returns the number of events so far, by entity and event.
    pub fn tally(&self) -> &Tally {
        &self.tally
    }

    /// Iterates over the measured topics with their number of messages.
    pub fn messages(&self) -> impl Iterator<Item = (String, u32)> {
        let counts = self.messages.iter().enumerate();
        counts.map(|(index, count)| (format!("/measured/topic_{index}"), *count))
    }

    /// Returns the number of participants, including those whose lease has not yet expired.
    pub fn size(&self) -> usize {
        self.members.len() + self.silent.len()
    }

    /// Returns the number of participants ever created.
    pub fn participants_created(&self) -> u32 {
        self.participants_created
    }

    /// Repeats disposals and every valid announcement, for an observer that missed some.
    pub fn repeat(&mut self) -> Result<()> {
        for farewell in self.disposals.clone() {
            self.send(&farewell)?;
        }
        for index in 0..self.members.len() {
            for message in self.members[index].introduction() {
                self.send(&message)?;
            }
            self.members[index].seen = Instant::now();
            self.tick(false)?;
        }
        Ok(())
    }

    /// Forgets past disposals, which the observer has seen.
    pub fn forget(&mut self) {
        self.disposals.clear();
    }

    fn tick(&mut self, changes: bool) -> Result<()> {
        let now = Instant::now();
        let passed = now.duration_since(self.ticked).as_secs_f64().min(0.1);
        self.ticked = now;
        self.drop_expired();
        self.renew()?;
        if changes {
            let deaths = self.members.len().saturating_sub(PERMANENT_MEMBERS) as f64;
            let rates = [
                deaths / self.scale.life.as_secs_f64(),
                self.scale.endpoint_changes,
                self.scale.messages,
            ];
            for (owed, rate) in self.pending_messages.iter_mut().zip(rates) {
                *owed += rate * passed;
            }
            for _ in 0..self.schedule_messages(0) {
                self.death()?;
            }
            for _ in 0..self.schedule_messages(1) {
                self.endpoint_change()?;
            }
            for _ in 0..self.schedule_messages(2) {
                self.message()?;
            }
            let surplus = self.members.len().saturating_sub(self.target);
            for _ in 0..surplus.min(10) {
                self.dispose()?;
            }
            for _ in 0..self.target.saturating_sub(self.size()).min(10) {
                let node = format!("node_{}", self.dice.pick(1 << 40));
                self.birth(node)?;
            }
        }
        std::thread::sleep(Duration::from_millis(5));
        Ok(())
    }

    fn schedule_messages(&mut self, kind: usize) -> u64 {
        let whole = self.pending_messages[kind].floor();
        self.pending_messages[kind] -= whole;
        whole as u64
    }

    /// Removes participants whose leases have ended.
    fn drop_expired(&mut self) {
        let now = Instant::now();
        let (silenced, members) = std::mem::take(&mut self.members)
            .into_iter()
            .partition(Member::is_late);
        self.members = members;
        self.silent.extend(Vec::from_iter(silenced));
        let (ended, silent): (Vec<_>, _) = std::mem::take(&mut self.silent)
            .into_iter()
            .partition(|member| member.ends() <= now);
        self.silent = silent;
        for member in ended {
            self.count_end(&member, "expired");
        }
    }

    fn renew(&mut self) -> Result<()> {
        for index in 0..self.members.len() {
            let member = &self.members[index];
            // The renewal of others takes time, after which it may be too late for this member.
            if member.seen.elapsed() > member.lease / 3 && !member.is_late() {
                let message = member.announcement();
                self.send(&message)?;
                self.members[index].seen = Instant::now();
            }
        }
        Ok(())
    }

    fn birth(&mut self, node: String) -> Result<()> {
        let staying = self.participants_created < PERMANENT_MEMBERS as u32;
        let slot = self.free_slot();
        let lease = if staying { 100 } else { self.lease() };
        let mut prefix = *b"\x01\x0fcrowd.....";
        prefix[8..].copy_from_slice(&self.participants_created.to_be_bytes());
        self.participants_created += 1;
        let mut member = Member {
            prefix,
            slot,
            lease: Duration::from_secs(lease),
            node,
            endpoints: BTreeMap::new(),
            numbers: [0; 3],
            entity: 1,
            seen: Instant::now(),
        };
        member
            .endpoints
            .insert(ENTITIES_WRITER, ENTITIES_TOPIC.to_owned());
        member
            .endpoints
            .insert(ENTITIES_READER, ENTITIES_TOPIC.to_owned());
        if staying {
            for index in slot * MEASURED..(slot + 1) * MEASURED {
                member.add(3, format!("rt/measured/topic_{index}"));
            }
        } else {
            member.add(3, format!("rt/robot/part_{slot}/points"));
            member.add(3, format!("rt/robot/part_{slot}/state"));
            for _ in 0..2 {
                let topic = self.topic();
                member.add(4, topic);
            }
        }
        member.number_endpoints();
        for message in member.introduction() {
            self.send(&message)?;
        }
        member.seen = Instant::now();
        self.count("participant", "appeared", 1);
        self.count("node", "appeared", 1);
        for entity in member.endpoints.keys() {
            self.count(role(*entity), "appeared", 1);
        }
        self.members.push(member);
        Ok(())
    }

    /// Ends a participant that is not permanent, in one of several ways.
    fn death(&mut self) -> Result<()> {
        match self.dice.pick(10) {
            0..4 => self.dispose(),
            4..8 => self.silence().map(drop),
            // The same node starts in another process before the lease of the first one has ended.
            _ => match self.silence()? {
                Some(node) if self.size() < self.scale.participants => self.birth(node),
                _ => Ok(()),
            },
        }
    }

    fn dispose(&mut self) -> Result<()> {
        if let Some(member) = self.take() {
            let message = member.disposal(SPDP_WRITER, 2, PARTICIPANT, self.dice.pick(2) == 0);
            self.send(&message)?;
            self.disposals.push(message);
            self.count_end(&member, "disposed");
        }
        Ok(())
    }

    fn silence(&mut self) -> Result<Option<String>> {
        let member = self.take();
        let node = member.as_ref().map(|member| member.node.clone());
        self.silent.extend(member);
        Ok(node)
    }

    fn take(&mut self) -> Option<Member> {
        let staying = self.members.iter().filter(|member| member.stays()).count();
        let others = self.members.len().checked_sub(staying + 1)?;
        let lot = self.dice.pick(others as u64 + 1) as usize;
        let mut mortal = (0..self.members.len()).filter(|index| !self.members[*index].stays());
        Some(self.members.swap_remove(mortal.nth(lot)?))
    }

    fn endpoint_change(&mut self) -> Result<()> {
        let index = self.dice.pick(self.members.len().max(1) as u64) as usize;
        let topic = self.topic();
        let (delete, by_key) = (self.dice.pick(2) == 0, self.dice.pick(2) == 0);
        let kind = if self.dice.pick(2) == 0 { 3 } else { 4 };
        let Some(member) = self.members.get_mut(index).filter(|member| !member.stays()) else {
            return Ok(());
        };
        let last = member.endpoints.last_key_value().map(|(last, _)| *last);
        let crowded = member.endpoints.len() > 8;
        let message = match last.filter(|last| (delete || crowded) && last[1..3] != [0, 1]) {
            Some(entity) => {
                member.endpoints.remove(&entity);
                let number = member.next_number(entity);
                let message = member.disposal(announcer(entity), number, entity, by_key);
                self.count(role(entity), "disposed", 1);
                self.disposals.push(message.clone());
                message
            }
            None => {
                let entity = member.add(kind, topic);
                let number = member.next_number(entity);
                let message = member.endpoint(entity, number);
                self.count(role(entity), "appeared", 1);
                message
            }
        };
        self.send(&message)?;
        // Any message asserts liveliness.
        self.members[index].seen = Instant::now();
        Ok(())
    }

    /// Sends the next message on the next measured topic.
    fn message(&mut self) -> Result<()> {
        const SIZES: [usize; 5] = [120, 320, 644, 1300, 6000];
        let index = self.next_topic;
        self.next_topic = (index + 1) % self.messages.len();
        let size = SIZES[self.dice.pick(SIZES.len() as u64) as usize];
        let Some(position) = self
            .members
            .iter()
            .position(|member| member.stays() && member.slot == index / MEASURED)
        else {
            return Ok(());
        };
        let mut payload = vec![0, 1, 0, 0];
        payload.resize(size, 0x33);
        self.messages[index] += 1;
        let entity = entity(2 + (index % MEASURED) as u16, 3);
        let member = &mut self.members[position];
        member.seen = Instant::now();
        let message = member.message(entity, self.messages[index], &payload);
        self.send(&message)
    }

    fn send(&mut self, message: &[u8]) -> Result<()> {
        self.due = (self.due + Duration::from_secs_f64(1.0 / PACE)).max(Instant::now());
        self.carrier.send(message)?;
        let ahead = self.due.saturating_duration_since(Instant::now());
        if ahead > Duration::from_millis(2) {
            std::thread::sleep(ahead);
        }
        Ok(())
    }

    fn count(&mut self, entity: &'static str, event: &'static str, number: u64) {
        *self.tally.entry((entity, event)).or_default() += number;
    }

    fn count_end(&mut self, member: &Member, event: &'static str) {
        self.count("participant", event, 1);
        self.count("node", "cascaded", 1);
        for entity in member.endpoints.keys() {
            self.count(role(*entity), "cascaded", 1);
        }
    }

    fn free_slot(&self) -> usize {
        let everybody = self.members.iter().chain(&self.silent);
        let taken: BTreeSet<usize> = everybody.map(|member| member.slot).collect();
        (0..).find(|slot| !taken.contains(slot)).unwrap_or(0)
    }

    fn lease(&mut self) -> u64 {
        let mut lot = self.dice.pick(100);
        for (lease, share) in self.scale.leases {
            match lot.checked_sub(*share) {
                Some(rest) => lot = rest,
                None => return *lease,
            }
        }
        100
    }

    /// Returns a topic of any participant, or a new topic one time in twenty.
    fn topic(&mut self) -> String {
        if self.dice.pick(20) == 0 {
            return format!("rt/once/topic_{}", self.dice.pick(1 << 40));
        }
        let slot = self.dice.pick(self.scale.participants as u64);
        let part = if self.dice.pick(2) == 0 {
            "points"
        } else {
            "state"
        };
        format!("rt/robot/part_{slot}/{part}")
    }
}
