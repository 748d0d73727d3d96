//! The view of an agent over a run: topics, the graph, findings and expectations of one domain.
//! Names come from the network, so they are escaped for terminals here, and each table is bounded.

use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};

use ros2probe_api::Open;
use ros2probe_api::health::Health;
use ros2probe_api::live::{self, Graph, Line, Row, Severity};
use ros2probe_api::watches::{Expectations, Origin, TopicState, WatchList, WatchedTopic};
use ros2probe_daemon::config::Limit;
use ros2probe_daemon::escape::visible;

use super::Rules;
use super::series::{Point, Series};
use super::tally::{MAX_STATE_DELAY, Tally};

/// Maximum number of topics over a run.
const MAX_TOPICS: usize = 2048;
/// Maximum number of different findings over a run.
const MAX_FINDINGS: usize = 1024;
/// Maximum number of pairs of a node and a topic over a run.
const MAX_EDGES: usize = 8192;
/// Maximum number of pairs of a watch and a topic over a run.
const MAX_EXPECTED: usize = 2048;

/// Kinds of findings about messages that the agent does not see.
const UNSEEN_FINDINGS: [&str; 3] = ["observation_suspended", "unknown_writers", "zenoh_unseen"];

/// Kinds of findings that other conditions judge.
const EXPECTATION_FINDINGS: [&str; 3] = ["loss", "watch_violated", "watch_silent"];

/// What an agent observed while a command ran. Times are seconds from the start of the command.
#[derive(Debug)]
pub struct Observation {
    rules: Rules,
    domain_id: u32,
    /// Topics by name.
    pub topics: BTreeMap<String, Topic>,
    /// Findings by id.
    pub findings: BTreeMap<String, Finding>,
    /// Expectations by watch and topic.
    pub expected: BTreeMap<(String, String), Expected>,
    /// Publishers and subscriptions of nodes.
    pub edges: BTreeSet<Edge>,
    /// Nodes by name.
    pub nodes: BTreeSet<String>,
    /// Greatest number of participants at once.
    pub participants: usize,
    /// Packets, records and datagrams that the agent dropped or skipped since its start.
    pub dropped: u64,
    /// Times that the agent refused or evicted an entry since its start, by the key of the limit.
    pub reached: BTreeMap<&'static str, u64>,
    /// Topics, findings, pairs of a node and a topic, or of a watch and a topic, beyond the caps.
    pub omitted: u64,
    /// The latest state of the stream.
    present: Present,
    /// Times at which participants left.
    departures: Vec<f64>,
}

/// The state of the stream. Numbers are valid within one stream.
#[derive(Debug, Default)]
struct Present {
    topics: HashMap<u32, String>,
    rows: HashMap<u32, Row>,
    findings: HashSet<String>,
    participants: HashSet<u32>,
}

/// A topic.
#[derive(Clone, Debug)]
pub struct Topic {
    /// ROS types.
    pub types: Vec<String>,
    /// Hidden by ROS convention.
    pub is_hidden: bool,
    /// Figures over the run.
    pub series: Series,
    /// Messages received whole.
    pub messages: u64,
    /// Messages that the worst subscriber lost.
    pub lost: Tally,
    /// Messages that the worst subscriber expected.
    pub expected: Tally,
    /// Counts of messages, lost and expected messages in the last row.
    counts: [u64; 3],
}

/// A finding.
#[derive(Clone, Debug)]
pub struct Finding {
    /// Kind.
    pub kind: String,
    /// Severity.
    pub severity: Severity,
    /// Description.
    pub text: String,
    /// Suggested remedy.
    pub remedy: Option<String>,
    /// Seconds in which it was present.
    pub seconds: Tally,
}

/// Expectations of a topic.
#[derive(Clone, Debug, Default)]
pub struct Expected {
    /// Expectations of the watch.
    pub expectations: Expectations,
    /// Seconds in which each expectation was violated, by key.
    pub violated: BTreeMap<String, Tally>,
    /// Seconds in which the topic had no publisher.
    pub unpublished: Tally,
    /// Whether the topic ever had a publisher.
    pub was_published: bool,
}

/// A node that publishes or subscribes to a topic.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Edge {
    /// Name of the node, or of its process.
    pub node: String,
    /// Name of the topic.
    pub topic: String,
    /// Whether the node publishes.
    pub is_publisher: bool,
}

impl Observation {
    /// Returns an empty observation of one domain.
    #[must_use]
    pub fn new(rules: Rules, domain_id: u32) -> Self {
        Self {
            rules,
            domain_id,
            topics: BTreeMap::new(),
            findings: BTreeMap::new(),
            expected: BTreeMap::new(),
            edges: BTreeSet::new(),
            nodes: BTreeSet::new(),
            participants: 0,
            dropped: 0,
            reached: BTreeMap::new(),
            omitted: 0,
            present: Present::default(),
            departures: Vec::new(),
        }
    }

    /// Returns the rules.
    #[must_use]
    pub const fn rules(&self) -> &Rules {
        &self.rules
    }

    /// Takes a line of the stream `/live`. Returns whether it completes the state of a second.
    pub fn line(&mut self, line: Line<'_>, now: f64) -> bool {
        match line {
            Line::Graph(graph) => self.graph(&graph, now),
            Line::Findings(findings) => self.set_findings(findings),
            Line::Values(values) => {
                for row in values.topics {
                    self.present.rows.insert(row.0, row);
                }
                self.count_second(now);
                return true;
            }
            Line::Open(_) | Line::Agent(_) | Line::History(_) | Line::Events(_) | Line::End(_) => {}
        }
        false
    }

    /// Takes the counters of what the agent missed.
    pub fn health(&mut self, health: &Health) {
        self.dropped = health.dropped();
        for limit in &health.limits {
            let known = Limit::find(&limit.limit).filter(|known| known.hides_data());
            if let Some(known) = known.filter(|_| limit.reached > 0) {
                self.reached.insert(known.key(), limit.reached);
            }
        }
    }

    /// Returns a sentence for each part of the run that the agent missed. Findings count from the
    /// time to settle until `until`.
    pub fn missed(&self, until: f64) -> Vec<String> {
        let mut missed = Vec::new();
        if self.dropped > 0 {
            let dropped = self.dropped;
            missed.push(format!(
                "the agent dropped {dropped} packets, so counts are lower bounds: raise \
                 capture.ring_bytes and capture.record_ring_bytes of --expect"
            ));
        }
        for (key, count) in &self.reached {
            missed.push(format!(
                "limits.{key} was reached, and {count} entries were refused or evicted: raise it \
                 in --expect"
            ));
        }
        if self.omitted > 0 {
            let left_out = self.omitted;
            missed.push(format!("{left_out} names are left out: the report is full"));
        }
        let unseen = self.findings.values().filter(|found| {
            UNSEEN_FINDINGS.contains(&&*found.kind) && found.seconds.judged(until) > 0
        });
        missed.extend(unseen.map(|found| found.text.clone()));
        missed
    }

    /// Takes the states of the watches.
    pub fn watches(&mut self, list: &WatchList, now: f64) {
        let (rules, domain_id) = (self.rules, self.domain_id);
        for watch in &list.watches {
            let is_configured = watch.origin == Open::Known(Origin::Config);
            let keys = watch.expectations.keys();
            if !is_configured || keys.is_empty() {
                continue;
            }
            let pattern = visible(&watch.topic).into_owned();
            let topics = watch.topics.iter();
            let mut topics = topics.filter(|it| it.domain_id == domain_id).peekable();
            if topics.peek().is_none() {
                self.expect((pattern.clone(), pattern.clone()), &watch.expectations);
            }
            for topic in topics {
                let name = visible(&topic.topic).into_owned();
                if let Some(expected) = self.expect((pattern.clone(), name), &watch.expectations) {
                    expected.add_state(topic, now, &rules);
                }
            }
        }
    }

    /// Prepares for another stream, which has other numbers.
    pub fn restart(&mut self) {
        self.present = Present::default();
    }

    /// Returns the findings that were first present at `now`, after the time to settle.
    pub fn new_findings(&self, now: f64) -> impl Iterator<Item = &Finding> {
        let all = self.findings.values();
        all.filter(move |found| found.seconds.first() == Some(now))
    }

    /// Returns the end of the judged part of a run that ended at `end`: the beginning of the
    /// shutdown, if participants left before. A problem of the last state may be late.
    #[must_use]
    pub fn judged_until(&self, end: f64) -> f64 {
        let earliest = end - self.rules.shutdown;
        let mut departures = self.departures.iter();
        let first = departures.find(|time| **time >= earliest);
        first.map_or(end, |first| first - MAX_STATE_DELAY)
    }

    /// Returns the findings that other conditions do not judge.
    pub fn own_findings(&self) -> impl Iterator<Item = &Finding> {
        let all = self.findings.values();
        all.filter(|found| !EXPECTATION_FINDINGS.contains(&&*found.kind))
    }

    fn expect(
        &mut self,
        key: (String, String),
        expectations: &Expectations,
    ) -> Option<&mut Expected> {
        if !self.expected.contains_key(&key) && self.expected.len() == MAX_EXPECTED {
            self.omitted += 1;
            return None;
        }
        // A glob without a topic has a row of its own.
        if key.0 != key.1 {
            self.expected.remove(&(key.0.clone(), key.0.clone()));
        }
        let expected = self.expected.entry(key).or_default();
        expected.expectations = *expectations;
        Some(expected)
    }

    fn graph(&mut self, graph: &Graph<'_>, now: f64) {
        let here = |domain_id: u32| domain_id == self.domain_id;
        let participants = graph.participants.iter().filter(|each| here(each.2));
        let participants: HashSet<u32> = participants.map(|each| each.0).collect();
        let remain = |id: &u32| participants.contains(id);
        if !self.present.participants.iter().all(remain) {
            self.departures.push(now);
            let certain = now - self.rules.shutdown - 2.0 * MAX_STATE_DELAY;
            self.departures.retain(|time| *time >= certain);
        }
        self.participants = self.participants.max(participants.len());
        self.present.participants = participants;
        let topics = graph.topics.iter().filter(|topic| here(topic.1));
        let names = topics
            .clone()
            .map(|topic| (topic.0, display_name(&topic.2)));
        self.present.topics = names.collect();
        self.present
            .rows
            .retain(|id, _| self.present.topics.contains_key(id));
        for topic in topics {
            let types = topic.5.iter().map(|each| display_name(each)).collect();
            let name = display_name(&topic.2);
            if let Some(known) = self.topics.get_mut(&name) {
                known.types = types;
            } else if self.topics.len() == MAX_TOPICS {
                self.omitted += 1;
            } else {
                let topic = Topic::new(types, topic.6 != 0, now);
                self.topics.insert(name, topic);
            }
        }
        self.set_edges(graph);
    }

    fn set_edges(&mut self, graph: &Graph<'_>) {
        let nodes = graph.nodes.iter().filter(|node| node.1 == self.domain_id);
        let nodes: HashMap<u32, String> =
            nodes.map(|node| (node.0, display_name(&node.2))).collect();
        let processes = graph.participants.iter().map(|each| {
            let process = each.6.as_deref().unwrap_or("a process");
            let id = each.5.map_or_else(String::new, |id| format!(" {id}"));
            (each.0, display_name(&format!("{process}{id}")))
        });
        let processes: HashMap<u32, String> = processes.collect();
        let publishers = graph.publishers.iter().map(|each| (each, true));
        let subscriptions = graph.subscriptions.iter().map(|each| (each, false));
        for (endpoint, is_publisher) in publishers.chain(subscriptions) {
            let Some(topic) = self.present.topics.get(&endpoint.0) else {
                continue;
            };
            let node = nodes
                .get(&endpoint.1)
                .or_else(|| processes.get(&endpoint.2));
            let Some(node) = node else { continue };
            let edge = Edge {
                node: node.clone(),
                topic: topic.clone(),
                is_publisher,
            };
            if self.edges.len() < MAX_EDGES {
                self.edges.insert(edge);
            } else if !self.edges.contains(&edge) {
                self.omitted += 1;
            }
        }
        let room = MAX_EDGES.saturating_sub(self.nodes.len());
        self.nodes.extend(nodes.into_values().take(room));
    }

    fn set_findings(&mut self, findings: Vec<live::Finding>) {
        self.present.findings.clear();
        for finding in findings {
            let here = finding.domain_id.is_none_or(|id| id == self.domain_id);
            if !here || finding.severity == Severity::Note {
                continue;
            }
            let known = self.findings.remove(&finding.id);
            if known.is_none() && self.findings.len() == MAX_FINDINGS {
                self.omitted += 1;
                continue;
            }
            self.present.findings.insert(finding.id.clone());
            let found = Finding {
                kind: display_name(&finding.kind),
                severity: finding.severity,
                text: display_name(&finding.text),
                remedy: finding.remedy.as_deref().map(display_name),
                seconds: known.map_or_else(Tally::default, |known| known.seconds),
            };
            self.findings.insert(finding.id, found);
        }
    }

    /// Counts the present state for one second.
    fn count_second(&mut self, now: f64) {
        for id in &self.present.findings {
            if let Some(found) = self.findings.get_mut(id) {
                found.seconds.add(now, 1, &self.rules);
            }
        }
        for (id, name) in &self.present.topics {
            let Some(topic) = self.topics.get_mut(name) else {
                continue;
            };
            let row = self.present.rows.get(id).copied();
            topic.second(row.unwrap_or_else(|| Row::empty(*id)), now, &self.rules);
        }
    }
}

impl Topic {
    const fn new(types: Vec<String>, is_hidden: bool, start: f64) -> Self {
        Self {
            types,
            is_hidden,
            series: Series::new(start),
            messages: 0,
            lost: Tally::EMPTY,
            expected: Tally::EMPTY,
            counts: [0; 3],
        }
    }

    fn second(&mut self, row: Row, now: f64, rules: &Rules) {
        #[expect(
            clippy::cast_possible_truncation,
            reason = "charts need no more digits"
        )]
        let known = |value: Option<f64>| value.map_or(f32::NAN, |value| value as f32);
        self.series.push(Point {
            rate: known(row.1),
            bandwidth: known(row.2),
            median: known(row.6),
            p99: known(row.7),
        });
        let [messages, lost, expected] = [row.3, row.4, row.10];
        let increase = |count: Option<u64>, before: &mut u64| {
            let Some(count) = count else { return 0 };
            let before = std::mem::replace(before, count);
            // A topic that is measured anew begins at zero.
            count.checked_sub(before).unwrap_or(count)
        };
        let [messages_before, lost_before, expected_before] = &mut self.counts;
        self.messages += increase(messages, messages_before);
        self.lost.add(now, increase(lost, lost_before), rules);
        self.expected
            .add(now, increase(expected, expected_before), rules);
    }
}

impl Expected {
    fn add_state(&mut self, topic: &WatchedTopic, now: f64, rules: &Rules) {
        let state = match &topic.state {
            Open::Known(state) => *state,
            Open::Unknown(_) => TopicState::Ok,
        };
        self.was_published |= state != TopicState::NotPublished;
        if state == TopicState::NotPublished {
            self.unpublished.add(now, 1, rules);
            for key in ["min_rate_hz", "max_silence_s", "publishers"] {
                self.add_violation(key, now, rules);
            }
        }
        if matches!(state, TopicState::Violated | TopicState::Silent) {
            for key in &topic.violations {
                self.add_violation(key, now, rules);
            }
        }
        if state == TopicState::Silent && !topic.violations.iter().any(|it| it == "max_silence_s") {
            self.add_violation("max_silence_s", now, rules);
        }
    }

    fn add_violation(&mut self, key: &str, now: f64, rules: &Rules) {
        if self.expectations.keys().contains(&key) {
            let tally = self.violated.entry(key.to_owned()).or_default();
            tally.add(now, 1, rules);
        }
    }
}

fn display_name(name: &str) -> String {
    visible(name).into_owned()
}

#[cfg(test)]
pub(super) mod tests {
    use ros2probe_api::live::{Participant, Values};
    use ros2probe_api::watches::Watch;

    use super::super::FailOn;
    use super::*;

    pub(in super::super) const RULES: Rules = Rules {
        settle: 5.0,
        shutdown: 10.0,
        fail_on: FailOn::Error,
        max_lost: Some(0),
        is_strict: false,
    };

    /// Returns a graph of participants and of topics, each with a publisher.
    pub(in super::super) fn graph(participants: u32, topics: &[&'static str]) -> Line<'static> {
        let participants = (1..=participants).map(|id| {
            Participant(
                id,
                String::new(),
                0,
                "".into(),
                None,
                None,
                None,
                None,
                None,
            )
        });
        let topic = |(id, name): (u32, &&'static str)| {
            let types = vec!["std_msgs/msg/String".into()];
            let name = (*name).into();
            live::Topic(id, 0, name, "".into(), "topic".into(), types, 0, 0, 1, 0)
        };
        let endpoint = |id: u32| {
            live::Endpoint(
                id,
                1,
                1,
                String::new(),
                0,
                "reliable".into(),
                "volatile".into(),
            )
        };
        let ids = 0..u32::try_from(topics.len()).unwrap();
        Line::Graph(Graph {
            version: 1,
            participants: participants.collect(),
            nodes: vec![live::Node(1, 0, "/talker".into(), vec![1], 0)],
            topics: (0..).zip(topics).map(topic).collect(),
            publishers: ids.map(endpoint).collect(),
            subscriptions: Vec::new(),
        })
    }

    pub(in super::super) fn values(rows: Vec<Row>) -> Line<'static> {
        Line::Values(Values {
            topics: rows,
            ..Values::default()
        })
    }

    /// Returns the row of a topic with these counts of messages and of lost ones.
    pub(in super::super) fn row(id: u32, messages: u64, lost: u64) -> Row {
        Row(
            id,
            Some(10.0),
            Some(1000.0),
            Some(messages),
            Some(lost),
            None,
            Some(0.001),
            Some(0.002),
            0,
            None,
            Some(messages + lost),
        )
    }

    #[test]
    fn losses_during_start_and_shutdown_are_not_evaluated() {
        let mut seen = Observation::new(RULES, 0);
        seen.line(graph(2, &["/a"]), 0.0);
        for (second, lost) in [(1_u8, 7), (6, 7), (7, 9), (20, 9)] {
            let row = row(0, u64::from(second) * 10, lost);
            assert!(seen.line(values(vec![row]), f64::from(second)));
        }
        seen.line(graph(1, &["/a"]), 21.0);
        seen.line(values(vec![row(0, 210, 50)]), 21.0);
        let topic = &seen.topics["/a"];
        assert_eq!(topic.messages, 210);
        assert_eq!(topic.lost.total(), 50);
        assert_eq!(topic.lost.judged(seen.judged_until(22.0)), 2);
        // Much later, the departure is not the beginning of a shutdown.
        assert_eq!(topic.lost.judged(seen.judged_until(60.0)), 43);
    }

    #[test]
    fn expectations_of_a_missing_topic_are_violated() {
        let mut seen = Observation::new(RULES, 0);
        let expectations = Expectations {
            min_rate_hz: Some(5.0),
            max_latency_ms: Some(10.0),
            ..Expectations::default()
        };
        let list = WatchList {
            watches: vec![Watch {
                topic: "/a".to_owned(),
                expectations,
                topics: vec![WatchedTopic {
                    topic: "/a".to_owned(),
                    state: Open::Known(TopicState::NotPublished),
                    ..WatchedTopic::default()
                }],
                origin: Open::Known(Origin::Config),
                ..Watch::default()
            }],
        };
        for second in 0..8 {
            seen.watches(&list, f64::from(second));
        }
        let expected = &seen.expected[&("/a".to_owned(), "/a".to_owned())];
        let violated: Vec<_> = expected.violated.keys().collect();
        assert_eq!(violated, ["min_rate_hz"]);
        assert_eq!(expected.violated["min_rate_hz"].judged(7.0), 3);
        assert!(!expected.was_published);
    }

    #[test]
    fn topics_beyond_the_cap_are_counted() {
        let mut seen = Observation::new(RULES, 0);
        for index in 0..MAX_TOPICS + 3 {
            let name: &'static str = format!("/t{index}").leak();
            seen.line(graph(1, &[name]), 1.0);
        }
        assert_eq!((seen.topics.len(), seen.omitted), (MAX_TOPICS, 3));
    }

    #[test]
    fn findings_beyond_the_cap_are_counted() {
        let mut seen = Observation::new(RULES, 0);
        let finding = |index: usize| live::Finding {
            id: index.to_string(),
            kind: "type_conflict".into(),
            severity: Severity::Error,
            domain_id: Some(0),
            topic: None,
            node: None,
            since: None,
            text: "\u{1b}[2J".to_owned(),
            remedy: None,
            writer: None,
            reader: None,
            policies: Vec::new(),
        };
        seen.line(
            Line::Findings((0..MAX_FINDINGS + 2).map(finding).collect()),
            1.0,
        );
        assert_eq!((seen.findings.len(), seen.omitted), (MAX_FINDINGS, 2));
        assert_eq!(seen.findings["0"].text, "\\u{1b}[2J");
    }

    #[test]
    fn edges_beyond_the_cap_are_counted() {
        let mut seen = Observation::new(RULES, 0);
        let topics: Vec<&'static str> = (0..MAX_TOPICS)
            .map(|index| -> &'static str { format!("/t{index}").leak() })
            .collect();
        for node in 0..5 {
            let Line::Graph(mut graph) = graph(1, &topics) else {
                panic!("a graph")
            };
            graph.nodes[0].2 = format!("/n{node}").into();
            seen.line(Line::Graph(graph), 1.0);
        }
        assert_eq!(seen.edges.len(), MAX_EDGES);
        assert_eq!(seen.omitted, (5 * MAX_TOPICS - MAX_EDGES) as u64);
    }

    #[test]
    fn expectations_beyond_the_cap_are_counted() {
        let mut seen = Observation::new(RULES, 0);
        let topic = |index: usize| WatchedTopic {
            topic: format!("/t{index}"),
            state: Open::Known(TopicState::Ok),
            ..WatchedTopic::default()
        };
        let watch = Watch {
            topic: "/**".to_owned(),
            expectations: Expectations {
                publishers: Some(1),
                ..Expectations::default()
            },
            topics: (0..MAX_EXPECTED + 4).map(topic).collect(),
            origin: Open::Known(Origin::Config),
            ..Watch::default()
        };
        let watches = vec![watch];
        seen.watches(&WatchList { watches }, 1.0);
        assert_eq!((seen.expected.len(), seen.omitted), (MAX_EXPECTED, 4));
    }
}
