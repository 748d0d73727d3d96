//! Remote write: a receiver gets the samples of the page, also after it failed or refused.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use ros2probe_metrics::catalogue::{CATALOGUE, Kind};
use ros2probe_testing::local_agent::{LocalAgent, PATIENCE};
use ros2probe_testing::remote_write::{Labels, Receiver, Reply, Write};
use tokio_rustls::rustls::pki_types::pem::PemObject as _;
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer};
use tokio_rustls::rustls::server::WebPkiClientVerifier;
use tokio_rustls::rustls::{RootCertStore, ServerConfig};

use crate::otlp::changes;
use crate::otlp_tls::{make_certificate, make_server_config};
use crate::rp;

/// Value of a series that ended.
const STALE: u64 = 0x7ff0_0000_0000_0002;

/// Starts an agent that sends to this receiver each second.
fn sending(receiver: &Receiver, directory: &Path, more: &str) -> LocalAgent {
    sending_to(&format!("http://{}", receiver.address), directory, more)
}

fn sending_to(url: &str, directory: &Path, more: &str) -> LocalAgent {
    let configuration = directory.join("ros2probe.yaml");
    let yaml = format!(
        "remote_write: {{url: '{url}/api/v1/write', interval_s: 1, instance: robot7, \
         labels: {{site: hall2}}{more}}}\n"
    );
    std::fs::write(&configuration, yaml).unwrap();
    let configuration = configuration.to_str().unwrap();
    LocalAgent::start(&mut rp(), &["--config", configuration, "--watch", "/**"])
}

fn requests(outcome: &str) -> String {
    format!("ros2probe_remote_write_requests_total{{outcome=\"{outcome}\"}}")
}

fn samples(outcome: &str) -> String {
    format!("ros2probe_remote_write_samples_total{{outcome=\"{outcome}\"}}")
}

/// Returns the series of a page with its labels and those of the robot.
fn page_series(page: &str) -> BTreeMap<Labels, f64> {
    let lines = page.lines().filter(|line| !line.starts_with('#'));
    let series = lines.map(|line| {
        let (series, value) = line.rsplit_once(' ').unwrap();
        let (name, labels) = series.split_once('{').unwrap_or((series, "}"));
        let labels = labels.trim_end_matches('}').split_terminator("\",");
        let mut labels: Labels = labels
            .map(|label| {
                let (name, value) = label.split_once("=\"").unwrap();
                let value = value.trim_end_matches('"');
                // Prometheus stores the bound `1` as `1.0`, and `0.00001` as `1e-05`.
                let bound = value.parse().ok().filter(|bound: &f64| bound.is_finite());
                let value = match bound.filter(|_| name == "le") {
                    Some(bound) if bound < 1e-4 => format!("{bound:e}").replace("e-", "e-0"),
                    Some(bound) => format!("{bound:?}"),
                    None => value.to_owned(),
                };
                (name.to_owned(), value)
            })
            .filter(|(_, value)| !value.is_empty())
            .collect();
        for (label, value) in [
            ("__name__", name),
            ("job", "ros2probe"),
            ("instance", "robot7"),
            ("site", "hall2"),
        ] {
            labels.insert(label.to_owned(), value.to_owned());
        }
        (labels, value.parse().unwrap())
    });
    series.collect()
}

/// Returns whether a series has the same value in the next scrape of a finished replay.
fn is_constant(labels: &Labels) -> bool {
    let name = labels["__name__"].as_str();
    !changes(name) && !name.starts_with("ros2probe_remote_write_") && name != "up"
}

/// Asserts that the last samples are those of the page. A figure may change between the two, so
/// that the next samples count, too.
fn assert_same_as_page(receiver: &Receiver, agent: &LocalAgent) {
    let mut difference = String::new();
    for _ in 0..5 {
        let sent = receiver.stored().len();
        receiver.wait_for("samples", |stored| stored.len() > sent);
        let page = agent.get("/metrics").body;
        let last = receiver.stored().pop().unwrap();
        let expected = page_series(&page).into_iter();
        let expected = expected.filter(|(labels, _)| is_constant(labels));
        let sent = last.series.iter();
        let sent = sent.filter(|(labels, _)| is_constant(labels));
        let sent = sent.map(|(labels, samples)| (labels.clone(), samples[0].1));
        difference = difference_of(&expected.collect(), &sent.collect());
        if difference.is_empty() {
            return;
        }
    }
    panic!("{difference}");
}

fn difference_of(expected: &BTreeMap<Labels, f64>, sent: &BTreeMap<Labels, f64>) -> String {
    assert!(expected.len() > 100);
    let keys: BTreeSet<_> = expected.keys().chain(sent.keys()).collect();
    let different = keys
        .into_iter()
        .filter(|key| expected.get(*key) != sent.get(*key));
    let lines =
        different.map(|key| format!("{key:?}: {:?}, {:?}\n", expected.get(key), sent.get(key)));
    lines.collect()
}

#[test]
fn a_receiver_gets_the_series_of_the_page_with_the_types_of_their_metrics() {
    let directory = tempfile::tempdir().unwrap();
    let receiver = Receiver::start(Reply::stored);
    let agent = sending(&receiver, directory.path(), "");
    agent.wait_for_metric("ros2probe_ready", |ready| ready > 0.5);
    let before = receiver.stored().len();
    receiver.wait_for("samples", |stored| stored.len() > before + 2);
    let stored = receiver.stored();
    let last = stored.last().unwrap();
    assert_eq!(last.version, "2.0.0");
    assert_eq!(last.of("up").len(), 1);
    assert_same_as_page(&receiver, &agent);
    for metric in CATALOGUE {
        let (name, kind) = match metric.kind {
            Kind::Counter => (metric.name.to_owned(), 1),
            Kind::Gauge => (metric.name.to_owned(), 2),
            Kind::Histogram => (format!("{}_bucket", metric.name), 3),
            Kind::Info => (metric.name.to_owned(), 6),
        };
        if let Some(sent) = last.kinds.get(&name) {
            assert_eq!(*sent, kind, "{name}");
        }
    }
    assert!(last.kinds.len() > 60);
}

#[test]
fn a_receiver_of_version_1_gets_the_same_series() {
    // It ignores the fields of version 2.0, as old receivers do, or refuses them.
    for status in [204, 415] {
        let directory = tempfile::tempdir().unwrap();
        let receiver = Receiver::start(move |write| match write.version.as_str() {
            "2.0.0" => Reply::status(status),
            _ => Reply::stored(write),
        });
        let agent = sending(&receiver, directory.path(), "");
        agent.wait_for_metric("ros2probe_ready", |ready| ready > 0.5);
        let before = receiver.stored().len();
        receiver.wait_for("samples", |stored| stored.len() > before + 2);
        let stored = receiver.stored();
        assert_eq!(stored.last().unwrap().version, "0.1.0");
        assert_same_as_page(&receiver, &agent);
        let page = agent.get("/metrics").body;
        let retried = ros2probe_testing::local_agent::metric(&page, &requests("retried"));
        assert_eq!(retried, Some(1.0));
    }
}

#[test]
fn one_refusal_without_the_version_changes_no_version_and_a_second_one_does() {
    let directory = tempfile::tempdir().unwrap();
    let receiver = Receiver::start(Reply::stored);
    let agent = sending(&receiver, directory.path(), "");
    receiver.wait_for("samples", |stored| !stored.is_empty());
    for refusals in [1, 2] {
        // The portal of a network answers, or a proxy.
        let mut left = 1;
        receiver.answer(move |write| match std::mem::take(&mut left) {
            1 => Reply::status(400),
            _ => Reply::stored(write),
        });
        let expected = f64::from(refusals) - 0.5;
        agent.wait_for_metric(&requests("retried"), |count| count > expected);
        let before = receiver.stored().len();
        receiver.wait_for("samples", |stored| stored.len() > before + 1);
        assert_eq!(receiver.stored().last().unwrap().version, "2.0.0");
    }
    // A receiver of version 1.0 takes the place of the first one.
    receiver.answer(|write| match write.version.as_str() {
        "2.0.0" => Reply::status(415),
        _ => Reply::stored(write),
    });
    receiver.wait_for("samples of version 1.0", |stored| {
        stored.last().is_some_and(|write| write.version == "0.1.0")
    });
}

#[test]
fn samples_refused_temporarily_are_sent_later_in_order_and_once() {
    let directory = tempfile::tempdir().unwrap();
    let mut answers = [500, 429, 401, 503].into_iter();
    let receiver = Receiver::start(move |write| match answers.next() {
        None => Reply::stored(write),
        Some(429) => Reply {
            headers: vec![("Retry-After", "1".to_owned())],
            ..Reply::status(429)
        },
        Some(status) => Reply::status(status),
    });
    let mut agent = sending(&receiver, directory.path(), "");
    agent.wait_for_log("out of reach");
    agent.wait_for_metric("ros2probe_remote_write_behind_seconds", |age| age > 1.5);
    agent.wait_for_metric(&requests("delivered"), |count| count > 2.5);
    agent.wait_for_metric("ros2probe_remote_write_behind_seconds", |age| age < 1.0);
    agent.wait_for_metric(&requests("retried"), |count| (3.5..4.5).contains(&count));
    let up = receiver.of("up");
    assert!(up.len() > 6, "{up:?}");
    let gaps = up.windows(2).map(|pair| pair[1].0 - pair[0].0);
    let gaps: Vec<_> = gaps.collect();
    // Ticks that a busy machine missed are skipped, so gaps are whole seconds.
    assert!(
        gaps.iter().all(|gap| (500..6_000).contains(gap)),
        "{gaps:?}"
    );
    let delivered = receiver.stored().iter().map(Write::samples).sum::<usize>();
    agent.wait_for_metric(&samples("delivered"), |count| count >= delivered as f64);
    agent.wait_for_metric(&samples("overflow"), |count| count < 0.5);
}

#[test]
fn a_receiver_that_demands_no_pause_gets_growing_pauses() {
    let directory = tempfile::tempdir().unwrap();
    let requests = Arc::new(Mutex::new(Vec::new()));
    let noted = Arc::clone(&requests);
    let receiver = Receiver::start(move |_| {
        noted.lock().unwrap().push(Instant::now());
        Reply {
            headers: vec![("Retry-After", "0".to_owned())],
            ..Reply::status(503)
        }
    });
    let mut agent = sending(&receiver, directory.path(), "");
    agent.wait_for_log("out of reach");
    let deadline = Instant::now() + PATIENCE;
    let times = loop {
        let times: Vec<Instant> = requests.lock().unwrap().clone();
        if times.len() > 2 {
            break times;
        }
        assert!(Instant::now() < deadline, "{} requests", times.len());
        std::thread::sleep(Duration::from_millis(50));
    };
    // A pause begins after the answer to a request.
    let pauses: Vec<_> = times.windows(2).map(|pair| pair[1] - pair[0]).collect();
    for (pause, least) in pauses.iter().zip([1, 2]) {
        assert!(*pause >= Duration::from_secs(least), "{pauses:?}");
    }
}

#[test]
fn a_sample_that_a_receiver_refuses_drops_no_other_sample() {
    let directory = tempfile::tempdir().unwrap();
    let receiver = Receiver::start(|_| Reply::status(503));
    let mut agent = sending(&receiver, directory.path(), "");
    agent.wait_for_metric("ros2probe_remote_write_behind_seconds", |age| age > 4.0);
    receiver.refuse_one_sample();
    let log = agent.wait_for_log("refuses samples");
    assert!(
        log.contains("400 Bad Request: as the test demands"),
        "{log}"
    );
    agent.wait_for_metric(&requests("delivered"), |count| count > 3.5);
    let refused = agent.wait_for_metric(&samples("refused"), |count| count > 100.0);
    let up = receiver.of("up");
    let wide = up.windows(2).filter(|pair| pair[1].0 - pair[0].0 > 1_500);
    assert!(up.is_sorted_by(|one, two| one.0 < two.0));
    assert!(wide.count() >= 1);
    // Only the samples of one moment are missing.
    let moment = receiver.stored().last().unwrap().samples() as f64;
    assert!(refused < moment * 1.2, "{refused} of {moment}");
}

#[test]
fn a_long_answer_is_not_read() {
    let directory = tempfile::tempdir().unwrap();
    let receiver = Receiver::start(|_| Reply {
        text: "x".repeat(100_000),
        ..Reply::status(503)
    });
    let mut agent = sending(&receiver, directory.path(), "");
    let log = agent.wait_for_log("out of reach");
    assert!(
        log.contains("reason=\"503 Service Unavailable: \""),
        "{log}"
    );
    receiver.answer(|write| Reply {
        text: "x".repeat(100_000),
        ..Reply::stored(write)
    });
    receiver.wait_for("samples", |stored| stored.len() > 1);
}

#[test]
fn an_agent_that_ends_sends_its_last_samples_and_the_end_of_its_series() {
    let directory = tempfile::tempdir().unwrap();
    let receiver = Receiver::start(Reply::stored);
    let mut agent = sending(&receiver, directory.path(), "");
    receiver.wait_for("samples", |stored| stored.len() > 1);
    agent.signal("-TERM");
    assert!(agent.wait().success());
    let stored = receiver.stored();
    let mut last = BTreeMap::new();
    for (labels, samples) in stored.iter().flat_map(|write| &write.series) {
        last.extend(samples.last().map(|(_, value)| (labels, value.to_bits())));
    }
    assert!(last.len() > 100);
    assert!(last.values().all(|value| *value == STALE));
    let up = receiver.of("up");
    assert_eq!(up[up.len() - 1].0 - up[up.len() - 2].0, 1);
}

#[test]
fn an_agent_without_a_receiver_ends_in_time_and_counts_its_loss() {
    let directory = tempfile::tempdir().unwrap();
    let receiver = Receiver::start(|_| Reply::status(503));
    let mut agent = sending(&receiver, directory.path(), "");
    agent.wait_for_metric(&requests("retried"), |count| count > 0.5);
    let begun = Instant::now();
    agent.signal("-TERM");
    assert!(agent.wait().success());
    assert!(begun.elapsed() < Duration::from_secs(30));
    assert_eq!(receiver.stored().len(), 0);
}

#[test]
fn a_replaced_token_applies_to_the_next_request() {
    let directory = tempfile::tempdir().unwrap();
    let token = directory.path().join("token");
    std::fs::write(&token, "first\n").unwrap();
    let receiver = Receiver::start(|write| match write.authorization.as_str() {
        "Bearer second" => Reply::stored(write),
        _ => Reply::status(401),
    });
    let more = format!(", token_file: {}", token.display());
    let mut agent = sending(&receiver, directory.path(), &more);
    agent.wait_for_log("401 Unauthorized");
    std::fs::write(&token, "second\n").unwrap();
    receiver.wait_for("samples", |stored| stored.len() > 2);
    let log = agent.log();
    assert!(!log.contains("first") && !log.contains("second"), "{log}");
    let missing = ", token_file: /no/such/token";
    let error = refused_to_start(&receiver, directory.path(), missing);
    assert!(
        error.contains("remote_write.token_file: cannot read /no/such/token"),
        "{error}"
    );
}

#[test]
fn a_robot_that_is_locked_out_stops_no_other_one_and_loses_nothing_if_it_returns() {
    let directories = [tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap()];
    let locked = Arc::new(Mutex::new(false));
    let is_locked = Arc::clone(&locked);
    let receiver = Receiver::start(move |write| match write.authorization.as_str() {
        "Bearer stolen" if *is_locked.lock().unwrap() => Reply::status(403),
        "Bearer stolen" | "Bearer other" => Reply::stored(write),
        _ => Reply::status(401),
    });
    let start = |directory: &Path, token: &str| {
        let file = directory.join("token");
        std::fs::write(&file, token).unwrap();
        sending(
            &receiver,
            directory,
            &format!(", token_file: {}", file.display()),
        )
    };
    let mut stolen = start(directories[0].path(), "stolen");
    let _other = start(directories[1].path(), "other");
    let of = |stored: &[Write], token: &str| -> Vec<i64> {
        let header = format!("Bearer {token}");
        let own = stored.iter().filter(|write| write.authorization == header);
        own.flat_map(|write| write.of("up"))
            .map(|(at, _)| *at)
            .collect()
    };
    receiver.wait_for("samples of both", |stored| {
        ["stolen", "other"]
            .iter()
            .all(|token| of(stored, token).len() > 2)
    });
    *locked.lock().unwrap() = true;
    stolen.wait_for_log("403 Forbidden");
    let stored = receiver.stored();
    let (before, others) = (of(&stored, "stolen").len(), of(&stored, "other").len());
    receiver.wait_for("samples of the other robot", |stored| {
        of(stored, "other").len() > others + 3
    });
    assert_eq!(of(&receiver.stored(), "stolen").len(), before);
    *locked.lock().unwrap() = false;
    receiver.wait_for("samples of the robot that returned", |stored| {
        of(stored, "stolen").len() > before + 3
    });
    for token in ["stolen", "other"] {
        let times = of(&receiver.stored(), token);
        let gaps: Vec<_> = times.windows(2).map(|pair| pair[1] - pair[0]).collect();
        // A busy machine skips collections.
        assert!(
            gaps.iter().all(|gap| (1..6_000).contains(gap)),
            "{token}: {gaps:?}"
        );
    }
}

/// Returns what an agent prints that cannot start.
fn refused_to_start(receiver: &Receiver, directory: &Path, more: &str) -> String {
    let configuration = directory.join("wrong.yaml");
    let yaml = format!(
        "remote_write: {{url: 'http://{}/api/v1/write'{more}}}\n",
        receiver.address
    );
    std::fs::write(&configuration, yaml).unwrap();
    let capture = ros2probe_testing::local_agent::capture();
    let output = rp()
        .args(["run", "--foxglove", "off", "--metrics", "127.0.0.1:0"])
        .args(["--api", "off", "--config"])
        .arg(&configuration)
        .arg("--replay")
        .arg(capture)
        .output()
        .unwrap();
    assert!(!output.status.success());
    String::from_utf8(output.stderr).unwrap()
}

#[test]
fn a_receiver_that_demands_certificates_accepts_a_renewed_one() {
    let directory = tempfile::tempdir().unwrap();
    let path = |name: &str| directory.path().join(name);
    make_certificate(directory.path());
    let pem = |name: &str| CertificateDer::from_pem_file(path(name)).unwrap();
    // The receiver knows robots whose certificates this authority has signed.
    let mut known = RootCertStore::empty();
    known.add(pem("authority")).unwrap();
    let verifier = WebPkiClientVerifier::builder(Arc::new(known))
        .build()
        .unwrap();
    let key = PrivateKeyDer::from_pem_file(path("key")).unwrap();
    let config = ServerConfig::builder().with_client_cert_verifier(verifier);
    let config = config
        .with_single_cert(vec![pem("certificate")], key)
        .unwrap();
    let receiver = Receiver::start_tls(config, Reply::stored);

    // The certificate of the robot is signed by another authority at first.
    let other = tempfile::tempdir().unwrap();
    make_certificate(other.path());
    let copy = |from: &Path| {
        for name in ["certificate", "key"] {
            std::fs::copy(from.join(name), path(&format!("robot.{name}"))).unwrap();
        }
    };
    copy(other.path());
    let more = format!(
        ", ca_file: {}, certificate_file: {}, key_file: {}",
        path("authority").display(),
        path("robot.certificate").display(),
        path("robot.key").display()
    );
    let url = format!("https://localhost:{}", receiver.address.port());
    let mut agent = sending_to(&url, directory.path(), &more);
    agent.wait_for_log("out of reach");
    assert_eq!(receiver.stored().len(), 0);
    copy(directory.path());
    receiver.wait_for("samples", |stored| stored.len() > 2);

    let damaged = path("damaged");
    std::fs::write(&damaged, "no certificate").unwrap();
    let more = format!(", ca_file: {}", damaged.display());
    let error = refused_to_start(&receiver, directory.path(), &more);
    assert!(
        error.contains("has no valid content (certificates in PEM)"),
        "{error}"
    );
}

#[test]
fn a_damaged_replaced_file_is_logged_once_and_stops_no_samples() {
    let directory = tempfile::tempdir().unwrap();
    let path = |name: &str| directory.path().join(name);
    let config = make_server_config(directory.path());
    let receiver = Receiver::start_tls(config, Reply::stored);
    std::fs::copy(path("authority"), path("robot.authority")).unwrap();
    let more = format!(", ca_file: {}", path("robot.authority").display());
    let url = format!("https://localhost:{}", receiver.address.port());
    let mut agent = sending_to(&url, directory.path(), &more);
    receiver.wait_for("samples", |stored| stored.len() > 1);
    std::fs::write(path("robot.authority"), "no certificate").unwrap();
    agent.wait_for_log("a replaced file of remote write cannot be used");
    let before = receiver.stored().len();
    receiver.wait_for("samples", |stored| stored.len() > before + 3);
    let log = agent.log();
    assert_eq!(log.matches("cannot be used").count(), 1, "{log}");
    assert!(!log.contains("out of reach"), "{log}");
}

#[test]
fn the_rate_of_bytes_is_limited() {
    let directory = tempfile::tempdir().unwrap();
    let receiver = Receiver::start(Reply::stored);
    let agent = sending(&receiver, directory.path(), ", max_bytes_per_second: 2000");
    // A request of each second has about 4 kB, so that samples of several seconds share one.
    receiver.wait_for("samples of several moments", |stored| {
        stored.iter().any(|write| write.of("up").len() > 1)
    });
    let sent = agent.wait_for_metric("ros2probe_remote_write_sent_bytes_total", |sent| sent > 9e3);
    let lengths: usize = receiver.stored().iter().map(|write| write.length).sum();
    assert!(lengths as f64 >= sent, "{lengths} of {sent}");
}

#[test]
fn series_beyond_those_of_an_hour_are_omitted_and_counted() {
    const LIMIT: usize = 50;
    let directory = tempfile::tempdir().unwrap();
    let receiver = Receiver::start(Reply::stored);
    let more = format!(", max_new_series_per_hour: {LIMIT}");
    let mut agent = sending(&receiver, directory.path(), &more);
    let log = agent.wait_for_log("too many series begin in an hour");
    assert!(log.contains("limit=50"), "{log}");
    receiver.wait_for("samples", |stored| stored.len() > 3);
    agent.wait_for_metric(&samples("series_limit"), |count| count > 100.0);
    let stored = receiver.stored();
    let series = stored.iter().flat_map(|write| &write.series);
    let series: BTreeSet<&Labels> = series.map(|(labels, _)| labels).collect();
    assert_eq!(series.len(), LIMIT);
    // Those that began go on.
    assert!(!stored.last().unwrap().of("up").is_empty());
    let line = "too many series begin in an hour";
    assert_eq!(agent.log().matches(line).count(), 1);
}

#[test]
fn invalid_sections_are_refused_with_their_position() {
    let directory = tempfile::tempdir().unwrap();
    let configuration = directory.path().join("ros2probe.yaml");
    let report = |section: &str| {
        std::fs::write(&configuration, format!("remote_write:\n{section}")).unwrap();
        let mut command = rp();
        command.args(["check-config", configuration.to_str().unwrap()]);
        let output = command.output().unwrap();
        assert!(!output.status.success());
        String::from_utf8(output.stderr).unwrap()
    };
    let texts = report("  url: prometheus:9090\n  key_file: robot.key\n");
    let meanings = report("  key_file: /robot.key\n  labels: {a-b: c, __name__: d}\n");
    for (text, expected) in [
        (
            &texts,
            ":2:8: remote_write.url: must be the URL of a receiver",
        ),
        (
            &texts,
            ":3:13: remote_write.key_file: must be an absolute path",
        ),
        (
            &meanings,
            ":3:17: remote_write.labels.a-b: is no name of a label",
        ),
        (
            &meanings,
            "remote_write.labels.__name__: is no name of a label",
        ),
        (
            &meanings,
            ":2:3: remote_write: needs both certificate_file and key_file",
        ),
    ] {
        assert!(text.contains(expected), "{expected} in\n{text}");
    }
}
