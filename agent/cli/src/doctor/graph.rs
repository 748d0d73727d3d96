//! Checks of the agent's graph: participants without names, topics on transports that are invisible
//! or sampled, and endpoints that do not match.

use std::collections::BTreeMap;

use super::answers::Answers;
use super::shell::{WITHOUT_ICEORYX, WITHOUT_PSMX};
use crate::top::text::counted;
use ros2probe_api::Open;
use ros2probe_api::diagnosis::Diagnosis;
use ros2probe_api::doctor::{Area, Finding, Severity};
use ros2probe_api::health::Health;
use ros2probe_api::participants::Participant;
use ros2probe_api::topics::Topic;
use ros2probe_daemon::missed_announcements::{self, Announces, DISCOVER_COMMAND};

const AREA: Area = Area::Graph;
/// Adds remedies to a finding.
type AddRemedies = fn(Finding) -> Finding;

/// Maximum number of topics in one sentence.
const MAX_NAMED_TOPICS: usize = 3;

/// Returns the findings of all graph checks. `processes` is the number of ROS processes on the
/// agent's host, if it is known.
#[must_use]
pub fn check(answers: &Answers, processes: Option<usize>) -> Vec<Finding> {
    let participants = &answers.participants.participants;
    let mut findings = vec![overview(answers, processes)];
    findings.extend(isolation_finding(participants));
    findings.extend(names(participants));
    findings.extend(restored(participants));
    findings.extend(unknown_writers(answers));
    findings.extend(secured(participants));
    findings.extend(encrypted(answers.participants.tls_connections));
    findings.extend(announced_unseen(participants));
    findings.extend(off_network_findings(answers));
    findings.extend(mismatches(&answers.topics.topics));
    findings.extend(near_misses(&answers.topics.topics));
    findings
}

fn overview(answers: &Answers, processes: Option<usize>) -> Finding {
    let (participants, topics) = (
        &answers.participants.participants,
        answers.topics.topics.len(),
    );
    let report = |severity, sentence: String| {
        let finding = Finding::new(AREA, "participants", severity, sentence);
        finding.seen(participants.len().to_string(), "GET /participants")
    };
    let unreadable = answers.health.zenoh.iter().flat_map(|zenoh| &zenoh.unseen);
    let unreadable = unreadable.filter(|unseen| unseen.reason != "shared_memory");
    let unreadable: u64 = unreadable.map(|unseen| unseen.connections).sum();
    if participants.is_empty() {
        return match processes {
            _ if unreadable > 0 => report(
                Severity::Note,
                format!(
                    "the agent sees no participant: {} of Zenoh cannot be read",
                    counted(unreadable, "connection")
                ),
            ),
            Some(count @ 1..) => report(
                Severity::Problem,
                format!(
                    "the agent sees no participant, but {count} ROS processes are running here"
                ),
            )
            .remedy(
                "rp doctor --verbose    # source, control group and interfaces above; RMW below",
            ),
            _ => report(
                Severity::Note,
                "the agent sees no participant: no DDS or Zenoh traffic".to_owned(),
            ),
        };
    }
    let mut domains: BTreeMap<u32, BTreeMap<&str, usize>> = BTreeMap::new();
    for participant in participants {
        let vendors = domains.entry(participant.domain_id).or_default();
        *vendors.entry(&participant.vendor).or_default() += 1;
    }
    let domains: Vec<_> = domains
        .iter()
        .map(|(domain, vendors)| {
            let vendors: Vec<_> = vendors
                .iter()
                .map(|(vendor, count)| format!("{count} {vendor}"))
                .collect();
            format!("domain {domain}: {}", vendors.join(", "))
        })
        .collect();
    report(
        Severity::Ok,
        format!(
            "{}, {}; {}",
            counted_noun(participants.len(), "participant"),
            counted_noun(topics, "topic"),
            domains.join("; ")
        ),
    )
}

/// Returns whether the participant is a Discovery Server without nodes, such as that of
/// `fastdds discovery` or `ROS2_EASY_MODE`. Such a server never announces topics.
fn is_server(participant: &Participant<'_>) -> bool {
    participant.discovery_server && participant.enclave.is_none()
}

/// Returns whether the participant is the only one of its domain and announced no endpoints.
/// Endpoints are announced only to other participants.
fn is_isolated(participant: &Participant<'_>, participants: &[Participant<'_>]) -> bool {
    let has_nothing = participant.writers == 0 && participant.readers == 0;
    let others = participants.iter();
    let neighbours = others.filter(|other| other.domain_id == participant.domain_id);
    let is_silent = participant.secured || is_server(participant);
    has_nothing && !is_silent && neighbours.count() == 1
}

fn isolation_finding(participants: &[Participant<'_>]) -> Option<Finding> {
    let is_alone = |each: &&Participant<'_>| is_isolated(each, participants);
    let alone: Vec<_> = participants.iter().filter(is_alone).collect();
    let domains: Vec<_> = alone
        .iter()
        .map(|each| each.domain_id.to_string())
        .collect();
    let s = if domains.len() == 1 { "" } else { "s" };
    if domains.is_empty() {
        return None;
    }
    let sentence = format!(
        "one participant is alone in domain{s} {} and announces its topics to no other; they appear \
         when a second one starts",
        domains.join(", ")
    );
    let finding = Finding::new(AREA, "alone", Severity::Note, sentence);
    let finding = finding.seen(domains.len().to_string(), "GET /participants");
    let remedy = remedy_of(alone.into_iter());
    Some(finding.remedy(with_comment(remedy, "requests them: a few packets")))
}

/// Returns the finding for participants that started before the agent and whose names are unknown.
fn names(participants: &[Participant<'_>]) -> Option<Finding> {
    let is_nameless = |each: &&Participant<'_>| {
        let has_nothing = each.writers == 0 && each.readers == 0;
        let is_nameless = has_nothing || each.enclave.is_some() && each.nodes.is_empty();
        let is_silent = each.secured || each.announces_unseen || is_server(each);
        !is_silent && is_nameless && !is_isolated(each, participants)
    };
    let nameless = participants.iter().filter(is_nameless);
    let count = nameless.clone().count();
    if count == 0 {
        return None;
    }
    let sentence = format!(
        "the topics or nodes of {} are unknown: they were announced once, before the agent started",
        counted_noun(count, "participant")
    );
    let finding = Finding::new(AREA, "names", Severity::Warning, sentence);
    let finding = finding.seen(count.to_string(), "GET /participants");
    Some(finding.remedy(with_comment(
        remedy_of(nameless),
        "a few packets; with --dry-run it only prints them",
    )))
}

/// Returns the command that requests the announcements of these participants.
fn remedy_of<'a>(participants: impl Iterator<Item = &'a Participant<'a>>) -> &'static str {
    missed_announcements::command(participants.map(Announces::of)).unwrap_or(DISCOVER_COMMAND)
}

/// Returns a remedy with a comment. By TCP, another participant is needed.
fn with_comment(remedy: &str, requested: &str) -> String {
    let comment = match remedy.contains("rp discover") {
        true => requested,
        false => "joins the domain with the robot's transports, so that all announce to it",
    };
    format!("{remedy}    # {comment}")
}

fn restored(participants: &[Participant<'_>]) -> Option<Finding> {
    let count = participants.iter().filter(|each| each.restored).count();
    if count == 0 {
        return None;
    }
    let sentence = format!(
        "{} restored from saved state, awaiting confirmation; removed when the lease ends",
        counted_noun(count, "participant")
    );
    let finding = Finding::new(AREA, "restored", Severity::Note, sentence);
    Some(finding.seen(count.to_string(), "GET /participants"))
}

fn unknown_writers(answers: &Answers) -> Option<Finding> {
    let writers = &answers.participants.unknown_writers;
    let first = writers.first()?;
    let sentence = missed_announcements::sentence(writers.len());
    let finding = Finding::new(AREA, "unknown_writers", Severity::Warning, sentence);
    let finding = finding.seen(
        format!("{}: {}", writers.len(), first.guid),
        "GET /participants",
    );
    let participants = &answers.participants.participants;
    let remedy = missed_announcements::remedy_for(writers, participants)?;
    Some(finding.remedy(with_comment(remedy, "requests the announcements")))
}

/// Returns the finding for participants whose endpoints are announced by TCP connections that were
/// not seen.
fn announced_unseen(participants: &[Participant<'_>]) -> Option<Finding> {
    let is_unseen =
        |each: &&Participant<'_>| each.announces_unseen && !is_isolated(each, participants);
    let count = participants.iter().filter(is_unseen).count();
    if count == 0 {
        return None;
    }
    let sentence = format!(
        "{} announce topics and nodes by TCP, and no message by TCP was seen: the connections are \
         encrypted, or pass between other hosts",
        counted_noun(count, "participant")
    );
    let sentence = match count {
        1 => sentence.replace(" announce ", " announces "),
        _ => sentence,
    };
    let finding = Finding::new(AREA, "tcp_unseen", Severity::Warning, sentence);
    let finding = finding.seen(count.to_string(), "GET /participants announces_unseen");
    Some(
        finding
            .elsewhere("run an agent on the hosts of these participants; TLS hides their messages"),
    )
}

/// Returns the finding for connections that are encrypted with TLS.
fn encrypted(connections: u64) -> Option<Finding> {
    let sentence = match connections {
        0 => return None,
        1 => "1 connection of RTPS over TCP is encrypted with TLS: its topics are not measured"
            .to_owned(),
        _ => format!(
            "{connections} connections of RTPS over TCP are encrypted with TLS: their topics are \
             not measured"
        ),
    };
    let finding = Finding::new(AREA, "tcp_tls", Severity::Warning, sentence);
    let finding = finding.seen(connections.to_string(), "GET /participants tls_connections");
    Some(
        finding
            .elsewhere("inside: full    # in `capture`, counts messages by calls in the processes")
            .elsewhere("<tls>    # or remove it from the transport descriptors of Fast DDS"),
    )
}

fn secured(participants: &[Participant<'_>]) -> Option<Finding> {
    let count = participants.iter().filter(|each| each.secured).count();
    if count == 0 {
        return None;
    }
    let sentence = format!(
        "{} with DDS security: encrypted messages are not visible, nor are topics and nodes if \
         discovery is encrypted",
        counted_noun(count, "participant")
    );
    let finding = Finding::new(AREA, "secured", Severity::Note, sentence);
    let finding = finding.seen(count.to_string(), "GET /participants secured");
    Some(
        finding.elsewhere(
            "discovery_protection_kind: NONE    # in the governance file, to see topics",
        ),
    )
}

/// Returns the findings for topics without a pair of endpoints on the network.
fn off_network_findings(answers: &Answers) -> Vec<Finding> {
    let transports = [
        shared_memory(&answers.health),
        OffNetwork {
            transport: "data_sharing",
            severity: Severity::Warning,
            words: ("use", "only Fast DDS data sharing and cannot be observed"),
            remedy: Some(|finding| {
                finding.elsewhere(
                    "<data_sharing><kind>OFF</kind></data_sharing>    # Fast DDS's profile of the writer",
                )
            }),
        },
        OffNetwork {
            transport: "iceoryx",
            severity: Severity::Warning,
            words: ("use", "only iceoryx and cannot be observed"),
            remedy: Some(|finding| finding.elsewhere(WITHOUT_ICEORYX).elsewhere(WITHOUT_PSMX)),
        },
        OffNetwork {
            transport: "same_process",
            severity: Severity::Note,
            words: ("stay", "inside one process and cannot be observed"),
            remedy: None,
        },
    ];
    let findings = transports.into_iter().filter_map(|each| {
        let topics = answers.topics.topics.iter();
        let topics: Vec<&Topic<'_>> = topics
            .filter(|topic| !topic.vanished && off_network(topic) == Some(each.transport))
            .filter(|topic| each.transport == "shared_memory" || !is_counted_inside(topic))
            .collect();
        each.finding(&topics)
    });
    findings.collect()
}

/// Returns whether calls inside the processes show the topic's messages.
fn is_counted_inside(topic: &Topic<'_>) -> bool {
    let is_observed = topic
        .passages
        .iter()
        .all(|it| it.observed_pairs == it.pairs);
    topic.source == "inside" || is_observed
}

/// Texts about topics on one transport other than the network.
struct OffNetwork {
    transport: &'static str,
    severity: Severity,
    /// Verb in the plural, and the rest of the sentence.
    words: (&'static str, &'static str),
    remedy: Option<AddRemedies>,
}

impl OffNetwork {
    fn finding(self, topics: &[&Topic<'_>]) -> Option<Finding> {
        if topics.is_empty() {
            return None;
        }
        let (verb, words) = self.words;
        let s = if topics.len() == 1 { "s" } else { "" };
        let sentence = format!(
            "{} {verb}{s} {words}: {}",
            counted_noun(topics.len(), "topic"),
            name_list(topics)
        );
        let finding = Finding::new(AREA, self.transport, self.severity, sentence);
        let finding = finding.seen(topics.len().to_string(), "GET /topics passages");
        Some(match self.remedy {
            Some(helps) => helps(finding),
            None => finding,
        })
    }
}

/// Returns the texts about shared memory of Fast DDS, by the agent's abilities.
fn shared_memory(health: &Health) -> OffNetwork {
    let find = |ability: &str| health.abilities.iter().find(|each| each.ability == ability);
    let able = |ability: &str| find(ability).is_some_and(|each| each.able);
    // An agent has a reason only for an ability that is configured.
    let is_configured = find("shared_memory_exact").is_some_and(|each| each.reason.is_some());
    let (severity, words, remedy): (_, _, Option<AddRemedies>) = if able("shared_memory_exact") {
        let words = "only Fast DDS shared memory; every message is seen";
        (Severity::Ok, words, None)
    } else if able("shared_memory") {
        let words = "only Fast DDS shared memory, which is sampled";
        let remedy: AddRemedies = |finding| {
            finding.configure(
                "capture: {shm: {exact: auto}}    # every message; instruments the senders",
            )
        };
        (Severity::Note, words, (!is_configured).then_some(remedy))
    } else {
        let words = "only Fast DDS shared memory, which is not read";
        let remedy: AddRemedies = |finding| finding.configure("capture: {shm: {mode: auto}}");
        (Severity::Warning, words, Some(remedy))
    };
    OffNetwork {
        transport: "shared_memory",
        severity,
        words: ("use", words),
        remedy,
    }
}

/// Returns the transport of most pairs, if no pair uses the network.
fn off_network<'a>(topic: &'a Topic<'_>) -> Option<&'a str> {
    if topic
        .passages
        .iter()
        .any(|passage| passage.passage == "network")
    {
        return None;
    }
    let most = topic.passages.iter().max_by_key(|passage| passage.pairs)?;
    Some(&most.passage)
}

/// Returns the findings for endpoints with incompatible types or QoS.
fn mismatches(topics: &[Topic<'_>]) -> Vec<Finding> {
    const KINDS: [(&str, &str, &str); 4] = [
        (
            "qos_incompatible",
            "with publishers and subscribers of incompatible QoS",
            "rp topic info --verbose TOPIC    # compare reliability and durability",
        ),
        (
            "type_conflict",
            "with several types; endpoints of different types do not communicate",
            "rp topic info --verbose TOPIC    # shows each endpoint's type",
        ),
        (
            "type_hash_conflict",
            "with several definitions of one type, which endpoints misread",
            "colcon build    # all nodes, with the same version of the interface package",
        ),
        (
            "wrong_stamps",
            "with stamps that cannot be right",
            "curl -s localhost:17401/topics/TOPIC    # `diagnoses` says what is wrong",
        ),
    ];
    let find = |(kind, words, remedy): (&'static str, &str, &str)| {
        let has = |topic: &&Topic<'_>| topic.diagnoses.iter().any(|each| each.kind() == kind);
        let found: Vec<_> = topics.iter().filter(has).collect();
        if found.is_empty() {
            return None;
        }
        let sentence = format!(
            "{} {words}: {}",
            counted_noun(found.len(), "topic"),
            name_list(&found)
        );
        let finding = Finding::new(AREA, kind, Severity::Warning, sentence);
        let finding = finding.seen(found.len().to_string(), "GET /topics diagnoses");
        Some(finding.remedy(remedy))
    };
    KINDS.into_iter().filter_map(find).collect()
}

/// Warns of a publisher and a subscription whose topics differ so little that one is probably a
/// mistake.
fn near_misses(topics: &[Topic<'_>]) -> Option<Finding> {
    let pairs = topics.iter().flat_map(|topic| {
        let subscriptions = topic.diagnoses.iter().filter_map(|found| match found {
            Open::Known(Diagnosis::NearMiss {
                subscription,
                subscription_domain_id,
                ..
            }) if *subscription == *topic.name => {
                Some(format!("{subscription} in domain {subscription_domain_id}"))
            }
            Open::Known(Diagnosis::NearMiss { subscription, .. }) => Some(subscription.to_string()),
            _ => None,
        });
        subscriptions.map(|subscription| format!("{} and {subscription}", topic.name))
    });
    let pairs: Vec<_> = pairs.collect();
    let first = pairs.first()?;
    let more = match pairs.len() {
        1 => String::new(),
        count => format!(" and {} more", counted_noun(count - 1, "pair")),
    };
    let sentence = format!(
        "publisher and subscription do not meet, their topics differ little: {first}{more}"
    );
    let finding = Finding::new(AREA, "near_miss", Severity::Warning, sentence);
    let finding = pairs.iter().fold(finding, |finding, pair| {
        finding.seen(pair, "GET /topics diagnoses")
    });
    Some(finding.remedy("ros2 run PACKAGE NODE --ros-args -r OLD:=NEW    # or correct the domain"))
}

fn name_list(topics: &[&Topic<'_>]) -> String {
    let names: Vec<_> = topics
        .iter()
        .take(MAX_NAMED_TOPICS)
        .map(|topic| topic.name.as_ref())
        .collect();
    let names = names.join(", ");
    match topics.len().saturating_sub(MAX_NAMED_TOPICS) {
        0 => names,
        more => format!("{names} and {more} more"),
    }
}

fn counted_noun(count: usize, what: &str) -> String {
    counted(count as u64, what)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn topics_that_differ_little_are_one_warning_with_both_names() {
        let topic = |name: &str, other: &str| {
            format!(
                r#"{{"name":"{name}","domain_id":0,"diagnoses":[{{"kind":"near_miss","subscription":"{other}","subscription_domain_id":5,"difference":"case"}}]}}"#
            )
        };
        let topics = format!("{},{}", topic("/Scan", "/scan"), topic("/imu", "/imu"));
        let answers = answers(r#"{"participants":[]}"#, &topics, "forwarded");
        let found = near_misses(&answers.topics.topics).unwrap();
        assert_eq!(
            found.sentence,
            "publisher and subscription do not meet, their topics differ little: /Scan and /scan \
             and 1 pair more"
        );
        assert_eq!(found.evidence[1].value, "/imu and /imu in domain 5");
        assert_eq!(near_misses(&[]), None);
    }

    fn answers(participants: &str, topics: &str, ability: &str) -> Answers {
        let health = format!(r#"{{"abilities":[{{"ability":"{ability}","able":true}}]}}"#);
        Answers {
            health: serde_json::from_str(&health).unwrap(),
            participants: serde_json::from_str(participants).unwrap(),
            topics: serde_json::from_str(&format!(r#"{{"topics":[{topics}]}}"#)).unwrap(),
            ..Answers::default()
        }
    }

    #[test]
    fn an_empty_graph_is_not_a_problem_if_connections_cannot_be_read() {
        let unseen = |reason: &str| {
            let health =
                format!(r#"{{"zenoh":{{"unseen":[{{"reason":"{reason}","connections":2}}]}}}}"#);
            let answers = Answers {
                health: serde_json::from_str(&health).unwrap(),
                ..Answers::default()
            };
            severity(&check(&answers, Some(4)), "participants")
        };
        assert_eq!(unseen("tls"), Some(Severity::Note));
        assert_eq!(unseen("shared_memory"), Some(Severity::Problem));
    }

    fn severity(findings: &[Finding], check: &str) -> Option<Severity> {
        let found = findings.iter().find(|finding| finding.check == check);
        found.map(|finding| finding.severity)
    }

    const WELL: &str = r#"{"participants":[
        {"domain_id":0,"vendor":"eProsima Fast DDS","enclave":"/","nodes":["/a"],"writers":1},
        {"domain_id":0,"vendor":"eProsima Fast DDS","enclave":"/","nodes":["/b"],"writers":1},
        {"domain_id":7,"vendor":"Eclipse Cyclone DDS","readers":2}]}"#;

    #[test]
    fn participants_whose_topics_are_announced_by_tls_are_named_and_not_alone() {
        let participant = r#"{"domain_id":0,"vendor":"eProsima Fast DDS","announces_unseen":true}"#;
        let both = format!(r#"{{"participants":[{participant},{participant}]}}"#);
        let findings = check(&answers(&both, "", ""), None);
        let of = |check| findings.iter().find(|finding| finding.check == check);
        let sentence = &of("tcp_unseen").unwrap().sentence;
        assert!(sentence.starts_with("2 participants announce topics and nodes by TCP"));
        assert_eq!((of("alone"), of("names")), (None, None));
        // A participant that is alone has none to which it can announce topics.
        let alone = format!(r#"{{"participants":[{participant}]}}"#);
        let findings = check(&answers(&alone, "", ""), None);
        assert_eq!(severity(&findings, "alone"), Some(Severity::Note));
        assert_eq!(severity(&findings, "tcp_unseen"), None);
    }

    #[test]
    fn connections_with_tls_are_a_finding_with_their_number() {
        let sentence = |count: u64| {
            let list = WELL.trim_end_matches('}');
            let findings = check(
                &answers(&format!("{list},\"tls_connections\":{count}}}"), "", ""),
                None,
            );
            let mut found = findings.into_iter().filter(|each| each.check == "tcp_tls");
            found.next().map(|found| found.sentence)
        };
        assert_eq!(sentence(0), None);
        assert!(
            sentence(1)
                .unwrap()
                .starts_with("1 connection of RTPS over TCP is encrypted")
        );
        assert!(
            sentence(3)
                .unwrap()
                .starts_with("3 connections of RTPS over TCP are encrypted")
        );
    }

    #[test]
    fn a_completely_known_graph_leads_to_one_line() {
        let findings = check(&answers(WELL, "", ""), None);
        assert_eq!(findings.len(), 1);
        assert_eq!(
            findings[0].sentence,
            "3 participants, 0 topics; domain 0: 2 eProsima Fast DDS; domain 7: 1 Eclipse Cyclone DDS"
        );
    }

    #[test]
    fn an_empty_graph_is_a_problem_only_if_participants_are_expected() {
        let nobody = answers("{}", "", "");
        assert_eq!(check(&nobody, None)[0].severity, Severity::Note);
        assert_eq!(check(&nobody, Some(0))[0].severity, Severity::Note);
        assert_eq!(check(&nobody, Some(2))[0].severity, Severity::Problem);
    }

    #[test]
    fn announcements_before_the_agents_start_are_reported_with_the_command() {
        let late = r#"{"participants":[
            {"enclave":"/","nodes":[],"writers":3},
            {"enclave":"/","nodes":["/a"],"writers":3,"restored":true},
            {"secured":true}],
            "unknown_writers":[{"guid":"0102"}]}"#;
        let findings = check(&answers(late, "", ""), None);
        let names = findings.iter().find(|each| each.check == "names").unwrap();
        assert!(
            names
                .sentence
                .starts_with("the topics or nodes of 1 participant "),
            "{}",
            names.sentence
        );
        assert!(names.remedies[0].line.starts_with("sudo rp discover --all"));
        assert_eq!(severity(&findings, "restored"), Some(Severity::Note));
        assert_eq!(
            severity(&findings, "unknown_writers"),
            Some(Severity::Warning)
        );
        assert_eq!(severity(&findings, "secured"), Some(Severity::Note));
    }

    #[test]
    fn an_isolated_participant_is_reported_separately_from_missing_names() {
        let of = |participants: &str| {
            let participants = format!(r#"{{"participants":[{participants}]}}"#);
            check(&answers(&participants, "", ""), None)
        };
        let lone = of(r#"{"domain_id":3,"enclave":"/","nodes":[]}"#);
        let finding = lone.iter().find(|each| each.check == "alone").unwrap();
        assert_eq!(
            finding.sentence,
            "one participant is alone in domain 3 and announces its topics to no other; they appear \
             when a second one starts"
        );
        assert!(
            finding.remedies[0]
                .line
                .starts_with("sudo rp discover --all")
        );
        assert_eq!(severity(&lone, "names"), None);
        // A second participant in the domain implies missed announcements.
        let two = of(r#"{"domain_id":3},{"domain_id":3,"writers":2}"#);
        assert_eq!(severity(&two, "alone"), None);
        assert_eq!(severity(&two, "names"), Some(Severity::Warning));
        // The names are known, or the participant has none.
        assert_eq!(severity(&of(r#"{"readers":1}"#), "alone"), None);
        assert_eq!(severity(&of(r#"{"secured":true}"#), "alone"), None);
        let apart = of(r#"{"domain_id":1},{"domain_id":2}"#);
        let finding = apart.iter().find(|each| each.check == "alone").unwrap();
        assert!(finding.sentence.contains("in domains 1, 2 and"));
    }

    #[test]
    fn a_discovery_server_is_neither_alone_nor_a_node_that_was_missed() {
        let of = |participants: &str| {
            let participants = format!(r#"{{"participants":[{participants}]}}"#);
            let findings = check(&answers(&participants, "", ""), None);
            ["alone", "names"].map(|check| severity(&findings, check))
        };
        let server = r#"{"domain_id":3,"discovery_server":true}"#;
        let client = r#"{"domain_id":3,"enclave":"/","nodes":["/a"],"writers":2}"#;
        assert_eq!(of(server), [None, None]);
        assert_eq!(of(&format!("{server},{client}")), [None, None]);
        // The nodes of a process that also runs a server may have been missed.
        let node = r#"{"domain_id":3,"enclave":"/","discovery_server":true}"#;
        let expected = [None, Some(Severity::Warning)];
        assert_eq!(of(&format!("{node},{client}")), expected);
    }

    #[test]
    fn topics_on_other_transports_than_the_network_are_reported_by_transport() {
        let topic =
            |name: &str, passages: &str| format!(r#"{{"name":"{name}","passages":[{passages}]}}"#);
        let pairs = |way: &str| format!(r#"{{"passage":"{way}","pairs":2}}"#);
        let of = |way: &str, ability: &str| {
            check(&answers(WELL, &topic("/x", &pairs(way)), ability), None)
        };
        let way = "shared_memory";
        assert_eq!(severity(&of(way, ""), way), Some(Severity::Warning));
        assert_eq!(
            severity(&of(way, "shared_memory"), way),
            Some(Severity::Note)
        );
        assert_eq!(
            severity(&of(way, "shared_memory_exact"), way),
            Some(Severity::Ok)
        );
        assert_eq!(
            severity(&of("data_sharing", ""), "data_sharing"),
            Some(Severity::Warning)
        );
        let iceoryx = of("iceoryx", "");
        assert_eq!(severity(&iceoryx, "iceoryx"), Some(Severity::Warning));
        // The two generations of Cyclone DDS turn it off by different elements.
        let found = iceoryx.iter().find(|each| each.check == "iceoryx").unwrap();
        let comments = found
            .remedies
            .iter()
            .filter_map(|each| each.comment.as_deref());
        let (old, new): (Vec<_>, Vec<_>) = comments.partition(|each| each.ends_with("0.10"));
        assert_eq!((old.len(), new.len()), (1, 1), "{found:?}");
        assert!(new[0].ends_with("Cyclone DDS 11"), "{found:?}");
        assert_eq!(
            severity(&of("same_process", ""), "same_process"),
            Some(Severity::Note)
        );
        // Calls inside both processes show the messages.
        let seen = r#"{"passage":"same_process","pairs":2,"observed_pairs":2}"#;
        let findings = check(&answers(WELL, &topic("/x", seen), ""), None);
        assert_eq!(severity(&findings, "same_process"), None);
        // One pair on the network suffices to count the messages.
        let both = format!("{},{}", pairs("network"), pairs("data_sharing"));
        let findings = check(&answers(WELL, &topic("/x", &both), ""), None);
        assert_eq!(findings.len(), 1);
    }

    #[test]
    fn exact_shared_memory_is_offered_only_where_it_is_off() {
        let topic = r#"{"name":"/x","passages":[{"passage":"shared_memory","pairs":2}]}"#;
        let remedies = |exact: &str| {
            let sampled = r#"{"ability":"shared_memory","able":true}"#;
            let health = format!(r#"{{"abilities":[{sampled},{exact}]}}"#);
            let answers = Answers {
                health: serde_json::from_str(&health).unwrap(),
                ..answers(WELL, topic, "")
            };
            let findings = check(&answers, None);
            let mut found = findings.iter();
            let found = found.find(|each| each.check == "shared_memory").unwrap();
            assert_eq!(found.severity, Severity::Note);
            found.remedies.len()
        };
        assert_eq!(remedies(r#"{"ability":"shared_memory_exact"}"#), 1);
        let resting =
            r#""on_demand":true,"reason":"capture.shm.exact is auto, and no client reads""#;
        for configured in [resting, r#""reason":"cannot connect to the broker""#] {
            let exact = format!(r#"{{"ability":"shared_memory_exact",{configured}}}"#);
            assert_eq!(remedies(&exact), 0, "{configured}");
        }
    }

    #[test]
    fn incompatible_endpoints_are_reported_by_topic() {
        let topics = r#"{"name":"/a","diagnoses":[{"kind":"qos_incompatible"},{"kind":"unmatched_publisher"}]},
            {"name":"/b","diagnoses":[{"kind":"qos_incompatible"}]},{"name":"/c"}"#;
        let findings = check(&answers(WELL, topics, ""), None);
        let finding = findings
            .iter()
            .find(|each| each.check == "qos_incompatible")
            .unwrap();
        assert!(
            finding.sentence.ends_with("of incompatible QoS: /a, /b"),
            "{}",
            finding.sentence
        );
        assert_eq!(findings.len(), 2);
    }
}
