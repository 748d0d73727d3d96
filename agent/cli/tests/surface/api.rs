//! The control API of the real binary, on free ports of this host.

use std::net::TcpStream;
use std::os::unix::fs::PermissionsExt as _;
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use crate::rp;
use ros2probe::config::Expectations;
use ros2probe_testing::local_agent::{self, Answer, LocalAgent, PATIENCE, capture, exchange};
use serde_json::Value;

/// A request with headers (each line ended) and a body.
fn ask(agent: &LocalAgent, method: &str, path: &str, headers: &str, body: &str) -> Answer {
    let stream = TcpStream::connect(agent.api).unwrap();
    let host = agent.api;
    let length = body.len();
    let head = format!(
        "{method} {path} HTTP/1.1\r\nHost: {host}\r\nContent-Length: {length}\r\n{headers}"
    );
    exchange(stream, &head, body)
}

/// The status and the end of the problem's type, or nothing.
fn problem(answer: &Answer) -> (u16, String) {
    let body: Value = serde_json::from_str(&answer.body).unwrap_or_default();
    let code = body["type"].as_str().unwrap_or_default().to_owned();
    if !code.is_empty() {
        assert!(
            answer
                .headers
                .contains("content-type: application/problem+json")
        );
        assert_eq!(body["status"], answer.status);
    }
    (answer.status, code.replace("urn:ros2probe:problem:", ""))
}

/// Asks until the answer is as wanted.
fn wait_for(agent: &LocalAgent, path: &str, wanted: impl Fn(&Value) -> bool) -> Value {
    let deadline = Instant::now() + PATIENCE;
    loop {
        let answer = ask(agent, "GET", path, "", "");
        let body = serde_json::from_str(&answer.body).unwrap();
        if wanted(&body) {
            return body;
        }
        assert!(Instant::now() < deadline, "{path}: {}", answer.body);
        std::thread::sleep(Duration::from_millis(20));
    }
}

#[test]
fn the_checked_in_document_is_the_generated_one() {
    let generated = ros2probe::surface::api::document()
        .to_pretty_json()
        .unwrap()
        + "\n";
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config/openapi.json");
    if std::env::var_os("UPDATE_OPENAPI").is_some() {
        std::fs::write(&path, &generated).unwrap();
    }
    assert_eq!(
        std::fs::read_to_string(path).unwrap(),
        generated,
        "run `UPDATE_OPENAPI=1 cargo test -p ros2probe --test surface api::` and commit the result"
    );
}

#[test]
fn the_document_says_of_topics_and_limits_what_the_agent_accepts() {
    let document = serde_json::to_value(ros2probe::surface::api::document()).unwrap();
    let topic = &document["paths"]["/watch/{topic}"]["post"]["parameters"][0]["schema"];
    assert!(topic["pattern"].is_string(), "{topic}");
    let validator = jsonschema::validator_for(topic).unwrap();
    let long = format!("a{}", "/b".repeat(127));
    for name in [
        "a",
        "a/b",
        "_a/b_1",
        "*",
        "**",
        "a/**/b",
        "cam*/raw",
        "*a*",
        "*1",
        "a*b*",
        "",
        "/a",
        "a/",
        "a//b",
        "1a",
        "a/1b",
        "a**",
        "**a",
        "a b",
        "a-b",
        "a.b",
        "\u{e9}",
        "a*",
        "**/**",
        "*/*",
        &long,
        &format!("{long}c"),
    ] {
        let documented = validator.is_valid(&Value::from(name));
        let accepted = ros2probe::config::watch::check_pattern(&format!("/{name}")).is_ok();
        assert_eq!(documented, accepted, "{name}");
    }
    let schema = ros2probe::config::Config::schema();
    let configured = &schema["$defs"]["WatchShape"]["anyOf"][1]["properties"];
    let body = &document["components"]["schemas"]["WatchRequest"]["properties"];
    let (mut low, mut high) = (Expectations::default(), Expectations::default());
    for (key, place) in [
        ("min_rate_hz", (&mut low.min_rate_hz, &mut high.min_rate_hz)),
        ("max_rate_hz", (&mut low.max_rate_hz, &mut high.max_rate_hz)),
        (
            "max_loss_ratio",
            (&mut low.max_loss_ratio, &mut high.max_loss_ratio),
        ),
        (
            "max_latency_ms",
            (&mut low.max_latency_ms, &mut high.max_latency_ms),
        ),
        (
            "max_silence_s",
            (&mut low.max_silence_s, &mut high.max_silence_s),
        ),
    ] {
        for (limit, place) in [("minimum", place.0), ("maximum", place.1)] {
            let value = configured[key][limit].as_f64();
            assert!(value.is_some(), "{key} {limit}: {configured}");
            assert_eq!(body[key][limit].as_f64(), value, "{key} {limit}");
            *place = value;
        }
    }
    assert_eq!((low.check(), high.check()), (Ok(()), Ok(())));
    let beyond = |change: fn(&mut Expectations)| {
        let mut wrong = Expectations::default();
        change(&mut wrong);
        wrong.check().is_err()
    };
    assert!(beyond(|wrong| wrong.min_rate_hz = Some(-0.1)));
    assert!(beyond(|wrong| wrong.max_rate_hz = Some(1_000_000.1)));
    assert!(beyond(|wrong| wrong.max_loss_ratio = Some(1.1)));
    assert!(beyond(|wrong| wrong.max_latency_ms = Some(3_600_000.1)));
    assert!(beyond(|wrong| wrong.max_silence_s = Some(0.0)));
    assert!(beyond(|wrong| wrong.max_silence_s = Some(f64::NAN)));
    assert!(beyond(
        |wrong| (wrong.min_rate_hz, wrong.max_rate_hz) = (Some(2.0), Some(1.0))
    ));
}

/// Text of so many characters that the parameter may have.
fn filler(parameter: &str, length: usize) -> String {
    let mut text = String::new();
    match parameter {
        "topic" | "exclude" => {
            while text.len() < length {
                let left = length - text.len();
                // The last name has two characters at least.
                let part = if left <= 202 { left } else { 200 };
                text += &format!("/{}", "a".repeat(part - 1));
                if text.len() < length {
                    text.pop();
                    text.push(',');
                }
            }
            text
        }
        "name" if length <= 1025 => {
            // Blanks around a name do not count.
            format!("{}ros2.message.lost", "+".repeat(length - 17))
        }
        _ => "a".repeat(length),
    }
}

/// The status of an answer that may have no end.
fn status(agent: &LocalAgent, method: &str, path: &str, body: &str) -> u16 {
    use std::io::{Read as _, Write as _};
    let mut stream = TcpStream::connect(agent.api).unwrap();
    stream
        .set_read_timeout(Some(local_agent::PATIENCE))
        .unwrap();
    let (api, length) = (agent.api, body.len());
    let head = format!(
        "{method} {path} HTTP/1.1\r\nHost: {api}\r\nContent-Type: application/json\r\n\
         Content-Length: {length}\r\n\r\n{body}"
    );
    stream.write_all(head.as_bytes()).unwrap();
    let mut answer = [0; 16];
    stream.read_exact(&mut answer).unwrap();
    let answer = String::from_utf8(answer.to_vec()).unwrap();
    answer.split(' ').nth(1).unwrap().parse().unwrap()
}

#[test]
fn every_bound_of_the_document_is_the_agents_and_the_next_value_is_refused() {
    let directory = tempfile::tempdir().unwrap();
    let config = directory.path().join("config.yaml");
    let bags = directory.path().join("bags");
    let text = format!(
        "recordings: {{directory: {}, reserve_percent: 0, reserve_bytes: 0}}\nlimits: {{recordings: 64}}\n",
        bags.display()
    );
    std::fs::write(&config, text).unwrap();
    let mut agent = LocalAgent::start(
        &mut rp(),
        &["--config", config.to_str().unwrap(), "--speed", "max"],
    );
    agent.wait_for_log("ready");
    let document = serde_json::to_value(ros2probe::surface::api::document()).unwrap();
    let mut checked = 0;
    let mut check = |what: &str, allowed: u16, beyond: u16| {
        assert!(
            !matches!(allowed, 400 | 422),
            "{what}: the bound is refused: {allowed}"
        );
        assert!(matches!(beyond, 400 | 422), "{what}: beyond it: {beyond}");
        checked += 1;
    };
    for (path, item) in document["paths"].as_object().unwrap() {
        let Some(parameters) = item["get"]["parameters"].as_array() else {
            continue;
        };
        let path = path
            .replace("{topic}", "chatter")
            .replace("{node}", "talker");
        for parameter in parameters
            .iter()
            .filter(|parameter| parameter["in"] == "query")
        {
            let (name, schema) = (parameter["name"].as_str().unwrap(), &parameter["schema"]);
            let ask = |value: &str| {
                // Without a topic nothing is wanted.
                let topic = match (path.as_str(), name) {
                    ("/samples", "exclude" | "exclude_regex" | "domain_id" | "queue_bytes") => {
                        "topic=/a&"
                    }
                    _ => "",
                };
                status(&agent, "GET", &format!("{path}?{topic}{name}={value}"), "")
            };
            let what = format!("{path} {name}");
            if let Some(maximum) = schema["maximum"].as_i64() {
                check(
                    &what,
                    ask(&maximum.to_string()),
                    ask(&(maximum + 1).to_string()),
                );
            }
            if let Some(minimum) = schema["minimum"].as_i64() {
                check(
                    &what,
                    ask(&minimum.to_string()),
                    ask(&(minimum - 1).to_string()),
                );
            }
            if let Some(longest) = schema["maxLength"].as_u64() {
                let longest = usize::try_from(longest).unwrap();
                check(
                    &what,
                    ask(&filler(name, longest)),
                    ask(&filler(name, longest + 1)),
                );
            }
        }
    }
    for (method, path, schema) in [
        ("POST", "/recordings", "RecordingRequest"),
        ("PUT", "/watch/a", "WatchRequest"),
    ] {
        let properties = &document["components"]["schemas"][schema]["properties"];
        for (name, schema) in properties.as_object().unwrap() {
            let ask = |value: Value| {
                let body = serde_json::json!({ name.as_str(): value }).to_string();
                status(&agent, method, path, &body)
            };
            let what = format!("{path} {name}");
            for (bound, step) in [("maximum", 1.0), ("minimum", -1.0)] {
                if let Some(value) = schema[bound].as_f64() {
                    // Whole numbers stay whole.
                    let beyond = schema[bound].as_i64().map_or_else(
                        || Value::from(value + step),
                        |value| Value::from(value + if step > 0.0 { 1 } else { -1 }),
                    );
                    check(&what, ask(schema[bound].clone()), ask(beyond));
                }
            }
            if let Some(longest) = schema["maxLength"].as_u64() {
                let longest = usize::try_from(longest).unwrap();
                let text = |length| Value::from("a".repeat(length));
                check(&what, ask(text(longest)), ask(text(longest + 1)));
            }
        }
    }
    eprintln!("{checked} bounds");
    assert!(checked >= 30, "{checked}");
}

#[test]
fn a_watch_is_added_shown_replaced_and_removed() {
    let mut agent = LocalAgent::start(&mut rp(), &["--speed", "0.5"]);
    agent.wait_for_log("ready");
    let json = "Content-Type: application/json\r\n";
    let added = ask(&agent, "POST", "/watch/chatter", "", "");
    assert_eq!(added.status, 201, "{}", added.body);
    assert!(added.headers.contains("location: /watch/chatter\r\n"));
    assert_eq!(ask(&agent, "POST", "/watch/chatter", "", "").status, 200);

    let other = ask(
        &agent,
        "POST",
        "/watch/chatter",
        json,
        "{\"max_silence_s\": 2}",
    );
    assert_eq!(problem(&other), (409, "watch-differs".to_owned()));
    let replaced = ask(
        &agent,
        "PUT",
        "/watch/chatter",
        json,
        "{\"max_silence_s\": 2}",
    );
    assert_eq!(replaced.status, 200);

    let shown = wait_for(&agent, "/watch/chatter", |shown| {
        shown["state"] == "measuring" && shown["topics"][0]["messages"] != 0
    });
    assert_eq!(shown["origin"], "api");
    assert_eq!(shown["max_silence_s"], 2.0);

    // Of a topic that is not there, in one domain.
    let later = ask(
        &agent,
        "POST",
        "/watch/camera/front/image_raw?domain_id=5",
        "",
        "",
    );
    assert!(
        later
            .headers
            .contains("location: /watch/camera/front/image_raw?domain_id=5")
    );
    let encoded = "/watch/camera%2Ffront%2Fimage_raw?domain_id=5";
    let shown = ask(&agent, "GET", encoded, "", "");
    let shown: Value = serde_json::from_str(&shown.body).unwrap();
    assert_eq!(shown["state"], "waiting");
    let elsewhere = ask(&agent, "GET", "/watch/camera/front/image_raw", "", "");
    assert_eq!(problem(&elsewhere), (404, "no-such-watch".to_owned()));

    let list: Value = serde_json::from_str(&ask(&agent, "GET", "/watch", "", "").body).unwrap();
    assert_eq!(list["watches"].as_array().unwrap().len(), 2);
    assert_eq!(ask(&agent, "DELETE", encoded, "", "").status, 204);
    let gone = ask(&agent, "DELETE", encoded, "", "");
    assert_eq!(problem(&gone), (404, "no-such-watch".to_owned()));
}

/// Topics and origins of what is watched.
fn listed(agent: &LocalAgent) -> Vec<(String, String)> {
    let list: Value = serde_json::from_str(&ask(agent, "GET", "/watch", "", "").body).unwrap();
    let watches = list["watches"].as_array().unwrap().iter();
    let text = |watch: &Value, key: &str| watch[key].as_str().unwrap().to_owned();
    let pair = |watch| (text(watch, "topic"), text(watch, "origin"));
    watches.map(pair).collect()
}

#[test]
fn a_client_does_not_overrule_the_configuration_and_reloads_do_not_undo_what_it_added() {
    let directory = tempfile::tempdir().unwrap();
    let config = directory.path().join("config.yaml");
    let write = |text: &str| std::fs::write(&config, text).unwrap();
    write("watch: [/a]");
    let mut agent = LocalAgent::start(
        &mut rp(),
        &["--config", config.to_str().unwrap(), "--watch", "/b"],
    );
    agent.wait_for_log("ready");
    let entry = |topic: &str, origin: &str| (topic.to_owned(), origin.to_owned());

    for topic in ["c", "d", "e/**"] {
        let path = format!("/watch/{topic}");
        assert_eq!(ask(&agent, "POST", &path, "", "").status, 201);
    }
    assert_eq!(ask(&agent, "DELETE", "/watch/d", "", "").status, 204);
    for (topic, by) in [("a", "configuration file"), ("b", "command line")] {
        let given = ask(&agent, "DELETE", &format!("/watch/{topic}"), "", "");
        assert_eq!(problem(&given), (409, "watch-given".to_owned()));
        assert!(given.body.contains(by), "{}", given.body);
    }
    assert_eq!(ask(&agent, "POST", "/watch/a", "", "").status, 200);
    let json = "Content-Type: application/json\r\n";
    let other = ask(
        &agent,
        "PUT",
        "/watch/a",
        json,
        "{\"per_subscriber\": true, \"trace\": 0.5}",
    );
    assert_eq!(problem(&other), (409, "watch-given".to_owned()));

    // What the configuration lists later is its own for as long as it does.
    write("watch: [/a, /c]");
    let reloaded = ask(&agent, "POST", "/-/reload", "", "");
    assert_eq!(reloaded.status, 200, "{}", reloaded.body);
    assert!(reloaded.body.contains("\"watches\":4"), "{}", reloaded.body);
    assert_eq!(listed(&agent)[1], entry("/c", "config"));

    write("watch: [/a, c]");
    let wrong = ask(&agent, "POST", "/-/reload", "", "");
    assert_eq!(problem(&wrong), (422, "invalid-configuration".to_owned()));
    let body: Value = serde_json::from_str(&wrong.body).unwrap();
    let mistake = body["mistakes"][0].as_str().unwrap();
    let place = "config.yaml:1:13: watch[1]: must begin with a slash";
    assert!(mistake.contains(place), "{mistake}");

    write("watch: [/a]\nlimits: {topics: 7}\n");
    let reloaded = ask(&agent, "POST", "/-/reload", "", "");
    assert!(reloaded.body.contains("[\"limits\"]"), "{}", reloaded.body);
    let all = [
        entry("/a", "config"),
        entry("/b", "command_line"),
        entry("/c", "api"),
        entry("/e/**", "api"),
    ];
    assert_eq!(listed(&agent), all);

    let health: Value = serde_json::from_str(&ask(&agent, "GET", "/health", "", "").body).unwrap();
    assert_eq!(health["ready"], true);
    assert_eq!(health["watches"], 4);
    assert_eq!(health["watches_kept"], false);
    let abilities = health["abilities"].as_array().unwrap();
    let able = |name: &str| {
        let found = abilities.iter().find(|each| each["ability"] == name);
        found.map(|each| each["able"].as_bool().unwrap())
    };
    assert_eq!(able("forwarded"), Some(true), "{health}");
    assert_eq!(able("subscribers"), Some(false), "{health}");
    assert_eq!(health["interfaces"][0]["interface"], "replay");
    let tables = health["tables"].as_array().unwrap();
    let endpoints = tables.iter().find(|table| table["table"] == "endpoints");
    assert_eq!(endpoints.unwrap()["evictions"], 0, "{health}");
    assert_eq!(health["capabilities"].as_array().map(Vec::len), Some(0));
    let threads = health["threads"].as_array().unwrap();
    let named = |name: &str| threads.iter().any(|thread| thread["thread"] == name);
    assert!(named("rp") && named("capture"), "{health}");
    let is_confined = |thread: &Value| thread["filtered"] == true;
    assert!(threads.iter().all(is_confined), "{health}");
    assert_eq!(health["unfiltered_reason"], Value::Null);
    assert!(health["process_id"].as_u64().unwrap() > 1, "{health}");
    assert!(
        health["uptime_seconds"].as_f64().unwrap() < 3600.0,
        "{health}"
    );
    agent.signal("-TERM");
    assert!(agent.wait().success());
}

#[test]
fn what_cannot_be_is_answered_with_a_problem_that_says_why() {
    let mut agent = LocalAgent::start(&mut rp(), &["--speed", "max"]);
    agent.wait_for_log("ready");
    let json = "Content-Type: application/json\r\n";
    let form = "Content-Type: application/x-www-form-urlencoded\r\n";
    for (method, path, headers, body, status, code, says) in [
        ("GET", "/watches", "", "", 404, "not-found", "/openapi.json"),
        ("GET", "/watch/", "", "", 404, "not-found", ""),
        (
            "PATCH",
            "/watch/a",
            "",
            "",
            405,
            "method-not-allowed",
            "PATCH",
        ),
        ("POST", "/watch/2d", "", "", 422, "invalid-request", "digit"),
        ("POST", "/watch/a/", "", "", 422, "invalid-request", "token"),
        (
            "POST",
            "/watch/a%20b",
            "",
            "",
            422,
            "invalid-request",
            "letters",
        ),
        (
            "POST",
            "/watch/a%ff",
            "",
            "",
            400,
            "malformed-request",
            "UTF-8",
        ),
        (
            "POST",
            "/watch/a?domain=5",
            "",
            "",
            400,
            "malformed-request",
            "domain",
        ),
        (
            "POST",
            "/watch/a?domain_id=300",
            "",
            "",
            422,
            "invalid-request",
            "232",
        ),
        (
            "POST",
            "/watch/a",
            "",
            "{}",
            415,
            "unsupported-media-type",
            "application/json",
        ),
        (
            "POST",
            "/watch/a",
            form,
            "{}",
            415,
            "unsupported-media-type",
            "application/json",
        ),
        (
            "POST",
            "/watch/a",
            json,
            "{",
            400,
            "malformed-request",
            "EOF",
        ),
        ("POST", "/watch/a", json, "[]", 422, "invalid-request", ""),
        (
            "POST",
            "/watch/a",
            json,
            "{\"max_loss\": 1}",
            422,
            "invalid-request",
            "max_loss_ratio",
        ),
        (
            "POST",
            "/watch/a",
            json,
            "{\"max_loss_ratio\": 2}",
            422,
            "invalid-request",
            "1",
        ),
        (
            "PUT",
            "/watch/a",
            json,
            "{\"domain_id\": 233}",
            422,
            "invalid-request",
            "232",
        ),
        (
            "PUT",
            "/watch/a?domain_id=1",
            json,
            "{\"domain_id\": 2}",
            422,
            "invalid-request",
            "query",
        ),
        (
            "POST",
            "/-/reload",
            "",
            "",
            409,
            "nothing-to-reload",
            "without a configuration file",
        ),
    ] {
        let answer = ask(&agent, method, path, headers, body);
        let case = format!("{method} {path} {body}: {}", answer.body);
        assert_eq!(problem(&answer), (status, code.to_owned()), "{case}");
        assert!(answer.body.contains(says), "{case}");
    }
    let refused = ask(&agent, "PATCH", "/watch/a", "", "");
    assert!(refused.headers.contains("allow: "), "{}", refused.headers);
    // What has no body may say what it likes about it; a name may come whole.
    assert_eq!(ask(&agent, "POST", "/watch/%2Fa", form, "").status, 201);
    assert_eq!(ask(&agent, "GET", "/watch/a", "", "").status, 200);
    let document: Value =
        serde_json::from_str(&ask(&agent, "GET", "/openapi.json", "", "").body).unwrap();
    assert_eq!(document["openapi"], "3.1.0");
}

/// The program of a Python package in a place of its own.
fn schemathesis() -> Command {
    let target = Path::new(env!("CARGO_TARGET_TMPDIR")).parent().unwrap();
    let program = target.join("tools/schemathesis/bin/st");
    assert!(
        program.exists(),
        "{} is missing: run `.ci/prerequisites.sh test`",
        program.display()
    );
    Command::new(program)
}

#[test]
fn no_request_that_can_be_thought_of_gets_an_answer_that_is_not_documented() {
    let directory = tempfile::tempdir().unwrap();
    let config = directory.path().join("config.yaml");
    std::fs::write(&config, "watch: [/chatter, /listed]\n").unwrap();
    let mut agent = LocalAgent::start(
        &mut rp(),
        &["--config", config.to_str().unwrap(), "--speed", "max"],
    );
    agent.wait_for_log("ready");
    let document = format!("http://{}/openapi.json", agent.api);
    // Streams do not end: how they are answered is tested elsewhere.
    let output = schemathesis()
        .arg("--config-file")
        .arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config/schemathesis.toml"))
        .args(["run", &document])
        .args(["--checks", "all", "--seed", "1", "--max-examples", "10"])
        .args(["--no-color", "--exclude-path", "/events"])
        .args(["--exclude-path", "/samples", "--exclude-path", "/live"])
        .args(["--exclude-path", "/topics/{topic}/messages"])
        .current_dir(directory.path())
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{said}\n{}", agent.log());
    assert_eq!(ask(&agent, "GET", "/health", "", "").status, 200);
}

/// Starts `rp run` with this `api:` section and gives what it says instead of running.
fn refused(section: &str) -> String {
    let directory = tempfile::tempdir().unwrap();
    let config = directory.path().join("config.yaml");
    std::fs::write(&config, format!("api: {section}\n")).unwrap();
    let output = rp()
        .args(["run", "--metrics", "off", "--replay"])
        .args([
            capture().to_str().unwrap(),
            "--config",
            config.to_str().unwrap(),
        ])
        .output()
        .unwrap();
    assert!(!output.status.success(), "{section}");
    let said = String::from_utf8(output.stderr).unwrap();
    let said = said.lines().filter(|line| !line.contains(" INFO "));
    let said: Vec<&str> = said.collect();
    assert_eq!(said.len(), 1, "{said:?}");
    said[0].to_owned()
}

#[test]
fn the_agent_does_not_start_where_the_api_would_be_open_to_everybody_or_cannot_be() {
    let open = refused("{listen: '0.0.0.0:17401'}");
    assert!(
        open.contains("config.yaml:1:15: api.listen: is 0.0.0.0:17401"),
        "{open}"
    );
    assert!(open.contains("needs `token_file`"), "{open}");
    let missing = refused("{listen: 'off', token_file: /nowhere/token}");
    assert!(missing.contains("/nowhere/token"), "{missing}");
    let missing = refused("{listen: 'off', socket: /nowhere/api.sock}");
    assert!(
        missing.contains("cannot serve the socket /nowhere/api.sock"),
        "{missing}"
    );
}

#[test]
fn the_service_managers_directory_has_the_socket_of_one_agent_and_no_other_takes_it() {
    let directory = tempfile::tempdir().unwrap();
    let socket = directory.path().join("api.sock");
    let start = || {
        let mut agent = rp();
        agent.env("RUNTIME_DIRECTORY", directory.path());
        LocalAgent::start(&mut agent, &["--watch", "/a"])
    };
    let asked = || {
        let stream = UnixStream::connect(&socket).unwrap();
        exchange(stream, "GET /watch/a HTTP/1.1\r\nHost: rp\r\n", "").status
    };
    let mut first = start();
    first.wait_for_log("ready");
    assert_eq!(asked(), 200);
    let mut second = start();
    second.wait_for_log("ready");
    assert!(second.log().contains("another agent serves the socket"));
    assert_eq!(ask(&second, "GET", "/watch/a", "", "").status, 200);
    drop(second);
    assert_eq!(asked(), 200);
    // Killed, it leaves the file; the next one takes its place.
    first.signal("-KILL");
    first.wait();
    assert!(socket.exists());
    let mut third = start();
    third.wait_for_log("ready");
    assert_eq!(asked(), 200);
}

#[test]
fn a_token_a_foreign_name_and_a_foreign_page_are_told_apart() {
    let directory = tempfile::tempdir().unwrap();
    let (config, token) = (
        directory.path().join("config.yaml"),
        directory.path().join("token"),
    );
    std::fs::write(&token, "0123456789abcdef\n").unwrap();
    let socket = directory.path().join("api.sock");
    let api = format!(
        "{{token_file: {}, socket: {}}}",
        token.display(),
        socket.display()
    );
    std::fs::write(&config, format!("api: {api}\n")).unwrap();
    let mut agent = LocalAgent::start(&mut rp(), &["--config", config.to_str().unwrap()]);
    agent.wait_for_log("ready");
    let local = format!("Host: {}\r\n", agent.api);
    let right = "Authorization: Bearer 0123456789abcdef\r\n";
    let wrong = "Authorization: Bearer 0123456789abcdee\r\n";
    let code = |headers: &str, body: &str| {
        let stream = TcpStream::connect(agent.api).unwrap();
        let head = format!("POST /watch/a HTTP/1.1\r\n{headers}");
        let answer = exchange(stream, &head, body);
        if answer.status == 401 {
            assert!(answer.headers.contains("www-authenticate: bearer"));
        }
        problem(&answer)
    };
    let case = |status, code: &str| (status, code.to_owned());
    assert_eq!(code(&local, ""), case(401, "unauthorized"));
    assert_eq!(
        code(&format!("{local}{wrong}"), ""),
        case(401, "unauthorized")
    );
    assert_eq!(code(&format!("{local}{right}"), ""), case(201, ""));
    let rebound = format!("Host: evil.example\r\n{right}");
    assert_eq!(code(&rebound, ""), case(403, "foreign-host"));
    let page = format!("{local}{right}Origin: http://evil.example\r\n");
    assert_eq!(code(&page, ""), case(403, "foreign-origin"));
    let long = "x".repeat(20_000);
    let said = format!("{local}{right}Content-Length: 20000\r\n");
    assert_eq!(code(&said, &long), case(413, "body-too-large"));
    let chunked = format!("{local}{right}Transfer-Encoding: chunked\r\n");
    let chunks = format!("4e20\r\n{long}\r\n0\r\n\r\n");
    assert_eq!(code(&chunked, &chunks), case(413, "body-too-large"));

    // Who may open the file needs no token; the metrics listener changes nothing for anybody.
    let mode = std::fs::metadata(&socket).unwrap().permissions().mode();
    assert_eq!(mode & 0o777, 0o660);
    let stream = UnixStream::connect(&socket).unwrap();
    let answer = exchange(stream, "GET /watch/a HTTP/1.1\r\nHost: rp\r\n", "");
    assert_eq!(answer.status, 200);
    let answer = agent.request("POST", "/watch/b", right);
    assert_eq!(answer.status, 404);

    // A connection on which nothing is asked does not hold up the end.
    let _idle = TcpStream::connect(agent.api).unwrap();
    agent.signal("-TERM");
    assert!(agent.wait().success());
    assert!(!socket.exists());
}

/// The commands of a section of `docs/api.md` and what they print.
fn commands(section: &str) -> Vec<(String, String)> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/api.md");
    let page = std::fs::read_to_string(path).unwrap();
    let (_, section) = page.split_once(&format!("\n## {section}\n")).unwrap();
    let (_, block) = section.split_once("```console\n$ ").unwrap();
    let (block, _) = block.split_once("\n```").unwrap();
    let commands = block.split("\n$ ").map(|command| {
        let (command, output) = command.split_once('\n').unwrap_or((command, ""));
        (command.to_owned(), output.to_owned())
    });
    commands.collect()
}

/// Without what is another number each time.
fn masked(text: &str) -> String {
    let mut masked = text.to_owned();
    for key in ["\"messages\":", "\"rate_hertz\":", "topic=\"/chatter\"} "] {
        if let Some((before, after)) = masked.split_once(key) {
            let rest = after.trim_start_matches(|c: char| c.is_ascii_digit() || c == '.');
            masked = format!("{before}{key}N{rest}");
        }
    }
    masked
}

#[test]
fn what_the_book_prints_is_what_is_printed() {
    let mut agent = LocalAgent::start(&mut rp(), &["--speed", "0.3"]);
    agent.wait_for_log("ready");
    for (command, expected) in commands("Measure a topic at run time") {
        let here = command.replace("localhost:17401", &agent.api.to_string());
        let here = here.replace("localhost:17400", &agent.address.to_string());
        let deadline = Instant::now() + PATIENCE;
        loop {
            let output = Command::new("sh").args(["-c", &here]).output().unwrap();
            let said = String::from_utf8(output.stdout).unwrap();
            let counts = !said.contains("\"messages\":0,") && !said.ends_with("\"} 0\n");
            if counts && masked(said.trim_end()) == masked(&expected) {
                break;
            }
            // Only what changes nothing may be asked again, until the robot has come that far.
            let may_repeat = !command.contains("-X") && Instant::now() < deadline;
            assert!(
                may_repeat,
                "{command}\n{said}\nbut docs/api.md has\n{expected}"
            );
            std::thread::sleep(Duration::from_millis(20));
        }
    }
}
