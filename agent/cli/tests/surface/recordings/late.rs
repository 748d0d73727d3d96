//! Agents that started after the robot. The writers are known, but not their topics.

use super::*;

/// Writes a capture of ten minutes with an announced and an unannounced writer, each at 10 Hz.
fn late_robot(path: &Path) {
    let (known, unknown) = (writer(ALICE, 0), writer(ALICE, 1));
    let mut capture = Capture::new(ETHERNET);
    capture.participant(START, 0, ALICE);
    capture.writer(START, 0, known, "rt/whole", 1);
    for number in 1..=6_000 {
        let time = START + number * SECOND / 10;
        capture.sample(time, 0, known, number);
        capture.sample(time + 1_000_000, 0, unknown, number);
    }
    capture.write(path);
}

fn late_agent(directory: &Path) -> LocalAgent {
    let capture = directory.join("late.pcap");
    late_robot(&capture);
    let agent = LocalAgent::replay(&mut rp(), &capture, &["--speed", "1"]);
    agent.wait_for_metric("ros2_unknown_writers", |writers| writers == 1.0);
    agent
}

const MISSED: &str = "1 writer is active whose announcement was missed; its topic is unknown";
const REMEDY: &str = "`sudo rp discover --all` requests their announcements";

/// Earlier, a recording printed the reason for an empty bag only at Ctrl-C.
#[test]
fn a_recording_warns_early_and_repeatedly_of_writers_without_a_topic() {
    let directory = tempfile::tempdir().unwrap();
    let agent = late_agent(directory.path());
    let mut recording = Recording::start(agent.api, &directory.path().join("bag"), &[]);
    recording.wait_for("Recording...");
    let first = recording.wait_for(&format!("not recorded: {MISSED}"));
    assert!(first < Duration::from_secs(30), "{first:?}");
    let line = recording.printed.last().unwrap();
    assert!(line.contains("[WARN]") && line.ends_with(REMEDY), "{line}");
    let again = recording.wait_for("not recorded: 1 writer is active");
    assert!(again > Duration::from_secs(5), "{again:?}");
    recording.signal("-INT");
    let (status, _) = recording.end();
    assert_eq!(status.code(), Some(0), "{:#?}", recording.printed);

    // In a recording of known topics, nothing is missing.
    let mut command = rp();
    command.args(["bag", "record", "--host", &agent.api.to_string(), "-o"]);
    command.arg(directory.path().join("whole")).arg("/whole");
    let mut recording = Recording::of(&mut command);
    recording.wait_for("Subscribed to topic '/whole'");
    std::thread::sleep(Duration::from_secs(3));
    recording.signal("-INT");
    recording.wait_for("Completing the bag");
    assert!(
        recording.printed.iter().all(|line| !line.contains(MISSED)),
        "{:#?}",
        recording.printed
    );
}

/// Earlier, every request about a known topic printed the hint about missed announcements.
#[test]
fn the_hint_about_missed_announcements_is_printed_only_without_an_answer() {
    let directory = tempfile::tempdir().unwrap();
    let agent = late_agent(directory.path());
    let run_rp = |arguments: &[&str]| {
        let mut command = rp();
        command
            .args(arguments)
            .args(["--host", &agent.api.to_string()]);
        command.env_remove("ROS_DISTRO").env_remove("ROS_DOMAIN_ID");
        let output = command.output().unwrap();
        let text = |bytes| String::from_utf8(bytes).unwrap();
        (text(output.stdout), text(output.stderr))
    };
    let kind = "std_msgs/msg/String";
    for (arguments, answer) in [
        (&["topic", "type", "/whole"][..], format!("{kind}\n")),
        (&["topic", "find", kind], "/whole\n".to_owned()),
        (&["topic", "find", kind, "-c"], "1\n".to_owned()),
    ] {
        assert_eq!(run_rp(arguments), (answer, String::new()), "{arguments:?}");
    }
    let (info, hint) = run_rp(&["topic", "info", "/whole"]);
    assert!(info.contains(kind) && hint.is_empty(), "{info}{hint}");
    let hint = format!("rp: {MISSED}: the agent started after them; {REMEDY}\n");
    for arguments in [
        &["topic", "list"][..],
        &["topic", "type", "/other"],
        &["topic", "info", "/other"],
        &["topic", "find", "sensor_msgs/msg/Image"],
        &["topic", "find", "sensor_msgs/msg/Image", "-c"],
        &["node", "list"],
        &["node", "info", "/other"],
        &["service", "list"],
        &["service", "type", "/other"],
        &["service", "find", "std_srvs/srv/Empty"],
        &["action", "list"],
        &["action", "type", "/other"],
    ] {
        let (_, stderr) = run_rp(arguments);
        assert!(stderr.contains(&hint), "{arguments:?}: {stderr}");
        assert_eq!(stderr.matches(MISSED).count(), 1, "{arguments:?}: {stderr}");
    }
    // The agent names the command, and its clients repeat it.
    for path in ["/names", "/health"] {
        let (_, answer) = ask_api(&agent, path);
        assert!(
            answer.contains("sudo rp discover --all"),
            "{path}: {answer}"
        );
    }
}

fn ask_api(agent: &LocalAgent, path: &str) -> (u16, String) {
    let (status, answer) = local_agent::call_api(agent.api, "GET", path, "");
    (status, answer.to_string())
}
