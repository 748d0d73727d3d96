//! Text of a learnt watchlist: a configuration file with the reason of each value.

use std::fmt::Write as _;

use super::Learnt;
use super::thresholds::{
    LATENCY_DEVIATIONS, LEAST_LOSS, RATE_DEVIATIONS, RATE_MARGIN, Remark, SILENCE_MARGIN,
    TopicThresholds,
};
use ros2probe_api::parameters::Parameters;
use ros2probe_daemon::config::MAX_PARAMETERS;
use ros2probe_daemon::config::rehearsal::STARTUP_GRACE_SECONDS;
use ros2probe_daemon::escape::visible;

/// Column at which reasons begin.
const REASON_COLUMN: usize = 28;
/// Maximum size of a configuration file that an agent reads, in bytes.
const MAX_BYTES: usize = 1 << 20;

/// Origin of a watchlist.
#[derive(Clone, Copy, Debug)]
pub struct Source<'a> {
    /// Name of the agent or the capture, as text for people.
    pub place: &'a str,
    /// Domain id.
    pub domain_id: u32,
    /// Whether entries name the domain, because the agent sees several.
    pub names_domain: bool,
    /// Times of the first and the last poll.
    pub period: (&'a str, &'a str),
    /// Number of whole seconds of learning.
    pub seconds: u32,
}

/// Returns the text of the file. If reasons make it larger than an agent reads, they are left out.
#[must_use]
pub fn text(learnt: &Learnt, source: &Source<'_>) -> String {
    let explained = entries(learnt, source, true);
    if explained.len() <= MAX_BYTES {
        return explained;
    }
    entries(learnt, source, false)
}

fn entries(learnt: &Learnt, source: &Source<'_>, is_explained: bool) -> String {
    let mut text = head(source);
    text.push_str("version: 1\nwatch:");
    if learnt
        .topics
        .iter()
        .all(|topic_thresholds| !is_expected(topic_thresholds))
    {
        text.push_str(" []");
    }
    text.push('\n');
    for topic_thresholds in &learnt.topics {
        entry(&mut text, topic_thresholds, source, is_explained);
    }
    if learnt.unnamed > 0 {
        let count = learnt.unnamed;
        line(
            &mut text,
            &format!("  # Topics that no watch can name: {count}"),
        );
    }
    if learnt.beyond_limit > 0 {
        let count = learnt.beyond_limit;
        let why = "  # Topics beyond the default of limits.watches, not learnt";
        line(&mut text, &format!("{why}: {count}"));
    }
    text
}

/// Returns the part of the file with the known parameters of a domain.
#[must_use]
pub fn parameters(known: &Parameters<'_>, domain_id: u32) -> String {
    let mut text = String::new();
    let own = known.parameters.iter();
    let mut own = own.filter(|each| each.domain_id == domain_id).peekable();
    if own.peek().is_none() {
        line(
            &mut text,
            "# No parameter is known: nodes announce them when they start.",
        );
        return text;
    }
    line(
        &mut text,
        "# Last known values; another value is a finding. Remove those that change on purpose.",
    );
    line(&mut text, "robot:");
    line(&mut text, "  parameters_expected:");
    for each in own.by_ref().take(MAX_PARAMETERS) {
        let quoted = |text: &str| serde_json::Value::from(text).to_string();
        let [node, name, value] =
            [&each.ros_node, &each.name, &each.value].map(|text| quoted(text));
        let entry = format!("    - {{node: {node}, name: {name}, value: {value}}}");
        line(&mut text, &entry);
    }
    let omitted = own.count();
    if omitted > 0 {
        line(
            &mut text,
            &format!("    # Parameters beyond the limit of {MAX_PARAMETERS}: {omitted}"),
        );
    }
    text
}

/// Returns whether a topic has any expectation.
#[must_use]
pub fn is_expected(topic_thresholds: &TopicThresholds) -> bool {
    let mut remarks = topic_thresholds.remarks.iter();
    remarks.any(|remark| matches!(remark, Remark::Set(..)))
}

fn head(source: &Source<'_>) -> String {
    let Source {
        place,
        domain_id,
        period: (from, to),
        seconds,
        ..
    } = source;
    let place = visible(place);
    let (rate, loss) = (RATE_MARGIN * 100.0, LEAST_LOSS * 100.0);
    format!(
        "\
# Watchlist learnt by `rp learn` from {place}, domain {domain_id},
# {from} to {to}: {seconds} s.
# Review it: faults that the robot had at that time are expected now.
#
# min_rate_hz, max_rate_hz: median of the rates in windows of at least three messages (1 to 10 s),
#   with a margin of {rate} % or {RATE_DEVIATIONS} deviations (1.4826 times the MAD), whichever is larger
# window_s: a longer window, in which a rate that varies from second to second is steady
# max_loss_ratio: three times the 95th percentile of windows of 10 s, at least {loss} % and one message
# max_latency_ms: median of one-second means with {LATENCY_DEVIATIONS} deviations or 5 ms, at least twice
#   the 95th percentile
# max_silence_s: {SILENCE_MARGIN} times the longest silence, at least 2 s and five messages
# publishers, subscribers: median of the numbers, from {STARTUP_GRACE_SECONDS} s after the first publisher on
# A value that the robot itself would have violated is widened to the extreme that was seen. One
# that is then too wide to find a fault is left out.
"
    )
}

fn entry(
    text: &mut String,
    topic_thresholds: &TopicThresholds,
    source: &Source<'_>,
    is_explained: bool,
) {
    let name = &topic_thresholds.topic;
    if is_expected(topic_thresholds) {
        line(text, &format!("  - topic: {name}"));
        if source.names_domain {
            line(text, &format!("    domain: {}", source.domain_id));
        }
    } else if is_explained {
        line(text, &format!("  # {name} has no expectations:"));
    }
    for remark in &topic_thresholds.remarks {
        match remark {
            Remark::Set(key, value, why) if why.is_empty() || !is_explained => {
                line(text, &format!("    {key}: {value}"));
            }
            Remark::Set(key, value, why) => {
                let setting = format!("    {key}: {value}");
                line(
                    text,
                    &format!("{setting:REASON_COLUMN$}  # {}", visible(why)),
                );
            }
            Remark::LeftOut(..) if !is_explained => {}
            Remark::LeftOut(keys, why) => {
                line(text, &format!("    # no {keys}: {}", visible(why)));
            }
        }
    }
}

fn line(text: &mut String, line: &str) {
    // Writing into a string cannot fail.
    let _ = writeln!(text, "{line}");
}
