//! Deliveries of messages from user space: attaches the programs at receive calls to the observed
//! control group, and looks messages up.

use std::fs::File;
use std::io;
use std::os::fd::{AsFd as _, AsRawFd as _, OwnedFd};
use std::time::Duration;

use aya::Ebpf;
use aya::maps::{Array, HashMap, MapData};
use aya::programs::{CgroupSockAddr, ProgramError, ProgramFd};
use ros2probe_model::facts::calls::late::{MessageDelivery, WaitingStates};
use ros2probe_wire::delivery::{Delivery, DeliveryKey};
use ros2probe_wire::inside::late::LateCall;

use super::super::bpf;
use super::super::error_chain::Reason;
use super::{FilterError, failed, take};

/// Programs and their attach types of linux/bpf.h.
const RECEIVER_PROGRAMS: [(&str, u32); 2] = [("received_ipv4", 19), ("received_ipv6", 20)];

type KeyWords = [u64; size_of::<DeliveryKey>() / 8];
type DeliveryWords = [u64; size_of::<Delivery>() / 8];

/// The programs and tables of deliveries.
pub struct Deliveries {
    receivers: Result<[ProgramFd; 2], Reason>,
    followed: Array<MapData, u32>,
    deliveries: HashMap<MapData, KeyWords, DeliveryWords>,
    sent: HashMap<MapData, u64, u64>,
    /// Present while deliveries are followed.
    links: Vec<OwnedFd>,
}

/// Why deliveries are not followed.
#[derive(Debug, thiserror::Error)]
enum NoDeliveries {
    /// The kernel does not attach a program.
    #[error("the kernel refuses to observe receive calls")]
    Link(#[source] io::Error),
    /// The kernel refuses a program.
    #[error("the kernel refuses a program at receive calls")]
    Program(#[from] ProgramError),
}

impl Deliveries {
    /// Loads the programs without attaching them.
    ///
    /// # Errors
    /// Fails if the object lacks a table. A refused program is an error of [`Deliveries::follow`].
    pub(super) fn load(ebpf: &mut Ebpf) -> Result<Self, FilterError> {
        let mut load = |name| -> Result<ProgramFd, NoDeliveries> {
            let program = ebpf.program_mut(name);
            let program = program.ok_or(ProgramError::NotLoaded)?;
            let program: &mut CgroupSockAddr = program.try_into()?;
            program.load()?;
            let descriptor = program.fd()?.try_clone();
            Ok(descriptor.map_err(ProgramError::IOError)?)
        };
        let [(ipv4, _), (ipv6, _)] = RECEIVER_PROGRAMS;
        let receivers = load(ipv4).and_then(|ipv4| Ok([ipv4, load(ipv6)?]));
        Ok(Self {
            receivers: receivers.map_err(|error| Reason::of(&error)),
            followed: take(ebpf, "FOLLOW_DELIVERIES")?,
            deliveries: take(ebpf, "DELIVERIES")?,
            sent: take(ebpf, "SENT")?,
            links: Vec::new(),
        })
    }

    /// Follows the deliveries of all messages from now on, if it does not yet. `cgroup` is the
    /// directory of the host hook's control group.
    ///
    /// # Errors
    /// Fails if the kernel refuses a program, or if the control group is gone.
    pub fn follow(&mut self, cgroup: &File) -> Result<(), Reason> {
        if !self.links.is_empty() {
            return Ok(());
        }
        let receivers = self.receivers.as_ref().map_err(Clone::clone)?;
        let links = receivers
            .iter()
            .zip(RECEIVER_PROGRAMS)
            .map(|(program, (_, at))| {
                let [program, cgroup] =
                    [program.as_fd().as_raw_fd(), cgroup.as_raw_fd()].map(i32::cast_unsigned);
                bpf::create_link(program, cgroup, at)
            });
        let links: io::Result<_> = links.collect();
        self.links = links.map_err(|error| Reason::of(&NoDeliveries::Link(error)))?;
        let set = self.followed.set(0, 1, 0);
        let set = set.map_err(failed("FOLLOW_DELIVERIES", "set"));
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

    /// Returns the delivery of the message that triggered a late call; `None` if it is not known:
    /// the message came through no UDP socket, or another copy of it came later.
    #[must_use]
    pub fn of(&self, call: &LateCall) -> Option<MessageDelivery> {
        let (source_timestamp, delivery) = self.find(call)?;
        if delivery.received > call.taken {
            return None;
        }
        let before = |time| Duration::from_nanos(call.started.saturating_sub(time));
        let sent = self.sent.get(&source_timestamp, 0).ok();
        Some(MessageDelivery {
            sent_before: sent.filter(|sent| *sent <= delivery.arrived).map(before),
            arrived_before: before(delivery.arrived),
            received_before: before(delivery.received),
            receiver_thread: delivery.thread,
            receiver: (delivery.accounted != 0).then(|| WaitingStates {
                runnable: Duration::from_nanos(delivery.runnable),
                throttled: Duration::from_nanos(delivery.throttled),
            }),
        })
    }

    /// Finds a delivery with the source timestamp of its datagrams. Middlewares round the wire's
    /// fraction of a second to nanoseconds in different ways.
    fn find(&self, call: &LateCall) -> Option<(u64, Delivery)> {
        let taken = call.source_timestamp;
        if taken == 0 {
            return None;
        }
        let all = [taken, taken.wrapping_sub(1), taken.wrapping_add(1)];
        all.into_iter().find_map(|source_timestamp| {
            let key: KeyWords = zerocopy::transmute!(DeliveryKey {
                source_timestamp,
                process: u64::from(call.process),
            });
            let words = self.deliveries.get(&key, 0).ok()?;
            Some((source_timestamp, zerocopy::transmute!(words)))
        })
    }
}
