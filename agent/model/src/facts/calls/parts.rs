//! What the time of a late call consisted of: its parts by stage and cause.

use std::time::Duration;

use super::late::{Activity, Cause, Handoff, LateCall, Part, PreviousCall, Repairs, Stage, Stop};
use super::other_thread::OtherThread;
use super::report::ThreadStates;

impl LateCall {
    /// Returns the time from ready to the end of the call.
    #[must_use]
    pub fn total(&self) -> Duration {
        self.wait.unwrap_or_default() + self.duration
    }

    /// Returns the parts of the call in chronological order. They add up to [`Self::total`].
    ///
    /// The sums are those of the scheduler's accounting. The events divide them: events can get
    /// lost, and the accounting cannot. Only the CPU time is that of the events, if none is
    /// missing: the accounting counts it by ticks.
    #[must_use]
    pub fn parts(&self) -> Vec<Part> {
        let mut parts = self.wait_parts();
        parts.extend(self.callback_parts());
        parts.retain(|part| !part.duration.is_zero());
        parts
    }

    /// Divides the wait from its end to its begin: what happened last on the way of the message
    /// explains the latest time.
    fn wait_parts(&self) -> Vec<Part> {
        let Some(wait) = self.wait else {
            return Vec::new();
        };
        let Some(delivery) = &self.delivery else {
            // The rest of the way is not known, so the arrival of a message behind a lost one is not.
            let since_arrival = wait.min(self.repairs.of_message.unwrap_or(wait));
            let network = Remainder::new(Stage::Network, wait - since_arrival);
            let mut parts = network.finish(Cause::Repaired);
            parts.extend(match &self.handoff {
                // The thread ran already when the message was published.
                Some(handoff) if handoff.woken_before <= since_arrival => {
                    self.handoff_parts(handoff, since_arrival)
                }
                _ => self.executor_parts(since_arrival, Cause::Arrival),
            });
            return parts;
        };
        let in_process = wait.min(delivery.received_before);
        let since_arrival = wait.min(delivery.arrived_before);
        let since_sent = match delivery.sent_before {
            Some(sent_before) => wait.min(sent_before),
            None => wait,
        };
        let mut parts = Remainder::new(Stage::Publish, wait - since_sent).finish(Cause::Send);
        let network = Remainder::new(Stage::Network, since_sent - since_arrival);
        parts.extend(network.finish(match self.repairs.of_message {
            Some(_) => Cause::Repaired,
            None => Cause::Transit,
        }));
        let mut socket = Remainder::new(Stage::Socket, since_arrival - in_process);
        if let Some(receiver) = &delivery.receiver {
            socket.take(Cause::Throttled, receiver.throttled);
            socket.take(Cause::Runnable, receiver.runnable);
        }
        socket.take(Cause::Stopped, self.stopped(in_process, since_arrival));
        parts.extend(socket.finish(Cause::Queue));
        // The middleware kept the message until an earlier one had arrived, or fragments of its own.
        let Repairs {
            of_message,
            of_earlier,
        } = self.repairs;
        let arrivals = [of_message, of_earlier].into_iter().flatten();
        let in_order = arrivals.fold(in_process, Duration::min);
        let receive = Remainder::new(Stage::Receive, in_process - in_order);
        parts.extend(receive.finish(Cause::Repaired));
        parts.extend(self.executor_parts(in_order, Cause::Middleware));
        parts
    }

    /// Divides the wait for a message that came through no socket, or whose way is not known.
    fn handoff_parts(&self, handoff: &Handoff, wait: Duration) -> Vec<Part> {
        let since_woken = handoff.woken_before;
        let Some(received_before) = handoff.received_before else {
            let mut before = Remainder::new(Stage::Wait, wait - since_woken);
            before.take(Cause::Stopped, self.stopped(since_woken, wait));
            let mut parts = before.finish(Cause::Arrival);
            parts.extend(self.woken_parts(handoff));
            return parts;
        };
        let since_received = wait.min(received_before);
        let (stage, cause) = match handoff.sender {
            Some(_) => (Stage::Publish, Cause::Send),
            None => (Stage::Wait, Cause::Arrival),
        };
        let mut parts = Remainder::new(stage, wait - since_received).finish(cause);
        let mut receive = Remainder::new(Stage::Receive, since_received - since_woken);
        // The thread may have been awake before the message was published.
        let awake = received_before.saturating_sub(since_woken);
        let share = |of| share(receive.rest, of, awake);
        let throttled = share(handoff.receiver.throttled);
        let runnable = share(handoff.receiver.runnable);
        receive.take(Cause::Throttled, throttled);
        receive.take(Cause::Runnable, runnable);
        receive.take(Cause::Stopped, self.stopped(since_woken, since_received));
        parts.extend(receive.finish(Cause::Middleware));
        parts.extend(self.woken_parts(handoff));
        parts
    }

    /// Divides the time since the executor's thread was woken.
    fn woken_parts(&self, handoff: &Handoff) -> Vec<Part> {
        let states = self.states_before.map(|states| {
            let before = u64::try_from(handoff.runnable_before.as_nanos()).unwrap_or(u64::MAX);
            ThreadStates {
                runnable: states.runnable.saturating_sub(before),
                ..states
            }
        });
        self.parts_by(states, handoff.woken_before, Cause::Middleware)
    }

    /// Returns for how long the process was stopped between two times before the call. A signal
    /// stops all threads of a process.
    fn stopped(&self, until_before: Duration, from_before: Duration) -> Duration {
        let span = Span {
            began_before: from_before,
            ended_before: until_before,
        };
        let stop = self.stop.as_ref();
        stop.map_or(Duration::ZERO, |stop| span.common(stop.span()))
    }

    /// Divides the last `wait` before the call by what the executor's thread did. `waiting` is the
    /// cause of the time in which that thread waited too.
    fn executor_parts(&self, wait: Duration, waiting: Cause) -> Vec<Part> {
        self.parts_by(self.states_before, wait, waiting)
    }

    /// The same, with what that thread did since the call before.
    fn parts_by(&self, states: Option<ThreadStates>, wait: Duration, waiting: Cause) -> Vec<Part> {
        let mut rest = Remainder::new(Stage::Wait, wait);
        let stop = self.stop.as_ref().map_or(Span::default(), Stop::span);
        let stop = stop.within(wait);
        rest.take(Cause::Stopped, stop.duration());
        // The thread made one call, and waited during another one of the same callback group.
        let mut until = Duration::ZERO;
        for call in [&self.released_by, &self.previous].into_iter().flatten() {
            let span = call.span().within(wait).before(until);
            rest.take(Cause::OtherCallback, span.duration() - span.common(stop));
            until = until.max(span.began_before);
        }
        if let (Some(busy), Some(previous)) = (&self.busy, &self.previous) {
            // Earlier calls, between which the thread did not wait.
            let earlier = Span {
                began_before: busy.began_before,
                ended_before: previous.span().began_before,
            };
            let span = earlier.within(wait).before(until);
            let share = |of| share(span.duration(), of, earlier.duration());
            let in_callbacks = share(busy.in_callbacks.saturating_sub(previous.duration));
            let stopped = span.common(stop);
            rest.take(Cause::OtherCallback, in_callbacks.saturating_sub(stopped));
            let last = self.states_before.unwrap_or_default();
            let between = |all: Duration, last| share(all.saturating_sub(nanoseconds(last)));
            let throttled = between(busy.states.throttled, last.throttled);
            rest.take(Cause::Throttled, throttled);
            rest.take(
                Cause::Runnable,
                between(busy.states.runnable, last.runnable),
            );
        }
        // The thread was between two calls for the remaining time.
        match states {
            Some(states) => {
                rest.take(Cause::Throttled, nanoseconds(states.throttled));
                rest.take(Cause::Runnable, nanoseconds(states.runnable));
                rest.finish(waiting)
            }
            None => rest.finish(Cause::Unexplained),
        }
    }

    fn callback_parts(&self) -> Vec<Part> {
        let mut rest = Remainder::new(Stage::Callback, self.duration);
        let Some(states) = self.states else {
            return rest.finish(Cause::Unexplained);
        };
        let activity = self.activity.as_ref();
        // The CPU time of the accounting may lack a tick, or have one that precedes the call.
        let exact = activity.and_then(|activity| activity.cpu_of(self.duration));
        let cpu = exact.unwrap_or(nanoseconds(states.cpu));
        let stolen = activity.map_or(Duration::ZERO, |activity| activity.stolen.min(cpu));
        rest.take(Cause::Cpu, cpu - stolen);
        rest.take(Cause::Stolen, stolen);
        rest.take(Cause::Throttled, nanoseconds(states.throttled));
        rest.take(Cause::Runnable, nanoseconds(states.runnable));
        let Some(activity) = activity else {
            return rest.finish(Cause::Blocked);
        };
        // With a tick too many, the events show more blocked time.
        let all: Duration = activity.blocked.iter().sum();
        let blocked = rest.rest;
        for (kind, duration) in activity.blocked.iter().enumerate() {
            let share = match all > blocked {
                true => share(blocked, *duration, all),
                false => *duration,
            };
            rest.take(Cause::of_wait(kind), share);
        }
        rest.finish(Cause::Unexplained)
    }

    /// Returns the main part: what made the call late. `usual` is what the time of all calls of the
    /// callback consisted of. A part that each call has explains nothing, unless it exceeds the
    /// bound by itself.
    #[must_use]
    pub fn main_part(&self, usual: ThreadStates) -> Option<Part> {
        let excess = |time: Duration, bound: Duration| time.saturating_sub(bound);
        let in_callback = excess(self.duration, self.bound.duration);
        let in_wait = excess(self.wait.unwrap_or_default(), self.bound.wait);
        let is_wait = in_wait > in_callback;
        let parts = self.parts();
        let parts = || {
            let of_wait = |part: &&Part| (part.stage != Stage::Callback) == is_wait;
            parts.iter().filter(of_wait)
        };
        let largest = parts().max_by_key(|part| part.duration).copied();
        if is_wait || usual.calls == 0 {
            return largest;
        }
        let beyond = |part: &&Part| {
            let mean = |state: usize| {
                let sums = usual.nanoseconds();
                nanoseconds(sums.get(state).copied().unwrap_or_default() / usual.calls)
            };
            let usual = part.cause.state().map_or(Duration::ZERO, mean);
            part.duration.saturating_sub(usual)
        };
        let unusual = parts().max_by_key(beyond);
        let is_large = |part: &&Part| beyond(part) * 4 >= self.duration;
        unusual.filter(is_large).copied().or(largest)
    }

    /// Returns the thread that a cause names: the one that ran instead for longest, released the
    /// lock, continued the process, or sent the message.
    #[must_use]
    pub fn named_by(&self, part: Part) -> Option<&OtherThread> {
        match part.cause {
            Cause::Runnable if part.stage == Stage::Wait => {
                // The rest precedes an earlier call, and has no events.
                let runnable = self.activity_before.as_ref()?.runnable;
                let is_most = runnable * 2 >= part.duration;
                is_most
                    .then(|| self.longest_other_thread(part.stage))
                    .flatten()
            }
            Cause::Runnable => self.longest_other_thread(part.stage),
            Cause::Stopped if part.stage != Stage::Callback => {
                self.stop.as_ref()?.wait.waker.as_ref()
            }
            Cause::Send if self.delivery.is_none() => self.handoff.as_ref()?.sender.as_ref(),
            Cause::Lock | Cause::Stopped => {
                let longest = self.activity(part.stage)?.longest.as_ref()?;
                longest.waker.as_ref()
            }
            _ => None,
        }
    }

    /// Returns the call for which this one waited longest, otherwise the call before in the same
    /// thread.
    #[must_use]
    pub fn waited_for(&self) -> Option<&PreviousCall> {
        let wait = self.wait.unwrap_or_default();
        let longest = self.busy.as_ref().map(|busy| &busy.longest);
        let earlier = [longest, self.released_by.as_ref(), self.previous.as_ref()];
        let earlier = earlier.into_iter().flatten();
        earlier.max_by_key(|call| call.span().within(wait).duration())
    }

    /// Returns the thread that ran instead for longest in this stage. Idle CPUs are left out.
    #[must_use]
    pub fn longest_other_thread(&self, stage: Stage) -> Option<&OtherThread> {
        let others = match (stage, &self.handoff, &self.delivery) {
            // Otherwise they may have run before the message was published. A wait is shorter than
            // the time since then, by that of the fastest message.
            (Stage::Receive, Some(handoff), _)
                if handoff.received_before? <= self.wait? * 9 / 8 =>
            {
                &handoff.others
            }
            // Another thread may have read the socket.
            (Stage::Socket, Some(handoff), Some(delivery))
                if handoff.thread == delivery.receiver_thread =>
            {
                &handoff.others
            }
            (Stage::Receive | Stage::Socket, _, _) => return None,
            _ => &self.activity(stage)?.others,
        };
        let others = others.iter();
        others
            .filter(|other| other.thread != 0)
            .max_by_key(|other| other.duration)
    }

    /// Returns what the executor's thread did in a stage, by events.
    fn activity(&self, stage: Stage) -> Option<&Activity> {
        match stage {
            Stage::Callback => self.activity.as_ref(),
            _ => self.activity_before.as_ref(),
        }
    }
}

impl PreviousCall {
    const fn span(&self) -> Span {
        Span::ending(self.ended_before, self.duration)
    }
}

impl Stop {
    const fn span(&self) -> Span {
        Span::ending(self.ended_before, self.wait.duration)
    }
}

/// A span of time before a call: its begin is the longer time.
#[derive(Clone, Copy, Default)]
struct Span {
    began_before: Duration,
    ended_before: Duration,
}

impl Span {
    const fn ending(ended_before: Duration, duration: Duration) -> Self {
        Self {
            began_before: ended_before.saturating_add(duration),
            ended_before,
        }
    }

    /// Returns the part in the last `time` before the call.
    fn within(self, time: Duration) -> Self {
        Self {
            began_before: self.began_before.min(time),
            ended_before: self.ended_before.min(time),
        }
    }

    /// Returns the part that is earlier than `time` before the call.
    fn before(self, time: Duration) -> Self {
        Self {
            began_before: self.began_before.max(time),
            ended_before: self.ended_before.max(time),
        }
    }

    fn duration(self) -> Duration {
        self.began_before.saturating_sub(self.ended_before)
    }

    /// Returns the time that both have.
    fn common(self, other: Self) -> Duration {
        let began_before = self.began_before.min(other.began_before);
        began_before.saturating_sub(self.ended_before.max(other.ended_before))
    }
}

impl Activity {
    /// Returns the CPU time if the events cover the whole `duration`.
    fn cpu_of(&self, duration: Duration) -> Option<Duration> {
        let blocked: Duration = self.blocked.iter().sum();
        let covered = self.cpu + self.runnable + blocked;
        let is_whole = covered.abs_diff(duration) * 100 <= duration;
        (self.missed_events == 0 && is_whole).then_some(self.cpu)
    }
}

/// The time of a stage that no part has yet.
struct Remainder {
    stage: Stage,
    rest: Duration,
    parts: Vec<Part>,
}

impl Remainder {
    const fn new(stage: Stage, rest: Duration) -> Self {
        Self {
            stage,
            rest,
            parts: Vec::new(),
        }
    }

    fn take(&mut self, cause: Cause, duration: Duration) {
        let duration = duration.min(self.rest);
        self.rest -= duration;
        match self.parts.iter_mut().find(|part| part.cause == cause) {
            Some(part) => part.duration += duration,
            None => self.parts.push(Part {
                stage: self.stage,
                cause,
                duration,
            }),
        }
    }

    fn finish(mut self, cause: Cause) -> Vec<Part> {
        self.take(cause, self.rest);
        self.parts
    }
}

const fn nanoseconds(nanoseconds: u64) -> Duration {
    Duration::from_nanos(nanoseconds)
}

/// Returns `part / all` of a duration.
fn share(of: Duration, part: Duration, all: Duration) -> Duration {
    let nanoseconds = of.as_nanos() * part.as_nanos() / all.as_nanos().max(1);
    Duration::from_nanos(u64::try_from(nanoseconds).unwrap_or(u64::MAX))
}
