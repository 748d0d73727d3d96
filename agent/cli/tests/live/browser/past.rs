//! The page at a moment in the past: the robot before a restart, and what it said then.

use std::sync::{Mutex, PoisonError};
use std::time::{Duration, SystemTime};

use anyhow::{Result, ensure};
use serde_json::json;

use super::player::play;
use super::robot::{Place, Robot};
use super::{PAGE, while_repeating};
use crate::robot_parts::{self, Node};
use ros2probe_testing::forged::{Carrier as _, SAMPLES_WRITER, Sender, Talker};
use ros2probe_testing::harness::network::Link;
use ros2probe_testing::model::forge::{self, Message};
use ros2probe_testing::robot_diagnostics::{self, Status, diagnostics};
use ros2probe_testing::robot_log::{self, log};
use ros2probe_testing::robot_parameters::{self, event};
use ros2probe_testing::robot_pictures;
use ros2probe_testing::robot_transforms::{self, Transform, transforms};
use ros2probe_wire::{EntityId, Guid, GuidPrefix};

/// Time for which the robot of the past runs: three readings of its processes.
const PAST: Duration = Duration::from_secs(35);

#[test]
fn the_page_shows_the_robot_as_it_was_before_a_restart() -> Result<()> {
    let place = Place::new()?;
    let state = place.directory.path().join("state");
    std::fs::create_dir(&state)?;
    let configuration = format!("watch: [/**]\nstate_directory: {}\n", state.display());
    let mut agent = place.agent(&configuration)?;
    let begin = unix_time();
    let robot = Robot::start(&place.host)?;
    std::thread::sleep(PAST);
    agent.process.terminate()?;
    let end = unix_time();
    drop((agent, robot));
    std::fs::remove_file(state.join("discovery.json"))?;
    let mut running = None;
    let mut answers = |question: &str| {
        ensure!(question == "another robot after a restart", "{question}");
        let agent = place.agent(&configuration)?;
        running = Some((agent, place.publisher("/after_restart", "/other")?));
        Ok(json!({"begin": begin, "end": end}))
    };
    play(&place.inside(), "past", &[PAGE], &mut answers)
}

pub(super) fn unix_time() -> u64 {
    let since = SystemTime::UNIX_EPOCH.elapsed();
    since.unwrap_or_default().as_secs()
}

/// Configuration of the agent of the past, and of the present one.
const CHAIN_THEN: &str = "chains: [{from: /tf, to: /diagnostics, max_latency_ms: 20}]\n";
const CHAIN_NOW: &str = "chains: [{from: /tf, to: /parameter_events, max_latency_ms: 20}]\n";

/// What the robot said and had: the agent before its restart, and the one after it. No view of the
/// past has the content of the present.
#[test]
fn the_page_shows_what_the_robot_said_before_it_said_something_else() -> Result<()> {
    let link = Link::new()?;
    let directory = tempfile::tempdir()?;
    let state = directory.path().join("state");
    std::fs::create_dir(&state)?;
    let more = format!("state_directory: {}\n", state.display());
    let mut agent = robot_parts::agent(&link, &directory, &format!("{CHAIN_THEN}{more}"))?;
    let mut robot = Speakers::start(&link)?;
    agent.scrape_until("all nodes", |page| page.sum("ros2_nodes", &[]) == 4.0)?;
    robot.say("motor too hot", (2, "nearly empty"), 5)?;
    robot.base.serve("reset", [5, 6])?;
    robot.base.broadcast(1.5, Duration::from_secs(3))?;
    for (what, metric, value) in [
        ("the log", "ros2_log_messages_total", 1.0),
        ("the battery", "ros2_diagnostics_level", 2.0),
        ("the transform", "ros2_transform_messages_total", 1.0),
    ] {
        agent.scrape_until(what, |page| page.sum(metric, &[]) == value)?;
    }
    let process = agent.process.pid();
    agent.process.terminate()?;
    let end = unix_time();
    drop(agent);
    let mut running = None;
    let robot = Mutex::new(robot);
    let speakers = || robot.lock().unwrap_or_else(PoisonError::into_inner);
    let every = || speakers().renew();
    let mut answers = |question: &str| {
        ensure!(question == "another agent and other words", "{question}");
        let configuration = format!("{CHAIN_NOW}{more}");
        let agent = robot_parts::agent(&link, &directory, &configuration)?;
        let now = agent.process.pid();
        running = Some(agent);
        let mut robot = speakers();
        robot.say("motor is cool", (0, "full"), 7)?;
        robot.add_watchdog(&link)?;
        robot.base.end_service([5, 6])?;
        robot.base.serve("calibrate", [7, 8])?;
        robot.base.publish_odometry()?;
        robot.base.broadcast(9.25, Duration::from_secs(7))?;
        Ok(json!({"end": end, "process": {"then": process, "now": now}}))
    };
    while_repeating(every, || {
        play(&link.monitor.inside(), "past-views", &[PAGE], &mut answers)
    })
}

/// Nodes on another host.
struct Speakers {
    lidar: Node,
    monitor: Node,
    planner: Node,
    base: Base,
    watchdog: Option<Node>,
}

impl Speakers {
    fn start(link: &Link) -> Result<Self> {
        let diagnostics = ("rt/diagnostics", robot_diagnostics::DDS_TYPE);
        let events = ("rt/parameter_events", robot_parameters::EVENT);
        Ok(Self {
            lidar: Node::start(link, 1, "lidar", ("rt/rosout", robot_log::DDS_TYPE))?,
            monitor: Node::start(link, 2, "monitor", diagnostics)?,
            planner: Node::start(link, 3, "planner", events)?,
            base: Base::start(link)?,
            watchdog: None,
        })
    }

    /// Starts a second publisher of diagnostics.
    fn add_watchdog(&mut self, link: &Link) -> Result<()> {
        let diagnostics = ("rt/diagnostics", robot_diagnostics::DDS_TYPE);
        self.watchdog = Some(Node::start(link, 5, "watchdog", diagnostics)?);
        Ok(())
    }

    fn renew(&mut self) -> Result<()> {
        self.base.announce()?;
        let nodes = [&mut self.lidar, &mut self.monitor, &mut self.planner];
        let mut nodes = nodes.into_iter().chain(&mut self.watchdog);
        nodes.try_for_each(Node::renew)
    }

    /// Sends a log message, the state of a battery, and the value of a parameter.
    fn say(&mut self, text: &str, battery: (u8, &str), speed: i64) -> Result<()> {
        let (level, message) = battery;
        self.lidar.send(&log(40, "lidar", text.as_bytes()))?;
        self.monitor.send(&diagnostics(&[Status {
            level,
            name: "battery",
            message,
            values: &[("Voltage (V)", "11.9")],
        }]))?;
        (self.planner).send(&event("/planner", &[("speed", speed)], &[], &[]))
    }
}

/// The node `/base` on a host with another clock: it broadcasts transforms, and has services.
struct Base {
    talker: Talker,
    sender: Sender,
    /// Its address (RTPS 2.5, 9.4.2.10).
    locator: [u8; 24],
    /// Numbers of the last announcement and of the last transform.
    announcements: u32,
    transforms: u32,
}

impl Base {
    fn start(link: &Link) -> Result<Self> {
        let mut locator = [0; 24];
        locator[0] = 1;
        locator[4..8].copy_from_slice(&7411_u32.to_le_bytes());
        locator[20..].copy_from_slice(&link.robot.address().octets());
        let mut base = Self {
            talker: Talker::new(4, "/unused"),
            sender: Sender::between(&link.robot, &link.monitor)?,
            locator,
            announcements: 0,
            transforms: 0,
        };
        base.announce()?;
        base.publish(SAMPLES_WRITER, "rt/tf", robot_transforms::DDS_TYPE)?;
        base.sender.send(&base.talker.entities("base"))?;
        Ok(base)
    }

    fn announce(&mut self) -> Result<()> {
        let announcement = self.talker.participant_at(&[self.locator]);
        self.sender.send(&announcement)
    }

    fn publish(&mut self, writer: [u8; 4], topic: &str, dds_type: &str) -> Result<()> {
        self.announcements += 1;
        let number = self.announcements;
        let publication = self.talker.publication(writer, topic, dds_type, number);
        self.sender.send(&publication)
    }

    /// Sends a transform from `map` to `odom`, stamped by a clock that is ahead.
    fn broadcast(&mut self, x: f64, ahead: Duration) -> Result<()> {
        self.transforms += 1;
        let transform = transforms(&[Transform {
            parent: "map",
            child: "odom",
            stamp: 1000,
            x,
            yaw: 0.0,
        }]);
        let stamp = SystemTime::UNIX_EPOCH.elapsed()? + ahead;
        let message = self.message().info_ts(u64::try_from(stamp.as_nanos())?);
        let number = self.transforms.into();
        let message = message.data(EntityId(SAMPLES_WRITER), number, &transform);
        self.sender.send(&message.bytes())
    }

    /// Announces the server of a service, with the last bytes of two entity ids.
    fn serve(&mut self, service: &str, [reader, writer]: [u8; 2]) -> Result<()> {
        let part = |part| format!("std_srvs::srv::dds_::Trigger_{part}_");
        let request = format!("rq/{service}Request");
        self.announcements += 1;
        let number = self.announcements;
        let reader = [0, 0, reader, 4];
        let subscription = (self.talker).subscription(reader, &request, &part("Request"), number);
        self.sender.send(&subscription)?;
        let reply = format!("rr/{service}Reply");
        self.publish([0, 0, writer, 3], &reply, &part("Response"))
    }

    /// Ends a service.
    fn end_service(&mut self, [reader, writer]: [u8; 2]) -> Result<()> {
        for (from, entity) in [
            (forge::SEDP_READERS, [0, 0, reader, 4]),
            (forge::SEDP_WRITERS, [0, 0, writer, 3]),
        ] {
            self.announcements += 1;
            let guid = self.guid(entity);
            let number = self.announcements.into();
            let end = self.message().dispose_by_key(from, number, 0x5a, guid);
            self.sender.send(&end.bytes())?;
        }
        Ok(())
    }

    /// Announces a second publisher of the node.
    fn publish_odometry(&mut self) -> Result<()> {
        let writer = [0, 0, 9, 3];
        self.publish(writer, "rt/odom", robot_pictures::ODOMETRY)?;
        let writers = [SAMPLES_WRITER, writer].map(|writer| ("/", "base", self.guid(writer)));
        let entities = forge::entities(self.prefix(), 16, &writers);
        let message = self.message().data(EntityId([0, 0, 1, 3]), 2, &entities);
        self.sender.send(&message.bytes())
    }

    const fn prefix(&self) -> GuidPrefix {
        GuidPrefix(self.talker.prefix)
    }

    const fn guid(&self, entity: [u8; 4]) -> Guid {
        Guid::new(self.prefix(), EntityId(entity))
    }

    fn message(&self) -> Message {
        Message::from_fast(self.prefix())
    }
}
