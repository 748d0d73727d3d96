//! Fixed caps of docs/limits-*.md that can be exceeded from outside. Tests of the other caps are
//! beside their constants.

use std::collections::BTreeSet;
use std::fs::File;
use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use crate::rp;
use ros2probe_capture::border::observe;
use ros2probe_daemon::agent_facts::{AgentFacts, SourceKind};
use ros2probe_daemon::config::{Watch, Watchlist};
use ros2probe_daemon::surface::{Exposition, Format, MetricSources};
use ros2probe_model::facts::bounded::ledger;
use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::{Observer, Settings};
use ros2probe_testing::local_agent::{LocalAgent, PATIENCE, call_api, metric};
use ros2probe_testing::model::forge::{self, Message, SEDP_READERS, SEDP_WRITERS, SPDP};
use ros2probe_wire::record::{flag, guid_words, kind};
use ros2probe_wire::{EntityId, Guid, GuidPrefix, Record, Timestamp};

const START: u64 = 1_700_000_000_000_000_000;
const DISCOVERY_INFO: EntityId = EntityId([0, 0, 2, 3]);
const STRING: &str = "std_msgs::msg::dds_::String_";

fn prefix(number: u32) -> GuidPrefix {
    let mut prefix = [3; 12];
    prefix[8..].copy_from_slice(&number.to_be_bytes());
    GuidPrefix(prefix)
}

fn entity(number: u32, last: u8) -> EntityId {
    let [_, a, b, c] = number.to_be_bytes();
    EntityId([a, b, c, last])
}

fn watch() -> Watch {
    let mut watch = Watch::named("/**").unwrap();
    watch.per_subscriber = true;
    watch
}

struct World {
    observer: Observer,
    now: u64,
}

impl World {
    fn new() -> Self {
        let mut observer = Observer::new(Settings::default());
        observer.input(Input::Watchlist(Arc::new(
            Watchlist::new(vec![watch()]).unwrap(),
        )));
        observer.input(Input::Time(Timestamp(START)));
        Self {
            observer,
            now: START,
        }
    }

    fn put(&mut self, message: Message) {
        self.now += 1000;
        let envelope = forge::multicast(self.now, 0);
        self.observer.input(Input::Datagram {
            envelope: &envelope,
            payload: &message.bytes(),
            handover: None,
        });
    }

    fn participant(&mut self, prefix: GuidPrefix) {
        let payload = forge::participant(prefix, 1_000_000, Some(0));
        self.put(Message::from(prefix).data(SPDP, 1, &payload));
    }

    fn endpoint(&mut self, guid: Guid, number: u64, topic: &str, kind: &str) {
        let by = match guid.entity.is_writer() {
            true => SEDP_WRITERS,
            false => SEDP_READERS,
        };
        let payload = forge::endpoint(guid, topic, kind, true);
        self.put(Message::from(guid.prefix).data(by, number, &payload));
    }

    /// Announces this number of nodes of a participant.
    fn nodes(&mut self, prefix: GuidPrefix, count: u32) {
        let names: Vec<_> = (0..count).map(|number| format!("n{number:0200}")).collect();
        let guid = Guid::new(prefix, entity(1, 3));
        let nodes: Vec<_> = names
            .iter()
            .map(|name| ("/", name.as_str(), guid))
            .collect();
        let payload = forge::entities(prefix, 24, &nodes);
        self.put(Message::from(prefix).data(DISCOVERY_INFO, 1, &payload));
    }

    fn wait(&mut self, milliseconds: u64) {
        self.now += milliseconds * 1_000_000;
        self.observer.input(Input::Time(Timestamp(self.now)));
    }

    /// Returns the number of entries of a table, and the number of evictions.
    fn table(&self, name: &str) -> (usize, u64) {
        let tables = self.observer.snapshot(Timestamp(self.now)).tables;
        let table = tables.iter().find(|table| table.table == name).unwrap();
        assert!(table.size <= table.limit, "{table:?}");
        (table.size as usize, table.evictions)
    }

    fn page(&self) -> String {
        let settings = ros2probe_daemon::settings_cell::Settings {
            watches: vec![Arc::new(watch())],
            ..ros2probe_daemon::settings_cell::Settings::default()
        };
        let sources = MetricSources::new(SourceKind::Wire, settings);
        let agent = AgentFacts::new(SourceKind::Wire, Instant::now());
        let state = sources
            .latest
            .publish(self.observer.snapshot(Timestamp(self.now)), agent);
        sources.limits.note(&state);
        Exposition::new(sources).render(Format::Classic).unwrap()
    }
}

#[test]
fn nodes_beyond_the_cap_are_left_out() {
    let mut world = World::new();
    for number in 0..30 {
        world.participant(prefix(number));
        world.nodes(prefix(number), 200);
    }
    let (nodes, left_out) = world.table("nodes");
    assert_eq!((nodes, left_out > 0), (4096, true));
}

#[test]
fn nodes_of_unknown_participants_do_not_exceed_the_cap_in_bytes() {
    let mut world = World::new();
    for number in 0..100 {
        world.nodes(prefix(number), 200);
    }
    let bytes = ledger()["discovery.pending_nodes.bytes"].largest;
    assert!((900 << 10..=1 << 20).contains(&bytes), "{bytes}");
    assert!(world.table("nodes").1 > 0);
}

#[test]
fn findings_of_one_kind_beyond_the_cap_are_left_out() {
    let mut world = World::new();
    world.participant(prefix(1));
    for number in 0..300 {
        let topic = format!("rt/topic_{number}");
        let (writer, reader) = (entity(number, 3), entity(number, 4));
        world.endpoint(Guid::new(prefix(1), writer), number.into(), &topic, STRING);
        let other = "std_msgs::msg::dds_::Int32_";
        world.endpoint(Guid::new(prefix(1), reader), number.into(), &topic, other);
    }
    world.wait(30_000);
    let (found, left_out) = world.table("diagnoses");
    assert!(found >= 256, "{found}");
    assert!(left_out >= 44, "{left_out}");
}

#[test]
fn acknowledging_readers_beyond_the_cap_of_the_metrics_page_are_counted_as_not_shown() {
    let mut world = World::new();
    world.participant(prefix(1));
    let writers = [1, 2, 3].map(|number| Guid::new(prefix(1), entity(number, 3)));
    for (number, writer) in (1..).zip(writers) {
        world.endpoint(writer, number, "rt/known", STRING);
        world.put(Message::from(prefix(1)).data(writer.entity, 1, &[0, 1, 0, 0, 9, 9, 9, 9]));
    }
    for number in 1..=500 {
        world.participant(prefix(1 + number));
        let reader = Guid::new(prefix(1 + number), entity(1, 4));
        world.endpoint(reader, 1, "rt/known", STRING);
        for writer in writers {
            observe(
                &mut world.observer,
                &Record {
                    kind: kind::ACKNACK,
                    reader: guid_words(reader),
                    writer: guid_words(writer),
                    flags: flag::HOST | flag::OUTGOING,
                    socket: number.into(),
                    sequence_number: 2,
                    time: world.now,
                    ..Record::default()
                },
            );
        }
    }
    world.wait(1000);
    let hidden = metric(&world.page(), "ros2probe_deliveries_not_shown").unwrap();
    assert!(hidden >= 500.0, "{hidden}");
}

#[test]
fn unknown_writers_beyond_the_cap_of_the_metrics_page_are_only_in_the_sum() {
    let mut world = World::new();
    for number in 0..60 {
        for sample in 1..=50 {
            let message = Message::from(prefix(number));
            world.put(message.data(entity(1, 3), sample, &[0, 1, 0, 0, 9, 9, 9, 9]));
        }
    }
    world.wait(20_000);
    for number in 0..60 {
        let message = Message::from(prefix(number));
        world.put(message.data(entity(1, 3), 51, &[0, 1, 0, 0, 9, 9, 9, 9]));
    }
    world.wait(1000);
    let page = world.page();
    let all = metric(&page, "ros2_unknown_writers").unwrap();
    let series = "ros2_unknown_writer_messages_total{";
    let shown = page.lines().filter(|line| line.starts_with(series)).count();
    assert_eq!((all, shown), (60.0, 32));
}

/// Creates a file of zeros with this length, which takes no space on the disk.
fn zeros(path: &Path, length: u64) -> String {
    File::create(path).unwrap().set_len(length).unwrap();
    path.to_str().unwrap().to_owned()
}

#[test]
fn files_above_the_maximum_size_are_refused() {
    let directory = tempfile::tempdir().unwrap();
    let configuration = zeros(&directory.path().join("ros2probe.yaml"), (1 << 20) + 1);
    let bag = directory.path().join("bag");
    std::fs::create_dir(&bag).unwrap();
    zeros(&bag.join("metadata.yaml"), (64 << 20) + 1);
    for arguments in [
        ["check-config", &configuration].as_slice(),
        &["bag", "info", bag.to_str().unwrap()],
    ] {
        let output = rp().args(arguments).output().unwrap();
        let printed = String::from_utf8_lossy(&output.stderr);
        assert!(!output.status.success(), "{printed}");
        assert!(
            printed.contains("MiB") || printed.contains("larger") || printed.contains("too large"),
            "{printed}"
        );
    }
}

#[test]
fn snapshots_beyond_the_cap_of_the_configuration_are_refused() {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("ros2probe.yaml");
    let check = |count: usize| {
        let entries: Vec<_> = (0..count)
            .map(|number| format!("{{name: s{number}, topics: [/a], seconds: 5}}"))
            .collect();
        let entries = entries.join(", ");
        std::fs::write(&file, format!("recordings: {{snapshots: [{entries}]}}\n")).unwrap();
        let output = rp().arg("check-config").arg(&file).output().unwrap();
        String::from_utf8_lossy(&output.stderr).into_owned()
    };
    assert!(!check(8).contains("entries, at most"), "{}", check(8));
    assert!(
        check(9).contains("has 9 entries, at most 8 are allowed"),
        "{}",
        check(9)
    );
}

#[test]
fn lists_of_the_robot_beyond_their_caps_are_refused() {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("ros2probe.yaml");
    let check = |key: &str, entry: &str, count: usize| {
        let entries = vec![entry; count].join(", ");
        std::fs::write(&file, format!("robot: {{{key}: [{entries}]}}\n")).unwrap();
        let output = rp().arg("check-config").arg(&file).output().unwrap();
        String::from_utf8_lossy(&output.stderr).into_owned()
    };
    for (key, entry, most) in [
        ("active", "/lidar", 64),
        ("extract", "{topic: /a, field: b, metric: c}", 64),
        (
            "parameters_expected",
            "{node: /a, name: b, value: '1'}",
            1024,
        ),
    ] {
        let fine = check(key, entry, most);
        assert!(!fine.contains("entries, at most"), "{fine}");
        let refused = check(key, entry, most + 1);
        let reason = format!("has {} entries, at most {most} are allowed", most + 1);
        assert!(refused.contains(&reason), "{refused}");
    }
}

#[test]
fn chains_beyond_the_cap_of_the_configuration_are_refused() {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("ros2probe.yaml");
    let check = |count: usize| {
        let entries: Vec<_> = (0..count)
            .map(|number| format!("{{from: /a{number}, to: /b}}"))
            .collect();
        let entries = entries.join(", ");
        std::fs::write(&file, format!("chains: [{entries}]\n")).unwrap();
        let output = rp().arg("check-config").arg(&file).output().unwrap();
        String::from_utf8_lossy(&output.stderr).into_owned()
    };
    assert!(!check(64).contains("entries, at most"), "{}", check(64));
    let refused = check(65);
    let reason = "has 65 entries, at most 64 are allowed";
    assert!(refused.contains(reason), "{refused}");
}

#[test]
fn an_api_request_beyond_a_cap_is_refused_with_the_status_of_that_cap() {
    let agent = LocalAgent::start(&mut rp(), &["--speed", "0.2"]);
    let list = "a".repeat(16_385);
    let (status, problem) = call_api(agent.api, "GET", &format!("/samples?topic={list}"), "");
    assert_eq!(status, 422, "{problem}");
    let head = format!("X-Long: {}", "a".repeat(60 << 10));
    let request = format!(
        "GET /health HTTP/1.1\r\nHost: {}\r\n{head}\r\n\r\n",
        agent.api
    );
    let mut stream = TcpStream::connect(agent.api).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    // The agent may close the connection before it has read everything.
    let _ = stream.write_all(request.as_bytes());
    let mut answer = String::new();
    let _ = stream.read_to_string(&mut answer);
    assert!(answer.starts_with("HTTP/1.1 431"), "{answer}");
}

#[test]
fn streams_of_events_beyond_the_cap_are_refused_until_one_ends() {
    let agent = LocalAgent::start(&mut rp(), &["--speed", "0.2"]);
    let stream = || {
        let mut stream = TcpStream::connect(agent.api).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        let request = format!("GET /events HTTP/1.1\r\nHost: {}\r\n\r\n", agent.api);
        stream.write_all(request.as_bytes()).unwrap();
        let mut answer = [0; 12];
        stream.read_exact(&mut answer).unwrap();
        (String::from_utf8_lossy(&answer).into_owned(), stream)
    };
    // A quarter of the 16 streams is reserved for clients with a token.
    let mut open: Vec<_> = (0..12).map(|_| stream()).collect();
    assert!(open.iter().all(|(answer, _)| answer == "HTTP/1.1 200"));
    assert_eq!(stream().0, "HTTP/1.1 503");
    open.pop();
    let deadline = Instant::now() + PATIENCE;
    while stream().0 != "HTTP/1.1 200" {
        assert!(Instant::now() < deadline, "no place was given back");
    }
}

#[test]
fn only_the_latest_ended_recordings_are_listed() {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("ros2probe.yaml");
    let bags = directory.path().join("bags");
    let text = format!(
        "recordings: {{directory: {}, reserve_percent: 0, reserve_bytes: 0}}\n",
        bags.display()
    );
    std::fs::write(&file, text).unwrap();
    let agent = LocalAgent::start(
        &mut rp(),
        &["--speed", "0.2", "--config", file.to_str().unwrap()],
    );
    // A recording that ends waits for packets that were sent before. Four recordings end
    // simultaneously.
    for first in (0..20).step_by(4) {
        let numbers = first..first + 4;
        for number in numbers.clone() {
            let begin = format!("{{\"name\": \"r{number}\"}}");
            assert_eq!(call_api(agent.api, "POST", "/recordings", &begin).0, 201);
        }
        std::thread::scope(|scope| {
            for number in numbers {
                let path = format!("/recordings/r{number}");
                scope.spawn(move || assert_eq!(call_api(agent.api, "DELETE", &path, "").0, 200));
            }
        });
    }
    let (_, list) = call_api(agent.api, "GET", "/recordings", "");
    let listed = list["recordings"].as_array().unwrap();
    let names: BTreeSet<_> = listed
        .iter()
        .map(|each| each["name"].as_str().unwrap())
        .collect();
    let latest: Vec<_> = (4..20).map(|number| format!("r{number}")).collect();
    assert_eq!(names, latest.iter().map(String::as_str).collect(), "{list}");
    assert_eq!(std::fs::read_dir(&bags).unwrap().count(), 20);
}

#[test]
fn a_snapshot_is_not_written_while_its_bags_have_their_maximum_size() {
    let directory = tempfile::tempdir().unwrap();
    let bags = directory.path().join("bags");
    let old = bags.join("last_rosbag2_2020_01_01");
    std::fs::create_dir_all(&old).unwrap();
    zeros(&old.join("bag_0.mcap"), 1 << 30);
    let file = directory.path().join("ros2probe.yaml");
    let text = format!(
        "recordings:\n  directory: {}\n  reserve_percent: 0\n  reserve_bytes: 0\n  \
         snapshots: [{{name: last, topics: ['/**'], seconds: 10}}]\n",
        bags.display()
    );
    std::fs::write(&file, text).unwrap();
    let agent = LocalAgent::start(
        &mut rp(),
        &["--speed", "0.2", "--config", file.to_str().unwrap()],
    );
    let (status, problem) = call_api(agent.api, "POST", "/snapshots/last", "");
    assert!(status >= 400, "{status} {problem}");
    assert!(problem.to_string().contains("remove some"), "{problem}");
    agent.wait_for_metric(
        "ros2probe_snapshots_failed_total{snapshot=\"last\"}",
        |failed| failed == 1.0,
    );
    std::fs::remove_dir_all(&old).unwrap();
    assert!(call_api(agent.api, "POST", "/snapshots/last", "").0 < 300);
}
