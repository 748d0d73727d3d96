//! `rp fleet`.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use anyhow::{Context as _, Result};
use clap::Args;
use ros2probe::fleet::{FleetText, Page, RobotText};
use ros2probe_api::fleet::{Incidents, Robot, RobotWithIncidents, State};
use ros2probe_capture::error_chain::in_words;
use ros2probe_daemon::agent::DEFAULT_CONFIG;
use ros2probe_daemon::config::{Config, FleetSettings};
use ros2probe_daemon::fleet::{self, Engine, IncidentReader, Link, MAX_BYTES, Sources};
use tokio::time::timeout;

use super::{Output, UserError};

/// Variable with the address of the engine.
const ENGINE_VARIABLE: &str = "ROS2PROBE_ENGINE";

/// Maximum time to read the incidents. The command prints those that it has read by then.
const STORE_TIMEOUT: Duration = Duration::from_secs(10);

/// `rp fleet`.
#[derive(Args, Debug)]
#[command(after_help = "\
It queries an engine to which the agents of the robots deliver, and contacts no robot. A robot is a
value of the label `instance`. A robot differs if more than half of all robots in reach have another
value; a rate differs by more than a fifth. The name of a robot in names of nodes and topics counts
as the same on every robot. With a store in the section `fleet` of the configuration, it lists the
incidents whose bags `rp ship` delivered.
Exit codes: 0 no robot is in trouble, 3 a robot is out of reach, not ready, or violates an
expectation, 2 wrong usage, 1 otherwise.

Examples:
  rp fleet --engine http://prometheus.example:9090
  rp fleet --engine https://mimir.example/prometheus --token-file token --json
  rp fleet --config fleet.yaml --listen 127.0.0.1:17410
  rp fleet robot-7                       how its graph differs from that of the others
  rp fleet --engine http://prometheus.example:9090 --listen 127.0.0.1:17410 \
    --link 'http://{robot}.example:17401/'")]
pub(crate) struct Fleet {
    /// A robot: print it alone, with all that differs from the others
    #[arg(value_name = "ROBOT", conflicts_with = "listen")]
    robot: Option<String>,
    /// URL of Prometheus, VictoriaMetrics, Mimir or Thanos [default: $ROS2PROBE_ENGINE]
    #[arg(long, value_name = "URL")]
    engine: Option<String>,
    /// File with a bearer token for the engine
    #[arg(long, value_name = "FILE")]
    token_file: Option<PathBuf>,
    /// Configuration whose section `fleet` names engine and store
    /// [default: /etc/ros2probe/ros2probe.yaml, if no engine is named and the file exists]
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Value of the label `job` of the robots [default: ros2probe]
    #[arg(long)]
    job: Option<String>,
    /// Hours for which a robot without samples is listed as out of reach [default: 24]
    #[arg(long, value_name = "HOURS", value_parser = clap::value_parser!(u32).range(1..=720))]
    since: Option<u32>,
    /// Seconds without samples after which a robot is out of reach [default: 60]
    #[arg(long, value_name = "SECONDS", value_parser = clap::value_parser!(u32).range(1..=86_400))]
    reach: Option<u32>,
    /// Print JSON: one object
    #[arg(long, conflicts_with = "listen")]
    json: bool,
    /// Serve a page with the robots at this loopback address, until Ctrl-C
    #[arg(long, value_name = "ADDRESS")]
    listen: Option<SocketAddr>,
    /// URL of a robot's own page, with {robot} in place of its name: the page links to it
    #[arg(long, value_name = "URL", requires = "listen")]
    link: Option<Link>,
}

/// Exit code if a robot is in trouble.
const EXIT_TROUBLE: u8 = 3;

impl Fleet {
    pub(crate) fn print(self) -> Result<ExitCode> {
        let settings = self.settings()?;
        let Some(url) = settings.engine else {
            let text =
                format!("rp: no engine is named: pass --engine URL, or set {ENGINE_VARIABLE}");
            return Err(UserError(text).into());
        };
        let token_file = settings.token_file.as_deref();
        let incidents = settings.store.map(IncidentReader::new).transpose();
        let sources = Sources {
            engine: Engine::new(&url, token_file, MAX_BYTES)?,
            question: settings.question,
            incidents: incidents.context("fleet.store")?,
        };
        if let Some(address) = self.listen {
            return serve(address, settings.link, sources);
        }
        let fleet = read(sources, &url, self.robot.as_deref())?;
        let Some(name) = self.robot else {
            let text = match self.json {
                true => serde_json::to_string_pretty(&fleet)? + "\n",
                false => FleetText(&fleet).to_string(),
            };
            Output::new().write(&text)?;
            return Ok(exit_code(&fleet.robots));
        };
        let Some(robot) = fleet.robots.iter().find(|robot| robot.name == name) else {
            let text = format!("rp: {url} has no robot `{name}`: `rp fleet` lists them");
            return Err(UserError(text).into());
        };
        let text = match self.json {
            true => {
                let robot = RobotWithIncidents {
                    robot: robot.clone(),
                    incidents: fleet.incidents.clone(),
                };
                serde_json::to_string_pretty(&robot)? + "\n"
            }
            false => RobotText(robot, &fleet).to_string(),
        };
        Output::new().write(&text)?;
        Ok(exit_code(std::slice::from_ref(robot)))
    }

    /// Returns the settings of the configuration with those of the command line.
    fn settings(&self) -> Result<FleetSettings> {
        let variable = || std::env::var(ENGINE_VARIABLE).ok();
        let named = self.engine.clone().or_else(variable);
        let named = named.filter(|url| !url.is_empty());
        let installed = || {
            (named.is_none() && Path::new(DEFAULT_CONFIG).exists()).then(|| DEFAULT_CONFIG.into())
        };
        let mut settings = match self.config.clone().or_else(installed) {
            Some(path) => Config::load(&path)?.fleet,
            None => FleetSettings::default(),
        };
        // A file that was named has precedence over the environment.
        let is_in_file = self.engine.is_none() && settings.engine.is_some();
        if !is_in_file {
            settings.engine = named;
        }
        if self.token_file.is_some() {
            settings.token_file.clone_from(&self.token_file);
        }
        if self.link.is_some() {
            settings.link.clone_from(&self.link);
        }
        let question = &mut settings.question;
        if let Some(job) = &self.job {
            question.job.clone_from(job);
        }
        question.hours = self.since.unwrap_or(question.hours);
        question.reach = self.reach.unwrap_or(question.reach);
        Ok(settings)
    }
}

/// Serves the page until Ctrl-C.
fn serve(address: SocketAddr, link: Option<Link>, sources: Sources) -> Result<ExitCode> {
    let page = Page::bind(address, link)?;
    eprintln!(
        "rp: the fleet is at http://{}/ (Ctrl-C ends)",
        page.local_addr()?
    );
    page.serve(sources)?;
    Ok(ExitCode::SUCCESS)
}

/// Reads the engine, and the incidents of a robot or of all. A store that does not answer is a
/// problem of the incidents alone.
fn read(sources: Sources, url: &str, robot: Option<&str>) -> Result<ros2probe_api::fleet::Fleet> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .context("cannot start a runtime")?;
    let Sources {
        engine,
        question,
        incidents,
    } = sources;
    let found = Mutex::new(None);
    let show = |incidents| *found.lock().unwrap_or_else(PoisonError::into_inner) = Some(incidents);
    let stored = async {
        let mut reader = incidents?;
        let problem = match timeout(STORE_TIMEOUT, reader.read(robot, show)).await {
            Ok(Ok(())) => None,
            Ok(Err(error)) => Some(in_words(&error)),
            Err(_) => Some(format!(
                "it did not answer in {} s",
                STORE_TIMEOUT.as_secs()
            )),
        };
        let mut found = found.lock().unwrap_or_else(PoisonError::into_inner);
        let mut incidents: Incidents = found.take().unwrap_or_default();
        incidents.problem = problem;
        Some(incidents)
    };
    let read = async { tokio::join!(fleet::read(&engine, &question), stored) };
    let (fleet, incidents) = runtime.block_on(read);
    // A folder that hangs must not delay the end.
    runtime.shutdown_background();
    let mut fleet = fleet.with_context(|| format!("the engine at {url}"))?;
    if fleet.robots.is_empty() {
        let text = format!(
            "rp: {url} has no robots of the job `{}` within {} h: do their agents deliver to it?",
            question.job, question.hours
        );
        return Err(UserError(text).into());
    }
    fleet.incidents = incidents;
    Ok(fleet)
}

fn exit_code(robots: &[Robot]) -> ExitCode {
    match robots.iter().any(|robot| robot.state < State::Findings) {
        true => ExitCode::from(EXIT_TROUBLE),
        false => ExitCode::SUCCESS,
    }
}
