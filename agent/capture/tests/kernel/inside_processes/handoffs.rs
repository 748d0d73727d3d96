//! Messages through shared memory: another process wakes a thread of the middleware, and that
//! thread wakes the executor's thread.

use std::fs;
use std::process::Command;
use std::thread::sleep;
use std::time::{Duration, Instant};

use ros2probe_model::facts::calls::late::{Cause, LateCall, Part, Stage};
use ros2probe_model::facts::calls::other_thread::OtherThread;
use ros2probe_model::facts::calls::report::ThreadStates;
use tempfile::NamedTempFile;

use super::deliveries::{LATE, assert_late_for, is_busy};
use super::late::{MAX_NAMED_THREADS, set_bounds};
use super::thread_states::{Hog, exhaust, limit_to_five_percent, wait_until_stopped};
use super::{Process, Robot};

/// A subscriber with a thread of the middleware, and a publisher that shares memory with it.
struct Subscriber {
    robot: Robot,
    process: Process,
    publisher: Process,
    port: NamedTempFile,
}

impl Subscriber {
    fn new() -> Subscriber {
        Self::of("/in")
    }

    /// Starts a publisher of this topic, and a subscriber to `/in`.
    fn of(topic: &str) -> Subscriber {
        let port = NamedTempFile::new().unwrap();
        port.as_file().set_len(16).unwrap();
        let mut robot = Robot::new(248, &[], true);
        robot.attach();
        let mut process = robot.start();
        process.run("init");
        process.run(&format!("listen 0 0 {}", port.path().display()));
        let program = robot.program.program();
        let mut publisher = Process::with(&program, &["/unused", topic, "talker"]);
        publisher.run("init");
        let mut subscriber = Subscriber {
            robot,
            process,
            publisher,
            port,
        };
        // The delay of a message is its time beyond the fastest one.
        let (mut passes, mut is_fast) = (0, false);
        while passes < 3 || !is_fast {
            assert!(passes < 1000, "no message passes fast");
            let begun = Instant::now();
            subscriber.pass(Duration::ZERO);
            is_fast |= begun.elapsed() < LATE / 5;
            passes += 1;
        }
        set_bounds(&mut subscriber.robot, &subscriber.process);
        // The executor's thread is followed from its first call on, then the listener.
        for _ in 0..3 {
            subscriber.pass(Duration::ZERO);
        }
        subscriber.robot.round();
        subscriber
    }

    /// Sends a message that was published some time ago, and lets the executor take it.
    fn pass(&mut self, ago: Duration) {
        self.process.begin("shared 1 0");
        self.send_to_waiting(ago);
        self.process.end("shared");
    }

    /// Sends a message when all threads of the process wait.
    fn send_to_waiting(&mut self, ago: Duration) {
        while !self.is_waiting() {
            sleep(Duration::from_millis(1));
        }
        self.send(ago);
    }

    fn send(&mut self, ago: Duration) {
        let path = self.port.path().display();
        let command = format!("send 0 {} {path}", ago.as_micros());
        self.publisher.run(&command);
    }

    fn is_waiting(&self) -> bool {
        self.tasks().iter().all(|task| {
            let call = fs::read_to_string(format!("{task}/syscall")).unwrap_or_default();
            call.split(' ').next() == Some(&libc::SYS_futex.to_string())
        })
    }

    fn tasks(&self) -> Vec<String> {
        let tasks = format!("/proc/{}/task", self.process.child.id());
        let tasks = fs::read_dir(tasks).unwrap().flatten();
        tasks
            .map(|task| task.path().display().to_string())
            .collect()
    }

    /// Returns the thread id of the middleware's thread.
    fn listener(&self) -> String {
        let is_listener = |task: &&String| {
            let name = fs::read_to_string(format!("{task}/comm")).unwrap_or_default();
            name.trim_end() == "dds-listener"
        };
        let tasks = self.tasks();
        let task = tasks.iter().find(is_listener).unwrap();
        task.rsplit('/').next().unwrap().to_owned()
    }

    fn one_late_call(&mut self) -> LateCall {
        let mut calls = self.robot.round().report.late;
        assert_eq!(calls.len(), 1, "{calls:#?}");
        calls.remove(0)
    }
}

#[test]
fn a_message_that_is_put_late_into_shared_memory_names_the_publisher() {
    let mut subscriber = Subscriber::new();
    subscriber.pass(LATE);
    let call = subscriber.one_late_call();
    let late = assert_late_for(&call, Stage::Publish, Cause::Send);
    let named = call.named_by(late);
    assert_eq!(
        named.map(|it| it.process),
        Some(subscriber.publisher.child.id()),
        "{call:#?}"
    );
    let handoff = call.handoff.as_ref().unwrap();
    assert_eq!(handoff.thread.to_string(), subscriber.listener());
}

#[test]
fn a_process_that_does_not_publish_the_topic_is_not_named() {
    let mut subscriber = Subscriber::of("/other");
    subscriber.pass(LATE);
    let call = subscriber.one_late_call();
    assert_late_for(&call, Stage::Wait, Cause::Arrival);
}

#[test]
fn a_message_that_the_middleware_passes_on_late_names_the_middleware() {
    let mut subscriber = Subscriber::new();
    let command = format!("shared 1 {}", LATE.as_micros());
    subscriber.process.begin(&command);
    subscriber.send_to_waiting(Duration::ZERO);
    subscriber.process.end("shared");
    let call = subscriber.one_late_call();
    assert_late_for(&call, Stage::Receive, Cause::Middleware);
}

/// Is true if the thread of the middleware waited for a CPU for most of the message's wait.
fn waited_for_the_receiver(call: &&LateCall) -> bool {
    let receiver = call
        .handoff
        .as_ref()
        .map(|handoff| handoff.receiver.runnable);
    call.wait
        .zip(receiver)
        .is_some_and(|(all, receiver)| receiver * 2 > all)
}

#[test]
fn a_delayed_wakeup_names_the_thread_that_ran_instead() {
    let mut subscriber = Subscriber::new();
    let listener = subscriber.listener();
    for command in [
        ["chrt", "-i", "-p", "0", &listener],
        ["taskset", "-p", "-c", "0", &listener],
    ] {
        let [program, arguments @ ..] = command;
        let output = Command::new(program).args(arguments).output().unwrap();
        assert!(output.status.success(), "{output:?}");
    }
    let _hogs = [Hog::on("0"), Hog::on("0")];
    let mut calls = Vec::new();
    // On a busy machine, the executor's thread sometimes waits longer for a CPU than this one. And
    // while other programs take this CPU from both loops, the thread often runs at once.
    let begun = Instant::now();
    let waited = loop {
        for _ in 0..5 {
            subscriber.pass(Duration::ZERO);
        }
        calls.extend(subscriber.robot.round().report.late);
        let waited: Vec<_> = calls.iter().filter(waited_for_the_receiver).collect();
        if waited.len() >= 12 {
            break waited;
        }
        assert!(begun.elapsed() < Duration::from_secs(60), "{calls:#?}");
    };
    // So may programs of others take this CPU: then one of them ran longer than both loops.
    let is_full = |others: &[OtherThread]| others.len() == MAX_NAMED_THREADS;
    let is_named = |call: &&&LateCall| {
        let main = call.main_part(ThreadStates::default()).unwrap();
        let named = call.named_by(main);
        let others = &call.handoff.as_ref().unwrap().others;
        let longest = others.iter().map(|other| other.duration).max();
        (main.stage, main.cause) == (Stage::Receive, Cause::Runnable)
            && (is_full(others) || others.iter().any(|other| &*other.name == "sh"))
            && named.is_some_and(|thread| Some(thread.duration) == longest)
    };
    let named = waited.iter().filter(is_named).count();
    assert!(named * 4 >= waited.len() * 3, "{calls:#?}");
}

#[test]
fn a_message_for_a_process_beyond_its_quota_is_throttled() {
    let mut subscriber = Subscriber::new();
    let quota = limit_to_five_percent(&subscriber.process);
    let hog = Hog::on("0-1");
    exhaust(&quota, &hog);
    const MESSAGES: usize = 30;
    subscriber.process.begin(&format!("shared {MESSAGES} 0"));
    for _ in 0..MESSAGES {
        subscriber.send_to_waiting(Duration::ZERO);
        sleep(Duration::from_millis(15));
    }
    subscriber.process.end("shared");
    drop(hog);
    drop(quota);
    let calls = subscriber.robot.round().report.late;
    let mains = calls
        .iter()
        .map(|call| call.main_part(ThreadStates::default()).unwrap());
    // On a busy machine, other threads make some messages late.
    let mains: Vec<_> = mains.filter(|main| !is_busy(main)).collect();
    let is_throttled = |main: &&Part| main.cause == Cause::Throttled;
    let throttled = mains.iter().filter(is_throttled).count();
    assert!(throttled > 0 && throttled * 2 >= mains.len(), "{calls:#?}");
}

#[test]
fn a_stopped_process_is_the_cause_of_a_wait_in_shared_memory() {
    let mut subscriber = Subscriber::new();
    subscriber.process.begin("shared 1 0");
    while !subscriber.is_waiting() {
        sleep(Duration::from_millis(1));
    }
    let process = subscriber.process.child.id().cast_signed();
    // SAFETY: signals a child of this test.
    unsafe { libc::kill(process, libc::SIGSTOP) };
    wait_until_stopped(&subscriber.process);
    subscriber.send(Duration::ZERO);
    sleep(LATE);
    // SAFETY: as above.
    unsafe { libc::kill(process, libc::SIGCONT) };
    subscriber.process.end("shared");
    let call = subscriber.one_late_call();
    // After SIGCONT, either of the two threads can be the first to see the message.
    let parts = call.parts().into_iter();
    let stopped = parts.filter(|part| part.cause == Cause::Stopped);
    let stopped = stopped.max_by_key(|part| part.duration).unwrap();
    assert_late_for(&call, stopped.stage, Cause::Stopped);
    assert!(
        matches!(stopped.stage, Stage::Receive | Stage::Wait),
        "{call:#?}"
    );
    let named = call.named_by(stopped);
    assert_eq!(
        named.map(|it| it.process),
        Some(std::process::id()),
        "{call:#?}"
    );
}
