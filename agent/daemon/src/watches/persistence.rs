//! Saves watches of clients for the next start, in `watches.json` of the state directory.
//!
//! A separate thread writes only the latest list, so clients do not wait for the disk. An unusable
//! file is moved aside and never ends the agent.

use std::io;
use std::mem;
use std::path::PathBuf;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use ros2probe_capture::threads::Progress;
use ros2probe_wire::{DomainId, InvalidDomainId};
use serde::{Deserialize, Serialize};

use crate::config::watch::{
    ExpectationError, ExpectationValues, Expectations, ManyGlobs, PatternError, Retain, Watch,
    check_pattern, check_trace,
};
use crate::config::{Limit, check_globs};
use crate::state::{END_TIMEOUT, Form, Found, Newer, StateDirectory, from_json, join_until};

const WATCHES_FILE: &str = "watches.json";
/// Version of the written format. Fields added so far may be missing in a file. Further fields need
/// a new version, since older agents would consider the file broken.
const VERSION: u32 = 1;
const WATCHES_FORM: Form<Document> = Form {
    file: WATCHES_FILE,
    readers: &[(VERSION, from_json)],
};
/// Delay of a write, so that changes within this time are written together.
const WRITE_DELAY: Duration = Duration::from_millis(50);
/// Time after a failure until the next attempt.
const RETRY_DELAY: Duration = Duration::from_secs(5);

/// Saved watches at the start.
#[derive(Debug, PartialEq)]
pub enum LoadedWatches {
    /// No file exists.
    Nothing,
    /// The saved watches.
    These(Vec<Watch>),
    /// A newer version wrote the file; it must not be overwritten.
    Newer(Newer),
    /// The file is unusable and was moved aside.
    Unusable {
        /// Reason why it is unusable.
        reason: String,
        /// New path of the file, if it could be moved.
        moved_to: Option<PathBuf>,
    },
}

#[derive(Serialize, Deserialize)]
struct Document {
    version: u32,
    watches: Vec<Line>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Line {
    topic: String,
    domain_id: Option<u32>,
    per_subscriber: bool,
    #[serde(default)]
    trace: f64,
    #[serde(default)]
    retain: Retain,
    min_rate_hz: Option<f64>,
    max_rate_hz: Option<f64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    window_s: Option<u32>,
    max_loss_ratio: Option<f64>,
    max_latency_ms: Option<f64>,
    max_silence_s: Option<f64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    publishers: Option<u32>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    subscribers: Option<u32>,
}

/// The writing thread.
#[derive(Debug)]
pub(super) struct WatchWriter {
    mailbox: Arc<Mailbox>,
    thread: Mutex<Option<JoinHandle<()>>>,
}

/// Mailbox of the writing thread.
#[derive(Debug, Default)]
struct Mailbox {
    pending: Mutex<Pending>,
    changed: Condvar,
    progress: Progress,
}

#[derive(Debug, Default)]
struct Pending {
    /// List that is not written yet.
    latest: Option<Vec<Arc<Watch>>>,
    is_failing: bool,
    is_closed: bool,
}

/// Reads the watches that clients of the previous agent added. An invalid file is moved aside.
#[must_use]
pub fn load(directory: &StateDirectory) -> LoadedWatches {
    let document = match directory.read(&WATCHES_FORM) {
        Found::Nothing => return LoadedWatches::Nothing,
        Found::Newer(newer) => return LoadedWatches::Newer(newer),
        Found::Unusable { reason, moved_to } => {
            return LoadedWatches::Unusable { reason, moved_to };
        }
        Found::This(document) => document,
    };
    let watches = if document.watches.len() > Limit::Watches.row().range.1 {
        Err(InvalidList::Watches(document.watches.len()))
    } else {
        let watches = document.watches.into_iter().map(Watch::try_from);
        watches.collect()
    };
    let watches = watches.and_then(|watches: Vec<Watch>| {
        let patterns = watches.iter().map(|watch| watch.pattern.as_str());
        check_globs(patterns)?;
        Ok(watches)
    });
    match watches {
        Ok(watches) => LoadedWatches::These(watches),
        Err(error) => match directory.move_aside::<Document>(WATCHES_FILE, error.to_string()) {
            Found::Unusable { reason, moved_to } => LoadedWatches::Unusable { reason, moved_to },
            Found::Nothing | Found::This(_) | Found::Newer(_) => LoadedWatches::Nothing,
        },
    }
}

/// Why the saved watches are invalid.
#[derive(Debug, thiserror::Error)]
enum InvalidList {
    #[error("it has {0} watches")]
    Watches(usize),
    #[error("it has {0}")]
    Globs(#[from] ManyGlobs),
    /// The pattern of a watch is invalid.
    #[error("`{topic}` {error}")]
    Pattern { topic: String, error: PatternError },
    #[error(transparent)]
    Domain(#[from] InvalidDomainId),
    #[error(transparent)]
    Expectation(#[from] ExpectationError),
}

impl TryFrom<Line> for Watch {
    type Error = InvalidList;

    fn try_from(line: Line) -> Result<Self, InvalidList> {
        check_pattern(&line.topic).map_err(|error| InvalidList::Pattern {
            topic: line.topic.clone(),
            error,
        })?;
        let domain_id = line.domain_id.map(DomainId::try_from).transpose()?;
        let values = ExpectationValues {
            min_rate_hz: line.min_rate_hz,
            max_rate_hz: line.max_rate_hz,
            window_s: line.window_s,
            max_loss_ratio: line.max_loss_ratio,
            max_latency_ms: line.max_latency_ms,
            max_silence_s: line.max_silence_s,
            publishers: line.publishers,
            subscribers: line.subscribers,
        };
        let expectations = Expectations::try_from(values)?;
        check_trace(line.trace)?;
        Ok(Self {
            pattern: line.topic,
            domain_id,
            expectations,
            per_subscriber: line.per_subscriber,
            trace: line.trace,
            retain: line.retain,
        })
    }
}

impl From<&Watch> for Line {
    fn from(watch: &Watch) -> Self {
        let ExpectationValues {
            min_rate_hz,
            max_rate_hz,
            window_s,
            max_loss_ratio,
            max_latency_ms,
            max_silence_s,
            publishers,
            subscribers,
        } = watch.expectations.values();
        Self {
            topic: watch.pattern.clone(),
            domain_id: watch.domain_id.map(|id| id.0),
            per_subscriber: watch.per_subscriber,
            trace: watch.trace,
            retain: watch.retain,
            min_rate_hz,
            max_rate_hz,
            window_s,
            max_loss_ratio,
            max_latency_ms,
            max_silence_s,
            publishers,
            subscribers,
        }
    }
}

impl WatchWriter {
    /// Starts the thread.
    pub(super) fn start(directory: Arc<StateDirectory>) -> io::Result<Self> {
        let mailbox = Arc::<Mailbox>::default();
        let own = Arc::clone(&mailbox);
        let thread = std::thread::Builder::new()
            .name("watches".to_owned())
            .spawn(move || own.write_until_closed(&directory))?;
        Ok(Self {
            mailbox,
            thread: Mutex::new(Some(thread)),
        })
    }

    /// Passes the list to the writing thread, without blocking.
    pub(super) fn store(&self, watches: Vec<Arc<Watch>>) {
        self.mailbox.pending().latest = Some(watches);
        self.mailbox.changed.notify_one();
    }

    /// Returns whether the last write succeeded, and the current one takes no longer than usual.
    pub(super) fn is_working(&self) -> bool {
        !self.mailbox.pending().is_failing && self.mailbox.progress.stalled().is_none()
    }

    /// Waits until the latest list is written, or its write has failed, for at most
    /// [`END_TIMEOUT`].
    pub(super) fn finish(&self) {
        self.mailbox.pending().is_closed = true;
        self.mailbox.changed.notify_one();
        let mut thread = self.thread.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(thread) = thread.take()
            && !join_until(thread, Instant::now() + END_TIMEOUT)
        {
            tracing::error!("the file system does not answer: the added watches are not saved");
        }
    }
}

impl Mailbox {
    fn pending(&self) -> MutexGuard<'_, Pending> {
        self.pending.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn write_until_closed(&self, directory: &StateDirectory) {
        while let Some(watches) = self.next() {
            let document = Document {
                version: VERSION,
                watches: watches.iter().map(|watch| Line::from(&**watch)).collect(),
            };
            self.progress.step();
            let written = directory.replace(WATCHES_FILE, &document);
            self.progress.set_idle();
            let mut pending = self.pending();
            let failed_before = mem::replace(&mut pending.is_failing, written.is_err());
            // At the end, a failed write is not retried.
            if pending.is_failing && !pending.is_closed {
                pending.latest.get_or_insert(watches);
            }
            drop(pending);
            let path = directory.path().display();
            match written {
                Ok(()) if failed_before => {
                    tracing::info!(%path, "added watches are saved again");
                }
                Err(error) if !failed_before => {
                    tracing::error!(%path, %error, "cannot save added watches: a restart would lose them");
                }
                Ok(()) | Err(_) => {}
            }
        }
    }

    /// Waits for the next list to write; returns `None` at the end.
    fn next(&self) -> Option<Vec<Arc<Watch>>> {
        let mut pending = self.pending();
        if pending.is_failing && !pending.is_closed {
            let again = self.changed.wait_timeout(pending, RETRY_DELAY);
            pending = again.unwrap_or_else(PoisonError::into_inner).0;
        }
        let idle = |pending: &mut Pending| pending.latest.is_none() && !pending.is_closed;
        let pending = self.changed.wait_while(pending, idle);
        let pending = pending.unwrap_or_else(PoisonError::into_inner);
        // Further changes may follow immediately.
        let open = |pending: &mut Pending| !pending.is_closed;
        let waited = self.changed.wait_timeout_while(pending, WRITE_DELAY, open);
        let mut pending = waited.unwrap_or_else(PoisonError::into_inner).0;
        pending.latest.take()
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    fn directory() -> (tempfile::TempDir, Arc<StateDirectory>) {
        let place = tempfile::tempdir().unwrap();
        let directory = StateDirectory::open(place.path()).unwrap();
        (place, Arc::new(directory))
    }

    fn watches() -> Vec<Watch> {
        let expecting = Watch {
            domain_id: Some(DomainId(5)),
            per_subscriber: true,
            trace: 0.5,
            retain: Retain::Last,
            expectations: Expectations {
                min_rate_hz: Some(9.5),
                max_silence: Some(Duration::from_secs(1)),
                subscribers: Some(2),
                ..Expectations::default()
            },
            ..Watch::named("/points").unwrap()
        };
        vec![expecting, Watch::named("/camera/**").unwrap()]
    }

    fn shared() -> Vec<Arc<Watch>> {
        watches().into_iter().map(Arc::new).collect()
    }

    #[test]
    fn saved_watches_are_read_back_unchanged() {
        let (_place, directory) = directory();
        assert_eq!(load(&directory), LoadedWatches::Nothing);
        let keeper = WatchWriter::start(Arc::clone(&directory)).unwrap();
        keeper.store(Vec::new());
        keeper.store(shared());
        keeper.finish();
        assert_eq!(load(&directory), LoadedWatches::These(watches()));
    }

    #[test]
    fn an_invalid_list_of_watches_is_moved_aside() {
        let (place, directory) = directory();
        let file = place.path().join(WATCHES_FILE);
        let document = Document {
            version: VERSION,
            watches: watches().iter().map(Line::from).collect(),
        };
        directory.replace(WATCHES_FILE, &document).unwrap();
        let whole = fs::read_to_string(&file).unwrap();
        let broken = [
            whole[..whole.len() / 2].to_owned(),
            whole.replace("/points", "points"),
            whole.replace("9.5", "-1"),
            whole.replace("\"domain_id\":5", "\"domain_id\":5000"),
            whole.replace("\"version\":1", "\"version\":0"),
            whole.replace("\"version\":1,", ""),
            whole.replace("per_subscriber", "for_ever"),
            String::new(),
        ];
        for text in broken {
            fs::write(&file, &text).unwrap();
            let found = load(&directory);
            assert!(
                matches!(&found, LoadedWatches::Unusable { .. }),
                "{text}: {found:?}"
            );
            let aside = place.path().join("watches.json.corrupt");
            assert_eq!(fs::read_to_string(aside).unwrap(), text);
            assert_eq!(load(&directory), LoadedWatches::Nothing);
        }
    }

    #[test]
    fn a_saved_list_with_too_costly_globs_is_moved_aside() {
        let (place, directory) = directory();
        let glob = |number| format!("/{}_{number}/**", "a*".repeat(7));
        let globs = (0..1000).map(|number| Watch::named(&glob(number)).unwrap());
        let document = Document {
            version: VERSION,
            watches: globs.map(|watch| Line::from(&watch)).collect(),
        };
        directory.replace(WATCHES_FILE, &document).unwrap();
        let LoadedWatches::Unusable { reason, moved_to } = load(&directory) else {
            panic!("it was read");
        };
        assert!(reason.contains("it has 1000 globs of"), "{reason}");
        assert_eq!(moved_to, Some(place.path().join("watches.json.corrupt")));
        assert_eq!(load(&directory), LoadedWatches::Nothing);
    }

    #[test]
    fn a_list_of_a_newer_agent_is_kept_and_one_in_the_first_format_is_read() {
        let (place, directory) = directory();
        let file = place.path().join(WATCHES_FILE);
        let newer = r#"{"version":2,"watches":[{"topic":"/points","colour":"red"}]}"#;
        fs::write(&file, newer).unwrap();
        let found = Newer {
            path: file.clone(),
            version: 2,
            known: VERSION,
        };
        assert_eq!(load(&directory), LoadedWatches::Newer(found));
        assert_eq!(fs::read_to_string(&file).unwrap(), newer);

        fs::write(
            &file,
            r#"{"version":1,"watches":[{"topic":"/points","domain_id":5,"per_subscriber":true,
                "min_rate_hz":9.5,"max_rate_hz":null,"max_loss_ratio":null,
                "max_latency_ms":null,"max_silence_s":1.0}]}"#,
        )
        .unwrap();
        let mut first = Watch {
            trace: 0.0,
            retain: Retain::None,
            ..watches().remove(0)
        };
        first.expectations.subscribers = None;
        assert_eq!(load(&directory), LoadedWatches::These(vec![first]));
    }

    #[test]
    fn a_failed_write_of_watches_is_retried() {
        let (place, directory) = directory();
        // A file cannot replace a directory.
        let obstacle = place.path().join("watches.json.new");
        fs::create_dir(&obstacle).unwrap();
        let keeper = WatchWriter::start(Arc::clone(&directory)).unwrap();
        keeper.store(shared());
        let start = Instant::now();
        while keeper.is_working() {
            assert!(start.elapsed() < Duration::from_secs(60));
            std::thread::yield_now();
        }
        fs::remove_dir(obstacle).unwrap();
        keeper.finish();
        assert_eq!(load(&directory), LoadedWatches::These(watches()));
    }
}
