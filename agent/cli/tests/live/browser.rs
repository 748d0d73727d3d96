//! The page in a real Chromium, with a running robot, with captures of faults, with hostile names,
//! and without rights. In some tests the agent stops or the tab sleeps. Each test plays a scenario
//! of `agent/cli/tests/page`. No request may leave the agent's origin, and no message may reach the
//! console.

mod calls;
mod crowd;
mod past;
mod pipelines;
pub(crate) mod player;
pub(crate) mod robot;

use std::io::{Read as _, Write as _};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use crate::robot_parts::{self, Node};
use crate::rp;
use anyhow::{Context as _, Result, ensure};
use flate2::read::MultiGzDecoder;
use past::unix_time;
use player::{play, play_for, watch};
use robot::{Place, Robot};
use ros2probe_testing::harness;
use ros2probe_testing::harness::agent::get;
use ros2probe_testing::harness::bpf::interest_of;
use ros2probe_testing::harness::network::Link;
use ros2probe_testing::local_agent::{self, LocalAgent};
use ros2probe_testing::robot_diagnostics::{self, Status, diagnostics};
use ros2probe_testing::robot_log::{self, log};
use ros2probe_testing::robot_parameters::{self, event};
use ros2probe_testing::robot_pictures;
use ros2probe_testing::robot_transforms::{self, Transform, transforms};
use serde_json::{Value, json};

/// Number of topics of the large robot.
const CROWD: usize = 500;
/// Number of chains with hostile names, and number of hops of the longest one.
const CHAIN_COUNT: usize = 20;
const LONG_CHAIN: usize = 31;
/// Chains of the capture `chain-1ns`: one too slow, one within its limit, and none.
const CHAINS: &str = "chains:
  - {from: /points, to: /cmd, max_latency_ms: 20}
  - {from: /points, to: /filtered, max_latency_ms: 50}
  - {from: /camera, to: /steering, max_latency_ms: 100}
";
/// Number of nodes among which one is found.
const NODES: usize = 200;
/// Address of the page of an agent with a network namespace of its own.
pub(crate) const PAGE: &str = "http://127.0.0.1:17401/";

/// Configuration of the topics that are measured from the start.
const SENSORS: &str = "watch: [/imu, /points, /scan]\n";

#[test]
fn every_view_shows_a_running_robot() -> Result<()> {
    let place = Place::new()?;
    let _agent = place.agent(SENSORS)?;
    let robot = Robot::start(&place.host)?;
    let mut late = None;
    let mut answers = |question: &str| {
        ensure!(question == "another node", "{question}");
        late = Some(place.publisher("/late", "/late_comer")?);
        Ok(json!({}))
    };
    let lidar = robot.lidar.pid().to_string();
    play(&place.inside(), "robot", &[PAGE, &lidar], &mut answers)
}

#[test]
fn every_view_is_accessible_in_both_themes() -> Result<()> {
    is_accessible("themes")
}

#[test]
fn every_view_is_accessible_on_a_phone() -> Result<()> {
    is_accessible("phone")
}

#[test]
fn every_view_is_accessible_enlarged_and_by_keys() -> Result<()> {
    is_accessible("enlarged")
}

fn is_accessible(how: &str) -> Result<()> {
    let place = Place::new()?;
    let _agent = place.agent(&format!("{SENSORS}{}", place.recordings()))?;
    let _robot = Robot::start(&place.host)?;
    // This topic has the longest badge.
    let _unmatched = place.publisher("/unmatched", "/alone")?;
    // Each view is examined for half a second of CPU, and a busy machine has little of it.
    let patience = Duration::from_secs(560);
    let mut nothing = |question: &str| anyhow::bail!("no answer to {question}");
    play_for(
        patience,
        &place.inside(),
        "access",
        &[PAGE, how],
        &mut nothing,
    )
}

#[test]
fn a_press_of_a_button_measures_a_topic_down_to_the_kernel() -> Result<()> {
    let place = Place::new()?;
    let agent = place.agent("")?;
    let _robot = Robot::start(&place.host)?;
    let mut answers = |question: &str| {
        ensure!(question == "watches", "{question}");
        let watches = place.ask("/watch")?;
        let topics: Vec<_> = watches["watches"]
            .as_array()
            .context("no list")?
            .iter()
            .map(|each| each["topic"].clone())
            .collect();
        let interest = interest_of(agent.process.pid())?.len();
        Ok(json!({"topics": topics, "interest": interest}))
    };
    play(&place.inside(), "watch", &[PAGE], &mut answers)
}

#[test]
fn a_message_is_shown_as_a_tree_with_charts_of_its_numbers() -> Result<()> {
    let place = Place::new()?;
    let state = place.directory.path().join("state");
    std::fs::create_dir(&state)?;
    let state = state.display();
    let _agent = place.agent(&format!("watch: [/imu]\nstate_directory: {state}\n"))?;
    let _robot = Robot::start(&place.host)?;
    let mut answers = |question: &str| {
        ensure!(question == "streams", "{question}");
        Ok(json!({"messages": place.used("subscriptions")?}))
    };
    play(&place.inside(), "message", &[PAGE], &mut answers)
}

#[test]
fn images_maps_scans_poses_and_paths_have_a_picture() -> Result<()> {
    let link = Link::new()?;
    let config = tempfile::tempdir()?;
    let agent = robot_parts::agent(&link, &config, "")?;
    let topics = [
        (1, "camera", ("rt/image", robot_pictures::IMAGE)),
        (2, "coder", ("rt/jpeg", robot_pictures::COMPRESSED_IMAGE)),
        (3, "mapper", ("rt/map", robot_pictures::MAP)),
        (4, "lidar", ("rt/scan", robot_pictures::SCAN)),
        (5, "base", ("rt/odom", robot_pictures::ODOMETRY)),
        (6, "pilot", ("rt/goal", robot_pictures::STAMPED_POSE)),
        (7, "planner", ("rt/plan", robot_pictures::PATH)),
    ];
    let mut nodes = Vec::new();
    for (number, name, topic) in topics {
        nodes.push(Node::start(&link, number, name, topic)?);
    }
    agent.scrape_until("all nodes", |page| page.sum("ros2_nodes", &[]) == 7.0)?;
    let mut passed = 0.0;
    let output_text = || {
        passed += 0.5;
        let messages = [
            robot_pictures::image(20, 10, [200, 30, 10]),
            robot_pictures::compressed_image(),
            robot_pictures::map(),
            robot_pictures::scan(100),
            robot_pictures::odometry(passed, 1.0),
            robot_pictures::stamped_pose(passed, 1.0),
            robot_pictures::path(&[(0.0, 0.0), (1.0, 0.0), (1.0, 1.0)]),
        ];
        for (node, message) in nodes.iter_mut().zip(messages) {
            node.renew()?;
            node.send(&message)?;
        }
        Ok(())
    };
    while_repeating(output_text, || {
        watch(&link.monitor.inside(), "previews", &[PAGE])
    })
}

/// Repeats an action each second until another one has ended.
fn while_repeating(
    mut action: impl FnMut() -> Result<()> + Send,
    other: impl FnOnce() -> Result<()>,
) -> Result<()> {
    let is_over = AtomicBool::new(false);
    std::thread::scope(|scope| {
        let repeated = scope.spawn(|| {
            while !is_over.load(Ordering::Relaxed) {
                action()?;
                std::thread::sleep(Duration::from_secs(1));
            }
            Ok(())
        });
        let ended = other();
        is_over.store(true, Ordering::Relaxed);
        let repeated = repeated.join();
        ended.and(repeated.map_err(|_| anyhow::anyhow!("the thread panicked"))?)
    })
}

#[test]
fn the_page_shows_logs_diagnostics_parameters_transforms_and_lifecycle() -> Result<()> {
    let link = Link::new()?;
    let config = tempfile::tempdir()?;
    let agent = robot_parts::agent(&link, &config, "")?;
    let mut nodes = Vec::new();
    for (number, name, topic) in [
        (1, "lidar", ("rt/rosout", robot_log::DDS_TYPE)),
        (
            2,
            "monitor",
            ("rt/diagnostics", robot_diagnostics::DDS_TYPE),
        ),
        (3, "ekf", ("rt/tf", robot_transforms::DDS_TYPE)),
        (
            4,
            "planner",
            ("rt/parameter_events", robot_parameters::EVENT),
        ),
    ] {
        nodes.push(Node::start(&link, number, name, topic)?);
    }
    agent.scrape_until("all nodes", |page| page.sum("ros2_nodes", &[]) == 4.0)?;
    let [lidar, monitor, ekf, planner] = &mut nodes[..] else {
        anyhow::bail!("not four nodes")
    };
    lidar.send(&log(40, "lidar", b"no echo from <b>sector</b> 3"))?;
    lidar.send(&log(20, "lidar", b"spinning"))?;
    let part = |level, name, message| Status {
        level,
        name,
        message,
        values: &[("Voltage (V)", "11.9")],
    };
    monitor.send(&diagnostics(&[
        part(0, "lidar: connection", "connected"),
        part(2, "battery", "nearly empty"),
    ]))?;
    let transform = |parent, child| Transform {
        parent,
        child,
        stamp: 1000,
        x: 1.5,
        yaw: 0.0,
    };
    ekf.send(&transforms(&[
        transform("map", "odom"),
        transform("odom", "base_link"),
    ]))?;
    planner.send(&event("/planner", &[("speed", 5)], &[], &[]))?;
    planner.send(&event("/planner", &[], &[("speed", 7)], &[]))?;
    let renew = || nodes.iter_mut().try_for_each(Node::renew);
    while_repeating(renew, || {
        watch(&link.monitor.inside(), "robot-says", &[PAGE])
    })
}

#[test]
fn tasks_on_a_running_robot_need_few_clicks() -> Result<()> {
    let place = Place::new()?;
    let state = place.directory.path().join("state");
    std::fs::create_dir(&state)?;
    let configuration = format!(
        "watch: [/**]\nstate_directory: {}\n{}",
        state.display(),
        place.recordings()
    );
    let mut agent = place.agent(&configuration)?;
    let robot = Robot::start(&place.host)?;
    std::thread::sleep(Duration::from_secs(5));
    let end = unix_time();
    agent.process.terminate()?;
    drop(agent);
    let _agent = place.agent(&configuration)?;
    let mut answers = |question: &str| {
        ensure!(question == "when", "{question}");
        Ok(json!({"end": end + 1}))
    };
    let tasks = [
        "which node needs most CPU",
        "content and plot of a number",
        "ten seconds recorded and downloaded",
        "what happened before the restart",
        "share this view",
    ];
    let arguments = [&[PAGE][..], &tasks].concat();
    let played = play(&place.inside(), "tasks", &arguments, &mut answers);
    drop(robot);
    played
}

#[test]
fn tasks_on_captures_need_few_clicks() -> Result<()> {
    let capture = data("cyclonedds/points-besteffort-lossy-2ns");
    let mut lossy = LocalAgent::replay(&mut rp(), &capture, &["--watch", "/**"]);
    lossy.wait_for_log("the capture has ended");
    watch(&[], "tasks", &[&page(&lossy), "why does /points lose"])?;
    let mut capture = tempfile::NamedTempFile::with_suffix(".pcap")?;
    capture.write_all(&beginning(&data("cyclonedds/qos-mismatch-2ns"), 5)?)?;
    let mismatched = replay(capture.path(), &[]);
    watch(&[], "tasks", &[&page(&mismatched), "the QoS mismatch"])?;
    let mut capture = tempfile::NamedTempFile::with_suffix(".pcap")?;
    capture.write_all(&crowd::capture(NODES, false, 5))?;
    let large = replay(capture.path(), &[]);
    let node = format!("/{}", crowd::node_name(NODES / 2, false));
    let mut answers = |question: &str| {
        ensure!(question == "node", "{question}");
        Ok(json!({"node": node}))
    };
    play(
        &[],
        "tasks",
        &[&page(&large), "a node among many"],
        &mut answers,
    )
}

#[test]
fn a_recording_is_started_ended_and_downloaded_on_the_page() -> Result<()> {
    let place = Place::new()?;
    let bags = place.directory.path().join("bags");
    let state = place.directory.path().join("state");
    std::fs::create_dir(&state)?;
    // No robot meets this expectation, so there is an incident.
    let configuration = format!(
        "watch: [{{topic: /imu, min_rate_hz: 900}}]\nstate_directory: {}\n{}  \
         snapshots: [{{name: incident, topics: [/imu], seconds: 5}}]\n",
        state.display(),
        place.recordings()
    );
    let mut agent = Some(place.agent(&configuration)?);
    let _robot = Robot::start(&place.host)?;
    let mut answers = |question: &str| {
        if question == "restart" {
            agent.take().context("no agent")?.process.terminate()?;
            agent = Some(place.agent(&configuration)?);
            return Ok(json!({}));
        }
        if let Some(file) = question.strip_prefix("size ") {
            let size = std::fs::metadata(bags.join("lap-one").join(file))?.len();
            return Ok(json!({"size": size}));
        }
        let recordings = place.ask("/recordings")?;
        let recordings = recordings["recordings"].as_array().context("no list")?;
        let names: Vec<_> = recordings.iter().map(|each| each["name"].clone()).collect();
        Ok(json!({"names": names}))
    };
    play(&place.inside(), "recording", &[PAGE], &mut answers)
}

#[test]
fn the_page_continues_after_the_agent_hung_ended_or_was_killed() -> Result<()> {
    let place = Place::new()?;
    let mut agent = Some(place.agent(SENSORS)?);
    let mut robot = Some(Robot::start(&place.host)?);
    let mut other = None;
    let mut answers = |question: &str| {
        match question {
            "freeze" => agent
                .as_ref()
                .context("no agent runs")?
                .process
                .signal("STOP")?,
            "thaw" => agent
                .as_ref()
                .context("no agent runs")?
                .process
                .signal("CONT")?,
            "stop" => drop(agent.take().context("no agent runs")?.process.terminate()?),
            "kill" => drop(agent.take().context("no agent runs")?),
            "start" => agent = Some(place.agent("watch: [/**]\n")?),
            "forget the robot" => robot = None,
            "another robot" => {
                let topic = "/after_restart";
                let subscriber = place.subscriber(topic)?;
                other = Some((subscriber, place.publisher(topic, "/other")?));
            }
            "run" => {
                let page = place.ask("/health")?;
                return Ok(json!({"run": page["process_id"]}));
            }
            _ => anyhow::bail!("{question}"),
        }
        Ok(json!({}))
    };
    let played = play(&place.inside(), "restart", &[PAGE], &mut answers);
    drop((robot, other));
    played
}

#[test]
fn a_tab_that_slept_for_a_minute_shows_the_present_state() -> Result<()> {
    let place = Place::new()?;
    let _agent = place.agent("watch: [/**]\n")?;
    let _robot = Robot::start(&place.host)?;
    let mut others = Vec::new();
    let mut answers = |question: &str| match question {
        "another topic" => {
            others.push(place.publisher("/while_asleep", "/night_watch")?);
            Ok(json!({}))
        }
        "a node while hidden" => {
            others.push(place.publisher("/hidden", "/while_hidden")?);
            // The event precedes the next stream.
            harness::wait_until("the event of the node", || {
                let url = format!("{PAGE}events?after=0&follow=false");
                Ok(get(&place.host, &url)?.contains("/while_hidden"))
            })?;
            Ok(json!({}))
        }
        _ => Ok(json!({"live": place.streams()?})),
    };
    let played = play(&place.inside(), "asleep", &[PAGE], &mut answers);
    drop(others);
    played
}

#[test]
fn the_page_of_a_capture_shows_an_incident_of_the_past() -> Result<()> {
    let capture = data("cyclonedds/points-besteffort-lossy-2ns");
    let mut agent = LocalAgent::replay(&mut rp(), &capture, &["--watch", "/**", "--speed", "1"]);
    agent.wait_for_log("the capture has ended");
    watch(&[], "loss", &[&page(&agent)])
}

#[test]
fn the_page_pauses_a_replay_and_jumps_to_the_next_event() -> Result<()> {
    let capture = data("cyclonedds/points-besteffort-lossy-2ns");
    let agent = LocalAgent::replay(&mut rp(), &capture, &["--watch", "/**", "--speed", "0.1"]);
    watch(&[], "replay", &[&page(&agent)])
}

#[test]
fn a_qos_mismatch_leads_to_the_incompatible_policy() -> Result<()> {
    // The capture ends before the first goodbye.
    let mut capture = tempfile::NamedTempFile::with_suffix(".pcap")?;
    capture.write_all(&beginning(&data("cyclonedds/qos-mismatch-2ns"), 5)?)?;
    let agent = replay(capture.path(), &[]);
    watch(&[], "mismatch", &[&page(&agent)])
}

#[test]
fn five_hundred_hostile_names_are_shown_as_text() -> Result<()> {
    let capture = large_robot(true, 20)?;
    let agent = replay(capture.path(), &[]);
    watch(&[], "hostile", &[&page(&agent), &CROWD.to_string()])
}

#[test]
fn a_chain_is_shown_as_a_waterfall_and_as_a_path_in_the_graph() -> Result<()> {
    let mut configured = tempfile::NamedTempFile::with_suffix(".yaml")?;
    configured.write_all(CHAINS.as_bytes())?;
    let path = configured.path().to_str().context("no path")?.to_owned();
    let capture = data("fastrtps-udp/chain-1ns");
    let mut agent = Some(replay(&capture, &["--config", &path]));
    let address = page(agent.as_ref().context("no agent")?);
    let mut answers = |question: &str| {
        if question == "end" {
            agent = None;
            return Ok(json!({}));
        }
        let agent = agent.as_ref().context("no agent")?;
        let (status, answer) = local_agent::call_api(agent.api, "GET", question, "");
        ensure!(status == 200, "{question}: {status}");
        Ok(answer)
    };
    play(&[], "chains", &[&address], &mut answers)
}

#[test]
fn chains_of_hostile_names_are_shown_as_text() -> Result<()> {
    let mut capture = tempfile::NamedTempFile::with_suffix(".pcap")?;
    let mut lengths = vec![LONG_CHAIN];
    lengths.resize(CHAIN_COUNT, 2);
    capture.write_all(&pipelines::capture(&lengths))?;
    let agent = replay(capture.path(), &[]);
    let arguments = [CHAIN_COUNT, LONG_CHAIN].map(|number| number.to_string());
    let arguments = [page(&agent), arguments[0].clone(), arguments[1].clone()];
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    watch(&[], "chain-names", &arguments)
}

#[test]
fn views_of_nodes_and_topics_show_figures_from_inside_processes() -> Result<()> {
    let place = Place::new()?;
    let _agent = place.agent_inside("watch: [/**]\n")?;
    // The graph knows the node by its participant.
    let _node = place.publisher("/other", "/robot1/filter")?;
    let mut filter = calls::Filter::start(&place)?;
    let mut answers = |question: &str| {
        match question {
            "create" => filter.create()?,
            "work" => filter.publish_messages()?,
            "usual" => filter.usual()?,
            "late" => filter.late()?,
            _ => return place.ask(question),
        }
        Ok(json!({}))
    };
    play(&place.inside(), "inside", &[PAGE], &mut answers)
}

#[test]
fn a_token_grants_rights_that_loopback_does_not_have() -> Result<()> {
    let directory = tempfile::tempdir()?;
    let socket = directory.path().join("api.sock");
    let configured = directory.path().join("config.yaml");
    std::fs::write(
        &configured,
        format!("api: {{socket: {}}}\n", socket.display()),
    )?;
    let file = directory.path().join("token");
    std::fs::write(&file, "0123456789abcdef0123\n")?;
    let strict = directory.path().join("strict.yaml");
    std::fs::write(
        &strict,
        format!("api: {{token_file: {}}}\n", file.display()),
    )?;
    let capture = data("cyclonedds/points-besteffort-lossy-2ns");
    let with = |path: &Path| path.to_str().unwrap().to_owned();
    let agent = replay(
        &capture,
        &["--config", &with(&configured), "--api-loopback", "read"],
    );
    let other = replay(&capture, &["--config", &with(&strict)]);
    let mut answers = |question: &str| {
        ensure!(question == "rp page", "{question}");
        let printed = rp().args(["page", "--socket"]).arg(&socket).output()?;
        ensure!(
            printed.status.success(),
            "{}",
            String::from_utf8_lossy(&printed.stderr)
        );
        let printed = String::from_utf8(printed.stdout)?;
        Ok(json!({"printed": printed.trim()}))
    };
    play(&[], "token", &[&page(&agent), &page(&other)], &mut answers)
}

/// Measures the first useful paint with 500 topics, the layout of large graphs, and a tab's memory.
#[test]
#[ignore = "measures for minutes: make page-bench"]
fn paint_layout_and_memory_of_the_page_are_measured() -> Result<()> {
    let minutes = std::env::var("MEASURE_MINUTES").map_or(Ok(2), |text| text.parse::<u64>())?;
    let seconds = 60 + minutes * 60;
    let capture = large_robot(false, seconds)?;
    let mut agent = LocalAgent::replay(
        &mut rp(),
        capture.path(),
        &["--watch", "/**", "--speed", "1"],
    );
    agent.wait_for_log("ready");
    let mut nothing = |question: &str| anyhow::bail!("no answer to {question}");
    let limit = Duration::from_secs(seconds + 120);
    player::play_for(limit, &[], "measure", &[&page(&agent)], &mut nothing)
}

/// Returns an agent that has read all of a capture and measured everything in it.
fn replay(capture: &Path, arguments: &[&str]) -> LocalAgent {
    let mut all = vec!["--speed", "max", "--watch", "/**"];
    all.extend(arguments);
    let mut agent = LocalAgent::replay(&mut rp(), capture, &all);
    agent.wait_for_log("the capture has ended");
    agent
}

fn page(agent: &LocalAgent) -> String {
    format!("http://localhost:{}/", agent.api.port())
}

fn data(name: &str) -> PathBuf {
    let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("../testing/data");
    data.join(name).join("capture.pcap.gz")
}

/// Returns the packets of a capture's first seconds.
fn beginning(capture: &Path, seconds: u32) -> Result<Vec<u8>> {
    let mut all = Vec::new();
    MultiGzDecoder::new(std::fs::File::open(capture)?).read_to_end(&mut all)?;
    let number = |at: usize| u32::from_le_bytes(all[at..at + 4].try_into().unwrap());
    let mut end = 24;
    while end < all.len() && number(end) < number(24) + seconds {
        end += 16 + number(end + 8) as usize;
    }
    all.truncate(end);
    Ok(all)
}

fn large_robot(hostile: bool, seconds: u64) -> Result<tempfile::NamedTempFile> {
    let mut file = tempfile::NamedTempFile::with_suffix(".pcap")?;
    file.write_all(&crowd::capture(CROWD, hostile, seconds))?;
    Ok(file)
}

/// Returns the number `of` in the list's member whose `key` is this name.
fn number(list: &Value, key: &str, name: &str, of: &str) -> Result<u64> {
    let mut all = list.as_array().context("no list")?.iter();
    let found = all.find(|each| each[key] == name);
    found
        .and_then(|each| each[of].as_u64())
        .with_context(|| format!("no {name} in {list}"))
}
