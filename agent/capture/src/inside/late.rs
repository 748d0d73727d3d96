//! Late calls: from when on a call is late, whether the scheduler's events are observed, and the
//! items that the kernel programs report.
//!
//! Without a bound from a client or an expectation, the bound is learnt. It is three times the 99th
//! percentile of the callback's calls in the last minutes, and [`MIN_BOUND`] or more.

mod items;
mod learnt;

use std::collections::{BTreeSet, HashMap, HashSet};
use std::fs::File;
use std::sync::Arc;
use std::time::Duration;

use ros2probe_model::facts::bounded::Bounded;
use ros2probe_model::facts::calls::late::MessageDelivery;
use ros2probe_model::facts::calls::report::Trigger;
use ros2probe_model::facts::glob;
use ros2probe_model::facts::names::NodeName;
use ros2probe_wire::DomainId;
use ros2probe_wire::inside::late::{self, Bound, mode};
use ros2probe_wire::inside::{Handle, kind};

use self::learnt::Learnt;
use super::programs::{Events, Programs, Tables};
use super::table::ProcessTable;
use crate::error_chain::{Reason, in_words};
use crate::filter::Deliveries;
use crate::settings::LateChoice;
use crate::tables::CallbackBounds;

pub(super) use self::items::{cgroup_ids, convert};
pub use self::learnt::MIN_BOUND;

/// What clients want to know about late calls.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct LateDemand {
    /// Whether a client requests causes.
    pub has_question: bool,
    /// Bounds of clients and expectations. The first one that applies to a callback counts.
    pub bounds: Vec<RequestedBound>,
}

/// From when on calls of a callback are late.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RequestedBound {
    /// Callbacks that have it.
    pub of: BoundScope,
    /// Maximum time of a call, and maximum time from ready to start.
    pub above: Duration,
}

/// Which callbacks have a bound.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum BoundScope {
    /// Any callback.
    All,
    /// Callbacks of topics that the pattern of a watch covers.
    Topics {
        /// ROS name or glob.
        pattern: Arc<str>,
        /// Domain; `None` = any.
        domain_id: Option<DomainId>,
    },
    /// Callbacks of a topic, service or node with this ROS name, and those that are known to belong
    /// to the node.
    Named {
        /// ROS name.
        name: Arc<str>,
        /// Domain; `None` = any.
        domain_id: Option<DomainId>,
        /// Process and address of callbacks.
        listed: Arc<BTreeSet<(u32, u64)>>,
    },
    /// These callbacks, by process and address.
    Listed(Arc<BTreeSet<(u32, u64)>>),
}

/// What is known about a callback.
struct CallbackNames {
    handle: Handle,
    domain_id: DomainId,
    trigger: Trigger,
    node: Option<NodeName>,
}

impl BoundScope {
    fn has(&self, callback: &CallbackNames) -> bool {
        let id = (callback.handle.process, callback.handle.address);
        let is_in = |domain_id: &Option<DomainId>| {
            domain_id.is_none_or(|domain_id| domain_id == callback.domain_id)
        };
        match self {
            Self::All => true,
            Self::Topics { pattern, domain_id } => {
                let topic = match &callback.trigger {
                    Trigger::Subscription(topic) | Trigger::IntraProcess(Some(topic)) => topic,
                    _ => return false,
                };
                is_in(domain_id) && glob::covers(pattern, topic)
            }
            Self::Named {
                name,
                domain_id,
                listed,
            } => {
                let name = Some(&**name);
                let is_named = name == callback.trigger.name() || name == callback.node.as_deref();
                listed.contains(&id) || is_named && is_in(domain_id)
            }
            Self::Listed(listed) => listed.contains(&id),
        }
    }
}

/// What the programs observe about late calls.
pub(super) struct LateObservation {
    programs: Arc<Programs>,
    choice: LateChoice,
    /// The mode that the programs have.
    mode: u32,
    events: Option<Events>,
    without_events: Option<Reason>,
    /// Programs that follow deliveries of messages, with the control group of the host hook.
    deliveries: Option<(Deliveries, File)>,
    without_deliveries: Option<Reason>,
    requested: Vec<RequestedBound>,
    bounds: Bounded<CallbackBounds, HashMap<Handle, Learnt>>,
}

impl LateObservation {
    pub(super) fn new(
        programs: Arc<Programs>,
        choice: LateChoice,
        deliveries: Option<(Deliveries, File)>,
    ) -> Self {
        let without_deliveries = match deliveries {
            Some(_) => None,
            None => Some(Reason(
                "the sockets of this host are not observed".to_owned(),
            )),
        };
        Self {
            programs,
            choice,
            mode: mode::OFF,
            events: None,
            without_events: None,
            deliveries,
            without_deliveries,
            requested: Vec::new(),
            bounds: Bounded::default(),
        }
    }

    /// Returns what is observed: `off`, `sums` or `events`.
    pub(super) const fn observed(&self) -> &'static str {
        match self.mode {
            mode::EVENTS => "events",
            mode::SUMS => "sums",
            _ => "off",
        }
    }

    /// Returns why the scheduler's events are not observed when they are needed. A refusal of the
    /// kernel is known before that.
    pub(super) fn without_events(&self) -> Option<String> {
        let refused = || match self.choice {
            LateChoice::Off => None,
            LateChoice::Auto | LateChoice::On => self.programs.without_scheduler(),
        };
        let reason = self.without_events.clone().or_else(refused);
        reason.map(|reason| reason.0)
    }

    /// Returns why deliveries of messages are not followed although they are needed.
    pub(super) fn without_deliveries(&self) -> Option<&str> {
        self.without_deliveries.as_ref().map(Reason::as_str)
    }

    /// Returns the delivery of the message that triggered a call.
    pub(super) fn delivery(&self, call: &late::LateCall) -> Option<MessageDelivery> {
        self.deliveries.as_ref()?.0.of(call)
    }

    /// Begins or ends the observation of the scheduler's events. `at_calls`: whether callbacks are
    /// observed.
    pub(super) fn follow(&mut self, at_calls: bool, demand: &LateDemand, tables: &mut Tables) {
        self.requested.clone_from(&demand.bounds);
        let needs_events = match self.choice {
            LateChoice::Off => false,
            LateChoice::On => true,
            LateChoice::Auto => demand.has_question,
        };
        let mode = match self.choice {
            _ if !at_calls => mode::OFF,
            LateChoice::Off => mode::OFF,
            _ if needs_events => mode::EVENTS,
            _ => mode::SUMS,
        };
        // These need an older kernel than the events.
        self.follow_deliveries(mode == mode::EVENTS);
        if mode == mode::EVENTS && self.events.is_none() && self.without_events.is_none() {
            match self.programs.observe_scheduler() {
                Ok(events) => self.events = Some(events),
                Err(reason) => {
                    tracing::warn!(
                        reason = reason.as_str(),
                        "late callbacks are reported without who ran instead"
                    );
                    self.without_events = Some(reason);
                }
            }
        }
        if mode != mode::EVENTS {
            self.events = None;
        }
        let mode = match mode == mode::EVENTS && self.events.is_none() {
            true => mode::SUMS,
            false => mode,
        };
        if mode == self.mode {
            return;
        }
        match tables.set_late_mode(mode) {
            Ok(()) => self.mode = mode,
            Err(error) => {
                let reason = in_words(&error);
                tracing::warn!(reason, "late callbacks are not reported");
            }
        }
    }

    /// Begins or ends following deliveries of messages.
    fn follow_deliveries(&mut self, wanted: bool) {
        let Some((deliveries, cgroup)) = &mut self.deliveries else {
            return;
        };
        if !wanted {
            deliveries.leave();
            return;
        }
        if let Err(reason) = deliveries.follow(cgroup) {
            tracing::warn!(
                reason = reason.as_str(),
                "late callbacks are reported without the way of their messages"
            );
            self.without_deliveries = Some(reason);
            self.deliveries = None;
        }
    }

    /// Learns from the calls of the last round, and sets the bounds of callbacks.
    pub(super) fn set_bounds(&mut self, table: &ProcessTable, tables: &mut Tables) {
        if self.mode == mode::OFF {
            return;
        }
        if self.mode == mode::EVENTS
            && let Err(error) = tables.correct_runnable()
        {
            let reason = in_words(&error);
            tracing::debug!(reason, "the number of threads that could run may be wrong");
        }
        let callbacks = tables.figures();
        let callbacks: Vec<_> = callbacks
            .filter(|(handle, _)| handle.kind == kind::CALLBACK)
            .collect();
        let present: HashSet<_> = callbacks.iter().map(|(handle, _)| *handle).collect();
        let gone = |handle: &Handle| !present.contains(handle);
        let gone: Vec<_> = self.bounds.keys().copied().filter(gone).collect();
        for handle in gone {
            self.bounds.remove(&handle);
            let _ = tables.remove_bound(handle);
        }
        for (handle, figures) in &callbacks {
            let requested = match &self.requested[..] {
                [] => None,
                requested => {
                    let (trigger, node) = table.name_callback(*handle, figures);
                    let callback = CallbackNames {
                        handle: *handle,
                        domain_id: table.domain_of(handle.process),
                        trigger,
                        node,
                    };
                    bound_of(requested, &callback)
                }
            };
            let learnt = self.bounds.get_or_insert_with(*handle, Learnt::default);
            let Some(learnt) = learnt else {
                continue;
            };
            learnt.add(&figures.buckets);
            let bounds = match requested {
                Some(above) => Some([above; 2]),
                None => learnt.learnt,
            };
            if learnt.differs(bounds, requested.is_some()) {
                let set = match bounds {
                    Some([duration, delay]) => {
                        let bound = Bound {
                            duration,
                            delay,
                            ..Bound::default()
                        };
                        tables.set_bound(*handle, bound)
                    }
                    None => tables.remove_bound(*handle),
                };
                if set.is_ok() {
                    learnt.set = bounds;
                }
            }
        }
    }
}

/// Returns the bound of a callback, in nanoseconds, if one applies.
fn bound_of(requested: &[RequestedBound], callback: &CallbackNames) -> Option<u64> {
    let mut requested = requested.iter();
    let above = requested.find(|bound| bound.of.has(callback))?.above;
    Some(u64::try_from(above.as_nanos()).unwrap_or(u64::MAX))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tables::tests::assert_driven;

    #[test]
    fn the_first_bound_that_applies_to_a_callback_counts() {
        let bound = |of: BoundScope, milliseconds| RequestedBound {
            of,
            above: Duration::from_millis(milliseconds),
        };
        let named = |name: &str, listed: &[(u32, u64)]| BoundScope::Named {
            name: name.into(),
            domain_id: None,
            listed: Arc::new(listed.iter().copied().collect()),
        };
        let topics = |pattern: &str, domain_id| BoundScope::Topics {
            pattern: pattern.into(),
            domain_id: Some(DomainId(domain_id)),
        };
        let requested = [
            bound(named("/scan", &[]), 1),
            bound(named("/nav", &[(2, 7)]), 2),
            bound(named("/scan", &[]), 3),
            bound(topics("/camera/**", 0), 4),
            bound(topics("/camera/**", 5), 5),
            bound(BoundScope::Listed(Arc::new([(2, 8)].into())), 6),
        ];
        let callback = |address, domain_id, topic: &str, node: &str| CallbackNames {
            handle: Handle {
                address,
                process: 2,
                kind: kind::CALLBACK,
            },
            domain_id: DomainId(domain_id),
            trigger: Trigger::Subscription(topic.into()),
            node: Some(node.into()),
        };
        let of = |callback| bound_of(&requested, &callback).map(|bound| bound / 1_000_000);
        assert_eq!(of(callback(1, 0, "/scan", "/nav")), Some(1));
        assert_eq!(of(callback(1, 0, "/map", "/nav")), Some(2));
        assert_eq!(of(callback(1, 0, "/map", "/other")), None);
        // The graph knows the node of this one.
        assert_eq!(of(callback(7, 0, "/map", "/other")), Some(2));
        assert_eq!(of(callback(8, 0, "/map", "/other")), Some(6));
        assert_eq!(of(callback(1, 0, "/camera/front/image", "/other")), Some(4));
        assert_eq!(of(callback(1, 5, "/camera/front/image", "/other")), Some(5));
        assert_eq!(of(callback(1, 6, "/camera/front/image", "/other")), None);
        let timer = CallbackNames {
            trigger: Trigger::Timer(None),
            ..callback(1, 0, "", "/other")
        };
        let all = [bound(BoundScope::All, 4)];
        assert_eq!(bound_of(&all, &timer), Some(4_000_000));
    }

    #[test]
    fn callbacks_beyond_the_cap_have_no_bound() {
        let mut bounds: Bounded<CallbackBounds, HashMap<Handle, Learnt>> = Bounded::default();
        for address in 0..10_000 {
            let handle = Handle {
                address,
                process: 1,
                kind: kind::CALLBACK,
            };
            bounds.get_or_insert_with(handle, Learnt::default);
        }
        assert_driven::<CallbackBounds>();
        assert_eq!(bounds.len(), CallbackBounds::CAP);
    }
}
