//! Notes on stderr beside the output of a verb: sampled topics, messages that could not be
//! captured, and reasons for silence. Each note is printed once, when its cause is known. The
//! output on stdout matches ros2cli.

use std::collections::{BTreeMap, HashSet};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use ros2probe::client::{Agent, ClientError};
use ros2probe_api::Open;
use ros2probe_api::health::Health;
use ros2probe_api::path::encoded;
use ros2probe_api::problem::Code;
use ros2probe_api::samples::{Missed, MissedReason};
use ros2probe_api::topics::{Reason, ReasonCode, Topic, TopicList, UNSUBSCRIBED};
use ros2probe_daemon::escape::visible;
use ros2probe_daemon::recording::{GraphSnapshot, PublishedTopic};

use super::shared::names_of;

/// Silence after which the reason is requested.
pub(crate) const SILENCE_TIMEOUT: Duration = Duration::from_secs(5);
/// Minimum time between two reports of a topic's missing messages.
const MIN_REPORT_INTERVAL: Duration = Duration::from_secs(5);
/// Consequence of sampling for verbs that print messages.
pub(crate) const NOT_ALL_PRINTED: &str = "not every message is printed";
/// Maximum number of topics named in one line.
const MAX_NAMED_TOPICS: usize = 8;
/// Remedy for sampled topics.
const SAMPLING_REMEDY: &str = "`capture.shm.exact: auto` captures each message";

/// Notes on the topics of one verb.
pub(crate) struct Notes<'a> {
    agent: &'a Agent,
    domain_id: u32,
    is_replay: bool,
    /// Topics on the command line; empty for all topics.
    names: Vec<String>,
    /// Whether one existing topic among the names is enough.
    are_parts: bool,
    /// Consequence of sampling for this verb.
    consequence: &'static str,
    sampling: Sampling,
    received_topics: HashSet<String>,
    sampled: HashSet<String>,
    begun: Instant,
    is_explained: bool,
}

/// Missing messages that are not reported yet. The variable is global, because Ctrl-C may end the
/// process. A process runs only one verb.
static MISSING_MESSAGES: Mutex<Missing> = Mutex::new(Missing(BTreeMap::new()));

/// Missing messages by topic and reason: the unreported count, and the time of the last report.
struct Missing(BTreeMap<(String, &'static str), (u64, Option<Instant>)>);

/// Reports missing messages before the process ends.
pub(crate) fn end() {
    // If another thread holds the lock, it is blocked on stderr.
    if let Ok(mut missing) = MISSING_MESSAGES.try_lock() {
        missing.report(true);
    }
}

impl<'a> Notes<'a> {
    /// Reports sampled topics. `names` are the topics on the command line.
    pub(crate) fn begin(
        agent: &'a Agent,
        domain_id: u32,
        is_replay: bool,
        names: &[String],
        consequence: &'static str,
    ) -> Self {
        let mut notes = Self {
            agent,
            domain_id,
            is_replay,
            names: names.to_vec(),
            are_parts: false,
            consequence,
            sampling: match is_replay {
                // A network capture contains no shared memory.
                true => Sampling::Nothing,
                false => Sampling::at(agent),
            },
            received_topics: HashSet::new(),
            sampled: HashSet::new(),
            begun: Instant::now(),
            is_explained: false,
        };
        if matches!(notes.sampling, Sampling::Sampled(_)) {
            let topics = notes.topics();
            let topics = topics.iter().filter(|topic| is_sampled(topic));
            let topics: Vec<String> = topics.map(|topic| topic.name.clone()).collect();
            notes.print_sampled(&topics);
        }
        notes
    }

    /// Treats the topics as parts of one entity, of which some may not exist.
    pub(crate) fn of_parts(self) -> Self {
        Self {
            are_parts: true,
            ..self
        }
    }

    /// Returns the topics that were reported as sampled.
    pub(crate) fn sampled(&self) -> impl Iterator<Item = &str> {
        self.sampled.iter().map(String::as_str)
    }

    /// Records the arrival of a message.
    pub(crate) fn received(&mut self, topic: &str, sampled: bool) {
        let is_new = sampled && !self.sampled.contains(topic);
        if is_new && self.sampling.is_known(self.agent, self.begun) {
            self.print_sampled(&[topic.to_owned()]);
        }
        if !self.received_topics.contains(topic) {
            self.received_topics.insert(topic.to_owned());
        }
    }

    /// Records messages that will not arrive.
    pub(crate) fn missed(&mut self, missed: &Missed) {
        let why = match missed.known_reason() {
            MissedReason::QueueFull => "were dropped: too slow here",
            MissedReason::NotCaptured => "could not be captured",
            MissedReason::Unannounced => "were sent before their publisher was announced",
            // The verb itself reports messages lost by its subscriber.
            MissedReason::Incomplete | MissedReason::Lost => return,
        };
        let mut missing = Missing::all();
        missing.add((missed.topic.clone(), why), missed.samples);
        missing.report(false);
    }

    /// Reports once why no message arrived, after [`SILENCE_TIMEOUT`].
    pub(crate) fn now(&mut self) {
        Missing::all().report(false);
        if !self.is_replay && self.begun.elapsed() >= SILENCE_TIMEOUT {
            self.print_explanation();
        }
    }

    /// At the end of the stream, reports missing messages and the reason for silence.
    pub(crate) fn end(&mut self) {
        Missing::all().report(true);
        self.print_explanation();
    }

    /// Prints the explanation, once. Failed requests are ignored, because it is only a hint: the
    /// stream reports an agent that has ended.
    fn print_explanation(&mut self) {
        if std::mem::replace(&mut self.is_explained, true) {
            return;
        }
        if self.are_parts && !self.received_topics.is_empty() {
            return;
        }
        if self.names.is_empty() && self.received_topics.is_empty() {
            let _ = names_of(self.agent, self.domain_id);
        }
        for name in &self.names {
            if self.received_topics.contains(name) {
                continue;
            }
            let path = path(name, self.domain_id);
            match self.agent.get::<Topic<'_>>(&path) {
                Ok(topic) => {
                    let why = topic.reasons.iter().find_map(|reason| self.words(reason));
                    if let Some(why) = counted_inside(&topic).or(why) {
                        eprintln!("rp: no message on {}: {}", visible(name), visible(&why));
                    }
                }
                Err(error @ ClientError::Refused(_)) if error.is(Code::NoSuchTopic) => {
                    let detail = error.to_string();
                    eprintln!("rp: no message on {}: {}", visible(name), visible(&detail));
                    let _ = names_of(self.agent, self.domain_id);
                }
                Err(_) => {}
            }
        }
    }

    /// Returns the text of a reason and its remedy; `None` if a message may still arrive.
    fn words(&self, reason: &Reason) -> Option<String> {
        let Open::Known(code) = &reason.code else {
            return None;
        };
        let text = match code {
            ReasonCode::NoPublisher => "it has no publisher",
            ReasonCode::NoSubscriber => {
                let remedy = "rp does not subscribe: start a subscriber";
                return Some(format!("{UNSUBSCRIBED}; {remedy}"));
            }
            ReasonCode::Encrypted => {
                "its publisher uses DDS security; its messages may be encrypted"
            }
            ReasonCode::WatchRejected => {
                "the limit on measured topics is reached: raise limits.topics"
            }
            ReasonCode::SharedMemory if self.is_replay => {
                "publisher and subscriber use shared memory, which a capture of the network lacks: \
                 record on the robot with `rp bag record`"
            }
            ReasonCode::DataSharing => {
                "subscribers read the publisher's memory (data sharing), where no single message \
                 is seen: turn data sharing off, or count them with `capture.inside: topics`"
            }
            ReasonCode::SameProcess => {
                "publisher and subscriber share one process; nothing crosses the network: subscribe \
                 from another process, or count them with `capture.inside: topics`"
            }
            ReasonCode::Iceoryx => {
                "messages pass through iceoryx, where no single message is seen: turn shared memory \
                 off in Cyclone DDS, or count them with `capture.inside: topics`"
            }
            ReasonCode::SharedMemory => {
                let text = "publisher and subscriber use shared memory, and none was seen there";
                return Some(match &self.sampling {
                    Sampling::Sampled(remedy) => format!("{text}: {remedy}"),
                    Sampling::Nothing | Sampling::OnDemand => text.to_owned(),
                });
            }
            ReasonCode::AgentNotReady
            | ReasonCode::NoMatchedSubscriber
            | ReasonCode::OutsideView => &reason.detail,
            ReasonCode::NotWatched | ReasonCode::Quiet => return None,
        };
        Some(text.to_owned())
    }

    fn print_sampled(&mut self, topics: &[String]) {
        if let Some(text) = self.sampling.text(topics, self.consequence) {
            eprintln!("rp: {}", visible(&text));
        }
        self.sampled.extend(topics.iter().cloned());
    }

    /// Returns the topics of the verb; empty if the agent does not answer.
    fn topics(&self) -> Vec<PublishedTopic> {
        let topics = match self.names.as_slice() {
            [name] => {
                let topic = self.agent.get(&path(name, self.domain_id));
                topic.map(|topic: Topic<'_>| vec![topic])
            }
            _ => {
                let domain_id = self.domain_id;
                let path = format!("/topics?domain_id={domain_id}&hidden=true");
                self.agent.get(&path).map(|list: TopicList<'_>| list.topics)
            }
        };
        let topics = topics.unwrap_or_default();
        let mut topics = GraphSnapshot::answered(&topics, Vec::new()).topics;
        topics.retain(|topic| self.names.is_empty() || self.names.contains(&topic.name));
        topics
    }
}

impl Missing {
    fn all() -> MutexGuard<'static, Self> {
        MISSING_MESSAGES
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
    }

    fn add(&mut self, key: (String, &'static str), samples: u64) {
        self.0.entry(key).or_insert((0, None)).0 += samples;
    }

    fn report(&mut self, at_end: bool) {
        for line in self.due(at_end) {
            eprintln!("rp: {line}");
        }
    }

    fn due(&mut self, at_end: bool) -> Vec<String> {
        let mut lines = Vec::new();
        for ((topic, why), (count, reported)) in &mut self.0 {
            let is_due = reported.is_none_or(|reported| reported.elapsed() >= MIN_REPORT_INTERVAL);
            if *count == 0 || !is_due && !at_end {
                continue;
            }
            let topic = visible(topic);
            lines.push(match *count {
                1 => format!("1 message on {topic} {}", why.replacen("were", "was", 1)),
                count => format!("{count} messages on {topic} {why}"),
            });
            (*count, *reported) = (0, Some(Instant::now()));
        }
        lines
    }
}

/// How the agent sees messages in shared memory.
pub(crate) enum Sampling {
    /// The agent sees every message, or no message uses shared memory.
    Nothing,
    /// The agent will see every message soon, because this client reads them.
    OnDemand,
    /// The agent sees only samples. The text is the remedy or the reason.
    Sampled(String),
}

impl Sampling {
    /// Returns how this agent sees messages in shared memory at present.
    pub(crate) fn at(agent: &Agent) -> Self {
        let health = agent.get("/health");
        health.map_or(Self::Nothing, |health: Health| Self::of(&health))
    }

    fn of(health: &Health) -> Self {
        let ability = |name: &str| health.abilities.iter().find(|each| each.ability == name);
        let exact = ability("shared_memory_exact");
        let is_read = ability("shared_memory").is_some_and(|each| each.able);
        match exact {
            _ if !is_read => Self::Nothing,
            Some(exact) if exact.able => Self::Nothing,
            Some(exact) if exact.on_demand => Self::OnDemand,
            // If exact capture is configured, the text has the reason of its failure instead of a
            // remedy.
            exact => {
                let reason = exact.and_then(|exact| exact.reason.clone());
                Self::Sampled(reason.unwrap_or_else(|| SAMPLING_REMEDY.to_owned()))
            }
        }
    }

    /// Returns whether sampled messages show a lasting state. While breakpoints attach after
    /// `begun`, they do not.
    pub(crate) fn is_known(&mut self, agent: &Agent, begun: Instant) -> bool {
        if matches!(self, Self::OnDemand) {
            if begun.elapsed() < SILENCE_TIMEOUT {
                return false;
            }
            *self = match Self::at(agent) {
                Self::OnDemand => Self::Nothing,
                known => known,
            };
        }
        true
    }

    /// Returns the text about sampled topics: the consequence, and the remedy or the reason.
    /// Returns `None` if the topics are not sampled.
    pub(crate) fn text(&self, topics: &[String], consequence: &str) -> Option<String> {
        let Self::Sampled(remedy) = self else {
            return None;
        };
        let names = shortened_list(topics);
        let verb = if topics.len() == 1 { "is" } else { "are" };
        let text = format!("{names} {verb} sampled in shared memory; {consequence}; {remedy}");
        (!topics.is_empty()).then_some(text)
    }
}

/// Returns whether all messages of a topic pass through shared memory.
pub(crate) fn is_sampled(topic: &PublishedTopic) -> bool {
    topic.subscribed && topic.other_transport.as_deref() == Some("shared_memory")
}

/// Returns a text if the topic's messages are counted only inside processes; `None` for others.
fn counted_inside(topic: &Topic<'_>) -> Option<String> {
    let measured = topic
        .measurement
        .as_ref()
        .filter(|_| topic.source == "inside")?;
    Some(format!(
        "its figures come from inside the processes, where no single message is seen: {} messages, \
         {:.1} Hz (`rp top`, `rp inside`)",
        measured.messages,
        measured.rate_hertz.unwrap_or_default()
    ))
}

fn shortened_list(names: &[String]) -> String {
    let shown: Vec<&str> = names
        .iter()
        .take(MAX_NAMED_TOPICS)
        .map(String::as_str)
        .collect();
    let shown = shown.join(", ");
    match names.len().saturating_sub(MAX_NAMED_TOPICS) {
        0 => shown,
        more => format!("{shown} and {more} more"),
    }
}

fn path(name: &str, domain_id: u32) -> String {
    let name = encoded(name.strip_prefix('/').unwrap_or(name));
    format!("/topics/{name}?domain_id={domain_id}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_missing_since_the_last_report_are_reported_at_the_end() {
        let mut missing = Missing(BTreeMap::new());
        let mut miss = |samples| {
            missing.add(("/t".to_owned(), "were dropped"), samples);
            missing.due(false)
        };
        assert_eq!(miss(2), ["2 messages on /t were dropped"]);
        assert!(miss(1).is_empty());
        assert_eq!(missing.due(true), ["1 message on /t was dropped"]);
        assert!(missing.due(true).is_empty());
    }

    #[test]
    fn a_topic_that_is_counted_inside_processes_names_that_source() {
        let mut topic = Topic {
            source: "inside".into(),
            measurement: Some(ros2probe_api::measurement::Measurement {
                messages: 200,
                rate_hertz: Some(20.04),
                ..Default::default()
            }),
            ..Topic::default()
        };
        let text = counted_inside(&topic).unwrap();
        let begin = "its figures come from inside the processes, ";
        assert!(text.starts_with(begin), "{text}");
        assert!(text.contains(": 200 messages, 20.0 Hz ("), "{text}");
        topic.source = "wire".into();
        assert_eq!(counted_inside(&topic), None);
    }

    #[test]
    fn a_long_list_of_sampled_topics_is_one_line() {
        let names: Vec<String> = (0..10).map(|number| format!("/t{number}")).collect();
        let sampling = Sampling::Sampled(SAMPLING_REMEDY.to_owned());
        let text = sampling.text(&names, NOT_ALL_PRINTED).unwrap();
        assert!(text.starts_with("/t0, /t1, "), "{text}");
        assert!(
            text.contains("/t7 and 2 more are sampled in shared memory; not every"),
            "{text}"
        );
        assert!(text.contains("capture.shm.exact"), "{text}");
        assert_eq!(sampling.text(&[], ""), None);
    }

    #[test]
    fn settings_that_are_configured_are_not_recommended() {
        let text = |exact: &str| {
            let health = format!(
                r#"{{"abilities":[{{"ability":"shared_memory","able":true}},
                    {{"ability":"shared_memory_exact",{exact}}}]}}"#
            );
            let health: Health = serde_json::from_str(&health).unwrap();
            Sampling::of(&health).text(&["/imu".to_owned()], NOT_ALL_PRINTED)
        };
        let off = text(r#""able":false"#).unwrap();
        assert!(off.ends_with(SAMPLING_REMEDY), "{off}");
        let resting = r#""able":false,"on_demand":true,"reason":"no client reads samples""#;
        assert_eq!(text(resting), None);
        assert_eq!(text(r#""able":true"#), None);
        let failed = text(r#""able":false,"reason":"uprobes need CAP_SYS_ADMIN""#).unwrap();
        assert!(
            failed.ends_with("printed; uprobes need CAP_SYS_ADMIN"),
            "{failed}"
        );
    }
}
