use proptest::prelude::*;
use ros2probe_api::endpoints::Endpoint;
use ros2probe_api::measurement::{Distribution, Measurement};
use ros2probe_daemon::config::Config;
use ros2probe_daemon::config::rehearsal::{self, Second};

use super::thresholds::Remark;
use super::watchlist::{Source, text};
use super::*;

/// A robot in virtual time, whose topics have counters of their messages.
struct Robot {
    /// Time by the robot's clock, and by a clock without steps.
    now: f64,
    steady: f64,
    /// Time until the next answer arrives.
    delay: f64,
    learner: Learner,
    topics: Vec<Topic<'static>>,
}

/// What one topic does in a second.
#[derive(Clone, Copy)]
struct Activity {
    messages: u64,
    lost: u64,
    latency: f64,
}

const STEADY: Activity = Activity {
    messages: 10,
    lost: 0,
    latency: 0.001,
};

impl Robot {
    fn new(names: &[&str]) -> Self {
        let topic = |name: &&str| Topic {
            name: name.to_string().into(),
            kind: "topic".into(),
            publishers: vec![Endpoint::default()],
            subscriptions: vec![Endpoint::default(); 2],
            measurement: Some(Measurement::default()),
            ..Topic::default()
        };
        let mut robot = Self {
            now: 1000.0,
            steady: 7.0,
            delay: 0.01,
            learner: Learner::new(Selection::default()),
            topics: names.iter().map(topic).collect(),
        };
        robot.view();
        robot
    }

    fn view(&mut self) {
        let list = TopicList {
            timestamp_seconds: self.now,
            topics: self.topics.clone(),
        };
        let answered = self.steady + std::mem::replace(&mut self.delay, 0.01);
        let request = Request {
            sent: self.steady,
            answered,
        };
        self.learner.observe(&list, Some(request));
    }

    fn pass(&mut self, seconds: f64) {
        self.now += seconds;
        self.steady += seconds;
    }

    /// Advances time by one second, in which the first topic has this activity.
    fn second(&mut self, activity: Activity) {
        self.pass(1.0);
        let counted = self.topics[0].measurement.as_mut().unwrap();
        let before = counted.latency.unwrap_or_default();
        let count = before.count + activity.messages;
        let sum =
            before.mean_seconds * before.count as f64 + activity.latency * activity.messages as f64;
        counted.messages += activity.messages;
        counted.subscriber_lost_messages += activity.lost;
        counted.subscriber_expected_messages += activity.messages + activity.lost;
        if count > 0 {
            counted.latency = Some(Distribution {
                count,
                mean_seconds: sum / count as f64,
                ..Distribution::default()
            });
        }
        if activity.messages > 0 {
            counted.last_message_timestamp_seconds = Some(self.now - 0.05);
        }
        self.view();
    }

    fn topic_thresholds(&self) -> TopicThresholds {
        self.learner.finish().unwrap().topics.remove(0)
    }
}

fn left_out(topic_thresholds: &TopicThresholds, key: &str) -> String {
    let mut remarks = topic_thresholds.remarks.iter();
    remarks
        .find_map(|remark| match remark {
            Remark::LeftOut(keys, why) if keys.contains(key) => Some(why.clone()),
            _ => None,
        })
        .unwrap_or_else(|| panic!("{key} is not left out: {topic_thresholds:?}"))
}

#[test]
fn a_steady_topic_has_every_expectation() {
    let mut robot = Robot::new(&["/imu"]);
    for _ in 0..60 {
        robot.second(STEADY);
    }
    let values = robot.topic_thresholds().values;
    assert_eq!(
        (values.min_rate_hz, values.max_rate_hz),
        (Some(8.0), Some(12.0))
    );
    // One of the 100 messages in 10 s may be lost.
    assert_eq!(values.max_loss_ratio, Some(0.015));
    assert_eq!(values.max_latency_ms, Some(6.0));
    assert_eq!(values.max_silence_s, Some(2.0));
    assert_eq!((values.publishers, values.subscribers), (Some(1), Some(2)));
}

#[test]
fn an_outlier_moves_no_threshold_and_a_changing_rate_is_left_out() {
    let mut robot = Robot::new(&["/imu"]);
    for second in 0..60 {
        let is_hiccup = second == 30;
        robot.second(Activity {
            messages: if is_hiccup { 3 } else { 10 },
            latency: if is_hiccup { 0.5 } else { 0.001 },
            ..STEADY
        });
    }
    let values = robot.topic_thresholds().values;
    // The slow second violates 8 Hz in no window of 5 s.
    assert_eq!((values.min_rate_hz, values.window_s), (Some(8.0), Some(5)));
    assert_eq!(values.max_latency_ms, Some(6.0));

    for second in 0..60 {
        robot.second(Activity {
            messages: if second < 30 { 10 } else { 40 },
            ..STEADY
        });
    }
    let topic_thresholds = robot.topic_thresholds();
    assert_eq!(topic_thresholds.values.min_rate_hz, Some(8.0));
    let why = left_out(&topic_thresholds, "max_rate_hz");
    assert!(
        why.starts_with("the rate varies: 8.6 to 40 Hz in windows of 5 s"),
        "{why}"
    );
}

/// Messages per second of 40 Hz odometry on a busy robot, from 24 to 46, in runs of slow seconds.
fn busy(second: u32) -> u32 {
    let noise = f64::from(second.wrapping_mul(2_654_435_761) >> 16 & 0xff) / 255.0;
    let slow = if second % 13 < 3 { 12.0 } else { 0.0 };
    (40.0 - slow + 6.0 * noise).round().clamp(24.0, 46.0) as u32
}

#[test]
fn a_busy_robot_violates_its_expectations_at_half_its_rate_and_not_otherwise() {
    let seconds = |from: u32, count: u32, part: u32| -> Vec<Second> {
        let second = |second: u32| Second {
            messages: busy(second) / part,
            silence: Some(0.1),
            publishers: 1,
            subscriptions: 1,
            ..Second::default()
        };
        (from..from + count).map(second).collect()
    };
    let learnt = seconds(0, 120, 1);
    let counts = || learnt.iter().map(|second| second.messages);
    assert_eq!((counts().min(), counts().max()), (Some(28), Some(46)));
    let topic_thresholds = thresholds::choose_thresholds("/odom", &Observation::of(learnt.clone()));
    let values = topic_thresholds.values;
    let window = values.window_s.unwrap();
    let low = values.min_rate_hz.unwrap();
    assert!(window > 1 && low > 24.0, "{values:?}");
    let text = format!("{:?}", topic_thresholds.remarks);
    assert!(
        text.contains(&format!("in windows of {window} s")),
        "{text}"
    );
    assert!(text.contains("window_s"), "{text}");
    let expectations = values.try_into().unwrap();
    // A day of the same robot.
    let day = rehearsal::violations(&expectations, &seconds(120, 86_400, 1));
    assert_eq!(day, Vec::<&str>::new());
    // The rate drops from full to half. The violation follows within the window and two
    // evaluations.
    let within = 2 + window as usize;
    let mut halved = learnt;
    halved.extend(seconds(120, within as u32, 2));
    let violated = rehearsal::violations(&expectations, &halved);
    assert!(violated.contains(&"min_rate_hz"), "{values:?} {violated:?}");
}

#[test]
fn a_topic_that_pauses_most_of_the_time_has_no_rate() {
    let mut robot = Robot::new(&["/imu"]);
    for second in 0..60 {
        robot.second(Activity {
            messages: if second < 20 { 10 } else { 0 },
            ..STEADY
        });
    }
    let topic_thresholds = robot.topic_thresholds();
    let why = left_out(&topic_thresholds, "min_rate_hz");
    assert_eq!(why, "no message arrived for most of the time");
    assert_eq!(topic_thresholds.values.min_rate_hz, None);
}

#[test]
fn rare_messages_lead_to_a_limit_of_silence_only_if_they_are_regular() {
    let mut regular = Robot::new(&["/map"]);
    for second in 0..200 {
        regular.second(Activity {
            messages: u64::from(second % 10 == 0),
            ..STEADY
        });
    }
    let topic_thresholds = regular.topic_thresholds();
    assert!((27.0..31.0).contains(&topic_thresholds.values.max_silence_s.unwrap()));
    assert!(left_out(&topic_thresholds, "min_rate_hz").contains("too seldom"));

    let mut irregular = Robot::new(&["/goal"]);
    for second in 0..200 {
        irregular.second(Activity {
            messages: u64::from(second < 12),
            ..STEADY
        });
    }
    assert!(left_out(&irregular.topic_thresholds(), "max_silence_s").contains("too irregular"));
}

#[test]
fn values_that_cannot_be_learnt_are_explained() {
    let mut robot = Robot::new(&["/imu"]);
    for _ in 0..60 {
        robot.second(STEADY);
        let counted = robot.topics[0].measurement.as_mut().unwrap();
        counted.negative_latency_messages += 1;
    }
    assert!(left_out(&robot.topic_thresholds(), "max_latency_ms").ends_with("the clocks differ"));
    robot.topics[0].subscriptions.clear();
    for _ in 0..90 {
        robot.second(STEADY);
    }
    let topic_thresholds = robot.topic_thresholds();
    assert_eq!(
        left_out(&topic_thresholds, "subscribers"),
        "the number varies: 0 to 2"
    );
    let mut silent = Robot::new(&["/imu"]);
    for _ in 0..5 {
        silent.second(Activity {
            messages: 0,
            ..STEADY
        });
    }
    let topic_thresholds = silent.topic_thresholds();
    assert_eq!(
        left_out(&topic_thresholds, "silence"),
        "no message was seen"
    );
    assert_eq!(
        left_out(&topic_thresholds, "publishers"),
        "5 s with a publisher are too few"
    );
}

#[test]
fn globs_select_topics_and_only_names_select_hidden_ones() {
    let typed = |names: &[&str]| {
        let names: Vec<_> = names.iter().map(|name| (*name).to_owned()).collect();
        Selection::new(&names)
    };
    let topic = |name: &'static str| Topic {
        name: name.into(),
        kind: "topic".into(),
        ..Topic::default()
    };
    let selection = typed(&["cam/*", "/_hidden"]).unwrap();
    for (name, is_selected) in [
        ("/cam/left", true),
        ("/cam/_left", false),
        ("/_hidden", true),
        ("/imu", false),
    ] {
        assert_eq!(selection.covers(&topic(name)), is_selected, "{name}");
    }
    let (text, error) = typed(&["/imu", "/a b"]).unwrap_err();
    assert_eq!(
        (text.as_str(), error),
        ("/a b", PatternError::Character(' '))
    );
}

#[test]
fn views_too_close_or_too_far_apart_count_whole_seconds() {
    let mut robot = Robot::new(&["/imu"]);
    for _ in 0..30 {
        robot.second(STEADY);
        robot.pass(0.1);
        robot.view();
        robot.pass(-0.1);
    }
    assert_eq!(robot.learner.seconds(), 30);
    // The agent was busy for three seconds.
    robot.pass(2.0);
    robot.second(Activity {
        messages: 30,
        ..STEADY
    });
    assert_eq!(robot.learner.seconds(), 33);
    assert_eq!(robot.topic_thresholds().values.min_rate_hz, Some(8.0));
}

#[test]
fn a_robot_whose_clock_is_set_keeps_its_thresholds() {
    for step in [3600.0, -3600.0, -0.7] {
        let mut robot = Robot::new(&["/imu"]);
        for second in 0..60 {
            if second == 30 {
                robot.now += step;
            }
            robot.second(STEADY);
        }
        assert_eq!(robot.learner.seconds(), 59, "{step}");
        let values = robot.topic_thresholds().values;
        assert_eq!(
            (values.min_rate_hz, values.max_rate_hz, values.publishers),
            (Some(8.0), Some(12.0), Some(1)),
            "{step}"
        );
    }
}

#[test]
fn a_late_answer_changes_no_rate() {
    for delay in [0.45, 0.55, 0.9] {
        let mut robot = Robot::new(&["/imu"]);
        for second in 0..60 {
            if second == 30 {
                robot.delay = delay;
            }
            robot.second(STEADY);
        }
        assert_eq!(robot.learner.seconds(), 60, "{delay}");
        let values = robot.topic_thresholds().values;
        let rates = (values.min_rate_hz, values.max_rate_hz);
        assert_eq!(rates, (Some(8.0), Some(12.0)), "{delay}");
    }
}

#[test]
fn a_view_of_the_same_state_is_skipped() {
    let mut robot = Robot::new(&["/imu"]);
    for _ in 0..30 {
        robot.second(STEADY);
    }
    // The busy agent answers a second later with the same state.
    robot.steady += 1.0;
    robot.view();
    assert_eq!(robot.learner.seconds(), 30);
    robot.now += 1.0;
    robot.second(Activity {
        messages: 20,
        ..STEADY
    });
    assert_eq!(robot.learner.seconds(), 32);
    assert_eq!(robot.topic_thresholds().values.min_rate_hz, Some(8.0));
}

#[test]
fn hostile_names_of_topics_do_not_corrupt_the_file() {
    let mut robot = Robot::new(&["/imu", "/a: b\n- x", "/scan"]);
    for _ in 0..30 {
        robot.second(STEADY);
    }
    let learnt = robot.learner.finish().unwrap();
    assert_eq!((learnt.topics.len(), learnt.unnamed), (2, 1));
    let source = Source {
        place: "robot\n- 1",
        domain_id: 3,
        names_domain: true,
        period: ("a", "b"),
        seconds: 30,
    };
    let file = text(&learnt, &source);
    let config = Config::parse(file.as_bytes()).unwrap();
    assert_eq!(config.watches.len(), 2, "{file}");
    assert_eq!(
        config.watches[0].expectations.values(),
        learnt.topics[0].values
    );
}

#[test]
fn a_file_is_never_larger_than_an_agent_reads() {
    let mut robot = Robot::new(&["/imu"]);
    for _ in 0..30 {
        robot.second(STEADY);
    }
    let mut learnt = robot.learner.finish().unwrap();
    let topic_thresholds = learnt.topics.remove(0);
    learnt.topics = (0..Limit::Watches.row().default)
        .map(|number| TopicThresholds {
            topic: format!("/t{number}{}", "x".repeat(250)),
            remarks: [
                &topic_thresholds.remarks[..],
                &vec![Remark::LeftOut("all", "y".repeat(900)); 1],
            ]
            .concat(),
            ..topic_thresholds.clone()
        })
        .collect();
    let source = Source {
        place: "robot",
        domain_id: 0,
        names_domain: false,
        period: ("a", "b"),
        seconds: 30,
    };
    let config = Config::parse(text(&learnt, &source).as_bytes()).unwrap();
    assert_eq!(config.watches.len(), learnt.topics.len());
}

proptest! {
    /// A robot never violates what was learnt from it.
    #[test]
    fn no_robot_violates_its_own_watchlist(
        seconds in prop::collection::vec((0..30_u32, 0..3_u32, 0.0..0.1_f32, 0..3_u16, 0..3_u16), 20..120),
    ) {
        let mut last = None;
        let mut list = Vec::new();
        for (messages, lost, latency, publishers, subscriptions) in seconds {
            last = if messages > 0 { Some(0.01) } else { last.map(|it: f32| it + 1.0) };
            list.push(Second {
                messages, lost, expected: messages + lost, delayed: messages, delay: latency * messages as f32,
                silence: last, publishers, subscriptions,
            });
        }
        let topic_thresholds = thresholds::choose_thresholds("/x", &Observation::of(list.clone()));
        let expectations = topic_thresholds.values.try_into().unwrap();
        prop_assert_eq!(rehearsal::violations(&expectations, &list), Vec::<&str>::new());
    }

    /// A learnt band excludes half the rate, at every rate.
    #[test]
    fn half_the_rate_violates_the_learnt_band(rate in 0.5..500.0_f64, jitter in 0.0..0.05_f64) {
        let count = |factor: f64, second: u32| {
            let noise = 1.0 + jitter * f64::from(second % 7).sin();
            let upto = |second: u32| (rate * factor * noise * f64::from(second)).floor() as u32;
            upto(second + 1).saturating_sub(upto(second))
        };
        let make = |factor: f64| -> Vec<Second> {
            (0..120).map(|second| Second {
                messages: count(factor, second), silence: Some(0.5), publishers: 1,
                subscriptions: 1, ..Second::default()
            }).collect()
        };
        let topic_thresholds = thresholds::choose_thresholds("/x", &Observation::of(make(1.0)));
        if topic_thresholds.values.min_rate_hz.is_some() {
            let expectations = topic_thresholds.values.try_into().unwrap();
            let violated = rehearsal::violations(&expectations, &make(0.5));
            prop_assert!(violated.contains(&"min_rate_hz"), "{:?}: {violated:?}", topic_thresholds.values);
        }
    }
}
