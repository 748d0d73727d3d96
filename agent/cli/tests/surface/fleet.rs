//! `rp fleet` with engines that answer as they should not.

use std::io::Read as _;
use std::net::{SocketAddr, TcpListener};
use std::time::Duration;

use crate::rp;

/// Starts an engine that answers each request with these bytes, and then ends the connection.
fn engine(
    answer: impl Fn(&mut dyn std::io::Write) -> std::io::Result<()> + Send + 'static,
) -> SocketAddr {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    std::thread::spawn(move || {
        for stream in listener.incoming() {
            let mut stream = stream.unwrap();
            stream
                .set_read_timeout(Some(Duration::from_secs(5)))
                .unwrap();
            let mut request = [0; 4096];
            let _ = stream.read(&mut request);
            // `rp` may have closed the connection.
            let _ = answer(&mut stream);
        }
    });
    address
}

fn fleet(arguments: &[&str]) -> (Option<i32>, String) {
    let output = rp().arg("fleet").args(arguments).output().unwrap();
    let text = String::from_utf8(output.stderr).unwrap();
    (output.status.code(), text)
}

#[test]
fn an_engine_without_a_usable_answer_is_one_error() {
    let status = engine(|out| {
        let text = "parse error";
        write!(
            out,
            "HTTP/1.1 400 Bad Request\r\nContent-Length: {}\r\n\r\n{text}",
            text.len()
        )
    });
    let page = engine(|out| write!(out, "HTTP/1.1 200 OK\r\nContent-Length: 6\r\n\r\n<html>"));
    let broken = engine(|out| write!(out, "HTTP/1.1 200 OK\r\nContent-Length: 60\r\n\r\n{{"));
    for (address, expected) in [
        (status, "the engine answers 400 Bad Request: parse error"),
        (page, "the answer is not one of Prometheus's query API"),
        (broken, "cannot receive the answer"),
    ] {
        let url = format!("http://{address}");
        let (code, text) = fleet(&["--engine", &url]);
        assert_eq!(code, Some(1), "{text}");
        assert!(
            text.contains(expected) && text.lines().count() == 1,
            "{text}"
        );
        assert!(text.contains(&url), "{text}");
    }
    let nowhere = TcpListener::bind("127.0.0.1:0")
        .unwrap()
        .local_addr()
        .unwrap();
    let (code, text) = fleet(&["--engine", &format!("http://{nowhere}")]);
    assert_eq!(code, Some(1));
    assert!(text.contains("the connection failed"), "{text}");
}

#[test]
fn an_engine_without_encryption_needs_no_certificate_authorities() {
    let directory = tempfile::tempdir().unwrap();
    let authorities = directory.path().join("none.pem");
    std::fs::write(&authorities, "").unwrap();
    let page = engine(|out| write!(out, "HTTP/1.1 200 OK\r\nContent-Length: 6\r\n\r\n<html>"));
    for (url, expected) in [
        (
            format!("http://{page}"),
            "the answer is not one of Prometheus's query API",
        ),
        (format!("https://{page}"), "cannot prepare the request"),
    ] {
        let mut command = rp();
        command.env("SSL_CERT_FILE", &authorities);
        command.env_remove("SSL_CERT_DIR");
        let output = command.args(["fleet", "--engine", &url]).output().unwrap();
        let text = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(1), "{text}");
        assert!(text.contains(expected), "{url}: {text}");
    }
}

#[test]
fn an_answer_beyond_the_cap_is_refused() {
    let endless = engine(|out| {
        write!(out, "HTTP/1.1 200 OK\r\nContent-Length: 9000000000\r\n\r\n")?;
        loop {
            out.write_all(&[b' '; 1 << 20])?;
        }
    });
    let (code, text) = fleet(&["--engine", &format!("http://{endless}")]);
    assert_eq!(code, Some(1));
    assert!(text.contains("cannot receive the answer"), "{text}");
}

#[test]
fn an_address_and_a_token_are_checked_before_a_request() {
    let (code, text) = fleet(&[]);
    assert_eq!(code, Some(1));
    assert!(
        text.contains("pass --engine URL, or set ROS2PROBE_ENGINE"),
        "{text}"
    );
    let (code, text) = fleet(&["--engine", "prometheus:9090"]);
    assert_eq!(code, Some(1));
    assert!(
        text.contains("`prometheus:9090` is not the URL of an engine"),
        "{text}"
    );
    let directory = tempfile::tempdir().unwrap();
    let token = directory.path().join("token");
    std::fs::write(&token, "x".repeat((64 << 10) + 1)).unwrap();
    let token = token.to_str().unwrap();
    let (code, text) = fleet(&["--engine", "http://127.0.0.1:9", "--token-file", token]);
    assert_eq!(code, Some(1));
    assert!(text.contains(&format!("cannot read {token}")), "{text}");
}
