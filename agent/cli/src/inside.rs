//! Text of `rp inside`: a table for each kind of entity.

use std::borrow::Cow;

use ros2probe_api::inside::{Durations, Inside, Owner, ThreadStates};

use crate::top::text::{escaped, seconds};

/// Width between two columns.
const COLUMN_GAP: usize = 2;

/// Returns whether nothing is known.
#[must_use]
pub fn is_empty(inside: &Inside<'_>) -> bool {
    inside.processes.is_empty()
        && inside.publishers.is_empty()
        && inside.subscriptions.is_empty()
        && inside.buffers.is_empty()
        && inside.callbacks.is_empty()
}

/// Returns all tables, each below its heading; empty ones are left out.
#[must_use]
pub fn text(inside: &Inside<'_>) -> String {
    let mut out = String::new();
    let processes = inside.processes.iter().map(|it| {
        let state = if it.suspended { "suspended" } else { "" };
        let nodes: Vec<_> = it.nodes.iter().map(|node| escaped(node)).collect();
        row([
            it.process_id.to_string(),
            it.process.as_deref().map(escaped).unwrap_or_default(),
            it.domain_id.to_string(),
            it.cpu_ratio.map(percent).unwrap_or_default(),
            it.calls_per_second.map(hertz).unwrap_or_default(),
            state.to_owned(),
            nodes.join(" "),
        ])
    });
    let head = ["PROCESS", "NAME", "DOMAIN", "CPU", "CALLS/S", "", "NODES"];
    table(&mut out, head, processes);
    let publishers = inside.publishers.iter().map(|it| {
        row([
            escaped(&it.topic),
            owner_name(&it.owner),
            it.published_messages.to_string(),
            it.within_process_messages.to_string(),
            it.rate_hertz.map(hertz).unwrap_or_default(),
            quantiles(it.interval.as_ref()),
            it.middleware.as_deref().map(escaped).unwrap_or_default(),
        ])
    });
    let head = [
        "PUBLISHER",
        "NODE",
        "PUBLISHED",
        "WITHIN",
        "HZ",
        "INTERVAL P50/P99",
        "MIDDLEWARE",
    ];
    table(&mut out, head, publishers);
    let subscriptions = inside.subscriptions.iter().map(|it| {
        row([
            escaped(&it.topic),
            owner_name(&it.owner),
            it.taken_messages.to_string(),
            it.failed_takes.to_string(),
            it.rate_hertz.map(hertz).unwrap_or_default(),
            quantiles(it.latency.as_ref()),
            it.middleware.as_deref().map(escaped).unwrap_or_default(),
        ])
    });
    let head = [
        "SUBSCRIPTION",
        "NODE",
        "TAKEN",
        "FAILED",
        "HZ",
        "LATENCY P50/P99",
        "MIDDLEWARE",
    ];
    table(&mut out, head, subscriptions);
    let queues = inside.reader_queues.iter().map(|it| {
        row([
            escaped(&it.topic),
            owner_name(&it.owner),
            it.arrived_messages.to_string(),
            it.taken_messages.to_string(),
            it.lost_messages.to_string(),
            it.depth.map(|depth| depth.to_string()).unwrap_or_default(),
        ])
    });
    let head = ["READER QUEUE", "NODE", "ARRIVED", "TAKEN", "LOST", "DEPTH"];
    table(&mut out, head, queues);
    let buffers = inside.buffers.iter().map(|it| {
        let capacity = it.capacity.map(|capacity| format!("/{capacity}"));
        row([
            it.topic.as_deref().map(escaped).unwrap_or_default(),
            owner_name(&it.owner),
            it.enqueued_messages.to_string(),
            it.overwritten_messages.to_string(),
            it.rate_hertz.map(hertz).unwrap_or_default(),
            quantiles(it.waiting.as_ref()),
            format!("{}{}", it.depth, capacity.unwrap_or_default()),
        ])
    });
    let head = [
        "BUFFER",
        "NODE",
        "ENQUEUED",
        "OVERWRITTEN",
        "HZ",
        "WAITING P50/P99",
        "DEPTH",
    ];
    table(&mut out, head, buffers);
    let callbacks = inside.callbacks.iter().map(|it| {
        row([
            escaped(&it.trigger.words()),
            owner_name(&it.owner),
            it.calls.to_string(),
            it.busy_ratio.map(percent).unwrap_or_default(),
            it.rate_hertz.map(hertz).unwrap_or_default(),
            quantiles(it.duration.as_ref()),
            quantiles(it.wait.as_ref()),
            it.states_ratio.as_ref().map(states).unwrap_or_default(),
        ])
    });
    let head = [
        "CALLBACK",
        "NODE",
        "CALLS",
        "BUSY",
        "HZ",
        "DURATION P50/P99",
        "WAIT P50/P99",
        "THREAD",
    ];
    table(&mut out, head, callbacks);
    for state in &inside.lifecycle_states {
        let node = state.node.as_deref().map_or(Cow::Borrowed("?"), Cow::from);
        out.push_str(&format!(
            "{} is {}\n",
            escaped(&node),
            escaped(&state.state)
        ));
    }
    out
}

fn row<const N: usize>(cells: [String; N]) -> [String; N] {
    cells.map(|cell| {
        if cell.is_empty() {
            "-".to_owned()
        } else {
            cell
        }
    })
}

fn table<const N: usize>(
    out: &mut String,
    head: [&str; N],
    rows: impl Iterator<Item = [String; N]>,
) {
    let rows: Vec<_> = rows.collect();
    if rows.is_empty() {
        return;
    }
    if !out.is_empty() {
        out.push('\n');
    }
    let head = head.map(str::to_owned);
    let all = || std::iter::once(&head).chain(&rows);
    let mut widths = [0; N];
    for cells in all() {
        for (width, cell) in widths.iter_mut().zip(cells) {
            *width = cell.chars().count().max(*width);
        }
    }
    for cells in all() {
        let padded = cells.iter().zip(widths);
        let line: String = padded
            .map(|(cell, width)| format!("{cell:<0$}", width + COLUMN_GAP))
            .collect();
        out.push_str(line.trim_end());
        out.push('\n');
    }
}

fn owner_name(owner: &Owner<'_>) -> String {
    let process = || format!("process {}", owner.process_id);
    owner.node.as_deref().map_or_else(process, escaped)
}

fn hertz(rate: f64) -> String {
    format!("{rate:.1}")
}

fn percent(ratio: f64) -> String {
    format!("{:.1}%", ratio * 100.0)
}

/// Returns the states in which the thread spent a percent of the time or more.
fn states(ratio: &ThreadStates) -> String {
    let all = [
        ("cpu", ratio.cpu),
        ("throttled", ratio.throttled),
        ("runnable", ratio.runnable),
        ("blocked", ratio.blocked),
    ];
    let shown = all.iter().filter(|(_, share)| *share >= 0.01);
    let words: Vec<_> = shown
        .map(|(state, share)| format!("{state} {:.0}%", 100.0 * share))
        .collect();
    words.join(" ")
}

fn quantiles(durations: Option<&Durations>) -> String {
    durations.map_or_else(String::new, |it| {
        format!("{} {}", seconds(it.p50_seconds), seconds(it.p99_seconds))
    })
}

#[cfg(test)]
mod tests {
    use ros2probe_api::inside::{Buffer, Callback, Process, Publisher, Trigger};

    use super::*;

    fn owner(node: Option<&'static str>) -> Owner<'static> {
        Owner {
            process_id: 42,
            node: node.map(Cow::Borrowed),
            ..Owner::default()
        }
    }

    fn inside() -> Inside<'static> {
        Inside {
            processes: vec![Process {
                process_id: 42,
                process: Some("nav".into()),
                ..Process::default()
            }],
            publishers: vec![Publisher {
                owner: owner(Some("/lidar")),
                topic: "/scan".into(),
                published_messages: 120,
                rate_hertz: Some(10.04),
                ..Publisher::default()
            }],
            buffers: vec![Buffer {
                owner: owner(None),
                topic: Some("/points\u{1b}[2J".into()),
                depth: 3,
                capacity: Some(5),
                ..Buffer::default()
            }],
            callbacks: vec![Callback {
                owner: owner(Some("/nav")),
                trigger: Trigger {
                    kind: "timer".into(),
                    name: None,
                    period_seconds: Some(0.05),
                },
                busy_ratio: Some(0.4),
                states_ratio: Some(ThreadStates {
                    cpu: 0.204,
                    runnable: 0.796,
                    ..ThreadStates::default()
                }),
                ..Callback::default()
            }],
            ..Inside::default()
        }
    }

    #[test]
    fn each_kind_has_a_table_and_hostile_names_are_escaped() {
        let text = text(&inside());
        let lines: Vec<_> = text.lines().collect();
        let find = |start: &str| lines.iter().find(|line| line.starts_with(start));
        let columns = |line: &str| {
            line.split_whitespace()
                .map(str::to_owned)
                .collect::<Vec<_>>()
        };
        let scan = columns(find("/scan").unwrap());
        assert_eq!(scan, ["/scan", "/lidar", "120", "0", "10.0", "-", "-"]);
        let timer = find("timer 50 ms").unwrap();
        assert!(timer.contains("40.0%"), "{text}");
        assert!(timer.ends_with("cpu 20% runnable 80%"), "{text}");
        assert!(find("/points").unwrap().ends_with("3/5"), "{text}");
        assert!(
            text.contains("process 42") && !text.contains('\u{1b}'),
            "{text}"
        );
        assert!(!text.contains("SUBSCRIPTION"));
    }
}
