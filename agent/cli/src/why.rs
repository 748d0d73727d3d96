//! Text of `rp why`: the causes of late calls, and the worst call of each callback with its stages.

use std::fmt::Write as _;

use jiff::Timestamp;
use jiff::tz::TimeZone;
use ros2probe_api::why::{LateCall, LateCallSummary, LateCallback, OtherThread, Part, Why};

use crate::top::text::{counted, escaped, seconds};

/// Width of a drawn bar, in characters.
const BAR_WIDTH: usize = 48;
/// Stages in the order of time, in words.
const STAGES: [(&str, &str); 6] = [
    ("publish", "until sent"),
    ("network", "on the way"),
    ("socket", "in the socket"),
    ("receive", "in the middleware"),
    ("wait", "before the call"),
    ("callback", "in the call"),
];
/// Share of a call below which a part has no words.
const MIN_NAMED_SHARE: f64 = 0.005;

/// Time before and after a moment in which late calls belong to it, in seconds.
pub const AROUND: f64 = 5.0;

/// Returns whether no late call is known.
#[must_use]
pub fn is_empty(why: &Why<'_>) -> bool {
    why.callbacks.is_empty()
}

/// Keeps the late calls [`AROUND`] a Unix time, of an answer with `history=true`.
pub fn keep_around(why: &mut Why<'_>, moment: f64) {
    let is_around = |at: f64| (at - moment).abs() <= AROUND;
    let mut kept = Vec::new();
    for callback in &mut why.callbacks {
        add_examples_to_history(callback);
        let history = &mut callback.history;
        history.retain(|call| is_around(call.timestamp_seconds));
        kept.extend(history.iter().cloned());
        (callback.calls, callback.late_calls) = (None, history.len() as u64);
        let examples = &mut callback.examples;
        examples.retain(|call| is_around(call.timestamp_seconds));
    }
    why.callbacks.retain(|callback| callback.late_calls > 0);
    for cause in &mut why.causes {
        let key = (&cause.stage, &cause.words);
        let calls = kept.iter().filter(|call| (&call.stage, &call.words) == key);
        let totals: Vec<_> = calls.map(|call| call.total_seconds).collect();
        cause.late_calls = totals.len() as u64;
        cause.longest_seconds = totals.into_iter().fold(0.0, f64::max);
    }
    why.causes.retain(|cause| cause.late_calls > 0);
    why.causes
        .sort_by_key(|cause| std::cmp::Reverse(cause.late_calls));
}

/// Adds the examples that are older than the history of their callback.
fn add_examples_to_history(callback: &mut LateCallback<'_>) {
    let history = &mut callback.history;
    for call in &callback.examples {
        let is_same =
            |of: &LateCallSummary<'_>| (of.timestamp_seconds - call.timestamp_seconds).abs() < 1e-6;
        if !history.iter().any(is_same) {
            history.push(LateCallSummary {
                timestamp_seconds: call.timestamp_seconds,
                total_seconds: call.wait_seconds.unwrap_or_default() + call.duration_seconds,
                stage: call.stage.clone().unwrap_or_default(),
                cause: call.cause.clone().unwrap_or_default(),
                words: call.words.clone(),
            });
        }
    }
    history.sort_by(|one, other| one.timestamp_seconds.total_cmp(&other.timestamp_seconds));
}

/// Returns the text: the causes by their number of calls, then each callback with its worst call.
#[must_use]
pub fn text(why: &Why<'_>, zone: &TimeZone) -> String {
    let mut out = String::new();
    let all: u64 = why.causes.iter().map(|cause| cause.late_calls).sum();
    for cause in &why.causes {
        let _ = writeln!(
            out,
            "{:>4} of {all}, up to {}: {}",
            cause.late_calls,
            seconds(cause.longest_seconds),
            escaped(&cause.words)
        );
        let _ = writeln!(out, "     > {}", escaped(&cause.remedy));
    }
    if let Some(reason) = &why.reason {
        let _ = writeln!(out, "not everything is observed: {}", escaped(reason));
    }
    for callback in &why.callbacks {
        out.push('\n');
        write_callback(callback, zone, &mut out);
    }
    out
}

fn write_callback(callback: &LateCallback<'_>, zone: &TimeZone, out: &mut String) {
    let node = callback.owner.node.as_deref().map(escaped);
    let node = node.unwrap_or_else(|| format!("process {}", callback.owner.process_id));
    let calls = callback.calls.map_or_else(
        || counted(callback.late_calls, "late call"),
        |calls| format!("{} of {calls} calls late", callback.late_calls),
    );
    let _ = writeln!(
        out,
        "{node}, callback of {}: {calls}",
        escaped(&callback.trigger.words())
    );
    for call in &callback.history {
        let _ = writeln!(
            out,
            "  {} {:>6}: {}",
            time(call.timestamp_seconds, zone),
            seconds(call.total_seconds),
            escaped(&call.words)
        );
    }
    if let Some(worst) = callback.examples.first() {
        write_worst_call(worst, zone, out);
    }
}

fn write_worst_call(call: &LateCall<'_>, zone: &TimeZone, out: &mut String) {
    let wait = call.wait_seconds.unwrap_or_default();
    let total = wait + call.duration_seconds;
    let _ = writeln!(
        out,
        "  worst: {} at {}, thread {} on CPU {}: {}",
        seconds(total),
        time(call.timestamp_seconds, zone),
        call.thread_id,
        call.cpu,
        escaped(&call.words)
    );
    for (stage, words) in STAGES {
        let parts = call.parts.iter().filter(|part| part.stage == stage);
        let parts: Vec<_> = parts.collect();
        let sum: f64 = parts.iter().map(|part| part.seconds).sum();
        if sum > 0.0 {
            let _ = writeln!(
                out,
                "  {words:<17} {:>6}  {}",
                seconds(sum),
                part_list(&parts, total)
            );
        }
    }
    let _ = writeln!(out, "  [{}]", bar(&call.parts, total));
    let mut others: Vec<_> = call.others.iter().collect();
    others.sort_by(|one, other| other.seconds.total_cmp(&one.seconds));
    let others = others
        .iter()
        .filter(|other| other.seconds >= total * MIN_NAMED_SHARE);
    let others: Vec<_> = others
        .take(4)
        .map(|other| match other.thread_id {
            0 => format!("no one (idle CPU) {}", seconds(other.seconds)),
            _ => format!(
                "{} {}",
                thread_in_words(other, other.process_id.to_string()),
                seconds(other.seconds)
            ),
        })
        .collect();
    if !others.is_empty() {
        let _ = writeln!(out, "  ran instead: {}", others.join(", "));
    }
    if let Some(blocked) = call
        .blocked
        .as_ref()
        .filter(|it| it.seconds >= total * MIN_NAMED_SHARE)
    {
        let system_call = match &blocked.system_call {
            Some(name) => format!("{}({})", escaped(name), escaped(&blocked.argument)),
            None => "no system call".to_owned(),
        };
        let ended = blocked.ended_by.as_ref().map(|by| {
            format!(
                ", ended by {}",
                thread_in_words(by, format!("thread {}", by.thread_id))
            )
        });
        let _ = writeln!(
            out,
            "  longest blocked: {} in {system_call}{}",
            seconds(blocked.seconds),
            ended.unwrap_or_default()
        );
    }
    if !call.cpu_limits.is_empty() {
        let limits: Vec<_> = call.cpu_limits.iter().map(|limit| escaped(limit)).collect();
        let _ = writeln!(out, "  slow CPUs: {}", limits.join("; "));
    }
    let others = call
        .parts
        .iter()
        .filter(|part| part.cause == "other_callback");
    let in_others: f64 = others.map(|part| part.seconds).sum();
    if let Some(previous) = call.previous.as_ref().filter(|_| in_others > 0.0) {
        let several = match previous.duration_seconds < in_others / 2.0 {
            true => "several callbacks, one of them",
            false => "the callback",
        };
        let _ = writeln!(
            out,
            "  waited for {several} of {}: {}",
            escaped(&previous.trigger.words()),
            seconds(previous.duration_seconds)
        );
    }
}

/// Returns a thread with its id in words, its unit, and a priority other than the usual one.
fn thread_in_words(other: &OtherThread<'_>, id: String) -> String {
    let mut facts = vec![id];
    facts.extend(other.unit.as_deref().map(escaped));
    let priority = other.priority.as_deref().filter(|it| *it != "nice 0");
    facts.extend(priority.map(escaped));
    format!("{} ({})", escaped(&other.name), facts.join(", "))
}

/// Returns the parts that are not small, with their lengths.
fn part_list(parts: &[&Part<'_>], total: f64) -> String {
    let shown = parts
        .iter()
        .filter(|part| part.seconds >= total * MIN_NAMED_SHARE);
    let words: Vec<_> = shown
        .map(|part| format!("{} {}", escaped(&part.cause), seconds(part.seconds)))
        .collect();
    words.join(", ")
}

/// Draws the parts in the order of their time: the first letter of a cause for each share of the
/// call.
fn bar(parts: &[Part<'_>], total: f64) -> String {
    let mut bar = String::with_capacity(BAR_WIDTH);
    let mut until = 0.0;
    for part in parts {
        until += part.seconds;
        let letter = part.cause.chars().next().unwrap_or('?');
        #[expect(clippy::cast_precision_loss, reason = "a bar has few characters")]
        while bar.len() < BAR_WIDTH && (bar.len() as f64 + 0.5) / BAR_WIDTH as f64 <= until / total
        {
            bar.push(letter);
        }
    }
    while bar.len() < BAR_WIDTH {
        bar.push(' ');
    }
    bar
}

/// Returns the time of day of a Unix time, to the millisecond.
#[must_use]
pub fn time(seconds: f64, zone: &TimeZone) -> String {
    #[expect(
        clippy::cast_possible_truncation,
        reason = "milliseconds fit until the year 292471208"
    )]
    let milliseconds = (seconds * 1e3).round() as i64;
    let Ok(timestamp) = Timestamp::from_millisecond(milliseconds) else {
        return "?".to_owned();
    };
    let zoned = timestamp.to_zoned(zone.clone());
    zoned.strftime("%H:%M:%S%.3f").to_string()
}

#[cfg(test)]
mod tests {
    use ros2probe_api::inside::{Owner, Trigger};
    use ros2probe_api::why::{Blocked, Cause, PreviousCall};

    use super::*;

    fn part(stage: &'static str, cause: &'static str, seconds: f64) -> Part<'static> {
        Part {
            stage: stage.into(),
            cause: cause.into(),
            seconds,
        }
    }

    fn why() -> Why<'static> {
        Why {
            observed: "events".into(),
            causes: vec![Cause {
                late_calls: 13,
                longest_seconds: 0.1054,
                words: "its control group had used up its CPU quota".into(),
                remedy: "raise CPUQuota".into(),
                ..Cause::default()
            }],
            callbacks: vec![LateCallback {
                owner: Owner {
                    process_id: 42,
                    node: Some("/filter".into()),
                    ..Owner::default()
                },
                trigger: Trigger {
                    kind: "subscription".into(),
                    name: Some("/points".into()),
                    period_seconds: None,
                },
                calls: Some(600),
                late_calls: 14,
                examples: vec![LateCall {
                    timestamp_seconds: 1_700_000_000.25,
                    duration_seconds: 0.12,
                    wait_seconds: Some(0.04),
                    thread_id: 43,
                    cpu: 1,
                    words: "its control group had used up its CPU quota".into(),
                    parts: vec![
                        part("wait", "arrival", 0.04),
                        part("callback", "cpu", 0.02),
                        part("callback", "throttled", 0.08),
                        part("callback", "lock", 0.02),
                    ],
                    others: vec![OtherThread {
                        name: "chromium\u{1b}".into(),
                        thread_id: 7,
                        process_id: 6,
                        unit: Some("kiosk.service".into()),
                        priority: Some("nice -5".into()),
                        seconds: 0.03,
                    }],
                    blocked: Some(Blocked {
                        seconds: 0.02,
                        system_call: Some("futex".into()),
                        argument: "0x7f00".into(),
                        ..Blocked::default()
                    }),
                    ..LateCall::default()
                }],
                ..LateCallback::default()
            }],
            ..Why::default()
        }
    }

    #[test]
    fn the_worst_call_is_drawn_with_its_stages_and_hostile_names_are_escaped() {
        let text = text(&why(), &TimeZone::UTC);
        let expected = "  13 of 13, up to 105ms: its control group had used up its CPU quota
     > raise CPUQuota

/filter, callback of /points: 14 of 600 calls late
  worst: 160ms at 22:13:20.250, thread 43 on CPU 1: its control group had used up its CPU quota
  before the call     40ms  arrival 40ms
  in the call        120ms  cpu 20ms, throttled 80ms, lock 20ms
  [aaaaaaaaaaaaccccccttttttttttttttttttttttttllllll]
  ran instead: chromium\\u{1b} (6, kiosk.service, nice -5) 30ms
  longest blocked: 20ms in futex(0x7f00)
";
        assert_eq!(text, expected);
    }

    /// A late call that began some seconds after that of [`why`].
    fn later(after: f64, words: &'static str) -> LateCallSummary<'static> {
        LateCallSummary {
            timestamp_seconds: 1_700_000_000.25 + after,
            total_seconds: 0.05,
            words: words.into(),
            ..LateCallSummary::default()
        }
    }

    #[test]
    fn the_late_calls_around_a_moment_are_listed_with_their_causes_alone() {
        let mut all = why();
        let computed = Cause {
            late_calls: 9,
            words: "it computed".into(),
            ..Cause::default()
        };
        all.causes.push(computed);
        all.callbacks[0].history = vec![
            later(20.0, "it computed"),
            later(21.0, "it computed"),
            later(40.0, "it slept"),
        ];
        let of = |after: f64| {
            let mut some = all.clone();
            keep_around(&mut some, 1_700_000_000.25 + after);
            some
        };
        let some = of(23.0);
        let words: Vec<_> = some.causes.iter().map(|cause| &*cause.words).collect();
        assert_eq!((words, some.causes[0].late_calls), (vec!["it computed"], 2));
        let listed = text(&some, &TimeZone::UTC);
        let expected = "   2 of 2, up to 50ms: it computed
     > \n\n/filter, callback of /points: 2 late calls
  22:13:40.250   50ms: it computed
  22:13:41.250   50ms: it computed\n";
        assert_eq!(listed, expected);
        // The worst call is older than the history.
        let worst = text(&of(1.0), &TimeZone::UTC);
        let line = "  22:13:20.250  160ms: its control group had used up its CPU quota\n  worst: ";
        assert!(worst.contains(line), "{worst}");
        assert!(is_empty(&of(10.0)) && of(10.0).causes.is_empty());
    }

    #[test]
    fn a_call_that_waited_names_the_callback_before_it_also_among_several() {
        let mut why = why();
        let worst = &mut why.callbacks[0].examples[0];
        worst.parts[0] = part("receive", "runnable", 0.01);
        worst.parts.insert(1, part("wait", "other_callback", 0.03));
        worst.previous = Some(PreviousCall {
            trigger: Trigger {
                kind: "timer".into(),
                ..Trigger::default()
            },
            duration_seconds: 0.03,
            ..PreviousCall::default()
        });
        let first = text(&why, &TimeZone::UTC);
        let stages = "  in the middleware   10ms  runnable 10ms
  before the call     30ms  other_callback 30ms
";
        assert!(first.contains(stages), "{first}");
        let waited = "  waited for the callback of timer: 30ms\n";
        assert!(first.ends_with(waited), "{first}");
        let worst = &mut why.callbacks[0].examples[0];
        worst.previous.as_mut().unwrap().duration_seconds = 0.01;
        let several = text(&why, &TimeZone::UTC);
        let waited = "  waited for several callbacks, one of them of timer: 10ms\n";
        assert!(several.ends_with(waited), "{several}");
    }
}
