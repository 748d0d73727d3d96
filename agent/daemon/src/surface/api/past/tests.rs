//! Requests for the history on a storage that does not answer.

use std::path::Path;
use std::sync::Arc;

use axum::Extension;
use axum::body::{Body, to_bytes};
use axum::http::{Request, StatusCode, Uri};
use hyper::service::Service as _;
use hyper_util::service::TowerToHyperService;
use ros2probe_api::doctor::{Report, Severity};
use ros2probe_api::history::KeptNoun;
use ros2probe_api::topics::TopicDetailsList;
use ros2probe_capture::reassembly::Limits;
use ros2probe_model::facts::topic_kind::TopicKind;
use ros2probe_model::report::snapshot::Snapshot;
use ros2probe_testing::{repository, sample_robot};

use super::super::security::Rights;
use super::super::{Context, Doctor, nouns};
use super::answers;
use super::query::{MAX_READERS, READER_PERMITS};
use crate::agent::{Components, Expansion, Speed};
use crate::agent_facts::SourceKind;
use crate::config::{Access, Config};
use crate::run::replay::Replay;
use crate::settings_cell::Settings;
use crate::snapshot_cell::State;
use crate::surface::MetricSources;

/// Returns the context of an agent with a history in this directory.
fn context(directory: &Path) -> Context {
    let config = Config::default();
    let capture = repository("wire/tests/data/cyclonedds-samehost-any.pcap.gz");
    let limits = Limits::default();
    let replay = Replay::open(&capture, Expansion::Limited, Speed::Max, limits).unwrap();
    let sources = MetricSources::new(SourceKind::Replay, Settings::new(&config));
    sources.disk_history.keep_in(directory, 1 << 20);
    let watches = sources.watches(Vec::new(), Vec::new()).unwrap();
    let doctor = Doctor::new(|_| Report {
        version: "".into(),
        subject: String::new(),
        severity: Severity::Ok,
        findings: Vec::new(),
    });
    let components = Components::of_replay(&config, replay, sources, watches, doctor);
    components.assemble().unwrap().context
}

/// Earlier, two such requests held the permits of all large answers for ten seconds.
#[tokio::test(start_paused = true)]
async fn a_storage_that_does_not_answer_delays_no_other_answer() {
    let directory = tempfile::tempdir().unwrap();
    let context = context(directory.path());
    let (router, _) = nouns(Some(&context)).split_for_parts();
    let granted = Rights::new(Access::All, None);
    let router = router.layer(Extension(granted)).with_state(context);
    let service = TowerToHyperService::new(router);
    let ask = |path: &'static str| {
        let mut request = Request::new(Body::empty());
        *request.uri_mut() = Uri::from_static(path);
        service.call(request)
    };
    let readers = u32::try_from(MAX_READERS).unwrap();
    let _hanging = READER_PERMITS.acquire_many(readers).await.unwrap();
    let waiting = [
        "/history/events?from=1&to=2",
        "/history/processes?from=1&to=2",
        "/history/moment?at=5",
        "/history/moment/parameters?at=5",
        "/topics/imu/history?from=1&to=2",
    ];
    let waiting = waiting.map(|path| tokio::spawn(ask(path)));
    // All of them wait for the storage.
    for _ in 0..100 {
        tokio::task::yield_now().await;
    }
    for path in ["/names", "/topics"] {
        let answer = ask(path).await.unwrap();
        assert_eq!(answer.status(), StatusCode::OK, "{path}");
    }
    assert!(waiting.iter().all(|request| !request.is_finished()));
    for request in waiting {
        let answer = request.await.unwrap().unwrap();
        assert_eq!(answer.status(), StatusCode::NOT_FOUND);
    }
}

/// Requests a path with these rights. Returns the status, and the body.
async fn ask(context: &Context, access: Access, path: &str) -> (StatusCode, Vec<u8>) {
    let (router, _) = nouns(Some(context)).split_for_parts();
    let router = router
        .layer(Extension(Rights::new(access, None)))
        .with_state(context.clone());
    let mut request = Request::new(Body::empty());
    *request.uri_mut() = path.parse().unwrap();
    let answer = TowerToHyperService::new(router)
        .call(request)
        .await
        .unwrap();
    let status = answer.status();
    let body = to_bytes(answer.into_body(), usize::MAX).await.unwrap();
    (status, body.to_vec())
}

/// Returns the state after a first snapshot.
fn known(context: &Context) -> Arc<State> {
    let agent = context.latest.state().agent.clone();
    let snapshot = Some(Arc::new(Snapshot::default()));
    Arc::new(State { snapshot, agent })
}

#[test]
fn answers_take_no_more_than_their_room() {
    let directory = tempfile::tempdir().unwrap();
    let context = context(directory.path());
    let known = known(&context);
    let sizes = |room| -> Vec<usize> {
        let documents = answers::of_state(&context, &known, room);
        documents.map(|document| document.content.len()).collect()
    };
    let all = sizes(usize::MAX);
    assert_eq!(all.len(), KeptNoun::ALL.len());
    for room in [0, 100, 500] {
        let kept = sizes(room);
        assert!(kept.len() < all.len() && kept.iter().sum::<usize>() <= room);
    }
}

/// Earlier, the services of 200 nodes took all the room, and the topics of the robot were missing.
#[test]
fn topics_of_services_take_no_room_of_the_others() {
    let directory = tempfile::tempdir().unwrap();
    let context = context(directory.path());
    let mut snapshot = sample_robot::snapshot(["/imu"]);
    for (kind, dds_name) in [
        (TopicKind::ServiceRequest, "rq/goRequest"),
        (TopicKind::ServiceReply, "rr/goReply"),
        (TopicKind::Discovery, "ros_discovery_info"),
        (TopicKind::Dds, "raw"),
    ] {
        let mut topic = sample_robot::topic("/go");
        (topic.kind, topic.dds_name) = (kind, dds_name.into());
        snapshot.topics.push(topic);
    }
    let agent = context.latest.state().agent.clone();
    let snapshot = Some(Arc::new(snapshot));
    let state = State { snapshot, agent };
    let mut documents = answers::of_state(&context, &state, usize::MAX);
    let topics = documents.find(|document| document.name == "topics");
    let topics = topics.unwrap().content;
    let kept: TopicDetailsList<'_> = serde_json::from_slice(&topics).unwrap();
    let names = kept.topics.iter().map(|each| each.topic.dds_name.clone());
    assert_eq!(names.collect::<Vec<_>>(), ["rt/imu", "raw"]);
}

/// Earlier, the past had the rate of a topic, and not that of each publisher.
#[test]
fn rates_of_publishers_are_kept_and_left_out_before_a_topic_is() {
    let directory = tempfile::tempdir().unwrap();
    let context = context(directory.path());
    let agent = context.latest.state().agent.clone();
    let snapshot = Some(Arc::new(sample_robot::snapshot(["/imu", "/scan"])));
    let state = State { snapshot, agent };
    let sizes = |room| -> usize {
        let documents = answers::of_state(&context, &state, room);
        documents.map(|document| document.content.len()).sum()
    };
    let kept = |room| -> serde_json::Value {
        let mut documents = answers::of_state(&context, &state, room);
        let topics = documents.find(|document| document.name == "topics");
        serde_json::from_slice(&topics.unwrap().content).unwrap()
    };
    let all = kept(usize::MAX);
    let scan = &all["topics"][1]["publishers"][0];
    assert_eq!(scan["measurement"], serde_json::Value::Null);
    let figures = serde_json::json!({
        "rate_hertz": 20.0, "bandwidth_bytes_per_second": 13_000_000.0, "loss_ratio": 0.096,
    });
    assert_eq!(scan["past_figures"], figures);
    let few = kept(sizes(usize::MAX) - 50);
    assert_eq!(few["topics"].as_array().unwrap().len(), 2);
    let scan = &few["topics"][1]["publishers"][0];
    assert!(scan["node"] == "/lidar" && scan.get("past_figures").is_none());
}

#[tokio::test]
async fn an_answer_of_the_past_is_found_after_a_restart_by_clients_with_its_rights() {
    let directory = tempfile::tempdir().unwrap();
    let before = context(directory.path());
    assert!(before.disk_history.open());
    let store = before.disk_history.store().unwrap();
    let (unknown, known) = (before.latest.state(), known(&before));
    assert_eq!(answers::of_state(&before, &unknown, usize::MAX).count(), 0);
    let room = store.document_room();
    let documents = answers::of_state(&before, &known, room);
    store.append_documents(0, 60, documents).unwrap();
    drop(before);

    let context = context(directory.path());
    assert!(context.disk_history.open());
    for noun in KeptNoun::ALL {
        let path = format!("/history/moment/{}?at=61", noun.label());
        let (status, body) = ask(&context, Access::All, &path).await;
        assert_eq!(status, StatusCode::OK, "{path}");
        let answer: serde_json::Value = serde_json::from_slice(&body).unwrap();
        assert!(answer.is_object(), "{path}");
        // The same rights as in the present.
        let present = format!("/{}", noun.label());
        let (now, _) = ask(&context, Access::Read, &present).await;
        let (then, _) = ask(&context, Access::Read, &path).await;
        assert_eq!(then, now, "{path}");
        let path = format!("/history/moment/{}?at=59", noun.label());
        let (status, _) = ask(&context, Access::All, &path).await;
        assert_eq!(status, StatusCode::NOT_FOUND, "{path}");
    }
    let (_, topics) = ask(&context, Access::Read, "/history/moment/topics?at=61").await;
    serde_json::from_slice::<TopicDetailsList<'_>>(&topics).unwrap();
    let path = "/history/moment/topics?at=61&name=/imu&domain_id=0";
    let (status, one) = ask(&context, Access::Read, path).await;
    let one: TopicDetailsList<'_> = serde_json::from_slice(&one).unwrap();
    assert!(status == StatusCode::OK && one.topics.is_empty());
    for path in [
        "/history/moment/doctor?at=61",
        "/history/moment/logs?at=-1",
        "/history/moment/logs?at=61&name=/imu",
    ] {
        let (status, _) = ask(&context, Access::All, path).await;
        assert_eq!(status, StatusCode::UNPROCESSABLE_ENTITY, "{path}");
    }
}
