//! The state of each robot, from queries about the whole fleet.

use std::collections::{BTreeMap, BTreeSet};

use ros2probe_api::fleet::{Comparison, Difference, Fleet, PRESENT, Robot, State};

use super::differences::{self, MIN_ROBOTS, Trait};
use super::engine::{Engine, EngineError, Labels};

/// Minimum numbers of decimal and of hexadecimal digits that are no part of a common name.
const MIN_DECIMAL: usize = 3;
const MIN_HEXADECIMAL: usize = 8;
/// Numbers of hexadecimal digits of a UUID's parts.
const UUID_DIGITS: [usize; 5] = [8, 4, 4, 4, 12];

/// Which robots, and how far back.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Question {
    /// Value of the label `job`.
    pub job: String,
    /// Time in hours for which a robot without samples is still listed.
    pub hours: u32,
    /// Time in seconds after which a robot without samples is out of reach.
    pub reach: u32,
}

impl Default for Question {
    fn default() -> Self {
        Self {
            job: "ros2probe".to_owned(),
            hours: 24,
            reach: 60,
        }
    }
}

/// Values of series.
type Samples = Vec<(Labels, f64)>;
/// By robot.
type ByRobot<T> = BTreeMap<String, T>;

/// Answers of the engine about the whole fleet, by robot.
#[derive(Default)]
struct Answers {
    /// Age of the last sample in seconds.
    ages: ByRobot<Samples>,
    ready: ByRobot<Samples>,
    versions: ByRobot<Samples>,
    nodes: ByRobot<Samples>,
    topics: ByRobot<Samples>,
    publishers: ByRobot<Samples>,
    subscriptions: ByRobot<Samples>,
    /// Messages a second of each topic.
    rates: ByRobot<Samples>,
    /// Fraction of messages.
    losses: ByRobot<Samples>,
    violated: ByRobot<Samples>,
    findings: ByRobot<Samples>,
}

/// Queries an engine for the robots of a fleet.
///
/// # Errors
///
/// Fails if the engine cannot be reached, or refuses a query.
pub async fn read(engine: &Engine, question: &Question) -> Result<Fleet, EngineError> {
    let answers = Answers::query(engine, question).await?;
    let reach = f64::from(question.reach);
    let in_reach = answers.ages.iter().filter(|(_, age)| {
        let age = value(age);
        age.is_some_and(|age| age < reach)
    });
    let traits = in_reach.map(|(name, _)| (name.clone(), answers.traits(name)));
    let traits = traits.collect();
    let mut differences = differences::find(&traits);
    let robots = answers.ages.keys().map(|name| {
        let differences = differences.remove(name).unwrap_or_default();
        answers.robot(name, reach, differences)
    });
    let mut robots: Vec<_> = robots.collect();
    robots.sort_by(|one, two| (one.state, &one.name).cmp(&(two.state, &two.name)));
    Ok(Fleet {
        robots,
        comparison: Comparison {
            in_reach: traits.len(),
            minimum: MIN_ROBOTS,
        },
        incidents: None,
    })
}

impl Answers {
    async fn query(engine: &Engine, question: &Question) -> Result<Self, EngineError> {
        let job = format!("job={}", quoted(&question.job));
        let mut left = engine.max_series();
        let mut ask = async |expression: &str| {
            let expression = expression.replace("$JOB", &job);
            Ok::<_, EngineError>(by_robot(engine.query(&expression, &mut left).await?))
        };
        let hours = question.hours;
        Ok(Self {
            ages: ask(&format!(
                "time() - max by (instance) (max_over_time(timestamp(ros2probe_ready{{$JOB}})[10m:5s]) \
                 or max_over_time(timestamp(ros2probe_ready{{$JOB}})[{hours}h:1m]))"
            ))
            .await?,
            ready: ask("min by (instance) (ros2probe_ready{$JOB})").await?,
            versions: ask("ros2probe_build_info{$JOB}").await?,
            nodes: ask("group by (instance, ros_node) (ros2_node_info{$JOB})").await?,
            topics: ask(
                "group by (instance, topic, message_type, reliability, durability) \
                 (ros2_topic_info{$JOB,kind=\"topic\"})",
            ).await?,
            publishers: ask("sum by (instance, topic) (ros2_topic_publishers{$JOB})").await?,
            subscriptions: ask("sum by (instance, topic) (ros2_topic_subscriptions{$JOB})").await?,
            rates: ask("sum by (instance, topic) (rate(ros2_topic_messages_total{$JOB}[2m]))").await?,
            losses: ask(
                "sum by (instance) (increase(ros2_topic_subscriber_lost_messages_total{$JOB}[5m])) / \
                 sum by (instance) (increase(ros2_topic_subscriber_expected_messages_total{$JOB}[5m]))",
            ).await?,
            violated: ask("ros2_watch_expectation_violated{$JOB} == 1").await?,
            findings: ask("sum by (instance, kind) (ros2_diagnoses{$JOB}) > 0").await?,
        })
    }

    /// Returns the properties of a robot that are compared.
    fn traits(&self, name: &str) -> BTreeMap<String, Trait> {
        // Several domains, or topics that differ by a number, may have one key. The order in which
        // an engine returns them is not defined.
        let mut texts = BTreeMap::<String, BTreeSet<String>>::new();
        // A topic without publishers has no type and no quality of service.
        let mut text = |key: String, text: String| {
            if !text.is_empty() {
                texts.entry(key).or_default().insert(text);
            }
        };
        for (labels, _) in of(&self.versions, name) {
            text("version of the agent".to_owned(), labels.version.clone());
        }
        for (labels, _) in of(&self.nodes, name) {
            let node = common(&labels.ros_node, name);
            text(format!("node {node}"), PRESENT.to_owned());
        }
        for (labels, _) in of(&self.topics, name) {
            let topic = common(&labels.topic, name);
            for (quality, value) in [
                ("message type", &labels.message_type),
                ("reliability", &labels.reliability),
                ("durability", &labels.durability),
            ] {
                text(format!("{quality} of {topic}"), value.clone());
            }
        }
        for (what, counts) in [
            ("publishers", &self.publishers),
            ("subscriptions", &self.subscriptions),
        ] {
            let mut sums = BTreeMap::<String, f64>::new();
            for (labels, count) in of(counts, name) {
                *sums.entry(common(&labels.topic, name)).or_default() += count;
            }
            for (topic, count) in sums {
                text(format!("{what} of {topic}"), format!("{count}"));
            }
        }
        for (labels, count) in of(&self.findings, name) {
            let kind = &labels.kind;
            if is_usual(kind) {
                text(format!("endpoints with {kind}"), format!("{count}"));
            }
        }
        let joined = |texts: BTreeSet<String>| texts.into_iter().collect::<Vec<_>>().join(", ");
        let texts = texts
            .into_iter()
            .map(|(key, texts)| (key, Trait::Text(joined(texts))));
        let mut traits: BTreeMap<_, _> = texts.collect();
        for (labels, rate) in of(&self.rates, name) {
            let key = format!("rate of {}", common(&labels.topic, name));
            let sum = traits.entry(key).or_insert(Trait::Hertz(0.0));
            if let Trait::Hertz(sum) = sum {
                *sum += rate;
            }
        }
        traits
    }

    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "the number of findings is small and positive"
    )]
    fn robot(&self, name: &str, reach: f64, differences: Vec<Difference>) -> Robot {
        let violated = of(&self.violated, name).iter();
        let violated =
            violated.map(|(labels, _)| (labels.topic.clone(), labels.expectation.clone()));
        let findings = of(&self.findings, name)
            .iter()
            .map(|(labels, count)| (labels.kind.clone(), *count as u64))
            .filter(|(kind, _)| !is_usual(kind));
        let version = of(&self.versions, name).first();
        let mut robot = Robot {
            name: name.to_owned(),
            state: State::OutOfReach,
            age_s: value(of(&self.ages, name)).unwrap_or(0.0).max(0.0),
            version: version.map(|(labels, _)| labels.version.clone()),
            nodes: of(&self.nodes, name).len(),
            topics: of(&self.topics, name).len(),
            loss: value(of(&self.losses, name)).filter(|loss| loss.is_finite()),
            violated: violated.collect(),
            findings: findings.collect(),
            differences,
            page: None,
        };
        if robot.age_s < reach {
            let ready = value(of(&self.ready, name));
            robot.state = state(&robot, ready.is_some_and(|ready| ready > 0.5));
        }
        robot
    }
}

/// Returns the state of a robot in reach.
fn state(robot: &Robot, is_ready: bool) -> State {
    if !is_ready {
        State::NotReady
    } else if !robot.violated.is_empty() {
        State::Violated
    } else if !robot.findings.is_empty() {
        State::Findings
    } else {
        State::Ok
    }
}

/// Returns whether findings of this kind are usual on healthy robots.
fn is_usual(kind: &str) -> bool {
    kind.starts_with("unmatched_")
}

fn by_robot(samples: Samples) -> ByRobot<Samples> {
    let mut robots: ByRobot<Samples> = BTreeMap::new();
    for (labels, value) in samples {
        if !labels.instance.is_empty() {
            let robot = robots.entry(labels.instance.clone()).or_default();
            robot.push((labels, value));
        }
    }
    robots
}

fn of<'a>(samples: &'a ByRobot<Samples>, robot: &str) -> &'a [(Labels, f64)] {
    samples.get(robot).map_or(&[], Vec::as_slice)
}

fn value(samples: &[(Labels, f64)]) -> Option<f64> {
    samples.first().map(|(_, value)| *value)
}

/// Returns a name as it is on every robot. The robot's own name in it is `<robot>`, and a number that
/// differs with each process is `<number>`.
fn common(name: &str, robot: &str) -> String {
    let tokens = name.split('/').map(|token| {
        if token == robot || token == robot.replace(['-', '.'], "_") {
            "<robot>".to_owned()
        } else {
            without_number(token)
        }
    });
    tokens.collect::<Vec<_>>().join("/")
}

/// Replaces the numbers of a token by `<number>`, of which a UUID with underscores is one.
fn without_number(token: &str) -> String {
    let parts: Vec<&str> = token.split('_').collect();
    let mut left = parts.as_slice();
    let mut kept = Vec::new();
    while let Some((&part, rest)) = left.split_first() {
        let uuid = left.split_at_checked(UUID_DIGITS.len());
        let uuid = uuid.filter(|(uuid, _)| {
            let lengths = uuid.iter().map(|part| part.len());
            lengths.eq(UUID_DIGITS) && uuid.iter().all(|part| is_hexadecimal(part))
        });
        let (after, part) = match uuid {
            Some((_, after)) => (after, "<number>"),
            None if is_number(part) => (rest, "<number>"),
            None => (rest, part),
        };
        left = after;
        kept.push(part);
    }
    kept.join("_")
}

/// Returns whether a part of a name is the number of a process, an address in memory or a UUID.
fn is_number(part: &str) -> bool {
    let has_digit = part.bytes().any(|byte| byte.is_ascii_digit());
    let is_decimal = part.bytes().all(|byte| byte.is_ascii_digit());
    (part.len() >= MIN_DECIMAL && is_decimal)
        || (part.len() >= MIN_HEXADECIMAL && has_digit && is_hexadecimal(part))
}

fn is_hexadecimal(part: &str) -> bool {
    part.bytes().all(|byte| byte.is_ascii_hexdigit())
}

/// Returns a text as a string of PromQL.
fn quoted(text: &str) -> String {
    format!("\"{}\"", text.replace('\\', "\\\\").replace('"', "\\\""))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_a_robot_of_a_process_and_of_a_mission_are_the_same_on_every_robot() {
        let common = |name: &str| super::common(name, "robot-7");
        assert_eq!(common("/robot_7/scan"), "/<robot>/scan");
        assert_eq!(common("/robot-7"), "/<robot>");
        assert_eq!(common("/launch_ros_4711"), "/launch_ros_<number>");
        assert_eq!(common("/camera_2/image"), "/camera_2/image");
        // The listener of tf2 has an address in its name, and a mission its UUID.
        let listener = "/transform_listener_impl_5581a5d0b0c0";
        assert_eq!(common(listener), "/transform_listener_impl_<number>");
        for uuid in [
            "6ba7b8109dad11d180b400c04fd430c8",
            "6ba7b810_9dad_11d1_80b4_00c04fd430c8",
            "deadbeef_dead_beef_dead_deadbeefdead",
        ] {
            let mission = format!("/mission_{uuid}/state");
            assert_eq!(common(&mission), "/mission_<number>/state");
        }
        for name in ["/facade_added", "/beadface", "/gripper_12/a_b_c_d", "/_"] {
            assert_eq!(common(name), name);
        }
        assert_eq!(quoted("a\"b\\"), "\"a\\\"b\\\\\"");
    }

    #[test]
    fn traits_of_topics_with_one_key_do_not_depend_on_the_order_of_the_answer() {
        let labels = |topic: &str, reliability: &str| Labels {
            topic: topic.to_owned(),
            reliability: reliability.to_owned(),
            ..Labels::default()
        };
        let mut series = vec![
            (labels("/camera_001/image", "reliable"), 30.0),
            (labels("/camera_002/image", "best_effort"), 15.0),
        ];
        let mut traits = Vec::new();
        for _ in 0..2 {
            series.reverse();
            let of_robot = BTreeMap::from([("robot".to_owned(), series.clone())]);
            let answers = Answers {
                topics: of_robot.clone(),
                publishers: of_robot.clone(),
                rates: of_robot,
                ..Answers::default()
            };
            traits.push(answers.traits("robot"));
        }
        assert_eq!(traits[0], traits[1]);
        let of = |key: &str| traits[0][&format!("{key} of /camera_<number>/image")].clone();
        assert_eq!(
            of("reliability"),
            Trait::Text("best_effort, reliable".to_owned())
        );
        assert_eq!(of("publishers"), Trait::Text("45".to_owned()));
        assert_eq!(of("rate"), Trait::Hertz(45.0));
    }
}
