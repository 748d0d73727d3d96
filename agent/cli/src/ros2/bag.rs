//! Text of `ros2 bag info`, by dialect.

use std::fmt::Write as _;

use jiff::tz::TimeZone;

use super::Dialect;
use ros2probe_bag::info::{Bag, Details, SERVICE_EVENT};
use ros2probe_bag::metadata::Topic;
use ros2probe_daemon::escape::visible;

/// Sort order of topics.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default, clap::ValueEnum)]
pub enum Sort {
    /// By name.
    #[default]
    Name,
    /// By type.
    Type,
    /// By number of messages.
    Count,
}

/// Returns the text of `ros2 bag info` in the time zone of this host. `details` are those of `-v`.
#[must_use]
pub fn info(bag: &Bag, dialect: Dialect, sort: Sort, details: Option<&Details>) -> String {
    let zone = &TimeZone::system();
    let metadata = &bag.metadata;
    let parts = Parts::of(&metadata.topics, dialect, sort);
    let mut text = "\n".to_owned();
    let mut line = |label: &str, value: &dyn std::fmt::Display| {
        let _ = writeln!(text, "{label:<VALUE_COLUMN$}{value}");
    };
    let files = metadata.relative_file_paths.iter();
    let files: Vec<String> = files.map(|file| visible(file).into_owned()).collect();
    line("Files:", &lines_of(&files));
    line("Bag size:", &size(bag.bytes));
    line("Storage id:", &visible(&metadata.storage_identifier));
    if dialect > Dialect::Humble {
        let distro = visible(&metadata.ros_distro);
        line(
            "ROS Distro:",
            &if distro.is_empty() {
                "unknown"
            } else {
                &distro
            },
        );
    }
    let end = metadata.starting_time.saturating_add(metadata.duration);
    line(
        "Duration:",
        &format_args!("{}s", seconds(metadata.duration)),
    );
    line("Start:", &moment(metadata.starting_time, zone));
    line("End:", &moment(end, zone));
    line(
        "Messages:",
        &metadata
            .message_count
            .saturating_sub(parts.of_services_and_actions),
    );
    let topics: Vec<String> = parts
        .topics
        .iter()
        .map(|topic| topic_line(topic, details))
        .collect();
    line("Topic information:", &lines_of(&topics));
    if dialect > Dialect::Humble {
        let label = if dialect == Dialect::Jazzy {
            "Service:"
        } else {
            "Services:"
        };
        line(label, &parts.services.len());
        text.push_str("Service information: ");
        parts.write_services(&mut text, details);
    }
    if dialect > Dialect::Jazzy {
        // The list of services ends with a line break; `-v` adds another.
        if parts.services.is_empty() || details.is_some() {
            text.push('\n');
        }
        let _ = writeln!(text, "{:<VALUE_COLUMN$}{}", "Actions:", parts.actions.len());
        text.push_str("Action information: ");
        parts.write_actions(&mut text, details);
    }
    text.push('\n');
    text
}

/// Returns the text of `ros2 bag info -t`: topic names without those of services and actions.
#[must_use]
pub fn names(bag: &Bag, dialect: Dialect, sort: Sort) -> String {
    let parts = Parts::of(&bag.metadata.topics, dialect, sort);
    parts
        .topics
        .iter()
        .map(|topic| format!("{}\n", visible(&topic.name)))
        .collect()
}

/// Column at which values begin.
const VALUE_COLUMN: usize = 19;
/// Topics of an action, and the suffix that each adds to the action's type.
const ACTION_TOPICS: [(&str, &str); 5] = [
    ("/_action/feedback", "_FeedbackMessage"),
    ("/_action/status", ""),
    ("/_action/send_goal/_service_event", "_SendGoal_Event"),
    ("/_action/cancel_goal/_service_event", ""),
    ("/_action/get_result/_service_event", "_GetResult_Event"),
];

/// Topics, services and actions, each sorted.
struct Parts<'a> {
    topics: Vec<&'a Topic>,
    services: Vec<&'a Topic>,
    actions: Vec<Action<'a>>,
    /// Number of messages of services and actions.
    of_services_and_actions: u64,
}

struct Action<'a> {
    name: &'a str,
    type_name: String,
    format: &'a str,
    /// Message counts in the order of [`ACTION_TOPICS`].
    counts: [u64; ACTION_TOPICS.len()],
}

impl<'a> Parts<'a> {
    fn of(all: &'a [Topic], dialect: Dialect, sort: Sort) -> Self {
        let mut parts = Parts {
            topics: Vec::new(),
            services: Vec::new(),
            actions: Vec::new(),
            of_services_and_actions: 0,
        };
        for topic in all {
            let is_event = topic.name.ends_with(SERVICE_EVENT)
                && topic.type_name.contains("/srv/")
                && topic.type_name.ends_with("_Event");
            let of_action = || {
                ACTION_TOPICS
                    .iter()
                    .position(|(suffix, _)| topic.name.ends_with(suffix))
                    .filter(|_| {
                        topic.type_name.contains("/action/")
                            || topic.type_name.starts_with("action_msgs/")
                    })
            };
            if dialect > Dialect::Jazzy
                && let Some(part) = of_action()
            {
                parts.of_services_and_actions = parts
                    .of_services_and_actions
                    .saturating_add(topic.message_count);
                parts.action(topic, part);
            } else if dialect > Dialect::Humble && is_event {
                parts.of_services_and_actions = parts
                    .of_services_and_actions
                    .saturating_add(topic.message_count);
                parts.services.push(topic);
            } else {
                parts.topics.push(topic);
            }
        }
        if dialect > Dialect::Humble {
            let sorted = |topics: &mut Vec<&Topic>| match sort {
                Sort::Name => topics.sort_by(|a, b| a.name.cmp(&b.name)),
                Sort::Type => topics.sort_by(|a, b| a.type_name.cmp(&b.type_name)),
                Sort::Count => topics.sort_by_key(|topic| topic.message_count),
            };
            sorted(&mut parts.topics);
            sorted(&mut parts.services);
            match sort {
                Sort::Name => parts.actions.sort_by(|a, b| a.name.cmp(b.name)),
                Sort::Type => parts.actions.sort_by(|a, b| a.type_name.cmp(&b.type_name)),
                Sort::Count => parts
                    .actions
                    .sort_by_key(|action| action.counts.map(u128::from).iter().sum::<u128>()),
            }
        }
        parts
    }

    fn action(&mut self, topic: &'a Topic, part: usize) {
        let Some((suffix, type_suffix)) = ACTION_TOPICS.get(part) else {
            return;
        };
        let name = topic.name.strip_suffix(suffix).unwrap_or(&topic.name);
        let known = self.actions.iter().position(|action| action.name == name);
        let at = known.unwrap_or_else(|| {
            self.actions.push(Action {
                name,
                type_name: String::new(),
                format: &topic.serialization_format,
                counts: [0; ACTION_TOPICS.len()],
            });
            self.actions.len() - 1
        });
        if let Some(action) = self.actions.get_mut(at) {
            if let Some(count) = action.counts.get_mut(part) {
                *count = count.saturating_add(topic.message_count);
            }
            if !type_suffix.is_empty()
                && let Some(type_name) = topic.type_name.strip_suffix(type_suffix)
            {
                action.type_name = type_name.to_owned();
            }
        }
    }

    fn write_services(&self, text: &mut String, details: Option<&Details>) {
        for (index, topic) in self.services.iter().enumerate() {
            if index > 0 {
                let _ = write!(text, "{:width$}", "", width = VALUE_COLUMN + 2);
            }
            let service = topic
                .name
                .strip_suffix(SERVICE_EVENT)
                .unwrap_or(&topic.name);
            let type_name = topic
                .type_name
                .strip_suffix("_Event")
                .unwrap_or(&topic.type_name);
            let counts = match details {
                None => format!("Event Count: {} | ", topic.message_count),
                Some(details) => {
                    let (requests, responses) = details.calls(&topic.name);
                    format!(
                        "Request Count: {requests} | Response Count: {responses} | \
                        Size Contribution: {} | ",
                        size(details.size(&topic.name))
                    )
                }
            };
            let [service, type_name, format] =
                [service, type_name, &topic.serialization_format].map(visible);
            let _ = writeln!(
                text,
                "Service: {service} | Type: {type_name} | {counts}Serialization Format: {format}"
            );
        }
    }

    fn write_actions(&self, text: &mut String, details: Option<&Details>) {
        for action in &self.actions {
            let topics = ACTION_TOPICS.map(|(suffix, _)| format!("{}{suffix}", action.name));
            let contribution = details.map(|details| {
                let bytes = topics.iter().map(|topic| details.size(topic)).sum();
                format!("Size Contribution: {} | ", size(bytes))
            });
            let _ = write!(
                text,
                "\n  Action: {} | Type: {} | Topics: 2 | Service: 3 | {}Serialization Format: {}",
                visible(action.name),
                visible(&action.type_name),
                contribution.unwrap_or_default(),
                visible(action.format)
            );
            let [feedback, status, events @ ..] = action.counts;
            let _ = write!(text, "\n    Topic: feedback | Count: {feedback}");
            let _ = write!(text, "\n    Topic: status | Count: {status}");
            let [_, _, names @ ..] = &topics;
            let services = ["send_goal", "cancel_goal", "get_result"];
            for ((service, events), topic) in services.iter().zip(events).zip(names) {
                let counts = match details {
                    None => format!("Event Count: {events}"),
                    Some(details) => {
                        let (requests, responses) = details.calls(topic);
                        format!("Request Count: {requests} | Response Count: {responses}")
                    }
                };
                let _ = write!(text, "\n    Service: {service} | {counts}");
            }
        }
    }
}

fn topic_line(topic: &Topic, details: Option<&Details>) -> String {
    let contribution = details
        .map(|details| format!("Size Contribution: {} | ", size(details.size(&topic.name))))
        .unwrap_or_default();
    format!(
        "Topic: {} | Type: {} | Count: {} | {contribution}Serialization Format: {}",
        visible(&topic.name),
        visible(&topic.type_name),
        topic.message_count,
        visible(&topic.serialization_format)
    )
}

/// Joins lines, indented to the column of values.
fn lines_of(lines: &[String]) -> String {
    lines.join(&format!("\n{:VALUE_COLUMN$}", ""))
}

/// Returns a size in the largest unit that keeps the number below 1024.
#[expect(clippy::cast_precision_loss, reason = "one decimal is printed")]
fn size(bytes: u64) -> String {
    if bytes < 1024 {
        return format!("{bytes} B");
    }
    let mut size = bytes as f64 / 1024.0;
    let mut units = ["KiB", "MiB", "GiB"].into_iter();
    let mut unit = units.next().unwrap_or_default();
    while size >= 1024.0 {
        size /= 1024.0;
        match units.next() {
            Some(next) => unit = next,
            None => return format!("{size:.1} TiB"),
        }
    }
    format!("{size:.1} {unit}")
}

fn seconds(nanoseconds: u64) -> String {
    format!(
        "{}.{:09}",
        nanoseconds / 1_000_000_000,
        nanoseconds % 1_000_000_000
    )
}

fn moment(time: u64, zone: &TimeZone) -> String {
    let whole = i64::try_from(time / 1_000_000_000).unwrap_or(i64::MAX);
    let local = jiff::Timestamp::new(whole, 0).map(|time| time.to_zoned(zone.clone()));
    let local = local.map(|time| time.strftime("%b %e %Y %H:%M:%S").to_string());
    let fraction = time % 1_000_000_000;
    format!(
        "{}.{fraction:09} ({})",
        local.unwrap_or_default(),
        seconds(time)
    )
}
