//! Tests of the maps of tracepoints and uprobes. Before Linux 6.1, the kernel warns about such a
//! program if its hash table allocates as it grows. With PREEMPT_RT, it refuses the program.

use std::fs::{self, File};
use std::os::fd::AsRawFd as _;
use std::path::Path;

use anyhow::{Context as _, Result, ensure};
use aya::maps::MapInfo;
use aya::programs::loaded_programs;
use ros2probe_capture::breakpoints::AttachMethod;
use ros2probe_capture::filter::{Filter, FilterSettings};
use ros2probe_capture::inside::programs;
use ros2probe_testing::harness;
use ros2probe_testing::harness::network::Namespace;

/// `BPF_MAP_TYPE_HASH`.
const HASH: &str = "1";
/// `BPF_F_NO_PREALLOC`.
const NO_PREALLOC: u32 = 1;
/// Number of listings of programs.
const LISTINGS: usize = 20;

#[test]
fn tables_of_tracepoints_and_uprobes_are_allocated_beforehand() -> Result<()> {
    harness::require()?;
    let host = Namespace::isolated()?;
    let mut filter = Filter::load_host(&FilterSettings::default())?;
    filter.attach(&File::open(host.cgroup())?)?;
    filter.attach_tracepoints(false);
    let means = AttachMethod::of_this_kernel();
    let _uprobe = Filter::load_uprobe(&FilterSettings::default(), None, means)?;
    let _inside = programs::load(true, None, means)?;
    let kinds = ["socket_full", "shm_handed", "rcl_publish", "callback_start"];
    let is_checked = |checked: &[String]| {
        let mut kinds = kinds.iter();
        kinds.all(|kind| checked.iter().any(|name| name.starts_with(kind)))
    };
    let mut checked = Vec::new();
    // A listing may skip a program while programs of another test are unloaded.
    for _ in 0..LISTINGS {
        check(&mut checked)?;
        if is_checked(&checked) {
            break;
        }
    }
    ensure!(is_checked(&checked), "{checked:?}");
    Ok(())
}

/// Checks the maps of every loaded tracepoint or uprobe program.
fn check(checked: &mut Vec<String>) -> Result<()> {
    let prefixes = ["socket_full", "no_room", "not_reassemble", "shm_handed"];
    let inside = ["rcl", "rmw_", "callback_"];
    for program in loaded_programs() {
        // Programs of other tests come and go.
        let Ok(program) = program else { continue };
        let name = program.name_as_str().unwrap_or_default().to_owned();
        let Ok(Some(maps)) = program.map_ids() else {
            continue;
        };
        let mut prefixes = prefixes.iter().chain(&inside);
        if prefixes.any(|prefix| name.starts_with(prefix)) {
            for map in maps {
                let Ok(map) = MapInfo::from_id(map) else {
                    continue;
                };
                ensure_allocated(&map).with_context(|| name.clone())?;
            }
            checked.push(name);
        }
    }
    Ok(())
}

fn ensure_allocated(map: &MapInfo) -> Result<()> {
    // Other tests release their maps at the same time.
    let Ok(descriptor) = map.fd() else {
        return Ok(());
    };
    let number = std::os::fd::AsFd::as_fd(&descriptor).as_raw_fd();
    let facts = fs::read_to_string(Path::new("/proc/self/fdinfo").join(number.to_string()))?;
    let value = |key: &str| {
        let line = facts.lines().find_map(|line| line.strip_prefix(key));
        line.map(str::trim).context("no such line")
    };
    let flags = value("map_flags:")?.trim_start_matches("0x");
    let grows = u32::from_str_radix(flags, 16)? & NO_PREALLOC != 0;
    ensure!(
        value("map_type:")? != HASH || !grows,
        "{}",
        map.name_as_str().unwrap_or_default()
    );
    Ok(())
}
