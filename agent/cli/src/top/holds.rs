//! Topics that are measured because somebody pressed a key: until the program ends, by a connection
//! that goes with the process however it ends, or also after that, by a watch.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::Sender;
use std::thread;
use std::time::Duration;

use serde_json::{Value, json};

use super::app::Hold;
use super::feed::Ask;
use super::row::Key;
use crate::client::{Agent, ClientError, Next};
use ros2probe_api::path::encoded;

/// How often a connection looks whether it is still wanted.
const LOOK: Duration = Duration::from_millis(200);
/// Looks between two attempts to open it again.
const PAUSE: u32 = 10;

/// All of them.
#[derive(Debug)]
pub(super) struct Holds {
    agent: Arc<Agent>,
    asks: Sender<Ask>,
    all: BTreeMap<Key, Held>,
}

#[derive(Debug)]
enum Held {
    /// By a connection, until this is set.
    Stream(Arc<AtomicBool>),
    /// By a watch of this name.
    Watch(String),
}

impl Holds {
    pub(super) const fn new(agent: Arc<Agent>, asks: Sender<Ask>) -> Self {
        Self {
            agent,
            asks,
            all: BTreeMap::new(),
        }
    }

    /// As the table marks them.
    pub(super) fn shown(&self) -> BTreeMap<Key, Hold> {
        let hold = |held: &Held| match held {
            Held::Stream(_) => Hold::Here,
            Held::Watch(_) => Hold::Kept,
        };
        let all = self.all.iter();
        all.map(|(key, held)| (key.clone(), hold(held))).collect()
    }

    /// Has a topic measured while this program runs, or no longer.
    pub(super) fn toggle(&mut self, key: &Key, name: &str) -> String {
        match self.all.remove(key) {
            Some(Held::Stream(stop)) => {
                stop.store(true, Ordering::Relaxed);
                format!("{name}: no longer measured for rp top")
            }
            Some(Held::Watch(path)) => match self.agent.delete(&path) {
                Ok(()) => format!("{name}: the watch is removed"),
                Err(error) => {
                    let said = format!("{name}: {error}");
                    // Somebody else may have removed it; else it is still there.
                    if !error.is("no-such-watch") {
                        self.all.insert(key.clone(), Held::Watch(path));
                    }
                    said
                }
            },
            None => match self.open(key) {
                Ok(()) => format!("{name}: measured while rp top runs; W keeps it"),
                Err(error) => format!("{name}: cannot be measured: {error}"),
            },
        }
    }

    /// Has a topic measured also after the end.
    pub(super) fn keep(&mut self, key: &Key, name: &str) -> String {
        if let Some(Held::Watch(_)) = self.all.get(key) {
            return format!("{name}: is kept already; w removes the watch");
        }
        let path = format!("/watch{}?domain_id={}", encoded(name), key.domain_id);
        if !name.starts_with('/') {
            return format!("{name}: only topics with a ROS name can be watched by a client");
        }
        match self.agent.post::<_, Value>(&path, &json!({})) {
            Ok(_) => {
                let before = self.all.insert(key.clone(), Held::Watch(path));
                if let Some(Held::Stream(stop)) = before {
                    stop.store(true, Ordering::Relaxed);
                }
                format!("{name}: stays watched after rp top ends; w removes it")
            }
            Err(error) => format!("{name}: {error}"),
        }
    }

    /// A connection could not be opened.
    pub(super) fn lost(&mut self, key: &Key, why: String) -> String {
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
            asks: self.asks.clone(),
        };
        let thread = thread::Builder::new().name("interest".to_owned());
        thread.spawn(move || stream.run())?;
        self.all.insert(key.clone(), Held::Stream(stop));
        Ok(())
    }
}

/// A connection that has a topic measured as long as it is open.
#[derive(Debug)]
struct Stream {
    agent: Arc<Agent>,
    path: String,
    key: Key,
    stop: Arc<AtomicBool>,
    asks: Sender<Ask>,
}

impl Stream {
    /// Reads what comes, which nobody wants to see, and opens it again when it breaks.
    fn run(self) {
        while !self.is_over() {
            match self.agent.stream(&self.path) {
                Ok(mut lines) => {
                    while !self.is_over() {
                        match lines.line_within(LOOK) {
                            Ok(Next::Line(_) | Next::Nothing) => {}
                            Ok(Next::End) | Err(_) => break,
                        }
                    }
                }
                Err(error @ (ClientError::Refused(_) | ClientError::Older { .. })) => {
                    let _ = self.asks.send(Ask::Lost(self.key, error.to_string()));
                    return;
                }
                Err(_) => {}
            }
            for _ in 0..PAUSE {
                if self.is_over() {
                    return;
                }
                thread::sleep(LOOK);
            }
        }
    }

    fn is_over(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }
}
