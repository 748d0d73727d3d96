//! Opens sockets in another network namespace: that of a container, or a named one.
//!
//! A separate thread enters the namespace and ends, so no other thread's namespace changes. A
//! socket stays in the namespace where it was created, whichever thread uses it later.

use std::fs::File;
use std::io;
use std::os::fd::AsRawFd;
use std::path::{Path, PathBuf};
use std::thread;

/// Why work in a network namespace failed.
#[derive(Debug, thiserror::Error)]
pub enum NetnsError {
    /// The file does not exist or cannot be read.
    #[error("cannot open network namespace {}", path.display())]
    Open {
        /// Path of the namespace.
        path: PathBuf,
        /// Error of the system.
        source: io::Error,
    },
    /// The process lacks a capability.
    #[error("not permitted to enter network namespace {}: CAP_SYS_ADMIN is missing", path.display())]
    NotPermitted {
        /// Path of the namespace.
        path: PathBuf,
        /// Error of the system.
        source: io::Error,
    },
    /// The namespace cannot be entered, for example because the file is not a network namespace.
    #[error("cannot enter network namespace {}", path.display())]
    Enter {
        /// Path of the namespace.
        path: PathBuf,
        /// Error of the system.
        source: io::Error,
    },
    /// The thread that enters the namespace could not be started or panicked.
    #[error("the thread for network namespace {} failed", path.display())]
    Thread {
        /// Path of the namespace.
        path: PathBuf,
    },
}

/// Runs `work` in the network namespace at `path` (`/run/netns/robot`, `/proc/1234/ns/net`).
///
/// # Errors
/// Fails if the namespace cannot be opened or entered.
pub fn within<T: Send>(path: &Path, work: impl FnOnce() -> T + Send) -> Result<T, NetnsError> {
    let failed = || NetnsError::Thread {
        path: path.to_path_buf(),
    };
    thread::scope(|scope| {
        thread::Builder::new()
            .name("netns".to_owned())
            .spawn_scoped(scope, || enter(path).map(|()| work()))
            .map_err(|_| failed())?
            .join()
            .map_err(|_| failed())?
    })
}

/// Moves the calling thread into the namespace permanently.
fn enter(path: &Path) -> Result<(), NetnsError> {
    let open = |source| NetnsError::Open {
        path: path.to_path_buf(),
        source,
    };
    let namespace = File::open(path).map_err(open)?;
    // SAFETY: the call takes no pointers, and the descriptor is open. Only this thread moves.
    if unsafe { libc::setns(namespace.as_raw_fd(), libc::CLONE_NEWNET) } == 0 {
        return Ok(());
    }
    let source = io::Error::last_os_error();
    let path = path.to_path_buf();
    Err(if source.kind() == io::ErrorKind::PermissionDenied {
        NetnsError::NotPermitted { path, source }
    } else {
        NetnsError::Enter { path, source }
    })
}

#[cfg(test)]
pub(crate) mod tests {
    use std::process::Command;

    use super::*;

    /// Runs a test in a new network namespace, with `lo` up.
    pub(crate) fn in_new_namespace(test: impl FnOnce() + Send) {
        thread::scope(|scope| {
            let thread = scope.spawn(|| {
                // SAFETY: the call takes no pointers, and only this thread moves.
                let result = unsafe { libc::unshare(libc::CLONE_NEWNET) };
                assert_eq!(
                    result,
                    0,
                    "network namespaces need root: run `sudo -E make test` ({})",
                    io::Error::last_os_error()
                );
                ip("link set lo up");
                test();
            });
            if let Err(panic) = thread.join() {
                std::panic::resume_unwind(panic);
            }
        });
    }

    /// Runs iproute2's `ip` in the calling thread's namespace.
    pub(crate) fn ip(arguments: &str) {
        let output = Command::new("ip")
            .args(arguments.split(' '))
            .output()
            .unwrap();
        assert!(output.status.success(), "ip {arguments}: {output:?}");
    }

    /// Returns the path of the calling thread's namespace.
    fn current() -> PathBuf {
        // SAFETY: the call takes no pointers.
        let thread = unsafe { libc::gettid() };
        PathBuf::from(format!("/proc/{}/task/{thread}/ns/net", std::process::id()))
    }

    fn name(path: &Path) -> PathBuf {
        std::fs::read_link(path).unwrap()
    }

    #[test]
    fn work_runs_in_the_other_namespace_and_the_caller_stays_in_its_own() {
        let outside = current();
        let (before, outside_name) = (name(&outside), name(&outside));
        in_new_namespace(|| {
            let inside = name(&current());
            assert_ne!(inside, outside_name);
            assert_eq!(within(&outside, || name(&current())).unwrap(), outside_name);
            assert_eq!(name(&current()), inside);
        });
        assert_eq!(name(&current()), before);
    }

    #[test]
    fn an_error_names_the_path_of_the_namespace() {
        let missing = within(Path::new("/run/netns/no-such-robot"), || ()).unwrap_err();
        assert_eq!(
            missing.to_string(),
            "cannot open network namespace /run/netns/no-such-robot"
        );
        let wrong = within(Path::new("/proc/self/ns/uts"), || ()).unwrap_err();
        assert!(wrong.to_string().contains("/proc/self/ns/uts"), "{wrong}");
    }

    #[test]
    fn a_panic_in_the_other_namespace_becomes_an_error() {
        let result = within(&current(), || panic!("on purpose"));
        assert!(matches!(
            result,
            Err(NetnsError::Thread { .. } | NetnsError::NotPermitted { .. })
        ));
    }
}
