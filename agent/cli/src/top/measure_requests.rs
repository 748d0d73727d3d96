//! Topics that are measured at the press of a key: by a connection that closes with the process, or
//! by a watch that outlives it.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::Sender;
use std::thread;
use std::time::Duration;

use super::app::MeasuredBy;
use super::poller::Request;
use super::row::Key;
use crate::client::{Agent, ClientError, Next};
use ros2probe_api::path::encoded;
use ros2probe_api::problem::Code;
use ros2probe_api::watches::{Watch, WatchRequest};

/// Interval at which a connection checks whether it is still needed.
const POLL_INTERVAL: Duration = Duration::from_millis(200);
/// Number of checks between two attempts to reopen a connection.
const REOPEN_CHECKS: u32 = 10;

/// All topics measured on behalf of this program.
#[derive(Debug)]
pub(super) struct MeasureRequests {
    agent: Arc<Agent>,
    requests: Sender<Request>,
    all: BTreeMap<Key, MeasureRequest>,
}

#[derive(Debug)]
enum MeasureRequest {
    /// Measured by a connection, until this flag is set.
    Stream(Arc<AtomicBool>),
    /// Measured by a watch at this path.
    Watch(String),
}

impl MeasureRequests {
    pub(super) const fn new(agent: Arc<Agent>, requests: Sender<Request>) -> Self {
        Self {
            agent,
            requests,
            all: BTreeMap::new(),
        }
    }

    /// Returns the topics and the mark of each in the table.
    pub(super) fn shown(&self) -> BTreeMap<Key, MeasuredBy> {
        let hold = |held: &MeasureRequest| match held {
            MeasureRequest::Stream(_) => MeasuredBy::Session,
            MeasureRequest::Watch(_) => MeasuredBy::Watch,
        };
        let all = self.all.iter();
        all.map(|(key, held)| (key.clone(), hold(held))).collect()
    }

    /// Starts or stops measuring a topic while this program runs. Returns the status line.
    pub(super) fn toggle(&mut self, key: &Key, name: &str) -> String {
        match self.all.remove(key) {
            Some(MeasureRequest::Stream(stop)) => {
                stop.store(true, Ordering::Relaxed);
                format!("{name}: no longer measured for rp top")
            }
            Some(MeasureRequest::Watch(path)) => match self.agent.delete(&path) {
                Ok(()) => format!("{name}: the watch is removed"),
                Err(error) => {
                    let status = format!("{name}: {error}");
                    // Another client may have removed the watch; otherwise it still exists.
                    if !error.is(Code::NoSuchWatch) {
                        self.all.insert(key.clone(), MeasureRequest::Watch(path));
                    }
                    status
                }
            },
            None => match self.open(key) {
                Ok(()) => format!("{name}: measured while rp top runs; W keeps it"),
                Err(error) => format!("{name}: cannot be measured: {error}"),
            },
        }
    }

    /// Creates a watch that measures a topic permanently. Returns the status line.
    pub(super) fn keep(&mut self, key: &Key, name: &str) -> String {
        if let Some(MeasureRequest::Watch(_)) = self.all.get(key) {
            return format!("{name}: already has a watch; w removes it");
        }
        let path = format!("/watch{}?domain_id={}", encoded(name), key.domain_id);
        if !name.starts_with('/') {
            return format!("{name}: only topics with a ROS name can be watched by a client");
        }
        match self.agent.post::<_, Watch>(&path, &WatchRequest::default()) {
            Ok(_) => {
                let before = self.all.insert(key.clone(), MeasureRequest::Watch(path));
                if let Some(MeasureRequest::Stream(stop)) = before {
                    stop.store(true, Ordering::Relaxed);
                }
                format!("{name}: stays watched after rp top ends; w removes it")
            }
            Err(error) => format!("{name}: {error}"),
        }
    }

    /// Removes a topic whose connection failed. Returns the status line.
    pub(super) fn remove_failed(&mut self, key: &Key, why: String) -> String {
        self.all.remove(key);
        why
    }

    fn open(&mut self, key: &Key) -> std::io::Result<()> {
        let stop = Arc::new(AtomicBool::new(false));
        let stream = Stream {
            agent: Arc::clone(&self.agent),
            path: format!(
                "/samples?topic={}&domain_id={}",
                encoded(&key.dds_name),
                key.domain_id
            ),
            key: key.clone(),
            stop: Arc::clone(&stop),
            requests: self.requests.clone(),
        };
        let thread = thread::Builder::new().name("interest".to_owned());
        thread.spawn(move || stream.run())?;
        self.all.insert(key.clone(), MeasureRequest::Stream(stop));
        Ok(())
    }
}

/// Connection that keeps a topic measured while it is open.
#[derive(Debug)]
struct Stream {
    agent: Arc<Agent>,
    path: String,
    key: Key,
    stop: Arc<AtomicBool>,
    requests: Sender<Request>,
}

impl Stream {
    /// Reads and discards the stream, and reopens it after a break.
    fn run(self) {
        while !self.is_over() {
            match self.agent.stream(&self.path) {
                Ok(mut lines) => {
                    while !self.is_over() {
                        match lines.line_within(POLL_INTERVAL) {
                            Ok(Next::Line(_) | Next::Nothing) => {}
                            Ok(Next::End) | Err(_) => break,
                        }
                    }
                }
                Err(error @ (ClientError::Refused(_) | ClientError::OlderAgent { .. })) => {
                    let _ = self
                        .requests
                        .send(Request::Lost(self.key, error.to_string()));
                    return;
                }
                Err(_) => {}
            }
            for _ in 0..REOPEN_CHECKS {
                if self.is_over() {
                    return;
                }
                thread::sleep(POLL_INTERVAL);
            }
        }
    }

    fn is_over(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }
}
