//! `rp topic`, `rp node`, `rp service` and `rp action` print the output of ros2cli, from an agent
//! and from a capture. They work together with other tools.

mod echo;
mod graph;
mod rates;
mod tools;

use std::io::{Read as _, Write as _};
use std::net::TcpListener;
use std::os::unix::net::UnixListener;
use std::process::Output;

use crate::rp;
use ros2probe_testing::local_agent::{self, LocalAgent};
use ros2probe_testing::ports::free_address;

pub fn run(arguments: &[&str]) -> Output {
    let mut rp = rp();
    rp.env_remove("ROS_DOMAIN_ID").env_remove("ROS_DISTRO");
    rp.args(arguments).output().unwrap()
}

pub fn stdout(output: &Output) -> String {
    String::from_utf8(output.stdout.clone()).unwrap()
}

pub fn stderr(output: &Output) -> String {
    String::from_utf8(output.stderr.clone()).unwrap()
}

/// Asserts that the command fails with exit code 1 and with one line that has this part.
fn fails_with(output: &Output, part: &str) {
    let printed = stderr(output);
    assert_eq!(output.status.code(), Some(1), "{printed}");
    assert_eq!(printed.lines().count(), 1, "{printed}");
    assert!(printed.contains(part), "`{part}` is not in {printed}");
}

#[test]
fn an_agent_and_its_capture_lead_to_the_same_output() {
    let capture = graph::own().join("graph.pcap.gz");
    let mut agent = LocalAgent::replay(&mut rp(), &capture, &["--speed", "max"]);
    agent.wait_for_log("the capture has ended");
    let capture = capture.to_str().unwrap();
    let host = agent.api.to_string();
    for words in [
        "topic list -v",
        "topic info -v /rosout",
        "topic find std_msgs/msg/String",
        "node list -a",
        "node info --include-hidden /robot1/sensor_node",
        "node info /nope",
        "service list -t",
        "service info /robot1/add_two_ints",
        "action info -t /robot1/fibonacci",
        "action type /nope",
    ] {
        let words: Vec<&str> = words.split(' ').collect();
        let asked = run(&[&words[..], &["--host", &host]].concat());
        let replayed = run(&[&words[..], &["--replay", capture]].concat());
        assert_eq!(asked, replayed, "{words:?}");
    }
    let elsewhere = run(&["topic", "list", "--host", &host, "--domain", "7"]);
    assert_eq!(
        (stdout(&elsewhere).as_str(), elsewhere.status.code()),
        ("", Some(0))
    );
    assert!(
        stderr(&elsewhere).contains("`--domain N`"),
        "{}",
        stderr(&elsewhere)
    );
}

#[test]
fn a_token_or_the_socket_gives_access_to_an_agent() {
    let directory = tempfile::tempdir().unwrap();
    let file = |name: &str, text: &str| {
        let path = directory.path().join(name);
        std::fs::write(&path, text).unwrap();
        path.to_str().unwrap().to_owned()
    };
    let token = file("token", "0123456789abcdef\n");
    let wrong = file("wrong", "0123456789abcdeg\n");
    let socket = directory.path().join("api.sock");
    let socket = socket.to_str().unwrap();
    let settings = format!("api: {{token_file: {token}, socket: {socket}}}\n");
    let config = file("ros2probe.yaml", &settings);
    let agent = LocalAgent::start(&mut rp(), &["--config", &config, "--speed", "max"]);
    let host = agent.api.to_string();
    let list = |words: &[&str]| run(&[&["topic", "list"], words].concat());
    for words in [
        &["--host", &host, "--token-file", &token][..],
        &["--socket", socket],
    ] {
        let listed = list(words);
        assert_eq!(listed.status.code(), Some(0), "{}", stderr(&listed));
    }
    fails_with(&list(&["--host", &host]), "ROS2PROBE_TOKEN_FILE");
    let wrong = list(&["--host", &host, "--token-file", &wrong]);
    fails_with(&wrong, "does not accept this token");
    let mut rp = rp();
    rp.env("ROS2PROBE_TOKEN_FILE", &token);
    let listed = rp
        .args(["topic", "list", "--host", &host])
        .output()
        .unwrap();
    assert_eq!(listed.status.code(), Some(0), "{}", stderr(&listed));
}

/// Starts a server that answers every connection with these bytes, and returns its address.
fn answering(answer: &'static [u8]) -> String {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap().to_string();
    std::thread::spawn(move || {
        for stream in listener.incoming() {
            let mut stream = stream.unwrap();
            let _ = stream.read(&mut [0; 4096]);
            let _ = stream.write_all(answer);
        }
    });
    address
}

#[test]
fn an_unreachable_agent_is_reported_in_one_line() {
    let ask = |host: &str| run(&["topic", "list", "--host", host]);
    fails_with(&ask(&free_address().to_string()), "connection refused");
    fails_with(
        &ask(&answering(b"SSH-2.0-OpenSSH_9.6\r\n")),
        "is not a ros2probe agent",
    );
    let page = b"HTTP/1.1 404 Not Found\r\ncontent-length: 4\r\n\r\noops";
    fails_with(&ask(&answering(page)), "is not a ros2probe agent");
    let problem = b"HTTP/1.1 404 Not Found\r\nconnection: close\r\n\r\n\
        {\"type\":\"urn:ros2probe:problem:not-found\",\"detail\":\"\"}";
    fails_with(&ask(&answering(problem)), "has no /names");
    let problem = b"HTTP/1.1 401 Unauthorized\r\nconnection: close\r\n\r\n\
        {\"type\":\"urn:ros2probe:problem:unauthorized\",\"detail\":\"\"}";
    fails_with(&ask(&answering(problem)), "`--token-file FILE`");

    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("api.sock");
    drop(UnixListener::bind(&path).unwrap());
    let path = path.to_str().unwrap();
    fails_with(&run(&["topic", "list", "--socket", path]), path);
    fails_with(
        &run(&["topic", "list", "--token-file", path]),
        "cannot read the token",
    );
}

#[test]
fn options_take_precedence_over_ros_distro_and_ros_domain_id() {
    let capture = graph::own().join("graph.pcap.gz");
    let info = |distro: &str, domain: &str, further: &[&str]| {
        let mut rp = rp();
        rp.env("ROS_DISTRO", distro).env("ROS_DOMAIN_ID", domain);
        rp.args(["topic", "info", "-v", "/chatter", "--replay"]);
        rp.arg(&capture).args(further).output().unwrap()
    };
    let has_hash = |output: &Output| stdout(output).contains("\nTopic type hash: ");
    assert!(!has_hash(&info("humble", "0", &[])));
    assert!(has_hash(&info("humble", "", &["--distro", "lyrical"])));
    assert!(has_hash(&info("unheard-of", "", &[])));
    assert_eq!(
        stderr(&info("jazzy", "3", &[])),
        "Unknown topic '/chatter'\n"
    );
    assert!(has_hash(&info("jazzy", "3", &["--domain", "0"])));
    fails_with(&info("jazzy", "three", &[]), "ROS_DOMAIN_ID is `three`");
}

#[test]
fn a_command_without_a_verb_prints_its_help() {
    for arguments in [&[][..], &["topic"]] {
        let output = run(arguments);
        assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
        assert!(stdout(&output).contains("Usage: rp"), "{}", stdout(&output));
    }
    let wrong = run(&["topic", "list", "--no-such-option"]);
    assert_eq!(
        (stdout(&wrong).as_str(), wrong.status.code()),
        ("", Some(2))
    );
}

#[test]
fn a_capture_is_listed_up_to_the_requested_time() {
    let capture = local_agent::capture();
    let capture = capture.to_str().unwrap();
    let list = |further: &[&str]| {
        let listed = run(&[&["topic", "list", "--replay", capture], further].concat());
        assert_eq!(listed.status.code(), Some(0), "{}", stderr(&listed));
        (stdout(&listed), stderr(&listed))
    };
    let (none, printed) = list(&["-c", "--until", "+0"]);
    assert_eq!(none, "0\n");
    assert_eq!(
        printed,
        "rp: 1 participant is known, but none of its topics: a participant that is alone announces \
         none\n"
    );
    let whole = list(&[]);
    let (names, printed) = &whole;
    assert_eq!(printed, "");
    assert!(names.contains("/rosout\n"), "{names}");
    assert_eq!(list(&["--until", "+86400"]), whole);

    let missing = run(&["topic", "list", "--replay", "/nowhere.pcap"]);
    fails_with(&missing, "cannot replay /nowhere.pcap");
    let wrong = run(&["topic", "list", "--replay", capture, "--until", "noon"]);
    assert_eq!(wrong.status.code(), Some(2));
}

#[test]
fn a_truncated_capture_is_listed_up_to_the_cut_with_a_warning() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("cut.pcap.gz");
    let whole = std::fs::read(local_agent::capture()).unwrap();
    std::fs::write(&path, &whole[..whole.len() - 100]).unwrap();
    let listed = run(&["topic", "list", "--replay", path.to_str().unwrap()]);
    assert_eq!(listed.status.code(), Some(0));
    assert!(stdout(&listed).contains("/rosout\n"), "{}", stdout(&listed));
    assert!(
        stderr(&listed).contains("cut.pcap.gz is incomplete: the capture is cut off"),
        "{}",
        stderr(&listed)
    );
}
