//! Late calls: their parts, their main cause, and what is kept of them.

use std::sync::Arc;
use std::time::Duration;

use ros2probe_model::facts::calls::late::{
    Activity, Blocked, BusyTime, Cause, Handoff, LateBound, LateCall, MessageDelivery,
    PreviousCall, Repairs, Stage, Stop, WaitingStates,
};
use ros2probe_model::facts::calls::other_thread::{OtherThread, Priority};
use ros2probe_model::facts::calls::report::{ProcessReport, Report, ThreadStates, Trigger};
use ros2probe_model::facts::diagnosis::Diagnosis;
use ros2probe_model::facts::tables::WaitingLateCalls;
use ros2probe_model::observe::input::Input;
use ros2probe_wire::Timestamp;
use ros2probe_wire::inside::late::wait;
use ros2probe_wire::time::SECOND;

use super::*;

const START: u64 = 1_700_000_000 * SECOND;

const fn milliseconds(number: u64) -> Duration {
    Duration::from_millis(number)
}

pub(super) const fn states(cpu: u64, throttled: u64, runnable: u64, blocked: u64) -> ThreadStates {
    ThreadStates {
        calls: 1,
        cpu: cpu * 1_000_000,
        throttled: throttled * 1_000_000,
        runnable: runnable * 1_000_000,
        blocked: blocked * 1_000_000,
    }
}

fn other(name: &str, process: u32, duration: u64) -> OtherThread {
    OtherThread {
        duration: milliseconds(duration),
        thread: process,
        process,
        name: name.into(),
        unit: Some("kiosk.service".into()),
        priority: None,
    }
}

/// A call of 100 ms with a bound of 20 ms.
pub(super) fn call(states: ThreadStates) -> LateCall {
    LateCall {
        process: 7,
        handle: 0x40,
        node: Some("/filter".into()),
        trigger: Trigger::Subscription("/points".into()),
        thread: 8,
        cpu: 1,
        source: None,
        started: Timestamp(START),
        duration: milliseconds(100),
        wait: None,
        bound: LateBound {
            duration: milliseconds(20),
            wait: milliseconds(20),
        },
        delivery: None,
        handoff: None,
        repairs: Repairs::default(),
        cpu_limits: Arc::new([]),
        stop: None,
        released_by: None,
        busy: None,
        previous: None,
        states: Some(states),
        states_before: None,
        activity: Some(Activity::default()),
        activity_before: Some(Activity::default()),
    }
}

fn parts(call: &LateCall) -> Vec<(Stage, Cause, u64)> {
    let sum: Duration = call.parts().iter().map(|part| part.duration).sum();
    assert_eq!(sum, call.total(), "{call:?}");
    let parts = call.parts().into_iter().map(|part| {
        let milliseconds = u64::try_from(part.duration.as_millis()).unwrap();
        (part.stage, part.cause, milliseconds)
    });
    parts.collect()
}

#[test]
fn blocked_time_is_divided_by_events_and_the_rest_is_unexplained() {
    let mut late = call(states(10, 5, 15, 70));
    let activity = late.activity.as_mut().unwrap();
    activity.blocked[wait::LOCK] = milliseconds(40);
    activity.blocked[wait::DISK] = milliseconds(20);
    let of = |cause, milliseconds| (Stage::Callback, cause, milliseconds);
    let expected = [
        of(Cause::Cpu, 10),
        of(Cause::Throttled, 5),
        of(Cause::Runnable, 15),
        of(Cause::Lock, 40),
        of(Cause::Disk, 20),
        of(Cause::Unexplained, 10),
    ];
    assert_eq!(parts(&late), expected);
    late.activity = None;
    assert_eq!(parts(&late)[3..], [of(Cause::Blocked, 70)]);
    late.states = None;
    assert_eq!(parts(&late), [of(Cause::Unexplained, 100)]);
}

#[test]
fn events_beyond_the_accounting_are_reduced_to_it() {
    // The accounting has a tick of CPU time that precedes the call.
    let mut late = call(states(10, 0, 0, 90));
    let activity = late.activity.as_mut().unwrap();
    activity.missed_events = 1;
    activity.blocked[wait::SLEEP] = milliseconds(50);
    activity.blocked[wait::OTHER] = milliseconds(50);
    let of = |cause, milliseconds| (Stage::Callback, cause, milliseconds);
    let expected = [
        of(Cause::Cpu, 10),
        of(Cause::Sleep, 45),
        of(Cause::SystemCall, 45),
    ];
    assert_eq!(parts(&late), expected);
}

#[test]
fn complete_events_have_the_exact_cpu_time_of_a_blocked_call() {
    // The last tick of the accounting is not counted yet.
    let mut late = call(states(1, 0, 2, 97));
    let activity = late.activity.as_mut().unwrap();
    activity.cpu = milliseconds(8);
    activity.runnable = milliseconds(2);
    activity.blocked[wait::LOCK] = milliseconds(90);
    let of = |cause, milliseconds| (Stage::Callback, cause, milliseconds);
    let expected = [
        of(Cause::Cpu, 8),
        of(Cause::Runnable, 2),
        of(Cause::Lock, 90),
    ];
    assert_eq!(parts(&late), expected);
    late.activity.as_mut().unwrap().missed_events = 1;
    let expected = [
        of(Cause::Cpu, 1),
        of(Cause::Runnable, 2),
        of(Cause::Lock, 90),
        of(Cause::Unexplained, 7),
    ];
    assert_eq!(parts(&late), expected);
}

#[test]
fn a_wait_is_divided_into_the_callback_before_the_thread_and_the_arrival() {
    let mut late = call(states(100, 0, 0, 0));
    late.wait = Some(milliseconds(80));
    late.states_before = Some(states(1, 0, 5, 14));
    late.previous = Some(PreviousCall {
        handle: 0x50,
        trigger: Trigger::Timer(None),
        duration: milliseconds(40),
        ended_before: milliseconds(20),
    });
    let of = |cause, milliseconds| (Stage::Wait, cause, milliseconds);
    let expected = [
        of(Cause::OtherCallback, 40),
        of(Cause::Runnable, 5),
        of(Cause::Arrival, 35),
    ];
    assert_eq!(parts(&late)[..3], expected);
    // The message came while the callback before it ran.
    late.wait = Some(milliseconds(30));
    assert_eq!(parts(&late)[0], of(Cause::OtherCallback, 10));
    late.previous = None;
    late.states_before = None;
    assert_eq!(parts(&late)[0], of(Cause::Unexplained, 30));
}

/// A call after 90 ms. Its message was sent after 10 ms, arrived after 30 ms, and was received
/// after 60 ms.
fn call_of_a_message() -> LateCall {
    let mut late = call(states(5, 0, 0, 0));
    late.duration = milliseconds(5);
    late.wait = Some(milliseconds(90));
    late.states_before = Some(states(1, 0, 4, 85));
    late.delivery = Some(MessageDelivery {
        sent_before: Some(milliseconds(80)),
        arrived_before: milliseconds(60),
        received_before: milliseconds(30),
        receiver_thread: 44,
        receiver: Some(WaitingStates {
            runnable: milliseconds(3),
            throttled: milliseconds(2),
        }),
    });
    late
}

#[test]
fn a_wait_is_divided_by_the_hops_of_the_message() {
    let mut late = call_of_a_message();
    let expected = [
        (Stage::Publish, Cause::Send, 10),
        (Stage::Network, Cause::Transit, 20),
        (Stage::Socket, Cause::Throttled, 2),
        (Stage::Socket, Cause::Runnable, 3),
        (Stage::Socket, Cause::Queue, 25),
        (Stage::Wait, Cause::Runnable, 4),
        (Stage::Wait, Cause::Middleware, 26),
        (Stage::Callback, Cause::Cpu, 5),
    ];
    assert_eq!(parts(&late), expected);
    let main = late.main_part(ThreadStates::default()).unwrap();
    assert_eq!((main.stage, main.cause), (Stage::Wait, Cause::Middleware));
    // Its publisher is on another host.
    late.delivery.as_mut().unwrap().sent_before = None;
    assert_eq!(parts(&late)[0], (Stage::Network, Cause::Transit, 30));
}

#[test]
fn a_message_that_was_lost_is_late_for_its_retransmission() {
    let mut late = call_of_a_message();
    late.repairs.of_message = Some(milliseconds(60));
    let all = parts(&late);
    assert_eq!(all[0], (Stage::Publish, Cause::Send, 10));
    assert_eq!(all[1], (Stage::Network, Cause::Repaired, 20));
    // Its way is not known otherwise.
    late.delivery = None;
    let expected = [
        (Stage::Network, Cause::Repaired, 30),
        (Stage::Wait, Cause::Runnable, 4),
        (Stage::Wait, Cause::Arrival, 56),
        (Stage::Callback, Cause::Cpu, 5),
    ];
    assert_eq!(parts(&late), expected);
    // The arrival of a message behind another one is not known.
    late.repairs = Repairs {
        of_message: None,
        of_earlier: Some(milliseconds(60)),
    };
    assert_eq!(parts(&late)[1], (Stage::Wait, Cause::Arrival, 86));
}

#[test]
fn a_message_behind_a_lost_one_waits_in_the_middleware_for_its_retransmission() {
    let mut late = call_of_a_message();
    late.repairs.of_earlier = Some(milliseconds(7));
    let expected = [
        (Stage::Publish, Cause::Send, 10),
        (Stage::Network, Cause::Transit, 20),
        (Stage::Socket, Cause::Throttled, 2),
        (Stage::Socket, Cause::Runnable, 3),
        (Stage::Socket, Cause::Queue, 25),
        (Stage::Receive, Cause::Repaired, 23),
        (Stage::Wait, Cause::Runnable, 4),
        (Stage::Wait, Cause::Middleware, 3),
        (Stage::Callback, Cause::Cpu, 5),
    ];
    assert_eq!(parts(&late), expected);
    // Fragments of its own came later than its last one.
    late.repairs.of_message = Some(milliseconds(4));
    assert!(parts(&late).contains(&(Stage::Network, Cause::Repaired, 20)));
    assert!(parts(&late).contains(&(Stage::Receive, Cause::Repaired, 26)));
}

#[test]
fn only_the_latest_time_of_a_delivery_belongs_to_a_shorter_wait() {
    // The usual time of a message is not a part of the wait.
    let mut late = call_of_a_message();
    late.wait = Some(milliseconds(50));
    let socket: Vec<_> = parts(&late);
    assert_eq!(
        socket[..3],
        [
            (Stage::Socket, Cause::Throttled, 2),
            (Stage::Socket, Cause::Runnable, 3),
            (Stage::Socket, Cause::Queue, 15),
        ]
    );
    late.wait = Some(milliseconds(20));
    assert_eq!(parts(&late)[0], (Stage::Wait, Cause::Runnable, 4));
}

#[test]
fn a_callback_before_explains_only_the_time_since_the_message_was_received() {
    let mut late = call_of_a_message();
    late.previous = Some(PreviousCall {
        handle: 0x50,
        trigger: Trigger::Timer(None),
        duration: milliseconds(70),
        ended_before: milliseconds(10),
    });
    let all = parts(&late);
    assert!(
        all.contains(&(Stage::Wait, Cause::OtherCallback, 20)),
        "{all:?}"
    );
    assert!(all.contains(&(Stage::Socket, Cause::Queue, 25)), "{all:?}");
}

#[test]
fn a_stopped_call_has_the_thread_that_continued_the_process() {
    let mut late = call_of_a_message();
    late.delivery.as_mut().unwrap().receiver = None;
    // It was stopped before the message arrived, which is 60 ms before the call.
    late.stop = Some(Stop {
        ended_before: milliseconds(31),
        wait: Blocked {
            duration: milliseconds(500),
            kind: wait::STOPPED,
            call: None,
            argument: 0,
            waker: Some(other("operator", 77, 0)),
        },
    });
    assert!(parts(&late).contains(&(Stage::Socket, Cause::Stopped, 29)));
    let main = late.main_part(ThreadStates::default()).unwrap();
    assert_eq!((main.stage, main.cause), (Stage::Socket, Cause::Stopped));
    assert_eq!(&*late.named_by(main).unwrap().name, "operator");
}

#[test]
fn a_wait_is_explained_by_the_last_callback_of_any_thread() {
    let mut late = call(states(100, 0, 0, 0));
    late.wait = Some(milliseconds(80));
    late.states_before = Some(states(1, 0, 0, 59));
    let earlier = |handle, duration, ended_before| PreviousCall {
        handle,
        trigger: Trigger::Timer(None),
        duration: milliseconds(duration),
        ended_before: milliseconds(ended_before),
    };
    late.previous = Some(earlier(0x50, 30, 60));
    late.released_by = Some(earlier(0x60, 45, 5));
    let expected = [
        (Stage::Wait, Cause::OtherCallback, 65),
        (Stage::Wait, Cause::Arrival, 15),
    ];
    assert_eq!(parts(&late)[..2], expected);
    assert_eq!(late.waited_for().map(|call| call.handle), Some(0x60));
    // The message came while that one ran.
    late.wait = Some(milliseconds(25));
    assert_eq!(parts(&late)[0], (Stage::Wait, Cause::OtherCallback, 20));
}

#[test]
fn earlier_callbacks_explain_the_wait_behind_several_messages() {
    let mut late = call(states(100, 0, 0, 0));
    late.wait = Some(milliseconds(80));
    late.states_before = Some(states(1, 0, 0, 1));
    let earlier = |handle, duration, ended_before| PreviousCall {
        handle,
        trigger: Trigger::Timer(None),
        duration: milliseconds(duration),
        ended_before: milliseconds(ended_before),
    };
    late.previous = Some(earlier(0x50, 8, 2));
    // The thread has been busy for 100 ms, and for 90 ms before the last call.
    late.busy = Some(BusyTime {
        began_before: milliseconds(100),
        in_callbacks: milliseconds(88),
        states: WaitingStates {
            runnable: milliseconds(8),
            throttled: milliseconds(2),
        },
        longest: earlier(0x60, 70, 15),
    });
    let all = parts(&late);
    // Of these 90 ms, 70 are in the wait: 80 of 90 in callbacks, 8 runnable, and 2 throttled.
    let expected = [
        (Stage::Wait, Cause::OtherCallback, 70),
        (Stage::Wait, Cause::Throttled, 1),
        (Stage::Wait, Cause::Runnable, 6),
        (Stage::Wait, Cause::Arrival, 2),
    ];
    assert_eq!(all[..4], expected, "{all:?}");
    assert_eq!(late.waited_for().map(|call| call.handle), Some(0x60));
    let runnable = late.parts()[2];
    assert_eq!(late.named_by(runnable), None, "no event is known");
    // The thread waited for work until 50 ms before the call.
    late.busy.as_mut().unwrap().began_before = milliseconds(50);
    late.busy.as_mut().unwrap().in_callbacks = milliseconds(38);
    assert_eq!(parts(&late)[0], (Stage::Wait, Cause::OtherCallback, 38));
    // It waited for its CPU, made the last call, and then this one.
    let busy = late.busy.as_mut().unwrap();
    busy.in_callbacks = milliseconds(8);
    busy.states.runnable = milliseconds(40);
    assert_eq!(parts(&late)[2], (Stage::Wait, Cause::Runnable, 40));
}

/// A call after 90 ms. Another process woke the middleware's thread after 20 ms, which woke the
/// executor's thread after 70 ms.
fn call_of_a_handoff() -> LateCall {
    let mut late = call_of_a_message();
    late.delivery = None;
    late.handoff = Some(Handoff {
        thread: 44,
        woken_before: milliseconds(20),
        runnable_before: milliseconds(1),
        received_before: Some(milliseconds(70)),
        receiver: WaitingStates {
            runnable: milliseconds(30),
            throttled: milliseconds(5),
        },
        others: vec![other("chromium", 99, 29)],
        sender: Some(other("talker", 55, 0)),
    });
    late
}

#[test]
fn a_wait_without_a_socket_is_divided_by_the_threads_that_passed_the_message() {
    let mut late = call_of_a_handoff();
    let expected = [
        (Stage::Publish, Cause::Send, 20),
        (Stage::Receive, Cause::Throttled, 5),
        (Stage::Receive, Cause::Runnable, 30),
        (Stage::Receive, Cause::Middleware, 15),
        (Stage::Wait, Cause::Runnable, 3),
        (Stage::Wait, Cause::Middleware, 17),
        (Stage::Callback, Cause::Cpu, 5),
    ];
    assert_eq!(parts(&late), expected);
    let main = late.main_part(ThreadStates::default()).unwrap();
    assert_eq!((main.stage, main.cause), (Stage::Receive, Cause::Runnable));
    assert_eq!(&*late.named_by(main).unwrap().name, "chromium");
    let send = late.parts()[0];
    assert_eq!(&*late.named_by(send).unwrap().name, "talker");
    // The thread received it from the network, or a process that does not publish it woke the
    // thread.
    late.handoff.as_mut().unwrap().sender = None;
    assert_eq!(parts(&late)[0], (Stage::Wait, Cause::Arrival, 20));
    // Nor is it known when that thread was woken.
    late.handoff.as_mut().unwrap().received_before = None;
    assert_eq!(parts(&late)[0], (Stage::Wait, Cause::Arrival, 70));
}

#[test]
fn a_thread_awake_before_the_message_does_not_explain_earlier_waits() {
    let mut late = call_of_a_handoff();
    // The middleware's thread was busy with earlier messages.
    late.wait = Some(milliseconds(45));
    let all = parts(&late);
    let expected = [
        (Stage::Receive, Cause::Throttled, 2),
        (Stage::Receive, Cause::Runnable, 15),
        (Stage::Receive, Cause::Middleware, 7),
    ];
    assert_eq!(all[..3], expected, "{all:?}");
    assert_eq!(late.named_by(late.parts()[1]), None);
    // The executor's thread was woken for another message.
    late.wait = Some(milliseconds(19));
    assert_eq!(parts(&late)[1], (Stage::Wait, Cause::Arrival, 15));
}

#[test]
fn a_stop_explains_the_wait_after_the_callback_before() {
    let mut late = call_of_a_message();
    late.delivery = None;
    late.previous = Some(PreviousCall {
        handle: 0x50,
        trigger: Trigger::Timer(None),
        duration: milliseconds(70),
        ended_before: milliseconds(50),
    });
    late.stop = Some(Stop {
        ended_before: milliseconds(10),
        wait: Blocked {
            duration: milliseconds(60),
            kind: wait::STOPPED,
            call: None,
            argument: 0,
            waker: Some(other("operator", 77, 0)),
        },
    });
    // The last 20 ms of that callback belong to the stop.
    let expected = [
        (Stage::Wait, Cause::Stopped, 60),
        (Stage::Wait, Cause::OtherCallback, 20),
    ];
    assert_eq!(parts(&late)[..2], expected);
    let stopped = late.parts()[0];
    assert_eq!(&*late.named_by(stopped).unwrap().name, "operator");
}

#[test]
fn a_part_that_every_call_has_is_not_what_made_one_late() {
    let late = call(states(52, 0, 48, 0));
    let usual = states(50, 0, 0, 0);
    assert_eq!(late.main_part(usual).unwrap().cause, Cause::Runnable);
    let without = ThreadStates::default();
    assert_eq!(late.main_part(without).unwrap().cause, Cause::Cpu);
    // All calls are late in the same way.
    let usual = states(52, 0, 48, 0);
    assert_eq!(late.main_part(usual).unwrap().cause, Cause::Cpu);
}

#[test]
fn the_stage_that_exceeds_its_bound_more_has_the_main_cause() {
    let mut late = call(states(25, 0, 0, 0));
    late.duration = milliseconds(25);
    late.wait = Some(milliseconds(60));
    late.states_before = Some(states(0, 0, 0, 60));
    let main = late.main_part(ThreadStates::default()).unwrap();
    assert_eq!((main.stage, main.cause), (Stage::Wait, Cause::Arrival));
    late.wait = Some(milliseconds(24));
    let main = late.main_part(ThreadStates::default()).unwrap();
    assert_eq!((main.stage, main.cause), (Stage::Callback, Cause::Cpu));
}

#[test]
fn the_thread_that_ran_instead_and_the_holder_of_a_lock_are_named() {
    let mut late = call(states(10, 0, 90, 0));
    let activity = late.activity.as_mut().unwrap();
    activity.others = vec![other("swapper/1", 0, 50), other("chromium", 3121, 40)];
    activity.longest = Some(Blocked {
        duration: milliseconds(5),
        kind: wait::LOCK,
        call: Some("futex".into()),
        argument: 0x7f00,
        waker: Some(other("holder", 99, 0)),
    });
    let named = |cause| {
        let parts = late.parts();
        let part = parts.into_iter().find(|part| part.cause == cause);
        let part = part.unwrap_or(ros2probe_model::facts::calls::late::Part {
            stage: Stage::Callback,
            cause,
            duration: Duration::ZERO,
        });
        late.named_by(part).map(|other| other.name.to_string())
    };
    assert_eq!(named(Cause::Runnable).as_deref(), Some("chromium"));
    assert_eq!(named(Cause::Lock).as_deref(), Some("holder"));
    assert_eq!(named(Cause::Cpu), None);
}

/// Reports late calls at a second.
fn report(observer: &mut Observer, second: u64, calls: u32) {
    report_all(observer, second, calls, 0);
}

/// Reports late calls at a second: those whose thread waited for a CPU, and then those that
/// computed.
fn report_all(observer: &mut Observer, second: u64, calls: u32, computing: u32) {
    let at = Timestamp(START + second * SECOND);
    let computing = (0..computing).map(|_| LateCall {
        started: at,
        ..call(states(100, 0, 0, 0))
    });
    let late = (0..calls).map(|number| {
        let mut late = call(states(10, 0, 90, 0));
        late.started = at;
        late.duration += milliseconds(number.into());
        late.states = Some(states(10, 0, 90 + u64::from(number), 0));
        let activity = late.activity.as_mut().unwrap();
        activity.others = vec![other("chromium", 3121, 90)];
        late
    });
    observer.input(Input::Inside(Report {
        at,
        has_callbacks: true,
        processes: vec![ProcessReport {
            id: 7,
            ..ProcessReport::default()
        }],
        transitions: Vec::new(),
        late: late.chain(computing).collect(),
    }));
    observer.input(Input::Time(at));
}

fn late_findings(observer: &mut Observer, second: u64) -> Vec<Diagnosis> {
    let snapshot = observer.snapshot(Timestamp(START + second * SECOND));
    let findings = snapshot.diagnoses.list.iter();
    let late = findings.filter(|finding| finding.kind() == "late_callback");
    late.cloned().collect()
}

#[test]
fn three_late_calls_in_a_minute_are_a_finding_with_the_cause_until_the_minute_is_over() {
    let mut observer = Observer::new(Settings::default());
    for second in 0..5 {
        report(&mut observer, second, u32::from(second < 2));
    }
    assert_eq!(late_findings(&mut observer, 4), [], "two calls");
    for second in 5..12 {
        report(&mut observer, second, u32::from(second == 5));
    }
    let found = late_findings(&mut observer, 11);
    let [
        Diagnosis::LateCallback {
            callback,
            calls,
            stage,
            cause,
            by,
            ..
        },
    ] = &found[..]
    else {
        panic!("{found:?}");
    };
    assert_eq!(callback.node.as_deref(), Some("/filter"));
    assert_eq!(
        (*calls, *stage, *cause),
        (3, Stage::Callback, Cause::Runnable)
    );
    let by = by.as_ref().map(ToString::to_string);
    assert_eq!(by.as_deref(), Some("chromium (kiosk.service)"));
    for second in 12..90 {
        report(&mut observer, second, 0);
    }
    assert_eq!(late_findings(&mut observer, 89), []);
}

#[test]
fn a_finding_does_not_return_with_the_next_client() {
    let mut observer = Observer::new(Settings::default());
    for second in 0..10 {
        report(&mut observer, second, u32::from(second < 3));
    }
    assert_eq!(late_findings(&mut observer, 9).len(), 1);
    observer.input(Input::InsideDetached);
    observer.input(Input::Time(Timestamp(START + 3600 * SECOND)));
    assert_eq!(late_findings(&mut observer, 3600), []);
    let at = Timestamp(START + 3601 * SECOND);
    let process = |id| ProcessReport {
        id,
        // Another finding, so that all are determined again.
        is_suspended: id == 8,
        ..ProcessReport::default()
    };
    observer.input(Input::Inside(Report {
        at,
        has_callbacks: true,
        processes: [7, 8].map(process).into(),
        ..Report::default()
    }));
    observer.input(Input::Time(at));
    assert_eq!(late_findings(&mut observer, 3601), []);
    let facts = observer.snapshot(at).inside;
    assert_eq!(facts.unwrap().late[0].calls, 3, "the calls are kept");
}

#[test]
fn a_finding_keeps_its_cause_and_calls_while_calls_with_another_cause_follow() {
    let mut observer = Observer::new(Settings::default());
    let facts = |observer: &mut Observer, second| {
        let found = late_findings(observer, second);
        let [finding] = &found[..] else {
            panic!("{found:?} after {second} s");
        };
        let Diagnosis::LateCallback {
            calls, cause, by, ..
        } = finding
        else {
            panic!("{finding:?}");
        };
        (*calls, *cause, by.is_some())
    };
    report_all(&mut observer, 0, 3, 0);
    for second in 1..55 {
        // All calls that are kept with their parts compute.
        report_all(&mut observer, second, 0, u32::from(second < 13));
        if second > 3 {
            assert_eq!(facts(&mut observer, second), (3, Cause::Runnable, true));
        }
    }
    // Those of the first cause are older than a minute.
    for second in 55..65 {
        report_all(&mut observer, second, 0, 0);
    }
    assert_eq!(facts(&mut observer, 64), (12, Cause::Cpu, false));
}

#[test]
fn the_longest_and_the_last_calls_are_kept_after_the_process_has_ended() {
    let mut observer = Observer::new(Settings::default());
    report(&mut observer, 0, 100);
    report(&mut observer, 1, 3);
    observer.input(Input::Inside(Report {
        at: Timestamp(START + 2 * SECOND),
        has_callbacks: true,
        processes: vec![ProcessReport {
            id: 7,
            has_ended: true,
            ..ProcessReport::default()
        }],
        ..Report::default()
    }));
    let snapshot = observer.snapshot(Timestamp(START + 2 * SECOND));
    let inside = snapshot.inside.as_deref().unwrap();
    let [late] = &inside.late[..] else {
        panic!("{:?}", inside.late);
    };
    assert_eq!(late.calls, 103);
    assert_eq!(late.causes, [((Stage::Callback, Cause::Runnable), 103)]);
    assert_eq!(late.longest.len(), 4);
    let least = late.longest.iter().map(|each| each.call.duration).min();
    assert_eq!(least, Some(milliseconds(196)), "the four longest");
    let latest: Vec<_> = late.latest.iter().map(|each| each.call.started).collect();
    assert_eq!(latest.len(), 4);
    assert_eq!(latest[1..], [Timestamp(START + SECOND); 3]);
    let sum: Duration = late.sums.iter().map(|(_, sum)| *sum).sum();
    let history = late
        .history
        .iter()
        .map(|entry| entry.total)
        .sum::<Duration>();
    assert_eq!(sum, history, "103 calls fit into the history");
    assert_eq!(
        late.history.back().unwrap().other_thread,
        Some(other("chromium", 3121, 90).label())
    );
}

#[test]
fn another_thread_is_named_with_its_unit_and_an_unusual_priority() {
    let mut thread = other("chromium", 3121, 90);
    assert_eq!(thread.to_string(), "chromium (3121, kiosk.service)");
    let named = |number| Priority::of_kernel(number).map(|it| it.to_string());
    for (number, words) in [
        (-1, "deadline"),
        (0, "real-time 99"),
        (98, "real-time 1"),
        (100, "nice -20"),
        (120, "nice 0"),
        (139, "nice 19"),
    ] {
        assert_eq!(named(number).as_deref(), Some(words));
    }
    for unknown in [i64::MIN, -2, 99, 140, i64::MAX] {
        assert_eq!(named(unknown), None);
    }
    thread.priority = Priority::of_kernel(49);
    thread.unit = None;
    assert_eq!(thread.to_string(), "chromium (3121, real-time 50)");
    thread.priority = Priority::of_kernel(120);
    assert_eq!(thread.to_string(), "chromium (3121)");
    assert_eq!(thread.label().to_string(), "chromium");
}

#[test]
fn late_calls_beyond_the_cap_until_the_next_output_are_counted() {
    let mut observer = Observer::new(Settings::default());
    report(&mut observer, 0, 600);
    report(&mut observer, 1, 600);
    let late = observer.drain().late_calls;
    let [cap, beyond] = [WaitingLateCalls::CAP, 1200 - WaitingLateCalls::CAP];
    assert_eq!((late.calls.len(), late.lost), (cap, beyond as u64));
    let (_, first) = &late.calls[0];
    assert_eq!(first.main.unwrap().cause, Cause::Runnable);
    report(&mut observer, 2, 1);
    let late = observer.drain().late_calls;
    assert_eq!((late.calls.len(), late.lost), (1, 0));
}
