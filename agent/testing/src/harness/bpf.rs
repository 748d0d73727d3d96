//! Queries the kernel's BPF programs independently of the agent: programs attached to a cgroup,
//! programs held by a process, and programs that still exist. Also attaches a foreign program.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File};
use std::io;
use std::os::fd::{AsRawFd as _, FromRawFd as _, OwnedFd};
use std::path::Path;

use anyhow::{Context as _, Result, bail};
use aya::maps::{HashMap, Map, MapData, MapInfo};
use ros2probe_wire::Guid;
use ros2probe_wire::record::{Verdict, guid_words};

use super::wait_until;

const PROG_LOAD: libc::c_int = 5;
const PROG_ATTACH: libc::c_int = 8;
const PROG_GET_NEXT_ID: libc::c_int = 11;
const MAP_GET_NEXT_ID: libc::c_int = 12;
const PROG_QUERY: libc::c_int = 16;
const LINK_GET_NEXT_ID: libc::c_int = 31;
const CGROUP_SKB: u32 = 8;
const ALLOW_MULTI: u32 = 2;

/// `BPF_CGROUP_INET_INGRESS` and `BPF_CGROUP_INET_EGRESS`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub enum Direction {
    Ingress = 0,
    Egress = 1,
}

/// A BPF object held by a process, by id.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Object {
    Program(u32),
    Map(u32),
    Link(u32),
}

/// Whether a foreign program allows other programs to be attached.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AttachMode {
    /// Other programs can be attached.
    Shared,
    /// Other programs cannot be attached.
    Exclusive,
}

/// Attaches to a cgroup a foreign program that accepts all packets. It stays attached until the
/// cgroup is removed.
pub fn attach_foreign_program(
    cgroup: &Path,
    direction: Direction,
    manners: AttachMode,
) -> Result<()> {
    // r0 = 1; exit
    let instructions: [u64; 2] = [0x0000_0001_0000_00b7, 0x95];
    let license = c"GPL";
    let load = ProgramToLoad {
        kind: CGROUP_SKB,
        instruction_count: 2,
        instructions: instructions.as_ptr() as u64,
        license: license.as_ptr() as u64,
        expected_attach_type: direction as u32,
        ..ProgramToLoad::default()
    };
    let program = descriptor(bpf(PROG_LOAD, &load)?);
    let directory = File::open(cgroup)?;
    let attach = ProgramToAttach {
        target: directory.as_raw_fd(),
        program: program.as_raw_fd(),
        attach_type: direction as u32,
        flags: match manners {
            AttachMode::Shared => ALLOW_MULTI,
            AttachMode::Exclusive => 0,
        },
    };
    bpf(PROG_ATTACH, &attach)?;
    Ok(())
}

/// Returns the number of programs attached directly to a cgroup.
pub fn attached(cgroup: &Path, direction: Direction) -> Result<u32> {
    let directory = File::open(cgroup)?;
    let mut query = ProgramsToFind {
        target: directory.as_raw_fd(),
        attach_type: direction as u32,
        ..ProgramsToFind::default()
    };
    bpf_mut(PROG_QUERY, &mut query)?;
    Ok(query.program_count)
}

/// Returns the ids of the programs held by a process.
pub fn programs_of(process: u32) -> Result<BTreeSet<u32>> {
    let mut programs = BTreeSet::new();
    for entry in fs::read_dir(format!("/proc/{process}/fdinfo"))? {
        // A descriptor may be closed between listing and reading.
        let text = fs::read_to_string(entry?.path()).unwrap_or_default();
        let ids = text
            .lines()
            .filter_map(|line| line.strip_prefix("prog_id:"));
        programs.extend(ids.filter_map(|id| id.trim().parse::<u32>().ok()));
    }
    Ok(programs)
}

/// Returns all objects held by a process.
pub fn objects_of(process: u32) -> Result<BTreeSet<Object>> {
    let mut objects = BTreeSet::new();
    for entry in fs::read_dir(format!("/proc/{process}/fdinfo"))? {
        // A descriptor may be closed between listing and reading.
        let text = fs::read_to_string(entry?.path()).unwrap_or_default();
        objects.extend(text.lines().filter_map(|line| {
            let (name, id) = line.split_once(':')?;
            let id = id.trim().parse().ok()?;
            Some(match name {
                "prog_id" => Object::Program(id),
                "map_id" => Object::Map(id),
                "link_id" => Object::Link(id),
                _ => return None,
            })
        }));
    }
    Ok(objects)
}

/// Returns the writers and readers in the interest maps of a process, with their verdicts.
pub fn interest_of(process: u32) -> Result<BTreeMap<[u32; 4], u32>> {
    for object in objects_of(process)? {
        let Object::Map(id) = object else { continue };
        if MapInfo::from_id(id)?.name_as_str() == Some("INTEREST") {
            let map = Map::HashMap(MapData::from_id(id)?);
            let map: HashMap<_, [u32; 4], u32> = HashMap::try_from(map)?;
            return map.iter().map(|entry| Ok(entry?)).collect();
        }
    }
    bail!("the process {process} has no such map")
}

/// Waits until the kernel passes records of an endpoint to this process.
pub fn wait_metered(process: u32, endpoint: Guid) -> Result<()> {
    wait_until("the kernel meters the endpoint", || {
        let verdict = interest_of(process)?.get(&guid_words(endpoint)).copied();
        Ok(verdict.is_some_and(|verdict| verdict != Verdict::Ignore as u32))
    })
}

/// Returns how often the kernel skipped a program of this process because it was already running on
/// that CPU.
pub fn skipped_runs() -> Result<u64> {
    let mut skipped = 0;
    for entry in fs::read_dir("/proc/self/fdinfo")? {
        let text = fs::read_to_string(entry?.path()).unwrap_or_default();
        let misses = text
            .lines()
            .filter_map(|line| line.strip_prefix("recursion_misses:"));
        skipped += misses
            .filter_map(|count| count.trim().parse::<u64>().ok())
            .sum::<u64>();
    }
    Ok(skipped)
}

/// Returns whether the program still exists.
pub fn exists(program: u32) -> Result<bool> {
    is_there(Object::Program(program))
}

/// Returns whether the object still exists. It is not opened: a `BPF_MAP_TYPE_PROG_ARRAY` that is
/// opened and closed while the kernel clears it is never freed (Linux 6.18).
pub fn is_there(object: Object) -> Result<bool> {
    let (command, id) = match object {
        Object::Program(id) => (PROG_GET_NEXT_ID, id),
        Object::Map(id) => (MAP_GET_NEXT_ID, id),
        Object::Link(id) => (LINK_GET_NEXT_ID, id),
    };
    let mut next = NextObject {
        start: id - 1,
        ..NextObject::default()
    };
    match bpf_mut(command, &mut next) {
        Ok(_) => Ok(next.next == id),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(false),
        Err(error) => Err(error).with_context(|| format!("cannot ask for {object:?}")),
    }
}

/// A prefix of `union bpf_attr`; the kernel treats missing attributes as zero.
trait Attributes: Copy {}

#[derive(Clone, Copy, Default)]
#[repr(C)]
struct ProgramToLoad {
    kind: u32,
    instruction_count: u32,
    instructions: u64,
    license: u64,
    log_level: u32,
    log_size: u32,
    log: u64,
    kernel_version: u32,
    flags: u32,
    name: [u8; 16],
    interface: u32,
    expected_attach_type: u32,
}

#[derive(Clone, Copy, Default)]
#[repr(C)]
struct ProgramToAttach {
    target: i32,
    program: i32,
    attach_type: u32,
    flags: u32,
}

#[derive(Clone, Copy, Default)]
#[repr(C)]
struct ProgramsToFind {
    target: i32,
    attach_type: u32,
    query_flags: u32,
    attach_flags: u32,
    programs: u64,
    program_count: u32,
    padding: u32,
}

#[derive(Clone, Copy, Default)]
#[repr(C)]
struct NextObject {
    start: u32,
    next: u32,
    open_flags: u32,
}

impl Attributes for ProgramToLoad {}
impl Attributes for ProgramToAttach {}
impl Attributes for ProgramsToFind {}
impl Attributes for NextObject {}

fn bpf<A: Attributes>(command: libc::c_int, attributes: &A) -> io::Result<i32> {
    let mut attributes = *attributes;
    bpf_mut(command, &mut attributes)
}

fn bpf_mut<A: Attributes>(command: libc::c_int, attributes: &mut A) -> io::Result<i32> {
    // SAFETY: the attributes are plain words of the size passed, laid out like `union bpf_attr`,
    // and the memory to which they point outlives the call.
    let result = unsafe {
        libc::syscall(
            libc::SYS_bpf,
            command,
            std::ptr::from_mut(attributes),
            size_of::<A>(),
        )
    };
    match i32::try_from(result) {
        Ok(number) if number >= 0 => Ok(number),
        _ => Err(io::Error::last_os_error()),
    }
}

fn descriptor(number: i32) -> OwnedFd {
    // SAFETY: a new descriptor without another owner.
    unsafe { OwnedFd::from_raw_fd(number) }
}
