//! Six implementations of DDS publish to each other, in the manner of OMG's suite `dds-rtps`. What
//! the agent shows equals what the peers logged: endpoints, matches, messages, deliveries, and
//! reasons of incompatibility. Needs root.
//!
//! Each pair has a domain of its own, so that a library does not disturb others: Fast DDS 2.9 may
//! fail an assertion in the presence of five other libraries.

mod late_joiners;
mod several_writers;

use std::time::{Duration, SystemTime, UNIX_EPOCH};

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::harness::agent::{Agent, Scrape, at_the_sockets_of, get};
use ros2probe_testing::harness::network::Link;
use ros2probe_testing::harness::peer::Role;
use ros2probe_testing::harness::shape::{Library, Shape};
use ros2probe_testing::harness::{wait_until, wait_within};
use serde_json::Value;
use tempfile::TempDir;

const TOPIC: &str = "/square";
/// Time within which samples arrive if some may get lost.
const WITH_LOSSES: Duration = Duration::from_secs(10);
/// Time after which a missing sample of a reliable writer counts as lost, and two seconds.
const UNDECIDED: Duration = Duration::from_secs(12);
/// Samples of each publisher.
const COUNT: u64 = 20;
/// Options of peers that match: dust_dds takes an announced infinite deadline for a finite one.
const FINITE: &str = "--deadline 10000";

/// What the peers of a round have in common.
struct Case {
    /// Place of each publisher's subscriber after its own in the list of libraries.
    offset: usize,
    /// What both libraries of a pair must support.
    capabilities: &'static [&'static str],
    offered: String,
    requested: String,
}

/// A publisher and a subscriber in a domain.
struct Pair {
    domain: String,
    publisher: Shape,
    subscriber: Shape,
}

/// A publisher of each library with a subscriber of another one, under observation.
struct Round {
    link: Link,
    config: TempDir,
}

impl Round {
    fn new() -> Result<Round> {
        let (link, config) = (Link::new()?, tempfile::tempdir()?);
        let source = at_the_sockets_of(&link.monitor);
        let text = format!("watch: [/**]\n{source}");
        std::fs::write(config.path().join("ros2probe.yaml"), text)?;
        Ok(Round { link, config })
    }

    fn agent(&self) -> Result<Agent<'_>> {
        let file = self.config.path().join("ros2probe.yaml");
        Agent::start(&self.link.monitor, env!("CARGO_BIN_EXE_rp"), &file)
    }

    /// Starts the peers of all pairs that support the case.
    fn pairs(&self, case: &Case) -> Result<Vec<Pair>> {
        let libraries = Library::ALL.into_iter().cycle().skip(case.offset);
        let mut pairs = Vec::new();
        for (domain, (publisher, subscriber)) in Library::ALL.into_iter().zip(libraries).enumerate()
        {
            let mut is_able = !is_mistaken(publisher, subscriber);
            for capability in case.capabilities {
                is_able &= publisher.can(Role::Publisher, capability)?
                    && subscriber.can(Role::Subscriber, capability)?;
            }
            if !is_able {
                println!("{publisher:?} to {subscriber:?}: not supported");
                continue;
            }
            let lease = lease_between(publisher, subscriber);
            let start = |library, role, options: &str| {
                self.start(domain, library, role, &format!("{lease} {options}"))
            };
            pairs.push(Pair {
                domain: domain.to_string(),
                subscriber: start(subscriber, Role::Subscriber, &case.requested)?,
                publisher: start(publisher, Role::Publisher, &case.offered)?,
            });
        }
        ensure!(pairs.len() >= 3, "{} pairs", pairs.len());
        Ok(pairs)
    }

    fn start(&self, domain: usize, library: Library, role: Role, options: &str) -> Result<Shape> {
        let options = format!("--domain {domain} --topic rt{TOPIC} {options}");
        Shape::start(&self.link.monitor, library, role, &options)
    }

    /// Runs pairs that match, and compares the agent's facts with their logs.
    fn match_all(&self, case: &Case) -> Result<()> {
        let agent = self.agent()?;
        let mut pairs = self.pairs(case)?;
        for pair in &mut pairs {
            pair.publisher.wait_matched()?;
            pair.subscriber.wait_matched()?;
        }
        for pair in &mut pairs {
            pair.publisher.start_sending()?;
        }
        for pair in &mut pairs {
            pair.publisher.wait_sent()?;
            let color = pair.publisher.library.color();
            let subscriber = &pair.subscriber;
            let all = || Ok(subscriber.received(&color)? == COUNT);
            match pair.is_lossy() {
                true => drop(wait_within(WITH_LOSSES, "samples", all)),
                false => wait_until(&format!("samples of {}", pair.name()), all)?,
            }
        }
        // HDDS never stops repeating its samples, so that its counters do not stand still.
        let page = agent.scrape_until("all messages", |page| {
            let messages = |pair: &Pair| pair.sum(page, "ros2_topic_messages_total");
            pairs.iter().all(|pair| messages(pair) >= COUNT as f64)
        })?;
        for pair in &pairs {
            let what = pair.name();
            for name in [
                "ros2_qos_incompatible_pairs",
                "ros2_topic_lost_messages_total",
            ] {
                assert_eq!(pair.sum(&page, name), 0.0, "{what}: {name}");
            }
            let topic = self.topic(&pair.domain)?;
            let publisher = only(&topic["publishers"]).context(what.clone())?;
            assert_eq!(publisher["guid"], pair.publisher.guid()?, "{what}");
            assert_eq!(
                publisher["measurement"]["messages"], COUNT,
                "{what}: {topic}"
            );
            assert_eq!(publisher["vendor"], pair.publisher.library.vendor());
            let subscription = only(&topic["subscriptions"]).context(what.clone())?;
            assert_eq!(subscription["guid"], pair.subscriber.guid()?, "{what}");
            // The process of a socket may be looked up later.
            if pair.is_lossy() && pair.subscriber.received(&pair.publisher.library.color())? < COUNT
            {
                continue;
            }
            let all = [(pair.publisher.guid()?, COUNT)];
            wait_until(&format!("{what}: deliveries equal the log"), || {
                Ok(self.delivered(&pair.domain, &pair.subscriber)? == all)
            })?;
        }
        Ok(())
    }

    /// Runs pairs that do not match because of this policy.
    fn match_none(&self, case: &Case, policy: &str) -> Result<()> {
        let agent = self.agent()?;
        let pairs = self.pairs(case)?;
        let name = policy.to_lowercase();
        let metric = "ros2_qos_incompatible_pairs";
        let page = agent.scrape_until("all pairs are incompatible", |page| {
            pairs.iter().all(|pair| pair.sum(page, metric) == 1.0)
        })?;
        for pair in &pairs {
            let labels = [("domain_id", &*pair.domain), ("policy", &*name)];
            assert_eq!(page.sum(metric, &labels), 1.0, "{}", pair.name());
            for (peer, role) in [
                (&pair.publisher, Role::Publisher),
                (&pair.subscriber, Role::Subscriber),
            ] {
                if peer.library.can(role, "incompatible_qos")? {
                    wait_until(&format!("{role:?} of {} reports", pair.name()), || {
                        let log = peer.log()?.0;
                        let mut reported = log.iter().filter_map(|event| event.policy.as_deref());
                        Ok(reported.any(|reported| reported == policy))
                    })?;
                }
            }
        }
        Ok(())
    }

    /// Returns the messages of each delivery to a subscriber's process, by their writer.
    fn delivered(&self, domain: &str, subscriber: &Shape) -> Result<Vec<(String, u64)>> {
        let topic = self.topic(domain)?;
        let deliveries = topic["deliveries"].as_array().context("no deliveries")?;
        let process = subscriber.process()?;
        let received = deliveries
            .iter()
            .filter(|each| each["direction"] == "received" && each["process_id"] == process);
        let counts = received.map(|each| {
            let writer = each["writer"].as_str().context("no writer")?;
            let messages = each["delivered"]["messages"].as_u64();
            Ok((writer.to_owned(), messages.context("no messages")?))
        });
        counts.collect()
    }

    /// Waits until every sample that was missed before now is decided: it is lost, or it is not.
    fn wait_decided(&self) -> Result<()> {
        let due = (SystemTime::now() + UNDECIDED).duration_since(UNIX_EPOCH)?;
        wait_until("the end of the settle window", || {
            let now = self.request("/graph")?["timestamp_seconds"].as_f64();
            Ok(now.context("no time")? > due.as_secs_f64())
        })
    }

    fn topic(&self, domain: &str) -> Result<Value> {
        self.request(&format!("/topics{TOPIC}?domain_id={domain}"))
    }

    fn request(&self, path: &str) -> Result<Value> {
        let text = get(&self.link.monitor, &format!("http://127.0.0.1:17401{path}"))?;
        Ok(serde_json::from_str(&text)?)
    }
}

impl Pair {
    fn name(&self) -> String {
        let (publisher, subscriber) = (self.publisher.library, self.subscriber.library);
        format!("{publisher:?} to {subscriber:?}")
    }

    fn is_lossy(&self) -> bool {
        is_lossy(&self.publisher) || is_lossy(&self.subscriber)
    }

    fn sum(&self, page: &Scrape, name: &str) -> f64 {
        page.sum(name, &[("topic", TOPIC), ("domain_id", &self.domain)])
    }
}

/// Returns the options with which a subscriber of dust_dds matches Fast DDS, whose lease is
/// infinite by default.
fn lease_between(publisher: Library, subscriber: Library) -> &'static str {
    match (publisher, subscriber) {
        (Library::Fast, Library::Dust) => "--liveliness-lease 10000",
        _ => "",
    }
}

/// Returns whether the libraries do not match though their QoS do: dust_dds takes the infinite
/// lease of HDDS, which announces none, for a finite one.
fn is_mistaken(publisher: Library, subscriber: Library) -> bool {
    (publisher, subscriber) == (Library::Hdds, Library::Dust)
}

/// Returns whether reliable samples may get lost: HDDS loses some on a busy machine.
fn is_lossy(peer: &Shape) -> bool {
    peer.library == Library::Hdds
}

/// Returns the only endpoint of a list.
fn only(list: &Value) -> Result<&Value> {
    match list.as_array().map(Vec::as_slice) {
        Some([only]) => Ok(only),
        _ => anyhow::bail!("not one endpoint: {list}"),
    }
}

fn match_all(offset: usize, capabilities: &'static [&'static str], qos: [&str; 2]) -> Result<()> {
    let [offered, requested] = qos;
    Round::new()?.match_all(&Case {
        offset,
        capabilities,
        offered: format!("{FINITE} --count {COUNT} --linger 120 {offered}"),
        requested: format!("{FINITE} {requested}"),
    })
}

#[test]
fn reliable_samples_reach_the_same_library() -> Result<()> {
    match_all(0, &[], ["--reliable"; 2])
}

// Coverage: UDP | dust_dds 0.16 | - | exact
// Coverage: UDP | HDDS 1.1 | - | exact
// Coverage: UDP | Cyclone DDS 11.0 | - | exact
#[test]
fn reliable_samples_reach_the_next_library() -> Result<()> {
    match_all(1, &[], ["--reliable"; 2])
}

#[test]
fn reliable_samples_reach_the_library_after_the_next() -> Result<()> {
    match_all(2, &[], ["--reliable"; 2])
}

#[test]
fn reliable_samples_reach_the_opposite_library() -> Result<()> {
    match_all(3, &[], ["--reliable"; 2])
}

#[test]
fn reliable_samples_reach_the_library_before_the_last() -> Result<()> {
    match_all(4, &[], ["--reliable"; 2])
}

#[test]
fn reliable_samples_reach_the_last_library() -> Result<()> {
    match_all(5, &[], ["--reliable"; 2])
}

#[test]
fn best_effort_samples_reach_another_library() -> Result<()> {
    match_all(1, &[], ["--best-effort"; 2])
}

// Coverage: UDP, samples in fragments | dust_dds 0.16 | - | exact
// Coverage: UDP, samples in fragments | Cyclone DDS 11.0 | - | exact
#[test]
fn fragments_reach_another_library() -> Result<()> {
    match_all(5, &["fragments"], ["--size 70000", ""])
}

#[test]
fn endpoints_in_the_same_partition_match() -> Result<()> {
    match_all(
        4,
        &["partition"],
        ["--partition left --partition middle", "--partition middle"],
    )
}

fn match_none(
    offset: usize,
    capabilities: &'static [&'static str],
    [offered, requested]: [&str; 2],
    policy: &str,
) -> Result<()> {
    let case = Case {
        offset,
        capabilities,
        offered: format!("{FINITE} {offered}"),
        requested: format!("{FINITE} {requested}"),
    };
    Round::new()?.match_none(&case, policy)
}

#[test]
fn a_best_effort_publisher_is_the_reported_reason() -> Result<()> {
    match_none(2, &[], ["--best-effort", "--reliable"], "RELIABILITY")
}

#[test]
fn a_volatile_publisher_is_the_reported_reason() -> Result<()> {
    let qos = ["--durability volatile", "--durability transient-local"];
    match_none(4, &[], qos, "DURABILITY")
}

#[test]
fn a_longer_deadline_of_a_publisher_is_the_reported_reason() -> Result<()> {
    let qos = ["--deadline 20000", ""];
    match_none(5, &["deadline"], qos, "DEADLINE")
}

#[test]
fn an_exclusive_publisher_is_the_reported_reason() -> Result<()> {
    match_none(
        1,
        &["ownership"],
        ["--ownership-strength 5", ""],
        "OWNERSHIP",
    )
}

/// All libraries but dust_dds and HDDS are in both roles, Cyclone DDS 0.10 only with itself.
#[test]
fn a_longer_lease_of_a_publisher_is_the_reported_reason() -> Result<()> {
    for offset in [0, 2] {
        let case = Case {
            offset,
            capabilities: &["liveliness"],
            offered: format!("{FINITE} --liveliness-lease 20000"),
            requested: format!("{FINITE} --liveliness-lease 10000"),
        };
        Round::new()?.match_none(&case, "LIVELINESS")?;
    }
    Ok(())
}

#[test]
fn endpoints_in_different_partitions_do_not_match() -> Result<()> {
    let round = Round::new()?;
    let agent = round.agent()?;
    let pairs = round.pairs(&Case {
        offset: 2,
        capabilities: &["partition"],
        offered: "--partition left".to_owned(),
        requested: "--partition right --partition far".to_owned(),
    })?;
    agent.scrape_until("every endpoint is alone", |page| {
        pairs.iter().all(|pair| {
            let sides = ["publishers", "subscriptions"];
            sides
                .iter()
                .all(|side| pair.sum(page, &format!("ros2_topic_unmatched_{side}")) == 1.0)
        })
    })?;
    for pair in &pairs {
        for peer in [&pair.publisher, &pair.subscriber] {
            let log = peer.log()?.0;
            let mut matched = log.iter().filter(|event| event.ev == "matched");
            ensure!(
                matched.all(|event| event.total == Some(0)),
                "{}",
                pair.name()
            );
        }
    }
    Ok(())
}
