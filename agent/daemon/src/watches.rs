//! All watched topics: those of the configuration, of the command line, and of clients at run time.
//!
//! Each pattern and domain has one entry; the configuration takes precedence. The capture thread
//! reads the latest merged list from a slot and is woken on changes. No thread waits for the
//! capture thread.

mod persistence;

use std::collections::HashSet;
use std::io;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use arc_swap::{ArcSwap, ArcSwapOption};
use ros2probe_wire::DomainId;

use crate::config::{Limit, ManyGlobs, Watch, Watchlist, check_globs};
use crate::events::{AgentEvent, EventLog};
use crate::limit_facts::LimitFigures;
use crate::settings_cell::SettingsCell;
use crate::snapshot_cell::CaptureBell;
use crate::state::StateDirectory;
use persistence::WatchWriter;
pub use persistence::{LoadedWatches, load};

/// Origin of a watch.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Origin {
    /// The configuration file.
    Config,
    /// The option `--watch`.
    CommandLine,
    /// A client of the API.
    Api,
}

/// One watch in force.
#[derive(Clone, Debug)]
pub struct Entry {
    /// The watch.
    pub watch: Arc<Watch>,
    /// Origin of the watch.
    pub origin: Origin,
}

/// Watches in force, immutable.
#[derive(Clone, Debug, Default)]
pub struct ActiveWatches {
    entries: Vec<Entry>,
    watchlist: Arc<Watchlist>,
}

/// Result of a request to add a watch.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AddOutcome {
    /// It was added.
    Added,
    /// It replaced a watch with other settings.
    Replaced,
    /// The same watch exists already.
    Unchanged,
}

/// Why a change of the watches was refused.
#[derive(Debug, thiserror::Error)]
pub enum Refused {
    /// The configuration or the command line has this watch; clients cannot override it.
    #[error("it is defined by {}", by.in_sentence())]
    DefinedElsewhere {
        /// Origin of the watch.
        by: Origin,
    },
    /// A client added it with other settings.
    #[error("it is watched already, with other settings")]
    Different,
    /// No such watch exists.
    #[error("it is not watched")]
    Unknown,
    /// The number of watches would exceed its limit.
    #[error(
        "there would be more than {0} watches, which is limits.watches: use globs, or raise it"
    )]
    Full(usize),
    /// Matching all globs against every topic would take too long.
    #[error("there would be {0}")]
    Globs(#[from] ManyGlobs),
}

/// All watches.
#[derive(Debug)]
pub struct Watches {
    lists: Mutex<Lists>,
    active: ArcSwap<ActiveWatches>,
    /// Latest list that the capture thread has not read yet.
    unread: ArcSwapOption<Watchlist>,
    limits: Arc<LimitFigures>,
    events: Arc<EventLog>,
    shown: Arc<SettingsCell>,
    bell: Arc<CaptureBell>,
    writer: OnceLock<WatchWriter>,
}

#[derive(Clone, Debug, Default)]
struct Lists {
    configured: Vec<Arc<Watch>>,
    command_line: Vec<Arc<Watch>>,
    added: Vec<Arc<Watch>>,
}

impl Origin {
    /// Returns the name in the API.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Config => "config",
            Self::CommandLine => "command_line",
            Self::Api => "api",
        }
    }

    /// Returns the name within a sentence.
    #[must_use]
    pub const fn in_sentence(self) -> &'static str {
        match self {
            Self::Config => "the configuration file",
            Self::CommandLine => "the command line",
            Self::Api => "a client of the API",
        }
    }
}

impl ActiveWatches {
    /// Returns all watches: of the configuration, of the command line, then of clients in order of
    /// their addition.
    #[must_use]
    pub fn entries(&self) -> &[Entry] {
        &self.entries
    }

    /// Returns the watches without their origins.
    #[must_use]
    pub fn watchlist(&self) -> &Watchlist {
        &self.watchlist
    }

    fn globs(&self) -> impl Iterator<Item = &str> {
        let patterns = self
            .entries
            .iter()
            .map(|entry| entry.watch.pattern.as_str());
        patterns.filter(|pattern| pattern.contains('*'))
    }

    /// Returns the watch with this pattern and domain; `None` if it does not exist.
    #[must_use]
    pub fn find(&self, pattern: &str, domain_id: Option<u32>) -> Option<&Entry> {
        let place = self.watchlist.position(pattern, domain_id.map(DomainId))?;
        self.entries.get(place)
    }
}

impl Watches {
    /// Creates the list from the configuration and the command line.
    ///
    /// # Errors
    ///
    /// Fails if there are too many watches or globs.
    pub fn new(
        limits: Arc<LimitFigures>,
        events: Arc<EventLog>,
        shown: Arc<SettingsCell>,
        bell: Arc<CaptureBell>,
        configured: Vec<Watch>,
        command_line: Vec<Watch>,
    ) -> Result<Self, Refused> {
        let watches = Self {
            lists: Mutex::default(),
            active: ArcSwap::default(),
            unread: ArcSwapOption::default(),
            limits,
            events,
            shown,
            bell,
            writer: OnceLock::new(),
        };
        let lists = Lists {
            configured: configured.into_iter().map(Arc::new).collect(),
            command_line: command_line.into_iter().map(Arc::new).collect(),
            added: Vec::new(),
        };
        watches.change(|old, _| {
            *old = lists;
            Ok(AddOutcome::Added)
        })?;
        Ok(watches)
    }

    /// Restores watches that clients of the previous agent had added. Returns the number of watches
    /// that did not fit.
    ///
    /// # Errors
    ///
    /// Fails if there are too many globs; then nothing changes.
    pub fn restore(&self, watches: Vec<Watch>) -> Result<usize, Refused> {
        let in_force = self.active();
        let mut room = self.cap().saturating_sub(in_force.entries().len());
        let asked = watches.len();
        let mut globs: Vec<String> = in_force.globs().map(str::to_owned).collect();
        let fits = |watch: &Watch| {
            let is_there = in_force
                .find(&watch.pattern, watch.domain_id.map(|id| id.0))
                .is_some();
            if is_there {
                return true;
            }
            globs.push(watch.pattern.clone());
            let fits = room > 0 && check_globs(globs.iter().map(String::as_str)).is_ok();
            if !fits {
                globs.pop();
            }
            room -= usize::from(fits);
            fits
        };
        let added: Vec<_> = watches.into_iter().filter(fits).map(Arc::new).collect();
        let left_out = asked - added.len();
        self.limits.reached(Limit::Watches, left_out);
        self.change(|lists, _| {
            lists.added = added;
            Ok(AddOutcome::Added)
        })?;
        Ok(left_out)
    }

    /// Saves watches of clients in this directory from now on.
    ///
    /// # Errors
    ///
    /// Fails if the thread cannot be started.
    pub fn keep_in(&self, directory: Arc<StateDirectory>) -> io::Result<()> {
        let keeper = WatchWriter::start(directory)?;
        // Only the first directory is used.
        let _ = self.writer.set(keeper);
        Ok(())
    }

    /// Returns whether watches of clients outlive the agent: a directory exists, and the last write
    /// succeeded.
    #[must_use]
    pub fn is_kept(&self) -> bool {
        self.writer.get().is_some_and(WatchWriter::is_working)
    }

    /// Waits until watches of clients are on disk, at the end of the agent.
    pub fn finish(&self) {
        if let Some(keeper) = self.writer.get() {
            keeper.finish();
        }
    }

    /// Replaces the watches of the configuration; others stay.
    ///
    /// # Errors
    ///
    /// Fails if there would be too many watches or globs; then nothing changes.
    pub fn configure(&self, watches: Vec<Watch>) -> Result<(), Refused> {
        self.change(|lists, _| {
            lists.configured = watches.into_iter().map(Arc::new).collect();
            Ok(AddOutcome::Replaced)
        })?;
        Ok(())
    }

    /// Adds a watch of a client, unless it exists.
    ///
    /// # Errors
    ///
    /// Fails if it exists with other settings, or if a limit would be exceeded.
    pub fn add(&self, watch: Watch) -> Result<AddOutcome, Refused> {
        self.put(watch, false)
    }

    /// Adds a watch of a client, or replaces one of a client.
    ///
    /// # Errors
    ///
    /// Fails if the configuration or the command line has it with other settings, or if a limit
    /// would be exceeded.
    pub fn replace(&self, watch: Watch) -> Result<AddOutcome, Refused> {
        self.put(watch, true)
    }

    /// Removes a watch of a client.
    ///
    /// # Errors
    ///
    /// Fails if the watch does not exist, or if no client added it.
    pub fn remove(&self, pattern: &str, domain_id: Option<u32>) -> Result<(), Refused> {
        self.change(|lists, in_force| {
            match in_force.find(pattern, domain_id) {
                None => return Err(Refused::Unknown),
                Some(Entry { origin, .. }) if *origin != Origin::Api => {
                    return Err(Refused::DefinedElsewhere { by: *origin });
                }
                Some(_) => {}
            }
            lists
                .added
                .retain(|watch| !has_identity(watch, pattern, domain_id));
            Ok(AddOutcome::Replaced)
        })?;
        self.events.record(AgentEvent::WatchRemoved {
            watch: pattern.to_owned(),
            domain_id,
        });
        Ok(())
    }

    /// Returns the watches in force.
    #[must_use]
    pub fn active(&self) -> Arc<ActiveWatches> {
        self.active.load_full()
    }

    /// For the capture thread: a replay begins again. The watches count as changed.
    pub fn begin_again(&self) {
        let lists = self.lists.lock().unwrap_or_else(PoisonError::into_inner);
        self.unread
            .store(Some(Arc::clone(&self.active().watchlist)));
        drop(lists);
    }

    /// For the capture thread: returns the watches, if they changed since the last call.
    #[must_use]
    pub fn take_changed(&self) -> Option<Arc<Watchlist>> {
        self.unread.swap(None)
    }

    fn cap(&self) -> usize {
        self.limits.caps().watches
    }

    fn put(&self, watch: Watch, replace: bool) -> Result<AddOutcome, Refused> {
        let watch = Arc::new(watch);
        let done = self.change(|lists, in_force| {
            let done = match in_force.find(&watch.pattern, watch.domain_id.map(|id| id.0)) {
                Some(old) if old.watch == watch => return Ok(AddOutcome::Unchanged),
                Some(old) if old.origin != Origin::Api => {
                    return Err(Refused::DefinedElsewhere { by: old.origin });
                }
                Some(_) if !replace => return Err(Refused::Different),
                Some(_) => AddOutcome::Replaced,
                None => AddOutcome::Added,
            };
            let same = |other: &&mut Arc<Watch>| {
                has_identity(other, &watch.pattern, watch.domain_id.map(|id| id.0))
            };
            if let Some(old) = lists.added.iter_mut().find(same) {
                *old = Arc::clone(&watch);
            } else {
                lists.added.push(Arc::clone(&watch));
            }
            Ok(done)
        })?;
        if done != AddOutcome::Unchanged {
            self.events.record(AgentEvent::WatchAdded {
                watch: watch.pattern.clone(),
                domain_id: watch.domain_id.map(|id| id.0),
            });
        }
        Ok(done)
    }

    /// Changes the lists, merges them and notifies all users of the result. Nothing changes on an
    /// error, or with [`Done::Unchanged`]. `change` runs under the lock, so concurrent clients are
    /// serialized.
    fn change(
        &self,
        change: impl FnOnce(&mut Lists, &ActiveWatches) -> Result<AddOutcome, Refused>,
    ) -> Result<AddOutcome, Refused> {
        let mut lists = self.lists.lock().unwrap_or_else(PoisonError::into_inner);
        let mut new = lists.clone();
        let done = change(&mut new, &self.active())?;
        if done == AddOutcome::Unchanged {
            return Ok(done);
        }
        let merged = ActiveWatches::merge(&new)?;
        let (count, cap) = (merged.entries.len(), self.cap());
        if count > cap {
            self.limits.reached(Limit::Watches, count - cap);
            return Err(Refused::Full(cap));
        }
        self.limits.set_used(Limit::Watches, count);
        if new.added != lists.added
            && let Some(keeper) = self.writer.get()
        {
            keeper.store(new.added.clone());
        }
        *lists = new;
        self.unread.store(Some(Arc::clone(&merged.watchlist)));
        self.shown.watch(merged.watchlist.watches());
        self.active.store(Arc::new(merged));
        drop(lists);
        self.bell.ring();
        Ok(done)
    }
}

impl ActiveWatches {
    fn merge(lists: &Lists) -> Result<Self, ManyGlobs> {
        let origins = [
            (Origin::Config, &lists.configured),
            (Origin::CommandLine, &lists.command_line),
            (Origin::Api, &lists.added),
        ];
        let mut taken = HashSet::new();
        let mut entries = Vec::new();
        for (origin, watches) in origins {
            for watch in watches {
                if taken.insert((watch.pattern.as_str(), watch.domain_id)) {
                    let watch = Arc::clone(watch);
                    entries.push(Entry { watch, origin });
                }
            }
        }
        let watches = entries.iter().map(|entry| Arc::clone(&entry.watch));
        let watchlist = Arc::new(Watchlist::of(watches.collect())?);
        Ok(Self { entries, watchlist })
    }
}

fn has_identity(watch: &Watch, pattern: &str, domain_id: Option<u32>) -> bool {
    watch.pattern == pattern && watch.domain_id == domain_id.map(DomainId)
}

#[cfg(test)]
mod tests {
    use std::sync::Barrier;

    use super::*;
    use crate::agent_facts::SourceKind;
    use crate::settings_cell::Settings;
    use crate::snapshot_cell::SnapshotCell;

    #[test]
    fn of_two_clients_that_add_the_same_watch_only_one_succeeds() {
        let watches = Watches::new(
            Arc::new(LimitFigures::new(Default::default())),
            Arc::new(EventLog::new()),
            Arc::new(SettingsCell::new(Settings::default())),
            Arc::clone(SnapshotCell::new(SourceKind::Host).bell()),
            Vec::new(),
            Vec::new(),
        )
        .unwrap();
        for round in 0..200 {
            let pattern = format!("/topic_{round}");
            let together = Barrier::new(2);
            let added = std::thread::scope(|scope| {
                let add = |per_subscriber| {
                    let (watches, pattern, together) = (&watches, &pattern, &together);
                    scope.spawn(move || {
                        let watch = Watch {
                            per_subscriber,
                            ..Watch::named(pattern).unwrap()
                        };
                        together.wait();
                        matches!(watches.add(watch), Ok(AddOutcome::Added))
                    })
                };
                let threads = [add(true), add(false)];
                threads.map(|thread| thread.join().unwrap())
            });
            assert!(added[0] != added[1], "round {round}: {added:?}");
            watches.remove(&pattern, None).unwrap();
        }
    }
}
