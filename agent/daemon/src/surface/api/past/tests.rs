//! Requests for the history on a storage that does not answer.

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use axum::Extension;
use axum::body::Body;
use axum::http::{Request, StatusCode, Uri};
use hyper::service::Service as _;
use hyper_util::service::TowerToHyperService;
use ros2probe_api::doctor::{Report, Severity};
use ros2probe_message::{Library, Sources};
use tokio_util::sync::CancellationToken;

use super::super::reload;
use super::super::security::Rights;
use super::super::{Context, Doctor, Live, Page, nouns};
use super::query::{MAX_READERS, READER_PERMITS};
use crate::agent_facts::SourceKind;
use crate::config::{Access, Config};
use crate::recording::{self, Recordings, Snapshots};
use crate::settings_cell::Settings;
use crate::subscriptions::{Caps, Subscriptions};
use crate::surface::MetricSources;
use crate::watches::Watches;

/// Returns the context of an agent with a history in this directory.
fn context(directory: &Path) -> Context {
    let config = Config::default();
    let sources = MetricSources::new(SourceKind::Replay, Settings::new(&config));
    sources.disk_history.keep_in(directory, 1 << 20);
    let stop = CancellationToken::new();
    let caps = Caps {
        subscriptions: 1,
        bytes: 1 << 20,
    };
    let subscriptions = Subscriptions::new(Arc::clone(&sources.latest), caps, stop.clone());
    let subscriptions = Arc::new(subscriptions);
    let library = Arc::new(Library::new(Sources::default()));
    let watches = Watches::new(
        Arc::clone(&sources.limits),
        Arc::clone(&sources.events),
        Arc::clone(&sources.settings),
        Arc::clone(sources.latest.bell()),
        Vec::new(),
        Vec::new(),
    );
    let recordings = Recordings::new(recording::Components {
        directory: None,
        limits: config.recordings.limits,
        queue_bytes: 1 << 20,
        latest: Arc::clone(&sources.latest),
        events: Arc::clone(&sources.events),
        caps: Arc::clone(&sources.limits),
        figures: Arc::clone(&sources.recordings),
        subscriptions: Arc::clone(&subscriptions),
        library: Arc::clone(&library),
        receipts: None,
    });
    let (reloader, _) = reload::channel();
    Context {
        latest: sources.latest,
        events: sources.events,
        limits: sources.limits,
        recording_figures: sources.recordings,
        watches: Arc::new(watches.unwrap()),
        subscriptions,
        recordings: Arc::new(recordings),
        snapshots: Arc::new(Snapshots::default()),
        live: Arc::new(Live::new(Duration::ZERO)),
        disk_history: sources.disk_history,
        library,
        viewers: sources.viewers,
        ros2_daemon: sources.ros2_daemon,
        page: Arc::new(Page::new(Vec::new())),
        doctor: Doctor::new(|_| Report {
            version: "".into(),
            subject: String::new(),
            severity: Severity::Ok,
            findings: Vec::new(),
        }),
        reloader,
        stop,
    }
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
