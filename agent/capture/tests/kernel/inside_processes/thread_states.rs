//! What the time of callbacks consists of, compared with the kernel's own figures of the process.

use std::fs;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use ros2probe_model::facts::calls::report::ThreadStates;
use ros2probe_testing::harness::quota::Quota;

use super::{Process, Robot};

/// Difference that the time between the readings, and CPU time that the scheduler adds up only at
/// its next tick, may make.
const TOLERANCE: Duration = Duration::from_millis(12);

/// CPU time and waiting time of callbacks, which the process reads from
/// `/proc/thread-self/schedstat` around each.
struct Schedstat {
    cpu: Duration,
    run_delay: Duration,
}

/// A process of the same CPU that never sleeps.
pub(super) struct Hog(pub(super) Child);

impl Hog {
    pub(super) fn on(cpu: &str) -> Self {
        Self::by(&["taskset", "-c", cpu, "sh", "-c", "while :; do :; done"])
    }

    /// A thread of real-time priority that computes for about half of the time.
    pub(super) fn real_time(cpu: &str) -> Self {
        let busy = "while :; do i=0; while [ $i -lt 30000 ]; do i=$((i+1)); done; sleep 0.03; done";
        Self::by(&["chrt", "-f", "50", "taskset", "-c", cpu, "sh", "-c", busy])
    }

    fn by(command: &[&str]) -> Self {
        let (program, arguments) = command.split_first().unwrap();
        let mut command = Command::new(program);
        let child = command.args(arguments).stdin(Stdio::null()).spawn();
        let hog = Self(child.expect("install taskset and chrt: apt-get install util-linux"));
        hog.wait_until_it_computes();
        hog
    }

    /// Waits for a tenth of a second of CPU time: on a busy machine, the shell starts late.
    fn wait_until_it_computes(&self) {
        let begun = Instant::now();
        let ticks = || -> Option<u64> {
            let stat = fs::read_to_string(format!("/proc/{}/stat", self.0.id())).ok()?;
            let (_, fields) = stat.rsplit_once(") ")?;
            fields.split(' ').nth(11)?.parse().ok()
        };
        while ticks().is_none_or(|ticks| ticks < 10) {
            assert!(begun.elapsed() < Duration::from_secs(60), "no CPU");
            std::thread::sleep(Duration::from_millis(5));
        }
    }
}

impl Drop for Hog {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Lets the process run for a twentieth of each 100 ms.
pub(super) fn limit_to_five_percent(process: &Process) -> Quota {
    Quota::limit(process.child.id(), 5).unwrap()
}

/// Adds a thread that computes to a group, so that the quota is always used up.
pub(super) fn exhaust(quota: &Quota, hog: &Hog) {
    quota.add(hog.0.id()).unwrap();
}

/// Waits until each thread of the process has stopped: each one does so when it has a CPU.
pub(super) fn wait_until_stopped(process: &Process) {
    let begun = Instant::now();
    let is_stopped = |task: fs::DirEntry| {
        let stat = fs::read_to_string(task.path().join("stat")).unwrap_or_default();
        stat.rsplit_once(") ")
            .is_some_and(|(_, fields)| fields.starts_with('T'))
    };
    let tasks = format!("/proc/{}/task", process.child.id());
    while !fs::read_dir(&tasks).unwrap().flatten().all(is_stopped) {
        assert!(begun.elapsed() < Duration::from_secs(60), "not stopped");
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// A process whose callbacks are observed, after it has created its entities.
fn started() -> (Robot, Process) {
    let mut robot = Robot::new(248, &[], true);
    robot.attach();
    let mut process = robot.start();
    process.run("init");
    (robot, process)
}

/// Runs a command of callbacks. Returns what they consisted of, and the kernel's figures of them.
fn run(robot: &mut Robot, process: &mut Process, command: &str) -> (ThreadStates, Schedstat) {
    let answer = process.run(command);
    let mut fields = answer.split_whitespace();
    let mut next = || Duration::from_nanos(fields.next().unwrap().parse().unwrap());
    let schedstat = Schedstat {
        cpu: next(),
        run_delay: next(),
    };
    let report = robot.report(process);
    let callback = report.callbacks.first().unwrap();
    let states = callback.states;
    assert_eq!(states.calls, callback.calls, "{states:?}");
    let sum: u64 = states.nanoseconds().iter().sum();
    assert_eq!(
        Duration::from_nanos(sum),
        callback.durations.sum(),
        "{states:?}"
    );
    (states, schedstat)
}

fn assert_close(nanoseconds: u64, expected: Duration, states: ThreadStates) {
    let difference = Duration::from_nanos(nanoseconds).abs_diff(expected);
    assert!(difference < TOLERANCE, "{states:?} {expected:?}");
}

#[test]
fn a_callback_that_sleeps_is_blocked() {
    let (mut robot, mut process) = started();
    let (states, schedstat) = run(&mut robot, &mut process, "sleep 20 5000");
    let slept = Duration::from_millis(20 * 5);
    let blocked = Duration::from_nanos(states.blocked);
    assert!(blocked + TOLERANCE > slept, "{states:?}");
    assert_close(states.cpu, schedstat.cpu, states);
    assert_close(states.runnable, schedstat.run_delay, states);
    assert_eq!(states.throttled, 0);
}

#[test]
fn a_callback_beside_a_busy_thread_is_runnable_for_as_long_as_the_kernel_counts() {
    let (mut robot, mut process) = started();
    let id = process.child.id().to_string();
    let pinned = Command::new("taskset").args(["-pc", "0", &id]).output();
    assert!(pinned.unwrap().status.success());
    let _hog = Hog::on("0");
    let (states, schedstat) = run(&mut robot, &mut process, "compute 10 60000");
    let sum: u64 = states.nanoseconds().iter().sum();
    assert!(states.runnable > sum / 5, "{states:?}");
    assert_close(states.cpu, schedstat.cpu, states);
    assert_close(states.runnable, schedstat.run_delay, states);
    assert_eq!(states.throttled, 0);
}

#[test]
fn a_callback_beyond_the_quota_of_its_control_group_is_throttled() {
    let (mut robot, mut process) = started();
    let quota = limit_to_five_percent(&process);
    let before = quota.throttled().unwrap();
    let (states, schedstat) = run(&mut robot, &mut process, "compute 3 300000");
    let throttled = quota.throttled().unwrap() - before;
    assert!(throttled > Duration::from_millis(100), "{states:?}");
    assert_close(states.throttled, throttled, states);
    assert_close(states.cpu, schedstat.cpu, states);
    assert_close(
        states.runnable + states.throttled,
        schedstat.run_delay,
        states,
    );
}
