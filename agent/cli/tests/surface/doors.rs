//! Hostile clients, and the access through each listener and the socket: memory, connections and
//! parts of the API that a client gets.

use std::collections::BTreeMap;
use std::io::{Read as _, Write as _};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::os::unix::net::UnixStream;
use std::os::unix::process::CommandExt as _;
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use crate::rp;
use ros2probe_testing::local_agent::{
    Answer, LocalAgent, PATIENCE, call_api, exchange, promtool, request,
};
use seccompiler::{BpfProgram, SeccompAction, SeccompFilter};
use serde_json::Value;

/// Returns the value of a line of `/proc/PID/status`, in KiB.
fn kibibytes(agent: &LocalAgent, key: &str) -> u64 {
    let status = std::fs::read_to_string(format!("/proc/{}/status", agent.pid())).unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix(key));
    let number = line.unwrap().trim_matches([':', '\t', ' ']);
    number.split(' ').next().unwrap().parse().unwrap()
}

/// Returns the headers and the body of an HTTP answer whose body is not text.
fn bytes_of(address: SocketAddr, path: &str, headers: &str) -> (String, Vec<u8>) {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    let head =
        format!("GET {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n{headers}\r\n");
    stream.write_all(head.as_bytes()).unwrap();
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).unwrap();
    let end = answer.windows(4).position(|bytes| bytes == b"\r\n\r\n");
    let body = answer.split_off(end.unwrap() + 4);
    (String::from_utf8(answer).unwrap().to_lowercase(), body)
}

#[test]
fn unfinished_requests_with_long_heads_take_little_memory_and_block_no_client() {
    let mut agent = LocalAgent::start(&mut rp(), &["--speed", "max"]);
    agent.wait_for_log("ready");
    assert_eq!(call_api(agent.api, "GET", "/health", "").0, 200);
    let before = kibibytes(&agent, "RssAnon");
    let mut most = 0;
    let mut clients = Vec::new();
    let field = format!("x: {}\r\n", "x".repeat(9_500));
    for number in 0..160 {
        let address = [agent.api, agent.address][number % 2];
        let mut client = TcpStream::connect(address).unwrap();
        client
            .set_write_timeout(Some(Duration::from_millis(50)))
            .unwrap();
        let _ = write!(client, "GET /topics HTTP/1.1\r\nHost: {address}\r\n");
        // Every other pair of connections stays below the maximum size of a head. The agent keeps
        // their 38 KB, and refuses the 380 KB of the others.
        let fields = if number % 4 < 2 { 4 } else { 40 };
        for _ in 0..fields {
            if client.write_all(field.as_bytes()).is_err() {
                break;
            }
        }
        clients.push(client);
        most = most.max(kibibytes(&agent, "RssAnon"));
    }
    std::thread::sleep(Duration::from_millis(100));
    let grown = most
        .max(kibibytes(&agent, "RssAnon"))
        .saturating_sub(before);
    eprintln!("160 unfinished requests of up to 380 KB: {grown} KiB");
    assert!(grown < 3 << 10, "{grown} KiB");
    assert_eq!(call_api(agent.api, "GET", "/health", "").0, 200);
    assert_eq!(agent.get("/metrics").status, 200);
    drop(clients);
}

#[test]
fn idle_connections_and_unfinished_requests_are_closed_for_the_next_client() {
    let mut agent = LocalAgent::start(&mut rp(), &["--speed", "max"]);
    agent.wait_for_log("ready");
    let mut clients = Vec::new();
    for number in 0..64 {
        let mut client = TcpStream::connect(agent.address).unwrap();
        client.set_read_timeout(Some(PATIENCE)).unwrap();
        if number % 2 == 0 {
            let request = format!("HEAD /healthz HTTP/1.1\r\nHost: {}\r\n\r\n", agent.address);
            client.write_all(request.as_bytes()).unwrap();
            assert!(client.read(&mut [0; 4096]).unwrap() > 0);
        } else {
            client.write_all(b"GET /metr").unwrap();
        }
        clients.push(client);
    }
    for _ in 0..20 {
        assert_eq!(agent.get("/metrics").status, 200);
    }
    // The agent closed the first connection without an answer.
    assert_eq!(clients[0].read(&mut [0; 16]).unwrap(), 0);
}

#[test]
fn a_body_that_does_not_arrive_leads_to_a_closed_connection_after_ten_seconds() {
    let mut agent = LocalAgent::start(&mut rp(), &["--speed", "max"]);
    agent.wait_for_log("ready");
    let mut client = TcpStream::connect(agent.api).unwrap();
    client.set_read_timeout(Some(PATIENCE)).unwrap();
    let head = format!(
        "PUT /watch/a HTTP/1.1\r\nHost: {}\r\nContent-Type: application/json\r\n\
         Content-Length: 1000\r\n\r\n{{",
        agent.api
    );
    let began = Instant::now();
    client.write_all(head.as_bytes()).unwrap();
    let mut answer = String::new();
    let _ = client.read_to_string(&mut answer);
    let seconds = began.elapsed().as_secs();
    assert!((9..60).contains(&seconds), "{seconds} s: {answer}");
}

#[test]
fn a_flood_without_the_token_does_not_reduce_the_answers_to_a_client_with_it() {
    let directory = tempfile::tempdir().unwrap();
    let (config, token) = (
        directory.path().join("config.yaml"),
        directory.path().join("token"),
    );
    std::fs::write(&token, "0123456789abcdef\n").unwrap();
    std::fs::write(
        &config,
        format!("api: {{token_file: {}}}\n", token.display()),
    )
    .unwrap();
    let mut agent = LocalAgent::start(
        &mut rp(),
        &["--config", config.to_str().unwrap(), "--speed", "max"],
    );
    agent.wait_for_log("ready");
    let (api, is_over, answers) = (agent.api, AtomicBool::new(false), AtomicU64::new(0));
    let flood = || {
        while !is_over.load(Ordering::Relaxed) {
            let mut client = TcpStream::connect(api).unwrap();
            let request = format!("GET /topics HTTP/1.1\r\nHost: {api}\r\n\r\n");
            let sent = client.write_all(request.as_bytes());
            if sent.is_ok() && client.read(&mut [0; 512]).is_ok() {
                answers.fetch_add(1, Ordering::Relaxed);
            }
        }
    };
    let answered = std::thread::scope(|scope| {
        for _ in 0..3 {
            scope.spawn(flood);
        }
        let deadline = Instant::now() + Duration::from_secs(120);
        // The burst of requests without a token is used up.
        while answers.load(Ordering::Relaxed) < 2_000 && Instant::now() < deadline {
            std::thread::sleep(Duration::from_millis(10));
        }
        let bearer = "Authorization: Bearer 0123456789abcdef\r\n";
        let answered = (0..370)
            .filter(|_| request(api, "GET", "/openapi.json", bearer).status == 200)
            .count();
        is_over.store(true, Ordering::Relaxed);
        answered
    });
    let flooded = answers.into_inner();
    eprintln!("{answered} of 370 beside {flooded} without the token");
    assert_eq!(answered, 370);
    assert!(flooded >= 2_000, "{flooded}");
}

#[test]
fn missing_system_call_filters_are_reported_everywhere() {
    // Simulates a kernel without system call filters.
    let refused = BTreeMap::from([(libc::SYS_seccomp, Vec::new())]);
    let filter = SeccompFilter::new(
        refused,
        SeccompAction::Allow,
        SeccompAction::Errno(libc::ENOSYS.cast_unsigned()),
        std::env::consts::ARCH.try_into().unwrap(),
    );
    let filter = BpfProgram::try_from(filter.unwrap()).unwrap();
    let mut command = rp();
    // SAFETY: between fork and exec are only two system calls, on memory allocated before.
    unsafe {
        command.pre_exec(move || seccompiler::apply_filter(&filter).map_err(std::io::Error::other));
    }
    let mut agent = LocalAgent::start(&mut command, &["--speed", "max"]);
    agent.wait_for_log("ready");
    let log = agent.log();
    assert!(log.contains("system calls are not filtered"), "{log}");
    let page = agent.get("/metrics").body;
    let shown = page
        .lines()
        .find(|line| line.starts_with("ros2probe_sandbox_info{"));
    let shown = shown.unwrap_or_default();
    assert!(shown.contains("system_calls=\"all\""), "{shown}");
    let health = call_api(agent.api, "GET", "/health", "").1;
    assert!(health["unfiltered_reason"].is_string(), "{health}");
}

#[test]
fn a_page_is_compressed_for_a_scraper_that_accepts_it() {
    let mut agent = LocalAgent::start(&mut rp(), &["--watch", "/**", "--speed", "max"]);
    agent.wait_for_log("ready");
    let names = |page: &[u8]| {
        let page = std::str::from_utf8(page).unwrap();
        let lines = page.lines().filter(|line| !line.starts_with('#'));
        lines
            .map(|line| line.rsplit_once(' ').unwrap().0.to_owned())
            .collect::<Vec<_>>()
    };
    let accepts = "Accept-Encoding: gzip\r\n";
    // If the page has the same series before and after, the compressed page in between has them
    // too.
    let (mut headers, mut page) = bytes_of(agent.address, "/metrics", "");
    let (compressed_headers, compressed) = loop {
        assert!(!headers.contains("content-encoding"), "{headers}");
        let compressed = bytes_of(agent.address, "/metrics", accepts);
        let (headers_after, after) = bytes_of(agent.address, "/metrics", "");
        if names(&page) == names(&after) {
            break compressed;
        }
        (headers, page) = (headers_after, after);
    };
    let headers = compressed_headers;
    assert!(headers.contains("content-encoding: gzip"), "{headers}");
    assert!(headers.contains(&format!("content-length: {}", compressed.len())));
    assert!(
        headers.contains("vary: accept, accept-encoding"),
        "{headers}"
    );
    let (compressed_length, length) = (compressed.len(), page.len());
    assert!(
        compressed_length * 3 < length,
        "{compressed_length} of {length}"
    );
    let mut text = String::new();
    flate2::read::GzDecoder::new(&compressed[..])
        .read_to_string(&mut text)
        .unwrap();
    assert_eq!(promtool(&text), "");
    assert_eq!(names(text.as_bytes()), names(&page));
}

#[test]
fn the_metrics_listener_on_loopback_answers_only_requests_to_its_own_names() {
    let mut agent = LocalAgent::start(&mut rp(), &["--speed", "max"]);
    agent.wait_for_log("ready");
    let port = agent.address.port();
    let status = |host: &str| {
        let stream = TcpStream::connect(agent.address).unwrap();
        let head = format!("GET /metrics HTTP/1.1\r\n{host}");
        exchange(stream, &head, "").status
    };
    for own in ["localhost", "127.0.0.1", "[::1]"] {
        assert_eq!(status(&format!("Host: {own}:{port}\r\n")), 200, "{own}");
    }
    for foreign in ["evil.example", "localhost:x@evil", "[::1]evil", "10.0.0.1"] {
        assert_eq!(status(&format!("Host: {foreign}\r\n")), 403, "{foreign}");
    }
    assert_eq!(status("Host: localhost\r\nHost: evil.example\r\n"), 403);
}

/// Returns the code and the detail of a refusal, or `None` for any other answer.
fn refusal(answer: &Answer) -> Option<(String, String)> {
    let problem: Value = serde_json::from_str(&answer.body).ok()?;
    let code = problem["type"].as_str()?;
    let code = code.strip_prefix("urn:ros2probe:problem:")?;
    Some((code.to_owned(), problem["detail"].as_str()?.to_owned()))
}

/// Requests and the level of access that they need.
const REQUESTS: [(&str, &str, &str); 25] = [
    ("GET", "/health", "read"),
    ("GET", "/topics", "read"),
    ("GET", "/graph", "read"),
    ("GET", "/watch", "read"),
    ("GET", "/events?after=0&follow=false", "read"),
    ("POST", "/watch/points", "watch"),
    ("GET", "/watch/points", "read"),
    ("DELETE", "/watch/points", "watch"),
    ("GET", "/samples?topic=/nothing//wrong", "watch"),
    ("GET", "/samples?topic=/nothing//wrong&payload=true", "all"),
    (
        "GET",
        "/samples?topic=/nothing//wrong&payl%6Fad=true",
        "all",
    ),
    ("GET", "/recordings", "all"),
    ("POST", "/recordings/none/pause", "all"),
    ("DELETE", "/recordings/none", "all"),
    ("GET", "/snapshots", "all"),
    ("POST", "/snapshots/none", "all"),
    ("POST", "/-/reload", "all"),
    ("POST", "/%2D/reload", "all"),
    ("GET", "/processes", "read"),
    ("GET", "/topics/nowhere/history", "read"),
    ("GET", "/topics/nowhere/definition", "read"),
    ("GET", "/topics/nowhere/messages", "all"),
    ("GET", "/recordings/none/files", "all"),
    ("GET", "/recordings/none/files/metadata.yaml", "all"),
    ("POST", "/page/token", "all"),
];

#[test]
fn loopback_grants_the_configured_access_and_the_socket_grants_all() {
    for level in ["read", "watch", "all"] {
        let directory = tempfile::tempdir().unwrap();
        let socket = directory.path().join("api.sock");
        let config = directory.path().join("config.yaml");
        let text = format!("api: {{socket: {}, loopback: {level}}}\n", socket.display());
        std::fs::write(&config, text).unwrap();
        // The command line takes precedence.
        let configured = ["--config", config.to_str().unwrap(), "--speed", "max"];
        let mut agent = LocalAgent::start(
            &mut rp(),
            &[&configured[..], &["--api-loopback", level]].concat(),
        );
        agent.wait_for_log("ready");
        let levels = ["read", "watch", "all"];
        let rank = |level: &str| levels.iter().position(|each| *each == level).unwrap();
        for (method, path, needed) in REQUESTS {
            let needs_socket =
                |answer: &Answer| refusal(answer).filter(|(code, _)| code == "needs-socket");
            let over_loopback = request(agent.api, method, path, "");
            let refused = needs_socket(&over_loopback);
            // A path in another spelling is not found.
            let is_granted = rank(needed) <= rank(level) || over_loopback.status == 404;
            assert_eq!(refused.is_none(), is_granted, "{level}: {method} {path}");
            if let Some((_, detail)) = refused {
                assert_eq!(over_loopback.status, 403);
                assert!(detail.contains("usermod -aG ros2probe"), "{detail}");
                assert!(detail.contains(socket.to_str().unwrap()), "{detail}");
            }
            let stream = UnixStream::connect(&socket).unwrap();
            let by_socket = exchange(
                stream,
                &format!("{method} {path} HTTP/1.1\r\nHost: rp\r\n"),
                "",
            );
            assert!(needs_socket(&by_socket).is_none(), "{method} {path}");
        }
    }
}

#[test]
fn a_client_without_a_token_learns_that_the_streams_left_are_for_clients_with_one() {
    let mut agent = LocalAgent::start(&mut rp(), &["--speed", "max"]);
    agent.wait_for_log("ready");
    for path in ["/events", "/live"] {
        let open = || {
            let mut stream = TcpStream::connect(agent.api).unwrap();
            stream.set_read_timeout(Some(PATIENCE)).unwrap();
            let head = format!("GET {path} HTTP/1.1\r\nHost: {}\r\n\r\n", agent.api);
            stream.write_all(head.as_bytes()).unwrap();
            let mut answer = [0; 12];
            stream.read_exact(&mut answer).unwrap();
            assert_eq!(&answer, b"HTTP/1.1 200", "{path}");
            stream
        };
        let open: Vec<_> = (0..12).map(|_| open()).collect();
        let answer = request(agent.api, "GET", path, "");
        let (code, detail) = refusal(&answer).unwrap();
        assert_eq!((answer.status, code.as_str()), (503, "too-many-streams"));
        let expected = "4 of 16 are for clients with a token";
        assert!(detail.ends_with(expected), "{path}: {detail}");
        drop(open);
    }
}

#[test]
fn by_default_loopback_grants_watches_but_no_payloads() {
    use ros2probe_daemon::config::{Access, Config};
    assert_eq!(Config::default().api.loopback, Access::Watch);
    let mut agent = LocalAgent::start(&mut rp(), &["--api-loopback", "watch"]);
    agent.wait_for_log("ready");
    assert_eq!(request(agent.api, "POST", "/watch/points", "").status, 201);
    let echo = rp()
        .args([
            "topic",
            "echo",
            "/chatter",
            "--host",
            &agent.api.to_string(),
        ])
        .output()
        .unwrap();
    let printed = String::from_utf8(echo.stderr).unwrap();
    assert!(!echo.status.success());
    assert_eq!(printed.lines().count(), 1, "{printed}");
    assert!(
        printed.contains("loopback grants no message payloads"),
        "{printed}"
    );
}

#[test]
fn a_client_of_a_silent_server_gives_up_after_five_seconds() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap().to_string();
    // Servers that send nothing, half of an answer, and a stream without a line.
    let beginnings = [
        "",
        "HTTP/1.1 200 OK\r\ncontent-length: 100\r\n\r\n{",
        "HTTP/1.1 200 OK\r\ntransfer-encoding: chunked\r\n\r\n",
    ];
    let commands: [&[&str]; 3] = [
        &["topic", "list"],
        &["topic", "list"],
        &["topic", "echo", "/a", "std_msgs/msg/String"],
    ];
    for (beginning, command) in beginnings.into_iter().zip(commands) {
        let began = Instant::now();
        let child = rp()
            .args(command)
            .args(["--host", &address])
            .stderr(std::process::Stdio::piped())
            .spawn()
            .unwrap();
        let (mut server, _) = listener.accept().unwrap();
        assert!(server.read(&mut [0; 4096]).unwrap() > 0);
        server.write_all(beginning.as_bytes()).unwrap();
        let output = child.wait_with_output().unwrap();
        let seconds = began.elapsed().as_secs_f64();
        let printed = String::from_utf8(output.stderr).unwrap();
        assert!(!output.status.success());
        assert!(
            printed.contains("does not answer"),
            "{command:?}: {printed}"
        );
        assert!((4.5..60.0).contains(&seconds), "{command:?}: {seconds} s");
        drop(server);
    }
}

#[test]
fn text_of_a_file_is_escaped_before_it_reaches_the_terminal() {
    let directory = tempfile::tempdir().unwrap();
    let steers = |text: &[u8]| {
        let text = String::from_utf8_lossy(text).into_owned();
        let hidden = |each: char| (each.is_control() && each != '\n') || each == '\u{200b}';
        text.contains(hidden)
    };
    let run = |arguments: &[&str], path: &Path| {
        let output = rp().args(arguments).arg(path).output().unwrap();
        let printed = [output.stdout, output.stderr].concat();
        assert!(!steers(&printed), "{arguments:?}: {printed:?}");
        String::from_utf8(printed).unwrap()
    };

    let config = directory.path().join("config.yaml");
    let hostile = "\\e]0;title\\a\\u200b";
    let text = format!("\"{hostile}\": 1\nwatch: [\"/a{hostile}\"]\nlog: \"{hostile}\"\n");
    std::fs::write(&config, text).unwrap();
    let printed = run(&["check-config"], &config);
    assert!(printed.contains("]0;title"), "{printed}");

    let bag = directory.path().join("bag");
    std::fs::create_dir(&bag).unwrap();
    let metadata = format!(
        "rosbag2_bagfile_information:\n  version: 9\n  storage_identifier: \"mcap{hostile}\"\n  \
         duration: {{nanoseconds: 1}}\n  starting_time: {{nanoseconds_since_epoch: 1}}\n  \
         message_count: 1\n  topics_with_message_count:\n    - topic_metadata: {{name: \"/a{hostile}\", \
         type: \"std_msgs/msg/String{hostile}\", serialization_format: \"cdr{hostile}\", \
         offered_qos_profiles: []}}\n      message_count: 1\n  compression_format: \"\"\n  \
         compression_mode: \"\"\n  relative_file_paths: [\"a{hostile}.mcap\"]\n  files: []\n  \
         custom_data: {{}}\n  ros_distro: \"jazzy{hostile}\"\n"
    );
    std::fs::write(bag.join("metadata.yaml"), metadata).unwrap();
    let printed = run(&["bag", "info"], &bag);
    assert!(
        printed.contains("/a\\u{1b}]0;title\\u{7}\\u{200b} | Type"),
        "{printed}"
    );
    run(&["bag", "info", "--topic-name"], &bag);
    run(&["bag", "info", "--verbose"], &bag);

    let cut = directory.path().join("cut");
    std::fs::create_dir(&cut).unwrap();
    let name = "a\u{1b}]0;title\u{7}\u{200b}.mcap";
    std::fs::write(cut.join(name), "nothing").unwrap();
    let printed = run(&["bag", "reindex"], &cut);
    assert!(printed.contains("]0;title"), "{printed}");
}

#[test]
fn a_refused_request_for_a_hint_does_not_end_an_echo() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap().to_string();
    let problem = |code: &str, status: u16| {
        let body = format!(
            r#"{{"type":"urn:ros2probe:problem:{code}","status":{status},"detail":"refused"}}"#
        );
        let length = body.len();
        format!("HTTP/1.1 {status} No\r\ncontent-length: {length}\r\n\r\n{body}")
    };
    std::thread::spawn(move || {
        let mut is_known = false;
        for client in listener.incoming() {
            let (mut client, mut request) = (client.unwrap(), [0; 4096]);
            let count = client.read(&mut request).unwrap();
            let request = String::from_utf8_lossy(&request[..count]);
            let answer = if request.starts_with("GET /samples?") {
                let lines =
                    "{\"open\":{\"topics\":[]}}\n{\"end\":{\"reason\":\"end of capture\"}}\n";
                let length = lines.len();
                format!("HTTP/1.1 200 OK\r\ncontent-length: {length}\r\n\r\n{lines}")
            } else if request.starts_with("GET /topics/a?")
                && !std::mem::replace(&mut is_known, true)
            {
                problem("no-such-topic", 404)
            } else {
                problem("too-many-clients", 503)
            };
            client.write_all(answer.as_bytes()).unwrap();
        }
    });
    let echo = ["topic", "echo", "/a", "std_msgs/msg/String", "--host"];
    let output = rp().args(echo).arg(&address).output().unwrap();
    let printed = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(0), "{printed}");
    assert!(!printed.contains("refused"), "{printed}");
}
