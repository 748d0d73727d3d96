//! Header lines: the robot, the state of its agent, and what the agent cannot see. A blind agent
//! must never look healthy.

use ros2probe_api::health::Health;
use ros2probe_daemon::missed_announcements::{DISCOVER_COMMAND, explanation, sentence};
use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use super::app::App;
use super::details::Styled;
use super::row::RowState;
use super::text::{counted, escaped};
use super::theme::{Kind, Theme};

/// Age above which the table is stale, as in the agent itself.
const STALE_AGE: Duration = Duration::from_secs(5);

/// Returns at most `most` lines. With a `width` of 0, lines are as wide as their text.
#[must_use]
pub fn lines(app: &App, width: usize, most: usize, theme: Theme, now: Instant) -> Vec<Styled> {
    let mut lines = vec![
        (robot(app, width, now), Kind::Heading),
        (agent(app), Kind::Plain),
    ];
    let mut warnings = warnings(app, now);
    let room = most.saturating_sub(lines.len()).max(1);
    if warnings.len() > room {
        let more = warnings.len() - room;
        warnings.truncate(room);
        if let Some((last, _)) = warnings.last_mut() {
            last.push_str(&format!(" {} {more} more", theme.cut()));
        }
    }
    lines.extend(warnings);
    lines
}

/// Returns `rp top  robot1  domain 0  24 topics, 20 measured, 3 with problems      0.4 s old`.
fn robot(app: &App, width: usize, now: Instant) -> String {
    let host = app
        .health
        .as_ref()
        .filter(|(health, _)| health.source != "replay")
        .and_then(|(health, _)| health.host.clone());
    let host = escaped(&host.unwrap_or_else(|| app.place.clone()));
    let domains: BTreeSet<_> = app.rows().iter().map(|row| row.key.domain_id).collect();
    let domains = match (app.domain_id, domains.len()) {
        (Some(domain_id), _) => format!("domain {domain_id}"),
        (None, 0) => "no domain".to_owned(),
        (None, count) => {
            let ids: Vec<_> = domains.iter().map(ToString::to_string).collect();
            format!(
                "domain{} {}",
                if count == 1 { "" } else { "s" },
                ids.join(",")
            )
        }
    };
    let count = |is_counted: fn(&super::row::Row) -> bool| {
        app.rows().iter().filter(|row| is_counted(row)).count()
    };
    let problems = count(|row| !row.problems.is_empty());
    let left = format!(
        "rp top  {host}  {domains}  {}, {} measured, {problems} with problems",
        counted(app.rows().len() as u64, "topic"),
        count(|row| row.is_measured),
    );
    let is_over = app
        .health
        .as_ref()
        .is_some_and(|(health, _)| health.finished);
    let age = match app.age(now).map(|age| age.as_secs_f64()) {
        None => "no data".to_owned(),
        // No data is newer than the end of a capture.
        Some(_) if is_over && app.unreachable_since.is_none() => "at its end".to_owned(),
        Some(age) if age >= 100.0 => format!("{age:.0} s old"),
        Some(age) => format!("{age:.1} s old"),
    };
    if width == 0 {
        return format!("{left}, {age}");
    }
    let room = width.saturating_sub(left.chars().count());
    if room > age.len() {
        return format!("{left}{age:>room$}");
    }
    format!("{age}  {left}")
}

/// Returns the line about the agent, and about the table's sorting and filter.
fn agent(app: &App) -> String {
    let state = match (&app.health, &app.unreachable_since) {
        (_, Some(_)) => "AGENT GONE".to_owned(),
        (None, None) => "waiting for the agent".to_owned(),
        (Some((health, _)), None) if !health.ready => "AGENT NOT READY".to_owned(),
        (Some((health, _)), None) => {
            let source = match health.source.as_ref() {
                "host" => "sees the host's sockets",
                "wire" => "sees the host's interfaces",
                "replay" if health.finished => "has replayed its capture to the end",
                "replay" => "replays a capture",
                _ => "ready",
            };
            format!("agent {source}")
        }
    };
    let mut line = format!("{state}; sorted by {}", app.sort.label());
    if app.reverse {
        line.push_str(", reversed");
    }
    if app.filter.is_set() {
        let mut only = Vec::new();
        if app.filter.problems {
            only.push("problems".to_owned());
        }
        if app.filter.measured {
            only.push("measured".to_owned());
        }
        if !app.filter.text.is_empty() {
            only.push(format!("\"{}\"", escaped(&app.filter.text)));
        }
        line.push_str(&format!(
            "; only {}: {} shown",
            only.join(", "),
            app.shown().len()
        ));
    }
    if app.hidden {
        line.push_str("; hidden ones too");
    }
    line
}

/// Returns the dropped data by kind.
fn dropped(health: &Health) -> String {
    let kinds = [
        (health.dropped_packets, "packets"),
        (health.dropped_records, "records"),
        (health.dropped_datagrams, "datagrams"),
        (health.contended_datagrams, "contended datagrams"),
    ];
    let kinds = kinds.iter().filter(|(count, _)| *count > 0);
    let kinds: Vec<_> = kinds
        .map(|(count, kind)| format!("{count} {kind}"))
        .collect();
    kinds.join(", ")
}

fn warnings(app: &App, now: Instant) -> Vec<Styled> {
    let mut warnings = Vec::new();
    let mut warn = |text: String| warnings.push((format!("! {text}"), Kind::Problem));
    if let Some((since, why)) = &app.unreachable_since {
        let since = now.saturating_duration_since(*since).as_secs();
        warn(format!("agent unreachable for {since} s, retrying: {why}"));
    }
    if let Some(age) = app.age(now).filter(|age| *age > STALE_AGE)
        && !app
            .health
            .as_ref()
            .is_some_and(|(health, _)| health.finished && app.unreachable_since.is_none())
    {
        warn(format!("the data shown is {} s old", age.as_secs()));
    }
    let Some((health, _)) = &app.health else {
        return warnings;
    };
    if !health.ready {
        let why = health.reason.as_deref().unwrap_or("it gives no reason");
        warn(format!(
            "the agent does not see the robot: {}",
            escaped(why)
        ));
    }
    if health.dropped() > 0 {
        let when = if app.is_dropping(now) {
            "dropping now"
        } else {
            "dropped"
        };
        warn(format!(
            "{when}: {}; counts are lower bounds",
            dropped(health)
        ));
    }
    let unseen = app
        .rows()
        .iter()
        .filter(|row| row.state == RowState::Unseen);
    let unseen = unseen.count() as u64;
    if unseen > 0 {
        warn(format!(
            "{} not visible: press Enter for the reason",
            counted(unseen, "topic")
        ));
    }
    if health.unknown_writers > 0 {
        let remedy = health.unknown_writers_remedy.as_deref();
        let (what, remedy) = (
            sentence(health.unknown_writers),
            remedy.unwrap_or(DISCOVER_COMMAND),
        );
        warn(format!("{what}: {}", explanation(&escaped(remedy))));
    }
    if health.topics_rejected > 0 {
        let topics = counted(health.topics_rejected, "watched topic");
        warn(format!("{topics} not measured: limits.topics is reached"));
    }
    for table in health.tables.iter().filter(|table| table.evictions > 0) {
        let (count, name) = (table.evictions, escaped(&table.table));
        warn(format!(
            "the table of {name} is full: {count} evicted (limits)"
        ));
    }
    if let Some(reason) = &health.source_reason {
        warn(format!("sees less than it could: {}", escaped(reason)));
    }
    for blind in health.abilities.iter().filter(|ability| !ability.able) {
        if let Some(reason) = &blind.reason {
            warn(format!(
                "blind for {}: {}",
                escaped(&blind.ability),
                escaped(reason)
            ));
        }
    }
    warnings
}
