//! Details of one topic as lines: expectations, problems with their causes, delivery, and each
//! writer and subscriber.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use ros2probe_api::Open;
use ros2probe_api::diagnosis::{Diagnosis, Finding};
use ros2probe_api::endpoints::Endpoint;
use ros2probe_api::measurement::{Bucket, Delivered, Distribution, Measurement};
use ros2probe_api::topics::{ReasonCode, Topic, TopicDetails, Watching};

use super::event_pane::{shown, shown_list};
use super::inside;
use super::row::{is_measured, shown_name};
use super::text::{beginning, bound, bytes, counted, end, escaped, rate, ratio, seconds};
use super::theme::{Kind, Theme};

/// Maximum number of receivers and destinations without a known reader.
const MAX_OTHERS: usize = 16;
/// Width of a node's name, in columns.
const NODE_WIDTH: usize = 24;

/// A line and its style.
pub type Styled = (String, Kind);

/// Returns all lines. Drawing truncates longer ones.
#[must_use]
pub fn lines(details: &TopicDetails<'_>, width: usize, theme: Theme) -> Vec<Styled> {
    let topic = &details.topic;
    let mut lines = Vec::new();
    let types: Vec<_> = topic.message_types.iter().map(|it| escaped(it)).collect();
    let head = format!(
        "{}  {}  domain {}",
        shown_name(topic),
        types.join(", "),
        topic.domain_id
    );
    lines.push((head, Kind::Plain));
    for watch in &topic.watches {
        lines.push(expectation(watch));
    }
    measured(topic, &mut lines);
    if let Some(inside) = &topic.inside {
        lines.push((inside::counts(inside), Kind::Plain));
        lines.extend(
            inside
                .late
                .iter()
                .map(|late| (inside::late_calls_text(late), Kind::Problem)),
        );
    }
    for finding in &topic.diagnoses {
        lines.push((format!("! {}", diagnosis(finding, topic)), Kind::Problem));
    }
    for reason in &topic.reasons {
        let kind = match reason.code {
            Open::Known(
                ReasonCode::NotWatched
                | ReasonCode::Quiet
                | ReasonCode::NoSubscriber
                | ReasonCode::NoPublisher,
            ) => Kind::Plain,
            _ => Kind::Problem,
        };
        lines.push((format!("why: {}", escaped(&reason.detail)), kind));
    }
    if topic.passages.iter().any(|it| it.passage != "network") {
        let ways_text = topic.passages.iter();
        let ways_text = ways_text.map(|it| format!("{} {}", it.pairs, escaped(&it.passage)));
        let ways_text: Vec<_> = ways_text.collect();
        let line = format!(
            "pairs of publisher and subscriber by: {}",
            ways_text.join(", ")
        );
        lines.push((line, Kind::Plain));
    }
    histograms(details, width, theme, &mut lines);
    publishers(topic, theme, &mut lines);
    subscribers(details, theme, &mut lines);
    other_receivers(details, theme, &mut lines);
    lines
}

fn expectation(watch: &Watching<'_>) -> Styled {
    let expectations = &watch.expectations;
    let mut expected = Vec::new();
    match (expectations.min_rate_hz, expectations.max_rate_hz) {
        (Some(least), Some(most)) => {
            expected.push(format!("{} to {} Hz", bound(least), bound(most)));
        }
        (Some(least), None) => expected.push(format!("at least {} Hz", bound(least))),
        (None, Some(most)) => expected.push(format!("at most {} Hz", bound(most))),
        (None, None) => {}
    }
    if let (Some(rate), Some(window)) = (expected.last_mut(), expectations.window_s) {
        // Writing into a string cannot fail.
        let _ = write!(rate, " in {window} s");
    }
    let most = [
        ("loss", expectations.max_loss_ratio.map(ratio)),
        (
            "latency",
            expectations.max_latency_ms.map(|it| seconds(it / 1e3)),
        ),
        ("silence", expectations.max_silence_s.map(seconds)),
    ];
    for (what, most) in most {
        expected.extend(most.map(|most| format!("{what} at most {most}")));
    }
    for (what, least) in [
        ("publishers", expectations.publishers),
        ("subscribers", expectations.subscribers),
    ] {
        expected.extend(least.map(|least| format!("{what} at least {least}")));
    }
    if expected.is_empty() {
        expected.push("no expectations".to_owned());
    }
    let origin = match watch.origin.as_deref() {
        Some("config") => " (configuration)",
        Some("command_line") => " (command line)",
        Some("api") => " (added)",
        _ => "",
    };
    let broken: Vec<_> = watch.violations.iter().map(|it| escaped(it)).collect();
    let state = match (watch.state.as_ref(), broken.is_empty()) {
        (state, true) => escaped(state),
        (state, false) => format!("{}: {}", escaped(state), broken.join(", ")),
    };
    let is_broken = matches!(watch.state.as_ref(), "violated" | "silent");
    let line = format!(
        "{} matches watch {}{origin}, {}: {state}",
        if is_broken { '!' } else { '-' },
        escaped(&watch.watch),
        expected.join(", "),
    );
    (
        line,
        if is_broken {
            Kind::Problem
        } else {
            Kind::Plain
        },
    )
}

fn measured(topic: &Topic<'_>, lines: &mut Vec<Styled>) {
    let Some(counted) = topic.measurement.as_ref() else {
        lines.push((
            "not measured: press w to count its messages".to_owned(),
            Kind::Plain,
        ));
        return;
    };
    if !is_measured(topic) && !topic.publishers.is_empty() {
        let line = "no longer measured; the figures below are old; press w to resume";
        lines.push((line.to_owned(), Kind::Plain));
    }
    lines.push((counts(counted), Kind::Plain));
    if let Some(received) = &topic.received {
        let line = format!("receivers here: {}", delivered(received));
        let kind = if received.lost_messages > 0 {
            Kind::Problem
        } else {
            Kind::Plain
        };
        lines.push((line, kind));
    }
    if let Some(sampled) = counted.sampled {
        let line = format!(
            "shared memory is sampled: {} of {} messages were seen",
            sampled.seen_messages, sampled.existing_messages
        );
        lines.push((line, Kind::Plain));
    }
    if counted.negative_latency_messages > 0 {
        let line = format!(
            "clocks differ: {} messages have timestamps later than their arrival",
            counted.negative_latency_messages
        );
        lines.push((line, Kind::Problem));
    }
    if counted.implausible_latency_messages > 0 {
        let line = format!(
            "clock not set: {} messages have timestamps more than an hour from their arrival",
            counted.implausible_latency_messages
        );
        lines.push((line, Kind::Problem));
    }
    if counted.doubted_sequence_jumps > 0 {
        let line = format!(
            "sequence numbers jumped {} times: restarts, missed messages or forged ones",
            counted.doubted_sequence_jumps
        );
        lines.push((line, Kind::Plain));
    }
}

fn counts(counted: &Measurement) -> String {
    let all = counted.messages + counted.lost_messages;
    let mut line = format!(
        "since measurement started: {} of {all} messages, {}",
        counted.messages,
        bytes(to_f64(counted.bytes))
    );
    let rest = [
        ("lost", counted.lost_messages),
        ("of these in part", counted.incomplete_messages),
        ("sent again", counted.recovered_messages),
        ("seen again", counted.duplicate_messages),
    ];
    for (what, count) in rest {
        if count > 0 || what == "lost" {
            line.push_str(&format!(", {count} {what}"));
        }
    }
    line
}

fn delivered(it: &Delivered) -> String {
    let line = format!("{} received, {} lost", it.messages, it.lost_messages);
    match causes(it) {
        causes if causes.is_empty() => line,
        causes => format!("{line} ({causes})"),
    }
}

/// Returns the causes of lost messages, as text.
fn causes(it: &Delivered) -> String {
    let causes = [
        ("at the sender", it.lost_at_sender_messages),
        ("before this host", it.lost_before_host_messages),
        ("in reassembly", it.lost_in_reassembly_messages),
        ("in full socket buffers", it.lost_in_socket_buffer_messages),
        ("pending", it.pending_messages),
    ];
    let causes = causes.iter().filter(|(_, count)| *count > 0);
    let causes: Vec<_> = causes
        .map(|(cause, count)| format!("{count} {cause}"))
        .collect();
    causes.join(", ")
}

fn diagnosis(finding: &Finding<'_>, topic: &Topic<'_>) -> String {
    let name = |guid: &str| {
        let mut all = topic.publishers.iter().chain(&topic.subscriptions);
        let node = all
            .find(|it| it.guid == guid)
            .and_then(|it| it.node.as_deref());
        escaped(node.unwrap_or(guid))
    };
    match finding {
        Open::Known(Diagnosis::QosIncompatible {
            writer,
            reader,
            policies,
        }) => format!(
            "{} offers less than {} requests: {}",
            name(writer),
            name(reader),
            shown_list(policies)
        ),
        Open::Known(Diagnosis::TypeConflict { types }) => format!(
            "endpoints of different types do not communicate: {}",
            shown_list(types)
        ),
        Open::Known(Diagnosis::TypeHashConflict {
            message_type,
            hashes,
        }) => {
            let hashes: Vec<_> = hashes.iter().map(|hash| escaped(hash)).collect();
            let message_type = escaped(message_type);
            format!("definitions of {message_type} differ: {}", hashes.join(","))
        }
        Open::Known(Diagnosis::UnmatchedPublisher { writer, reason }) => {
            let reason = escaped(unmatched(reason));
            format!("{} has no matching subscriber ({reason})", name(writer))
        }
        Open::Known(Diagnosis::UnmatchedSubscription { reader, reason }) => {
            let reason = escaped(unmatched(reason));
            format!("{} has no matching publisher ({reason})", name(reader))
        }
        Open::Known(Diagnosis::HangingCall { writer }) => {
            format!("{} receives no reply", name(writer))
        }
        Open::Known(Diagnosis::RestampingNode { node, input }) => format!(
            "{} replaces the stamps of {}: chains end here",
            escaped(node),
            escaped(input)
        ),
        Open::Known(Diagnosis::BuffersByCpu {
            writer,
            reader,
            backends,
        }) => {
            let why = match reader {
                Some(reader) => format!("{} takes no buffers", name(reader)),
                None => "it is transient local".to_owned(),
            };
            let (writer_name, backends) = (name(writer), shown_list(backends));
            format!("{writer_name} sends through the CPU instead of {backends}: {why}")
        }
        Open::Known(Diagnosis::SlowChain {
            from,
            max_latency_ms,
        }) => {
            let from = escaped(from);
            format!("the chain from {from} takes longer than {max_latency_ms} ms")
        }
        Open::Known(other) => inside::problem(other).unwrap_or_else(|| other.kind().to_owned()),
        Open::Unknown(attributes) => {
            let all = attributes.0.iter();
            let all = all.map(|(key, value)| format!("{}={}", escaped(key), shown(value)));
            all.collect::<Vec<_>>().join(" ")
        }
    }
}

/// Returns the text for the reason of `unmatched_publisher` and `unmatched_subscription`.
fn unmatched(reason: &str) -> &str {
    match reason {
        "unreachable" => "127.0.0.1 only",
        "qos" => "incompatible QoS",
        "type" => "type mismatch",
        "partition" => "another partition",
        "no_endpoint" => "none announced",
        other => other,
    }
}

fn histograms(details: &TopicDetails<'_>, width: usize, theme: Theme, lines: &mut Vec<Styled>) {
    let topic = &details.topic;
    let measured = topic.measurement.as_ref();
    let title = |what: &str, it: Option<Distribution>| {
        it.map(|it| {
            format!(
                "{what}: median {}, p99 {}, {} to {}",
                seconds(it.p50_seconds),
                seconds(it.p99_seconds),
                seconds(it.minimum_seconds),
                seconds(it.maximum_seconds)
            )
        })
    };
    let between = title("between messages", measured.and_then(|it| it.interarrival));
    let latency = title("latency", measured.and_then(|it| it.latency));
    let both = [
        (between, &details.interarrival_buckets),
        (latency, &details.latency_buckets),
    ];
    let both = both.into_iter().filter_map(|(title, buckets)| {
        let title = title?;
        Some((title, buckets))
    });
    let both: Vec<_> = both.collect();
    let half = width.saturating_sub(3) / 2;
    if let ([(left, left_buckets), (right, right_buckets)], true) = (both.as_slice(), half >= 48) {
        let cut = theme.cut();
        let join = |left: &str, right: &str| {
            format!(
                "{:<half$}   {}",
                beginning(left, half, cut),
                beginning(right, half, cut)
            )
        };
        lines.push((join(left, right), Kind::Heading));
        let (left, right) = (
            bars(left_buckets, half, theme),
            bars(right_buckets, half, theme),
        );
        for at in 0..left.len().max(right.len()) {
            let line = |lines: &[String]| lines.get(at).cloned().unwrap_or_default();
            lines.push((join(&line(&left), &line(&right)), Kind::Plain));
        }
        return;
    }
    for (title, buckets) in both {
        lines.push((title, Kind::Heading));
        let bars = bars(buckets, width, theme);
        lines.extend(bars.into_iter().map(|bar| (bar, Kind::Plain)));
    }
}

/// Returns one line per bucket, from the first to the last that is not empty.
#[must_use]
pub fn bars(buckets: &[Bucket], width: usize, theme: Theme) -> Vec<String> {
    let is_filled = |bucket: &Bucket| bucket.count > 0;
    let first = buckets.iter().position(is_filled).unwrap_or(0);
    let behind = buckets.iter().rposition(is_filled).map_or(0, |at| at + 1);
    let most = buckets.iter().map(|it| it.count).max().unwrap_or(0).max(1);
    let filled = buckets.get(first..behind).unwrap_or_default();
    let digits = most.to_string().len();
    let room = width.saturating_sub(digits + 12).min(60);
    let line = |bucket: &Bucket| {
        let bound = match bucket.upper_seconds {
            Some(upper) => format!("<= {:>5}", seconds(upper)),
            None => "   more ".to_owned(),
        };
        let part = to_f64(bucket.count) / to_f64(most);
        format!(
            "  {bound} {:>digits$} {}",
            bucket.count,
            theme.bar(part, room)
        )
    };
    filled.iter().map(line).collect()
}

fn publishers(topic: &Topic<'_>, theme: Theme, lines: &mut Vec<Styled>) {
    if topic.publishers.is_empty() {
        return;
    }
    let title = counted(topic.publishers.len() as u64, "publisher");
    let heading = format!(
        "{title:<NODE_WIDTH$} {:>6} {:>6} {:>6} {:>5} {:>5}  QOS",
        "HZ", "B/S", "LOST", "MED", "P99"
    );
    lines.push((heading, Kind::Heading));
    for writer in &topic.publishers {
        let measured = writer.measurement.as_ref();
        let known = |value: Option<String>| value.unwrap_or_else(|| "-".to_owned());
        let latency = measured.and_then(|it| it.latency);
        let line = format!(
            "{:<NODE_WIDTH$} {:>6} {:>6} {:>6} {:>5} {:>5}  {}",
            node(writer, theme),
            known(measured.and_then(|it| it.rate_hertz).map(rate)),
            known(
                measured
                    .and_then(|it| it.bandwidth_bytes_per_second)
                    .map(bytes)
            ),
            known(measured.map(|it| it.lost_messages.to_string())),
            known(latency.map(|it| seconds(it.p50_seconds))),
            known(latency.map(|it| seconds(it.p99_seconds))),
            qos(writer, topic),
        );
        let is_losing = measured.is_some_and(|it| it.lost_messages > 0);
        lines.push((
            line,
            if is_losing {
                Kind::Problem
            } else {
                Kind::Plain
            },
        ));
    }
}

fn subscribers(details: &TopicDetails<'_>, theme: Theme, lines: &mut Vec<Styled>) {
    let topic = &details.topic;
    if topic.subscriptions.is_empty() {
        return;
    }
    let title = counted(topic.subscriptions.len() as u64, "subscriber");
    let heading = format!(
        "{title:<NODE_WIDTH$} {:>7} {:>6} {:>6}  QOS",
        "CAME", "LOST", "BEHIND"
    );
    lines.push((heading, Kind::Heading));
    for reader in &topic.subscriptions {
        let mut sum: Option<Delivered> = None;
        let own = |readers: &[String]| readers.contains(&reader.guid);
        for delivery in &details.deliveries {
            if delivery.direction == "received" && own(&delivery.readers) {
                add(sum.get_or_insert_default(), &delivery.delivered);
            }
        }
        let acknowledged = details.acknowledgements.iter();
        let mut acknowledged = acknowledged.filter(|it| it.reader == reader.guid);
        let behind = acknowledged.next().map(|first| {
            acknowledged.fold(first.missing_messages, |most, it| {
                most.max(it.missing_messages)
            })
        });
        let known = |value: Option<String>| value.unwrap_or_else(|| "-".to_owned());
        let line = format!(
            "{:<NODE_WIDTH$} {:>7} {:>6} {:>6}  {}",
            node(reader, theme),
            known(sum.map(|it| it.messages.to_string())),
            known(sum.map(|it| it.lost_messages.to_string())),
            known(behind.map(|it| it.to_string())),
            qos(reader, topic),
        );
        let lost = sum.filter(|it| it.lost_messages > 0);
        let kind = if lost.is_some() {
            Kind::Problem
        } else {
            Kind::Plain
        };
        lines.push((line, kind));
        lines.extend(lost.map(|lost| (format!("  lost: {}", causes(&lost)), kind)));
    }
}

/// Adds the lines for receivers without a known reader, and for other destinations.
fn other_receivers(details: &TopicDetails<'_>, theme: Theme, lines: &mut Vec<Styled>) {
    let mut others: BTreeMap<String, Delivered> = BTreeMap::new();
    for delivery in &details.deliveries {
        let to = match (delivery.direction.as_ref(), &delivery.process) {
            ("received", _) if !delivery.readers.is_empty() => continue,
            ("received", Some(process)) => {
                let id = delivery
                    .process_id
                    .map_or_else(String::new, |id| format!(" {id}"));
                format!("in {}{id}", escaped(process))
            }
            ("received", None) => format!("at {}", escaped(&delivery.destination)),
            _ => format!("to {}", escaped(&delivery.destination)),
        };
        add(others.entry(to).or_default(), &delivery.delivered);
    }
    if others.is_empty() {
        return;
    }
    let heading = format!("{:<NODE_WIDTH$} {:>7} {:>6}", "other ways", "CAME", "LOST");
    lines.push((heading, Kind::Heading));
    for (to, it) in others.iter().take(MAX_OTHERS) {
        let to = beginning(to, NODE_WIDTH, theme.cut());
        let line = format!(
            "{to:<NODE_WIDTH$} {:>7} {:>6}",
            it.messages, it.lost_messages
        );
        lines.push((line, Kind::Plain));
    }
    if let Some(more) = others
        .len()
        .checked_sub(MAX_OTHERS)
        .filter(|more| *more > 0)
    {
        lines.push((format!("and {more} more"), Kind::Faint));
    }
}

fn add(sum: &mut Delivered, one: &Delivered) {
    sum.messages += one.messages;
    sum.lost_messages += one.lost_messages;
    sum.lost_at_sender_messages += one.lost_at_sender_messages;
    sum.lost_before_host_messages += one.lost_before_host_messages;
    sum.lost_in_reassembly_messages += one.lost_in_reassembly_messages;
    sum.lost_in_socket_buffer_messages += one.lost_in_socket_buffer_messages;
    sum.pending_messages += one.pending_messages;
}

fn node(endpoint: &Endpoint<'_>, theme: Theme) -> String {
    let name = escaped(endpoint.node.as_deref().unwrap_or(&endpoint.guid));
    end(&name, NODE_WIDTH, theme.cut())
}

fn qos(endpoint: &Endpoint<'_>, topic: &Topic<'_>) -> String {
    let qos = &endpoint.qos;
    let parts = [&qos.reliability, &qos.durability, &qos.history];
    let parts = parts.into_iter().filter(|part| !part.is_empty());
    let mut parts: Vec<_> = parts.map(|part| escaped(part)).collect();
    if let Some(deadline) = qos.deadline_seconds {
        parts.push(format!("deadline {}", seconds(deadline)));
    }
    parts.extend(
        endpoint
            .vendor
            .as_deref()
            .map(|vendor| format!("({})", escaped(vendor))),
    );
    if topic.message_types.len() > 1 {
        parts.push(escaped(&endpoint.message_type));
    }
    parts.join(" ")
}

#[expect(clippy::cast_precision_loss, reason = "counts far below 2^52")]
fn to_f64(count: u64) -> f64 {
    count as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_histogram_omits_empty_buckets_at_both_ends() {
        let bucket = |upper_seconds, count| Bucket {
            upper_seconds,
            count,
        };
        let buckets = [
            bucket(Some(0.001), 0),
            bucket(Some(0.005), 120),
            bucket(Some(0.01), 0),
            bucket(None, 3),
        ];
        assert_eq!(
            bars(&buckets, 30, Theme::default()),
            [
                "  <= 5.0ms 120 ###############",
                "  <=  10ms   0 ",
                "     more    3 #",
            ]
        );
        assert!(bars(&buckets[..1], 30, Theme::default()).is_empty());
        assert!(bars(&[], 30, Theme::default()).is_empty());
    }
}
