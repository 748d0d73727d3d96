//! The agent as the daemon of the `ros2` command line, with a replayed capture of ROS 2 Humble. The
//! tests use Python's own XML-RPC client, and check the states of the port and refused requests.
//!
//! The port of domain 0 exists once on a host, so these tests run one after the other (nextest's
//! group).

use std::fs;
use std::io::{ErrorKind, Read as _, Write as _};
use std::net::{Ipv4Addr, SocketAddr, TcpListener, TcpStream};
use std::process::Command;
use std::time::{Duration, Instant};

use ros2probe_testing::local_agent::{Answer, LocalAgent, PATIENCE, metric};
use ros2probe_testing::repository;
use serde_json::Value;
use tempfile::TempDir;

use crate::rp;

/// Port of domain 0, which the capture uses.
const DAEMON: SocketAddr = SocketAddr::new(std::net::IpAddr::V4(Ipv4Addr::LOCALHOST), 11_511);
const LISTENING: &str = "ros2probe_ros2_daemon_ports{state=\"listening\"}";
/// Replay speed. In the capture, all nodes are known after 1 s and end after 8 s.
const SPEED: &str = "0.25";
/// Maximum number of simultaneous connections (`MAX_CLIENTS`).
const MAX_CLIENTS: usize = 16;

/// An agent with a configuration file, which a test may change.
struct Daemon {
    agent: LocalAgent,
    directory: TempDir,
}

impl Daemon {
    /// Starts an agent with this value of `ros2_daemon`.
    fn start(setting: &str) -> Self {
        let directory = tempfile::tempdir().unwrap();
        let configuration = directory.path().join("ros2probe.yaml");
        fs::write(&configuration, format!("ros2_daemon: {setting}\n")).unwrap();
        let capture = repository("wire/tests/data").join("cyclonedds-samehost-any.pcap.gz");
        let configuration = configuration.to_str().unwrap();
        let arguments = ["--speed", SPEED, "--config", configuration];
        let agent = LocalAgent::replay(&mut rp(), &capture, &arguments);
        Self { agent, directory }
    }

    /// Starts an agent and waits for its port.
    fn listening(setting: &str) -> Self {
        let mut daemon = Self::start(setting);
        daemon.agent.wait_for_log("answering as the ros2 daemon");
        daemon
            .agent
            .wait_for_metric("ros2_nodes{domain_id=\"0\"}", |count| count == 4.0);
        let readers = "ros2_topic_subscriptions{domain_id=\"0\",topic=\"/chatter\"}";
        daemon.agent.wait_for_metric(readers, |count| count == 1.0);
        daemon
    }

    fn ports(&self, state: &str, wanted: f64) {
        let series = format!("ros2probe_ros2_daemon_ports{{state=\"{state}\"}}");
        self.agent.wait_for_metric(&series, |count| count == wanted);
    }

    fn refused(&self, reason: &str) -> f64 {
        let series = format!("ros2probe_ros2_daemon_refused_total{{reason=\"{reason}\"}}");
        metric(&self.agent.get("/metrics").body, &series).unwrap()
    }
}

/// Returns the body of a call with text arguments.
fn body(method: &str, arguments: &[&str]) -> String {
    let arguments: String = arguments
        .iter()
        .map(|text| format!("<param>\n<value><string>{text}</string></value>\n</param>\n"))
        .collect();
    format!(
        "<?xml version='1.0'?>\n<methodCall>\n<methodName>{method}</methodName>\n<params>\n\
         {arguments}</params>\n</methodCall>\n"
    )
}

/// Sends a request on a persistent connection, as Python's client does.
fn send(stream: &mut TcpStream, head: &str, body: &str) -> Answer {
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    let length = body.len();
    // Python sends head and body separately.
    write!(stream, "{head}Content-Length: {length}\r\n\r\n").unwrap();
    stream.write_all(body.as_bytes()).unwrap();
    let mut bytes = Vec::new();
    let mut piece = [0; 4096];
    loop {
        let text = String::from_utf8_lossy(&bytes).into_owned();
        if let Some((headers, body)) = text.split_once("\r\n\r\n") {
            let headers = headers.to_lowercase();
            let length = headers.split("content-length: ").nth(1).unwrap();
            let length: usize = length.lines().next().unwrap().parse().unwrap();
            if body.len() >= length {
                let status = headers.split(' ').nth(1).unwrap().parse().unwrap();
                let body = body.to_owned();
                return Answer {
                    status,
                    headers,
                    body,
                };
            }
        }
        let count = stream.read(&mut piece).unwrap();
        assert!(count > 0, "closed after {text}");
        bytes.extend_from_slice(&piece[..count]);
    }
}

const HEAD: &str = "POST /ros2cli/ HTTP/1.1\r\nHost: 127.0.0.1:11511\r\nAccept-Encoding: gzip\r\n\
    Content-Type: text/xml\r\nUser-Agent: Python-xmlrpc/3.10\r\n";

fn call(method: &str, arguments: &[&str]) -> Answer {
    let mut stream = TcpStream::connect(DAEMON).unwrap();
    send(&mut stream, HEAD, &body(method, arguments))
}

#[test]
fn python_clients_of_each_distribution_read_every_answer_and_encode_the_same_bytes() {
    let script = repository("agent/cli/tests/surface/ros2_daemon/client.py");
    for distro in ["humble", "jazzy", "kilted", "lyrical"] {
        let _daemon = Daemon::listening(&format!("{{distro: {distro}}}"));
        let output = Command::new("python3")
            .arg(&script)
            .args(["11511", distro])
            .env("ROS_DISTRO", distro)
            .output()
            .unwrap_or_else(|error| panic!("python3: {error}; `apt-get install python3`"));
        let errors = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{distro}: {errors}");
        let answers: Value = serde_json::from_slice(&output.stdout).unwrap();
        let topics = &answers["get_topic_names_and_types"];
        let first = serde_json::json!(["/chatter", ["std_msgs/msg/String"]]);
        assert_eq!(topics[0], first, "{topics}");
        let ends = &answers["ends"]["/chatter"];
        assert_eq!(ends[0][0]["node_name"], "talker", "{ends}");
        let gid = ends[0][0]["endpoint_gid"].as_array().unwrap().len();
        assert_eq!(gid, if distro == "humble" { 24 } else { 16 });
        assert_eq!(ends[0][0]["topic_type_hash"].is_null(), distro == "humble");
        assert_eq!(ends[0][0]["endpoint_type"], 1);
        let nodes = answers["get_node_names_and_namespaces"].as_array().unwrap();
        assert_eq!(nodes.len(), 4, "{nodes:?}");
        let published = &answers["nodes"]["/robot1|lidar"]["publisher"];
        assert_eq!(published[2][0], "/rosout", "{published}");
        let counts = &answers["services"]["/talker/get_parameters"];
        assert_eq!(*counts, serde_json::json!([1, 0]));
        assert_eq!(
            answers["faults"][0],
            "<class 'Exception'>:method \"nope\" is not supported"
        );
    }
}

#[test]
fn the_python_release_in_the_user_agent_selects_the_classes_of_endpoints() {
    let daemon = Daemon::listening("on");
    let mut stream = TcpStream::connect(DAEMON).unwrap();
    for (release, gid, class) in [
        ("3.10", 24, "rclpy.topic_endpoint_info.TopicEndpointInfo"),
        ("3.12", 16, "rclpy.topic_endpoint_info.TopicEndpointInfo"),
        ("3.14", 16, "rclpy.endpoint_info.TopicEndpointInfo"),
        // For an unknown release, the robot decides. It announces no type hashes, as in Humble.
        ("3.11", 24, "rclpy.topic_endpoint_info.TopicEndpointInfo"),
    ] {
        let head = HEAD.replace("3.10", release);
        let answer = send(
            &mut stream,
            &head,
            &body("get_publishers_info_by_topic", &["/chatter"]),
        );
        assert_eq!(answer.status, 200);
        let gids = answer
            .body
            .split("<name>endpoint_gid</name>")
            .nth(1)
            .unwrap();
        let gids = gids.split("</array>").next().unwrap();
        assert_eq!(gids.matches("<int>").count(), gid, "{release}");
        assert!(answer.body.contains(class), "{release}");
    }
    let series = "ros2probe_ros2_daemon_requests_total{function=\"get_publishers_info_by_topic\"}";
    assert_eq!(
        metric(&daemon.agent.get("/metrics").body, series),
        Some(4.0)
    );
    call("nope", &[]);
    let series = "ros2probe_ros2_daemon_requests_total{function=\"unknown\"}";
    assert_eq!(
        metric(&daemon.agent.get("/metrics").body, series),
        Some(1.0)
    );
}

#[test]
fn the_agent_waits_for_a_port_in_use_and_leaves_it_free_after_a_shutdown() {
    let other = TcpListener::bind(DAEMON).unwrap();
    let mut daemon = Daemon::start("on");
    daemon.ports("occupied", 1.0);
    let line = daemon.agent.wait_for_log("another process has the port");
    assert!(
        line.contains("WARN") && line.contains("port=11511"),
        "{line}"
    );
    drop(other);
    daemon.ports("listening", 1.0);
    // A second client stays connected.
    let mut idle = TcpStream::connect(DAEMON).unwrap();
    assert_eq!(
        send(&mut idle, HEAD, &body("get_namespace", &[])).status,
        200
    );

    let answer = call("system.shutdown", &[]);
    assert!(answer.body.contains("<nil/>") && answer.headers.contains("connection: close"));
    let error = TcpStream::connect(DAEMON).unwrap_err();
    assert_eq!(error.kind(), ErrorKind::ConnectionRefused);
    idle.set_read_timeout(Some(PATIENCE)).unwrap();
    let ended = idle.read(&mut [0]);
    assert!(!matches!(ended, Ok(1..)), "{ended:?}");
    // No connection keeps the port in use, so a daemon that does not reuse addresses can bind it.
    let bind = "import socket; s = socket.socket(); s.bind(('127.0.0.1', 11511)); s.listen()";
    let status = Command::new("python3").args(["-c", bind]).status().unwrap();
    assert!(status.success());
    daemon.ports("released", 1.0);
    daemon.agent.signal("-HUP");
    daemon.ports("listening", 1.0);
    assert_eq!(call("get_namespace", &[]).status, 200);
    drop(daemon.directory);
}

#[test]
fn web_pages_and_requests_that_are_not_calls_are_refused() {
    let daemon = Daemon::listening("on");
    let list = body("system.listMethods", &[]);
    let ask = |head: &str, body: &str| {
        let mut stream = TcpStream::connect(DAEMON).unwrap();
        send(&mut stream, head, body)
    };
    let with = |from: &str, to: &str| HEAD.replace(from, to);
    for (head, status, reason) in [
        (with("127.0.0.1:11511", "evil.example"), 403, "host"),
        (
            with("Content-Type: text/xml", "Content-Type: text/plain"),
            403,
            "origin",
        ),
        (
            with(
                "Content-Type",
                "Origin: http://evil.example\r\nContent-Type",
            ),
            403,
            "origin",
        ),
        (with("/ros2cli/", "/RPC2"), 404, "path"),
        (with("POST", "GET"), 501, "path"),
    ] {
        let before = daemon.refused(reason);
        assert_eq!(ask(&head, &list).status, status, "{head}");
        assert_eq!(daemon.refused(reason), before + 1.0, "{reason}");
    }
    assert_eq!(
        ask(&with("127.0.0.1:11511", "localhost:11511"), &list).status,
        200
    );
    let whole = format!("{list}{}", " ".repeat((16 << 10) - list.len()));
    assert_eq!(ask(HEAD, &whole).status, 200);
    assert_eq!(ask(HEAD, &format!("{whole} ")).status, 413);
    assert_eq!(daemon.refused("size"), 1.0);
    let fault = ask(HEAD, "<methodCall>");
    assert_eq!(fault.status, 200);
    assert!(fault.body.contains("<fault>"), "{}", fault.body);
    let fault = ask(HEAD, "<!DOCTYPE a>");
    assert!(fault.body.contains("ExpatError"), "{}", fault.body);
    assert_eq!(daemon.refused("malformed"), 2.0);
    assert_eq!(
        metric(&daemon.agent.get("/metrics").body, LISTENING),
        Some(1.0)
    );
}

#[test]
fn connections_beyond_the_cap_replace_the_longest_idle_one() {
    let daemon = Daemon::listening("on");
    let clients = "ros2probe_ros2_daemon_clients";
    let mut first = TcpStream::connect(DAEMON).unwrap();
    assert_eq!(
        send(&mut first, HEAD, &body("get_namespace", &[])).status,
        200
    );
    let mut others: Vec<_> = (1..MAX_CLIENTS)
        .map(|_| TcpStream::connect(DAEMON).unwrap())
        .collect();
    daemon
        .agent
        .wait_for_metric(clients, |count| count == MAX_CLIENTS as f64);
    let begun = Instant::now();
    assert_eq!(call("get_namespace", &[]).status, 200);
    assert!(begun.elapsed() < Duration::from_secs(30));
    first.set_read_timeout(Some(PATIENCE)).unwrap();
    let ended = first.read(&mut [0]);
    assert!(!matches!(ended, Ok(1..)), "{ended:?}");
    for stream in &mut others {
        assert_eq!(send(stream, HEAD, &body("get_namespace", &[])).status, 200);
    }
}

#[test]
fn without_the_setting_the_port_is_closed() {
    let daemon = Daemon::start("off");
    daemon
        .agent
        .wait_for_metric("ros2probe_ready", |ready| ready == 1.0);
    let page = daemon.agent.get("/metrics").body;
    assert_eq!(metric(&page, LISTENING), None, "{page}");
    let error = TcpStream::connect(DAEMON).unwrap_err();
    assert_eq!(error.kind(), ErrorKind::ConnectionRefused);
}
