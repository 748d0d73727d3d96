//! `rp top` on a pseudo-terminal with a real agent: the screen, the effect of keys, and the
//! terminal after every kind of end.

use std::time::{Duration, Instant};

use crate::recordings::long_capture;
use crate::rp;
use ros2probe_testing::local_agent::{LocalAgent, PATIENCE, capture, request};
use ros2probe_testing::pseudo_terminal::Terminal;

const TOPIC: &str = "/chatter";

/// Returns an agent that has replayed a whole capture and measured everything.
fn agent() -> LocalAgent {
    let mut agent = LocalAgent::start(&mut rp(), &["--speed", "max", "--watch", "/**"]);
    agent.wait_for_log("the capture has ended");
    agent
}

fn top(agent: &LocalAgent, arguments: &[&str]) -> Terminal {
    let mut command = rp();
    command
        .args(["top", "--host", &agent.api.to_string()])
        .args(arguments)
        .env("TERM", "xterm")
        .env("LC_ALL", "C");
    Terminal::start(&mut command)
}

fn wait_until(holds: impl Fn() -> bool) {
    let deadline = Instant::now() + PATIENCE;
    while !holds() {
        assert!(Instant::now() < deadline, "it does not come");
        std::thread::sleep(Duration::from_millis(50));
    }
}

#[test]
fn rp_top_reacts_to_keys_and_restores_the_terminal() {
    let agent = agent();
    let mut top = top(&agent, &[]);
    top.wait_for(TOPIC);
    top.wait_for("agent has replayed its capture to the end");
    top.press("?");
    top.wait_for("any key: back");
    top.press("?");
    top.press("/chat\r");
    top.wait_for("only \"chat\": 1 shown");
    top.wait_for(&format!("> {TOPIC}"));
    top.press("\r");
    top.wait_for("between messages: median");
    top.press("e");
    top.wait_for("INFO  participant.lost");
    top.resize(30, 5);
    top.wait_for("rp top needs 40x8");
    top.resize(120, 40);
    top.wait_for("1 subscriber");
    top.press("q");
    assert_eq!(top.ends(), Some(0));
    top.assert_given_back();
}

#[test]
fn a_signal_and_control_c_without_an_agent_restore_the_terminal() {
    let agent = agent();
    for (signal, code) in [("-TERM", 143), ("-INT", 130)] {
        let mut top = top(&agent, &[]);
        top.wait_for(TOPIC);
        top.signal(signal);
        assert_eq!(top.ends(), Some(code));
        top.assert_given_back();
    }
    let mut top = top(&agent, &["--interval", "0.2"]);
    top.wait_for(TOPIC);
    drop(agent);
    top.wait_for("AGENT GONE");
    top.wait_for("retrying");
    // The last known values stay on the screen, and keys work.
    assert!(top.screen().contains(TOPIC), "{}", top.screen());
    top.press("?");
    top.wait_for("any key: back");
    top.press("?");
    top.wait_for("AGENT GONE");
    top.press("\x03");
    assert_eq!(top.ends(), Some(0));
    top.assert_given_back();
}

#[test]
fn a_signal_ends_rp_top_while_the_terminal_accepts_no_output() {
    let agent = agent();
    let mut top = top(&agent, &["--interval", "0.1"]);
    top.wait_for(TOPIC);
    top.stop_output();
    top.press("e?");
    std::thread::sleep(Duration::from_millis(300));
    top.signal("-TERM");
    assert_eq!(top.ends(), Some(143));
    top.assert_settings_given_back();
}

#[test]
fn rp_top_reconnects_to_a_restarted_agent() {
    let directory = tempfile::tempdir().unwrap();
    let socket = directory.path().join("api.sock");
    let config = directory.path().join("config.yaml");
    let text = format!("api: {{socket: {}}}\n", socket.display());
    std::fs::write(&config, text).unwrap();
    let start = || {
        let config = config.to_str().unwrap();
        let mut agent = LocalAgent::start(&mut rp(), &["--speed", "max", "--config", config]);
        agent.wait_for_log("the capture has ended");
        agent
    };
    let agent = start();
    let mut command = rp();
    command
        .args(["top", "--interval", "0.2", "--socket"])
        .arg(&socket)
        .env("TERM", "xterm");
    let mut top = Terminal::start(&mut command);
    top.wait_for(TOPIC);
    drop(agent);
    top.wait_for("AGENT GONE");
    let _agent = start();
    top.wait_for("agent has replayed");
    assert!(!top.screen().contains("GONE"), "{}", top.screen());
    top.press("q");
    assert_eq!(top.ends(), Some(0));
}

#[test]
fn a_topic_is_measured_on_request_until_rp_top_ends() {
    let capture = long_capture();
    let agent = LocalAgent::replay(&mut rp(), &capture, &["--speed", "1"]);
    let is_measured = || {
        let topic = request(agent.api, "GET", &format!("/topics{TOPIC}"), "").body;
        let topic: serde_json::Value = serde_json::from_str(&topic).unwrap();
        let publisher = &topic["publishers"][0];
        assert!(publisher.is_object(), "{topic}");
        publisher["measurement"].is_object()
    };
    let mut top = top(&agent, &["--filter", TOPIC]);
    top.wait_for(&format!("> {TOPIC}"));
    top.wait_for("  1/");
    assert!(top.screen().contains("unwatched"), "{}", top.screen());
    assert!(!is_measured());
    top.press("w");
    top.wait_for(&format!(">+{TOPIC}"));
    wait_until(is_measured);
    top.signal("-KILL");
    assert_eq!(top.ends(), None);
    wait_until(|| !is_measured());
    let watches = request(agent.api, "GET", "/watch", "").body;
    assert_eq!(
        watches.replace(char::is_whitespace, ""),
        r#"{"watches":[]}"#
    );
}

#[test]
fn with_once_rp_top_prints_a_table_without_a_terminal() {
    let output = |agent: &[&str], arguments: &[&str]| {
        let mut command = rp();
        command.arg("top").args(arguments).args(agent);
        let output = command.output().unwrap();
        let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
        (
            output.status.code(),
            text(output.stdout),
            text(output.stderr),
        )
    };
    let agent = agent();
    let address = agent.api.to_string();
    let live = ["--host", &address];
    let (code, table, printed) = output(&live, &["--once", "--sort", "rate"]);
    assert_eq!((code, printed.as_str()), (Some(0), ""));
    let lines: Vec<_> = table.lines().map(str::trim_end).collect();
    assert!(lines[0].starts_with("rp top  "), "{table}");
    let heading = lines
        .iter()
        .position(|line| line.starts_with("TOPIC "))
        .unwrap();
    assert!(
        lines[heading + 1..]
            .iter()
            .any(|line| line.starts_with(TOPIC)),
        "{table}"
    );
    assert!(!table.contains('\x1b'), "{table}");

    let (_, filtered, _) = output(&live, &["--batch", "--filter", "CHAT"]);
    assert!(
        filtered.lines().last().unwrap().starts_with(TOPIC),
        "{filtered}"
    );

    // A capture leads to the same table without an agent.
    let capture = capture();
    let replayed = ["--replay", capture.to_str().unwrap()];
    let (code, from_capture, printed) = output(&replayed, &["--once", "--sort", "rate"]);
    assert_eq!((code, printed.as_str()), (Some(0), ""));
    let rows = |table: &str| {
        let lines = table.lines().skip_while(|line| !line.starts_with("TOPIC "));
        lines.map(ToOwned::to_owned).collect::<Vec<_>>()
    };
    assert_eq!(rows(&from_capture), rows(&table));

    let (code, _, printed) = output(&live, &[]);
    assert_eq!(code, Some(1));
    assert!(
        printed.contains("needs a terminal") && printed.lines().count() == 1,
        "{printed}"
    );
}

#[test]
fn a_capture_is_shown_during_its_replay() {
    let mut command = rp();
    command
        .args(["top", "--speed", "4", "--replay"])
        .arg(capture())
        .env("TERM", "xterm");
    let mut top = Terminal::start(&mut command);
    top.wait_for("agent replays a capture");
    top.wait_for(TOPIC);
    top.wait_for("agent has replayed its capture to the end");
    top.press("q");
    assert_eq!(top.ends(), Some(0));
    top.assert_given_back();
}
