//! `rp topic hz`, `bw`, `delay` and `echo` on a busy machine. They are correct where subscribers
//! are not, and they leave no trace, however they end.

use std::hint::spin_loop;
use std::io::{BufRead as _, BufReader};
use std::os::unix::process::ExitStatusExt as _;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::harness;
use ros2probe_testing::harness::agent::Agent;
use ros2probe_testing::harness::network::Namespace;
use ros2probe_testing::harness::peer::{Peer, Role, Stack, Stream};
use ros2probe_testing::harness::usage::Usage;
use ros2probe_testing::harness::wait_until;

const PATIENCE: Duration = Duration::from_secs(60);
const RATE: f64 = 200.0;
/// Maximum difference between the printed rate and the true one, as a part of it.
const TOLERANCE: f64 = 0.001;

/// Runs one test at a time, because both keep the machine busy.
static TURN: Mutex<()> = Mutex::new(());

#[test]
fn ten_clients_print_correct_rates_on_a_busy_machine_and_leave_no_trace() -> Result<()> {
    let _turn = TURN.lock().unwrap_or_else(PoisonError::into_inner);
    let host = Namespace::isolated()?;
    let directory = tempfile::tempdir()?;
    let (agent, socket) = agent(&host, directory.path())?;
    let stream = Stream::small(100_000);
    let subscriber = Peer::start(&host, Stack::Cyclone, Role::Subscriber, &stream, &["/ekf"])?;
    let mut publisher = Peer::start(&host, Stack::Cyclone, Role::Publisher, &stream, &["/imu"])?;
    publisher.wait_matched()?;
    agent.scrape_until("published", |scrape| {
        scrape.sum("ros2_topic_publishers", &[("topic", "/imu")]) > 0.0
    })?;
    let _load = Load::on_every_core();

    // There is a client for each kind of end, and some that continue.
    let start = |arguments: &str| Client::start(&socket, arguments);
    let hz = start("hz /imu")?;
    let mut killed = start("hz /imu /nobody")?;
    let mut ended = [
        (start("hz /imu --distro kilted")?, 0),
        (start("hz imu --distro humble")?, 2),
        (start("bw /imu --distro rolling")?, 0),
        (start("bw /imu --distro kilted")?, 2),
        (start("delay /imu --distro rolling")?, 2),
    ];
    let all = start("hz --all")?;
    let bandwidth = start("bw /imu")?;
    let delay = start("delay /imu")?;
    open(&agent, 10)?;
    publisher.start_sending()?;

    killed.prints("=====")?;
    killed.child.kill()?;
    killed.child.wait()?;
    open(&agent, 9)?;
    for (client, code) in &mut ended {
        client.reports(3)?;
        let status = client.interrupt()?;
        ensure!(status == Some(*code), "{}: {status:?}", client.name);
    }
    piped_into_head(&socket)?;
    open(&agent, 4)?;

    wait_true_rate(&hz, &publisher, 1000, TOLERANCE)?;
    all.prints("average rate: ")?;
    let sent = publisher.log()?.sequences("pub").len();
    let heard = subscriber.log()?.sequences("sub").len();
    eprintln!("of {sent} sent {heard} were received");
    // 320 bytes in DDS's encoding are sent 200 times a second, over the interval until now.
    wait_until("the bandwidth is printed", || {
        Ok((40.0..=70.0).contains(&bandwidth.last("")))
    })
    .with_context(|| bandwidth.printed().join("\n"))?;
    wait_until("the delay is printed", || {
        Ok((0.0..1.0).contains(&delay.last("average delay: ")))
    })
    .with_context(|| delay.printed().join("\n"))?;

    for client in [hz, all, bandwidth, delay] {
        drop(client);
    }
    check_unsubscribed(&agent, "/imu", 1000.0)?;
    wait_until("the publisher goes on", || {
        Ok(publisher.log()?.sequences("pub").len() as f64 > sent as f64 + RATE)
    })
}

/// Waits until the printed rate of at least this many messages is that of the publisher's log, up to
/// this part of it. The busier the machine, the longer single delays affect the rate.
fn wait_true_rate(hz: &Client, publisher: &Peer, messages: usize, part: f64) -> Result<()> {
    let mut compared = String::new();
    wait_until("the rate is that of the log", || {
        let Some((printed, window)) = hz.last_rate().filter(|(_, window)| *window >= messages)
        else {
            return Ok(false);
        };
        let log = publisher.log()?.0;
        let sent = log.iter().filter(|event| event.ev == "pub");
        let sent: Vec<u64> = sent.map(|event| event.t).take(window).collect();
        let (Some(first), Some(last)) = (sent.first(), sent.last()) else {
            return Ok(false);
        };
        let true_rate = (sent.len() - 1) as f64 / ((last - first) as f64 / 1e9);
        compared = format!("said {printed}, sent {true_rate:.3} Hz in {window} messages");
        Ok((printed - true_rate).abs() <= true_rate * part)
    })
    .with_context(|| compared.clone())?;
    eprintln!("{compared}");
    Ok(())
}

/// Starts an agent that watches nothing by itself, and returns it with its socket.
fn agent<'a>(host: &'a Namespace, directory: &Path) -> Result<(Agent<'a>, PathBuf)> {
    let configuration = directory.join("ros2probe.yaml");
    let socket = directory.join("api.sock");
    let text = format!(
        "capture: {{source: host, cgroup: {}, shm: {{mode: off}}}}\nwatch: []\n\
         state_directory: {}\napi: {{socket: {}}}\n",
        host.cgroup().display(),
        directory.display(),
        socket.display()
    );
    std::fs::write(&configuration, text)?;
    let agent = Agent::start(host, env!("CARGO_BIN_EXE_rp"), &configuration)?;
    Ok((agent, socket))
}

/// Point clouds of 2.72 MB, 20 a second: 54 MB a second go from the agent to `echo`.
#[test]
fn echoing_point_clouds_takes_bounded_memory_and_changes_no_count() -> Result<()> {
    const SIZE: usize = 2_720_000;
    const AGENT: u64 = 160 << 20;
    const CLIENT: u64 = 64 << 20;
    let _turn = TURN.lock().unwrap_or_else(PoisonError::into_inner);
    let host = Namespace::isolated()?;
    let directory = tempfile::tempdir()?;
    let (agent, socket) = agent(&host, directory.path())?;
    let stream = Stream {
        reliable: true,
        ..Stream::point_cloud(SIZE, 100_000)
    };
    let _subscriber = Peer::start(&host, Stack::Cyclone, Role::Subscriber, &stream, &["/map"])?;
    let mut publisher = Peer::start(&host, Stack::Cyclone, Role::Publisher, &stream, &["/lidar"])?;
    publisher.wait_matched()?;
    agent.scrape_until("published", |scrape| {
        scrape.sum("ros2_topic_publishers", &[("topic", "/points")]) > 0.0
    })?;
    let hz = Client::start(&socket, "hz /points")?;
    let mut echo = Client::start(&socket, "echo /points")?;
    publisher.start_sending()?;
    let shown = || -> usize {
        let printed = echo.printed();
        printed
            .iter()
            .filter(|line| *line == "row_step: 2719947")
            .count()
    };
    let (mut of_agent, mut of_client) = (0, 0);
    let mut spent = Usage::of(echo.child.id())?;
    let before = (shown(), Instant::now(), spent);
    wait_until("a hundred clouds are shown", || {
        of_agent = of_agent.max(Usage::of(agent.process.pid())?.memory.unreclaimable);
        spent = Usage::of(echo.child.id())?;
        of_client = of_client.max(spent.memory.unreclaimable);
        Ok(shown() >= 100)
    })?;
    eprintln!(
        "agent {} MB, client {} MB and {:.2} CPU s for {} clouds in {:.1} s",
        of_agent >> 20,
        of_client >> 20,
        spent.since(&before.2).cpu.as_secs_f64(),
        shown() - before.0,
        before.1.elapsed().as_secs_f64()
    );
    ensure!(of_agent < AGENT, "the agent took {of_agent} bytes");
    ensure!(of_client < CLIENT, "the client took {of_client} bytes");

    // A killed client closes nothing itself, and the agent does not wait for it.
    echo.child.kill()?;
    echo.child.wait()?;
    wait_true_rate(&hz, &publisher, 50, 0.05)?;
    drop(hz);
    check_unsubscribed(&agent, "/points", 50.0)
}

/// Checks that the topic continues and its count stays: a subscription that a client left behind
/// would increase it.
fn check_unsubscribed(agent: &Agent<'_>, topic: &str, least: f64) -> Result<()> {
    wait_until("the topic is let go", || {
        let counted = || -> Result<f64> {
            let labels = [("topic", topic)];
            Ok(agent.scrape()?.sum("ros2_topic_messages_total", &labels))
        };
        let before = counted()?;
        ensure!(before > least, "{before} messages were counted");
        std::thread::sleep(Duration::from_secs(2));
        Ok(counted()? <= before)
    })
}

/// Waits until this many subscriptions are open.
fn open(agent: &Agent<'_>, wanted: u32) -> Result<()> {
    let what = format!("{wanted} subscriptions open");
    let page = agent.scrape_until(&what, |page| {
        page.value("ros2probe_subscriptions", &[]) == Some(f64::from(wanted))
    });
    page.map(drop)
}

/// Checks that `rp` ends silently once its reader is gone, as any program does.
fn piped_into_head(socket: &Path) -> Result<()> {
    let rp = env!("CARGO_BIN_EXE_rp");
    let script = format!(
        "{rp} topic hz /imu --socket {} | head -2; echo ${{PIPESTATUS[0]}}",
        socket.display()
    );
    let output = Command::new("bash").args(["-c", &script]).output()?;
    let (output_text, errors) = (
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr),
    );
    let lines: Vec<&str> = output_text.lines().collect();
    let [rate, spread, code] = lines[..] else {
        anyhow::bail!("{output_text}{errors}");
    };
    ensure!(
        rate.starts_with("average rate: ") && spread.starts_with("\tmin: "),
        "{output_text}"
    );
    ensure!(code == "141" && errors.is_empty(), "{output_text}{errors}");
    Ok(())
}

/// One `rp`, and its output.
struct Client {
    name: String,
    child: Child,
    printed: Arc<Mutex<Vec<String>>>,
}

impl Client {
    fn start(socket: &Path, arguments: &str) -> Result<Client> {
        let mut child = Command::new(env!("CARGO_BIN_EXE_rp"))
            .env_remove("ROS_DISTRO")
            .env_remove("ROS_DOMAIN_ID")
            .arg("topic")
            .args(arguments.split(' '))
            .arg("--socket")
            .arg(socket)
            .stdout(Stdio::piped())
            .spawn()?;
        let stdout = child.stdout.take().context("no output")?;
        let printed = Arc::new(Mutex::new(Vec::new()));
        let lines = Arc::clone(&printed);
        std::thread::spawn(move || {
            for line in BufReader::new(stdout).lines().map_while(Result::ok) {
                lines
                    .lock()
                    .unwrap_or_else(PoisonError::into_inner)
                    .push(line);
            }
        });
        let name = arguments.to_owned();
        Ok(Client {
            name,
            child,
            printed,
        })
    }

    fn printed(&self) -> MutexGuard<'_, Vec<String>> {
        self.printed.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn prints(&self, begin: &str) -> Result<()> {
        let what = format!("{} prints `{begin}`", self.name);
        wait_until(&what, || {
            Ok(self.printed().iter().any(|line| line.starts_with(begin)))
        })
    }

    /// Waits for this many more lines.
    fn reports(&self, more: usize) -> Result<()> {
        let now = self.printed().len();
        let what = format!("{} goes on", self.name);
        wait_until(&what, || Ok(self.printed().len() >= now + more))
    }

    /// Returns the last printed number after these words; NaN before the first.
    fn last(&self, words: &str) -> f64 {
        let printed = self.printed();
        let mut numbers = printed.iter().rev().filter_map(|line| {
            let number = line.strip_prefix(words)?.split(' ').next()?;
            number.parse().ok()
        });
        numbers.next().unwrap_or(f64::NAN)
    }

    /// Returns the last printed rate, and the number of messages that it covers.
    fn last_rate(&self) -> Option<(f64, usize)> {
        let printed = self.printed();
        let place = printed.iter().rposition(|line| line.contains("window: "))?;
        let rate = printed.get(place.checked_sub(1)?)?;
        let rate = rate.strip_prefix("average rate: ")?.split(' ').next()?;
        let (_, window) = printed.get(place)?.rsplit_once("window: ")?;
        Some((rate.parse().ok()?, window.trim().parse().ok()?))
    }

    /// Sends Ctrl-C, and returns the exit code.
    fn interrupt(&mut self) -> Result<Option<i32>> {
        harness::run(&format!("kill -INT {}", self.child.id()))?;
        let deadline = Instant::now() + PATIENCE;
        loop {
            if let Some(status) = self.child.try_wait()? {
                ensure!(status.signal().is_none(), "{}: {status}", self.name);
                return Ok(status.code());
            }
            ensure!(Instant::now() < deadline, "{} does not end", self.name);
            std::thread::sleep(Duration::from_millis(10));
        }
    }
}

impl Drop for Client {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Keeps every core busy.
struct Load {
    on: Arc<AtomicBool>,
}

impl Load {
    fn on_every_core() -> Load {
        let on = Arc::new(AtomicBool::new(true));
        let cores = std::thread::available_parallelism().map_or(2, usize::from);
        for _ in 0..cores {
            let on = Arc::clone(&on);
            std::thread::spawn(move || {
                while on.load(Ordering::Relaxed) {
                    spin_loop();
                }
            });
        }
        Load { on }
    }
}

impl Drop for Load {
    fn drop(&mut self) {
        self.on.store(false, Ordering::Relaxed);
    }
}
