//! A robot that publishes, a program that records it, and the content of its bags.

use super::*;
use ros2probe_testing::bag_messages::for_each_message;

/// An agent with a directory for bags.
pub(super) struct Robot<'a> {
    pub(super) host: &'a Namespace,
    pub(super) directory: TempDir,
    pub(super) socket: PathBuf,
    pub(super) agent: Agent<'a>,
}

impl<'a> Robot<'a> {
    pub(super) fn start(
        host: &'a Namespace,
        settings: &str,
        enter: &[String],
    ) -> Result<Robot<'a>> {
        Robot::start_in(host, settings, enter, tempfile::tempdir()?)
    }

    /// Starts the agent. `enter` mounts over the directory for bags, which is its next argument.
    pub(super) fn start_on_disk(
        host: &'a Namespace,
        settings: &str,
        mut enter: Vec<String>,
    ) -> Result<Robot<'a>> {
        let directory = tempfile::tempdir()?;
        enter.push(directory.path().join("bags").display().to_string());
        Robot::start_in(host, settings, &enter, directory)
    }

    pub(super) fn start_in(
        host: &'a Namespace,
        settings: &str,
        enter: &[String],
        directory: TempDir,
    ) -> Result<Robot<'a>> {
        let socket = directory.path().join("api.sock");
        let bags = directory.path().join("bags");
        fs::create_dir(&bags)?;
        let mut all: serde_json::Map<String, Value> = serde_yaml::from_str(settings)?;
        all.insert(
            "capture".to_owned(),
            json!({"source": "host", "cgroup": host.cgroup(), "shm": {"mode": "off"}}),
        );
        all.insert("api".to_owned(), json!({"socket": &socket}));
        all.insert("state_directory".to_owned(), json!(directory.path()));
        let recordings = all.entry("recordings").or_insert(json!({}));
        recordings["directory"] = json!(&bags);
        // Disks are filled to the last byte here.
        recordings["reserve_percent"] = json!(0);
        recordings["reserve_bytes"] = json!(0);
        let configuration = directory.path().join("ros2probe.yaml");
        fs::write(&configuration, serde_json::to_string(&all)?)?;
        let arguments = [Path::new("run"), Path::new("--config"), &configuration];
        let process = Process::start(enter, RP, arguments)?;
        let mut agent = Agent { process, host };
        agent.wait_ready(PATIENCE)?;
        Ok(Robot {
            host,
            directory,
            socket,
            agent,
        })
    }

    pub(super) fn bags(&self) -> PathBuf {
        self.directory.path().join("bags")
    }

    /// Starts a publisher that the agent knows and that waits, and its subscriber.
    pub(super) fn pair(&self, stream: &Stream) -> Result<(Peer, Peer)> {
        let start = |role, node| Peer::start(self.host, Stack::Cyclone, role, stream, &[node]);
        let subscriber = start(Role::Subscriber, "/map")?;
        let mut publisher = start(Role::Publisher, "/driver")?;
        publisher.wait_matched()?;
        let topic = [("topic", stream.topic.as_str())];
        self.agent.scrape_until("published", |page| {
            page.sum("ros2_topic_publishers", &topic) > 0.0
        })?;
        Ok((publisher, subscriber))
    }

    /// Returns the status of an answer, and its body.
    pub(super) fn ask(&self, method: &str, path: &str, body: &Value) -> Result<(u16, Value)> {
        let text = self.curl(method, path, body)?;
        let (body, status) = text.rsplit_once('\n').context("no status")?;
        let value = serde_json::from_str(body).with_context(|| text.clone())?;
        Ok((status.parse()?, value))
    }

    /// Returns all events of these names once there are this many.
    pub(super) fn events_after(&self, names: &str, count: usize) -> Result<Vec<Value>> {
        let mut events = Vec::new();
        wait_until(&format!("{count} events {names}"), || {
            events = self.events(names)?;
            Ok(events.len() >= count)
        })?;
        Ok(events)
    }

    /// Returns all events of these names so far.
    fn events(&self, names: &str) -> Result<Vec<Value>> {
        let path = format!("/events?after=0&follow=false&name={names}");
        let text = self.curl("GET", &path, &Value::Null)?;
        let data = text.lines().filter_map(|line| line.strip_prefix("data: "));
        let events = data.map(serde_json::from_str).collect::<Result<_, _>>();
        events.with_context(|| text.clone())
    }

    pub(super) fn curl(&self, method: &str, path: &str, body: &Value) -> Result<String> {
        let mut curl = Command::new("curl");
        curl.args(["--silent", "--show-error", "--globoff", "--max-time", "60"])
            .args(["--write-out", "\n%{http_code}", "--request", method])
            .arg("--unix-socket")
            .arg(&self.socket)
            .arg(format!("http://localhost{path}"));
        if !body.is_null() {
            curl.args(["--header", "content-type: application/json"])
                .args(["--data-binary", "@-"]);
        }
        let mut child = curl
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .context("cannot run curl")?;
        let mut input = child.stdin.take().context("no input")?;
        if !body.is_null() {
            // The answer may arrive before the whole body was read.
            let _ = input.write_all(body.to_string().as_bytes());
        }
        drop(input);
        let output = child.wait_with_output()?;
        Ok(String::from_utf8_lossy(&output.stdout).into_owned())
    }
}

/// An `rp bag record` that has begun.
pub(super) struct Recorder {
    pub(super) process: Process,
    pub(super) stderr: PathBuf,
}

impl Recorder {
    pub(super) fn start(robot: &Robot<'_>, name: &str, arguments: &[&str]) -> Result<Recorder> {
        let stderr = robot.directory.path().join(format!("{name}.said"));
        let output = robot.directory.path().join(name);
        let mut words = vec!["bag".to_owned(), "record".to_owned()];
        words.extend(arguments.iter().map(|word| (*word).to_owned()));
        words.extend(["-o".to_owned(), output.display().to_string()]);
        words.extend(["--socket".to_owned(), robot.socket.display().to_string()]);
        let mut enter = robot.host.on_network();
        enter.extend(["env", "-u", "ROS_DISTRO", "-u", "ROS_DOMAIN_ID"].map(str::to_owned));
        let errors = File::create(&stderr)?;
        let process = Process::start_with(&enter, RP, words, errors.into())?;
        let recorder = Recorder { process, stderr };
        wait_until("it records", || {
            Ok(recorder.stderr().contains("Recording..."))
        })
        .with_context(|| recorder.stderr())?;
        Ok(recorder)
    }

    pub(super) fn stderr(&self) -> String {
        fs::read_to_string(&self.stderr).unwrap_or_default()
    }

    /// Sends Ctrl-C, and waits for the end.
    pub(super) fn interrupt(&mut self) -> Result<ExitStatus> {
        self.process.signal("INT")?;
        self.process.wait(PATIENCE)
    }
}

/// Waits until publishers have sent so many stretches, and the agent has counted all that it can.
pub(super) fn settled(
    robot: &Robot<'_>,
    pairs: &[(&str, u64, Peer, Peer)],
    stretches: u64,
) -> Result<Scrape> {
    let mut page = robot.agent.scrape()?;
    for (topic, count, publisher, _) in pairs {
        let all = stretches * count;
        wait_until("all is sent", || Ok(sent(publisher)?.len() as u64 >= all))?;
        page = robot.agent.settled_scrape(topic, all)?;
    }
    Ok(page)
}

/// Returns whether no record was dropped. The messages of dropped records are unknown.
pub(super) fn is_exact(page: &Scrape) -> bool {
    let lost = page.sum("ros2probe_records_dropped_total", &[]);
    if lost > 0.0 {
        eprintln!("too busy to be exact: {}", page.suspicious_counters());
    }
    lost == 0.0
}

/// Returns the numbers of the messages that a publisher has sent, as its writer counts them.
pub(super) fn sent(publisher: &Peer) -> Result<BTreeSet<u64>> {
    publisher.log()?.writer_numbers("pub")
}

/// Returns the numbers in a bag by topic, as another reader finds them. Fails if one occurs twice.
pub(super) fn numbers(bag: &Path) -> Result<BTreeMap<String, BTreeSet<u64>>> {
    let mut numbers: BTreeMap<String, BTreeSet<u64>> = BTreeMap::new();
    for_each_message(bag, |message| {
        let topic = numbers.entry(message.channel.topic.clone()).or_default();
        let is_new = topic.insert(message.sequence.into());
        ensure!(is_new, "{} twice in {}", message.sequence, bag.display());
        Ok(())
    })?;
    Ok(numbers)
}
