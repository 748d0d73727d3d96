//! Events as lines of the events pane: bounded, oldest first, escaped.

use std::borrow::Cow;
use std::collections::VecDeque;

use super::text::escaped;
use ros2probe_api::attributes::Value;
use ros2probe_api::events::{Event, Lagged};

/// Maximum number of events kept for scrolling.
const MAX_EVENTS: usize = 1_000;

/// Line of one event.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Line {
    /// Whether the severity is a warning or worse.
    pub is_warning: bool,
    /// `14:02:11 WARN message.lost /points count=3`.
    pub text: String,
}

/// Latest events.
#[derive(Clone, Debug, Default)]
pub struct EventPane {
    lines: VecDeque<Line>,
    /// Whether only warnings are shown.
    pub only_warnings: bool,
}

impl EventPane {
    /// Adds an event, unless it belongs to another domain than `domain_id`.
    pub fn add(&mut self, event: &Event<'_>, domain_id: Option<u32>) {
        let own = event.attributes.get("domain_id");
        if let (Some(Value::Number(own)), Some(wanted)) = (own, domain_id)
            && *own != u64::from(wanted)
        {
            return;
        }
        let mut text = format!("{} {:<5} ", clock(&event.time), escaped(&event.severity));
        text.push_str(&escaped(
            event.name.strip_prefix("ros2.").unwrap_or(&event.name),
        ));
        let first = ["topic", "ros_node", "what", "watch", "error"];
        let last = [
            "endpoint",
            "participant",
            "participants",
            "reader",
            "writer",
        ];
        for key in first {
            if let Some(value) = event.attributes.get(key) {
                text.push(' ');
                text.push_str(&shown(value));
            }
        }
        // Identities come last, since they are long and of little interest.
        let mut attributes: Vec<_> = event.attributes.0.iter().collect();
        attributes.sort_unstable_by_key(|(key, _)| key);
        for is_identity in [false, true] {
            for (key, value) in &attributes {
                let key = key.as_ref();
                let is_noise = matches!(key, "domain_id" | "kind" | "message_type");
                let value = shown(value);
                let is_skipped = first.contains(&key) || is_noise || value.is_empty();
                if !is_skipped && last.contains(&key) == is_identity {
                    text.push_str(&format!(" {}={value}", escaped(key)));
                }
            }
        }
        self.push(Line {
            is_warning: event.severity != "INFO",
            text,
        });
    }

    /// Adds a line about missing events.
    pub fn lag(&mut self, lagged: &Lagged) {
        let text = match lagged.missed {
            Some(missed) => format!("-------- {missed} events are missing here"),
            None => "-------- the agent has restarted".to_owned(),
        };
        self.push(Line {
            is_warning: true,
            text,
        });
    }

    /// Returns the lines to show, oldest first.
    pub fn shown(&self) -> impl DoubleEndedIterator<Item = &Line> {
        let lines = self.lines.iter();
        lines.filter(|line| line.is_warning || !self.only_warnings)
    }

    fn push(&mut self, line: Line) {
        self.lines.push_back(line);
        if self.lines.len() > MAX_EVENTS {
            self.lines.pop_front();
        }
    }
}

/// Returns the time of day of `2026-11-20T14:02:11.123456789Z`.
fn clock(time: &str) -> String {
    let time = escaped(time);
    let (_, clock) = time.split_once('T').unwrap_or_default();
    clock.chars().take(8).collect()
}

/// Returns the value of an attribute as text.
#[must_use]
pub fn shown(value: &Value<'_>) -> String {
    match value {
        Value::Text(text) => escaped(text),
        Value::List(texts) => shown_list(texts),
        Value::Number(number) => number.to_string(),
        Value::Real(real) => format!("{real:.3}"),
        Value::Unknown(_) => "?".to_owned(),
    }
}

/// Returns texts separated by commas.
#[must_use]
pub fn shown_list(texts: &[Cow<'_, str>]) -> String {
    let texts: Vec<_> = texts.iter().map(|text| escaped(text)).collect();
    texts.join(",")
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn event(json: serde_json::Value) -> Event<'static> {
        serde_json::from_value(json).unwrap()
    }

    #[test]
    fn the_line_of_an_event_begins_with_its_name_and_topic() {
        let mut events = EventPane::default();
        let lost = event(json!({
            "time": "2026-11-20T14:02:11.123Z", "name": "ros2.message.lost", "severity": "WARN",
            "attributes": {"domain_id": 0, "count": 3, "topic": "/po\u{1b}[31mints", "writer": "01.02"},
        }));
        events.add(&lost, Some(0));
        events.add(&lost, Some(7));
        let lines: Vec<_> = events.shown().map(|line| line.text.as_str()).collect();
        assert_eq!(
            lines,
            [r"14:02:11 WARN  message.lost /po\u{1b}[31mints count=3 writer=01.02"]
        );
    }

    #[test]
    fn the_pane_keeps_the_latest_events_and_the_number_of_missed_ones() {
        let mut events = EventPane::default();
        for number in 0..MAX_EVENTS + 5 {
            events.add(
                &event(json!({"severity": "INFO", "attributes": {"count": number}})),
                None,
            );
        }
        events.lag(&Lagged {
            missed: Some(7),
            reason: "overwritten".into(),
        });
        assert_eq!(events.shown().count(), MAX_EVENTS);
        events.only_warnings = true;
        let lines: Vec<_> = events.shown().collect();
        assert_eq!(lines.len(), 1);
        assert!(lines[0].text.contains("7 events are missing"));
    }
}
