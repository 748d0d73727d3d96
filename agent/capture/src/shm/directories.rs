//! Finds the files of shared memory in every mount namespace of the host.
//!
//! Each `/dev/shm` is listed only if it changed; only new processes are inspected for mounts.
//! Everything behind `/proc/<pid>/root` is untrusted, so links are not followed there.

use std::collections::{HashMap, HashSet};
use std::fs::{self, File, Metadata};
use std::os::unix::fs::{DirEntryExt as _, FileExt as _, MetadataExt as _};
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use super::cell::SegmentId;
use super::owner::{LOCK_SUFFIXES, Locks};
use crate::tables::{Directories, DirectoryFiles, ScopeProcesses};
use ros2probe_model::facts::bounded::Bounded;

/// Directory of shared memory.
const SHARED_MEMORY: &str = "/dev/shm";
/// Prefixes of file names: Fast DDS 2.x, 3.x.
const FILE_PREFIXES: [&str; 2] = ["fastrtps_", "fastdds_"];
/// Maximum number of entries read per directory.
const MAX_LISTED: usize = 65_536;
/// Granularity of directory timestamps: a directory that changed more recently may change again
/// without a new timestamp.
const TIMESTAMP_GRANULARITY: Duration = Duration::from_secs(1);
/// Number of rounds in which a new process may still be mounting directories. Afterwards it is
/// inspected only once in [`MAX_QUIET_ROUNDS`] rounds.
const MOUNTING_ROUNDS: u32 = 5;
const MAX_QUIET_ROUNDS: u32 = 32;
/// Maximum number of levels of cgroups that are read.
const MAX_DEPTH: usize = 8;
/// Number of rounds in which a new process may still move to a cgroup in scope.
const MOVING_ROUNDS: u32 = 3;
/// Maximum number of rounds that reuse the last list of processes while no process starts.
const MAX_REUSED_ROUNDS: u32 = 5;

/// Device and inode of a directory of shared memory.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub struct ShmDirectoryId {
    device: u64,
    inode: u64,
}

/// A generation of Fast DDS with its own file names: index of its prefix.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub struct Generation(u8);

/// Kind of a file, by its name.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub enum Name {
    /// A port and its number.
    Port(Generation, u32),
    /// A segment and its id.
    Segment(Generation, SegmentId),
}

/// One directory of shared memory.
#[derive(Debug)]
pub struct ShmDirectory {
    /// A path that currently reaches the directory.
    pub path: PathBuf,
    /// Files by name, with their inodes.
    pub files: Bounded<DirectoryFiles, HashMap<Name, u64>>,
    changed: Option<SystemTime>,
    seen: bool,
}

/// Scope of the observed shared memory.
#[derive(Clone, PartialEq, Eq, Debug)]
pub enum Scope {
    /// Directories of the agent and of every process.
    AllProcesses,
    /// Directories of the processes of this cgroup and those below it.
    Cgroup(PathBuf),
    /// Directories of the agent and of processes in these network namespaces.
    Networks(Vec<PathBuf>),
    /// Exactly these directories.
    Directories(Vec<PathBuf>),
}

/// The directories in scope.
#[derive(Debug)]
pub struct ShmDirectories {
    scope: Scope,
    /// Inodes of the network namespaces, if they are the scope.
    networks: Vec<u64>,
    /// Directories by identity.
    pub directories: Bounded<Directories, HashMap<ShmDirectoryId, ShmDirectory>>,
    /// The processes in scope when they were last listed.
    listed: Bounded<ScopeProcesses, Vec<u32>>,
    newest: NewestProcess,
    /// Inspected processes with their directory and the number of inspections.
    processes: HashMap<u32, (Option<ShmDirectoryId>, u32)>,
    /// Whether a process may still be mounting directories.
    is_mounting: bool,
    /// Directories and files skipped because of a cap.
    pub left_out: u64,
}

impl Scope {
    /// Returns the processes in scope; none for a list of directories.
    #[must_use]
    pub fn processes(&self) -> Bounded<ScopeProcesses, Vec<u32>> {
        match self {
            Self::AllProcesses | Self::Networks(_) => all_processes(),
            Self::Cgroup(cgroup) => {
                let mut processes = Bounded::default();
                processes_of(cgroup, MAX_DEPTH, &mut processes);
                processes
            }
            Self::Directories(_) => Bounded::default(),
        }
    }
}

impl Name {
    /// Parses a file's name; `None` for files that are not read.
    #[must_use]
    pub fn parse(name: &str) -> Option<Self> {
        let (generation, rest) = (0_u8..)
            .zip(FILE_PREFIXES)
            .find_map(|(index, prefix)| Some((Generation(index), name.strip_prefix(prefix)?)))?;
        if let Some(number) = rest.strip_prefix("port") {
            let is_number = !number.is_empty() && number.bytes().all(|b| b.is_ascii_digit());
            let number = number.parse().ok().filter(|_| is_number)?;
            return Some(Self::Port(generation, number));
        }
        let bytes = rest.as_bytes();
        let mut id = [0; 8];
        let is_id =
            bytes.len() == 16 && bytes.iter().all(|b| matches!(b, b'0'..=b'9' | b'a'..=b'f'));
        let (pairs, _) = bytes.as_chunks::<2>();
        for (byte, [high, low]) in id.iter_mut().zip(pairs.iter().filter(|_| is_id)) {
            let digit = |digit: u8| char::from(digit).to_digit(16).unwrap_or(0) as u8;
            *byte = digit(*high) << 4 | digit(*low);
        }
        is_id.then_some(Self::Segment(generation, SegmentId(id)))
    }

    /// Returns the file that this lock file protects; `None` if it is not a lock file.
    fn of_lock(name: &str) -> Option<Self> {
        let suffix = |suffix: &&str| name.strip_suffix(*suffix).and_then(Self::parse);
        LOCK_SUFFIXES.iter().find_map(suffix)
    }

    /// Returns the file's name.
    #[must_use]
    pub fn file_name(&self) -> String {
        let prefix = |generation: &Generation| {
            let prefix = FILE_PREFIXES.get(usize::from(generation.0));
            prefix.copied().unwrap_or_default()
        };
        match self {
            Self::Port(generation, number) => format!("{}port{number}", prefix(generation)),
            Self::Segment(generation, id) => format!("{}{id}", prefix(generation)),
        }
    }
}

impl ShmDirectories {
    /// Creates an empty set.
    #[must_use]
    pub fn new(scope: Scope) -> Self {
        let networks = match &scope {
            Scope::Networks(paths) => paths.iter().filter_map(|path| inode(path)).collect(),
            _ => Vec::new(),
        };
        Self {
            scope,
            networks,
            directories: Bounded::default(),
            listed: Bounded::default(),
            newest: NewestProcess::default(),
            processes: HashMap::new(),
            is_mounting: false,
            left_out: 0,
        }
    }

    /// Finds the directories of shared memory as [`Self::find`] does, if a process may be new.
    /// Otherwise, a directory whose path led through an ended process may be missed for some
    /// rounds.
    pub fn find_new(&mut self) {
        self.newest.look();
        if self.newest.must_list || self.is_mounting || matches!(self.scope, Scope::Directories(_))
        {
            self.inspect_scope();
        }
    }

    /// Finds the directories of shared memory, and forgets those that no living process reaches.
    pub fn find(&mut self) {
        self.newest.look();
        self.inspect_scope();
    }

    /// Returns whether each directory's path still reaches it. A path may lead through a process
    /// that has ended, while other processes use the directory.
    #[must_use]
    pub fn are_reachable(&self) -> bool {
        let mut directories = self.directories.values();
        directories.all(|directory| directory.path.exists())
    }

    fn inspect_scope(&mut self) {
        for directory in self.directories.values_mut() {
            directory.seen = false;
        }
        match self.scope.clone() {
            Scope::Directories(directories) => {
                for directory in directories {
                    self.find_directory(&directory);
                }
            }
            Scope::Cgroup(_) => self.go_through_processes(),
            Scope::AllProcesses | Scope::Networks(_) => {
                self.find_directory(Path::new(SHARED_MEMORY));
                self.go_through_processes();
            }
        }
        self.directories.retain(|_, directory| directory.seen);
    }

    /// Lists the directories that changed since the last call; returns whether any file changed.
    pub fn list(&mut self) -> bool {
        let mut any = false;
        for directory in self.directories.values_mut() {
            any |= directory.list(&mut self.left_out);
        }
        any
    }

    /// Inspects the processes in scope. They are listed again if there may be new ones.
    fn go_through_processes(&mut self) {
        if self.newest.must_list {
            self.listed = self.scope.processes();
            // The agent itself may be in a cgroup in scope, but has no shared memory.
            if matches!(self.scope, Scope::Cgroup(_)) {
                self.listed.retain(|pid| *pid != std::process::id());
            }
        }
        let processes = std::mem::take(&mut self.listed);
        self.inspect_processes(&processes);
        self.listed = processes;
    }

    fn inspect_processes(&mut self, processes: &[u32]) {
        let before = std::mem::take(&mut self.processes);
        self.is_mounting = false;
        for &pid in processes {
            let (known, met) = before.get(&pid).copied().unwrap_or((None, 0));
            self.is_mounting |= met <= MOUNTING_ROUNDS;
            let is_settled =
                met > MOUNTING_ROUNDS && met % MAX_QUIET_ROUNDS != pid % MAX_QUIET_ROUNDS;
            let directory = match known.and_then(|id| self.directories.get_mut(&id)) {
                // The path of the directory may lead through another process, which may have ended.
                Some(directory) if is_settled && (directory.seen || directory.path.exists()) => {
                    directory.seen = true;
                    known
                }
                None if is_settled => None,
                _ => self.directory_of(pid),
            };
            self.processes
                .insert(pid, (directory, met.saturating_add(1)));
        }
    }

    fn directory_of(&mut self, pid: u32) -> Option<ShmDirectoryId> {
        if matches!(self.scope, Scope::Networks(_)) {
            let network = inode(Path::new(&format!("/proc/{pid}/ns/net")))?;
            if !self.networks.contains(&network) {
                return None;
            }
        }
        let is_directory =
            |path: &Path| fs::symlink_metadata(path).is_ok_and(|metadata| metadata.is_dir());
        let devices = PathBuf::from(format!("/proc/{pid}/root/dev"));
        let within = devices.join("shm");
        let is_plain = is_directory(&devices) && is_directory(&within);
        is_plain.then(|| self.find_directory(&within)).flatten()
    }

    fn find_directory(&mut self, path: &Path) -> Option<ShmDirectoryId> {
        let metadata = fs::metadata(path).ok().filter(Metadata::is_dir)?;
        let id = ShmDirectoryId {
            device: metadata.dev(),
            inode: metadata.ino(),
        };
        if let Some(directory) = self.directories.get_mut(&id) {
            if !directory.seen && directory.path != path && !directory.path.exists() {
                directory.path = path.to_path_buf();
            }
            directory.seen = true;
            return Some(id);
        }
        let directory = ShmDirectory {
            path: path.to_path_buf(),
            files: Bounded::default(),
            changed: None,
            seen: true,
        };
        let is_left_out = self.directories.insert(id, directory).is_some();
        self.left_out += u64::from(is_left_out);
        (!is_left_out).then_some(id)
    }
}

impl ShmDirectory {
    fn list(&mut self, left_out: &mut u64) -> bool {
        let changed = fs::metadata(&self.path).and_then(|metadata| metadata.modified());
        let changed = changed.ok();
        let settled =
            changed.is_some_and(|at| at.elapsed().is_ok_and(|age| age > TIMESTAMP_GRANULARITY));
        if settled && changed == self.changed {
            return false;
        }
        self.changed = changed.filter(|_| settled);
        let known = self.files.take();
        let Ok(entries) = fs::read_dir(&self.path) else {
            // The cause may end without a change of the directory: too many open files.
            self.changed = None;
            return true;
        };
        let (mut files, mut locks) = (Vec::new(), Vec::new());
        let mut entries = entries.flatten();
        for entry in entries.by_ref().take(MAX_LISTED) {
            let is_file = entry.file_type().is_ok_and(|kind| kind.is_file());
            let name = entry.file_name();
            let Some(name) = name.to_str().filter(|_| is_file) else {
                continue;
            };
            if let Some(name) = Name::parse(name) {
                files.push((name, entry.ino()));
            } else if let Some(name) = Name::of_lock(name) {
                locks.push((name, entry.ino()));
            }
        }
        if entries.next().is_some() {
            *left_out += 1;
            files = self.keep_existing(files, known);
        }
        *left_out += files.len().saturating_sub(DirectoryFiles::CAP) as u64;
        if files.len() > DirectoryFiles::CAP {
            files = self.select_files(files, &locks);
        }
        self.files = files.into_iter().collect();
        true
    }

    /// For a partially listed directory, returns the `listed` files and the `known` files that
    /// still exist.
    fn keep_existing(
        &self,
        listed: Vec<(Name, u64)>,
        known: HashMap<Name, u64>,
    ) -> Vec<(Name, u64)> {
        let mut files: HashMap<Name, u64> = listed.into_iter().collect();
        for (name, inode) in known {
            let metadata = || fs::symlink_metadata(self.path.join(name.file_name()));
            let is_same = |metadata: Metadata| metadata.is_file() && metadata.ino() == inode;
            if !files.contains_key(&name) && metadata().is_ok_and(is_same) {
                files.insert(name, inode);
            }
        }
        files.into_iter().collect()
    }

    /// Selects from too many files: first files of living processes, then an equal number per user,
    /// oldest first. No user can hide another's files in this way.
    fn select_files(&self, files: Vec<(Name, u64)>, locks: &[(Name, u64)]) -> Vec<(Name, u64)> {
        let device = fs::metadata(&self.path).map_or(0, |metadata| metadata.dev());
        let held = Locks::read();
        let locks = locks.iter();
        let locks = locks.filter(|(_, inode)| held.is_held(device, *inode) == Some(true));
        let alive: HashSet<Name> = locks.map(|(name, _)| *name).collect();
        let (mut chosen, others) = files
            .into_iter()
            .partition::<Vec<_>, _>(|(name, _)| alive.contains(name));
        if chosen.len() > DirectoryFiles::CAP {
            return self.share_among_users(chosen, DirectoryFiles::CAP);
        }
        chosen.extend(self.share_among_users(others, DirectoryFiles::CAP - chosen.len()));
        chosen
    }

    /// Selects this many files, an equal number per user.
    fn share_among_users(&self, files: Vec<(Name, u64)>, room: usize) -> Vec<(Name, u64)> {
        let files = files.into_iter().filter_map(|(name, inode)| {
            let metadata = fs::symlink_metadata(self.path.join(name.file_name())).ok()?;
            let age = (metadata.ctime(), metadata.ctime_nsec());
            Some((metadata.uid(), age, inode, name))
        });
        let mut files: Vec<_> = files.collect();
        files.sort_unstable_by_key(|(user, age, inode, _)| (*user, *age, *inode));
        let mut taken: HashMap<u32, usize> = HashMap::new();
        let turns = files.into_iter().map(|(user, age, inode, name)| {
            let turn = taken.entry(user).or_default();
            *turn += 1;
            (*turn, age, name, inode)
        });
        let mut turns: Vec<_> = turns.collect();
        turns.sort_unstable_by_key(|(turn, age, _, inode)| (*turn, *age, *inode));
        let chosen = turns.into_iter().take(room);
        chosen.map(|(_, _, name, inode)| (name, inode)).collect()
    }
}

/// Tracks the newest process, so that processes are listed only if there may be new ones.
#[derive(Debug, Default)]
struct NewestProcess {
    /// `/proc/loadavg`, open for further reads.
    file: Option<File>,
    id: Option<u32>,
    /// Whether the next round lists the processes.
    must_list: bool,
    /// Number of rounds since the newest process changed, and since the processes were listed.
    rounds: u32,
    rounds_since_list: u32,
}

impl NewestProcess {
    /// Reads the id of the newest process.
    fn look(&mut self) {
        if self.file.is_none() {
            self.file = File::open("/proc/loadavg").ok();
        }
        let newest = self.file.as_ref().and_then(newest_process);
        self.note(newest);
    }

    /// Decides from the id of the newest process whether the next round lists the processes.
    fn note(&mut self, newest: Option<u32>) {
        let is_new = newest.is_none() || newest != self.id;
        self.id = newest;
        self.rounds = if is_new {
            0
        } else {
            self.rounds.saturating_add(1)
        };
        self.rounds_since_list += 1;
        self.must_list =
            self.rounds <= MOVING_ROUNDS || self.rounds_since_list >= MAX_REUSED_ROUNDS;
        if self.must_list {
            self.rounds_since_list = 0;
        }
    }
}

/// Returns the id of the process or thread created last in this PID namespace or below; `None` if
/// it is unknown. The id is the last word of `/proc/loadavg` (proc_loadavg(5)).
fn newest_process(loadavg: &File) -> Option<u32> {
    let mut line = [0; 128];
    let len = loadavg.read_at(&mut line, 0).ok()?;
    let line = std::str::from_utf8(line.get(..len)?).ok()?;
    line.split_whitespace().last()?.parse().ok()
}

fn inode(path: &Path) -> Option<u64> {
    fs::metadata(path).ok().map(|metadata| metadata.ino())
}

fn all_processes() -> Bounded<ScopeProcesses, Vec<u32>> {
    let entries = fs::read_dir("/proc").into_iter().flatten().flatten();
    let processes = entries.filter_map(|entry| entry.file_name().to_str()?.parse().ok());
    processes.take(ScopeProcesses::CAP).collect()
}

fn processes_of(cgroup: &Path, depth: usize, processes: &mut Bounded<ScopeProcesses, Vec<u32>>) {
    let members = fs::read_to_string(cgroup.join("cgroup.procs")).unwrap_or_default();
    let members = members.lines().filter_map(|line| line.parse::<u32>().ok());
    for process in members {
        if processes.push(process).is_some() {
            return;
        }
    }
    let entries = fs::read_dir(cgroup).into_iter().flatten().flatten();
    for entry in entries.filter(|_| depth > 0) {
        if entry.file_type().is_ok_and(|kind| kind.is_dir()) {
            processes_of(&entry.path(), depth - 1, processes);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tables::tests::assert_driven;

    #[test]
    fn processes_are_listed_after_a_new_process_and_at_intervals() {
        let mut newest = NewestProcess::default();
        let mut lists = |id, rounds: u32| {
            let rounds = (0..rounds).filter(|_| {
                newest.note(id);
                newest.must_list
            });
            rounds.count()
        };
        assert_eq!(lists(Some(7), MOVING_ROUNDS + 1), 4);
        assert_eq!(lists(Some(7), 4 * MAX_REUSED_ROUNDS), 4);
        assert_eq!(lists(Some(8), 1), 1);
        assert_eq!(lists(Some(8), MOVING_ROUNDS), 3);
        // If the id is unknown, the processes are always listed.
        assert_eq!(lists(None, 40), 40);
        newest.look();
        let (file, id) = (newest.file.as_ref().unwrap(), newest.id.unwrap());
        // The id is read again, not remembered.
        std::process::Command::new("true").status().unwrap();
        assert_ne!(newest_process(file).unwrap(), id);
    }

    #[test]
    fn names_of_ports_and_segments_are_parsed_and_formatted() {
        for name in [
            "fastrtps_port7411",
            "fastdds_port7661",
            "fastrtps_0011aabbccddeeff",
            "fastdds_ffffffffffffffff",
        ] {
            assert_eq!(Name::parse(name).unwrap().file_name(), name);
        }
    }

    #[test]
    fn names_of_other_files_are_not_parsed() {
        for name in [
            "fastrtps_port7411_el",
            "fastrtps_port7411_sl",
            "sem.fastrtps_port7411_mutex",
            "fastrtps_0011aabbccddeeff_el",
            "fastrtps_0011AABBCCDDEEFF",
            "fastrtps_0011aabbccddeef",
            "fast_datasharing_0011aabbccddeeff",
            "fastrtps_port",
            "fastrtps_port+7411",
            "fastrtps_port99999999999",
            "fastrtps_",
            "",
        ] {
            assert_eq!(Name::parse(name), None, "{name}");
        }
    }

    #[test]
    fn created_and_removed_files_are_noticed_within_one_tick_of_the_clock() {
        let directory = tempfile::tempdir().unwrap();
        let mut directories =
            ShmDirectories::new(Scope::Directories(vec![directory.path().to_path_buf()]));
        directories.find();
        let port = Name::parse("fastrtps_port7411").unwrap();
        let path = directory.path().join(port.file_name());
        let count = |directories: &ShmDirectories| {
            let files = directories
                .directories
                .values()
                .map(|directory| directory.files.len());
            files.sum::<usize>()
        };
        for _ in 0..20 {
            fs::write(&path, "x").unwrap();
            directories.list();
            assert_eq!(count(&directories), 1);
            fs::remove_file(&path).unwrap();
            directories.list();
            assert_eq!(count(&directories), 0);
        }
        drop(directory);
        directories.find();
        assert!(directories.directories.is_empty());
    }

    #[test]
    fn a_directory_that_could_not_be_read_is_read_again_although_it_did_not_change() {
        let above = tempfile::tempdir().unwrap();
        let (path, aside) = (above.path().join("shm"), above.path().join("aside"));
        let changed = SystemTime::now() - 60 * TIMESTAMP_GRANULARITY;
        let set_changed = || {
            let file = fs::File::open(&path).unwrap();
            file.set_modified(changed).unwrap();
        };
        fs::create_dir(&path).unwrap();
        fs::write(path.join("fastrtps_port7411"), "").unwrap();
        set_changed();
        let mut directories = ShmDirectories::new(Scope::Directories(vec![path.clone()]));
        directories.find();
        // A file has a time of change, but no entries.
        fs::rename(&path, &aside).unwrap();
        fs::write(&path, "").unwrap();
        set_changed();
        assert!(directories.list());
        assert!(files(&directories).is_empty());
        fs::remove_file(&path).unwrap();
        fs::rename(&aside, &path).unwrap();
        set_changed();
        assert!(directories.list());
        assert_eq!(files(&directories).len(), 1);
        assert!(!directories.list());
    }

    fn files(directories: &ShmDirectories) -> HashSet<Name> {
        let files = directories
            .directories
            .values()
            .flat_map(|directory| directory.files.keys());
        files.copied().collect()
    }

    #[test]
    fn files_of_live_processes_are_kept_among_forged_ones_beyond_the_cap() {
        let directory = tempfile::tempdir().unwrap();
        let file = |name: &str| fs::File::create(directory.path().join(name)).unwrap();
        for number in 0..DirectoryFiles::CAP + 500 {
            file(&format!("fastrtps_{number:016x}"));
        }
        let real = ["fastrtps_port7411", "fastrtps_ffffffffffffffff"];
        let locks = real.map(|name| {
            file(name);
            let lock = file(&format!("{name}_el"));
            lock.try_lock().unwrap();
            lock
        });
        for number in 0..DirectoryFiles::CAP + 500 {
            file(&format!("fastrtps_port{}", 20_000 + number));
        }
        let mut directories =
            ShmDirectories::new(Scope::Directories(vec![directory.path().to_path_buf()]));
        directories.find();
        directories.list();
        let found = files(&directories);
        assert_eq!(found.len(), DirectoryFiles::CAP);
        for name in real {
            assert!(found.contains(&Name::parse(name).unwrap()), "{name}");
        }
        assert!(directories.left_out > 0);
        assert_driven::<DirectoryFiles>();
        drop(locks);
    }

    #[test]
    fn directories_beyond_the_cap_are_left_out_and_counted() {
        let above = tempfile::tempdir().unwrap();
        let paths = (0..70).map(|number| above.path().join(number.to_string()));
        let paths: Vec<_> = paths
            .inspect(|path| fs::create_dir(path).unwrap())
            .collect();
        let mut directories = ShmDirectories::new(Scope::Directories(paths));
        directories.find();
        assert_driven::<Directories>();
        assert_eq!(directories.left_out, 70 - Directories::CAP as u64);
    }

    #[test]
    fn processes_of_a_control_group_beyond_the_cap_are_not_inspected() {
        let cgroup = tempfile::tempdir().unwrap();
        let list: String = (1..10_000).map(|process| format!("{process}\n")).collect();
        fs::write(cgroup.path().join("cgroup.procs"), list).unwrap();
        let processes = Scope::Cgroup(cgroup.path().to_path_buf()).processes();
        assert_eq!(processes.len(), ScopeProcesses::CAP);
        assert_driven::<ScopeProcesses>();
    }

    #[test]
    fn known_files_stay_in_a_directory_with_more_entries_than_are_read() {
        let directory = tempfile::tempdir_in(SHARED_MEMORY).unwrap();
        let path = |name: &str| directory.path().join(name);
        let flood = |numbers: std::ops::Range<usize>| {
            for number in numbers {
                fs::File::create(path(&format!("fastrtps_{number:016x}"))).unwrap();
            }
        };
        let real = ["fastrtps_port7411", "fastrtps_port7413"];
        let make = |name: &str| {
            fs::File::create(path(name)).unwrap();
            std::os::unix::fs::chown(path(name), Some(64_123), None).unwrap();
        };
        let mut directories =
            ShmDirectories::new(Scope::Directories(vec![directory.path().to_path_buf()]));
        directories.find();
        // The files are found in either order in which the file system lists the directory.
        make(real[0]);
        flood(0..MAX_LISTED - real.len());
        make(real[1]);
        directories.list();
        assert_eq!(
            directories.left_out,
            (MAX_LISTED - DirectoryFiles::CAP) as u64
        );
        let has_real = |directories: &ShmDirectories| {
            let found = files(directories);
            assert_eq!(found.len(), DirectoryFiles::CAP);
            real.map(|name| found.contains(&Name::parse(name).unwrap()))
        };
        assert_eq!(has_real(&directories), [true; 2]);
        flood(MAX_LISTED..MAX_LISTED + 2 * DirectoryFiles::CAP);
        directories.left_out = 0;
        directories.list();
        // One is counted for all unread entries, and one for each file beyond the cap.
        let left_out = usize::try_from(directories.left_out).unwrap();
        let bound = 1 + MAX_LISTED - DirectoryFiles::CAP..=1 + MAX_LISTED;
        assert!(bound.contains(&left_out), "{left_out}");
        assert_eq!(has_real(&directories), [true; 2]);
        fs::remove_file(path(real[0])).unwrap();
        directories.list();
        assert_eq!(has_real(&directories), [false, true]);
    }

    #[test]
    fn a_user_with_too_many_files_hides_no_file_of_another_user() {
        let directory = tempfile::tempdir().unwrap();
        let file = |name: &str| directory.path().join(name);
        for number in 0..DirectoryFiles::CAP + 500 {
            fs::write(file(&format!("fastrtps_{number:016x}")), "").unwrap();
        }
        let real = Name::parse("fastrtps_port7411").unwrap();
        fs::write(file("fastrtps_port7411"), "").unwrap();
        std::os::unix::fs::chown(file("fastrtps_port7411"), Some(64_123), None).unwrap();
        let mut directories =
            ShmDirectories::new(Scope::Directories(vec![directory.path().to_path_buf()]));
        directories.find();
        directories.list();
        let found = files(&directories);
        assert!(found.len() == DirectoryFiles::CAP && found.contains(&real));
    }

    #[test]
    fn a_directory_is_replaced_by_another_one_at_the_same_path() {
        let above = tempfile::tempdir().unwrap();
        let path = above.path().join("shm");
        fs::create_dir(&path).unwrap();
        fs::write(path.join("fastrtps_port7411"), "").unwrap();
        let mut directories = ShmDirectories::new(Scope::Directories(vec![path.clone()]));
        let mut assert_only = |name: &str| {
            directories.find();
            directories.list();
            assert_eq!(
                files(&directories),
                HashSet::from([Name::parse(name).unwrap()])
            );
        };
        assert_only("fastrtps_port7411");
        // Another directory is at the same path, as after a mount.
        fs::rename(&path, above.path().join("below")).unwrap();
        fs::create_dir(&path).unwrap();
        fs::write(path.join("fastrtps_port7413"), "").unwrap();
        assert_only("fastrtps_port7413");
    }

    #[test]
    fn a_directory_whose_process_ended_is_reached_through_another_process() {
        let group = tempfile::tempdir().unwrap();
        let sleeper = || std::process::Command::new("sleep").arg("60").spawn();
        let (mut first, mut second) = (sleeper().unwrap(), sleeper().unwrap());
        let members = format!("{}\n{}\n", first.id(), second.id());
        fs::write(group.path().join("cgroup.procs"), members).unwrap();
        let mut directories = ShmDirectories::new(Scope::Cgroup(group.path().to_path_buf()));
        directories.find();
        let path = |directories: &ShmDirectories| {
            let paths = directories.directories.values();
            let paths: Vec<_> = paths.map(|each| each.path.display().to_string()).collect();
            paths.concat()
        };
        assert_eq!(
            path(&directories),
            format!("/proc/{}/root/dev/shm", first.id())
        );
        assert!(directories.are_reachable());
        first.kill().unwrap();
        first.wait().unwrap();
        assert!(!directories.are_reachable());
        directories.find();
        assert_eq!(
            path(&directories),
            format!("/proc/{}/root/dev/shm", second.id())
        );
        assert!(directories.are_reachable());
        second.kill().unwrap();
        second.wait().unwrap();
        directories.find();
        assert!(directories.directories.is_empty());
    }

    #[test]
    fn the_shared_memory_of_this_host_is_found_once_for_all_processes() {
        let mut directories = ShmDirectories::new(Scope::AllProcesses);
        directories.find();
        let own = directories
            .directories
            .values()
            .filter(|directory| directory.path == Path::new(SHARED_MEMORY));
        assert_eq!(own.count(), 1);
        // This process's network includes that directory too; a cgroup without processes has none.
        let network = PathBuf::from("/proc/self/ns/net");
        let mut directories = ShmDirectories::new(Scope::Networks(vec![network]));
        directories.find();
        let mut own = directories.directories.values();
        assert!(own.any(|directory| directory.path == Path::new(SHARED_MEMORY)));
        let mut directories = ShmDirectories::new(Scope::Cgroup(PathBuf::from("/nowhere")));
        directories.find();
        assert!(directories.directories.is_empty());
    }
}
