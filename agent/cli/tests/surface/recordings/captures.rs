//! Captures that begin late, are truncated or have silent topics, as `rp` converts and echoes them.

use super::*;

const BOB: GuidPrefix = GuidPrefix(*b"\x01\x10bobby-host");

const ONE: GuidPrefix = GuidPrefix(*b"\x01\x10oneproc-ss");

/// Writes a capture that begins late and has more than one domain.
fn with_omissions(path: &Path) {
    let mut capture = Capture::new(ETHERNET);
    let at = |milliseconds: u64| START + milliseconds * 1_000_000;
    let (late, whole, never) = (writer(ALICE, 0), writer(ALICE, 1), writer(ALICE, 2));
    capture.participant(at(0), 0, ALICE);
    capture.writer(at(1), 0, whole, "rt/whole", 1);
    for number in 1..=10 {
        capture.sample(at(10 * number), 0, whole, number);
        capture.sample(at(10 * number + 1), 0, late, number);
        capture.sample(at(10 * number + 2), 0, never, number);
    }
    capture.writer(at(500), 0, late, "rt/late", 2);
    for number in 11..=15 {
        capture.sample(at(500 + 10 * number), 0, late, number);
    }
    // The writer and the reader of this process exchange nothing over the network.
    capture.participant(at(700), 0, ONE);
    capture.writer(at(710), 0, writer(ONE, 0), "rt/inside", 1);
    capture.reader(at(711), 0, reader(ONE, 0), "rt/inside", 1);
    capture.participant(at(720), 7, BOB);
    capture.writer(at(721), 7, writer(BOB, 0), "rt/imu", 1);
    for number in 1..=4 {
        capture.sample(at(730 + 10 * number), 7, writer(BOB, 0), number);
    }
    capture.sample(at(2000), 0, whole, 11);
    capture.write(path);
}

#[test]
fn missing_messages_of_a_late_capture_are_counted_and_change_the_exit_code() {
    let directory = tempfile::tempdir().unwrap();
    let capture = directory.path().join("late.pcap");
    with_omissions(&capture);
    let bag = directory.path().join("bag");
    let (code, printed, report) = converted(&capture, &bag, &[]);
    let topics = &report["topics"];
    assert_eq!(topics["/whole"]["messages"], 11, "{printed}");
    assert_eq!(topics["/late"]["messages"], 5, "{printed}");
    assert_eq!(topics["/late"]["unannounced"], 10, "{printed}");
    assert_eq!(report["missing"], 10, "{report:#}");
    let unknown = serde_json::json!({"writers": 1, "messages": 10});
    assert_eq!(report["unknown_writers"], unknown);
    let unobserved = serde_json::json!({"/inside": "same_process"});
    assert_eq!(report["unobserved"], unobserved, "{printed}");
    let others = serde_json::json!([{"domain_id": 7, "topics": 1, "messages": 4}]);
    assert_eq!(report["other_domains"], others);
    assert_eq!(code, Some(3), "{printed}");
    let last = printed.lines().last().unwrap();
    assert!(
        last.contains("some sent messages are not in the bag"),
        "{printed}"
    );
    assert!(!printed.contains("stdin"), "{printed}");
    for line in [
        "/late: 5 of 15 messages recorded; 10 sent before their writer was announced",
        "/inside: no message recorded; publisher and subscriber share one process",
        "not recorded: 10 messages of 1 unknown writer whose announcement was missed",
        "not recorded: 1 topic of domain 7 with 4 messages (`--domain 7`)",
    ] {
        assert!(printed.contains(line), "`{line}` is not in {printed}");
    }

    let bag = directory.path().join("other");
    let (code, printed, report) = converted(&capture, &bag, &["--domain", "7"]);
    assert_eq!(report["topics"]["/imu"]["messages"], 4, "{printed}");
    assert_eq!(report["other_domains"][0]["domain_id"], 0);
    assert_eq!(code, Some(3), "{printed}");
}

#[test]
fn the_conversion_of_a_complete_capture_ends_with_exit_code_0() {
    let directory = tempfile::tempdir().unwrap();
    let capture = directory.path().join("many.pcap");
    many_topics(&capture);
    let (code, printed, report) = converted(&capture, &directory.path().join("bag"), &[]);
    assert_eq!(
        (code, &report["missing"]),
        (Some(0), &Value::from(0)),
        "{printed}"
    );
    assert_eq!(report["messages"], 59 * MANY);
    assert!(
        printed
            .lines()
            .last()
            .unwrap()
            .ends_with("Recording stopped"),
        "{printed}"
    );
}

#[test]
fn a_truncated_capture_is_converted_up_to_the_cut_and_changes_the_exit_code() {
    let directory = tempfile::tempdir().unwrap();
    let (whole, cut) = (
        directory.path().join("many.pcap"),
        directory.path().join("cut.pcap"),
    );
    many_topics(&whole);
    let bytes = std::fs::read(&whole).unwrap();
    std::fs::write(&cut, &bytes[..bytes.len() / 2]).unwrap();
    let (code, printed, report) = converted(&cut, &directory.path().join("bag"), &[]);
    assert_eq!(code, Some(3), "{printed}");
    assert!(report["messages"].as_u64() > Some(1000), "{printed}");
    assert!(printed.contains("cut.pcap is incomplete: "), "{printed}");
}

#[test]
fn an_unsupported_link_type_is_an_error_and_not_an_empty_graph() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("wifi.pcap");
    let mut capture = Capture::new(127);
    capture.frame(START, &[0; 60]);
    capture.write(&path);
    let capture = path.to_str().unwrap();
    let bag = directory.path().join("bag");
    for arguments in [
        &["topic", "list", "--replay", capture][..],
        &["topic", "echo", "/a", "--replay", capture],
        &["topic", "hz", "/a", "--replay", capture],
        &["node", "list", "--replay", capture],
        &["bag", "convert", capture, bag.to_str().unwrap()],
        &["run", "--report", "--replay", capture],
    ] {
        let output = rp().args(arguments).output().unwrap();
        let printed = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(1), "{arguments:?}: {printed}");
        assert!(
            printed.contains("link type 127 (802.11 with radiotap header)"),
            "{printed}"
        );
        assert!(output.stdout.is_empty(), "{arguments:?}");
    }
    assert!(!bag.exists());
}

/// Writes a capture with a topic within one participant, a topic without a subscriber, and a writer
/// that is never announced.
fn with_silence(path: &Path) {
    let mut capture = Capture::new(ETHERNET);
    let at = |milliseconds: u64| START + milliseconds * 1_000_000;
    for (prefix, number) in [(ALICE, 0), (ONE, 1)] {
        capture.participant(at(number), 0, prefix);
    }
    capture.writer(at(10), 0, writer(ONE, 0), "rt/inside", 1);
    capture.reader(at(11), 0, reader(ONE, 0), "rt/inside", 1);
    capture.writer(at(12), 0, writer(ONE, 1), "rt/alone", 2);
    for number in 1..=600 {
        capture.sample(at(100 * number), 0, writer(ALICE, 0), number);
    }
    capture.write(path);
}

#[test]
fn a_silent_topic_is_explained_once_on_stderr() {
    let directory = tempfile::tempdir().unwrap();
    let capture = directory.path().join("silent.pcap");
    with_silence(&capture);
    let inside = "rp: no message on /inside: publisher and subscriber share one process; nothing \
                  crosses the network";
    let alone = "rp: no message on /alone: no subscriber exists, so nothing is sent; rp does not \
                 subscribe: start a subscriber";
    let unknown = "rp: no message on /nothing: no endpoint on /nothing";
    for (verb, topic, why) in [
        ("echo", "/inside", inside),
        ("hz", "/inside", inside),
        ("bw", "/inside", inside),
        ("delay", "/inside", inside),
        ("hz", "/alone", alone),
        ("echo", "/alone", alone),
        ("bw", "/alone", alone),
        ("delay", "/alone", alone),
        ("hz", "/nothing", unknown),
    ] {
        let mut command = rp();
        command
            .args(["topic", verb, topic, "--replay"])
            .arg(&capture);
        let output = command.env_remove("ROS_DOMAIN_ID").output().unwrap();
        let printed = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(printed.matches(why).count(), 1, "{verb} {topic}: {printed}");
        let out = String::from_utf8(output.stdout).unwrap();
        assert!(!out.contains("subscriber"), "{verb}: {out}");
    }

    // Commands that keep running print the reason once, after some seconds.
    let agent = LocalAgent::replay(&mut rp(), &capture, &["--speed", "1"]);
    agent.wait_for_metric("ros2_topics{domain_id=\"0\",kind=\"topic\"}", |topics| {
        topics == 2.0
    });
    let api = agent.api.to_string();
    let mut running: Vec<_> = ["echo", "hz", "bw", "delay"]
        .into_iter()
        .map(|verb| {
            let mut command = rp();
            command.args(["topic", verb, "/inside", "--host", &api]);
            Recording::of(command.stdout(Stdio::null()))
        })
        .collect();
    let bag = directory.path().join("bag");
    let mut recording = Recording::start(agent.api, &bag, &["/missing"]);
    for verb in &mut running {
        verb.wait_for(inside);
    }
    recording.wait_for("/alone: no message recorded; no subscriber exists, so nothing is sent");
    recording.wait_for("/inside: no message recorded; publisher and subscriber share one process");
    recording.wait_for("/missing has no known publisher");
    std::thread::sleep(Duration::from_secs(2));
    for verb in running {
        assert!(verb.lines.try_recv().is_err(), "{:?}", verb.printed);
    }
}

#[test]
fn a_capture_without_announcements_leads_to_a_hint_beside_the_known_topics() {
    let directory = tempfile::tempdir().unwrap();
    let (silent, lonely) = (
        directory.path().join("a.pcap"),
        directory.path().join("b.pcap"),
    );
    with_silence(&silent);
    let mut capture = Capture::new(ETHERNET);
    for number in 0..12 {
        let prefix = [&[1, 16][..], &[number; 10]].concat();
        capture.participant(START, 0, GuidPrefix(prefix.try_into().unwrap()));
    }
    capture.write(&lonely);
    for (capture, names, printed) in [
        (
            &silent,
            "/alone\n/inside\n",
            "rp: 1 writer is active whose announcement was missed",
        ),
        (
            &lonely,
            "",
            "rp: 12 participants are known, but none of their topics",
        ),
    ] {
        let mut command = rp();
        command.args(["topic", "list", "--replay"]).arg(capture);
        let output = command.env_remove("ROS_DOMAIN_ID").output().unwrap();
        let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(String::from_utf8_lossy(&output.stdout), names);
        assert_eq!(
            (stderr.lines().count(), stderr.starts_with(printed)),
            (1, true),
            "{stderr}"
        );
    }
}

#[test]
fn a_truncated_capture_is_echoed_up_to_the_cut_with_an_error_about_the_capture() {
    let directory = tempfile::tempdir().unwrap();
    let (whole, cut) = (
        directory.path().join("a.pcap"),
        directory.path().join("b.pcap"),
    );
    many_topics(&whole);
    let bytes = std::fs::read(&whole).unwrap();
    std::fs::write(&cut, &bytes[..bytes.len() / 2]).unwrap();
    for verb in ["echo", "hz", "bw"] {
        let mut command = rp();
        command
            .args(["topic", verb, "/topic1", "--replay"])
            .arg(&cut);
        let output = command.env_remove("ROS_DOMAIN_ID").output().unwrap();
        let printed = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(1), "{verb}: {printed}");
        assert_eq!(
            printed.matches("b.pcap is incomplete: ").count(),
            1,
            "{verb}: {printed}"
        );
        assert!(!printed.contains("agent"), "{verb}: {printed}");
        assert!(!output.stdout.is_empty(), "{verb}");
    }
}
