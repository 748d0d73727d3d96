//! Containers: whether this process is in one, and what withholds the host from it.
//!
//! Errors of the capture name the option of `docker run` and `podman run` that grants what is
//! missing, or the lines of a unit of systemd. Nothing here is a security decision: a container may
//! hide that it is one.

use std::fs;
use std::path::Path;

/// Files that Docker and podman create in each container.
const MARKER_FILES: [&str; 2] = ["/.dockerenv", "/run/.containerenv"];
/// Variable of the container interface of systemd. The image has it as well.
const CONTAINER_VARIABLE: &str = "container";
/// Its values for containers that are started with options, unlike those of systemd-nspawn or LXC.
const CONTAINER_ENGINES: [&str; 3] = ["docker", "oci", "podman"];
/// Options that show the host's control groups.
pub const CGROUP_OPTIONS: &str = "--cgroupns host --volume /sys/fs/cgroup:/sys/fs/cgroup:ro";
/// Address families of sockets at interfaces, as a line of a unit.
pub const FAMILIES_LINE: &str = "RestrictAddressFamilies=AF_PACKET AF_NETLINK";
/// Container option for a seccomp profile that permits `bpf(2)`.
pub const SECCOMP_OPTION: &str = "--security-opt seccomp=FILE (docs/containers.md)";

/// Inodes of the host's namespaces, the same on every kernel (include/linux/proc_ns.h).
const HOST_USERS: &str = "user:[4026531837]";
const HOST_PROCESSES: &str = "pid:[4026531836]";
/// A setting that only the host's network namespace has.
const HOST_NETWORK: &str = "/proc/sys/net/core/netdev_max_backlog";
const MOUNTS_PATH: &str = "/proc/self/mountinfo";
/// Mounts of the first process, which is the host's unless the process ids are the container's own.
pub const FIRST_MOUNTS: &str = "/proc/1/mountinfo";

/// Returns whether this process is in a container of Docker, podman or Kubernetes. A marker alone
/// proves nothing, because virtual machines may be built from container images.
#[must_use]
pub fn is_container() -> bool {
    let engine = std::env::var(CONTAINER_VARIABLE)
        .is_ok_and(|value| CONTAINER_ENGINES.contains(&value.as_str()));
    let is_marked = engine
        || MARKER_FILES
            .into_iter()
            .any(|path| Path::new(path).exists());
    is_marked && (has_own_processes() || has_own_root())
}

/// Returns whether the root file system is another one than that of the first process. With process
/// ids of its own, a container's first process has the same.
fn has_own_root() -> bool {
    let read = |path| fs::read_to_string(path).unwrap_or_default();
    mount_of("/", &read(MOUNTS_PATH)) != mount_of("/", &read(FIRST_MOUNTS))
}

/// Returns whether this process is a service of systemd that reports its state: no shell has this
/// variable.
#[must_use]
pub fn is_service() -> bool {
    std::env::var_os("NOTIFY_SOCKET").is_some()
}

/// Returns the device and the directory that are mounted on a path, of the last such mount, which
/// hides earlier ones.
#[must_use]
pub fn mount_of<'m>(point: &str, mounts: &'m str) -> Option<(&'m str, &'m str)> {
    let mut mounted = mounts.lines().filter_map(|line| {
        let mut fields = line.split(' ').skip(2);
        let (device, directory) = (fields.next()?, fields.next()?);
        (fields.next()? == point).then_some((device, directory))
    });
    mounted.next_back()
}

/// Returns `: add OPTION` in a container, and an empty text elsewhere.
#[must_use]
pub fn add(option: &str) -> String {
    otherwise(option, "")
}

/// Returns `: add OPTION` in a container, and `elsewhere` elsewhere.
pub(crate) fn otherwise(option: &str, elsewhere: &str) -> String {
    match is_container() {
        true => format!(": add {option}"),
        false => elsewhere.to_owned(),
    }
}

/// Returns whether this process is in a user namespace of its own, whose capabilities do not apply
/// to BPF.
#[must_use]
pub fn has_own_users() -> bool {
    differs("/proc/self/ns/user", HOST_USERS)
}

/// Returns whether this process is in a process namespace of its own.
#[must_use]
pub fn has_own_processes() -> bool {
    differs("/proc/self/ns/pid", HOST_PROCESSES)
}

/// Returns whether this process is in a network namespace of its own.
#[must_use]
pub fn has_own_network() -> bool {
    Path::new("/proc/sys/net/core").exists() && !Path::new(HOST_NETWORK).exists()
}

/// Returns whether a seccomp filter checks the system calls of this process.
pub(crate) fn is_filtered() -> bool {
    let status = fs::read_to_string("/proc/thread-self/status").unwrap_or_default();
    let mut lines = status.lines();
    lines.any(|line| {
        line.strip_prefix("Seccomp:")
            .is_some_and(|mode| mode.trim() == "2")
    })
}

fn differs(link: &str, host: &str) -> bool {
    fs::read_link(link).is_ok_and(|own| own != Path::new(host))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_last_mount_on_a_path_counts() {
        let mounts = "24 18 0:22 / /dev rw - devtmpfs none rw\n\
            25 24 0:23 / /dev/shm rw,nosuid shared:4 - tmpfs tmpfs rw\n\
            31 24 0:29 /a /dev/shm rw - tmpfs tmpfs rw\n";
        assert_eq!(mount_of("/dev/shm", mounts), Some(("0:29", "/a")));
        assert_eq!(mount_of("/dev", mounts), Some(("0:22", "/")));
        assert_eq!(mount_of("/", mounts), None);
    }

    #[test]
    fn this_process_is_in_a_mount_namespace_with_a_root() {
        let mounts = fs::read_to_string(MOUNTS_PATH).unwrap();
        assert!(mount_of("/", &mounts).is_some(), "{mounts}");
    }
}
