//! Journeys of messages from user space: attaches the programs at receive calls to the observed
//! control group, and looks messages up.

use std::fs::File;
use std::io;
use std::os::fd::{AsFd as _, AsRawFd as _, OwnedFd};
use std::time::Duration;

use aya::Ebpf;
use aya::maps::{Array, HashMap, MapData};
use aya::programs::{CgroupSockAddr, ProgramError, ProgramFd};
use ros2probe_model::facts::calls::late::{MessageJourney, ReceiverStates};
use ros2probe_wire::inside::late::LateCall;
use ros2probe_wire::journey::{Journey, JourneyKey};

use super::super::bpf;
use super::super::error_chain::Reason;
use super::{FilterError, failed, take};

/// Programs and their attach types of linux/bpf.h.
const RECEIVERS: [(&str, u32); 2] = [("received_ipv4", 19), ("received_ipv6", 20)];

type KeyWords = [u64; size_of::<JourneyKey>() / 8];
type JourneyWords = [u64; size_of::<Journey>() / 8];

/// The programs and tables of journeys.
pub struct Journeys {
    receivers: Result<[ProgramFd; 2], Reason>,
    followed: Array<MapData, u32>,
    journeys: HashMap<MapData, KeyWords, JourneyWords>,
    sent: HashMap<MapData, u64, u64>,
    /// Present while journeys are followed.
    links: Vec<OwnedFd>,
}

/// Why journeys are not followed.
#[derive(Debug, thiserror::Error)]
enum NoJourneys {
    /// The kernel does not attach a program.
    #[error("the kernel refuses to observe receive calls")]
    Link(#[source] io::Error),
    /// The kernel refuses a program.
    #[error("the kernel refuses a program at receive calls")]
    Program(#[from] ProgramError),
}

impl Journeys {
    /// Loads the programs without attaching them.
    ///
    /// # Errors
    /// Fails if the object lacks a table. A refused program is an error of [`Journeys::follow`].
    pub(super) fn load(ebpf: &mut Ebpf) -> Result<Self, FilterError> {
        let mut load = |name| -> Result<ProgramFd, NoJourneys> {
            let program = ebpf.program_mut(name);
            let program = program.ok_or(ProgramError::NotLoaded)?;
            let program: &mut CgroupSockAddr = program.try_into()?;
            program.load()?;
            let descriptor = program.fd()?.try_clone();
            Ok(descriptor.map_err(ProgramError::IOError)?)
        };
        let [(ipv4, _), (ipv6, _)] = RECEIVERS;
        let receivers = load(ipv4).and_then(|ipv4| Ok([ipv4, load(ipv6)?]));
        Ok(Self {
            receivers: receivers.map_err(|error| Reason::of(&error)),
            followed: take(ebpf, "FOLLOW_JOURNEYS")?,
            journeys: take(ebpf, "JOURNEYS")?,
            sent: take(ebpf, "SENT")?,
            links: Vec::new(),
        })
    }

    /// Follows the journeys of all messages from now on, if it does not yet. `cgroup` is the directory of the
    /// host hook's control group.
    ///
    /// # Errors
    /// Fails if the kernel refuses a program, or if the control group is gone.
    pub fn follow(&mut self, cgroup: &File) -> Result<(), Reason> {
        if !self.links.is_empty() {
            return Ok(());
        }
        let receivers = self.receivers.as_ref().map_err(Clone::clone)?;
        let links = receivers.iter().zip(RECEIVERS).map(|(program, (_, at))| {
            let [program, cgroup] =
                [program.as_fd().as_raw_fd(), cgroup.as_raw_fd()].map(i32::cast_unsigned);
            bpf::create_link(program, cgroup, at)
        });
        let links: io::Result<_> = links.collect();
        self.links = links.map_err(|error| Reason::of(&NoJourneys::Link(error)))?;
        let set = self.followed.set(0, 1, 0);
        let set = set.map_err(failed("FOLLOW_JOURNEYS", "set"));
        set.map_err(|error| Reason::of(&error))
    }

    /// Follows them no longer.
    pub fn leave(&mut self) {
        if self.links.is_empty() {
            return;
        }
        self.links.clear();
        let _ = self.followed.set(0, 0, 0);
    }

    /// Returns the journey of the message that triggered a late call; `None` if it is not known: the
    /// message came through no UDP socket, or another copy of it came later.
    #[must_use]
    pub fn of(&self, call: &LateCall) -> Option<MessageJourney> {
        let (source_timestamp, journey) = self.find(call)?;
        if journey.received > call.taken {
            return None;
        }
        let before = |time| Duration::from_nanos(call.started.saturating_sub(time));
        let sent = self.sent.get(&source_timestamp, 0).ok();
        Some(MessageJourney {
            sent_before: sent.filter(|sent| *sent <= journey.arrived).map(before),
            arrived_before: before(journey.arrived),
            received_before: before(journey.received),
            receiver: (journey.accounted != 0).then(|| ReceiverStates {
                runnable: Duration::from_nanos(journey.runnable),
                throttled: Duration::from_nanos(journey.throttled),
            }),
        })
    }

    /// Finds a journey with the source timestamp of its datagrams. Middlewares round the wire's
    /// fraction of a second to nanoseconds in different ways.
    fn find(&self, call: &LateCall) -> Option<(u64, Journey)> {
        let taken = call.source_timestamp;
        if taken == 0 {
            return None;
        }
        let all = [taken, taken.wrapping_sub(1), taken.wrapping_add(1)];
        all.into_iter().find_map(|source_timestamp| {
            let key: KeyWords = zerocopy::transmute!(JourneyKey {
                source_timestamp,
                process: u64::from(call.process),
            });
            let words = self.journeys.get(&key, 0).ok()?;
            Some((source_timestamp, zerocopy::transmute!(words)))
        })
    }
}
