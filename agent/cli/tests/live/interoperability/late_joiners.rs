//! A transient-local publisher sends its history to a subscriber that starts later. The agent
//! counts each sample once, and counts no loss of samples that have expired or that the publisher
//! no longer keeps.

use std::collections::BTreeSet;

use super::*;

/// The publisher sends [`COUNT`] samples before the late subscriber starts, and as many afterwards.
const ALL: u64 = 2 * COUNT;
/// Much longer than a delivery takes.
const LIFESPAN: Duration = Duration::from_secs(2);

/// What the publishers of a round have in common.
struct History {
    /// Place of each publisher's subscribers after its own in the list of libraries.
    offset: usize,
    /// Whether another subscriber exists from the beginning.
    has_early: bool,
    /// Number of samples that the publisher keeps.
    depth: u64,
    lifespan: Option<Duration>,
}

/// A publisher and its subscribers in a domain.
struct Scene {
    publisher: Shape,
    early: Option<Shape>,
    late: Shape,
}

impl Round {
    /// Compares the agent's facts with the logs of subscribers before and after the history.
    fn join_late(&self, history: &History) -> Result<()> {
        let agent = self.agent()?;
        let mut begun = Vec::new();
        for (domain, publisher) in Library::ALL.into_iter().enumerate() {
            let subscriber = Library::ALL[(domain + history.offset) % Library::ALL.len()];
            if history.is_supported(publisher, subscriber)? {
                begun.push(self.begin(history, domain, publisher, subscriber)?);
            } else {
                println!("{publisher:?} to {subscriber:?}: not supported");
            }
        }
        ensure!(begun.len() >= 3, "{} publishers", begun.len());
        for (publisher, early, _) in &mut begun {
            publisher.wait_matched()?;
            early.iter_mut().try_for_each(Shape::wait_matched)?;
        }
        for (publisher, ..) in &mut begun {
            publisher.start_sending()?;
        }
        for (publisher, early, _) in &mut begun {
            wait_until("the history", || Ok(sent(publisher)? == COUNT))?;
            if let Some(early) = early {
                wait_received(early, publisher, COUNT)?;
            }
        }
        if let Some(lifespan) = history.lifespan {
            let expired = SystemTime::now() + lifespan;
            wait_until(
                "the end of the lifespan",
                || Ok(SystemTime::now() > expired),
            )?;
        }
        let mut scenes = Vec::new();
        for (publisher, early, (domain, subscriber)) in begun {
            let options = history.options(publisher.library, subscriber);
            let late = self.start(domain, subscriber, Role::Subscriber, &options)?;
            let scene = Scene {
                publisher,
                early,
                late,
            };
            scenes.push((domain.to_string(), scene));
        }
        for (_, scene) in &mut scenes {
            scene.late.wait_matched()?;
            let kept = history.kept(&scene.publisher);
            wait_received(&scene.late, &scene.publisher, kept)?;
        }
        for (_, scene) in &mut scenes {
            scene.publisher.start_sending()?;
        }
        for (_, scene) in &mut scenes {
            scene.publisher.wait_sent()?;
            let late = history.kept(&scene.publisher) + COUNT;
            wait_received(&scene.late, &scene.publisher, late)?;
            if let Some(early) = &scene.early {
                wait_received(early, &scene.publisher, ALL)?;
            }
        }
        self.wait_decided()?;
        let page = agent.scrape()?;
        for (domain, scene) in &scenes {
            self.check_late(history, &page, domain, scene)?;
        }
        Ok(())
    }

    fn check_late(
        &self,
        history: &History,
        page: &Scrape,
        domain: &str,
        scene: &Scene,
    ) -> Result<()> {
        let (what, topic) = (scene.name(), self.topic(domain)?);
        let late = history.kept(&scene.publisher) + COUNT;
        // Without a subscriber, the publisher does not send.
        let sent = if history.has_early { ALL } else { late };
        let publisher = only(&topic["publishers"]).context(what.clone())?;
        let lifespan = history.lifespan.map(|lifespan| lifespan.as_secs_f64());
        assert_eq!(publisher["qos"]["lifespan_seconds"].as_f64(), lifespan);
        let early = scene.early.iter().map(|early| (early, ALL));
        for (subscriber, expected) in early.chain([(&scene.late, late)]) {
            let received = numbers(subscriber, &scene.publisher)?;
            if scene.is_lossy() && received.len() as u64 != expected {
                println!("{what}: {} of {expected} samples", received.len());
                return Ok(());
            }
            assert_eq!(received, (ALL - expected..ALL).collect(), "{what}");
            let all = [(scene.publisher.guid()?, expected)];
            assert_eq!(self.delivered(domain, subscriber)?, all, "{what}: {topic}");
        }
        let measured = &publisher["measurement"];
        assert_eq!(measured["messages"], sent, "{what}: {topic}");
        assert_eq!(measured["lost_messages"], 0, "{what}: {topic}");
        assert_eq!(measured["subscriber_lost_messages"], 0, "{what}: {topic}");
        let labels = [("topic", TOPIC), ("domain_id", domain)];
        assert_eq!(page.sum("ros2_topic_lost_messages_total", &labels), 0.0);
        Ok(())
    }

    /// Starts a publisher, and its early subscriber if it has one.
    fn begin(
        &self,
        history: &History,
        domain: usize,
        publisher: Library,
        subscriber: Library,
    ) -> Result<(Shape, Option<Shape>, (usize, Library))> {
        let options = history.options(publisher, subscriber);
        let early = match history.has_early {
            true => Some(self.start(domain, subscriber, Role::Subscriber, &options)?),
            false => None,
        };
        let peers = u8::from(history.has_early);
        let sending = format!("--count {ALL} --stretch {COUNT} --linger 120 --peers {peers}");
        let lifespan = history.lifespan.map_or(String::new(), |lifespan| {
            format!("--lifespan {}", lifespan.as_millis())
        });
        // A publisher that keeps few samples drops some if its subscriber does not get CPU time.
        let rate = if history.depth < ALL { 5 } else { 20 };
        let kept = format!("--depth {} --rate {rate} {lifespan}", history.depth);
        let options = format!("{options} {sending} {kept}");
        let publisher = self.start(domain, publisher, Role::Publisher, &options)?;
        Ok((publisher, early, (domain, subscriber)))
    }
}

impl History {
    fn is_supported(&self, publisher: Library, subscriber: Library) -> Result<bool> {
        // HDDS requests the history of its own publishers alone.
        let is_own = (publisher, subscriber) == (Library::Hdds, Library::Hdds);
        Ok(!is_mistaken(publisher, subscriber)
            && publisher.can(Role::Publisher, "late_joiner")?
            && (is_own || subscriber.can(Role::Subscriber, "late_joiner")?)
            && (self.lifespan.is_none() || publisher.can(Role::Publisher, "lifespan")?))
    }

    /// Returns how many of the first samples reach a late subscriber. RustDDS keeps samples beyond
    /// its depth.
    fn kept(&self, publisher: &Shape) -> u64 {
        match (publisher.library, self.lifespan) {
            (_, Some(_)) => 0,
            (Library::RustDds, None) => COUNT,
            (_, None) => self.depth.min(COUNT),
        }
    }

    /// Returns the options of a publisher and its subscribers.
    fn options(&self, publisher: Library, subscriber: Library) -> String {
        let lease = lease_between(publisher, subscriber);
        format!("{FINITE} --durability transient-local {lease}")
    }
}

impl Scene {
    fn name(&self) -> String {
        format!("{:?} to {:?}", self.publisher.library, self.late.library)
    }

    fn is_lossy(&self) -> bool {
        is_lossy(&self.publisher) || is_lossy(&self.late)
    }
}

/// Returns how many samples a publisher has sent.
fn sent(publisher: &Shape) -> Result<u64> {
    Ok(publisher.log()?.sequences("pub").len() as u64)
}

/// Returns the numbers of a publisher's samples that a subscriber received. HDDS receives some
/// samples of its own publishers twice.
fn numbers(subscriber: &Shape, publisher: &Shape) -> Result<BTreeSet<u64>> {
    let color = publisher.library.color();
    let log = subscriber.log()?.0.into_iter();
    let samples = log.filter(|event| event.ev == "sub" && event.color.as_ref() == Some(&color));
    let numbers: Vec<u64> = samples.filter_map(|event| event.seq).collect();
    let distinct: BTreeSet<u64> = numbers.iter().copied().collect();
    let is_once = distinct.len() == numbers.len() || is_lossy(subscriber);
    ensure!(is_once, "{:?}: {numbers:?}", subscriber.library);
    Ok(distinct)
}

/// Waits until a subscriber has this many samples of a publisher.
fn wait_received(subscriber: &Shape, publisher: &Shape, count: u64) -> Result<()> {
    let all = || Ok(numbers(subscriber, publisher)?.len() as u64 >= count);
    let what = format!(
        "{count} samples of {:?} to {:?}",
        publisher.library, subscriber.library
    );
    match is_lossy(publisher) || is_lossy(subscriber) {
        true => {
            drop(wait_within(WITH_LOSSES, &what, all));
            Ok(())
        }
        false => wait_until(&what, all),
    }
}

/// Runs publishers that keep all their samples.
fn join_late(offset: usize, has_early: bool, lifespan: Option<Duration>) -> Result<()> {
    Round::new()?.join_late(&History {
        offset,
        has_early,
        depth: ALL,
        lifespan,
    })
}

#[test]
fn a_history_reaches_a_late_subscriber_of_the_same_library() -> Result<()> {
    join_late(0, false, None)
}

#[test]
fn a_history_reaches_a_late_subscriber_of_the_next_library() -> Result<()> {
    join_late(1, false, None)
}

#[test]
fn a_history_sent_again_to_the_library_after_the_next_counts_once() -> Result<()> {
    join_late(2, true, None)
}

#[test]
fn a_history_sent_again_to_the_last_library_counts_once() -> Result<()> {
    join_late(5, true, None)
}

#[test]
fn samples_that_the_publisher_no_longer_keeps_are_not_lost() -> Result<()> {
    Round::new()?.join_late(&History {
        offset: 4,
        has_early: false,
        depth: COUNT / 2,
        lifespan: None,
    })
}

#[test]
fn expired_samples_are_not_lost_to_a_late_subscriber() -> Result<()> {
    join_late(1, true, Some(LIFESPAN))
}

#[test]
fn expired_samples_without_a_subscriber_are_not_lost() -> Result<()> {
    join_late(0, false, Some(LIFESPAN))
}
