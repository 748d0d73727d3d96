//! Samples in shared memory, by polling and on demand.

use super::*;

/// Time without a sample after which no more arrive, on a busy machine.
const SILENCE: Duration = Duration::from_secs(30);

/// Messages in shared memory are read whole in the process that sends them.
#[test]
fn payloads_in_shared_memory_equal_those_that_were_sent() -> Result<()> {
    let host = Host::new()?;
    let observed = host.observe("exact: uprobe")?;
    let stream = in_shared_memory(60_000, 40);
    let (mut publisher, _subscriber) = host.pair(&stream)?;
    let client = observed.client()?;
    let mut lines = open(&client, "topic=/points&payload=true", "/points")?;
    publisher.start_sending()?;
    let (whole, missed) = given(&mut lines, &stream)?;
    ensure!((whole, missed) == (40, 0), "{whole} {missed}");
    Ok(())
}

/// Fast DDS sends more than 64 KiB in several messages. With polling, a sample is complete if all
/// its messages were seen.
#[test]
fn samples_above_64_kib_are_read_from_shared_memory_by_polling() -> Result<()> {
    let host = Host::new()?;
    let observed = host.observe("exact: off")?;
    let stream = Stream {
        rate: 10.0,
        ..in_shared_memory(150_000, 60)
    };
    let (mut publisher, _subscriber) = host.known_pair(&observed, &stream)?;
    let client = observed.client()?;
    let mut lines = open(&client, "topic=/points&payload=true", "/points")?;
    publisher.start_sending()?;
    let (whole, missed) = given(&mut lines, &stream)?;
    println!("{whole} of {} whole, {missed} missed", stream.count);
    // A machine with other load may poll too late.
    ensure!(whole >= 6, "{whole} whole, {missed} missed");
    let topic = observed.topic("/points")?;
    ensure!(topic["passages"][0]["view"] == "close", "{topic}");
    drop(lines);
    drop(client);
    observed.wait_for_view("sampled")
}

/// With `exact: auto` the breakpoint exists only while samples are read.
#[test]
fn on_demand_every_sample_is_seen_and_the_last_reader_removes_the_breakpoint() -> Result<()> {
    let host = Host::with_its_own_fast_dds()?;
    let observed = host.observe("exact: auto")?;
    let stream = in_shared_memory(150_000, 40);
    let (mut publisher, _subscriber) = host.known_pair(&observed, &stream)?;
    let maps = std::fs::read_to_string(format!("/proc/{}/maps", publisher.process.pid()))?;
    let line = maps.lines().find(|line| line.contains("/libfastrtps.so"));
    let library = line.and_then(|line| line.get(line.find('/')?..));
    let library = PathBuf::from(library.context("no Fast DDS")?);
    let is_attached = |peer: &Peer| -> Result<bool> {
        let code = harness::code::at_function(&peer.process, &library)?;
        Ok(code.in_memory != code.in_file)
    };
    wait_until("the breakpoint of the start is taken out", || {
        Ok(!is_attached(&publisher)?)
    })?;
    let client = observed.client()?;
    // The first line of the stream follows once every message is seen.
    let mut lines = open(&client, "topic=/points&payload=true", "/points")?;
    ensure!(is_attached(&publisher)?, "a sample is to be read");
    observed.wait_for_view("exact")?;
    publisher.start_sending()?;
    let (whole, missed) = given(&mut lines, &stream)?;
    ensure!((whole, missed) == (stream.count, 0), "{whole} {missed}");
    drop(lines);
    drop(client);
    wait_until("the breakpoint is taken out", || {
        Ok(!is_attached(&publisher)?)
    })?;
    observed.wait_for_view("sampled")
}

/// No reader of a best-effort writer waits for a lower number. Breakpoints replace polling while
/// the writer sends.
#[test]
fn while_breakpoints_attach_samples_keep_their_order_and_losses_are_reported() -> Result<()> {
    let host = Host::with_its_own_fast_dds()?;
    let observed = host.observe("exact: auto")?;
    let stream = Stream {
        rate: 250.0,
        reliable: false,
        ..in_shared_memory(320, 1500)
    };
    let (mut publisher, _subscriber) = host.known_pair(&observed, &stream)?;
    publisher.start_sending()?;
    std::thread::sleep(Duration::from_secs(1));
    let client = observed.client()?;
    let mut lines = open(&client, "topic=/points&payload=true", "/points")?;
    let (mut numbers, mut times, mut missed) = (Vec::new(), Vec::new(), Vec::new());
    while numbers.last() != Some(&stream.count) {
        let line = match lines.line_within(PATIENCE)? {
            Next::Line(line) => line,
            Next::End => bail!("the stream ended"),
            Next::Nothing => bail!("not even a clock"),
        };
        match serde_json::from_slice(&line)? {
            Line::Sample(sample) => {
                lines.bytes(sample.payload_bytes.context("no payload")? as usize)?;
                numbers.push(sample.sequence_number);
                times.push(sample.time_ns);
            }
            Line::Missed(facts) => {
                missed.extend(facts.first_sequence_number..=facts.last_sequence_number);
            }
            _ => {}
        }
    }
    ensure!(numbers.is_sorted(), "{numbers:?}");
    ensure!(times.is_sorted(), "{times:?}");
    println!(
        "{} samples from {}, missed {missed:?}",
        numbers.len(),
        numbers[0]
    );
    // Samples that arrived and samples reported as missing are together all that were sent.
    let first = numbers[0];
    numbers.extend(missed);
    numbers.sort_unstable();
    ensure!(
        numbers.iter().copied().eq(first..=stream.count),
        "{numbers:?}"
    );
    Ok(())
}

/// A host with its own `/dev/shm`.
struct Host {
    network: Namespace,
    enter: Vec<String>,
    _shared_memory: SharedMemory,
    /// Directory with a copy of Fast DDS, if the host has its own.
    _libraries: Option<TempDir>,
}

impl Host {
    fn new() -> Result<Self> {
        let network = Namespace::isolated()?;
        let shared_memory = SharedMemory::of(&network, 64)?;
        Ok(Self {
            enter: shared_memory.inside(&network),
            network,
            _shared_memory: shared_memory,
            _libraries: None,
        })
    }

    /// Breakpoints are in a file's pages, for all processes that map the file. This copy has none
    /// from other tests.
    fn with_its_own_fast_dds() -> Result<Self> {
        let mut host = Self::new()?;
        let library = Stack::Fast.library("libfastrtps.so")?;
        let libraries = tempfile::tempdir()?;
        let name = library.file_name().context("a library without a name")?;
        std::fs::copy(&library, libraries.path().join(name))?;
        let path = format!("LD_LIBRARY_PATH={}", libraries.path().display());
        host.enter.extend(["env".to_owned(), path]);
        host._libraries = Some(libraries);
        Ok(host)
    }

    /// Starts an agent at the host's sockets, with these settings of `capture.shm`.
    fn observe(&self, shm: &str) -> Result<Observed<'_>> {
        let cgroup = self.network.cgroup().display();
        let capture = format!("capture: {{source: host, cgroup: {cgroup}, shm: {{{shm}}}}}\n");
        Observed::start(&self.network, &capture)
    }

    /// Starts a pair as [`Self::pair`] does, until the agent has its topic. The topic is announced
    /// once in shared memory, and a busy machine may poll too late.
    fn known_pair(&self, observed: &Observed<'_>, stream: &Stream) -> Result<(Peer, Peer)> {
        for _ in 0..12 {
            let (mut publisher, mut subscriber) = self.pair(stream)?;
            let deadline = Instant::now() + Duration::from_secs(4);
            while Instant::now() < deadline {
                let topic = observed.topic(&stream.topic)?;
                if topic.pointer("/passages/0/pairs") == Some(&1.into()) {
                    return Ok((publisher, subscriber));
                }
                std::thread::sleep(Duration::from_millis(100));
            }
            publisher.process.terminate()?;
            subscriber.process.terminate()?;
            std::thread::sleep(Duration::from_secs(1));
        }
        bail!("{} never became known", stream.topic)
    }

    /// Starts a publisher and a matched subscriber.
    fn pair(&self, stream: &Stream) -> Result<(Peer, Peer)> {
        let launch =
            |role, node| Peer::launch_behind(&self.enter, Stack::Fast, role, stream, &[node]);
        let mut subscriber = launch(Role::Subscriber, "/listener")?;
        subscriber.wait_ready()?;
        let mut publisher = launch(Role::Publisher, "/sensor")?;
        publisher.wait_ready()?;
        publisher.wait_matched()?;
        subscriber.wait_matched()?;
        Ok((publisher, subscriber))
    }
}

/// Returns a stream of point clouds as `rmw_fastrtps_cpp` publishes them by default.
fn in_shared_memory(size: usize, count: u64) -> Stream {
    Stream {
        reliable: true,
        shares_memory: true,
        linger: 60.0,
        ..Stream::point_cloud(size, count)
    }
}

/// Returns how many samples of a stream arrived unchanged, and how many are missing. Ends at the
/// last number, or after a silence.
fn given(lines: &mut Lines<'_>, stream: &Stream) -> Result<(u64, u64)> {
    let pattern: Vec<u8> = (8..stream.size).map(pattern).collect();
    let (mut whole, mut missed, mut last) = (0, 0, 0);
    let mut deadline = Instant::now() + PATIENCE;
    while last < stream.count && Instant::now() < deadline {
        let line = match lines.line_within(PATIENCE)? {
            Next::Line(line) => line,
            Next::End => bail!("the stream ended"),
            Next::Nothing => bail!("not even a clock"),
        };
        let number = match serde_json::from_slice(&line)? {
            Line::Sample(sample) => {
                let len = sample.payload_bytes.context("no payload")? as usize;
                let payload = lines.bytes(len)?;
                ensure!(check(&payload, &pattern)? + 1 == sample.sequence_number);
                whole += 1;
                ensure!(
                    !sample.sampled || sample.sequence_number > last,
                    "{last} before {sample:?}"
                );
                if sample.sequence_number != last + 1 {
                    println!("{} after {last}", sample.sequence_number);
                }
                sample.sequence_number
            }
            Line::Missed(facts) => {
                missed += facts.samples;
                facts.last_sequence_number
            }
            _ => continue,
        };
        last = last.max(number);
        deadline = Instant::now() + SILENCE;
    }
    Ok((whole, missed))
}
