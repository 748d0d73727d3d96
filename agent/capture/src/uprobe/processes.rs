//! Finds the processes that use a library, and the files of it.
//!
//! Reads `/proc/<pid>/maps` of new processes, of young ones for a while, and of the others
//! occasionally: a library may be loaded late. Reads no process memory.

use std::collections::{BTreeSet, HashMap, HashSet};
use std::fs::{self, File};
use std::io::{self, Read as _};
use std::path::PathBuf;

use crate::shm::directories::Scope;
use crate::tables::MappedLibraries;
use ros2probe_model::bounded::Bounded;

/// Names of the library: Fast DDS 2.x, 3.x. A version may follow.
const LIBRARIES: [&str; 2] = ["libfastrtps.so", "libfastdds.so"];
/// Files of its shared memory, which every sender and receiver maps, even if it is linked
/// statically.
const SHARED: [&str; 2] = ["/dev/shm/fastrtps_", "/dev/shm/fastdds_"];
/// Suffix of a replaced or removed file.
const DELETED: &str = " (deleted)";
/// File that lists the holders of locks.
const LOCKS: &str = "/proc/locks";
/// Most bytes read of one process's map: some forty thousand mappings.
const MAX_TEXT: u64 = 4 << 20;
/// Number of rounds in which a new process may still be loading libraries; afterwards it is
/// inspected only once per so many rounds.
const LOADING_ROUNDS: u32 = 10;
const ROUNDS: u32 = 32;

/// Device and inode of a library's file, as in the processes' maps.
#[derive(Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub struct LibraryId {
    /// `major:minor`, as the kernel writes it.
    pub device: String,
    /// Inode of the file.
    pub inode: u64,
}

/// A library in a process.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Mapped {
    /// Identity of the file.
    pub id: LibraryId,
    /// Its path in the process's own file system.
    pub path: PathBuf,
    /// Its first address range, as the kernel writes it.
    pub range: String,
}

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
    is_library: fn(&str) -> bool,
    known: HashMap<u32, Process>,
}

#[derive(Debug)]
struct Process {
    met: u32,
    use_of_it: Use,
    /// Its map cannot be read for lack of permission.
    is_closed: bool,
}

impl Use {
    /// Parses the text of a map. `is_library`: whether a file of this name is the library.
    #[must_use]
    pub fn parse(text: &str, is_library: fn(&str) -> bool) -> Self {
        let mut found = Self::default();
        for line in text.lines() {
            // Range, permissions, offset, device, inode; the rest is the path.
            let Some(path) = line.find('/').and_then(|at| line.get(at..)) else {
                continue;
            };
            found.shares |= SHARED.iter().any(|start| path.starts_with(start));
            let name = path.rsplit('/').next().unwrap_or_default();
            let is_library = is_library(name.strip_suffix(DELETED).unwrap_or(name));
            let mut fields = line.split_ascii_whitespace();
            let (range, device, inode) = (fields.next(), fields.nth(2), fields.next());
            let inode = inode.and_then(|inode| inode.parse().ok());
            if let (true, Some(range), Some(device), Some(inode)) =
                (is_library, range, device, inode)
            {
                let device = device.to_owned();
                let id = LibraryId { device, inode };
                if found.libraries.iter().all(|known| known.id != id) {
                    let (path, range) = (PathBuf::from(path), range.to_owned());
                    found.libraries.push(Mapped { id, path, range });
                }
            }
        }
        found
    }

    fn read(process: u32, is_library: fn(&str) -> bool) -> io::Result<Self> {
        let mut bytes = Vec::new();
        let file = File::open(format!("/proc/{process}/maps"))?;
        file.take(MAX_TEXT).read_to_end(&mut bytes)?;
        Ok(Self::parse(&String::from_utf8_lossy(&bytes), is_library))
    }

    /// Returns whether the process uses Fast DDS at all.
    #[must_use]
    pub fn is_any(&self) -> bool {
        self.shares || !self.libraries.is_empty()
    }
}

impl Processes {
    /// Creates an empty set. `is_library`: whether a file of this name is the library.
    #[must_use]
    pub fn new(scope: Scope, is_library: fn(&str) -> bool) -> Self {
        Self {
            scope,
            is_library,
            known: HashMap::new(),
        }
    }

    /// Creates a set with one process.
    #[cfg(test)]
    pub(super) fn of(process: u32, use_of_it: Use) -> Self {
        let known = Process {
            met: 1,
            use_of_it,
            is_closed: false,
        };
        Self {
            scope: Scope::Directories(Vec::new()),
            is_library,
            known: HashMap::from([(process, known)]),
        }
    }

    /// Visits processes. `all`: includes those that recently did not use Fast DDS.
    pub fn find(&mut self, all: bool) {
        let mut before = std::mem::take(&mut self.known);
        for pid in self.scope.processes() {
            let known = before.remove(&pid);
            let met = known.as_ref().map_or(0, |known| known.met);
            let is_asked = met <= LOADING_ROUNDS
                || met % ROUNDS == pid % ROUNDS
                || all
                    && known
                        .as_ref()
                        .is_some_and(|known| !known.use_of_it.is_any());
            let mut process = match known {
                Some(known) if !is_asked => known,
                _ => match Use::read(pid, self.is_library) {
                    Ok(use_of_it) => Process {
                        met,
                        use_of_it,
                        is_closed: false,
                    },
                    Err(error) => Process {
                        met,
                        use_of_it: Use::default(),
                        is_closed: error.kind() == io::ErrorKind::PermissionDenied,
                    },
                },
            };
            process.met = met.saturating_add(1);
            self.known.insert(pid, process);
        }
    }

    /// Visits processes that have just mapped a library, if they are in scope.
    pub fn inspect(&mut self, pids: &BTreeSet<u32>) {
        let is_in_scope: Box<dyn Fn(&u32) -> bool> = match &self.scope {
            Scope::AllProcesses => Box::new(|_| true),
            scope => {
                let processes = scope.processes();
                Box::new(move |pid| processes.contains(pid))
            }
        };
        for pid in pids.iter().filter(|pid| is_in_scope(pid)) {
            if let Ok(use_of_it) = Use::read(*pid, self.is_library) {
                let process = Process {
                    // It may load further libraries.
                    met: 0,
                    use_of_it,
                    is_closed: false,
                };
                self.known.insert(*pid, process);
            }
        }
    }

    /// Iterates over the processes that use Fast DDS.
    pub fn using(&self) -> impl Iterator<Item = (u32, &Use)> {
        self.known
            .iter()
            .filter(|(_, process)| process.use_of_it.is_any())
            .map(|(pid, process)| (*pid, &process.use_of_it))
    }

    /// Returns a process that cannot be inspected and may use Fast DDS, because it holds one of its
    /// locks. Without a list of locks, every such process may use it.
    #[must_use]
    pub fn closed(&self) -> Option<u32> {
        let mut closed = self.known.iter().filter(|(_, process)| process.is_closed);
        let first = closed.clone().next().map(|(pid, _)| *pid)?;
        let Ok(locks) = fs::read_to_string(LOCKS) else {
            return Some(first);
        };
        let holders: HashSet<u32> = locks.lines().filter_map(holder).collect();
        closed
            .find(|(pid, _)| holders.contains(pid))
            .map(|(pid, _)| *pid)
    }
}

/// Returns whether a file of this name is Fast DDS's library.
#[must_use]
pub fn is_library(name: &str) -> bool {
    LIBRARIES.iter().any(|library| is_version_of(library, name))
}

/// Returns whether a file of this name is the library, or a version of it.
pub(crate) fn is_version_of(library: &str, name: &str) -> bool {
    let version = name.strip_prefix(library);
    version.is_some_and(|rest| rest.is_empty() || rest.starts_with('.'))
}

/// Returns the holder of the lock in a line of [`LOCKS`], if Fast DDS takes this kind for its ports
/// and segments.
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

    #[test]
    fn libraries_and_shared_memory_are_found_in_a_map() {
        let text = "\
563200000000-563200001000 r--p 00000000 fe:00 11   /usr/bin/talker
7f3da9800000-7f3da9a00000 r--p 00000000 fe:00 1234 /usr/lib/x86_64-linux-gnu/libfastrtps.so.2.9.1
7f3da9a00000-7f3da9f00000 r-xp 00200000 fe:00 1234 /usr/lib/x86_64-linux-gnu/libfastrtps.so.2.9.1
7f3daa000000-7f3daa100000 r-xp 00000000 00:2b 77   /opt/my robot/libfastdds.so
7f3daa200000-7f3daa300000 r-xp 00000000 fe:00 9    /usr/lib/libfastrtps.so.2.6 (deleted)
7f3dab000000-7f3dab100000 rw-s 00000000 00:1a 5    /dev/shm/fastrtps_0011aabbccddeeff
7f3dac000000-7f3dac100000 rw-p 00000000 00:00 0    [heap]
";
        let found = Use::parse(text, is_library);
        let libraries: Vec<_> = found
            .libraries
            .iter()
            .map(|library| {
                (
                    &library.range[..12],
                    library.id.inode,
                    library.path.to_str().unwrap(),
                )
            })
            .collect();
        assert_eq!(
            libraries,
            [
                (
                    "7f3da9800000",
                    1234,
                    "/usr/lib/x86_64-linux-gnu/libfastrtps.so.2.9.1"
                ),
                ("7f3daa000000", 77, "/opt/my robot/libfastdds.so"),
                ("7f3daa200000", 9, "/usr/lib/libfastrtps.so.2.6 (deleted)"),
            ]
        );
        assert!(found.shares && found.is_any());
    }

    #[test]
    fn what_only_looks_alike_is_left_alone() {
        for path in [
            "/usr/lib/libfastrtpsx.so.2",
            "/usr/lib/librmw_fastrtps_cpp.so",
            "/usr/lib/libfastrtps.sock",
            "/dev/shm/other",
            "[vdso]",
            "",
        ] {
            let line = format!("7f0000000000-7f0000001000 r-xp 00000000 fe:00 1 {path}\n");
            assert!(!Use::parse(&line, is_library).is_any(), "{path}");
        }
        let nonsense = "nonsense /usr/lib/libfastdds.so";
        assert!(!Use::parse(nonsense, is_library).is_any());
    }

    #[test]
    fn of_a_process_with_too_many_libraries_the_first_ones_are_known() {
        let line = |inode| {
            format!("7f0000000000-7f0000001000 r-xp 00000000 fe:00 {inode} /libfastdds.so\n")
        };
        let text: String = (1..=1000).map(line).collect();
        let found = Use::parse(&text, is_library);
        assert_driven::<MappedLibraries>();
        assert_eq!(
            found.libraries.last().unwrap().id.inode,
            MappedLibraries::CAP as u64
        );
    }

    #[test]
    fn holders_of_locks_are_read() {
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
    fn this_process_is_met_and_uses_none_of_it() {
        let mut processes = Processes::new(Scope::AllProcesses, is_library);
        processes.find(true);
        let own = std::process::id();
        assert!(processes.known.contains_key(&own));
        assert!(processes.using().all(|(pid, _)| pid != own));
    }
}
