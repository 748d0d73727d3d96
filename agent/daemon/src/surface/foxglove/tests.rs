//! One viewer on a stream in memory, and the channels of snapshots.

use std::collections::BTreeMap;

use futures_util::{SinkExt as _, StreamExt as _};
use ros2probe_message::Sources;
use ros2probe_model::facts::dispatch::{
    Dispatch, Missed, MissedReason, Sample, SampleOutcome, Topic,
};
use ros2probe_model::facts::naming::Naming;
use ros2probe_model::facts::selection::SampleRequest;
use ros2probe_model::report::snapshot::Snapshot;
use ros2probe_testing::sample_robot;
use ros2probe_wire::names::DdsTopic;
use ros2probe_wire::{DomainId, EntityId, Guid, GuidPrefix, SequenceNumber, Timestamp};
use serde_json::{Value, json};
use tokio::io::{DuplexStream, duplex};
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::tungstenite::protocol::Role;

use super::*;
use crate::agent_facts::AgentFacts;
use crate::subscriptions::Caps;
use crate::tables::tests::assert_driven;
use crate::tables::{ViewerChannels, ViewerSubscriptions};

const MEGABYTE: usize = 1 << 20;

fn library() -> Arc<Library> {
    Arc::new(Library::new(Sources::default()))
}

/// A robot with these topics.
fn robot(names: &[&str]) -> Snapshot {
    sample_robot::snapshot(names.iter().copied())
}

/// Returns the ids of a table's channels, by topic.
fn ids(table: &Table) -> BTreeMap<String, u32> {
    let channels = table.channels.values();
    let advertised = channels.map(|channel| channel.advertised());
    advertised
        .map(|channel| (channel.topic.to_owned(), channel.id))
        .collect()
}

#[tokio::test]
async fn channels_keep_their_ids_and_no_id_is_used_twice() {
    let mut registry = Registry::new(library());
    let first = ids(&registry.update(&robot(&["/a", "/b"]), false).await);
    let expected = ["/a", "/b", "/rp/topics/a", "/rp/topics/b"];
    assert_eq!(first.keys().collect::<Vec<_>>(), expected);
    let same = registry.update(&robot(&["/a", "/b"]), false).await;
    assert!(Arc::ptr_eq(
        &same.channels,
        &registry.update(&robot(&["/a", "/b"]), false).await.channels
    ));
    let second = ids(&registry.update(&robot(&["/b", "/c"]), false).await);
    assert_eq!(second["/b"], first["/b"]);
    let third = ids(&registry.update(&robot(&["/a"]), false).await);
    let all: Vec<_> = [&first, &second, &third]
        .into_iter()
        .flat_map(|ids| ids.iter().map(|(topic, id)| (*id, topic.clone())))
        .collect();
    let of_id: BTreeMap<_, _> = all.iter().cloned().collect();
    assert!(all.iter().all(|(id, topic)| of_id[id] == *topic), "{all:?}");
    assert_ne!(third["/a"], first["/a"]);
}

#[tokio::test]
async fn each_domain_and_each_type_of_a_topic_has_a_channel_of_its_own() {
    let mut registry = Registry::new(library());
    let mut snapshot = robot(&["/a"]);
    let mut other = robot(&["/a"]).topics.remove(0);
    other.domain_id = DomainId(5);
    other.message_types = vec!["std_msgs/msg/String".into(), "unknown/msg/Type".into()];
    snapshot.topics.push(other);
    let table = registry.update(&snapshot, true).await;
    let shown = table.channels.values().map(|channel| channel.advertised());
    let shown: Vec<_> = shown
        .filter(|channel| channel.encoding == "cdr" && channel.topic.starts_with("/domain_5"))
        .map(|channel| (channel.topic, channel.schema_name, channel.schema.len() > 5))
        .collect();
    let expected = [
        ("/domain_5/a", "std_msgs/msg/String", true),
        ("/domain_5/a", "unknown/msg/Type", false),
    ];
    assert_eq!(shown, expected);
    // A channel keeps its name when the other domain no longer has the topic.
    snapshot.topics.remove(0);
    let before = ids(&table);
    let after = ids(&registry.update(&snapshot, false).await);
    assert_eq!(after["/domain_5/a"], before["/domain_5/a"]);
}

#[tokio::test]
async fn topics_beyond_the_cap_have_no_channel() {
    let mut registry = Registry::new(library());
    let names: Vec<_> = (0..=ViewerChannels::CAP)
        .map(|number| format!("/t{number}"))
        .collect();
    let names: Vec<_> = names.iter().map(String::as_str).collect();
    let mut snapshot = robot(&names[..1]);
    let template = snapshot.topics[0].clone();
    snapshot.topics = names
        .iter()
        .map(|name| {
            let mut topic = template.clone();
            topic.name = (*name).into();
            topic.dds_name = format!("rt{name}").into();
            topic
        })
        .collect();
    let table = registry.update(&snapshot, false).await;
    assert_eq!(table.channels.len(), ViewerChannels::CAP);
    assert_driven::<ViewerChannels>();
}

#[tokio::test]
async fn a_viewer_with_subscriptions_beyond_the_cap_is_closed() {
    let shared = shared(MEGABYTE);
    let names: Vec<_> = (0..ViewerSubscriptions::CAP)
        .map(|number| format!("/t{number}"))
        .collect();
    let names: Vec<_> = names.iter().map(String::as_str).collect();
    let agent = AgentFacts::new(SourceKind::Wire, Instant::now());
    shared.latest.publish(robot(&names), agent);
    let mut scene = Scene::of(shared).await;
    assert_eq!(scene.json().await["op"], "serverInfo");
    let mut wanted = Vec::new();
    while wanted.len() < ViewerSubscriptions::CAP {
        let advertised = scene.json().await;
        for channel in advertised["channels"].as_array().unwrap() {
            wanted.push(json!({"id": wanted.len(), "channelId": channel["id"]}));
        }
    }
    let subscribe = |some: &[Value]| json!({"op": "subscribe", "subscriptions": some});
    scene.send(&subscribe(&wanted)).await;
    let subscriptions = |scene: &Scene| scene.shared.viewers.connected()[0].subscriptions;
    while subscriptions(&scene) < ViewerSubscriptions::CAP {
        tokio::task::yield_now().await;
    }
    scene.send(&subscribe(&wanted[..1])).await;
    let close = loop {
        if let Message::Close(close) = scene.socket.next().await.unwrap().unwrap() {
            break close.unwrap();
        }
    };
    assert_eq!(u16::from(close.code), 1008, "{close}");
    assert_driven::<ViewerSubscriptions>();
}

/// Shared state of a live agent with two topics.
fn shared(bytes: usize) -> Arc<Shared> {
    let latest = Arc::new(SnapshotCell::new(SourceKind::Wire));
    latest.publish(
        robot(&["/points", "/chatter"]),
        AgentFacts::new(SourceKind::Wire, Instant::now()),
    );
    let caps = Caps {
        subscriptions: 4,
        bytes,
    };
    let stop = CancellationToken::new();
    let subscriptions = Subscriptions::new(Arc::clone(&latest), caps, stop.clone());
    Arc::new(Shared {
        latest,
        subscriptions: Arc::new(subscriptions),
        viewers: Arc::default(),
        tables: watch::Sender::new(None),
        changed: Notify::new(),
        graphs: AtomicUsize::new(0),
        is_replay: false,
        name: "test".to_owned(),
        session: "1".to_owned(),
        stop,
    })
}

/// A viewer on a stream in memory, and the shared state of its agent.
struct Scene {
    shared: Arc<Shared>,
    socket: WebSocketStream<DuplexStream>,
}

impl Scene {
    async fn new(bytes: usize) -> Self {
        Self::of(shared(bytes)).await
    }

    async fn of(shared: Arc<Shared>) -> Self {
        let (ours, theirs) = duplex(64 << 10);
        let viewer = shared.viewers.join(None, Access::All);
        let client = Client::new(ours, Arc::clone(&shared), Access::All, viewer).await;
        tokio::spawn(client.run());
        tokio::spawn(follow(Arc::clone(&shared), library()));
        let socket = WebSocketStream::from_raw_socket(theirs, Role::Client, None).await;
        Self { shared, socket }
    }

    async fn json(&mut self) -> Value {
        loop {
            if let Message::Text(text) = self.socket.next().await.unwrap().unwrap() {
                return serde_json::from_str(&text).unwrap();
            }
        }
    }

    /// Subscribes to topics, and waits until the subscription is open.
    async fn subscribe(&mut self, topics: &[&str]) {
        assert_eq!(self.json().await["op"], "serverInfo");
        let advertised = self.json().await;
        let channels = advertised["channels"].as_array().unwrap();
        let wanted = topics.iter().enumerate().map(|(id, topic)| {
            let channel = channels.iter().find(|channel| channel["topic"] == *topic);
            json!({"id": id, "channelId": channel.unwrap()["id"]})
        });
        let wanted: Vec<_> = wanted.collect();
        self.send(&json!({"op": "subscribe", "subscriptions": wanted}))
            .await;
        while !self.shared.subscriptions.is_open() {
            tokio::task::yield_now().await;
        }
    }

    async fn send(&mut self, message: &Value) {
        let text = message.to_string();
        self.socket.send(Message::Text(text.into())).await.unwrap();
    }

    fn deliver(&self, topic: &str, number: u64, size: usize) {
        let to = [1].into();
        let outcome = SampleOutcome::Sample(sample(topic, number, size));
        self.shared
            .subscriptions
            .deliver(vec![Dispatch { to, outcome }], None);
    }
}

fn sample(topic: &str, number: u64, size: usize) -> Arc<Sample> {
    let robot = robot(&[topic]);
    let facts = &robot.topics[0];
    Arc::new(Sample {
        topic: Arc::new(Topic {
            domain_id: facts.domain_id,
            name: facts.name.clone(),
            dds_name: facts.dds_name.clone(),
            message_type: facts.message_types[0].clone(),
            offered: None,
        }),
        time: Timestamp(number),
        writer: Guid::new(GuidPrefix([1; 12]), EntityId([0, 0, 1, 3])),
        sequence_number: SequenceNumber(number),
        source_timestamp: None,
        header_stamp: None,
        size: u32::try_from(size).unwrap(),
        sampled: false,
        payload: Some(vec![u8::try_from(number % 251).unwrap(); size].into()),
    })
}

#[tokio::test]
async fn a_viewer_that_does_not_read_loses_the_oldest_messages_and_their_number_is_sent() {
    const MESSAGES: u64 = 40;
    let mut scene = Scene::new(64 * MEGABYTE).await;
    scene.subscribe(&["/points", "/chatter"]).await;
    for number in 1..=MESSAGES {
        scene.deliver("/points", number, MEGABYTE);
        scene.deliver("/chatter", number, 100);
    }
    assert!(scene.shared.subscriptions.facts().queued_bytes <= 17 * MEGABYTE);
    let (mut points, mut chatter, mut dropped) = (Vec::new(), Vec::new(), 0);
    while chatter.last() != Some(&MESSAGES) || points.last() != Some(&MESSAGES) || dropped == 0 {
        match scene.socket.next().await.unwrap().unwrap() {
            Message::Binary(data) => {
                let number = u64::from_le_bytes(data[5..13].try_into().unwrap());
                let payload = &data[13..];
                let expected = u8::try_from(number % 251).unwrap();
                assert!(payload.iter().all(|byte| *byte == expected), "{number}");
                match payload.len() {
                    MEGABYTE => points.push(number),
                    100 => chatter.push(number),
                    size => panic!("{size} bytes"),
                }
            }
            Message::Text(text) => {
                let status: Value = serde_json::from_str(&text).unwrap();
                if status["op"] == "status" {
                    let message = status["message"].as_str().unwrap();
                    assert!(message.contains("reads too slowly"), "{message}");
                    assert!(message.ends_with("of /points"), "{message}");
                    dropped = message.split(' ').next().unwrap().parse().unwrap();
                }
            }
            _ => {}
        }
    }
    // The topic with small messages loses no message because of the other topic.
    assert_eq!(chatter, (1..=MESSAGES).collect::<Vec<_>>());
    assert_eq!(points.len() as u64 + dropped, MESSAGES);
    assert!((14..=17).contains(&points.len()), "{points:?}");
    let viewer = &scene.shared.viewers.connected()[0];
    assert_eq!(viewer.dropped_messages, dropped);
    assert_eq!(scene.shared.viewers.totals().dropped_messages, dropped);
}

#[tokio::test]
async fn messages_that_wait_beyond_a_batch_are_all_sent() {
    const MESSAGES: u64 = 200;
    let mut scene = Scene::new(MEGABYTE).await;
    scene.subscribe(&["/chatter"]).await;
    for number in 1..=MESSAGES {
        scene.deliver("/chatter", number, 100);
    }
    let mut numbers = Vec::new();
    while numbers.last() != Some(&MESSAGES) {
        if let Message::Binary(data) = scene.socket.next().await.unwrap().unwrap() {
            numbers.push(u64::from_le_bytes(data[5..13].try_into().unwrap()));
        }
    }
    assert_eq!(numbers, (1..=MESSAGES).collect::<Vec<_>>());
}

#[tokio::test]
async fn interest_follows_the_subscriptions_and_ends_with_the_viewer() {
    let mut scene = Scene::new(MEGABYTE).await;
    scene.subscribe(&["/chatter"]).await;
    let topics = |shared: &Shared| {
        let requests = shared.subscriptions.take_changed();
        let requests = requests.iter().flat_map(|requests| requests.iter());
        requests
            .map(|request| format!("{:?}", request.selection.include))
            .collect::<Vec<_>>()
    };
    let chatter = r#"[Topics({(DomainId(0), "rt/chatter")})]"#;
    assert_eq!(topics(&scene.shared), [chatter]);
    scene.deliver("/points", 1, 10);
    scene.deliver("/chatter", 2, 10);
    let data = loop {
        if let Message::Binary(data) = scene.socket.next().await.unwrap().unwrap() {
            break data;
        }
    };
    assert_eq!(data[..13], [1, 0, 0, 0, 0, 2, 0, 0, 0, 0, 0, 0, 0]);
    scene
        .send(&json!({"op": "unsubscribe", "subscriptionIds": [0]}))
        .await;
    while scene.shared.subscriptions.is_open() {
        tokio::task::yield_now().await;
    }
    assert_eq!(topics(&scene.shared), [""; 0]);
    let shared = Arc::clone(&scene.shared);
    drop(scene);
    while shared.viewers.is_any() {
        tokio::task::yield_now().await;
    }
}

/// A channel is one topic of one domain and one type. An earlier version captured the topics of
/// that name in every domain, and reported their losses.
#[tokio::test]
async fn a_channel_has_the_messages_and_losses_of_its_domain_and_type_only() {
    let shared = shared(MEGABYTE);
    let mut two = robot(&["/points", "/chatter"]);
    let mut other = two.topics.clone();
    for topic in &mut other {
        topic.domain_id = DomainId(5);
    }
    two.topics.extend(other);
    two.topics[0]
        .message_types
        .push("std_msgs/msg/String".into());
    let agent = AgentFacts::new(SourceKind::Wire, Instant::now());
    shared.latest.publish(two, agent);
    let mut scene = Scene::of(shared).await;
    scene.subscribe(&["/points", "/domain_5/chatter"]).await;
    let requests = scene.shared.subscriptions.take_changed().unwrap();
    let is_captured = |domain_id, name: &str| {
        let naming = Naming::of(&DdsTopic::parse(name).unwrap());
        requests[0].covers(DomainId(domain_id), &naming)
    };
    assert!(is_captured(0, "rt/points") && is_captured(5, "rt/chatter"));
    assert!(!is_captured(5, "rt/points") && !is_captured(0, "rt/chatter"));
    let of = |domain_id, name: &str, message_type: Option<&str>| {
        let topic = Topic::clone(&sample(name, 1, 1).topic);
        let message_type = message_type.map_or(topic.message_type.clone(), Into::into);
        Arc::new(Topic {
            domain_id: DomainId(domain_id),
            message_type,
            ..topic
        })
    };
    let lost = |topic: Arc<Topic>, samples| Dispatch {
        to: [1].into(),
        outcome: SampleOutcome::Missed(Missed {
            topic,
            writer: Guid::default(),
            first: SequenceNumber(1),
            last: SequenceNumber(samples),
            samples,
            reason: MissedReason::NotCaptured,
        }),
    };
    let losses = vec![
        lost(of(5, "/points", None), 1_000),
        lost(of(0, "/points", Some("std_msgs/msg/String")), 100),
        lost(of(0, "/chatter", None), 10_000),
        lost(of(0, "/points", None), 7),
        lost(of(5, "/chatter", None), 3),
    ];
    scene.shared.subscriptions.deliver(losses, None);
    let message = loop {
        let status = scene.json().await;
        if status["op"] == "status" {
            break status["message"].as_str().unwrap().to_owned();
        }
    };
    let expected = "10 messages were not captured because the agent reads too slowly: 7 of \
                    /points, 3 of /domain_5/chatter";
    assert_eq!(message, expected);
}

#[tokio::test(start_paused = true)]
async fn a_silent_topic_without_a_subscriber_is_reported_until_it_has_one() {
    let shared = shared(MEGABYTE);
    let publish = |subscribed: bool| {
        let mut snapshot = robot(&["/points", "/chatter"]);
        for topic in &mut snapshot.topics {
            let is_alone = *topic.name == *"/points" && !subscribed;
            if is_alone {
                topic.subscriptions.clear();
                topic.measurement = None;
                topic.inside = None;
            }
        }
        let agent = AgentFacts::new(SourceKind::Wire, std::time::Instant::now());
        shared.latest.publish(snapshot, agent);
    };
    publish(false);
    let mut scene = Scene::of(Arc::clone(&shared)).await;
    scene.subscribe(&["/chatter", "/points"]).await;
    let begun = tokio::time::Instant::now();
    let status = loop {
        let status = scene.json().await;
        if status["op"] == "status" {
            break status;
        }
    };
    let message = "/points: no subscriber exists, so nothing is sent";
    assert_eq!(status["message"], message);
    assert!(begun.elapsed() >= std::time::Duration::from_secs(5));
    publish(true);
    let removed = loop {
        let removed = scene.json().await;
        if removed["op"] == "removeStatus" {
            break removed;
        }
        assert_ne!(removed["op"], "status", "it is named once");
    };
    assert_eq!(removed["statusIds"], json!(["no_subscriber"]));
}

#[tokio::test]
async fn each_new_subscription_to_a_latched_topic_receives_its_last_message() {
    let mut scene = Scene::new(MEGABYTE).await;
    let subscriptions = Arc::clone(&scene.shared.subscriptions);
    let kept = sample("/points", 7, 20);
    let latched = |request: &SampleRequest| {
        let topic = &kept.topic;
        let dds_name = DdsTopic::parse(&topic.dds_name).unwrap();
        let is_covered = request.covers(topic.domain_id, &Naming::of(&dds_name));
        is_covered.then(|| Arc::clone(&kept)).into_iter().collect()
    };
    scene.subscribe(&["/chatter", "/points"]).await;
    for round in 0..2 {
        // The test puts the requests in force, as the capture thread does.
        let requests = loop {
            match subscriptions.take_changed() {
                Some(requests) if requests.len() == 1 => break requests,
                _ => tokio::task::yield_now().await,
            }
        };
        subscriptions.confirm_applied(&requests, Timestamp(9), latched);
        subscriptions.confirm_applied(&requests, Timestamp(9), latched);
        let data = loop {
            if let Message::Binary(data) = scene.socket.next().await.unwrap().unwrap() {
                break data;
            }
        };
        assert_eq!((data[5], data.len()), (7, 33), "{round}");
        // A message of another topic does not send the latched message again.
        scene.deliver("/chatter", 9, 10);
        let data = loop {
            if let Message::Binary(data) = scene.socket.next().await.unwrap().unwrap() {
                break data;
            }
        };
        assert_eq!((data[5], data.len()), (9, 23), "{round}");
        if round == 0 {
            let table = scene.shared.tables.borrow().clone().unwrap();
            let id = ids(&table)["/points"];
            scene
                .send(&json!({"op": "unsubscribe", "subscriptionIds": [1]}))
                .await;
            let again = json!({"op": "subscribe", "subscriptions": [{"id": 5, "channelId": id}]});
            scene.send(&again).await;
            while scene.shared.viewers.totals().subscriptions != 2 {
                tokio::task::yield_now().await;
            }
        }
    }
}
