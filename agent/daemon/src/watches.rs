//! All that is watched: what the configuration lists, what the command line adds, and what clients
//! add and remove while the agent runs.
//!
//! One entry for each pattern and domain; the configuration's comes first. The capture thread is
//! handed the merged list in a slot that holds the latest one, and is woken. No thread waits for it.

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

/// Who asked for a watch.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Origin {
    /// The configuration file.
    Config,
    /// `--watch`.
    CommandLine,
    /// A client of the API.
    Api,
}

/// One watch in force.
#[derive(Clone, Debug)]
pub struct Entry {
    /// What is watched.
    pub watch: Arc<Watch>,
    /// On whose behalf.
    pub origin: Origin,
}

/// What is in force, immutable.
#[derive(Clone, Debug, Default)]
pub struct InForce {
    entries: Vec<Entry>,
    watchlist: Arc<Watchlist>,
}

/// What became of a watch that was asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Done {
    /// It was not there before.
    Added,
    /// It was there, with other settings.
    Replaced,
    /// It was there just so.
    Unchanged,
}

/// Why the list of watches stays as it is.
#[derive(Debug, thiserror::Error)]
pub enum Refused {
    /// Listed by the configuration or the command line, which a client does not overrule.
    #[error("it is defined by {}", by.phrase())]
    Given {
        /// Which of them.
        by: Origin,
    },
    /// A client added it with other settings.
    #[error("it is watched already, with other settings")]
    Different,
    /// No such watch.
    #[error("it is not watched")]
    Unknown,
    /// There would be more than may be.
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
    in_force: ArcSwap<InForce>,
    /// For the capture thread: the latest list it has not taken yet.
    news: ArcSwapOption<Watchlist>,
    limits: Arc<LimitFigures>,
    events: Arc<EventLog>,
    shown: Arc<SettingsCell>,
    bell: Arc<CaptureBell>,
    keeper: OnceLock<WatchWriter>,
}

#[derive(Clone, Debug, Default)]
struct Lists {
    configured: Vec<Arc<Watch>>,
    command_line: Vec<Arc<Watch>>,
    added: Vec<Arc<Watch>>,
}

impl Origin {
    /// As clients see it.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Config => "config",
            Self::CommandLine => "command_line",
            Self::Api => "api",
        }
    }

    /// As in a sentence.
    #[must_use]
    pub const fn phrase(self) -> &'static str {
        match self {
            Self::Config => "the configuration file",
            Self::CommandLine => "the command line",
            Self::Api => "a client of the API",
        }
    }
}

impl InForce {
    /// Each watch: of the configuration, of the command line, of clients in the order they came.
    #[must_use]
    pub fn entries(&self) -> &[Entry] {
        &self.entries
    }

    /// The watches alone.
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

    /// The watch with this pattern for this domain.
    #[must_use]
    pub fn find(&self, pattern: &str, domain_id: Option<u32>) -> Option<&Entry> {
        let place = self.watchlist.position(pattern, domain_id.map(DomainId))?;
        self.entries.get(place)
    }
}

impl Watches {
    /// What the configuration and the command line list.
    ///
    /// # Errors
    /// They are too many, or their globs are too many.
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
            in_force: ArcSwap::default(),
            news: ArcSwapOption::default(),
            limits,
            events,
            shown,
            bell,
            keeper: OnceLock::new(),
        };
        let lists = Lists {
            configured: configured.into_iter().map(Arc::new).collect(),
            command_line: command_line.into_iter().map(Arc::new).collect(),
            added: Vec::new(),
        };
        watches.change(|old, _| {
            *old = lists;
            Ok(Done::Added)
        })?;
        Ok(watches)
    }

    /// Watches again what clients had added before the last agent ended; how many of them are left
    /// out, for want of room.
    ///
    /// # Errors
    /// The globs are too many; then nothing changes.
    pub fn restore(&self, watches: Vec<Watch>) -> Result<usize, Refused> {
        let in_force = self.in_force();
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
            Ok(Done::Added)
        })?;
        Ok(left_out)
    }

    /// Keeps what clients add from now on in this directory.
    ///
    /// # Errors
    /// No thread is to be had for it.
    pub fn keep_in(&self, directory: Arc<StateDirectory>) -> io::Result<()> {
        let keeper = WatchWriter::start(directory)?;
        // Only the first one would ever be asked for.
        let _ = self.keeper.set(keeper);
        Ok(())
    }

    /// Whether what clients add outlives the agent: kept somewhere, and the last write worked.
    #[must_use]
    pub fn is_kept(&self) -> bool {
        self.keeper.get().is_some_and(WatchWriter::works)
    }

    /// Waits until what clients have added is on disk, when the agent ends.
    pub fn finish(&self) {
        if let Some(keeper) = self.keeper.get() {
            keeper.finish();
        }
    }

    /// The configuration lists these now; what else is watched stays.
    ///
    /// # Errors
    /// With what else is watched they are too many, or their globs are too many;
    /// then nothing changes.
    pub fn configure(&self, watches: Vec<Watch>) -> Result<(), Refused> {
        self.change(|lists, _| {
            lists.configured = watches.into_iter().map(Arc::new).collect();
            Ok(Done::Replaced)
        })?;
        Ok(())
    }

    /// Watches this too, unless it is watched already.
    ///
    /// # Errors
    /// It is watched with other settings, or there is no room.
    pub fn add(&self, watch: Watch) -> Result<Done, Refused> {
        self.put(watch, false)
    }

    /// Watches this too, in place of what a client has asked for before.
    ///
    /// # Errors
    /// The configuration lists it with other settings, or there is no room.
    pub fn replace(&self, watch: Watch) -> Result<Done, Refused> {
        self.put(watch, true)
    }

    /// Watches what a client has added no longer.
    ///
    /// # Errors
    /// There is no such watch, or it is not a client's.
    pub fn remove(&self, pattern: &str, domain_id: Option<u32>) -> Result<(), Refused> {
        self.change(|lists, in_force| {
            match in_force.find(pattern, domain_id) {
                None => return Err(Refused::Unknown),
                Some(Entry { origin, .. }) if *origin != Origin::Api => {
                    return Err(Refused::Given { by: *origin });
                }
                Some(_) => {}
            }
            lists
                .added
                .retain(|watch| !is_for(watch, pattern, domain_id));
            Ok(Done::Replaced)
        })?;
        self.events.record(AgentEvent::WatchRemoved {
            watch: pattern.to_owned(),
            domain_id,
        });
        Ok(())
    }

    /// What is in force.
    #[must_use]
    pub fn in_force(&self) -> Arc<InForce> {
        self.in_force.load_full()
    }

    /// For the capture thread: what to watch from now on, when that has changed since the last call.
    #[must_use]
    pub fn take_changed(&self) -> Option<Arc<Watchlist>> {
        self.news.swap(None)
    }

    fn cap(&self) -> usize {
        self.limits.caps().watches
    }

    fn put(&self, watch: Watch, replace: bool) -> Result<Done, Refused> {
        let watch = Arc::new(watch);
        let done = self.change(|lists, in_force| {
            let done = match in_force.find(&watch.pattern, watch.domain_id.map(|id| id.0)) {
                Some(old) if old.watch == watch => return Ok(Done::Unchanged),
                Some(old) if old.origin != Origin::Api => {
                    return Err(Refused::Given { by: old.origin });
                }
                Some(_) if !replace => return Err(Refused::Different),
                Some(_) => Done::Replaced,
                None => Done::Added,
            };
            let same = |other: &&mut Arc<Watch>| {
                is_for(other, &watch.pattern, watch.domain_id.map(|id| id.0))
            };
            if let Some(old) = lists.added.iter_mut().find(same) {
                *old = Arc::clone(&watch);
            } else {
                lists.added.push(Arc::clone(&watch));
            }
            Ok(done)
        })?;
        if done != Done::Unchanged {
            self.events.record(AgentEvent::WatchAdded {
                watch: watch.pattern.clone(),
                domain_id: watch.domain_id.map(|id| id.0),
            });
        }
        Ok(done)
    }

    /// Changes the lists, merges them and hands the outcome to whom it concerns; on an error, and
    /// with [`Done::Unchanged`], nothing changes. `change` sees what is in force and decides under the
    /// lock: of two clients that ask at once, one comes second.
    fn change(
        &self,
        change: impl FnOnce(&mut Lists, &InForce) -> Result<Done, Refused>,
    ) -> Result<Done, Refused> {
        let mut lists = self.lists.lock().unwrap_or_else(PoisonError::into_inner);
        let mut new = lists.clone();
        let done = change(&mut new, &self.in_force())?;
        if done == Done::Unchanged {
            return Ok(done);
        }
        let merged = InForce::merge(&new)?;
        let (count, cap) = (merged.entries.len(), self.cap());
        if count > cap {
            self.limits.reached(Limit::Watches, count - cap);
            return Err(Refused::Full(cap));
        }
        self.limits.set_used(Limit::Watches, count);
        if new.added != lists.added
            && let Some(keeper) = self.keeper.get()
        {
            keeper.keep(new.added.clone());
        }
        *lists = new;
        self.news.store(Some(Arc::clone(&merged.watchlist)));
        self.shown.watch(merged.watchlist.watches());
        self.in_force.store(Arc::new(merged));
        drop(lists);
        self.bell.ring();
        Ok(done)
    }
}

impl InForce {
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

fn is_for(watch: &Watch, pattern: &str, domain_id: Option<u32>) -> bool {
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
    fn of_two_clients_that_add_the_same_watch_at_once_one_comes_second() {
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
                        matches!(watches.add(watch), Ok(Done::Added))
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
