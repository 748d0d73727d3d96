//! Finds the processes that use a library, and the library files that they map.
//!
//! The broker reads the maps of new processes in every round, of older ones occasionally: a
//! library may be loaded late. It reads no process memory.

use std::collections::{BTreeSet, HashMap, HashSet};
use std::fs;

use ros2probe_attach::client::{Broker, BrokerError};
use ros2probe_attach::functions::Library;
use ros2probe_attach::mapped::{self, Mapped};

use crate::mappings::NewMappings;
use crate::shm::directories::Scope;
use crate::tables::MappedLibraries;
use ros2probe_model::facts::bounded::Bounded;

/// File that lists the holders of locks.
const LOCKS_PATH: &str = "/proc/locks";
/// Number of rounds in which a new process may still be loading libraries. Afterwards it is
/// inspected only once in [`MAX_QUIET_ROUNDS`] rounds.
const LOADING_ROUNDS: u32 = 10;
const MAX_QUIET_ROUNDS: u32 = 32;

/// Files of the library, and of Fast DDS's shared memory, that a process maps.
#[derive(Clone, Default, PartialEq, Eq, Debug)]
pub struct Use {
    /// Files of the library.
    pub libraries: Bounded<MappedLibraries, Vec<Mapped>>,
    /// Whether it maps files of Fast DDS's shared memory.
    pub shares: bool,
}

/// All inspected processes.
#[derive(Debug)]
pub struct Processes {
    scope: Scope,
    library: Library,
    known: HashMap<u32, Process>,
}

#[derive(Debug)]
struct Process {
    rounds: u32,
    library_use: Use,
    /// Whether its maps cannot be read for lack of permission.
    is_closed: bool,
}

impl From<mapped::Use> for Use {
    fn from(used: mapped::Use) -> Self {
        let mut libraries = Bounded::<MappedLibraries, Vec<Mapped>>::default();
        for library in used.libraries {
            libraries.push(library);
        }
        Self {
            libraries,
            shares: used.shares,
        }
    }
}

impl Use {
    /// Returns whether the process uses the library at all.
    #[must_use]
    pub fn is_any(&self) -> bool {
        self.shares || !self.libraries.is_empty()
    }
}

impl Processes {
    /// Creates an empty set.
    #[must_use]
    pub fn new(scope: Scope, library: Library) -> Self {
        Self {
            scope,
            library,
            known: HashMap::new(),
        }
    }

    /// Creates a set with one process.
    #[cfg(test)]
    pub(crate) fn of(process: u32, use_of_it: Use) -> Self {
        let known = Process {
            rounds: 1,
            library_use: use_of_it,
            is_closed: false,
        };
        Self {
            scope: Scope::Directories(Vec::new()),
            library: Library::FastDds,
            known: HashMap::from([(process, known)]),
        }
    }

    /// Inspects processes. With `all`, includes processes that did not use the library so far.
    ///
    /// # Errors
    /// Fails if the broker cannot be reached. The result of the last call then stays.
    pub fn find(&mut self, all: bool, broker: &mut Broker) -> Result<(), BrokerError> {
        let in_scope = self.in_scope(broker)?;
        let is_asked = |pid: &u32| {
            self.known.get(pid).is_none_or(|known| {
                known.rounds <= LOADING_ROUNDS
                    || known.rounds % MAX_QUIET_ROUNDS == pid % MAX_QUIET_ROUNDS
                    || all && !known.library_use.is_any()
            })
        };
        let asked: Vec<_> = in_scope.iter().copied().filter(is_asked).collect();
        let users = broker.users(self.library, &asked)?;
        let mut before = std::mem::take(&mut self.known);
        let asked: HashSet<_> = asked.into_iter().collect();
        let mut used: HashMap<_, _> = users.used.into_iter().collect();
        let closed: HashSet<_> = users.closed.into_iter().collect();
        for pid in in_scope {
            let known = before.remove(&pid);
            let met = known.as_ref().map_or(0, |known| known.rounds);
            let mut process = match known {
                Some(known) if !asked.contains(&pid) => known,
                _ => Process {
                    rounds: met,
                    library_use: used.remove(&pid).map(Use::from).unwrap_or_default(),
                    is_closed: closed.contains(&pid),
                },
            };
            process.rounds = met.saturating_add(1);
            self.known.insert(pid, process);
        }
        Ok(())
    }

    /// Inspects processes that have just mapped a library, if they are in scope.
    ///
    /// # Errors
    /// Fails if the broker cannot be reached.
    fn inspect(&mut self, pids: &BTreeSet<u32>, broker: &mut Broker) -> Result<(), BrokerError> {
        let mut pids: Vec<_> = pids.iter().copied().collect();
        if !matches!(self.scope, Scope::AllProcesses) {
            let in_scope = self.in_scope(broker)?;
            pids.retain(|pid| in_scope.contains(pid));
        }
        if pids.is_empty() {
            return Ok(());
        }
        for (pid, used) in broker.users(self.library, &pids)?.used {
            let process = Process {
                // The process may load further libraries.
                rounds: 0,
                library_use: used.into(),
                is_closed: false,
            };
            self.known.insert(pid, process);
        }
        Ok(())
    }

    /// Inspects processes that have mapped a library, and all processes if records were lost.
    ///
    /// # Errors
    /// Fails if the broker cannot be reached.
    pub(crate) fn inspect_mapped(
        &mut self,
        new: &NewMappings,
        broker: &mut Broker,
    ) -> Result<(), BrokerError> {
        if new.is_incomplete {
            self.find(true, broker)?;
        }
        if new.processes.is_empty() {
            return Ok(());
        }
        self.inspect(&new.processes, broker)
    }

    /// Returns whether any of these processes is in scope.
    #[must_use]
    pub(crate) fn are_in_scope(&self, pids: &BTreeSet<u32>) -> bool {
        match &self.scope {
            Scope::AllProcesses | Scope::Networks(_) => !pids.is_empty(),
            scope => scope.processes().iter().any(|pid| pids.contains(pid)),
        }
    }

    /// Returns the processes in scope. The agent itself cannot see processes of other users.
    fn in_scope(&self, broker: &mut Broker) -> Result<Vec<u32>, BrokerError> {
        match &self.scope {
            Scope::AllProcesses | Scope::Networks(_) => broker.processes(),
            scope => Ok(scope.processes().to_vec()),
        }
    }

    /// Iterates over the processes that use the library.
    pub fn using(&self) -> impl Iterator<Item = (u32, &Use)> {
        self.known
            .iter()
            .filter(|(_, process)| process.library_use.is_any())
            .map(|(pid, process)| (*pid, &process.library_use))
    }

    /// Returns a process that cannot be inspected and may use Fast DDS, because it holds a lock of
    /// the kind that Fast DDS takes. Without a list of locks, every such process may use Fast DDS.
    #[must_use]
    pub fn closed(&self) -> Option<u32> {
        let mut closed = self.known.iter().filter(|(_, process)| process.is_closed);
        let first = closed.clone().next().map(|(pid, _)| *pid)?;
        let Ok(locks) = fs::read_to_string(LOCKS_PATH) else {
            return Some(first);
        };
        let holders: HashSet<u32> = locks.lines().filter_map(holder).collect();
        closed
            .find(|(pid, _)| holders.contains(pid))
            .map(|(pid, _)| *pid)
    }
}

/// Returns the holder of the lock in a line of [`LOCKS_PATH`], if Fast DDS takes this kind for its
/// ports and segments.
fn holder(line: &str) -> Option<u32> {
    let mut fields = line.split_ascii_whitespace().skip(1);
    // An arrow precedes a lock that a process waits for.
    let kind = fields.find(|field| *field != "->")?;
    (kind == "FLOCK").then(|| fields.nth(2)?.parse().ok())?
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tables::tests::assert_driven;
    use ros2probe_attach::mapped::LibraryId;

    #[test]
    fn a_process_with_too_many_libraries_keeps_the_first_ones() {
        let libraries = (1..=1000).map(|inode| Mapped {
            id: LibraryId {
                device: "fe:00".to_owned(),
                inode,
            },
            path: "/libfastdds.so".into(),
            range: String::new(),
        });
        let libraries = libraries.collect();
        let found = Use::from(mapped::Use {
            libraries,
            shares: false,
        });
        assert_driven::<MappedLibraries>();
        assert_eq!(
            found.libraries.last().unwrap().id.inode,
            MappedLibraries::CAP as u64
        );
        assert_eq!(MappedLibraries::CAP, mapped::MAX_LIBRARIES);
    }

    #[test]
    fn the_holder_of_a_file_lock_is_parsed() {
        assert_eq!(
            holder("1: FLOCK  ADVISORY  WRITE 4711 00:1a:5 0 EOF"),
            Some(4711)
        );
        assert_eq!(
            holder("2: -> FLOCK  ADVISORY  WRITE 12 00:1a:5 0 EOF"),
            Some(12)
        );
        for other in ["3: POSIX  ADVISORY  WRITE 7 00:1a:5 0 EOF", "4: FLOCK", ""] {
            assert_eq!(holder(other), None);
        }
    }

    #[test]
    fn this_process_is_found_and_does_not_use_fast_dds() {
        let mut processes = Processes::new(Scope::AllProcesses, Library::FastDds);
        processes.find(true, &mut Broker::here()).unwrap();
        let own = std::process::id();
        assert!(processes.known.contains_key(&own));
        assert!(processes.using().all(|(pid, _)| pid != own));
    }
}
