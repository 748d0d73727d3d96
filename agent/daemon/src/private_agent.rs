//! An agent that one command starts for itself, as `rp ci` does: its socket and its bags are in a
//! directory of the command. It has no other listener, saves no state, exports nothing, and ends
//! with the command.

use std::io;
use std::path::PathBuf;

use ros2probe_metrics::otlp::Endpoint;
use ros2probe_wire::DomainId;
use rustix::process::{Pid, Signal, getppid, set_parent_process_death_signal};

use crate::config::{Config, SocketChoice, StateChoice, Watch};

/// Name of the API's socket in the directory.
pub const SOCKET_NAME: &str = "api.sock";
/// Name of the directory of bags.
pub const RECORDINGS_DIRECTORY: &str = "recordings";
/// Maximum size of a bag in bytes, unless the configuration sets another one.
pub const BAG_BYTES: u64 = 256 << 20;

/// The command that an agent belongs to.
#[derive(Clone, Debug)]
pub struct PrivateAgent {
    /// Existing directory that the agent may write to.
    pub directory: PathBuf,
    /// The only domain whose topics are measured.
    pub domain_id: DomainId,
    /// Process id of the command, which is the parent of the agent.
    pub parent: i32,
}

impl PrivateAgent {
    /// Changes the configuration: no address is bound, nothing outside the directory is written,
    /// and every topic of the domain is measured.
    pub(crate) fn restrict(&self, config: &mut Config) {
        config.metrics.listen = None;
        config.foxglove.listen = None;
        config.api.listen = None;
        config.api.token_file = None;
        config.api.socket = SocketChoice::At(self.directory.join(SOCKET_NAME));
        config.ros2_daemon.is_on = false;
        config.otlp.endpoint = Endpoint::Off;
        config.remote_write.url = None;
        config.ship.url = None;
        config.fleet.engine = None;
        config.state_directory = StateChoice::Off;
        config.history_bytes = 0;
        config.recordings.directory = StateChoice::At(self.directory.join(RECORDINGS_DIRECTORY));
        config.recordings.snapshots.clear();
        let limits = &mut config.recordings.limits;
        limits.max_bytes.get_or_insert(BAG_BYTES);
        // A part of a shared disk says nothing about a bag of this size: CI runs on full disks.
        limits.reserve_percent = 0;
        for watch in &mut config.watches {
            watch.domain_id.get_or_insert(self.domain_id);
        }
        let everything = Watch {
            domain_id: Some(self.domain_id),
            ..Watch::everything()
        };
        let same = |watch: &Watch| {
            (&watch.pattern, watch.domain_id) == (&everything.pattern, everything.domain_id)
        };
        if !config.watches.iter().any(same) {
            config.watches.push(everything);
        }
    }

    /// Ends this process with SIGTERM when the parent ends. Call it on the main thread, after the
    /// last change of the user, which resets it in the kernel.
    ///
    /// # Errors
    ///
    /// Fails if the parent has ended already.
    pub(crate) fn end_with_parent(&self) -> io::Result<()> {
        end_with_parent(self.parent, Signal::TERM)
    }

    /// Removes the directory at the end of an agent whose parent has ended.
    pub(crate) fn clean_up(&self) {
        if is_child_of(self.parent) {
            return;
        }
        if let Err(error) = std::fs::remove_dir_all(&self.directory) {
            tracing::warn!(%error, "the directory of the command remains");
        }
    }
}

/// Makes the kernel send `signal` to this process when its parent ends.
///
/// # Errors
///
/// Fails if `parent` is no longer the parent, or if the kernel refuses.
pub fn end_with_parent(parent: i32, signal: Signal) -> io::Result<()> {
    set_parent_process_death_signal(Some(signal))?;
    // The parent may have ended before the call.
    match is_child_of(parent) {
        true => Ok(()),
        false => Err(io::Error::other("the command that started it has ended")),
    }
}

/// Returns whether `parent` is the parent of this process.
#[must_use]
pub fn is_child_of(parent: i32) -> bool {
    getppid() == Pid::from_raw(parent)
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    fn applied(text: &str) -> Config {
        let mut config = Config::parse(text.as_bytes()).unwrap();
        let private = PrivateAgent {
            directory: "/tmp/ci".into(),
            domain_id: DomainId(7),
            parent: 1,
        };
        private.restrict(&mut config);
        config
    }

    #[test]
    fn a_private_agent_binds_no_address_and_writes_only_to_its_directory() {
        let config = applied(
            "metrics: {listen: '0.0.0.0:17400'}\nfoxglove: {listen: '127.0.0.1:8765'}\n\
             ros2_daemon: on\notlp: {endpoint: 'http://collector:4317'}\n\
             remote_write: {url: 'http://prometheus:9090/api/v1/write'}\n\
             fleet: {engine: 'http://prometheus:9090'}\n\
             state_directory: /var/lib/ros2probe\n\
             recordings: {max_bytes: 5000000, snapshots: [{name: a, topics: [/a]}]}\n",
        );
        assert_eq!(config.metrics.listen, None);
        assert_eq!(config.foxglove.listen, None);
        assert_eq!(config.api.listen, None);
        assert!(!config.ros2_daemon.is_on);
        assert_eq!(config.otlp.endpoint, Endpoint::Off);
        assert_eq!(config.remote_write.url, None);
        assert_eq!(config.fleet.engine, None);
        assert_eq!(config.state_directory, StateChoice::Off);
        let inside = |name: &str| Path::new("/tmp/ci").join(name);
        assert_eq!(config.api.socket, SocketChoice::At(inside("api.sock")));
        let recordings = config.recordings;
        assert_eq!(recordings.directory, StateChoice::At(inside("recordings")));
        assert_eq!(recordings.limits.max_bytes, Some(5_000_000));
        assert!(recordings.snapshots.is_empty());
    }

    #[test]
    fn a_private_agent_measures_every_topic_of_its_domain_within_a_limit_of_bytes() {
        let config = applied("watch: [{topic: /imu, min_rate_hz: 5}, {topic: /a, domain: 3}]\n");
        let watches = config.watches.iter();
        let watches: Vec<_> = watches
            .map(|watch| (&*watch.pattern, watch.domain_id.map(|id| id.0)))
            .collect();
        assert_eq!(
            watches,
            [("/imu", Some(7)), ("/a", Some(3)), ("/**", Some(7))]
        );
        let limits = config.recordings.limits;
        assert_eq!(limits.max_bytes, Some(BAG_BYTES));
        assert_eq!(
            (limits.reserve_percent, limits.reserve_bytes),
            (0, 512 << 20)
        );
        assert_eq!(applied("watch: [/**]\n").watches.len(), 1);
    }

    #[test]
    fn a_process_of_another_parent_is_refused() {
        let thread = std::thread::spawn(|| end_with_parent(i32::MAX, Signal::TERM));
        assert!(thread.join().unwrap().is_err());
        // The signal belongs to the thread, which has ended.
    }
}
