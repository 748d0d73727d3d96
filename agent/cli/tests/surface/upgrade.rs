//! `rp upgrade --check` compares with a feed on disk or at an address, and only when it is run.

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::Output;
use std::sync::Arc;

use crate::otlp_tls::make_server_config;
use crate::rp;
use ros2probe_testing::local_agent::LocalAgent;
use serde_json::{Value, json};
use tokio_rustls::rustls::{ServerConnection, StreamOwned};

const OWN: &str = env!("CARGO_PKG_VERSION");

/// Returns a feed with a binary for this machine.
fn feed(version: &str) -> String {
    let binary = format!("rp-{version}-{}", std::env::consts::ARCH);
    let feed = json!({
        "version": version,
        "commit": "0123456789abcdef0123456789abcdef01234567",
        "notes": "https://example.org/notes",
        "files": { binary: "ab".repeat(32), "SOMETHING-ELSE": "cd".repeat(32) },
    });
    feed.to_string()
}

fn check(feed: &str, more: &[&str]) -> Output {
    let mut rp = rp();
    rp.args(["upgrade", "--check", "--feed", feed]).args(more);
    rp.output().unwrap()
}

fn stdout(output: &Output) -> String {
    String::from_utf8(output.stdout.clone()).unwrap()
}

/// Asserts that a command fails with one line that has this text.
fn fails(output: &Output, text: &str) {
    let printed = String::from_utf8(output.stderr.clone()).unwrap();
    assert_eq!(output.status.code(), Some(1), "{printed}");
    assert_eq!(printed.lines().count(), 1, "{printed}");
    assert!(printed.contains(text), "{printed}");
    assert!(output.stdout.is_empty());
}

fn write(directory: &Path, name: &str, text: &str) -> PathBuf {
    let path = directory.join(name);
    std::fs::write(&path, text).unwrap();
    path
}

/// Answers one request.
fn answer(mut stream: impl Read + Write) {
    let mut head = Vec::new();
    let mut byte = [0];
    while !head.ends_with(b"\r\n\r\n") {
        match stream.read(&mut byte) {
            Ok(1) => head.push(byte[0]),
            // A client that does not know the authority ends the handshake.
            _ => return,
        }
    }
    let head = String::from_utf8(head).unwrap();
    assert!(head.contains(&format!("rp/{OWN}")), "{head}");
    let redirection = |target: &str| {
        (
            "302 Found",
            format!("Location: {target}\r\n"),
            String::new(),
        )
    };
    let (status, headers, body) = match head.split(' ').nth(1).unwrap() {
        "/new/release.json" => ("200 OK", String::new(), feed("99.0.0")),
        "/latest" => redirection("/new/release.json"),
        "/loop" => redirection("/loop"),
        "/large" => ("200 OK", String::new(), " ".repeat((1 << 20) + 1)),
        _ => ("404 Not Found", String::new(), String::new()),
    };
    let length = body.len();
    let text = format!(
        "HTTP/1.1 {status}\r\n{headers}Content-Length: {length}\r\nConnection: close\r\n\r\n{body}"
    );
    let _ = stream.write_all(text.as_bytes());
}

/// Starts a server and returns its port.
fn serve(wrap: impl Fn(TcpStream) + Send + 'static) -> u16 {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = listener.local_addr().unwrap().port();
    std::thread::spawn(move || {
        for stream in listener.incoming() {
            wrap(stream.unwrap());
        }
    });
    port
}

#[test]
fn a_newer_version_is_printed_with_its_file_and_the_command_that_installs_it() {
    let directory = tempfile::tempdir().unwrap();
    let path = write(directory.path(), "release.json", &feed("99.0.0"));
    let output = check(path.to_str().unwrap(), &[]);
    assert_eq!(output.status.code(), Some(100), "{output:?}");
    let text = stdout(&output);
    let file = format!("{}/rp-99.0.0-", directory.path().display());
    for part in [
        &*format!("ros2probe 99.0.0 is available. This is {OWN}, installed as the file "),
        &*format!("  file    {file}"),
        &*format!("  sha256  {}\n", "ab".repeat(32)),
        "  notes   https://example.org/notes\n",
        &*format!("  sudo install -m 755 {file}"),
    ] {
        assert!(text.contains(part), "`{part}` is not in {text}");
    }

    let output = check(path.to_str().unwrap(), &["--json"]);
    assert_eq!(output.status.code(), Some(100), "{output:?}");
    let comparison: Value = serde_json::from_str(&stdout(&output)).unwrap();
    assert_eq!(comparison["installed"], OWN);
    assert_eq!(comparison["newest"], "99.0.0");
    assert_eq!(comparison["is_newer"], true);
    assert_eq!(comparison["installation"]["by"], "binary");
    assert_eq!(comparison["commands"].as_array().unwrap().len(), 1);
}

#[test]
fn the_same_or_an_older_version_is_not_an_upgrade() {
    let directory = tempfile::tempdir().unwrap();
    for version in [OWN, "0.0.9"] {
        let path = write(directory.path(), "release.json", &feed(version));
        let path = path.to_str().unwrap();
        let output = check(path, &[]);
        assert_eq!(output.status.code(), Some(0), "{output:?}");
        let expected = format!("rp {OWN} is the newest version: {path} has {version}.\n");
        assert_eq!(stdout(&output), expected);
        let output = check(path, &["--json"]);
        let comparison: Value = serde_json::from_str(&stdout(&output)).unwrap();
        assert_eq!(comparison["commands"], json!([]));
    }
}

#[test]
fn a_feed_at_an_address_is_read_once_with_its_redirections() {
    let server = format!("http://127.0.0.1:{}", serve(answer));
    let output = check(&format!("{server}/latest"), &[]);
    assert_eq!(output.status.code(), Some(100), "{output:?}");
    let text = stdout(&output);
    let file = format!("curl --fail --location --output rp {server}/rp-99.0.0-");
    assert!(text.contains(&file), "{text}");
    for (path, reason) in [
        ("/nothing", "the server answers 404 Not Found"),
        ("/loop", "more than 5 redirections"),
        ("/large", "length limit exceeded"),
    ] {
        fails(&check(&format!("{server}{path}"), &[]), reason);
    }
}

#[test]
fn a_feed_over_https_needs_a_certificate_of_a_known_authority() {
    let directory = tempfile::tempdir().unwrap();
    let path = |name: &str| directory.path().join(name);
    let config = Arc::new(make_server_config(directory.path()));
    let port = serve(move |stream| {
        let connection = ServerConnection::new(Arc::clone(&config)).unwrap();
        answer(StreamOwned::new(connection, stream));
    });
    let address = format!("https://localhost:{port}/new/release.json");
    let mut known = rp();
    known.env("SSL_CERT_FILE", path("authority"));
    known.args(["upgrade", "--check", "--feed", &address]);
    let output = known.output().unwrap();
    assert_eq!(output.status.code(), Some(100), "{output:?}");
    fails(&check(&address, &[]), "certificate");
}

#[test]
fn a_feed_without_encryption_needs_no_certificate_authorities() {
    let directory = tempfile::tempdir().unwrap();
    let authorities = write(directory.path(), "none.pem", "");
    let address = format!("http://127.0.0.1:{}/latest", serve(answer));
    let mut rp = rp();
    rp.env("SSL_CERT_FILE", authorities);
    rp.env_remove("SSL_CERT_DIR");
    rp.args(["upgrade", "--check", "--feed", &address]);
    let output = rp.output().unwrap();
    assert_eq!(output.status.code(), Some(100), "{output:?}");
}

#[test]
fn an_invalid_feed_is_reported_in_one_line() {
    let directory = tempfile::tempdir().unwrap();
    fails(
        &check("/nowhere.json", &[]),
        "cannot read the feed /nowhere.json",
    );
    for (text, reason) in [
        ("not JSON", "is not a feed of ros2probe"),
        (
            "{\"version\": \"1.x\", \"notes\": \"\", \"files\": {}}",
            "is not a version",
        ),
        (
            "{\"version\": \"1.0.0\", \"notes\": \"\"}",
            "missing field `files`",
        ),
    ] {
        let path = write(directory.path(), "release.json", text);
        fails(&check(path.to_str().unwrap(), &[]), reason);
    }
}

#[test]
fn without_a_feed_the_error_names_the_option_and_the_key() {
    let directory = tempfile::tempdir().unwrap();
    let path = write(directory.path(), "ros2probe.yaml", "upgrade:\n");
    let path = path.to_str().unwrap();
    let mut rp = rp();
    let output = rp.args(["upgrade", "--check", "--config", path]);
    let expected = format!("pass --feed PATH|URL, or set `upgrade.feed` in {path}");
    fails(&output.output().unwrap(), &expected);
}

#[test]
fn only_the_command_reads_the_configured_feed() {
    let directory = tempfile::tempdir().unwrap();
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    let yaml = format!("upgrade: {{feed: 'http://{address}/new/release.json'}}\n");
    let path = write(directory.path(), "ros2probe.yaml", &yaml);
    let path = path.to_str().unwrap();
    let agent = LocalAgent::start(&mut rp(), &["--config", path]);
    agent.wait_for_metric("ros2probe_config_last_reload_successful", |value| {
        value > 0.5
    });
    drop(agent);
    listener.set_nonblocking(true).unwrap();
    assert!(
        listener.accept().is_err(),
        "the agent connected to the feed"
    );

    listener.set_nonblocking(false).unwrap();
    let server = std::thread::spawn(move || answer(listener.accept().unwrap().0));
    let mut rp = rp();
    let output = rp.args(["upgrade", "--check", "--config", path]);
    assert_eq!(output.output().unwrap().status.code(), Some(100));
    server.join().unwrap();
}
