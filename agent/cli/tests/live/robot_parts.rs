//! What the robot itself says: diagnostics, parameters and transforms in metrics, API, findings and
//! commands, without a watch. Needs root.

use std::process::{Command, Stdio};
use std::time::Duration;

use anyhow::Result;
use ros2probe_testing::forged::{Carrier as _, Renewal, SAMPLES_WRITER, Sender, Talker};
use ros2probe_testing::harness::agent::{Agent, PACKETS_ALONE, Scrape, get};
use ros2probe_testing::harness::network::{Link, Namespace};
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::harness::wait_until;
use ros2probe_testing::robot_diagnostics::{self, Status, diagnostics};
use ros2probe_testing::robot_parameters::{self, boolean, event, request};
use ros2probe_testing::robot_states::{self, battery, transition, with_header};
use ros2probe_testing::robot_transforms::{self, Transform, transforms};

const PATIENCE: Duration = Duration::from_secs(60);
const RP: &str = env!("CARGO_BIN_EXE_rp");

/// A node on another host with one writer. It renews its lease until it is dropped.
pub(crate) struct Node {
    talker: Talker,
    sender: Sender,
    number: u32,
    _renewal: Renewal,
}

impl Node {
    pub(crate) fn start(link: &Link, number: u32, name: &str, topic: (&str, &str)) -> Result<Self> {
        let talker = Talker::new(number, "/unused");
        let mut sender = Sender::between(&link.robot, &link.monitor)?;
        sender.send(&talker.participant())?;
        sender.send(&talker.publication(SAMPLES_WRITER, topic.0, topic.1, 1))?;
        sender.send(&talker.entities(name))?;
        let repeater = Sender::between(&link.robot, &link.monitor)?;
        let renewal = Renewal::start(repeater, talker.participant());
        Ok(Self {
            talker,
            sender,
            number: 0,
            _renewal: renewal,
        })
    }

    /// Announces the node's participant again, whose lease would end.
    pub(crate) fn renew(&mut self) -> Result<()> {
        self.sender.send(&self.talker.participant())
    }

    pub(crate) fn send(&mut self, payload: &[u8]) -> Result<()> {
        self.number += 1;
        let message = (self.talker).message(SAMPLES_WRITER, self.number, payload);
        self.sender.send(&message)
    }

    fn say(&mut self, level: u8, message: &str) -> Result<()> {
        self.send(&diagnostics(&[
            Status {
                level,
                name: "lidar: connection",
                message,
                values: &[("packet rate (Hz)", "9.5"), ("port", "/dev/ttyUSB0")],
            },
            Status {
                level: 0,
                name: "battery",
                message: "full",
                values: &[("Voltage (V)", "12.6")],
            },
        ]))
    }
}

/// Starts an agent on the wire, without a watch.
pub(crate) fn agent<'a>(
    link: &'a Link,
    config: &tempfile::TempDir,
    more: &str,
) -> Result<Agent<'a>> {
    let file = config.path().join("ros2probe.yaml");
    std::fs::write(&file, format!("watch: []\n{more}{PACKETS_ALONE}"))?;
    Agent::start(&link.monitor, RP, &file)
}

/// Runs `rp` beside the agent, and returns what it prints.
fn rp(host: &Namespace, arguments: &[&str]) -> Result<String> {
    let [enter, words @ ..] = &host.outside()[..] else {
        anyhow::bail!("no way into the host")
    };
    let output = Command::new(enter)
        .args(words)
        .arg(RP)
        .args(arguments)
        .output()?;
    let errors = String::from_utf8_lossy(&output.stderr);
    anyhow::ensure!(output.status.success(), "{errors}");
    Ok(String::from_utf8(output.stdout)? + &errors)
}

#[test]
fn diagnostics_have_levels_values_findings_and_a_command_without_a_watch() -> Result<()> {
    let link = Link::new()?;
    let config = tempfile::tempdir()?;
    let values = "robot: {diagnostic_values: ['battery/*']}\n";
    let agent = agent(&link, &config, values)?;
    let none = rp(&link.monitor, &["diag"])?;
    assert!(none.contains("no diagnostics were seen"), "{none}");

    let topic = ("rt/diagnostics", robot_diagnostics::DDS_TYPE);
    let mut node = Node::start(&link, 1, "driver", topic)?;
    agent.scrape_until("the writer", |page| {
        page.sum("ros2_topic_publishers", &[("topic", "/diagnostics")]) == 1.0
    })?;
    node.say(1, "slow")?;
    let lidar = [
        ("domain_id", "0"),
        ("topic", "/diagnostics"),
        ("name", "lidar: connection"),
        ("hardware_id", "hw"),
    ];
    let page = agent.scrape_until("the level", |page| {
        page.sum("ros2_diagnostics_level", &lidar) == 1.0
    })?;
    let voltage = [("name", "battery"), ("key", "Voltage (V)")];
    assert_eq!(page.sum("ros2_diagnostics_value", &voltage), 12.6);
    assert_eq!(
        page.sum("ros2_diagnostics_value", &[]),
        12.6,
        "only the selected one"
    );

    let mut following =
        Process::start_with(&link.monitor.inside(), RP, ["diag", "-f"], Stdio::null())?;
    following.wait_for("WARN   lidar: connection: slow", PATIENCE)?;
    node.say(2, "no data")?;
    following.wait_for("ERROR  lidar: connection: no data", PATIENCE)?;
    // A part that ceases to publish would be stale after 5 s.
    wait_until("the finding", || {
        node.say(2, "no data")?;
        let page = agent.scrape()?;
        Ok(page.sum("ros2_diagnoses", &[("kind", "diagnostic_error")]) == 1.0)
    })?;
    wait_until("the error is printed", || {
        node.say(2, "no data")?;
        let printed = rp(&link.monitor, &["diag", "-l", "error"])?;
        Ok(printed == "ERROR  lidar: connection: no data\n")
    })?;
    node.say(2, "no data")?;
    let verbose = rp(&link.monitor, &["diag", "-v", "lidar"])?;
    assert!(
        verbose.contains("hardware hw, /diagnostics of /driver, "),
        "{verbose}"
    );
    assert!(verbose.contains("       port: /dev/ttyUSB0\n"), "{verbose}");
    node.say(0, "connected")?;
    agent.scrape_until("the end of the finding", |page| {
        page.sum("ros2_diagnoses", &[("kind", "diagnostic_error")]) == 0.0
    })?;
    following.wait_for("OK     lidar: connection: connected", PATIENCE)?;
    Ok(())
}

#[test]
fn changes_of_parameters_name_the_node_that_requested_them() -> Result<()> {
    let link = Link::new()?;
    let config = tempfile::tempdir()?;
    let agent = agent(&link, &config, "")?;
    let none = rp(&link.monitor, &["param", "changes"])?;
    assert!(none.contains("no changes were seen"), "{none}");

    let events = ("rt/parameter_events", robot_parameters::EVENT);
    let mut planner = Node::start(&link, 1, "planner", events)?;
    let requests = (
        "rq/planner/set_parametersRequest",
        robot_parameters::REQUEST,
    );
    let mut tuner = Node::start(&link, 2, "tuner", requests)?;
    agent.scrape_until("both nodes", |page| page.sum("ros2_nodes", &[]) == 2.0)?;
    planner.send(&event("/planner", &[("speed", 5)], &[], &[]))?;
    let mut following = Process::start_with(
        &link.monitor.inside(),
        RP,
        ["param", "changes", "-f"],
        Stdio::null(),
    )?;
    planner.send(&event("/planner", &[], &[("speed", 6)], &[]))?;
    let end = " /planner speed: 5 -> 6 (by the node itself, or by a client that was not seen)";
    following.line_with_end(end, PATIENCE)?;
    tuner.send(&request(&[("speed", 9)], false))?;
    std::thread::sleep(Duration::from_millis(50));
    planner.send(&event("/planner", &[], &[("speed", 9)], &[]))?;
    let end = " /planner speed: 6 -> 9 (requested by /tuner)";
    following.line_with_end(end, PATIENCE)?;
    let page = agent.scrape_until("both changes", |page| {
        page.sum("ros2_parameter_changes_total", &[]) == 2.0
    })?;
    let planner = [("domain_id", "0"), ("ros_node", "/planner")];
    assert_eq!(page.sum("ros2_parameter_changes_total", &planner), 2.0);
    assert_eq!(
        rp(&link.monitor, &["param", "dump"])?,
        "/planner:\n  speed: 9\n"
    );
    Ok(())
}

#[test]
fn transforms_make_a_tree_with_rates_poses_and_faults() -> Result<()> {
    let link = Link::new()?;
    let config = tempfile::tempdir()?;
    let agent = agent(&link, &config, "")?;
    let none = rp(&link.monitor, &["tf"])?;
    assert!(none.contains("no transforms were seen"), "{none}");

    let dds_type = robot_transforms::DDS_TYPE;
    let mut ekf = Node::start(&link, 1, "ekf", ("rt/tf", dds_type))?;
    let mut model = Node::start(
        &link,
        2,
        "robot_state_publisher",
        ("rt/tf_static", dds_type),
    )?;
    agent.scrape_until("both nodes", |page| page.sum("ros2_nodes", &[]) == 2.0)?;
    let note = rp(&link.monitor, &["tf"])?;
    assert!(
        note.contains("the static transforms of 1 publisher are missing"),
        "{note}"
    );
    let transform = |parent, child, stamp, x, yaw| Transform {
        parent,
        child,
        stamp,
        x,
        yaw,
    };
    model.send(&transforms(&[transform("base_link", "lidar", 0, 0.5, 0.0)]))?;
    let quarter = std::f64::consts::FRAC_PI_2;
    for step in 0..40 {
        let stamp = 1000 + 50 * step;
        ekf.send(&transforms(&[
            transform("map", "odom", stamp, 10.0, 0.0),
            transform("odom", "base_link", stamp, 2.0, quarter),
        ]))?;
        std::thread::sleep(Duration::from_millis(50));
    }
    let edge = [
        ("domain_id", "0"),
        ("namespace", ""),
        ("parent", "odom"),
        ("child", "base_link"),
    ];
    let page = agent.scrape_until("the transforms", |page| {
        page.sum("ros2_transform_messages_total", &edge) == 40.0
    })?;
    assert_eq!(page.sum("ros2_transform_broadcasters", &[]), 3.0);
    let tree = rp(&link.monitor, &["tf"])?;
    let parts: Vec<_> = tree.lines().map(|line| line.split("  ").next()).collect();
    assert_eq!(tree.lines().next(), Some("map"), "{parts:?}");
    assert!(
        tree.contains("      └─ lidar  static  /robot_state_publisher\n"),
        "{tree}"
    );
    assert!(tree.contains(" s ago  /ekf\n"), "{tree}");
    assert_eq!(
        rp(&link.monitor, &["tf", "map", "lidar", "--once"])?,
        "At time 2.950000000\n\
         - Translation: [12.000, 0.500, 0.000]\n\
         - Rotation: in Quaternion [0.000, 0.000, 0.707, 0.707]\n\
         - Rotation: in RPY (radian) [0.000, -0.000, 1.571]\n\
         - Rotation: in RPY (degree) [0.000, -0.000, 90.000]\n\
         - Matrix:\n\
         \x20 0.000 -1.000  0.000 12.000\n\
         \x20 1.000  0.000  0.000  0.500\n\
         \x20 0.000  0.000  1.000  0.000\n\
         \x20 0.000  0.000  0.000  1.000\n"
    );
    let dot = rp(&link.monitor, &["tf", "--dot"])?;
    assert!(dot.contains("\"map\" -> \"odom\""), "{dot}");
    let unknown = rp(&link.monitor, &["tf", "map", "nose", "--once"]).unwrap_err();
    assert!(
        unknown
            .to_string()
            .contains("no transform has the frame `nose`"),
        "{unknown}"
    );
    // The node sends nothing from here on, and it stays announced.
    agent.scrape_until("the silence", |page| {
        page.sum("ros2_diagnoses", &[("kind", "transform_fault")]) == 1.0
    })?;
    Ok(())
}

#[test]
fn managed_nodes_batteries_and_extracted_fields_have_metrics_and_findings() -> Result<()> {
    let link = Link::new()?;
    let config = tempfile::tempdir()?;
    let more = "robot:\n  active: [/plan*]\n  extract:\n    - {topic: /battery, field: \
                'cell_voltage[0]', metric: robot_cell_volts}\n";
    let agent = agent(&link, &config, more)?;
    let event = ("rt/planner/transition_event", robot_states::TRANSITION);
    let mut planner = Node::start(&link, 1, "planner", event)?;
    let mut driver = Node::start(&link, 2, "driver", ("rt/battery", robot_states::BATTERY))?;
    agent.scrape_until("both nodes", |page| page.sum("ros2_nodes", &[]) == 2.0)?;
    let state = |state| [("ros_node", "/planner"), ("state", state)];
    planner.send(&transition(13, 3))?;
    driver.send(&battery("base_link", 24.5, f32::NAN, 0.75))?;
    let page = agent.scrape_until("the state and the battery", |page| {
        page.sum("ros2_node_lifecycle_state", &state("active")) == 1.0
            && page.sum("ros2_battery_voltage_volts", &[("topic", "/battery")]) == 24.5
    })?;
    assert_eq!(page.sum("ros2_battery_charge_ratio", &[]), 0.75);
    assert!((page.sum("robot_cell_volts", &[("topic", "/battery")]) - 3.7).abs() < 1e-6);
    assert_eq!(page.sum("ros2probe_field_unreadable", &[]), 0.0);
    assert!(
        page.value("ros2_battery_temperature_celsius", &[])
            .is_none()
    );
    planner.send(&transition(14, 2))?;
    agent.scrape_until("the finding", |page| {
        page.sum("ros2_diagnoses", &[("kind", "node_inactive")]) == 1.0
    })?;
    let url = "http://127.0.0.1:17401/nodes/planner";
    let shown: ros2probe_api::nodes::Node<'_> = serde_json::from_str(&get(&link.monitor, url)?)?;
    assert_eq!(shown.lifecycle_state.as_deref(), Some("inactive"));
    assert_eq!(shown.diagnoses.len(), 1);
    planner.send(&transition(13, 3))?;
    agent.scrape_until("the end of the finding", |page| {
        page.sum("ros2_diagnoses", &[("kind", "node_inactive")]) == 0.0
    })?;
    Ok(())
}

#[test]
fn misspelt_names_and_frames_without_transforms_are_reported() -> Result<()> {
    let link = Link::new()?;
    let config = tempfile::tempdir()?;
    let agent = agent(&link, &config, "")?;
    let image = "sensor_msgs::msg::dds_::Image_";
    let mut camera = Node::start(&link, 1, "camera", ("rt/camera/image", image))?;
    let mut ekf = Node::start(&link, 2, "ekf", ("rt/tf", robot_transforms::DDS_TYPE))?;
    let viewer = Talker::new(3, "/unused");
    let mut sender = Sender::between(&link.robot, &link.monitor)?;
    sender.send(&viewer.participant())?;
    sender.send(&viewer.subscription([0, 0, 3, 4], "rt/camera/imgae", image, 1))?;
    sender.send(&viewer.entities("viewer"))?;
    agent.scrape_until("the nodes", |page| page.sum("ros2_nodes", &[]) == 3.0)?;
    let _renewal = Renewal::start(sender, viewer.participant());
    let (mut step, mut near_miss, mut frame) = (0, false, false);
    wait_until("the near miss and the frame", || {
        camera.send(&with_header("camera_optical", 1000))?;
        ekf.send(&transforms(&[Transform {
            parent: "odom",
            child: "base_link",
            stamp: 1000 + 500 * step,
            x: 0.0,
            yaw: 0.0,
        }]))?;
        step += 1;
        std::thread::sleep(Duration::from_millis(400));
        let page = agent.scrape()?;
        near_miss |= page.sum("ros2_diagnoses", &[("kind", "near_miss")]) == 1.0;
        frame |= page.sum("ros2_diagnoses", &[("kind", "transform_fault")]) == 1.0;
        Ok(near_miss && frame)
    })
}

#[test]
fn other_parameters_than_expected_and_mixed_clocks_are_found() -> Result<()> {
    let link = Link::new()?;
    let config = tempfile::tempdir()?;
    let more = "robot: {parameters_expected: [{node: /planner, name: speed, value: '5'}]}\n";
    let agent = agent(&link, &config, more)?;
    let events = ("rt/parameter_events", robot_parameters::EVENT);
    let mut planner = Node::start(&link, 1, "planner", events)?;
    let mut lidar = Node::start(&link, 2, "lidar", events)?;
    agent.scrape_until("the nodes", |page| page.sum("ros2_nodes", &[]) == 2.0)?;
    let found = |page: &Scrape, kind| page.sum("ros2_diagnoses", &[("kind", kind)]);
    planner.send(&event("/planner", &[("speed", 5)], &[], &[]))?;
    planner.send(&boolean("/planner", "use_sim_time", true))?;
    lidar.send(&boolean("/lidar", "use_sim_time", false))?;
    let page = agent.scrape_until("the clocks", |page| found(page, "mixed_time") == 1.0)?;
    assert_eq!(found(&page, "parameter_drift"), 0.0);
    planner.send(&event("/planner", &[], &[("speed", 7)], &[]))?;
    agent.scrape_until("the drift", |page| found(page, "parameter_drift") == 1.0)?;
    planner.send(&event("/planner", &[], &[("speed", 5)], &[]))?;
    lidar.send(&boolean("/lidar", "use_sim_time", true))?;
    agent.scrape_until("the end", |page| {
        found(page, "parameter_drift") == 0.0 && found(page, "mixed_time") == 0.0
    })?;
    Ok(())
}
