//! `make fleet`: three robots in network namespaces of their own, and a centre with Prometheus,
//! Alertmanager and VictoriaMetrics. Each robot's agent delivers by remote write. The second robot
//! loses messages between its two computers. The third one is out of reach for a minute of each
//! two.
//!
//! The engines and the page of each robot are relayed to ports of this machine. The summary is the
//! output of `rp fleet`.

use std::fmt::Write as _;
use std::io::IsTerminal;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};
use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use clap::Parser;
use ros2probe_testing::harness::agent::{Agent, get};
use ros2probe_testing::harness::alertmanager::with_own_files;
use ros2probe_testing::harness::loss::Loss;
use ros2probe_testing::harness::network::{Link, Namespace, Uplink};
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::harness::relay::{self, Relay};
use ros2probe_testing::harness::{ended, peer};
use ros2probe_testing::repository;
use tokio::time::{Instant, sleep};

const REFRESH: Duration = Duration::from_secs(5);
/// Time in reach and out of reach of the third robot.
const PHASE: Duration = Duration::from_secs(60);
/// Packets of a thousand that the second robot loses between its computers.
const LOST: u16 = 2;
const API: u16 = 17401;
const PROMETHEUS: u16 = 9090;
const ALERTMANAGER: u16 = 9093;
const VICTORIA_METRICS: u16 = 8428;

#[derive(Parser)]
#[command(
    about = "Shows a fleet of three robots and its centre; needs root for network namespaces"
)]
struct Options {
    /// End after this many seconds
    #[arg(long)]
    seconds: Option<f64>,
    #[arg(long, hide = true)]
    relay: Option<PathBuf>,
    #[arg(long, hide = true, default_value_t = API)]
    port: u16,
}

/// A robot: a computer with sensors, and one with the agent.
struct Robot {
    name: String,
    link: Link,
    uplink: Uplink,
}

fn main() -> ExitCode {
    match fleet(&Options::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("fleet: {error:#}");
            ExitCode::FAILURE
        }
    }
}

/// Runs on one thread: the processes started below live as long as this thread.
#[tokio::main(flavor = "current_thread")]
async fn fleet(options: &Options) -> Result<()> {
    if let Some(socket) = &options.relay {
        return relay::serve(socket, options.port);
    }
    let program = peer::rp()?;
    let name = program.display();
    ensure!(
        program.exists(),
        "{name} is missing: run `make fleet`, which builds it"
    );
    let directory = tempfile::tempdir().context("cannot create a directory")?;
    let centre = Namespace::isolated()?;
    println!("starting the centre: Prometheus, Alertmanager, VictoriaMetrics");
    let _engines = engines(&centre, directory.path())?;
    let mut relays = Vec::new();
    let mut addresses = String::new();
    for (name, port) in [
        ("Prometheus", PROMETHEUS),
        ("Alertmanager", ALERTMANAGER),
        ("VictoriaMetrics", VICTORIA_METRICS),
    ] {
        let relay = Relay::start(&centre, directory.path(), port)?;
        writeln!(addresses, "  {name:<16} http://{}", relay.address())?;
        relays.push(relay);
    }

    let mut robots = Vec::new();
    for number in 1..=3 {
        println!("starting robot-{number}");
        let link = Link::new()?;
        let uplink = link.robot.join(&centre)?;
        let name = format!("robot-{number}");
        robots.push(Robot { name, link, uplink });
    }
    let mut running = Vec::new();
    let mut agents = Vec::new();
    for robot in &robots {
        let (main, sensors) = (&robot.link.robot, &robot.link.monitor);
        let own = directory.path().join(&robot.name);
        agents.push(agent(robot, &program, &own)?);
        let relay = Relay::start(main, &own, API)?;
        let page = format!("{}'s page", robot.name);
        writeln!(addresses, "  {page:<16} http://{}", relay.address())?;
        relays.push(relay);
        for (host, role) in [(sensors, "lidar"), (main, "base"), (main, "monitor")] {
            running.push(peer::start_robot(host, role)?);
        }
    }
    let lossy = robots.get(1).context("no second robot")?;
    let _loss = Loss::of(&lossy.link.monitor, "meta l4proto udp", LOST)?;
    let leaving = robots.get(2).context("no third robot")?;

    let mut end = std::pin::pin!(ended(options.seconds));
    let mut change = Instant::now() + PHASE;
    let mut is_in_reach = true;
    loop {
        tokio::select! {
            interrupted = &mut end => {
                interrupted?;
                break;
            }
            () = sleep(REFRESH) => {}
        }
        if Instant::now() > change {
            change = Instant::now() + PHASE;
            is_in_reach = !is_in_reach;
            leaving.uplink.set_up(is_in_reach)?;
        }
        show(&centre, &program, &addresses, is_in_reach)?;
    }
    println!("\nstopping the robots and the centre");
    // Samples that wait on the third robot can be delivered now.
    leaving.uplink.set_up(true)?;
    drop(relays);
    for mut node in running {
        node.terminate()?;
    }
    for mut agent in agents {
        let status = agent.process.terminate()?;
        ensure!(status.success(), "an agent ended with {status}");
    }
    Ok(())
}

/// Starts the engines of the centre. Prometheus sends all samples to VictoriaMetrics as well.
fn engines(centre: &Namespace, directory: &Path) -> Result<Vec<Process>> {
    let shipped = std::fs::read_to_string(repository("deploy/prometheus/prometheus.yaml"))?;
    let rules = repository("dashboards/rules").display().to_string();
    let text = shipped.replace("/etc/ros2probe/rules", &rules)
        + &format!(
            "\nalerting: {{alertmanagers: [{{static_configs: [{{targets: ['127.0.0.1:{ALERTMANAGER}']}}]}}]}}\n\
             remote_write: [{{url: 'http://127.0.0.1:{VICTORIA_METRICS}/api/v1/write'}}]\n"
        );
    let file = |name: &str| directory.join(name);
    std::fs::write(file("prometheus.yaml"), text)?;
    std::fs::write(
        file("alertmanager.yaml"),
        "route: {receiver: none, group_by: [alertname, instance]}\nreceivers: [{name: none}]\n",
    )?;
    let option = |name: &str, path: &str| format!("{name}={}", file(path).display());
    let programs = [
        (
            "victoria-metrics",
            vec![
                option("-storageDataPath", "victoria-metrics"),
                format!("-httpListenAddr=127.0.0.1:{VICTORIA_METRICS}"),
                "-loggerLevel=ERROR".to_owned(),
            ],
        ),
        (
            "prometheus-alertmanager",
            vec![
                option("--config.file", "alertmanager.yaml"),
                option("--storage.path", "alertmanager"),
                format!("--web.listen-address=127.0.0.1:{ALERTMANAGER}"),
                "--cluster.listen-address=".to_owned(),
                "--log.level=error".to_owned(),
            ],
        ),
        (
            "prometheus",
            vec![
                option("--config.file", "prometheus.yaml"),
                option("--storage.tsdb.path", "prometheus"),
                format!("--web.listen-address=0.0.0.0:{PROMETHEUS}"),
                "--web.enable-remote-write-receiver".to_owned(),
                "--log.level=error".to_owned(),
            ],
        ),
    ];
    let [enter, network] = centre.outside();
    let started = programs.into_iter().map(|(program, arguments)| {
        let mut words = vec![enter.clone(), network.clone()];
        words.extend(with_own_files(program));
        let started = Process::start(&words, program, arguments);
        started.with_context(|| format!("{program}: run `.ci/prerequisites.sh fleet`"))
    });
    started.collect()
}

/// Starts the agent of a robot. Its watchlist is the default one, with an expectation.
fn agent<'a>(robot: &'a Robot, program: &Path, own: &Path) -> Result<Agent<'a>> {
    std::fs::create_dir_all(own.join("state"))?;
    let centre = robot.uplink.address();
    let text = format!(
        "watch: ['/**', {{topic: /points, max_loss_ratio: 0.01}}]\n\
         capture: {{source: host, cgroup: {}}}\n\
         api: {{socket: 'off'}}\n\
         state_directory: {}\n\
         remote_write: {{url: 'http://{centre}:{PROMETHEUS}/api/v1/write', instance: {}}}\n\
         fleet: {{engine: 'http://{centre}:{PROMETHEUS}', reach_s: 20}}\n",
        robot.link.robot.cgroup().display(),
        own.join("state").display(),
        robot.name
    );
    let configuration = own.join("ros2probe.yaml");
    std::fs::write(&configuration, text)?;
    let log = own.join("agent.log");
    Agent::start_logging(&robot.link.robot, program, &configuration, &log).with_context(|| {
        let log = std::fs::read(&log).unwrap_or_default();
        format!("the agent said: {}", String::from_utf8_lossy(&log).trim())
    })
}

/// Prints what `rp fleet` prints in the centre, and the alerts that fire.
fn show(centre: &Namespace, program: &Path, addresses: &str, is_in_reach: bool) -> Result<()> {
    let [enter, network] = centre.outside();
    let engine = format!("http://127.0.0.1:{PROMETHEUS}");
    let output = Command::new(enter)
        .arg(network)
        .arg(program)
        .args(["fleet", "--reach", "20", "--engine", &engine])
        .output()?;
    if std::io::stdout().is_terminal() {
        // Clears the screen.
        print!("\x1b[H\x1b[2J");
    }
    println!("{addresses}");
    let link = if is_in_reach { "up" } else { "cut" };
    println!("the link of robot-3 is {link}\n");
    print!("{}", String::from_utf8_lossy(&output.stdout));
    print!("{}", String::from_utf8_lossy(&output.stderr));
    let alerts = get(
        centre,
        &format!("http://127.0.0.1:{ALERTMANAGER}/api/v2/alerts"),
    )?;
    let alerts: serde_json::Value = serde_json::from_str(&alerts).context("Alertmanager")?;
    for alert in alerts.as_array().into_iter().flatten() {
        let label = |name: &str| {
            let label = alert.pointer(&format!("/labels/{name}"));
            label.and_then(|label| label.as_str()).unwrap_or_default()
        };
        println!(
            "alert: {} {} {}",
            label("instance"),
            label("alertname"),
            label("topic")
        );
    }
    println!();
    Ok(())
}
