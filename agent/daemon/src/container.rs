//! What an agent in a container lacks although it runs, and the option of `docker run` and `podman
//! run` that grants it. Missing capabilities and refused system calls are errors of their own.

use std::fmt;
use std::fs;
use std::os::unix::fs::MetadataExt as _;

use crate::config::{Config, ShmMode, SourceChoice, StateChoice};
use crate::memory;
use ros2probe_capture::cgroup::Cgroup;
use ros2probe_capture::container::{
    CGROUP_OPTIONS, FIRST_MOUNTS, has_own_network, has_own_processes, is_container, mount_of,
};
use rustix::fs::{Access, access, major, minor};
use rustix::io::Errno;
use rustix::process::geteuid;

const SHARED_MEMORY: &str = "/dev/shm";

/// One thing that the container withholds.
#[derive(Debug, PartialEq, Eq)]
pub struct Restriction {
    /// Name of the check in `rp doctor`.
    pub check: &'static str,
    /// What is missing, and the consequence.
    pub sentence: String,
    /// The option that grants it.
    pub option: String,
}

impl fmt::Display for Restriction {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: add {}", self.sentence, self.option)
    }
}

/// Returns what the container withholds from an agent with this configuration; nothing outside of
/// containers.
pub(crate) fn restrictions(config: &Config) -> Vec<Restriction> {
    if !is_container() {
        return Vec::new();
    }
    let mut found = namespace_restrictions(config);
    if config.capture.source != SourceChoice::Wire {
        found.extend(cgroup(config));
    }
    found.extend(state_restriction(&config.state_directory));
    found
}

/// Returns which namespaces and directories of the host the container withholds; nothing outside of
/// containers. With `capture.source: wire` the agent observes its own network namespace by choice.
#[must_use]
pub fn namespace_restrictions(config: &Config) -> Vec<Restriction> {
    if !is_container() || config.capture.source == SourceChoice::Wire {
        return Vec::new();
    }
    let restriction = |check, sentence: &str, option: &str| Restriction {
        check,
        sentence: sentence.to_owned(),
        option: option.to_owned(),
    };
    let mut found = Vec::new();
    if has_own_processes() {
        let sentence = "process ids are not the host's, so owners of sockets are unknown";
        found.push(restriction("process_ids", sentence, "--pid host"));
    }
    if has_own_network() {
        let sentence = "interfaces are those of the container, so the host's are not observed";
        found.push(restriction("network", sentence, "--network host"));
    }
    if config.capture.shm.mode != ShmMode::Off && !has_own_processes() && !shares_host_memory() {
        let sentence = "/dev/shm is not the host's, so its shared memory is not observed";
        let option = "--volume /dev/shm:/dev/shm:ro";
        found.push(restriction("shm", sentence, option));
    }
    found
}

fn cgroup(config: &Config) -> Option<Restriction> {
    let group = Cgroup::topmost().ok()?;
    let is_part = config.capture.cgroup.is_none() && !group.is_whole_host();
    is_part.then(|| Restriction {
        check: "cgroup_root",
        sentence: format!(
            "{} is not the root of the host's control groups, so sockets of other containers are not \
             observed",
            group.path().display()
        ),
        option: CGROUP_OPTIONS.to_owned(),
    })
}

/// Returns whether the shared memory of this process is the host's, as far as the first process
/// shows.
fn shares_host_memory() -> bool {
    let host = fs::read_to_string(FIRST_MOUNTS).unwrap_or_default();
    let Some((device, _)) = mount_of(SHARED_MEMORY, &host) else {
        return true;
    };
    fs::metadata(SHARED_MEMORY)
        .map(|own| own.dev())
        .is_ok_and(|own| format!("{}:{}", major(own), minor(own)) == device)
}

/// Returns the restriction of the state directory; `None` outside of containers.
pub(crate) fn state(choice: &StateChoice) -> Option<Restriction> {
    is_container().then(|| state_restriction(choice)).flatten()
}

/// Returns the restriction of the state directory, in a container or elsewhere.
fn state_restriction(choice: &StateChoice) -> Option<Restriction> {
    let path = memory::path(choice)?;
    let directory = fs::metadata(&path).ok()?;
    let refusal = access(&path, Access::WRITE_OK).err()?;
    let option = match refusal {
        Errno::ROFS => format!("--volume ros2probe-state:{}", path.display()),
        _ => writer(geteuid().as_raw(), &directory),
    };
    Some(Restriction {
        check: "state",
        sentence: format!(
            "{} cannot be written, so a restart loses names and added watches",
            path.display()
        ),
        option,
    })
}

/// Returns the option for a user that may write a directory: this one, if the group may.
fn writer(user_id: u32, directory: &fs::Metadata) -> String {
    let user_id = match directory.mode() & 0o020 {
        0 => directory.uid(),
        _ => user_id,
    };
    format!("--user {user_id}:{}", directory.gid())
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt as _;

    use std::path::PathBuf;

    use super::*;

    #[test]
    fn a_state_directory_of_another_user_is_named_with_a_user_that_may_write_it() {
        let refused = state_restriction(&StateChoice::At(PathBuf::from("/proc/sys"))).unwrap();
        assert_eq!(
            refused.to_string(),
            "/proc/sys cannot be written, so a restart loses names and added watches: add --user 0:0"
        );
        assert_eq!(state_restriction(&StateChoice::Off), None);
        assert_eq!(
            state_restriction(&StateChoice::At(PathBuf::from("/tmp"))),
            None
        );
        let directory = tempfile::tempdir().unwrap();
        let writer = |mode| {
            fs::set_permissions(directory.path(), fs::Permissions::from_mode(mode)).unwrap();
            let made = fs::metadata(directory.path()).unwrap();
            (writer(77, &made), made.uid(), made.gid())
        };
        let (option, owner, group) = writer(0o750);
        assert_eq!(option, format!("--user {owner}:{group}"));
        let (option, _, group) = writer(0o770);
        assert_eq!(option, format!("--user 77:{group}"));
    }
}
