//! The metrics listener with a `web.yml`: passwords and encryption.

use std::process::{Command, Output};

use crate::rp;
use ros2probe_testing::local_agent;
use ros2probe_testing::local_agent::LocalAgent;
use tempfile::TempDir;

/// A directory with a configuration and with a `web.yml` of this content.
struct Web {
    directory: TempDir,
}

impl Web {
    fn new(web: &str) -> Self {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("web.yml");
        std::fs::write(&path, web).unwrap();
        let config = format!("metrics: {{web_config: {}}}\n", path.display());
        std::fs::write(directory.path().join("config.yaml"), config).unwrap();
        Self { directory }
    }

    fn path(&self, name: &str) -> String {
        self.directory
            .path()
            .join(name)
            .to_str()
            .unwrap()
            .to_owned()
    }

    fn agent(&self) -> LocalAgent {
        let mut agent = LocalAgent::start(&mut rp(), &["--config", &self.path("config.yaml")]);
        agent.wait_for_log("ready");
        agent
    }
}

fn curl(arguments: &[&str]) -> Output {
    let mut curl = Command::new("curl");
    curl.args([
        "--silent",
        "--show-error",
        "--max-time",
        "20",
        "--write-out",
        "\n%{http_code}",
    ]);
    curl.args(arguments).output().unwrap()
}

/// Returns the HTTP status of the answer to curl.
fn status(arguments: &[&str]) -> String {
    let output = curl(arguments);
    let printed = String::from_utf8(output.stdout).unwrap();
    printed.lines().last().unwrap_or_default().to_owned()
}

#[test]
fn a_client_without_the_password_is_refused() {
    let hash = bcrypt::hash("open sesame", 4).unwrap();
    let web = Web::new(&format!("basic_auth_users:\n  alice: {hash}\n"));
    let agent = web.agent();
    for page in ["metrics", "readyz", "healthz", "nothing"] {
        let url = format!("http://{}/{page}", agent.address);
        assert_eq!(status(&[&url]), "401", "{page}");
        assert_eq!(status(&["--user", "alice:sesame", &url]), "401", "{page}");
        assert_eq!(
            status(&["--user", "bob:open sesame", &url]),
            "401",
            "{page}"
        );
    }
    let url = format!("http://{}/metrics", agent.address);
    for _ in 0..2 {
        assert_eq!(status(&["--user", "alice:open sesame", &url]), "200");
    }
    let refused = agent.get("/metrics");
    assert!(refused.headers.contains("www-authenticate: basic"));
}

/// Returns the error of an agent that does not start.
fn refused(web: &Web) -> String {
    let output = rp()
        .args([
            "run",
            "--metrics",
            "127.0.0.1:0",
            "--api",
            "off",
            "--replay",
        ])
        .arg(local_agent::capture())
        .args(["--config", &web.path("config.yaml")])
        .output()
        .unwrap();
    assert!(!output.status.success());
    String::from_utf8(output.stderr).unwrap()
}

#[test]
fn an_invalid_web_config_prevents_the_start_of_the_agent() {
    let printed = refused(&Web::new("basic_auth_users:\n  alice: secret\n"));
    assert!(
        printed.contains("the hash of `alice` is not a bcrypt hash"),
        "{printed}"
    );
    let web = Web::new("");
    std::fs::remove_file(web.path("web.yml")).unwrap();
    let printed = refused(&web);
    assert!(
        printed.contains("web.yml (`metrics.web_config`): No such file"),
        "{printed}"
    );
}

#[test]
fn an_encrypted_listener_answers_only_clients_that_trust_its_certificate() {
    let hash = bcrypt::hash("open sesame", 4).unwrap();
    let web = Web::new(&format!(
        "tls_server_config: {{cert_file: a.crt, key_file: a.key, min_version: TLS13}}\n\
         basic_auth_users: {{alice: {hash}}}\n"
    ));
    let printed = refused(&web);
    assert!(
        printed.contains("a.crt") || printed.contains("a.key"),
        "{printed}"
    );
    let made = Command::new("openssl")
        .args([
            "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2",
        ])
        .args([
            "-subj",
            "/CN=robot",
            "-addext",
            "subjectAltName=IP:127.0.0.1",
        ])
        .args(["-keyout", &web.path("a.key"), "-out", &web.path("a.crt")])
        .output()
        .unwrap_or_else(|error| panic!("openssl: {error}; `apt-get install openssl`"));
    assert!(made.status.success());
    let agent = web.agent();
    let url = format!("https://{}/metrics", agent.address);
    let known = web.path("a.crt");
    let user = ["--user", "alice:open sesame"];
    assert_eq!(status(&["--cacert", &known, user[0], user[1], &url]), "200");
    assert_eq!(status(&["--cacert", &known, &url]), "401");
    assert_eq!(status(&[user[0], user[1], &url]), "000");
    assert_eq!(
        status(&["--cacert", &known, "--tls-max", "1.2", &url]),
        "000"
    );
    let plain = format!("http://{}/metrics", agent.address);
    assert_eq!(status(&[&plain]), "000");
    // A client without a TLS handshake does not delay others.
    let _silent = std::net::TcpStream::connect(agent.address).unwrap();
    assert_eq!(status(&["--cacert", &known, user[0], user[1], &url]), "200");
}
