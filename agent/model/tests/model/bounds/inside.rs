//! Reports of ever new processes, handles and states, some of them of an announced participant.

use super::*;
use ros2probe_model::facts::calls::late::{LateBound, LateCall, Repairs};
use ros2probe_model::facts::calls::report::{
    CallbackReport, Durations, ProcessReport, PublisherReport, Report, SubscriptionReport,
    ThreadStates, Transition, Trigger,
};
use ros2probe_testing::model::host;
use std::sync::Arc;

const PROCESS: u32 = 0x0101;
/// A participant of Fast DDS in this process.
const BOB: GuidPrefix = GuidPrefix([1, 0x0f, 9, 9, 1, 1, 0, 0, 1, 0, 0, 0]);

/// Reports one process.
pub(super) fn reports(observer: &mut Observer, dice: &mut Dice, now: u64) {
    if dice.pick(1_000) == 0 {
        let payload = forge::participant(BOB, 1_000_000, Some(0));
        let message = Message::from_fast(BOB).data(SPDP, 1, &payload).bytes();
        observer.input(Input::Datagram {
            envelope: &forge::multicast(now, 0),
            payload: &message,
            handover: None,
        });
    }
    let id = match dice.pick(2) {
        0 => PROCESS,
        _ => u32::try_from(dice.pick(3_000)).unwrap(),
    };
    let topic = format!("/t{}", dice.pick(9_000));
    let at = Timestamp(now);
    let publisher = PublisherReport {
        handle: dice.pick(9_000),
        node: None,
        topic: topic.as_str().into(),
        middleware: None,
        published: dice.pick(1_000),
        within_process: 0,
        last: at,
        intervals: Durations::default(),
    };
    let callback = CallbackReport {
        handle: dice.pick(9_000),
        node: None,
        trigger: Trigger::IntraProcess(Some(topic.into())),
        thread: 1,
        calls: dice.pick(1_000),
        last: at,
        durations: Durations::default(),
        waits: Durations::default(),
        skipped: 0,
        states: ThreadStates::default(),
    };
    let process = ProcessReport {
        id,
        has_ended: dice.pick(50) == 0,
        nodes: vec![format!("/n{}", dice.pick(9_000)).into()],
        publishers: vec![publisher],
        callbacks: vec![callback],
        ..ProcessReport::default()
    };
    let transition = Transition {
        process: id,
        node: Some(format!("/n{}", dice.pick(9_000)).into()),
        start: "inactive".into(),
        goal: "active".into(),
        at,
    };
    observer.input(Input::Inside(Report {
        at,
        has_callbacks: true,
        processes: vec![process],
        transitions: vec![transition],
        late: vec![late(id, dice, at)],
    }));
}

/// Returns a late call, one of many of a few callbacks or one of a new callback.
fn late(process: u32, dice: &mut Dice, at: Timestamp) -> LateCall {
    LateCall {
        process,
        handle: match dice.pick(2) {
            0 => 1,
            _ => dice.pick(9_000),
        },
        node: None,
        trigger: Trigger::Timer(None),
        thread: 1,
        cpu: 0,
        source: None,
        started: at,
        duration: Duration::from_millis(dice.pick(1_000)),
        wait: None,
        bound: LateBound {
            duration: Duration::ZERO,
            wait: Duration::MAX,
        },
        delivery: None,
        handoff: None,
        repairs: Repairs::default(),
        cpu_limits: Arc::new([]),
        stop: None,
        released_by: None,
        busy: None,
        previous: None,
        states: None,
        states_before: None,
        activity: None,
        activity_before: None,
    }
}

/// Reports a subscription more often than its queue keeps totals.
pub(super) fn of_a_queue() {
    let mut host = host::Host::new();
    let bob = host.reader(host::BOB, 7411);
    host.owner(bob, host::BOB);
    for number in 1..=200 {
        host.wait(1_000);
        host.data(bob, number);
        let at = Timestamp(host.now);
        let subscription = SubscriptionReport {
            handle: 1,
            node: None,
            topic: "/chatter".into(),
            middleware: None,
            taken: number,
            failed: 0,
            last: at,
            intervals: Durations::default(),
            latency: Durations::default(),
        };
        host.observer.input(Input::Inside(Report {
            at,
            has_callbacks: false,
            processes: vec![ProcessReport {
                id: host::BOB.0[2].into(),
                subscriptions: vec![subscription],
                ..ProcessReport::default()
            }],
            transitions: Vec::new(),
            late: Vec::new(),
        }));
    }
}
