use serde::Deserialize;

use super::*;

const START: i64 = 1_795_142_000_000_000_000;
const MILLISECOND: i64 = 1_000_000;
const IMU: &str = "sensor_msgs/msg/Imu";
const STRING: &str = "std_msgs/msg/String";

#[derive(Deserialize)]
struct Case {
    kind: String,
    window: usize,
    messages: Vec<(i64, u32, i64)>,
    now: i64,
    text: String,
}

#[test]
fn the_numbers_of_reports_are_those_of_python() {
    for line in include_str!("golden/reports.jsonl").lines() {
        let case: Case = serde_json::from_str(line).unwrap();
        let mut intervals = Intervals::new(case.window);
        let mut sizes = Sizes::new(case.window);
        let mut ages = Ages::new(case.window);
        for (time, size, stamp) in case.messages {
            intervals.add_message(START + time);
            sizes.add_message(START + time, size);
            ages.add_message(START + time, START + stamp);
        }
        let found = match case.kind.as_str() {
            "hz" => intervals.report_at_second().unwrap().lines(),
            "bw" => sizes.report(START + case.now).unwrap().unwrap().lines(),
            _ => ages.lines().unwrap(),
        };
        assert_eq!(found, case.text, "{line}");
    }
}

fn named(names: &[&str]) -> Vec<Named> {
    names.iter().map(|name| Named::absolute(name)).collect()
}

fn present(topics: &[(&str, &str)]) -> Vec<(String, Vec<String>)> {
    let topics = topics.iter();
    topics
        .map(|(name, types)| ((*name).to_owned(), vec![(*types).to_owned()]))
        .collect()
}

fn at(milliseconds: i64) -> i64 {
    START + milliseconds * MILLISECOND
}

/// Adds messages at these times, each of 100 bytes and 2 ms of age. Returns the output.
fn messages(rates: &mut Rates, name: &str, times: impl IntoIterator<Item = i64>) -> String {
    for time in times {
        let header_stamp = Some(at(time - 2));
        let arrival = Arrival {
            time: at(time),
            size: 100,
            header_stamp,
        };
        rates.add_message(name, arrival).unwrap();
        rates.clock(at(time));
    }
    rates.take().out
}

#[test]
fn a_missing_topic_is_reported_once_and_awaited() {
    let topics = vec![Named {
        typed: "x".to_owned(),
        name: "/x".to_owned(),
    }];
    let mut rates = Rates::of(Quantity::Bandwidth, Dialect::Humble, 100, topics);
    rates.opened(&[]).unwrap();
    let warning = "WARNING: topic [x] does not appear to be published yet\n";
    assert_eq!(rates.take().out, warning);
    rates.clock(at(0));
    rates.clock(at(5000));
    assert_eq!(rates.take(), Output::default());
    rates.appeared("/x", &[STRING.to_owned()]).unwrap();
    rates.appeared("/x", &[STRING.to_owned()]).unwrap();
    assert_eq!(rates.take().out, "Subscribed to [x]\n");
    rates.clock(at(6000));
    messages(&mut rates, "/x", [6100, 6600]);
    // The seconds count from the time at which the topic appears.
    rates.clock(at(6999));
    assert_eq!(rates.take().out, "");
    rates.clock(at(7000));
    let text = "222 B/s from 2 messages\n\tMessage size mean: 100 B min: 100 B max: 100 B\n";
    assert_eq!(rates.take().out, text);
}

#[test]
fn hz_of_one_topic_prints_only_rates() {
    for (dialect, windows) in [
        (Dialect::Jazzy, ["201", "401", "601"]),
        (Dialect::Kilted, ["198", "398", "598"]),
    ] {
        let mut rates = Rates::of(Quantity::Rate, dialect, 10_000, named(&["/imu"]));
        let topics = present(&[("/imu", IMU), ("/other", STRING)]);
        rates.opened(&topics).unwrap();
        assert_eq!(rates.take().out, "");
        rates.clock(at(0));
        messages(&mut rates, "/other", [5]);
        let text = messages(&mut rates, "/imu", (1..=620).map(|step| step * 5));
        let report = |window| {
            format!(
                "average rate: 200.000\n\t\
                 min: 0.005s max: 0.005s std dev: 0.00000s window: {window}\n"
            )
        };
        assert_eq!(text, windows.map(report).concat());
    }
}

#[test]
fn silence_is_reported_by_dialect() {
    let reports = |quantity, dialect| {
        let mut rates = Rates::of(quantity, dialect, 100, named(&["/imu"]));
        rates.opened(&present(&[("/imu", IMU)])).unwrap();
        rates.clock(at(0));
        let mut text = messages(&mut rates, "/imu", [100, 200, 300]);
        rates.clock(at(3000));
        text.push_str(&rates.take().out);
        text
    };
    let bandwidth = |span: &str| format!("{span} B/s from 3 messages");
    for (dialect, decays) in [(Dialect::Kilted, true), (Dialect::Rolling, false)] {
        let text = reports(Quantity::Bandwidth, dialect);
        assert!(text.contains(&bandwidth("333")), "{text}");
        assert_eq!(text.contains(&bandwidth("158")), decays, "{text}");
        assert_eq!(text.contains(&bandwidth("103")), decays, "{text}");
    }
    for dialect in [Dialect::Humble, Dialect::Rolling] {
        let text = reports(Quantity::Delay, dialect);
        let expected = "average delay: 0.002\n\tmin: 0.002s max: 0.002s std dev: 0.00000s \
                        window: 2\nno new messages\nno new messages\n";
        assert_eq!(text, expected);
        let text = reports(Quantity::Rate, dialect);
        assert_eq!(
            text.lines().count(),
            if dialect == Dialect::Humble { 0 } else { 2 },
            "{text}"
        );
    }
}

#[test]
fn several_topics_share_a_table_without_silent_topics() {
    let mut rates = Rates::of(
        Quantity::Rate,
        Dialect::Kilted,
        100,
        named(&["/b", "/a", "/c"]),
    );
    rates
        .opened(&present(&[("/a", IMU), ("/b", STRING)]))
        .unwrap();
    let begin = "Subscribed to [/b]\nSubscribed to [/a]\n\
                 WARNING: topic [/c] does not appear to be published yet\n";
    assert_eq!(rates.take().out, begin);
    rates.clock(at(0));
    for step in 1..=9 {
        messages(&mut rates, "/a", [step * 100]);
        messages(&mut rates, "/b", [step * 100 + 10]);
    }
    rates.clock(at(1000));
    let both = "\
        topic    rate    min_delta   max_delta   std_dev   window\n\
        =========================================================\n\
        /b      10.000   0.100       0.100       0.00000   8     \n\
        /a      10.000   0.100       0.100       0.00000   8     \n\
        \n";
    assert_eq!(rates.take().out, both);
    messages(&mut rates, "/a", [1100]);
    rates.clock(at(2000));
    let table = rates.take().out;
    assert!(table.contains("/a  ") && !table.contains("/b"), "{table}");
    rates.clock(at(3000));
    assert_eq!(rates.take().out, "");
}

#[test]
fn each_bandwidth_of_several_topics_has_its_own_unit() {
    let mut rates = Rates::of(
        Quantity::Bandwidth,
        Dialect::Rolling,
        100,
        named(&["/a", "/b"]),
    );
    rates
        .opened(&present(&[("/a", IMU), ("/b", STRING)]))
        .unwrap();
    rates.clock(at(0));
    rates.take();
    messages(&mut rates, "/a", [0, 100]);
    for time in [0, 500] {
        let arrival = Arrival {
            time: at(time),
            size: 4096,
            header_stamp: None,
        };
        rates.add_message("/b", arrival).unwrap();
    }
    rates.clock(at(1000));
    let expected = "\
        topic   bandwidth   window     mean      min       max  \n\
        ========================================================\n\
        /a      200 B/s     2        100 B     100 B     100 B  \n\
        /b      8.19 KB/s   2        4.10 KB   4.10 KB   4.10 KB\n\
        \n";
    assert_eq!(rates.take().out, expected);
}

#[test]
fn all_topics_include_topics_that_appear_later() {
    let mut rates = Rates::of_all(Quantity::Rate, Dialect::Kilted, 100);
    rates
        .opened(&present(&[("/a", IMU), ("/b", STRING)]))
        .unwrap();
    let begin =
        "Subscribing to all 2 available topics...\nSubscribed to [/a]\nSubscribed to [/b]\n";
    assert_eq!(rates.take().out, begin);
    rates.clock(at(0));
    assert_eq!(rates.take().out, CLEAR_SCREEN);
    rates.appeared("/late", &[STRING.to_owned()]).unwrap();
    let text = messages(&mut rates, "/late", [100, 200]);
    assert_eq!(text, "Subscribed to [/late]\n");
    rates.clock(at(1000));
    let table = rates.take().out;
    assert!(
        table.starts_with(CLEAR_SCREEN) && table.contains("\n/late   10.000"),
        "{table}"
    );
}

#[test]
fn without_any_topic_the_command_ends() {
    let mut rates = Rates::of_all(Quantity::Rate, Dialect::Kilted, 100);
    assert_eq!(rates.opened(&[]), Err(End::Idle));
    assert_eq!(rates.take().out, "No topics available\n");
    let mut rates = Rates::of_all(Quantity::Delay, Dialect::Kilted, 100);
    assert_eq!(
        rates.opened(&present(&[("/chatter", STRING)])),
        Err(End::Idle)
    );
}

#[test]
fn a_topic_of_several_types_cannot_be_measured() {
    let mut rates = Rates::of(Quantity::Rate, Dialect::Jazzy, 100, named(&["/x"]));
    let types = vec!["a/msg/X".to_owned(), "b/msg/Y".to_owned()];
    let text = "Cannot echo topic '/x', as it contains more than one type: [a/msg/X, b/msg/Y]";
    let expected = Err(End::Refused(Refused(text.to_owned())));
    assert_eq!(rates.opened(&[("/x".to_owned(), types)]), expected);
}

#[test]
fn a_message_without_a_header_ends_the_measurement_of_a_delay() {
    let mut rates = Rates::of(Quantity::Delay, Dialect::Jazzy, 100, named(&["/chatter"]));
    rates.opened(&present(&[("/chatter", STRING)])).unwrap();
    let arrival = Arrival {
        time: at(0),
        size: 28,
        header_stamp: None,
    };
    let expected = Err(End::Refused(Refused("msg does not have header".to_owned())));
    assert_eq!(rates.add_message("/chatter", arrival), expected);
    assert_eq!(rates.take().out, "");
}

#[test]
fn messages_count_in_the_order_of_their_times() {
    let mut rates = Rates::of(Quantity::Rate, Dialect::Jazzy, 100, named(&["/imu"]));
    rates.opened(&present(&[("/imu", IMU)])).unwrap();
    // Each message of the second writer arrives after the next one of the first writer.
    for time in [
        0, 200, 100, 400, 300, 600, 500, 800, 700, 1000, 900, 1200, 1100, 1400,
    ] {
        let arrival = Arrival {
            time: at(time),
            size: 100,
            header_stamp: None,
        };
        rates.add_message("/imu", arrival).unwrap();
        rates.clock(at(time - 100));
    }
    let text = "average rate: 10.000\n\tmin: 0.100s max: 0.100s std dev: 0.00000s window: 11\n";
    assert_eq!(rates.take().out, text);
    rates.finish();
    assert_eq!(rates.take().out, "");
}

#[test]
fn messages_unseen_in_shared_memory_count_by_their_sequence_numbers() {
    let mut rates = Rates::of(Quantity::Rate, Dialect::Jazzy, 100, named(&["/imu"]));
    rates.opened(&present(&[("/imu", IMU)])).unwrap();
    // Ten messages a second are sent, and a third of them is seen.
    for step in 0..8 {
        let time = step * 300;
        let arrival = Arrival {
            time: at(time),
            size: 100,
            header_stamp: None,
        };
        let number = 7 + 3 * u64::try_from(step).unwrap();
        let origin = Origin {
            writer: "01",
            number,
            source_timestamp: Some(at(time)),
            is_sampled: true,
        };
        rates.arrived_from("/imu", arrival, origin).unwrap();
        rates.clock(at(time));
    }
    let output = rates.take();
    let report = "\tmin: 0.100s max: 0.100s std dev: 0.00000s window: ";
    let report = |window| format!("average rate: 10.000\n{report}{window}\n");
    assert_eq!(output.out, report(11) + &report(21));
    assert_eq!(
        output
            .err
            .matches("/imu is sampled in shared memory")
            .count(),
        1
    );
}

#[test]
fn a_sampled_rate_is_correct_in_the_first_report_despite_late_polls() {
    for dialect in [Dialect::Humble, Dialect::Kilted] {
        let mut rates = Rates::of(Quantity::Rate, dialect, 10_000, named(&["/imu"]));
        rates.opened(&present(&[("/imu", IMU)])).unwrap();
        rates.clock(at(0));
        let see = |rates: &mut Rates, number: u64, sent: Option<i64>, read: i64| {
            let arrival = Arrival {
                time: at(read),
                size: 100,
                header_stamp: None,
            };
            let origin = Origin {
                writer: "01",
                number,
                source_timestamp: sent.map(at),
                is_sampled: true,
            };
            rates.arrived_from("/imu", arrival, origin).unwrap();
            rates.clock(at(read));
        };
        // 200 Hz. The first poll finds old messages, and later ones are late by up to 0.4 s.
        for number in [1, 20, 80] {
            see(&mut rates, number, None, 400);
        }
        let numbers = (81..2_480).filter(|number| number % 7 < 3);
        let mut read = 400;
        for number in numbers {
            let sent = 5 * i64::try_from(number).unwrap();
            let delay = [1, 3, 400, 20][usize::try_from(number / 90 % 4).unwrap()];
            read = read.max(sent + delay);
            see(&mut rates, number, Some(sent), read);
        }
        let text = rates.take().out;
        let lines = text.lines().filter(|line| line.starts_with("average"));
        let lines: Vec<_> = lines.collect();
        assert!(lines.len() >= 10, "{text}");
        assert!(
            lines.iter().all(|line| *line == "average rate: 200.000"),
            "{text}"
        );
    }
}

#[test]
fn a_late_message_of_a_second_writer_causes_no_negative_interval() {
    for dialect in [Dialect::Jazzy, Dialect::Kilted] {
        let mut rates = Rates::of(Quantity::Rate, dialect, 10_000, named(&["/imu"]));
        rates.opened(&present(&[("/imu", IMU)])).unwrap();
        rates.clock(at(0));
        for step in 0..40 {
            let begin = 100 * step;
            for (writer, sent, read) in [("01", 60, 65), ("02", 40, 95)] {
                let arrival = Arrival {
                    time: at(begin + read),
                    size: 100,
                    header_stamp: None,
                };
                let origin = Origin {
                    writer,
                    number: u64::try_from(step + 1).unwrap(),
                    source_timestamp: Some(at(begin + sent)),
                    is_sampled: true,
                };
                rates.arrived_from("/imu", arrival, origin).unwrap();
                rates.clock(at(begin + read));
            }
        }
        let text = rates.take().out;
        let reports = text.matches("average rate: ").count();
        let in_order = text.matches("\tmin: 0.000s max: 0.100s ").count();
        assert!(reports >= 2 && in_order == reports, "{text}");
    }
}

#[test]
fn a_clock_step_of_minutes_causes_one_report_of_a_live_agent() {
    let reports = |is_live: bool| {
        let rates = Rates::of(Quantity::Bandwidth, Dialect::Humble, 100, named(&["/imu"]));
        let mut rates = if is_live { rates.live() } else { rates };
        rates.opened(&present(&[("/imu", IMU)])).unwrap();
        rates.clock(at(0));
        messages(&mut rates, "/imu", [100, 200]);
        rates.clock(at(300_000));
        rates.take().out.matches(" from 2 messages").count()
    };
    assert_eq!((reports(true), reports(false)), (1, 300));
}

#[test]
fn a_clock_step_forward_causes_one_report_and_a_step_back_a_warning() {
    let mut rates = Rates::of(Quantity::Bandwidth, Dialect::Humble, 100, named(&["/imu"]));
    rates.opened(&present(&[("/imu", IMU)])).unwrap();
    rates.clock(at(0));
    messages(&mut rates, "/imu", [100, 200]);
    rates.clock(at(400 * 24 * 3600 * 1000));
    assert_eq!(rates.take().out.matches(" from 2 messages").count(), 1);
    rates.clock(at(-60_000));
    rates.clock(at(-59_000));
    let output = rates.take();
    assert_eq!(
        (output.out.as_str(), output.err.as_str()),
        ("", "WARNING: time is reset!\n")
    );
    messages(&mut rates, "/imu", [-58_900, -58_800]);
    rates.clock(at(-58_000));
    assert!(rates.take().out.starts_with("222 B/s from 2 messages\n"));
}
