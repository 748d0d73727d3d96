//! `rp fleet`.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::{Context as _, Result};
use clap::Args;
use ros2probe::fleet::{self, Engine, Link, Page, Question};

use super::{Output, UserError};

/// Variable with the address of the engine.
const ENGINE_VARIABLE: &str = "ROS2PROBE_ENGINE";
/// Maximum size of the file with a token, in bytes.
const TOKEN_BYTES: u64 = 64 << 10;

/// `rp fleet`.
#[derive(Args, Debug)]
#[command(after_help = "\
It queries an engine to which the agents of the robots deliver, and contacts no robot. A robot is a
value of the label `instance`. A robot differs if more than half of all robots in reach have another
value; a rate differs by more than a fifth. The name of a robot in names of nodes and topics counts
as the same on every robot.
Exit codes: 0 no robot is in trouble, 3 a robot is out of reach, not ready, or violates an
expectation, 2 wrong usage, 1 otherwise.

Examples:
  rp fleet --engine http://prometheus.example:9090
  rp fleet --engine https://mimir.example/prometheus --token-file token --json
  rp fleet --engine http://prometheus.example:9090 --listen 127.0.0.1:17410 \
    --link 'http://{robot}.example:17401/'")]
pub(crate) struct Fleet {
    /// URL of Prometheus, VictoriaMetrics, Mimir or Thanos [default: $ROS2PROBE_ENGINE]
    #[arg(long, value_name = "URL")]
    engine: Option<String>,
    /// File with a bearer token for the engine
    #[arg(long, value_name = "FILE")]
    token_file: Option<PathBuf>,
    /// Value of the label `job` of the robots
    #[arg(long, default_value = "ros2probe")]
    job: String,
    /// Hours for which a robot without samples is listed as out of reach
    #[arg(long, value_name = "HOURS", default_value_t = 24, value_parser = clap::value_parser!(u32).range(1..=720))]
    since: u32,
    /// Seconds without samples after which a robot is out of reach
    #[arg(long, value_name = "SECONDS", default_value_t = 60, value_parser = clap::value_parser!(u32).range(1..=86_400))]
    reach: u32,
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
        let named = || {
            std::env::var(ENGINE_VARIABLE)
                .ok()
                .filter(|url| !url.is_empty())
        };
        let Some(url) = self.engine.or_else(named) else {
            let text =
                format!("rp: no engine is named: pass --engine URL, or set {ENGINE_VARIABLE}");
            return Err(UserError(text).into());
        };
        let token = self.token_file.map(|path| {
            let text = ros2probe_daemon::file::read_text(&path, TOKEN_BYTES);
            text.with_context(|| format!("cannot read {}", path.display()))
        });
        let engine = Engine::new(&url, token.transpose()?.as_deref())?;
        let question = Question {
            job: self.job,
            hours: self.since,
            reach: self.reach,
        };
        if let Some(address) = self.listen {
            let page = Page::bind(address, self.link)?;
            eprintln!(
                "rp: the fleet is at http://{}/ (Ctrl-C ends)",
                page.local_addr()?
            );
            page.serve(engine, question)?;
            return Ok(ExitCode::SUCCESS);
        }
        let fleet = fleet::Fleet::read(&engine, &question);
        let fleet = fleet.with_context(|| format!("the engine at {url}"))?;
        if fleet.robots.is_empty() {
            let text = format!(
                "rp: {url} has no robots of the job `{}` within {} h: do their agents deliver to it?",
                question.job, question.hours
            );
            return Err(UserError(text).into());
        }
        let text = match self.json {
            true => serde_json::to_string_pretty(&fleet)? + "\n",
            false => fleet.to_string(),
        };
        Output::new().write(&text)?;
        let is_in_trouble = fleet
            .robots
            .iter()
            .any(|robot| robot.state < fleet::State::Findings);
        Ok(match is_in_trouble {
            true => ExitCode::from(EXIT_TROUBLE),
            false => ExitCode::SUCCESS,
        })
    }
}
