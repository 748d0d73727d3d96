//! The parts of late calls, compared with the kernel's own trace of the scheduler (ftrace), which
//! `trace-cmd` and `perf sched` read.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use ros2probe_capture::system::Clocks;
use ros2probe_model::facts::calls::late::{Cause, LateCall, Part, Stage};

use super::Process;
use super::late::{PATIENCE, is_complete, late, pin, started};
use super::thread_states::Hog;

/// Difference that may remain, as a share of the calls' time. The trace has microseconds, and a
/// switch begins some microseconds before it is traced.
const TOLERANCE: f64 = 0.03;

/// A trace of one thread by an instance of its own.
struct KernelTrace {
    instance: PathBuf,
    _mount: Mount,
}

/// A file system of the kernel at a temporary place.
struct Mount(tempfile::TempDir);

/// Time on a CPU, waiting for one, and blocked.
#[derive(Clone, Copy, Debug, Default)]
struct Division {
    running: Duration,
    runnable: Duration,
    blocked: Duration,
}

/// An event of the scheduler about the thread.
#[derive(Clone, Copy, Debug)]
enum Event {
    SwitchedIn,
    /// It could continue to run.
    Preempted,
    Blocked,
    Woken,
}

impl Mount {
    fn tracefs() -> Self {
        let place = tempfile::tempdir().unwrap();
        let mut mount = Command::new("mount");
        mount.args(["-t", "tracefs", "none"]).arg(place.path());
        assert!(mount.status().unwrap().success());
        Self(place)
    }
}

impl Drop for Mount {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg(self.0.path()).status();
    }
}

impl KernelTrace {
    fn of(process: &Process) -> Self {
        let mount = Mount::tracefs();
        let name = format!("r2p-{}", process.child.id());
        let instance = mount.0.path().join("instances").join(name);
        std::fs::create_dir(&instance).unwrap();
        let trace = Self {
            instance,
            _mount: mount,
        };
        trace.set("trace_clock", "mono");
        trace.set("buffer_size_kb", "8192");
        trace.set("set_event_pid", &process.child.id().to_string());
        for event in ["sched_switch", "sched_waking"] {
            trace.set(&format!("events/sched/{event}/enable"), "1");
        }
        trace
    }

    fn set(&self, file: &str, value: &str) {
        std::fs::write(self.instance.join(file), value).unwrap();
    }

    /// Returns the events of a thread with their CLOCK_MONOTONIC times, oldest first.
    fn events(&self, thread: u32) -> Vec<(Duration, Event)> {
        let text = std::fs::read_to_string(self.instance.join("trace")).unwrap();
        let lines = text.lines().filter(|line| !line.starts_with('#'));
        lines.filter_map(|line| event(line, thread)).collect()
    }
}

impl Drop for KernelTrace {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir(&self.instance);
    }
}

/// Reads a line as `NAME-PID [CPU] FLAGS SECONDS: sched_switch: prev_pid=.. ==> next_pid=..`.
fn event(line: &str, thread: u32) -> Option<(Duration, Event)> {
    let (head, fields) = line.split_once(": sched_")?;
    let at: f64 = head.rsplit(' ').next()?.parse().ok()?;
    let is = |name: &str| {
        let (_, value) = fields.split_once(name)?;
        let value = value.split(' ').next()?;
        Some(value.parse::<u32>().ok()? == thread)
    };
    let event = if fields.starts_with("waking") {
        is(" pid=")?.then_some(Event::Woken)
    } else if is(" prev_pid=")? {
        let (_, state) = fields.split_once(" prev_state=")?;
        match state.starts_with('R') {
            true => Some(Event::Preempted),
            false => Some(Event::Blocked),
        }
    } else {
        is(" next_pid=")?.then_some(Event::SwitchedIn)
    };
    Some((Duration::from_secs_f64(at), event?))
}

impl Division {
    /// Divides the time of a call by the trace.
    fn by_trace(events: &[(Duration, Event)], (start, end): (Duration, Duration)) -> Self {
        let mut division = Self::default();
        // A thread that begins a call is on a CPU.
        let (mut state, mut since) = (Event::SwitchedIn, start);
        let within = events.iter().filter(|(at, _)| (start..end).contains(at));
        for &(at, event) in within {
            // A thread that was woken while it left its CPU waits for one: no later event wakes it.
            let past = match (state, event) {
                (Event::Blocked, Event::SwitchedIn) => Event::Woken,
                _ => state,
            };
            division.add(past, at - since);
            since = at;
            state = match (state, event) {
                // The thread was not blocked: it runs, or waits for a CPU already.
                (Event::SwitchedIn | Event::Preempted | Event::Woken, Event::Woken) => state,
                (_, event) => event,
            };
        }
        division.add(state, end - since);
        division
    }

    fn add(&mut self, state: Event, time: Duration) {
        *match state {
            Event::SwitchedIn => &mut self.running,
            Event::Preempted | Event::Woken => &mut self.runnable,
            Event::Blocked => &mut self.blocked,
        } += time;
    }

    /// Divides the time of a call by its reported parts.
    fn by_parts(call: &LateCall) -> Self {
        let mut division = Self::default();
        let parts = call.parts().into_iter();
        let explained = |part: &Part| part.cause != Cause::Unexplained;
        for part in parts.filter(|part| part.stage == Stage::Callback && explained(part)) {
            *match part.cause {
                Cause::Cpu | Cause::Stolen => &mut division.running,
                Cause::Runnable | Cause::Throttled => &mut division.runnable,
                _ => &mut division.blocked,
            } += part.duration;
        }
        division
    }

    fn of_all(each: impl Iterator<Item = Self>) -> Self {
        each.fold(Self::default(), |sum, one| Self {
            running: sum.running + one.running,
            runnable: sum.runnable + one.runnable,
            blocked: sum.blocked + one.blocked,
        })
    }
}

/// Runs callbacks, and compares the parts of those that are late with the trace.
fn agrees_with_the_trace(command: &str, is_crowded: bool) {
    let (mut robot, mut process) = started();
    pin(&process);
    let _hog = is_crowded.then(|| Hog::on("0"));
    let trace = KernelTrace::of(&process);
    let clocks = Clocks::read();
    let (mut calls, mut incomplete) = (Vec::new(), Vec::new());
    let deadline = Instant::now() + PATIENCE;
    // On a busy machine, the kernel may skip an event of a call.
    while calls.len() < 4 {
        assert!(Instant::now() < deadline, "{calls:#?} {incomplete:#?}");
        let late = late(&mut robot, &mut process, command).into_iter();
        let (complete, others): (Vec<_>, Vec<_>) = late.partition(is_complete);
        calls.extend(complete);
        incomplete.extend(others);
    }
    let events = trace.events(process.child.id());
    let span = |call: &LateCall| {
        let since = call.started.nanoseconds_since(clocks.now);
        let start = Duration::from_nanos(clocks.monotonic.strict_add_signed(since));
        (start, start + call.duration)
    };
    let traced = calls.iter();
    let traced = Division::of_all(traced.map(|call| Division::by_trace(&events, span(call))));
    let reported = Division::of_all(calls.iter().map(Division::by_parts));
    let all: Duration = calls.iter().map(|call| call.duration).sum();
    println!("{command}: {all:?}, reported {reported:?}, traced {traced:?}");
    for (one, other) in [
        (reported.running, traced.running),
        (reported.runnable, traced.runnable),
        (reported.blocked, traced.blocked),
    ] {
        let difference = one.abs_diff(other).as_secs_f64();
        let bound = TOLERANCE * all.as_secs_f64();
        assert!(difference < bound, "{reported:?} {traced:?} {calls:#?}");
    }
}

#[test]
fn parts_of_a_sleep_agree_with_the_trace() {
    agrees_with_the_trace("sleep 10 20000", false);
}

#[test]
fn parts_of_a_wait_for_a_lock_agree_with_the_trace() {
    agrees_with_the_trace("lock 10 30000", false);
}

#[test]
fn parts_of_a_call_beside_a_busy_thread_agree_with_the_trace() {
    agrees_with_the_trace("compute 10 60000", true);
}

#[test]
fn parts_of_a_lock_beside_a_busy_thread_agree_with_the_trace() {
    agrees_with_the_trace("lock 10 30000", true);
}

#[test]
fn parts_of_many_short_waits_for_a_disk_agree_with_the_trace() {
    let file = tempfile::NamedTempFile::new_in(env!("CARGO_TARGET_TMPDIR")).unwrap();
    let path: &Path = file.path();
    agrees_with_the_trace(&format!("disk 10 16384 {}", path.display()), false);
}
