//! Two publishers, and a subscriber that ignores some of their samples: a stronger publisher owns
//! the instance, or a content filter rejects them. The agent counts both publishers' messages, and
//! no loss.

use std::collections::{BTreeMap, BTreeSet};

use super::*;

/// Two publishers and the subscribers of one library, in a domain.
struct Scene {
    domain: String,
    publishers: [Shape; 2],
    subscribers: Vec<Shape>,
}

/// Libraries of both publishers and of the subscribers.
type Trio = [Library; 3];

impl Round {
    /// Starts the peers. A subscriber exists for each of `requested`.
    fn scene(
        &self,
        domain: usize,
        trio: Trio,
        offered: [&str; 2],
        requested: &[&str],
    ) -> Result<Scene> {
        let [first, second, subscriber] = trio;
        let leases = [first, second].map(|publisher| lease_between(publisher, subscriber));
        let common = format!("{FINITE} {}", leases.into_iter().max().unwrap_or_default());
        let mut subscribers = Vec::new();
        for options in requested {
            let options = format!("{common} --peers 2 {options}");
            subscribers.push(self.start(domain, subscriber, Role::Subscriber, &options)?);
        }
        let start = |library, options: &str| {
            let peers = requested.len();
            let sending = format!("--count {COUNT} --linger 120 --peers {peers}");
            let options = format!("{common} {sending} {options}");
            self.start(domain, library, Role::Publisher, &options)
        };
        Ok(Scene {
            domain: domain.to_string(),
            publishers: [start(first, offered[0])?, start(second, offered[1])?],
            subscribers,
        })
    }

    /// Lets both publishers of each scene send, the second one after subscribers received a sample
    /// of the first. Waits until the agent has decided about all samples.
    fn send(&self, scenes: &mut [Scene]) -> Result<()> {
        for scene in scenes.iter_mut() {
            let peers = scene.publishers.iter_mut().chain(&mut scene.subscribers);
            peers.into_iter().try_for_each(Shape::wait_matched)?;
        }
        for scene in scenes.iter_mut() {
            scene.publishers[0].start_sending()?;
        }
        for scene in scenes.iter_mut() {
            for subscriber in &scene.subscribers {
                let begins = || Ok(!samples(subscriber)?.is_empty());
                wait_until(&format!("{}: first samples", scene.name()), begins)?;
            }
            scene.publishers[1].start_sending()?;
        }
        for scene in scenes.iter_mut() {
            scene.publishers.iter_mut().try_for_each(Shape::wait_sent)?;
        }
        self.wait_decided()
    }

    /// Returns the messages of each writer that reached a subscriber's process.
    fn messages(&self, scene: &Scene, subscriber: &Shape) -> Result<BTreeMap<String, u64>> {
        let delivered = self.delivered(&scene.domain, subscriber)?.into_iter();
        Ok(delivered.filter(|(_, messages)| *messages > 0).collect())
    }

    /// Checks that the agent counted this many samples of each publisher, and lost none.
    fn check_messages(&self, agent: &Agent<'_>, scene: &Scene, counts: [u64; 2]) -> Result<Value> {
        let (what, topic) = (scene.name(), self.topic(&scene.domain)?);
        let publishers = topic["publishers"].as_array().context("no publishers")?;
        assert_eq!(publishers.len(), 2, "{what}: {topic}");
        for (publisher, count) in scene.publishers.iter().zip(counts) {
            let guid = publisher.guid()?;
            let found = publishers.iter().find(|each| each["guid"] == *guid);
            let measured = &found.context(guid)?["measurement"];
            assert_eq!(measured["messages"], count, "{what}: {topic}");
            assert_eq!(measured["lost_messages"], 0, "{what}: {topic}");
            assert_eq!(measured["subscriber_lost_messages"], 0, "{what}: {topic}");
        }
        let labels = [("topic", TOPIC), ("domain_id", &*scene.domain)];
        let lost = agent
            .scrape()?
            .sum("ros2_topic_lost_messages_total", &labels);
        assert_eq!(lost, 0.0, "{what}");
        Ok(topic)
    }
}

impl Scene {
    fn is_lossy(&self) -> bool {
        let mut peers = self.publishers.iter().chain(&self.subscribers);
        peers.any(is_lossy)
    }

    /// Returns this number of samples for each publisher.
    fn of_both(&self, count: u64) -> Result<BTreeMap<String, u64>> {
        let counts = self.publishers.iter().map(|each| Ok((each.guid()?, count)));
        counts.collect()
    }

    fn name(&self) -> String {
        let [first, second] = &self.publishers;
        let subscriber = self.subscribers.first().map(|each| each.library);
        format!(
            "{:?} and {:?} to {subscriber:?}",
            first.library, second.library
        )
    }
}

/// Returns the numbers of the samples that a subscriber received, by color and additional length.
fn samples(subscriber: &Shape) -> Result<BTreeMap<(String, u64), BTreeSet<u64>>> {
    let mut samples = BTreeMap::<_, BTreeSet<u64>>::new();
    for event in subscriber.log()?.0 {
        if let (Some(color), Some(len), Some(seq)) = (event.color, event.len, event.seq) {
            samples.entry((color, len)).or_default().insert(seq);
        }
    }
    Ok(samples)
}

// Each library is once the stronger publisher, once the weaker one, and once the subscriber.
#[test]
fn messages_of_a_weaker_publisher_are_not_lost() -> Result<()> {
    use Library::*;
    let round = Round::new()?;
    let agent = round.agent()?;
    let trios = [
        [Fast, Cyclone, Dust],
        [Cyclone, Cyclone11, Fast],
        [Cyclone11, Dust, Cyclone],
        [Dust, Fast, Cyclone11],
    ];
    // The additional payload distinguishes the publishers of the instance.
    let offered = [
        "--ownership-strength 8 --size 8",
        "--ownership-strength 4 --size 4",
    ]
    .map(|options| format!("{options} --color SHARED"));
    let offered = offered.each_ref().map(String::as_str);
    let mut scenes = Vec::new();
    for (domain, trio) in trios.into_iter().enumerate() {
        scenes.push(round.scene(domain, trio, offered, &["--exclusive"])?);
    }
    round.send(&mut scenes)?;
    for scene in &scenes {
        let topic = round.check_messages(&agent, scene, [COUNT; 2])?;
        for side in ["publishers", "subscriptions"] {
            for endpoint in topic[side].as_array().context("no endpoints")? {
                assert_eq!(endpoint["qos"]["ownership"], "EXCLUSIVE", "{topic}");
            }
        }
        let publishers = topic["publishers"].as_array().context("no publishers")?;
        let strengths = publishers.iter();
        let strengths = strengths.map(|each| each["qos"]["ownership_strength"].as_i64());
        let strengths: BTreeSet<_> = strengths.collect();
        assert_eq!(strengths, BTreeSet::from([Some(4), Some(8)]), "{topic}");
        // The weaker publisher's samples reach the process, and its library ignores them.
        let subscriber = only_subscriber(scene)?;
        let expected = BTreeMap::from([(("SHARED".to_owned(), 8), all())]);
        assert_eq!(samples(subscriber)?, expected, "{}", scene.name());
        let both = scene.of_both(COUNT)?;
        assert_eq!(round.messages(scene, subscriber)?, both, "{topic}");
    }
    Ok(())
}

/// A publisher of Fast DDS applies the filters of subscribers of Fast DDS. All others send each
/// sample, and the subscriber rejects it.
#[test]
fn messages_that_a_content_filter_rejects_are_not_lost() -> Result<()> {
    use Library::*;
    let round = Round::new()?;
    let agent = round.agent()?;
    let trios = [
        [Cyclone, Fast, Dust],
        [Dust, Fast, Fast],
        [RustDds, Hdds, Fast],
        [Fast, Cyclone11, Hdds],
    ];
    let offered = ["--color RED", "--color BLUE"];
    let mut scenes = Vec::new();
    for (domain, trio) in trios.into_iter().enumerate() {
        let requested = ["--filter color='RED'", ""];
        scenes.push(round.scene(domain, trio, offered, &requested)?);
    }
    round.send(&mut scenes)?;
    for scene in &scenes {
        let [filtered, other] = &*scene.subscribers else {
            anyhow::bail!("not two subscribers");
        };
        let [red, blue] = ["RED", "BLUE"].map(|color| ((color.to_owned(), 0), all()));
        let received = [samples(filtered)?, samples(other)?];
        ensure!(
            !received[0].contains_key(&blue.0),
            "{}: {received:?}",
            scene.name()
        );
        let expected = [BTreeMap::from([red.clone()]), BTreeMap::from([red, blue])];
        if scene.is_lossy() && received != expected {
            println!("{}: {received:?}", scene.name());
            continue;
        }
        assert_eq!(received, expected, "{}", scene.name());
        let topic = round.check_messages(&agent, scene, [COUNT; 2])?;
        let mut expected = scene.of_both(COUNT)?;
        assert_eq!(round.messages(scene, other)?, expected, "{topic}");
        let mut messages = round.messages(scene, filtered)?;
        let [_, blue] = &scene.publishers;
        // No log says which samples of HDDS reached a process that rejects them.
        if is_lossy(blue) {
            messages.remove(&blue.guid()?);
        }
        if is_lossy(blue) || [blue.library, filtered.library] == [Fast, Fast] {
            expected.remove(&blue.guid()?);
        }
        assert_eq!(messages, expected, "{topic}");
    }
    Ok(())
}

/// The publisher announces each rejected sample in a GAP.
#[test]
fn messages_that_a_publisher_filters_are_irrelevant() -> Result<()> {
    let round = Round::new()?;
    let agent = round.agent()?;
    let requested = ["--filter (x=3)or(x=12)"];
    let scene = round.scene(0, [Library::Fast; 3], ["", "--color OTHER"], &requested)?;
    let mut scenes = [scene];
    round.send(&mut scenes)?;
    let [scene] = &scenes;
    let subscriber = only_subscriber(scene)?;
    let received = ["FAST", "OTHER"].map(|color| ((color.to_owned(), 0), BTreeSet::from([3, 12])));
    assert_eq!(samples(subscriber)?, BTreeMap::from(received));
    let topic = round.check_messages(&agent, scene, [2; 2])?;
    let both = scene.of_both(2)?;
    assert_eq!(round.messages(scene, subscriber)?, both, "{topic}");
    let deliveries = topic["deliveries"].as_array().context("no deliveries")?;
    let received = deliveries
        .iter()
        .filter(|each| each["direction"] == "received");
    for delivery in received {
        // Eight samples are between both. The publisher does not always announce the last ones.
        let irrelevant = delivery["delivered"]["irrelevant_messages"].as_u64();
        ensure!(
            irrelevant.is_some_and(|count| (8..=18).contains(&count)),
            "{topic}"
        );
    }
    Ok(())
}

/// Returns the numbers of all samples of a publisher.
fn all() -> BTreeSet<u64> {
    (0..COUNT).collect()
}

fn only_subscriber(scene: &Scene) -> Result<&Shape> {
    scene.subscribers.first().context("no subscriber")
}
