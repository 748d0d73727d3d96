//! The OpenAPI document: it describes what the agent accepts and answers.

use std::collections::BTreeSet;

use super::*;

#[test]
fn the_document_in_the_repository_equals_the_generated_one() {
    let generated = ros2probe_daemon::surface::api::document()
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

/// Validates against the schema of OpenAPI 3.1 that schemathesis contains.
const VALIDATE: &str = "
import json, sys
from schemathesis.specs.openapi.definitions import OPENAPI_31_VALIDATOR
for error in OPENAPI_31_VALIDATOR.iter_errors(json.load(open(sys.argv[1]))):
    print(list(error.instance_path), error.message)
";

/// Earlier, `list` was the id of twelve operations, and `show` the id of seven.
#[test]
fn the_document_is_valid_and_every_operation_has_a_unique_id() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config/openapi.json");
    let python = schemathesis("python")
        .args(["-c", VALIDATE])
        .arg(&path)
        .output()
        .unwrap();
    assert!(
        python.status.success(),
        "{}",
        String::from_utf8_lossy(&python.stderr)
    );
    assert_eq!(String::from_utf8_lossy(&python.stdout), "");

    let document: Value = serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap();
    let tags = document["tags"].as_array().unwrap().iter();
    let tags: Vec<&str> = tags.map(|tag| tag["name"].as_str().unwrap()).collect();
    let mut ids = BTreeSet::new();
    for (path, item) in document["paths"].as_object().unwrap() {
        for (method, operation) in item.as_object().unwrap() {
            let id = operation["operationId"].as_str().unwrap();
            assert!(
                ids.insert(id),
                "{id} is the id of a second operation: {method} {path}"
            );
            let is_plain = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_';
            assert!(id.chars().all(is_plain), "{id} is no name of a function");
            // OpenAPI 3.1.1, 4.8.9: each name in the path is a parameter, and each path parameter
            // is in the path.
            let named: BTreeSet<&str> = path
                .split('/')
                .filter_map(|segment| segment.strip_prefix('{')?.strip_suffix('}'))
                .collect();
            let parameters = operation["parameters"].as_array().into_iter().flatten();
            let of_path = parameters.filter(|parameter| parameter["in"] == "path");
            let declared: Vec<&str> = of_path.map(|each| each["name"].as_str().unwrap()).collect();
            assert_eq!(declared.len(), named.len(), "{method} {path}");
            assert_eq!(
                declared.into_iter().collect::<BTreeSet<_>>(),
                named,
                "{path}"
            );
            for tag in operation["tags"].as_array().unwrap() {
                assert!(tags.contains(&tag.as_str().unwrap()), "{tag} of {path}");
            }
        }
    }
    assert!(ids.len() >= 38, "{}", ids.len());
    for (name, schema) in document["components"]["schemas"].as_object().unwrap() {
        assert!(jsonschema::meta::is_valid(schema), "{name}");
    }
    let mut waiting = vec![&document];
    while let Some(value) = waiting.pop() {
        match value {
            Value::Object(object) => waiting.extend(object.values()),
            Value::Array(array) => waiting.extend(array),
            _ => {}
        }
        if let Some(reference) = value["$ref"].as_str() {
            let pointer = reference.strip_prefix('#').unwrap();
            assert!(document.pointer(pointer).is_some(), "{reference}");
        }
    }
}

#[test]
fn the_document_has_the_topics_and_limits_that_the_agent_accepts() {
    let document = serde_json::to_value(ros2probe_daemon::surface::api::document()).unwrap();
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
        let accepted = ros2probe_daemon::config::watch::check_pattern(&format!("/{name}")).is_ok();
        assert_eq!(documented, accepted, "{name}");
    }
    assert_expectations_are_documented(&document);
}

/// The limits of an expectation are the same as in the configuration, and the agent refuses values
/// beyond them.
fn assert_expectations_are_documented(document: &Value) {
    let schema = ros2probe_daemon::config::Config::schema();
    let configured = &schema["$defs"]["WatchShape"]["anyOf"][1]["properties"];
    let body = &document["components"]["schemas"]["WatchRequest"]["properties"];
    let (mut low, mut high) = (ExpectationValues::default(), ExpectationValues::default());
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
    for (key, place) in [
        ("window_s", (&mut low.window_s, &mut high.window_s)),
        ("publishers", (&mut low.publishers, &mut high.publishers)),
        ("subscribers", (&mut low.subscribers, &mut high.subscribers)),
    ] {
        for (limit, place) in [("minimum", place.0), ("maximum", place.1)] {
            let value = configured[key][limit].as_u64();
            assert_eq!(body[key][limit].as_u64(), value, "{key} {limit}");
            *place = Some(u32::try_from(value.unwrap()).unwrap());
        }
    }
    let is_valid = |values| Expectations::try_from(values).is_ok();
    assert!(is_valid(low) && is_valid(high));
    let beyond = |change: fn(&mut ExpectationValues)| {
        let mut wrong = ExpectationValues::default();
        change(&mut wrong);
        !is_valid(wrong)
    };
    assert!(beyond(|wrong| wrong.min_rate_hz = Some(-0.1)));
    assert!(beyond(|wrong| wrong.max_rate_hz = Some(1_000_000.1)));
    assert!(beyond(|wrong| wrong.max_loss_ratio = Some(1.1)));
    assert!(beyond(|wrong| wrong.max_latency_ms = Some(3_600_000.1)));
    assert!(beyond(|wrong| wrong.max_silence_s = Some(0.0)));
    assert!(beyond(|wrong| wrong.max_silence_s = Some(f64::NAN)));
    assert!(beyond(|wrong| wrong.publishers = Some(0)));
    assert!(beyond(
        |wrong| (wrong.min_rate_hz, wrong.window_s) = (Some(1.0), Some(11))
    ));
    assert!(beyond(|wrong| wrong.window_s = Some(5)));
    assert!(beyond(|wrong| wrong.subscribers = Some(10_001)));
    assert!(beyond(
        |wrong| (wrong.min_rate_hz, wrong.max_rate_hz) = (Some(2.0), Some(1.0))
    ));
}

/// Returns a valid value of the parameter with this number of characters.
fn filler(parameter: &str, length: usize) -> String {
    let mut text = String::new();
    match parameter {
        "topic" | "exclude" => {
            while text.len() < length {
                let left = length - text.len();
                // The last name has at least two characters.
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
            // Blanks around a name are ignored.
            format!("{}ros2.message.lost", "+".repeat(length - 17))
        }
        _ => "a".repeat(length),
    }
}

/// Returns the status of an answer whose body may be endless.
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
fn the_agent_accepts_every_bound_of_the_document_and_refuses_the_next_value() {
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
    let document = serde_json::to_value(ros2probe_daemon::surface::api::document()).unwrap();
    let mut checked = 0;
    let mut check = |what: &str, allowed: u16, beyond: u16| {
        assert!(
            !matches!(allowed, 400 | 422),
            "{what}: the bound is refused: {allowed}"
        );
        assert!(matches!(beyond, 400 | 422), "{what}: beyond it: {beyond}");
        checked += 1;
    };
    bounds_of_queries(&agent, &document, &mut check);
    bounds_of_bodies(&agent, &document, &mut check);
    eprintln!("{checked} bounds");
    assert!(checked >= 30, "{checked}");
}

/// Takes the checked value, the status at the bound, and the status beyond it.
type Check<'a> = &'a mut dyn FnMut(&str, u16, u16);

fn bounds_of_queries(agent: &LocalAgent, document: &Value, check: Check<'_>) {
    for (path, item) in document["paths"].as_object().unwrap() {
        let Some(parameters) = item["get"]["parameters"].as_array() else {
            continue;
        };
        let path = path
            .replace("{topic}", "chatter")
            .replace("{node}", "talker")
            .replace("{noun}", "topics");
        for parameter in parameters
            .iter()
            .filter(|parameter| parameter["in"] == "query")
        {
            let (name, schema) = (parameter["name"].as_str().unwrap(), &parameter["schema"]);
            let ask = |value: &str| {
                // These parameters need a topic, or a moment.
                let other = match (path.as_str(), name) {
                    ("/samples", "exclude" | "exclude_regex" | "domain_id" | "queue_bytes") => {
                        "topic=/a&"
                    }
                    ("/history/moment/topics", "domain_id") => "at=1790000000&",
                    _ => "",
                };
                status(agent, "GET", &format!("{path}?{other}{name}={value}"), "")
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
}

fn bounds_of_bodies(agent: &LocalAgent, document: &Value, check: Check<'_>) {
    for (method, path, schema) in [
        ("POST", "/recordings", "RecordingRequest"),
        ("PUT", "/watch/a", "WatchRequest"),
    ] {
        let properties = &document["components"]["schemas"][schema]["properties"];
        for (name, schema) in properties.as_object().unwrap() {
            let ask = |value: Value| {
                let mut body = serde_json::json!({ name.as_str(): value });
                if name == "window_s" {
                    // A window requires a rate.
                    body["min_rate_hz"] = 1.into();
                }
                status(agent, method, path, &body.to_string())
            };
            let what = format!("{path} {name}");
            for (bound, step) in [("maximum", 1.0), ("minimum", -1.0)] {
                if let Some(value) = schema[bound].as_f64() {
                    // Integers stay integers.
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
}

/// Runs a program from the directory in which schemathesis is installed.
fn schemathesis(program: &str) -> Command {
    let target = Path::new(env!("CARGO_TARGET_TMPDIR")).parent().unwrap();
    let program = target.join("tools/schemathesis/bin").join(program);
    assert!(
        program.exists(),
        "{} is missing: run `.ci/prerequisites.sh test`",
        program.display()
    );
    Command::new(program)
}

#[test]
fn no_request_gets_an_undocumented_answer() {
    let directory = tempfile::tempdir().unwrap();
    let config = directory.path().join("config.yaml");
    std::fs::write(&config, "watch: [/chatter, /listed]\n").unwrap();
    let mut agent = LocalAgent::start(
        &mut rp(),
        &["--config", config.to_str().unwrap(), "--speed", "max"],
    );
    agent.wait_for_log("ready");
    let document = format!("http://{}/openapi.json", agent.api);
    // Streams do not end. Other tests check their answers.
    let output = schemathesis("st")
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
    let printed = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{printed}\n{}", agent.log());
    assert_eq!(ask(&agent, "GET", "/health", "", "").status, 200);
}
