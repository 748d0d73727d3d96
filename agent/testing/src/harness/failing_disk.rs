//! A file system in memory whose operations fail with EIO on request, as those of a dying disk do.
//!
//! This process serves it over `/dev/fuse` (FUSE 7.31, `linux/fuse.h`). It has what a state
//! directory and a directory of bags need: files and directories, without links or attributes.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, Read as _, Write as _};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering};
use std::thread::JoinHandle;

use anyhow::{Context as _, Result, ensure};

const ROOT: u64 = 1;
const MAX_WRITE: u32 = 128 << 10;
const DIRECTORY: u32 = 0o040_000;
const FILE: u32 = 0o100_000;

/// Operations that fail.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Failing(u32);

impl Failing {
    /// No operation.
    pub const NO_OPERATION: Self = Self(0);
    /// Reads of files and directories.
    pub const READS: Self = Self(1);
    /// Writes.
    pub const WRITES: Self = Self(2);
    /// Syncs of files and directories.
    pub const SYNCS: Self = Self(4);
    /// Opening, creating, renaming, removing and truncating.
    pub const NAMES: Self = Self(8);
    /// All of these, and lookups, attributes, statistics and flushes.
    pub const ALL: Self = Self(31);
}

/// A mounted file system. It is unmounted when the value is dropped.
#[derive(Debug)]
pub struct FailingDisk {
    place: PathBuf,
    failing: Arc<AtomicU32>,
    failures: Arc<AtomicU64>,
    server: Option<JoinHandle<()>>,
}

impl FailingDisk {
    /// Mounts a new file system at an existing directory.
    ///
    /// # Errors
    ///
    /// Fails if `/dev/fuse` cannot be opened, or the mount fails.
    pub fn mount(place: &Path) -> Result<Self> {
        let device = File::options().read(true).write(true).open("/dev/fuse")?;
        let status = Command::new("mount")
            .args(["-i", "-t", "fuse", "-o"])
            .arg("fd=0,rootmode=40000,user_id=0,group_id=0,allow_other,default_permissions")
            .arg("failing")
            .arg(place)
            .stdin(device.try_clone()?)
            .status()?;
        ensure!(status.success(), "mount: {status}");
        let (failing, failures) = (Arc::<AtomicU32>::default(), Arc::<AtomicU64>::default());
        let mut server = Server {
            device,
            nodes: BTreeMap::from([(ROOT, Node::new(DIRECTORY | 0o755))]),
            last: ROOT,
            failing: Arc::clone(&failing),
            failures: Arc::clone(&failures),
        };
        let server = std::thread::Builder::new().spawn(move || {
            // The kernel returns ENODEV once the file system is unmounted.
            if let Err(error) = server.serve() {
                eprintln!("the failing disk ends: {error:#}");
            }
        })?;
        Ok(Self {
            place: place.to_owned(),
            failing,
            failures,
            server: Some(server),
        })
    }

    /// Lets these operations fail from now on, and all others succeed.
    pub fn fail(&self, operations: Failing) {
        self.failing.store(operations.0, Ordering::SeqCst);
    }

    /// Returns the number of operations that have failed so far.
    #[must_use]
    pub fn failures(&self) -> u64 {
        self.failures.load(Ordering::SeqCst)
    }
}

impl Drop for FailingDisk {
    fn drop(&mut self) {
        self.fail(Failing::NO_OPERATION);
        let unmounted = Command::new("umount").arg("-l").arg(&self.place).status();
        if unmounted.is_ok_and(|status| status.success())
            && let Some(server) = self.server.take()
        {
            let _ = server.join();
        }
    }
}

/// A file or a directory.
#[derive(Debug)]
struct Node {
    mode: u32,
    user: u32,
    group: u32,
    bytes: Vec<u8>,
    entries: BTreeMap<String, u64>,
}

impl Node {
    fn new(mode: u32) -> Self {
        Self {
            mode,
            user: 0,
            group: 0,
            bytes: Vec::new(),
            entries: BTreeMap::new(),
        }
    }

    fn is_directory(&self) -> bool {
        self.mode & DIRECTORY != 0
    }
}

struct Server {
    device: File,
    nodes: BTreeMap<u64, Node>,
    last: u64,
    failing: Arc<AtomicU32>,
    failures: Arc<AtomicU64>,
}

/// The body of a response, or an errno.
type Answer = Result<Vec<u8>, i32>;

impl Server {
    fn serve(&mut self) -> Result<()> {
        let mut buffer = vec![0; MAX_WRITE as usize + (16 << 10)];
        loop {
            let count = match self.device.read(&mut buffer) {
                Ok(count) => count,
                Err(error) if error.raw_os_error() == Some(libc::ENODEV) => return Ok(()),
                Err(error) if error.raw_os_error() == Some(libc::ENOENT) => continue,
                Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
                Err(error) => return Err(error.into()),
            };
            let request = buffer.get(..count).context("no request")?;
            let (operation, unique) = (word(request, 4), long(request, 8));
            let (node, body) = (long(request, 16), request.get(40..).unwrap_or_default());
            let Some(answer) = self.answer(operation, node, body) else {
                continue;
            };
            let (error, answer) = match answer {
                Ok(answer) => (0, answer),
                Err(error) => (-error, Vec::new()),
            };
            let mut reply = Reply::default();
            reply.word(u32::try_from(16 + answer.len())?);
            reply.0.extend(error.to_le_bytes());
            reply.long(unique);
            reply.0.extend(answer);
            match self.device.write_all(&reply.0) {
                // The caller was interrupted.
                Err(error) if error.raw_os_error() == Some(libc::ENOENT) => {}
                written => written?,
            }
        }
    }

    /// Handles a request. Returns `None` for requests that have no response.
    fn answer(&mut self, operation: u32, node: u64, body: &[u8]) -> Option<Answer> {
        let kind = match operation {
            15 | 28 => Failing::READS.0,
            16 => Failing::WRITES.0,
            20 | 30 => Failing::SYNCS.0,
            4 | 9..=12 | 14 | 27 | 35 | 45 => Failing::NAMES.0,
            1 | 3 | 17 | 25 => 16,
            _ => 0,
        };
        if self.failing.load(Ordering::SeqCst) & kind != 0 {
            self.failures.fetch_add(1, Ordering::SeqCst);
            return Some(Err(libc::EIO));
        }
        Some(match operation {
            // FORGET, INTERRUPT, BATCH_FORGET
            2 | 36 | 42 => return None,
            1 => self.look_up(node, name(body)),
            3 => self.attributes(node),
            4 => self.set_attributes(node, body),
            9 => self.create(node, DIRECTORY | word(body, 0) & 0o7777, name(&body[8..])),
            10 | 11 => self.remove(node, name(body)),
            12 => self.rename(node, long(body, 0), &body[8..]),
            45 => self.rename(node, long(body, 0), &body[16..]),
            // OPEN, OPENDIR
            14 | 27 => Ok(vec![0; 16]),
            15 => self.read(node, body),
            16 => self.write(node, body),
            17 => Ok(space()),
            // RELEASE, FSYNC, FLUSH, RELEASEDIR, FSYNCDIR, ACCESS, DESTROY
            18 | 20 | 25 | 29 | 30 | 34 | 38 => Ok(Vec::new()),
            26 => Ok(introduction()),
            28 => self.list(node, body),
            35 => {
                let mode = FILE | word(body, 4) & 0o7777;
                let created = self.create(node, mode, name(&body[16..]));
                // The response to OPEN follows.
                created.map(|mut answer| {
                    answer.extend([0; 16]);
                    answer
                })
            }
            _ => Err(libc::ENOSYS),
        })
    }

    fn node(&mut self, node: u64) -> Result<&mut Node, i32> {
        self.nodes.get_mut(&node).ok_or(libc::ENOENT)
    }

    fn look_up(&mut self, parent: u64, name: &str) -> Answer {
        let found = self.node(parent)?.entries.get(name).copied();
        self.entry(found.ok_or(libc::ENOENT)?)
    }

    fn create(&mut self, parent: u64, mode: u32, name: &str) -> Answer {
        if self.node(parent)?.entries.contains_key(name) {
            return Err(libc::EEXIST);
        }
        self.last += 1;
        let node = self.last;
        self.nodes.insert(node, Node::new(mode));
        self.node(parent)?.entries.insert(name.to_owned(), node);
        self.entry(node)
    }

    fn remove(&mut self, parent: u64, name: &str) -> Answer {
        let node = *self.node(parent)?.entries.get(name).ok_or(libc::ENOENT)?;
        if !self.node(node)?.entries.is_empty() {
            return Err(libc::ENOTEMPTY);
        }
        // Open descriptors may still use its bytes.
        self.node(parent)?.entries.remove(name);
        Ok(Vec::new())
    }

    fn rename(&mut self, parent: u64, target: u64, names: &[u8]) -> Answer {
        let from = name(names);
        let to = name(&names[from.len() + 1..]);
        let moved = self.node(parent)?.entries.remove(from);
        let moved = moved.ok_or(libc::ENOENT)?;
        self.node(target)?.entries.insert(to.to_owned(), moved);
        Ok(Vec::new())
    }

    fn read(&mut self, node: u64, body: &[u8]) -> Answer {
        let bytes = &self.node(node)?.bytes;
        let begin = index(long(body, 8)).min(bytes.len());
        let end = (begin + word(body, 16) as usize).min(bytes.len());
        Ok(bytes[begin..end].to_vec())
    }

    fn write(&mut self, node: u64, body: &[u8]) -> Answer {
        let (begin, size) = (index(long(body, 8)), word(body, 16));
        let data = &body[40..40 + size as usize];
        let bytes = &mut self.node(node)?.bytes;
        let end = begin + data.len();
        bytes.resize(end.max(bytes.len()), 0);
        bytes[begin..end].copy_from_slice(data);
        let mut reply = Reply::default();
        reply.word(size);
        reply.word(0);
        Ok(reply.0)
    }

    fn list(&mut self, node: u64, body: &[u8]) -> Answer {
        let (begin, most) = (index(long(body, 8)), word(body, 16) as usize);
        let entries: Vec<_> = self.node(node)?.entries.clone().into_iter().collect();
        let mut reply = Reply::default();
        for (place, (name, node)) in entries.iter().enumerate().skip(begin) {
            let length = 24 + name.len().next_multiple_of(8);
            if reply.0.len() + length > most {
                break;
            }
            let end = reply.0.len() + length;
            let kind = self.node(*node)?.mode >> 12;
            reply.long(*node);
            reply.long(place as u64 + 1);
            reply.word(u32::try_from(name.len()).unwrap_or(0));
            reply.word(kind);
            reply.0.extend(name.as_bytes());
            reply.0.resize(end, 0);
        }
        Ok(reply.0)
    }

    fn set_attributes(&mut self, node: u64, body: &[u8]) -> Answer {
        let valid = word(body, 0);
        let known = self.node(node)?;
        if valid & 1 != 0 {
            known.mode = known.mode & !0o7777 | word(body, 68) & 0o7777;
        }
        if valid & 2 != 0 {
            known.user = word(body, 76);
        }
        if valid & 4 != 0 {
            known.group = word(body, 80);
        }
        if valid & 8 != 0 {
            known.bytes.resize(index(long(body, 16)), 0);
        }
        self.attributes(node)
    }

    /// `struct fuse_attr_out`, not to be cached.
    fn attributes(&mut self, node: u64) -> Answer {
        let mut reply = Reply(vec![0; 16]);
        self.describe(node, &mut reply)?;
        Ok(reply.0)
    }

    /// `struct fuse_entry_out`, not to be cached.
    fn entry(&mut self, node: u64) -> Answer {
        let mut reply = Reply::default();
        reply.long(node);
        reply.0.resize(40, 0);
        self.describe(node, &mut reply)?;
        Ok(reply.0)
    }

    /// `struct fuse_attr`
    fn describe(&mut self, number: u64, reply: &mut Reply) -> Result<(), i32> {
        let node = self.node(number)?;
        reply.long(number);
        reply.long(node.bytes.len() as u64);
        reply.long(node.bytes.len().div_ceil(512) as u64);
        // Times.
        (0..3).for_each(|_| reply.long(0));
        (0..3).for_each(|_| reply.word(0));
        reply.word(node.mode);
        reply.word(if node.is_directory() { 2 } else { 1 });
        reply.word(node.user);
        reply.word(node.group);
        reply.word(0);
        reply.word(4096);
        reply.word(0);
        Ok(())
    }
}

/// Numbers in the byte order of this machine, which is little-endian wherever the tests run.
#[derive(Default)]
struct Reply(Vec<u8>);

impl Reply {
    fn word(&mut self, value: u32) {
        self.0.extend(value.to_le_bytes());
    }

    fn long(&mut self, value: u64) {
        self.0.extend(value.to_le_bytes());
    }
}

/// `struct fuse_init_out`
fn introduction() -> Vec<u8> {
    let mut reply = Reply::default();
    reply.word(7);
    reply.word(31);
    reply.word(MAX_WRITE);
    // Flags, and requests in the background.
    reply.word(0);
    reply.word(0);
    reply.word(MAX_WRITE);
    // Granularity of times.
    reply.word(1);
    reply.0.resize(64, 0);
    reply.0
}

/// `struct fuse_kstatfs`: a gibibyte of which half is free.
fn space() -> Vec<u8> {
    const BLOCKS: u64 = 1 << 18;
    let mut reply = Reply::default();
    for number in [BLOCKS, BLOCKS / 2, BLOCKS / 2, 1 << 20, 1 << 20] {
        reply.long(number);
    }
    for number in [4096, 255, 4096] {
        reply.word(number);
    }
    reply.0.resize(80, 0);
    reply.0
}

fn word(bytes: &[u8], place: usize) -> u32 {
    let bytes = bytes.get(place..).and_then(|rest| rest.first_chunk());
    u32::from_le_bytes(bytes.copied().unwrap_or_default())
}

fn long(bytes: &[u8], place: usize) -> u64 {
    let bytes = bytes.get(place..).and_then(|rest| rest.first_chunk());
    u64::from_le_bytes(bytes.copied().unwrap_or_default())
}

fn index(number: u64) -> usize {
    usize::try_from(number).unwrap_or(usize::MAX)
}

/// Returns a name up to its final zero.
fn name(bytes: &[u8]) -> &str {
    let name = bytes.split(|byte| *byte == 0).next().unwrap_or_default();
    std::str::from_utf8(name).unwrap_or_default()
}
