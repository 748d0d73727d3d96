//! A real Alertmanager on a host, and the notifications that it sends.

use std::collections::BTreeMap;
use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, bail};
use ros2probe_capture::netns;
use serde_json::Value;
use tempfile::TempDir;

use super::network::Namespace;
use super::process::Process;

/// Part of the configuration of a Prometheus on the same host.
pub const ALERTING: &str =
    "alerting: {alertmanagers: [{static_configs: [{targets: ['127.0.0.1:9093']}]}]}\n";
/// Maximum wait for a notification, on a busy machine.
const PATIENCE: Duration = Duration::from_secs(120);

/// States of each alert in the order of their notifications, by the names of alert and robot.
type States = BTreeMap<(String, String), Vec<String>>;

pub struct Alertmanager {
    _process: Process,
    _directory: TempDir,
    states: Arc<Mutex<States>>,
}

impl Alertmanager {
    /// Starts it on port 9093. It sends each change of an alert at once, and repeats none.
    pub fn start(host: &Namespace) -> Result<Alertmanager> {
        let listener = netns::within(&host.network(), || TcpListener::bind("127.0.0.1:0"))??;
        let address = listener.local_addr()?;
        let states = Arc::<Mutex<States>>::default();
        let kept = Arc::clone(&states);
        std::thread::spawn(move || {
            for stream in listener.incoming().map_while(Result::ok) {
                if let Err(error) = receive(stream, &kept) {
                    eprintln!("not a notification: {error:#}");
                }
            }
        });
        let directory = tempfile::tempdir()?;
        let configuration = directory.path().join("alertmanager.yaml");
        let text = format!(
            "route: {{receiver: test, group_by: ['...'], group_wait: 1s, group_interval: 1s, \
             repeat_interval: 4h}}\n\
             receivers: [{{name: test, webhook_configs: [{{url: 'http://{address}/'}}]}}]\n"
        );
        std::fs::write(&configuration, text)?;
        let program = "prometheus-alertmanager";
        let mut words = Vec::from(host.outside());
        words.extend(with_own_files(program));
        let arguments = [
            format!("--config.file={}", configuration.display()),
            format!("--storage.path={}", directory.path().join("data").display()),
            "--web.listen-address=127.0.0.1:9093".to_owned(),
            "--cluster.listen-address=".to_owned(),
            "--log.level=error".to_owned(),
        ];
        let process = Process::start(&words, program, arguments);
        Ok(Alertmanager {
            _process: process.context("run `.ci/prerequisites.sh fleet`")?,
            _directory: directory,
            states,
        })
    }

    /// Waits until an alert about a robot had these states, one after the other and each once.
    pub fn wait_for(&self, alert: &str, robot: &str, wanted: &[&str]) -> Result<()> {
        let key = (alert.to_owned(), robot.to_owned());
        let deadline = Instant::now() + PATIENCE;
        loop {
            let states = self.states();
            if states.get(&key).is_some_and(|states| states == wanted) {
                return Ok(());
            }
            if Instant::now() > deadline {
                bail!("{alert} of {robot} is not {wanted:?}: {states:?}");
            }
            std::thread::sleep(Duration::from_millis(100));
        }
    }

    /// Returns the names of the robots that had an alert.
    pub fn robots_with(&self, alert: &str) -> Vec<String> {
        let states = self.states().into_keys();
        let own = states.filter(|(name, _)| name == alert);
        own.map(|(_, robot)| robot).collect()
    }

    fn states(&self) -> States {
        let states = self.states.lock();
        states.unwrap_or_else(PoisonError::into_inner).clone()
    }
}

/// Reads a notification (`webhook_config`), and confirms it.
fn receive(stream: TcpStream, states: &Mutex<States>) -> Result<()> {
    let mut reader = BufReader::new(stream);
    let mut length = 0;
    loop {
        let mut line = String::new();
        reader.read_line(&mut line)?;
        let line = line.trim().to_ascii_lowercase();
        if line.is_empty() {
            break;
        }
        if let Some(value) = line.strip_prefix("content-length:") {
            length = value.trim().parse()?;
        }
    }
    let mut body = vec![0; length];
    reader.read_exact(&mut body)?;
    let answer = "HTTP/1.1 200 OK\r\nContent-Length: 0\r\nConnection: close\r\n\r\n";
    reader.get_mut().write_all(answer.as_bytes())?;
    let notification: Value = serde_json::from_slice(&body)?;
    let text = |alert: &Value, pointer: &str| {
        let text = alert.pointer(pointer).and_then(Value::as_str);
        text.unwrap_or_default().to_owned()
    };
    let mut states = states.lock().unwrap_or_else(PoisonError::into_inner);
    for alert in notification["alerts"].as_array().into_iter().flatten() {
        let name = text(alert, "/labels/alertname");
        let key = (name, text(alert, "/labels/instance"));
        states.entry(key).or_default().push(text(alert, "/status"));
    }
    Ok(())
}

/// Returns the command prefix of a program that was unpacked but not installed, and reads files in
/// `/usr/share`: it sees its own there.
pub fn with_own_files(program: &str) -> Vec<String> {
    let path = std::env::var_os("PATH").unwrap_or_default();
    let found = std::env::split_paths(&path).find(|directory| directory.join(program).exists());
    let share = found
        .as_deref()
        .and_then(Path::parent)
        .map(|root| root.join("share"));
    match share {
        Some(share) if share != Path::new("/usr/share") && share.join("prometheus").exists() => {
            let script = format!(
                "mount -t overlay overlay -o lowerdir={}:/usr/share /usr/share && exec \"$0\" \"$@\"",
                share.display()
            );
            ["unshare", "--mount", "sh", "-c", &script]
                .map(str::to_owned)
                .into()
        }
        _ => Vec::new(),
    }
}
