//! Descriptions of problems that only calls inside processes show.

use std::time::Duration;

use super::findings::finding;
use super::structure::Ids;
use ros2probe_api::live::{Finding, Severity};
use ros2probe_model::facts::calls::facts::Owner;
use ros2probe_model::facts::diagnosis::Diagnosis;

/// Describes a problem from inside a process.
pub(super) fn in_words(ids: &Ids, diagnosis: &Diagnosis) -> Finding {
    let kind = diagnosis.kind();
    let (about, text, remedy) = match diagnosis {
        Diagnosis::SlowCallback {
            callback,
            trigger,
            duration,
            period,
            is_own_period,
            ..
        } => {
            let which = match is_own_period {
                true => "its period is",
                false => "a timer of the same thread has a period of",
            };
            let text = format!(
                "The callback of {trigger} in {} takes {}; {which} {}",
                owner_name(callback),
                milliseconds(*duration),
                milliseconds(*period)
            );
            let remedy = "shorten the callback, or give it a callback group and thread of its own";
            (owner_object(callback), text, remedy)
        }
        Diagnosis::ExecutorWait {
            callback,
            trigger,
            wait,
            ..
        } => {
            let text = format!(
                "The callback of {trigger} in {} waits {} for the executor",
                owner_name(callback),
                milliseconds(*wait)
            );
            let remedy = "shorten the callbacks of its thread, or use a multi-threaded executor";
            (owner_object(callback), text, remedy)
        }
        Diagnosis::LateCallback {
            callback,
            trigger,
            calls,
            cause,
            by,
            longest,
            ..
        } => {
            let text = format!(
                "The callback of {trigger} in {} was late {calls} times in a minute, up to {}: {}",
                owner_name(callback),
                milliseconds(*longest),
                cause.in_words(by.as_ref().map(|by| by as _))
            );
            (owner_object(callback), text, cause.remedy())
        }
        Diagnosis::IntraProcessOverflow {
            topic,
            queue,
            overwritten_permille,
        } => {
            let text = format!(
                "The queue of {} within {} overwrote {}.{} % of the messages",
                topic.name,
                owner_name(queue),
                overwritten_permille / 10,
                overwritten_permille % 10
            );
            let remedy = "raise the depth of the subscription, or shorten its callback";
            (owner_object(queue), text, remedy)
        }
        Diagnosis::ReaderQueueOverflow {
            topic,
            queue,
            lost_permille,
            depth,
        } => {
            let depth = depth.map(|depth| format!(" of depth {depth}"));
            let text = format!(
                "{} takes {} too slowly: its queue{} loses {}.{} % of the messages",
                owner_name(queue),
                topic.name,
                depth.unwrap_or_default(),
                lost_permille / 10,
                lost_permille % 10
            );
            let remedy = "shorten the callback, give it a callback group and thread of its own, or \
                          raise the depth of the subscription";
            (owner_object(queue), text, remedy)
        }
        Diagnosis::ObservationSuspended { process, name, .. } => {
            let name = name.as_deref().unwrap_or("a process");
            let text = format!("Calls of {name} ({process}) exceed the budget and do not count");
            let remedy = "set capture.inside to topics, which observes fewer calls";
            (process.to_string(), text, remedy)
        }
        _ => (String::new(), kind.to_owned(), ""),
    };
    let owner = diagnosis.owner();
    let node = owner.and_then(|owner| ids.node(owner.domain_id, owner.node.as_ref()?));
    Finding {
        domain_id: owner.map(|owner| owner.domain_id.0),
        node,
        ..finding(kind, Severity::Warning, &about, text)
    }
    .with_remedy(remedy)
}

fn owner_name(owner: &Owner) -> String {
    let process = || format!("process {}", owner.process);
    let node = owner.node.as_ref().map(ToString::to_string);
    node.unwrap_or_else(process)
}

fn owner_object(owner: &Owner) -> String {
    format!("{}|{:x}", owner.process, owner.handle)
}

fn milliseconds(duration: Duration) -> String {
    format!("{:.0} ms", duration.as_secs_f64() * 1e3)
}
