//! Late calls, each with an injected cause.

use std::process::Command;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, mpsc};
use std::time::{Duration, Instant};

use ros2probe_model::facts::calls::late::{Cause, LateCall, Stage};
use ros2probe_model::facts::calls::other_thread::Priority;
use ros2probe_model::facts::calls::report::{ThreadStates, Trigger};
use ros2probe_testing::harness::cgroup::Cgroup;
use ros2probe_wire::inside::late::{Bound, PER_SECOND, THREAD_CAPACITY, mode};
use ros2probe_wire::inside::{Counter, Handle, kind};

use super::deliveries::is_busy;
use super::thread_states::{Hog, limit_to_five_percent};
use super::{Process, Robot};

/// Calls that take longer are late.
const BOUND: Duration = Duration::from_millis(5);

/// Time after which a busy machine has shown enough calls.
pub(super) const PATIENCE: Duration = Duration::from_secs(60);

/// Maximum number of threads that are named for a span of a late call.
pub(super) const MAX_NAMED_THREADS: usize = 4;

/// A process whose late calls are observed, by the scheduler's events.
pub(super) fn started() -> (Robot, Process) {
    let mut robot = Robot::new(248, &[], true);
    robot.attach();
    let mut process = robot.start();
    process.run("init");
    process.run("compute 1 10");
    process.run("enqueue 1");
    process.run("receive 1 10");
    set_bounds(&mut robot, &process);
    (robot, process)
}

/// Observes the scheduler's events, and calls late beyond [`BOUND`].
pub(super) fn set_bounds(robot: &mut Robot, process: &Process) {
    robot.events = Some(robot.programs.observe_scheduler().unwrap());
    robot.tables.set_late_mode(mode::EVENTS).unwrap();
    let report = robot.report(process);
    for callback in &report.callbacks {
        let nanoseconds = u64::try_from(BOUND.as_nanos()).unwrap();
        let bound = Bound {
            duration: nanoseconds,
            delay: nanoseconds,
            ..Bound::default()
        };
        let handle = Handle {
            address: callback.handle,
            process: process.child.id(),
            kind: kind::CALLBACK,
        };
        robot.tables.set_bound(handle, bound).unwrap();
    }
}

/// Runs a command of callbacks, and returns the late ones.
pub(super) fn late(robot: &mut Robot, process: &mut Process, command: &str) -> Vec<LateCall> {
    process.run(command);
    robot.round().report.late
}

/// Is true if the kernel has skipped no event of the call.
pub(super) fn is_complete(call: &LateCall) -> bool {
    let activity = call.activity.as_ref();
    activity.is_none_or(|activity| activity.missed_events == 0)
}

/// Returns the calls whose events are complete: on a busy machine the kernel may skip an event of
/// some of them.
fn complete(calls: &[LateCall]) -> Vec<&LateCall> {
    let complete: Vec<_> = calls.iter().filter(|call| is_complete(call)).collect();
    assert!(complete.len() * 2 > calls.len(), "{calls:#?}");
    complete
}

/// Asserts that each call is late for this cause, which took this share of its time or more. On a
/// busy machine, a call may also wait for a CPU, even for longer. That time is left out.
fn assert_cause(calls: &[LateCall], number: usize, cause: Cause, share: f64) {
    assert_eq!(calls.len(), number, "{calls:#?}");
    for call in complete(calls) {
        let parts = call.parts();
        let sum: Duration = parts.iter().map(|part| part.duration).sum();
        assert_eq!(sum, call.total(), "{call:#?}");
        let named = call.main_part(ThreadStates::default()).unwrap();
        assert!(
            named.cause == cause || is_busy(&named),
            "{parts:?} {call:#?}"
        );
        let own: Vec<_> = parts.iter().filter(|part| !is_busy(part)).collect();
        let main = own.iter().max_by_key(|part| part.duration).unwrap();
        assert_eq!(main.cause, cause, "{parts:?} {call:#?}");
        let sum: Duration = own.iter().map(|part| part.duration).sum();
        let of_all = main.duration.as_secs_f64() / sum.as_secs_f64();
        assert!(of_all >= share, "{parts:?} {call:#?}");
    }
}

#[test]
fn a_call_that_sleeps_names_the_system_call() {
    let (mut robot, mut process) = started();
    let calls = late(&mut robot, &mut process, "sleep 10 20000");
    assert_cause(&calls, 10, Cause::Sleep, 0.5);
    for call in complete(&calls) {
        let longest = call.activity.as_ref().unwrap().longest.as_ref().unwrap();
        assert_eq!(longest.call.as_deref(), Some("clock_nanosleep"));
        assert!(longest.duration >= Duration::from_millis(20), "{longest:?}");
    }
}

#[test]
fn a_call_that_computes_names_no_one() {
    let (mut robot, mut process) = started();
    let calls = late(&mut robot, &mut process, "compute 5 20000");
    assert_eq!(calls.len(), 5, "{calls:#?}");
    for call in &calls {
        let main = call.main_part(ThreadStates::default()).unwrap();
        // On a busy machine another thread may run instead.
        assert!(
            matches!(main.cause, Cause::Cpu | Cause::Runnable | Cause::Stolen),
            "{call:#?}"
        );
    }
}

#[test]
fn calls_within_the_bound_name_nothing() {
    let (mut robot, mut process) = started();
    robot.round();
    let calls = late(&mut robot, &mut process, "compute 300 50");
    // On a busy machine, another thread may run instead for longer than the bound.
    for call in calls.iter().filter(|call| is_complete(call)) {
        let main = call.main_part(ThreadStates::default()).unwrap();
        assert!(is_busy(&main), "{call:#?}");
    }
    // Late calls are still reported.
    let begun = Instant::now();
    while late(&mut robot, &mut process, "sleep 1 20000").is_empty() {
        assert!(begun.elapsed() < PATIENCE);
    }
}

#[test]
fn a_call_beside_a_busy_thread_names_that_thread() {
    let (mut robot, mut process) = started();
    pin(&process);
    let name = format!("r2p-{}-kiosk.service", std::process::id());
    let unit = Cgroup::create(&name).unwrap();
    let hog = Hog::on("0");
    std::fs::write(unit.path().join("cgroup.procs"), hog.0.id().to_string()).unwrap();
    let calls = late(&mut robot, &mut process, "compute 10 60000");
    assert_eq!(calls.len(), 10, "{calls:#?}");
    for call in &calls {
        let states = call.states.unwrap();
        let runnable = Duration::from_nanos(states.runnable);
        assert!(runnable >= call.duration / 5, "{call:#?}");
        let others = &call.activity.as_ref().unwrap().others;
        let named: Duration = others.iter().map(|other| other.duration).sum();
        // A busy machine has further threads, of which the longest ones are named. The kernel may
        // skip an event there. Of threads whose ids end with the same bits, one is named.
        let is_whole = others.len() < MAX_NAMED_THREADS && is_complete(call);
        assert!(!is_whole || named * 2 >= runnable, "{call:#?}");
        let hog = others.iter().find(|other| other.process == hog.0.id());
        let hog = hog.unwrap_or_else(|| panic!("{call:#?}"));
        assert_eq!(hog.unit.as_deref(), Some(&*name), "{call:#?}");
        // SAFETY: no preconditions.
        let nice = unsafe { libc::getpriority(libc::PRIO_PROCESS, 0) };
        assert_eq!(hog.priority, Some(Priority::Nice(nice.try_into().unwrap())));
    }
}

#[test]
fn a_call_beside_a_thread_of_another_process_names_that_process() {
    let (mut robot, mut process) = started();
    pin(&process);
    let is_over = Arc::new(AtomicBool::new(false));
    let until = Arc::clone(&is_over);
    let (pinned, is_pinned) = mpsc::channel();
    let hog = std::thread::spawn(move || {
        // SAFETY: no preconditions.
        let thread = unsafe { libc::gettid() };
        let arguments = ["-pc", "0", &thread.to_string()];
        let output = Command::new("taskset").args(arguments).output();
        assert!(output.unwrap().status.success());
        pinned.send(thread.cast_unsigned()).unwrap();
        while !until.load(Ordering::Relaxed) {}
    });
    let thread = is_pinned.recv().unwrap();
    let begun = Instant::now();
    // On a busy machine, further threads of this CPU may be the longest ones.
    loop {
        let calls = late(&mut robot, &mut process, "compute 10 60000");
        let others = calls
            .iter()
            .flat_map(|call| &call.activity.as_ref().unwrap().others);
        let hogs: Vec<_> = others.filter(|other| other.thread == thread).collect();
        assert!(
            hogs.iter().all(|hog| hog.process == std::process::id()),
            "{calls:#?}"
        );
        if !hogs.is_empty() {
            break;
        }
        assert!(begun.elapsed() < PATIENCE, "{calls:#?}");
    }
    is_over.store(true, Ordering::Relaxed);
    hog.join().unwrap();
}

#[test]
fn a_call_beside_a_real_time_thread_names_that_thread() {
    let (mut robot, mut process) = started();
    pin(&process);
    let _hog = Hog::real_time("0");
    let calls = late(&mut robot, &mut process, "compute 10 60000");
    let is_named = |call: &LateCall| {
        let delaying_thread = call.longest_other_thread(Stage::Callback);
        delaying_thread.is_some_and(|delaying_thread| {
            &*delaying_thread.name == "sh"
                && delaying_thread.priority == Some(Priority::RealTime(50))
        })
    };
    let named = calls.iter().filter(|call| is_named(call)).count();
    assert!(named >= 8, "{calls:#?}");
}

#[test]
fn a_call_that_waits_for_a_lock_names_its_holder() {
    let (mut robot, mut process) = started();
    let name = format!("r2p-{}-filter.service", std::process::id());
    let unit = Cgroup::create(&name).unwrap();
    let id = process.child.id().to_string();
    std::fs::write(unit.path().join("cgroup.procs"), id).unwrap();
    let waits_for_lock = |call: &LateCall| {
        let mut parts = call.parts().into_iter();
        parts.any(|part| part.cause == Cause::Lock && part.duration >= BOUND)
    };
    let begun = Instant::now();
    let mut calls: Vec<LateCall> = Vec::new();
    // On a busy machine, the process may lose its CPU between the holder's lock and its own.
    let held = loop {
        calls.extend(late(&mut robot, &mut process, "lock 10 30000"));
        let complete = calls.iter().filter(|call| is_complete(call));
        let (held, free): (Vec<LateCall>, Vec<LateCall>) =
            complete.cloned().partition(waits_for_lock);
        for call in free {
            let main = call.main_part(ThreadStates::default()).unwrap();
            assert!(is_busy(&main), "{call:#?}");
        }
        if held.len() >= 8 {
            break held;
        }
        assert!(begun.elapsed() < PATIENCE, "{calls:#?}");
    };
    assert_cause(&held, held.len(), Cause::Lock, 0.3);
    for call in &held {
        let activity = call.activity.as_ref().unwrap();
        let longest = activity.longest.as_ref().unwrap();
        assert_eq!(longest.call.as_deref(), Some("futex"), "{call:#?}");
        let waker = longest.waker.as_ref().unwrap();
        assert_eq!(&*waker.name, "lock-holder", "{call:#?}");
        assert_eq!(waker.unit.as_deref(), Some(&*name), "{call:#?}");
        assert_eq!(waker.process, process.child.id());
    }
}

#[test]
fn a_call_that_waits_for_the_disk_names_the_system_call() {
    let (mut robot, mut process) = started();
    let file = tempfile::NamedTempFile::new_in(env!("CARGO_TARGET_TMPDIR")).unwrap();
    let path = file.path().display();
    let calls = late(&mut robot, &mut process, &format!("disk 5 16384 {path}"));
    assert!(!calls.is_empty());
    for call in &calls {
        let disk = call
            .parts()
            .into_iter()
            .find(|part| part.cause == Cause::Disk);
        assert!(disk.is_some(), "{call:#?}");
    }
}

#[test]
fn a_call_that_waits_for_its_pages_is_named_so() {
    let (mut robot, mut process) = started();
    let file = tempfile::NamedTempFile::new_in(env!("CARGO_TARGET_TMPDIR")).unwrap();
    let path = file.path().display();
    process.run(&format!("disk 1 16384 {path}"));
    let calls = late(&mut robot, &mut process, &format!("fault 5 0 {path}"));
    let calls: Vec<_> = calls.iter().skip(1).collect();
    assert!(!calls.is_empty());
    for call in calls {
        let parts = call.parts();
        let fault = parts.iter().find(|part| part.cause == Cause::PageFault);
        assert!(fault.is_some(), "{call:#?}");
    }
}

#[test]
fn a_stopped_call_names_the_thread_that_continued_it() {
    let (mut robot, mut process) = started();
    let id = process.child.id().cast_signed();
    let stop = move || {
        for _ in 0..10 {
            std::thread::sleep(Duration::from_millis(30));
            // SAFETY: signals a child of this test.
            unsafe { libc::kill(id, libc::SIGSTOP) };
            std::thread::sleep(Duration::from_millis(60));
            // SAFETY: as above.
            unsafe { libc::kill(id, libc::SIGCONT) };
        }
    };
    let is_stopped = |call: &&LateCall| {
        let longest = call.activity.as_ref().unwrap().longest.as_ref();
        let waker = longest.and_then(|longest| longest.waker.as_ref());
        let mut parts = call.parts().into_iter();
        let part = parts.find(|part| part.cause == Cause::Stopped);
        waker.is_some_and(|waker| waker.process == std::process::id())
            && part.is_some_and(|part| part.duration >= Duration::from_millis(20))
    };
    let begun = Instant::now();
    let mut calls: Vec<LateCall> = Vec::new();
    // On a busy machine, a stopped process may wait longer for a CPU than for its signal.
    loop {
        let stops = std::thread::spawn(stop);
        calls.extend(late(&mut robot, &mut process, "compute 10 80000"));
        stops.join().unwrap();
        if calls.iter().filter(is_stopped).count() >= 4 {
            return;
        }
        assert!(begun.elapsed() < PATIENCE, "{calls:#?}");
    }
}

#[test]
fn a_call_beyond_the_quota_of_its_control_group_is_throttled() {
    let (mut robot, mut process) = started();
    let _quota = limit_to_five_percent(&process);
    let calls = late(&mut robot, &mut process, "compute 5 200000");
    assert_eq!(calls.len(), 5, "{calls:#?}");
    // On a busy machine, a call that gets no CPU in all its time uses up no quota.
    let is_throttled = |call: &LateCall| {
        let mut parts = call.parts().into_iter();
        parts.any(|part| part.cause == Cause::Throttled)
    };
    let (throttled, others): (Vec<LateCall>, Vec<LateCall>) =
        calls.into_iter().partition(is_throttled);
    assert!(!throttled.is_empty(), "{others:#?}");
    assert_cause(&throttled, throttled.len(), Cause::Throttled, 0.4);
    for call in others {
        let main = call.main_part(ThreadStates::default()).unwrap();
        assert!(is_busy(&main), "{call:#?}");
    }
}

#[test]
fn a_call_that_waits_for_another_callback_names_it() {
    let (mut robot, mut process) = started();
    // On a busy machine, the process would wait for the second command.
    process.begin("enqueue 3");
    process.begin("receive 3 30000");
    process.end("enqueue");
    process.end("receive");
    let calls = robot.round().report.late;
    assert_eq!(calls.len(), 3, "{calls:#?}");
    for (index, call) in (0..).zip(&calls) {
        let main = call.main_part(ThreadStates::default()).unwrap();
        if index == 0 {
            let is_short = call.wait.is_none_or(|wait| wait < call.duration / 4);
            assert!(!is_short || main.stage == Stage::Callback, "{call:#?}");
            let mut parts = call.parts().into_iter();
            let has_other = parts.any(|part| part.cause == Cause::OtherCallback);
            assert!(!has_other, "{call:#?}");
            continue;
        }
        let mut parts = call.parts().into_iter();
        let other = parts.find(|part| part.cause == Cause::OtherCallback);
        let other = other.unwrap();
        assert!(
            other.duration >= Duration::from_millis(29) * index,
            "{call:#?}"
        );
        let previous = call.previous.as_ref().unwrap();
        assert_eq!(previous.handle, call.handle);
    }
}

#[test]
fn a_call_that_waits_for_a_callback_of_another_thread_names_it() {
    let (mut robot, mut process) = started();
    let id = process.child.id();
    // The delay of a message is its time beyond the fastest one, and the thread is followed.
    process.run("group 4 1");
    set_bounds(&mut robot, &process);
    process.run("group 2 1");
    robot.round();
    let of_messages = |call: &LateCall| matches!(call.trigger, Trigger::Subscription(_));
    let is_named = |call: &&LateCall| {
        let main = call.main_part(ThreadStates::default());
        main.is_some_and(|main| main.cause == Cause::OtherCallback)
    };
    // On a busy machine, the other thread may wait for a CPU before it wakes this one.
    let begun = Instant::now();
    let mut all: Vec<LateCall> = Vec::new();
    let named: Vec<_> = loop {
        let mut calls = late(&mut robot, &mut process, "group 5 60000");
        calls.retain(of_messages);
        assert_eq!(calls.len(), 5, "{calls:#?}");
        all.extend(calls);
        if all.iter().filter(is_named).count() >= 3 {
            break all.iter().filter(is_named).collect();
        }
        assert!(begun.elapsed() < PATIENCE, "{all:#?}");
    };
    for call in named {
        assert_eq!(call.thread, id, "{call:#?}");
        let other = call.waited_for().unwrap();
        assert!(matches!(other.trigger, Trigger::Timer(_)), "{call:#?}");
        assert!(other.duration >= Duration::from_millis(60), "{call:#?}");
        assert_ne!(call.previous.as_ref(), Some(other));
    }
}

#[test]
fn a_thread_is_followed_again_after_more_threads_than_the_cap() {
    let (mut robot, mut process) = started();
    process.run(&format!("threads {}", THREAD_CAPACITY + 200));
    robot.round();
    let calls = late(&mut robot, &mut process, "sleep 10 20000");
    assert_eq!(calls.len(), 10, "{calls:#?}");
    for call in complete(&calls) {
        let longest = call.activity.as_ref().unwrap().longest.as_ref().unwrap();
        assert_eq!(longest.call.as_deref(), Some("clock_nanosleep"));
    }
}

#[test]
fn late_calls_beyond_the_rate_are_skipped_and_counted() {
    let (mut robot, mut process) = started();
    let calls = late(&mut robot, &mut process, "sleep 100 6000");
    let skipped = robot.counter(Counter::LateSkipped);
    assert_eq!(calls.len() as u64 + skipped, 100);
    // 100 calls of 6 ms belong to two seconds or more on a busy machine.
    assert!(calls.len() as u64 >= PER_SECOND && skipped > 0, "{skipped}");
}

/// Measures a hundred late calls of each cause: how often the main cause is the injected one, and
/// how far the sums are from those that the process reads from the kernel.
#[test]
#[ignore = "a measurement of two minutes: run it alone, with --no-capture"]
fn measure_the_causes_of_a_hundred_calls_each() {
    let file = tempfile::NamedTempFile::new_in(env!("CARGO_TARGET_TMPDIR")).unwrap();
    let path = file.path().display();
    let plain = |command: &str| command.to_owned();
    let causes = [
        (plain("sleep 10 20000"), Cause::Sleep),
        (plain("lock 10 30000"), Cause::Lock),
        (plain("compute 10 30000"), Cause::Cpu),
        (format!("disk 10 16384 {path}"), Cause::Disk),
        (format!("fault 10 0 {path}"), Cause::PageFault),
        (plain("compute 10 30000 hog"), Cause::Runnable),
        (plain("compute 10 30000 real-time"), Cause::Runnable),
        (plain("compute 10 60000 quota"), Cause::Throttled),
    ];
    for (command, cause) in causes {
        let (mut robot, mut process) = started();
        let is_beside = |word: &str| command.ends_with(word);
        let hog = match () {
            () if is_beside("hog") => Some(Hog::on("0")),
            () if is_beside("real-time") => Some(Hog::real_time("0")),
            () => None,
        };
        if hog.is_some() {
            pin(&process);
        }
        let _quota = is_beside("quota").then(|| limit_to_five_percent(&process));
        let (mut all, mut right, mut named) = (0, 0, 0);
        let mut truth = [Duration::ZERO; 2];
        let mut measured = [Duration::ZERO; 2];
        for _ in 0..10 {
            let answer = process.run(&command);
            let mut sums = answer
                .split_whitespace()
                .map_while(|word| word.parse().ok());
            truth
                .iter_mut()
                .for_each(|sum| *sum += Duration::from_nanos(sums.next().unwrap()));
            let calls = robot.round().report.late;
            for call in &calls {
                all += 1;
                let main = call.main_part(ThreadStates::default()).unwrap();
                right += u32::from(main.cause == cause);
                let parts = call.parts();
                let sum = |causes: &[Cause]| -> Duration {
                    let parts = parts.iter().filter(|part| causes.contains(&part.cause));
                    parts.map(|part| part.duration).sum()
                };
                measured[0] += sum(&[Cause::Cpu, Cause::Stolen]);
                measured[1] += sum(&[Cause::Runnable, Cause::Throttled]);
                let by = call.named_by(main).map(|other| other.name.to_string());
                named += u32::from(matches!(by.as_deref(), Some("sh" | "lock-holder")));
            }
            std::thread::sleep(Duration::from_secs(1));
        }
        println!(
            "{command:.24}: {all} late, {right} by {}, {named} named; CPU {:?} of {:?}, waiting {:?} of {:?}",
            cause.label(),
            measured[0],
            truth[0],
            measured[1],
            truth[1]
        );
    }
}

/// Binds the process to the first CPU.
pub(super) fn pin(process: &Process) {
    let id = process.child.id().to_string();
    let pinned = Command::new("taskset").args(["-pc", "0", &id]).output();
    assert!(pinned.unwrap().status.success());
}
