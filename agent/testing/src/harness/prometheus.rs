//! A real Prometheus on a host, and the results of its queries.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, bail};
use tempfile::TempDir;

use super::agent::get;
use super::network::Namespace;
use super::process::Process;

pub const INSTALL: &str = "run `make prerequisites` or `apt-get install prometheus`";
const SERVER: &str = "127.0.0.1:9090";
/// Maximum wait for the result of a query.
const PATIENCE: Duration = Duration::from_secs(90);

pub struct Prometheus<'a> {
    host: &'a Namespace,
    _process: Process,
    _directory: TempDir,
}

/// Mode of a Prometheus.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// Stores, evaluates and answers, and accepts pushed samples.
    Server,
    /// Scrapes and pushes, and stores only undelivered samples.
    Agent,
    /// VictoriaMetrics, which accepts pushed samples and answers the same queries. It reads no
    /// configuration.
    VictoriaMetrics,
}

impl<'a> Prometheus<'a> {
    /// Starts a server that scrapes these targets (`address:port`) and evaluates these rule files
    /// each second.
    pub fn start(
        host: &'a Namespace,
        targets: &[String],
        rules: &[PathBuf],
    ) -> Result<Prometheus<'a>> {
        let text = format!(
            "global: {{scrape_interval: 1s, evaluation_interval: 1s}}\n\
             rule_files: {rules:?}\n\
             scrape_configs: [{{job_name: ros2probe, static_configs: [{{targets: {targets:?}}}]}}]\n",
        );
        Prometheus::run(host, Kind::Server, &text)
    }

    /// Starts Prometheus with this configuration on port 9090, and returns once it answers queries.
    pub fn run(host: &'a Namespace, kind: Kind, text: &str) -> Result<Prometheus<'a>> {
        let directory = tempfile::tempdir()?;
        let configuration = directory.path().join("prometheus.yml");
        std::fs::write(&configuration, text)?;
        let data = directory.path().join("data");
        let data = data.display();
        let prometheus = |own: [String; 2]| {
            own.into_iter().chain([
                format!("--config.file={}", configuration.display()),
                "--web.listen-address=0.0.0.0:9090".to_owned(),
                "--log.level=error".to_owned(),
            ])
        };
        let (program, arguments): (_, Vec<_>) = match kind {
            Kind::Server => {
                let own = [
                    format!("--storage.tsdb.path={data}"),
                    "--web.enable-remote-write-receiver".to_owned(),
                ];
                ("prometheus", prometheus(own).collect())
            }
            Kind::Agent => {
                let own = [
                    format!("--storage.agent.path={data}"),
                    "--enable-feature=agent".to_owned(),
                ];
                ("prometheus", prometheus(own).collect())
            }
            Kind::VictoriaMetrics => {
                let own = [
                    format!("-storageDataPath={data}"),
                    "-httpListenAddr=0.0.0.0:9090".to_owned(),
                    "-loggerLevel=ERROR".to_owned(),
                    // Samples are found as soon as they are stored.
                    "-search.latencyOffset=0s".to_owned(),
                    "-search.disableCache".to_owned(),
                ];
                ("victoria-metrics", own.into())
            }
        };
        let process = Process::start(&host.outside(), program, arguments).context(INSTALL)?;
        let prometheus = Prometheus {
            host,
            _process: process,
            _directory: directory,
        };
        prometheus.wait_until_ready()?;
        Ok(prometheus)
    }

    /// Waits until Prometheus is ready; before that, it answers each query with 503.
    fn wait_until_ready(&self) -> Result<()> {
        let deadline = Instant::now() + PATIENCE;
        while let Err(error) = get(self.host, &format!("http://{SERVER}/-/ready")) {
            if Instant::now() > deadline {
                return Err(error.context("Prometheus does not become ready"));
            }
            std::thread::sleep(Duration::from_millis(100));
        }
        Ok(())
    }

    /// Queries until there is a result, and returns the value of its first sample.
    pub fn query(&self, expression: &str) -> Result<f64> {
        let deadline = Instant::now() + PATIENCE;
        loop {
            let answer = self.request(expression);
            let value = answer
                .as_ref()
                .ok()
                .and_then(|answer| answer.pointer("/data/result/0/value/1"))
                .and_then(|value| value.as_str());
            if let Some(value) = value.and_then(|value| value.parse().ok()) {
                return Ok(value);
            }
            if Instant::now() > deadline {
                bail!("{expression}: {answer:?}; is `prometheus` there? {INSTALL}");
            }
            std::thread::sleep(Duration::from_millis(300));
        }
    }

    /// Queries until the result is `wanted`.
    pub fn wait_for(&self, expression: &str, wanted: f64) -> Result<()> {
        let deadline = Instant::now() + PATIENCE;
        loop {
            let value = self.query(expression)?;
            if value == wanted {
                return Ok(());
            }
            if Instant::now() > deadline {
                bail!("{expression} is {value} and not {wanted}");
            }
            std::thread::sleep(Duration::from_millis(300));
        }
    }

    /// Returns the current number of series of an expression.
    pub fn series(&self, expression: &str) -> Result<usize> {
        Ok(self.label_sets(expression)?.len())
    }

    /// Returns the labels of each current series of an expression.
    pub fn label_sets(&self, expression: &str) -> Result<Vec<BTreeMap<String, String>>> {
        let answer = self
            .request(expression)
            .with_context(|| expression.to_owned())?;
        let result = answer.pointer("/data/result");
        let series = result.and_then(|result| result.as_array());
        let labels = series
            .with_context(|| format!("{expression}: {answer}"))?
            .iter()
            .map(|series| Ok(serde_json::from_value(series["metric"].clone())?));
        labels.collect()
    }

    /// Returns the times of the first series' samples, for an expression such as `up[30s]`.
    pub fn times(&self, expression: &str) -> Result<Vec<f64>> {
        let answer = self.request(expression)?;
        let samples = answer.pointer("/data/result/0/values");
        let samples = samples.and_then(|samples| samples.as_array());
        let samples = samples.with_context(|| format!("{expression}: {answer}"))?;
        Ok(samples
            .iter()
            .filter_map(|sample| sample.get(0)?.as_f64())
            .collect())
    }

    fn request(&self, expression: &str) -> Result<serde_json::Value> {
        let encoded: String = expression
            .bytes()
            .map(|byte| format!("%{byte:02X}"))
            .collect();
        let body = get(
            self.host,
            &format!("http://{SERVER}/api/v1/query?query={encoded}"),
        )?;
        serde_json::from_str(&body).with_context(|| format!("not JSON: {body}"))
    }
}
