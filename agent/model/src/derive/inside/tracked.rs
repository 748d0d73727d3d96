//! One publisher, subscription, buffer or callback: its cumulative figures, and those of the last
//! window.

use std::sync::Arc;
use std::time::Duration;

use ros2probe_wire::DomainId;
use ros2probe_wire::inside::distribution::{DELAY, INTERVAL};

use super::findings::Alarms;
use crate::facts::calls::facts::{
    Buffer, Callback, InsideFacts, Owner, Publisher, Quantiles, Subscription,
};
use crate::facts::calls::report::{
    BufferReport, CallbackReport, Durations, PublisherReport, SubscriptionReport, ThreadStates,
    Trigger,
};
use crate::facts::model_time::ModelTime;
use crate::facts::names::{NodeName, TopicName};
use crate::facts::wall_clock::WallClock;

/// The window covers one to two times this duration.
pub(super) const HALF_WINDOW: Duration = Duration::from_secs(5);

/// Kinds of handles.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Kind {
    Publisher,
    Subscription,
    Buffer,
    Callback,
}

/// Properties that only one kind has.
#[derive(Clone, Debug)]
pub(super) enum Detail {
    Endpoint {
        middleware: Option<Arc<str>>,
    },
    Buffer {
        depth: u32,
        max_depth: u32,
        capacity: Option<u32>,
    },
    Callback {
        trigger: Trigger,
        thread: u32,
        states: ThreadStates,
    },
}

/// Cumulative figures of one handle.
#[derive(Clone, Debug)]
pub(super) struct Figures {
    pub(super) kind: Kind,
    pub(super) handle: u64,
    /// Its node according to the source.
    pub(super) node: Option<NodeName>,
    pub(super) topic: Option<TopicName>,
    pub(super) detail: Detail,
    pub(super) counts: Counts,
    pub(super) last: ModelTime,
    /// Durations by the index of [`ros2probe_wire::inside::distribution`]; `None` if the kind has
    /// none.
    pub(super) durations: [Option<Arc<Durations>>; 2],
}

/// Counts, with the meaning that `ros2probe_wire::inside::Figures` gives them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Counts {
    pub(super) count: u64,
    pub(super) failed: u64,
    pub(super) within: u64,
}

/// A handle with the start of its window.
#[derive(Debug)]
pub(super) struct Tracked {
    pub(super) figures: Figures,
    /// Its node: as the source reports it, otherwise as the graph shows it.
    pub(super) node: Option<NodeName>,
    pub(super) domain_id: DomainId,
    /// Time at which the thread of its calls last changed.
    pub(super) thread_since: ModelTime,
    /// Time of its first report.
    pub(super) since: ModelTime,
    /// For a subscription: a time at or before the publication of the last message that it took. It
    /// only increases.
    pub(super) published: Option<ModelTime>,
    /// The earlier and the later start of a window.
    marks: [Mark; 2],
    pub(super) recent: Recent,
    pub(super) alarms: Alarms,
}

/// Figures at an earlier time.
#[derive(Clone, Debug)]
struct Mark {
    at: ModelTime,
    counts: Counts,
    states: ThreadStates,
    durations: [Option<Arc<Durations>>; 2],
}

/// Figures of the last window.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Recent {
    /// Length of the window; zero before the second report.
    pub(super) span: Duration,
    pub(super) counts: Counts,
    pub(super) quantiles: [Quantiles; 2],
    /// Time that its calls took within the window. A call that began earlier counts from the start
    /// of the window.
    pub(super) busy: Duration,
}

/// Counts and delays that one report added to a handle.
#[derive(Debug, Default)]
pub(super) struct Added {
    pub(super) counts: Counts,
    pub(super) delay: Option<Durations>,
}

impl Counts {
    /// Returns the counts since `earlier`. A count that decreased has restarted from 0.
    fn since(self, earlier: Self) -> Self {
        let one = |now: u64, before: u64| now.checked_sub(before).unwrap_or(now);
        Self {
            count: one(self.count, earlier.count),
            failed: one(self.failed, earlier.failed),
            within: one(self.within, earlier.within),
        }
    }
}

impl Figures {
    /// Returns the figures of a publisher.
    pub(super) fn of_publisher(report: PublisherReport, clock: WallClock) -> Self {
        Self {
            kind: Kind::Publisher,
            handle: report.handle,
            node: report.node,
            topic: Some(report.topic),
            detail: Detail::Endpoint {
                middleware: report.middleware,
            },
            counts: Counts {
                count: report.published,
                failed: 0,
                within: report.within_process,
            },
            last: clock.model_time(report.last),
            durations: [Some(report.intervals.into()), None],
        }
    }

    /// Returns the figures of a subscription.
    pub(super) fn of_subscription(report: SubscriptionReport, clock: WallClock) -> Self {
        Self {
            kind: Kind::Subscription,
            handle: report.handle,
            node: report.node,
            topic: Some(report.topic),
            detail: Detail::Endpoint {
                middleware: report.middleware,
            },
            counts: Counts {
                count: report.taken,
                failed: report.failed,
                within: 0,
            },
            last: clock.model_time(report.last),
            durations: [None, Some(report.latency.into())],
        }
    }

    /// Returns the figures of a buffer.
    pub(super) fn of_buffer(report: BufferReport, clock: WallClock) -> Self {
        Self {
            kind: Kind::Buffer,
            handle: report.handle,
            node: report.node,
            topic: report.topic,
            detail: Detail::Buffer {
                depth: report.depth,
                max_depth: report.max_depth,
                capacity: report.capacity,
            },
            counts: Counts {
                count: report.enqueued,
                failed: report.overwritten,
                within: report.dequeued,
            },
            last: clock.model_time(report.last),
            durations: [None, Some(report.waiting.into())],
        }
    }

    /// Returns the figures of a callback.
    pub(super) fn of_callback(report: CallbackReport, clock: WallClock) -> Self {
        let topic = match &report.trigger {
            Trigger::Subscription(topic) | Trigger::IntraProcess(Some(topic)) => {
                Some(topic.clone())
            }
            Trigger::IntraProcess(None) | Trigger::Timer(_) | Trigger::Service(_) => None,
        };
        Self {
            kind: Kind::Callback,
            handle: report.handle,
            node: report.node,
            topic,
            detail: Detail::Callback {
                trigger: report.trigger,
                thread: report.thread,
                states: report.states,
            },
            counts: Counts {
                count: report.calls,
                failed: report.skipped,
                within: 0,
            },
            last: clock.model_time(report.last),
            durations: [Some(report.durations.into()), Some(report.waits.into())],
        }
    }

    /// Returns what triggers the callback.
    pub(super) const fn trigger(&self) -> Option<&Trigger> {
        match &self.detail {
            Detail::Callback { trigger, .. } => Some(trigger),
            _ => None,
        }
    }

    /// Returns what the time of a callback's calls consisted of.
    pub(super) fn states(&self) -> ThreadStates {
        match &self.detail {
            Detail::Callback { states, .. } => *states,
            _ => ThreadStates::default(),
        }
    }

    /// Returns the thread of the callback's last call.
    pub(super) const fn thread(&self) -> Option<u32> {
        match &self.detail {
            Detail::Callback { thread, .. } => Some(*thread),
            _ => None,
        }
    }
}

impl Tracked {
    /// Begins to track a handle that was first reported at `at`. Its counts began at 0 after
    /// `began`, the time of the report before, if there was one.
    pub(super) fn new(figures: Figures, at: ModelTime, began: Option<ModelTime>) -> Self {
        let mark = match began {
            Some(began) => Mark {
                at: began,
                counts: Counts::default(),
                states: ThreadStates::default(),
                durations: [None, None],
            },
            None => Mark::of(&figures, at),
        };
        Self {
            node: figures.node.clone(),
            domain_id: DomainId(0),
            thread_since: at,
            since: at,
            published: None,
            marks: [mark.clone(), mark],
            recent: Recent::default(),
            alarms: Alarms::default(),
            figures,
        }
    }

    /// Replaces the figures by newer ones. Returns the counts and delays that they add.
    pub(super) fn update(&mut self, mut figures: Figures, at: ModelTime) -> Added {
        if figures.counts.count >= self.figures.counts.count {
            figures.continue_from(&self.figures);
        }
        let added = Added {
            counts: figures.counts.since(self.figures.counts),
            delay: figures.added_delay(self.figures.durations[DELAY].as_deref()),
        };
        if figures.counts.count < self.figures.counts.count {
            let mark = Mark {
                at,
                counts: Counts::default(),
                states: ThreadStates::default(),
                durations: [None, None],
            };
            self.marks = [mark.clone(), mark];
        }
        if figures.thread() != self.figures.thread() {
            self.thread_since = at;
        }
        if figures.node.is_some() {
            self.node.clone_from(&figures.node);
        }
        self.figures = figures;
        added
    }

    /// Records the publication time of the oldest message that a report added. Does nothing unless
    /// the report has the latency of each message.
    pub(super) fn took(&mut self, added: &Added) {
        let delay = added.delay.as_ref().filter(|delay| {
            self.figures.kind == Kind::Subscription && delay.count() == added.counts.count
        });
        if let Some((_, longest)) = delay.and_then(Durations::range) {
            self.published = self.published.max(Some(self.figures.last - longest));
        }
    }

    /// Updates the figures of the window that ends at `at`, and begins the next half.
    pub(super) fn turn(&mut self, at: ModelTime) {
        let [begin, middle] = &self.marks;
        self.recent = self.figures.since(begin, at);
        if at - middle.at >= HALF_WINDOW {
            self.marks.swap(0, 1);
            self.marks[1] = Mark::of(&self.figures, at);
        }
    }

    /// Returns the durations of the window with this index in
    /// [`ros2probe_wire::inside::distribution`].
    pub(super) fn window(&self, which: usize) -> Option<Durations> {
        let now = self.figures.durations.get(which)?.as_deref()?;
        let [begin, _] = &self.marks;
        let before = begin.durations.get(which).and_then(Option::as_deref);
        Some(before.map_or_else(|| now.clone(), |before| now.since(before)))
    }

    /// Returns its identity and node.
    pub(super) fn owner(&self, process: u32) -> Owner {
        Owner {
            process,
            handle: self.figures.handle,
            domain_id: self.domain_id,
            node: self.node.clone(),
        }
    }

    /// Adds the handle to the list of its kind.
    pub(super) fn facts(&self, process: u32, into: &mut InsideFacts) {
        let owner = self.owner(process);
        let Figures {
            topic,
            counts,
            last,
            ..
        } = &self.figures;
        let Recent {
            counts: recent,
            quantiles,
            ..
        } = self.recent;
        let rate_hz = self.rate();
        let durations = |which: usize| {
            let known = self.figures.durations.get(which).cloned().flatten();
            known.unwrap_or_default()
        };
        match &self.figures.detail {
            Detail::Endpoint { middleware } if self.figures.kind == Kind::Publisher => {
                into.publishers.push(Publisher {
                    owner,
                    topic: topic.clone().unwrap_or_default(),
                    middleware: middleware.clone(),
                    published: counts.count,
                    within_process: counts.within,
                    rate_hz,
                    last: *last,
                    interval: quantiles[INTERVAL],
                });
            }
            Detail::Endpoint { middleware } => into.subscriptions.push(Subscription {
                owner,
                topic: topic.clone().unwrap_or_default(),
                middleware: middleware.clone(),
                taken: counts.count,
                failed: counts.failed,
                rate_hz,
                last: *last,
                latency: quantiles[DELAY],
            }),
            Detail::Buffer {
                depth,
                max_depth,
                capacity,
            } => into.buffers.push(Buffer {
                owner,
                topic: topic.clone(),
                enqueued: counts.count,
                overwritten: counts.failed,
                dequeued: counts.within,
                overwritten_ratio: ratio(recent.failed, recent.count),
                depth: *depth,
                max_depth: *max_depth,
                capacity: *capacity,
                rate_hz,
                last: *last,
                waiting: quantiles[DELAY],
            }),
            Detail::Callback {
                trigger,
                thread,
                states,
            } => into.callbacks.push(Callback {
                owner,
                trigger: trigger.clone(),
                thread: *thread,
                calls: counts.count,
                skipped: counts.failed,
                rate_hz,
                busy: self.busy(),
                last: *last,
                duration: quantiles[INTERVAL],
                wait: quantiles[DELAY],
                durations: durations(INTERVAL),
                waits: durations(DELAY),
                states: *states,
                recent_states: states.since(self.marks[0].states),
            }),
        }
    }

    /// Returns the count per second over the window.
    #[expect(
        clippy::cast_precision_loss,
        reason = "counts of ten seconds are far below 2^52"
    )]
    pub(super) fn rate(&self) -> Option<f64> {
        let seconds = self.recent.span.as_secs_f64();
        (seconds > 0.0).then(|| self.recent.counts.count as f64 / seconds)
    }

    /// Returns the share of the window that its calls took.
    pub(super) fn busy(&self) -> Option<f64> {
        let seconds = self.recent.span.as_secs_f64();
        (seconds > 0.0).then(|| self.recent.busy.as_secs_f64() / seconds)
    }
}

impl Figures {
    /// Continues the distributions of the report before.
    fn continue_from(&mut self, earlier: &Self) {
        for (now, before) in self.durations.iter_mut().zip(&earlier.durations) {
            if let (Some(now), Some(before)) = (now, before) {
                Arc::make_mut(now).continue_from(before);
            }
        }
    }

    /// Returns the delays that were added since `before`.
    pub(super) fn added_delay(&self, before: Option<&Durations>) -> Option<Durations> {
        let now = self.durations[DELAY].as_deref()?;
        Some(before.map_or_else(|| now.clone(), |before| now.since(before)))
    }

    fn since(&self, mark: &Mark, at: ModelTime) -> Recent {
        let mut recent = Recent {
            span: at - mark.at,
            counts: self.counts.since(mark.counts),
            ..Recent::default()
        };
        let both = self.durations.iter().zip(&mark.durations);
        for (which, (now, before)) in both.enumerate() {
            let Some(now) = now else {
                continue;
            };
            let window = match before {
                Some(before) if Arc::ptr_eq(now, before) => continue,
                Some(before) => &now.since(before),
                None => &**now,
            };
            if let Some(quantiles) = recent.quantiles.get_mut(which) {
                *quantiles = Quantiles::of(window);
            }
            if self.kind == Kind::Callback && which == INTERVAL {
                recent.busy = window.sum_within(recent.span);
            }
        }
        recent
    }
}

impl Mark {
    fn of(figures: &Figures, at: ModelTime) -> Self {
        Self {
            at,
            counts: figures.counts,
            states: figures.states(),
            durations: figures.durations.clone(),
        }
    }
}

#[expect(
    clippy::cast_precision_loss,
    reason = "a ratio of counts far below 2^52"
)]
pub(super) fn ratio(part: u64, whole: u64) -> Option<f64> {
    (whole > 0).then(|| part as f64 / whole as f64)
}
