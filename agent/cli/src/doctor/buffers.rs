//! Checks of socket receive buffers and of memory for IP reassembly, against the sizes and losses
//! of observed messages.
//!
//! The recommended values are computed. A receive buffer holds two of the largest messages, since
//! the next one arrives while one is being read. Reassembly memory holds sixteen, since an
//! incomplete message stays for `ipfrag_time`. The kernel counts its own overhead and grants twice
//! the requested size.

use super::answers::Answers;
use super::host_state::{Files, HostState, ReadFailure};
use ros2probe_api::doctor::{Area, Finding, Severity};
use ros2probe_api::measurement::Measurement;
use ros2probe_api::topics::Topic;

const AREA: Area = Area::Buffers;
const RECEIVE_MAX: Sysctl = Sysctl("net.core.rmem_max");
const RECEIVE_DEFAULT: Sysctl = Sysctl("net.core.rmem_default");
const REASSEMBLY_SYSCTLS: [(Sysctl, Sysctl); 2] = [
    (
        Sysctl("net.ipv4.ipfrag_high_thresh"),
        Sysctl("net.ipv4.ipfrag_time"),
    ),
    (
        Sysctl("net.ipv6.ip6frag_high_thresh"),
        Sysctl("net.ipv6.ip6frag_time"),
    ),
];
const MEBIBYTE: u64 = 1 << 20;
/// Size in bytes above which a message needs several UDP datagrams.
const LARGE_MESSAGE: u64 = 64 << 10;
/// Assumed message size without measurements: a typical camera image or lidar scan.
const DEFAULT_MESSAGE: u64 = 4 * MEBIBYTE;
const MESSAGES_IN_BUFFER: u64 = 2;
const MESSAGES_IN_REASSEMBLY: u64 = 16;
/// Ratio of lost messages above which the finding is a problem.
const PROBLEM_LOSS_RATIO: f64 = 0.01;
/// Maximum number of topics in one sentence.
const MAX_NAMED_TOPICS: usize = 3;

/// Name of a kernel parameter.
#[derive(Clone, Copy, Debug)]
struct Sysctl(&'static str);

/// Topic with the largest measured messages, and their mean size.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Largest {
    bytes: u64,
    topic: String,
}

/// Returns the findings of all buffer checks.
#[must_use]
pub fn check(host: &HostState, answers: Option<&Answers>) -> Vec<Finding> {
    let topics = answers.map_or(&[][..], |answers| &answers.topics.topics);
    let largest = largest(topics);
    let mut findings = vec![receive(&host.files, largest.as_ref())];
    findings.extend(loss_finding(
        topics,
        "socket_losses",
        "in full socket buffers",
        |topic| {
            topic
                .received
                .map_or(0, |received| received.lost_in_socket_buffer_messages)
        },
        |finding| {
            let bytes = recommended_size(largest.as_ref(), MESSAGES_IN_BUFFER);
            finding
                .remedy(RECEIVE_DEFAULT.set(bytes))
                .remedy(RECEIVE_MAX.set(bytes))
                .elsewhere(format!(
                    "<Internal><SocketReceiveBufferSize min=\"{bytes}B\"/></Internal>    # in \
                     CYCLONEDDS_URI"
                ))
        },
    ));
    let is_large = largest
        .as_ref()
        .is_some_and(|largest| largest.bytes > LARGE_MESSAGE);
    findings.extend(reassembly(
        &host.files,
        largest.as_ref().filter(|_| is_large),
    ));
    findings.extend(loss_finding(
        topics,
        "reassembly_losses",
        "in IP reassembly, because a fragment was missing",
        |topic| {
            topic
                .received
                .map_or(0, |received| received.lost_in_reassembly_messages)
        },
        |finding| {
            let [(memory, time), _] = REASSEMBLY_SYSCTLS;
            finding
                .remedy(memory.set(128 * MEBIBYTE))
                .remedy(time.set(3))
        },
    ));
    findings
}

/// Returns the topic with the largest mean message size; `None` without measurements. Sizes vary
/// little within a topic.
fn largest(topics: &[Topic<'_>]) -> Option<Largest> {
    let mean = |measured: &Measurement| measured.bytes.checked_div(measured.messages);
    let of_topic = |topic: &Topic<'_>| {
        let writers = topic
            .publishers
            .iter()
            .filter_map(|each| each.measurement.as_ref());
        let all = writers.chain(topic.measurement.as_ref());
        all.filter_map(mean).max()
    };
    let sizes = topics
        .iter()
        .filter_map(|topic| Some((of_topic(topic)?, topic)));
    let (bytes, topic) = sizes.max_by_key(|(bytes, _)| *bytes)?;
    let topic = topic.name.clone();
    let topic = topic.into_owned();
    Some(Largest { bytes, topic })
}

/// Returns the size of `messages` of the largest messages, rounded up to whole mebibytes.
fn recommended_size(largest: Option<&Largest>, messages: u64) -> u64 {
    let bytes = largest.map_or(DEFAULT_MESSAGE, |largest| largest.bytes);
    bytes
        .saturating_mul(messages)
        .max(1)
        .div_ceil(MEBIBYTE)
        .saturating_mul(MEBIBYTE)
}

fn receive(files: &Files, largest: Option<&Largest>) -> Finding {
    let report = |severity, sentence: String| Finding::new(AREA, "receive", severity, sentence);
    let (most, default) = (RECEIVE_MAX.read(files), RECEIVE_DEFAULT.read(files));
    let finding = match &most {
        Err(error) => {
            let sentence = format!("the maximum socket receive buffer is unknown: {error}");
            report(Severity::Unknown, sentence)
                .remedy("sysctl net.core.rmem_max    # on the host itself")
        }
        Ok(most) => {
            let wanted = recommended_size(largest, MESSAGES_IN_BUFFER);
            let (severity, words) = match largest {
                None if *most >= wanted => (
                    Severity::Ok,
                    "enough for typical point clouds and images".to_owned(),
                ),
                None => (
                    Severity::Note,
                    "point clouds and images of some MB need more".to_owned(),
                ),
                Some(largest) if *most >= largest.bytes.saturating_mul(MESSAGES_IN_BUFFER) => (
                    Severity::Ok,
                    format!(
                        "enough for two messages of {} ({})",
                        largest.topic,
                        size(largest.bytes)
                    ),
                ),
                Some(largest) => (
                    Severity::Warning,
                    format!(
                        "two messages of {} ({} each) do not fit: a busy subscriber loses a burst",
                        largest.topic,
                        size(largest.bytes)
                    ),
                ),
            };
            let sentence = format!("a socket may buffer {}: {words}", size(*most));
            let finding = report(severity, sentence);
            if severity == Severity::Ok {
                finding
            } else {
                finding.remedy(RECEIVE_MAX.set(wanted)).remedy(format!(
                    "{}    # Fast DDS takes the default, Cyclone DDS asks for 1 MiB",
                    RECEIVE_DEFAULT.line(wanted)
                ))
            }
        }
    };
    RECEIVE_DEFAULT.show(RECEIVE_MAX.show(finding, &most), &default)
}

fn reassembly(files: &Files, largest: Option<&Largest>) -> Vec<Finding> {
    let mut findings = Vec::new();
    for (number, (memory, time)) in (0..).zip(REASSEMBLY_SYSCTLS) {
        let (bytes, seconds) = (memory.read(files), time.read(files));
        let check = if number == 0 {
            "reassembly"
        } else {
            "reassembly_ipv6"
        };
        let report = |severity, sentence: String| Finding::new(AREA, check, severity, sentence);
        let Ok(most) = bytes else {
            // Without IPv6, its parameter does not exist.
            if number == 0 {
                let sentence = "the memory limit of IP reassembly is unknown".to_owned();
                let finding =
                    report(Severity::Unknown, sentence).remedy(format!("sysctl {}", memory.0));
                findings.push(memory.show(finding, &bytes));
            }
            continue;
        };
        let wanted = recommended_size(largest, MESSAGES_IN_REASSEMBLY);
        let version = if number == 0 { "IPv4" } else { "IPv6" };
        let finding = match largest {
            Some(largest) if most < wanted => {
                let sentence = format!(
                    "reassembly of {version} may use {}: lost fragments of messages as large as \
                     those of {} ({}) fill it for {} s",
                    size(most),
                    largest.topic,
                    size(largest.bytes),
                    seconds
                        .as_ref()
                        .map_or_else(|_| "30".to_owned(), u64::to_string),
                );
                report(
                    if number == 0 {
                        Severity::Note
                    } else {
                        Severity::Ok
                    },
                    sentence,
                )
                .remedy(memory.set(wanted))
                .remedy(time.set(3))
            }
            _ => report(
                Severity::Ok,
                format!("reassembly of {version} may use {}", size(most)),
            ),
        };
        findings.push(time.show(memory.show(finding, &bytes), &seconds));
    }
    findings
}

/// Returns the finding for messages lost at `place`; `None` if no message was lost.
fn loss_finding(
    topics: &[Topic<'_>],
    check: &'static str,
    place: &str,
    count: impl Fn(&Topic<'_>) -> u64,
    helped: impl Fn(Finding) -> Finding,
) -> Option<Finding> {
    let mut lossy: Vec<_> = topics.iter().filter(|topic| count(topic) > 0).collect();
    if lossy.is_empty() {
        return None;
    }
    lossy.sort_by_key(|topic| std::cmp::Reverse(count(topic)));
    let ratio = |topic: &Topic<'_>| {
        let received = topic.received.map_or(0, |received| received.messages);
        ratio(count(topic), received)
    };
    let worst = lossy.iter().map(|topic| ratio(topic)).fold(0.0, f64::max);
    let severity = if worst >= PROBLEM_LOSS_RATIO {
        Severity::Problem
    } else {
        Severity::Warning
    };
    let named: Vec<_> = lossy
        .iter()
        .take(MAX_NAMED_TOPICS)
        .map(|topic| {
            format!(
                "{} {} ({:.1} %)",
                topic.name,
                count(topic),
                100.0 * ratio(topic)
            )
        })
        .collect();
    let sum: u64 = lossy.iter().map(|topic| count(topic)).sum();
    let sentence = format!("{sum} messages were lost {place}: {}", named.join(", "));
    let finding = Finding::new(AREA, check, severity, sentence);
    let finding = finding.seen(sum.to_string(), "GET /topics received");
    Some(helped(finding))
}

impl Sysctl {
    fn path(self) -> String {
        format!("/proc/sys/{}", self.0.replace('.', "/"))
    }

    fn read(self, files: &Files) -> Result<u64, ReadFailure> {
        files.number(&self.path())
    }

    fn line(self, value: u64) -> String {
        format!("sudo sysctl -w {}={value}", self.0)
    }

    /// Returns the command that sets the value, and the file that makes it permanent.
    fn set(self, value: u64) -> String {
        format!(
            "{}    # permanent: /etc/sysctl.d/60-ros.conf",
            self.line(value)
        )
    }

    fn show(self, finding: Finding, value: &Result<u64, ReadFailure>) -> Finding {
        let value = match value {
            Ok(value) => value.to_string(),
            Err(error) => error.to_string(),
        };
        finding.seen(value, self.path())
    }
}

#[expect(clippy::cast_precision_loss, reason = "a ratio for people")]
fn ratio(lost: u64, received: u64) -> f64 {
    lost as f64 / lost.saturating_add(received).max(1) as f64
}

/// Returns a size with a unit for people.
#[expect(clippy::cast_precision_loss, reason = "a size for people")]
fn size(bytes: u64) -> String {
    let bytes = bytes as f64;
    match bytes {
        bytes if bytes < 1e3 => format!("{bytes:.0} B"),
        bytes if bytes < 1e6 => format!("{:.0} KB", bytes / 1e3),
        bytes if bytes < 1e9 => format!("{:.1} MB", bytes / 1e6),
        bytes => format!("{:.1} GB", bytes / 1e9),
    }
}

#[cfg(test)]
mod tests {
    use super::super::host_state::tests::host;
    use super::*;

    const USUALLY: [(&str, &str); 6] = [
        ("/proc/sys/net/core/rmem_max", "212992\n"),
        ("/proc/sys/net/core/rmem_default", "212992\n"),
        ("/proc/sys/net/ipv4/ipfrag_high_thresh", "4194304\n"),
        ("/proc/sys/net/ipv4/ipfrag_time", "30\n"),
        ("/proc/sys/net/ipv6/ip6frag_high_thresh", "4194304\n"),
        ("/proc/sys/net/ipv6/ip6frag_time", "60\n"),
    ];

    fn found(files: &[(&str, &str)], topics: &str) -> Vec<Finding> {
        let (_directory, host) = host(files);
        let topics = serde_json::from_str(&format!(r#"{{"topics":[{topics}]}}"#)).unwrap();
        let answers = Answers {
            topics,
            ..Answers::default()
        };
        check(&host, Some(&answers))
    }

    fn find<'a>(findings: &'a [Finding], check: &str) -> &'a Finding {
        let found = findings.iter().find(|finding| finding.check == check);
        found.unwrap_or_else(|| panic!("no {check} in {findings:?}"))
    }

    const CLOUD: &str = r#"{"name":"/points","measurement":{"messages":100,"bytes":272000000}}"#;

    #[test]
    fn the_buffer_for_a_measured_point_cloud_is_computed() {
        let findings = found(&USUALLY, CLOUD);
        let receive = find(&findings, "receive");
        assert_eq!(receive.severity, Severity::Warning);
        assert!(
            receive.sentence.contains("/points (2.7 MB each)"),
            "{}",
            receive.sentence
        );
        // Twice 2.72 MB in whole mebibytes.
        assert!(
            receive.remedies[0]
                .line
                .starts_with("sudo sysctl -w net.core.rmem_max=6291456")
        );
        let reassembly = find(&findings, "reassembly");
        assert_eq!(reassembly.severity, Severity::Note);
        assert!(
            reassembly.remedies[0]
                .line
                .contains("ipfrag_high_thresh=44040192"),
            "{:?}",
            reassembly.remedies
        );
        let mut enough = USUALLY;
        enough[0].1 = "8388608";
        enough[2].1 = "134217728";
        let findings = found(&enough, CLOUD);
        assert_eq!(find(&findings, "receive").severity, Severity::Ok);
        assert_eq!(find(&findings, "reassembly").severity, Severity::Ok);
    }

    #[test]
    fn small_messages_need_no_change_and_missing_measurements_lead_to_a_note() {
        let small =
            r#"{"name":"/imu","publishers":[{"measurement":{"messages":10,"bytes":3200}}]}"#;
        let findings = found(&USUALLY, small);
        assert!(
            findings.iter().all(|each| each.severity == Severity::Ok),
            "{findings:?}"
        );
        let findings = found(&USUALLY, "");
        assert_eq!(find(&findings, "receive").severity, Severity::Note);
        assert!(
            find(&findings, "receive").remedies[0]
                .line
                .contains("rmem_max=8388608")
        );
    }

    #[test]
    fn few_losses_at_a_buffer_are_a_warning_and_many_are_a_problem() {
        let topic = |lost: u64| {
            format!(
                r#"{{"name":"/points","received":{{"messages":1000,
                "lost_in_socket_buffer_messages":{lost},"lost_in_reassembly_messages":{lost}}}}}"#
            )
        };
        let findings = found(&USUALLY, &topic(2));
        assert_eq!(find(&findings, "socket_losses").severity, Severity::Warning);
        let findings = found(&USUALLY, &topic(50));
        let lost = find(&findings, "socket_losses");
        assert_eq!(lost.severity, Severity::Problem);
        assert!(
            lost.sentence.contains("/points 50 (4.8 %)"),
            "{}",
            lost.sentence
        );
        assert!(
            lost.remedies
                .iter()
                .any(|remedy| remedy.line.contains("SocketReceiveBufferSize"))
        );
        let lost = find(&findings, "reassembly_losses");
        assert!(lost.remedies[1].line.contains("net.ipv4.ipfrag_time=3"));
    }

    #[test]
    fn a_value_that_cannot_be_read_is_unknown_and_names_the_command() {
        let (_directory, host) = host(&[]);
        let findings = check(&host, None);
        assert_eq!(findings.len(), 2);
        for finding in findings {
            assert_eq!(finding.severity, Severity::Unknown);
            assert!(
                finding.remedies[0].line.starts_with("sysctl net."),
                "{finding:?}"
            );
        }
    }
}
