//! The delivered bags of a fleet, in `rp fleet` and in the API.

use std::fs;
use std::io::{Read as _, Write as _};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use super::{PATIENCE, Robot, SECRET};
use crate::rp;
use ros2probe_testing::local_agent::{LocalAgent, call_api};
use ros2probe_testing::s3::{Call, Operation, RequestOutcome, Store};
use serde_json::{Value, json};

/// Starts an engine that has one sample of this robot for each query.
fn engine() -> std::net::SocketAddr {
    let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    std::thread::spawn(move || {
        for stream in listener.incoming() {
            let mut stream = stream.unwrap();
            let _ = stream.read(&mut [0; 4096]);
            let text = r#"{"status":"success","data":{"resultType":"vector","result":[
                {"metric":{"instance":"robot-17"},"value":[1,"1"]}]}}"#;
            let length = text.len();
            // The client may have closed the connection.
            let _ = write!(
                stream,
                "HTTP/1.1 200 OK\r\nContent-Length: {length}\r\n\r\n{text}"
            );
        }
    });
    address
}

/// Returns a configuration with the view of a fleet whose robots deliver as this one.
fn view(robot: &Robot, engine: std::net::SocketAddr) -> PathBuf {
    let text = format!(
        "fleet:\n  engine: http://{engine}\n  store:\n    url: {}\n    {}\n    credentials_file: {}\n",
        robot.url,
        robot.more,
        robot.path("ship.env").display()
    );
    fs::write(robot.path("fleet.yaml"), text).unwrap();
    robot.path("fleet.yaml")
}

fn fleet(config: &Path, arguments: &[&str]) -> String {
    let mut rp = rp();
    rp.args(["fleet", "--config"]).arg(config).args(arguments);
    let output = rp.output().unwrap();
    let all = format!("{output:?}");
    assert!(!all.contains(SECRET), "{all}");
    String::from_utf8(output.stdout).unwrap() + &String::from_utf8(output.stderr).unwrap()
}

#[test]
fn the_incidents_of_a_fleet_are_those_that_robots_delivered() {
    let store = Store::start();
    let robot = Robot::of(&store);
    let folder = tempfile::tempdir().unwrap();
    let to_folder = Robot::to(&format!("file://{}", folder.path().display()), "");
    for robot in [&robot, &to_folder] {
        robot.record("drive", 1_000, 50);
        robot.snapshot("incident_1", 2_000, 40);
        robot.snapshot("incident_2", 3_000, 30);
        robot.delivers();
        let config = view(robot, engine());
        for arguments in [&[][..], &["robot-17"]] {
            let text = fleet(&config, arguments);
            let (_, incidents) = text.split_once("\nincidents\n").expect(&text);
            let bags: Vec<_> = incidents
                .lines()
                .filter_map(|line| line.split_whitespace().last())
                .filter(|word| word.starts_with("incident_"))
                .collect();
            assert_eq!(bags, ["incident_2", "incident_1"], "{text}");
            assert!(incidents.contains(" robot-17  participant_lost "), "{text}");
            assert!(incidents.contains("findings unknown"), "{text}");
        }
        let json: Value = serde_json::from_str(&fleet(&config, &["robot-17", "--json"])).unwrap();
        let found = &json["incidents"]["bags"][0];
        assert_eq!(json["name"], "robot-17");
        assert_eq!(found["is_complete"], true);
        assert!(found["bytes"].as_u64() > Some(3_000), "{found}");
    }
    let other = fleet(
        &view(&robot, engine()),
        &["robot-17", "--engine", "http://127.0.0.1:9"],
    );
    assert!(other.contains("the connection failed"), "{other}");
    let pages = store.served();
    let lists = pages
        .iter()
        .filter(|call| call.operation == Operation::List);
    assert!(lists.count() > 3, "the listing has pages: {pages:#?}");
}

#[test]
fn a_fleet_shows_a_store_out_of_reach_and_keeps_the_last_incidents() {
    let store = Store::start();
    let robot = Robot::of(&store);
    robot.snapshot("incident_1", 2_000, 40);
    robot.delivers();
    let config = view(&robot, engine());
    let arguments = ["--config", config.to_str().unwrap(), "--speed", "max"];
    let agent = LocalAgent::start(&mut rp(), &arguments);
    let incidents = |wanted: &dyn Fn(&Value) -> bool| {
        let deadline = Instant::now() + 2 * PATIENCE;
        loop {
            let (status, answer) = call_api(agent.api, "GET", "/fleet", "");
            assert_eq!(status, 200, "{answer}");
            if wanted(&answer["incidents"]) && answer["at"].is_number() {
                return answer["incidents"].clone();
            }
            assert!(Instant::now() < deadline, "{answer}");
            std::thread::sleep(Duration::from_millis(50));
        }
    };
    let found = incidents(&|found| found["at"].is_number());
    assert_eq!(found["bags"][0]["bag"], "incident_1", "{found}");
    assert_eq!(found["bags"][0]["robot"], "robot-17", "{found}");
    assert_eq!(
        (&found["problem"], &found["is_cut"]),
        (&Value::Null, &json!(false))
    );
    let reads = |store: &Store| {
        let served = store.served();
        let of_manifest = |call: &&Call| {
            call.operation == Operation::Get && call.object.ends_with("manifest.json")
        };
        served.iter().filter(of_manifest).count()
    };
    let read = reads(&store);
    store.decide(|_| RequestOutcome::Refuse(503, None));
    let failed = incidents(&|found| found["problem"].is_string());
    let problem = failed["problem"].as_str().unwrap();
    assert!(problem.contains("503"), "{problem}");
    assert_eq!(failed["bags"], found["bags"], "the last known ones stay");
    store.decide(|_| RequestOutcome::Serve);
    incidents(&|found| found["problem"].is_null());
    assert_eq!(reads(&store), read, "no manifest is read twice");
    // `rp fleet` with a store that does not answer has a problem and no empty list.
    store.decide(|_| RequestOutcome::Refuse(403, None));
    let text = fleet(&config, &[]);
    assert!(text.contains("the store cannot be read: "), "{text}");
    assert!(text.contains("403") && !text.contains("\n  none"), "{text}");
}
