//! Problems and figures from inside processes, as text.

use std::borrow::Cow;

use ros2probe_api::diagnosis::Diagnosis;
use ros2probe_api::inside::{RecentLateCalls, TopicInside};

use super::text::{counted, escaped, ratio, seconds};

/// Returns the late calls of a topic's callbacks, as text.
pub(super) fn late_calls_text(late: &RecentLateCalls<'_>) -> String {
    format!(
        "{} in the last minute, up to {}: {} (rp why)",
        counted(late.calls, "late call"),
        seconds(late.longest_seconds),
        escaped(&late.words)
    )
}

/// Returns the text of a problem that only calls inside processes show; `None` for any other.
pub(super) fn problem(diagnosis: &Diagnosis<'_>) -> Option<String> {
    let node_or_process = |node: &Option<Cow<'_, str>>, process: &u32| match node {
        Some(node) => escaped(node),
        None => format!("process {process}"),
    };
    Some(match diagnosis {
        Diagnosis::SlowCallback {
            node,
            process_id,
            trigger,
            duration_seconds,
            period_seconds,
            own_period,
        } => format!(
            "callback of {} in {} takes {}, {} is {}",
            escaped(&trigger.words()),
            node_or_process(node, process_id),
            seconds(*duration_seconds),
            match own_period {
                true => "its period",
                false => "the period of a timer in its thread",
            },
            seconds(*period_seconds)
        ),
        Diagnosis::ExecutorWait {
            node,
            process_id,
            trigger,
            wait_seconds,
        } => format!(
            "callback of {} in {} waits {} for the executor",
            escaped(&trigger.words()),
            node_or_process(node, process_id),
            seconds(*wait_seconds)
        ),
        Diagnosis::LateCallback {
            node,
            process_id,
            trigger,
            late_calls,
            words,
            longest_seconds,
            ..
        } => format!(
            "callback of {} in {} was late {late_calls} times in a minute, up to {}: {}",
            escaped(&trigger.words()),
            node_or_process(node, process_id),
            seconds(*longest_seconds),
            escaped(words)
        ),
        Diagnosis::IntraProcessOverflow {
            node,
            process_id,
            overwritten_ratio,
        } => format!(
            "{} within the process overwrites {} of the messages",
            node_or_process(node, process_id),
            ratio(*overwritten_ratio)
        ),
        Diagnosis::ReaderQueueOverflow {
            node,
            process_id,
            lost_ratio,
            ..
        } => format!(
            "{} takes too slowly: its queue loses {} of the messages",
            node_or_process(node, process_id),
            ratio(*lost_ratio)
        ),
        Diagnosis::ObservationSuspended { process_id, .. } => {
            format!("process {process_id} exceeds the budget of capture.inside")
        }
        _ => return None,
    })
}

/// Returns one line about a topic's counts inside processes.
pub(super) fn counts(inside: &TopicInside<'_>) -> String {
    let mut line = format!(
        "inside processes: {} published, {} taken",
        inside.published_messages, inside.taken_messages
    );
    let rest = [
        ("takes without a message", inside.failed_takes),
        ("buffered within the process", inside.enqueued_messages),
        ("overwritten there", inside.overwritten_messages),
        (
            "lost in queues of subscriptions",
            inside.lost_in_reader_queue_messages.unwrap_or_default(),
        ),
        (
            "received within the process",
            inside.intra_process_receptions,
        ),
    ];
    for (what, count) in rest.into_iter().filter(|(_, count)| *count > 0) {
        line.push_str(&format!(", {count} {what}"));
    }
    line
}
