//! Memory of every table when it is full. Forges participants, endpoints and samples up to the
//! default caps, one kind after the other, and prints the agent's memory after each. It checks
//! nothing.

use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result};

use ros2probe_testing::forged::{Carrier as _, Sender, Talker};
use ros2probe_testing::harness::agent::{Agent, METRICS, ON_THE_WIRE, Scrape, get};
use ros2probe_testing::harness::network::Link;
use ros2probe_testing::harness::usage::Usage;

/// The default caps (`limits` in the configuration).
const PARTICIPANTS: u32 = 1000;
const ENDPOINTS: u32 = 8192;
/// Each participant has a writer for samples, one for `ros_discovery_info`, and readers.
const READERS: u32 = ENDPOINTS / PARTICIPANTS - 2;
/// No process listens on this port, so only the agent sees the packets.
const UNUSED_PORT: u16 = 7399;
/// Number of packets between pauses: fast enough for leases of 12 s, slow enough for every ring.
const BURST: usize = 8;
const PAUSE: Duration = Duration::from_millis(2);
/// Number of participants that announce their endpoints before all participants renew their leases.
const GROUP: usize = 250;
const SAMPLE: usize = 320;
/// Number of rounds: enough for the samples of a minute of history and several snapshots.
const ROUNDS: u32 = 20;

/// Memory of one kind of entry.
struct Step {
    what: &'static str,
    entries: u32,
    /// Memory of the agent with this many entries and all previous kinds.
    unreclaimable: u64,
}

/// Fills the tables of an agent on the wire and prints its memory.
pub(crate) fn measure(program: &Path) -> Result<()> {
    let link = Link::new()?;
    let directory = tempfile::tempdir().context("cannot create a directory")?;
    let configuration = directory.path().join("ros2probe.yaml");
    let text = format!("watch: [/**]\n{ON_THE_WIRE}log: warn\n");
    std::fs::write(&configuration, text)?;
    let agent = Agent::start(&link.robot, program, &configuration)?;
    let from = format!("{}:0", link.monitor.address());
    let to = format!("{}:{UNUSED_PORT}", link.robot.address());
    let mut sender = Sender::new(&link.monitor, &from, &to)?;
    let mut talkers: Vec<_> = (0..PARTICIPANTS)
        .map(|number| Talker::new(number, &topic(number)))
        .collect();
    let settled = || -> Result<u64> {
        std::thread::sleep(Duration::from_secs(2));
        Ok(Usage::of(agent.process.pid())?.memory.unreclaimable)
    };
    let mut send = |messages: &mut dyn Iterator<Item = Vec<u8>>| -> Result<()> {
        for (number, message) in messages.enumerate() {
            sender.send(&message)?;
            if number % BURST == 0 {
                std::thread::sleep(PAUSE);
            }
        }
        Ok(())
    };

    let mut steps = vec![Step {
        what: "nothing",
        entries: 1,
        unreclaimable: settled()?,
    }];
    send(&mut talkers.iter().map(Talker::participant))?;
    steps.push(Step {
        what: "participants",
        entries: PARTICIPANTS,
        unreclaimable: settled()?,
    });
    let numbered: Vec<_> = talkers.iter().zip(0..).collect();
    for group in numbered.chunks(GROUP) {
        send(&mut group.iter().copied().flat_map(announced))?;
        send(&mut talkers.iter().map(Talker::participant))?;
    }
    steps.push(Step {
        what: "endpoints, and 1000 topics of theirs",
        entries: PARTICIPANTS * (READERS + 2),
        unreclaimable: settled()?,
    });
    for round in 0..ROUNDS {
        // Samples assert liveliness but do not renew the SPDP lease.
        if round % 3 == 0 {
            send(&mut talkers.iter().map(Talker::participant))?;
        }
        send(&mut talkers.iter_mut().map(|talker| talker.sample(SAMPLE)))?;
    }
    steps.push(Step {
        what: "measured topics with messages",
        entries: PARTICIPANTS,
        unreclaimable: settled()?,
    });
    let page = scraped(&agent)?;
    print(steps, page);
    Ok(())
}

/// Prints the table of the cost of each kind of entry, and the cost of a scrape.
fn print(steps: Vec<Step>, page: Scraped) {
    println!(
        "| entries | how many | MB unreclaimable | bytes each |\n| --- | ---: | ---: | ---: |"
    );
    let mut before = None;
    for Step {
        what,
        entries,
        unreclaimable,
    } in steps
    {
        let each = before.map_or_else(
            || "-".to_owned(),
            |before| (unreclaimable.saturating_sub(before) / u64::from(entries)).to_string(),
        );
        println!(
            "| {what} | {entries} | {:.1} | {each} |",
            unreclaimable as f64 / 1e6
        );
        before = Some(unreclaimable);
    }
    let Scraped {
        unreclaimable,
        bytes,
        known,
    } = page;
    println!(
        "\nthe most while it answers a scrape of {:.1} MB: {:.1} MB; known: {known}\n",
        bytes as f64 / 1e6,
        unreclaimable as f64 / 1e6,
    );
}

/// The maximum memory during a scrape, and the scraped figures.
struct Scraped {
    unreclaimable: u64,
    bytes: usize,
    known: String,
}

fn scraped(agent: &Agent<'_>) -> Result<Scraped> {
    let (pid, host) = (agent.process.pid(), agent.host);
    std::thread::scope(|scope| {
        let scraping = scope.spawn(move || get(host, &format!("{METRICS}/metrics")));
        let (mut unreclaimable, began) = (0, Instant::now());
        while !scraping.is_finished() && began.elapsed() < Duration::from_secs(60) {
            unreclaimable = Usage::of(pid)?.memory.unreclaimable.max(unreclaimable);
        }
        let page = scraping.join();
        let page = page.map_err(|_| anyhow::anyhow!("the thread that scrapes panicked"))??;
        let page = Scrape(page);
        let known = ["participants", "endpoints", "topics"].map(|limit| {
            let used = page.sum("ros2probe_limit_used", &[("limit", limit)]);
            format!("{limit} {used}")
        });
        Ok(Scraped {
            unreclaimable,
            bytes: page.0.len(),
            known: known.join(", "),
        })
    })
}

/// Returns all announcements of a participant: two writers, its readers and its node.
fn announced((talker, number): (&Talker, u32)) -> Vec<Vec<u8>> {
    let [_, entities, samples, node] = talker.introduction(&format!("node{number}"));
    let readers = (0..READERS).map(|reader| {
        let [_, high, low, _] = (reader + 16).to_be_bytes();
        let topic = format!("rt{}", topic((number + reader * 7) % PARTICIPANTS));
        let cloud = "sensor_msgs::msg::dds_::PointCloud2_";
        talker.subscription([0, high, low, 4], &topic, cloud, reader + 1)
    });
    [entities, samples]
        .into_iter()
        .chain(readers)
        .chain([node])
        .collect()
}

fn topic(number: u32) -> String {
    format!("/robot/sensors/topic{number}")
}
