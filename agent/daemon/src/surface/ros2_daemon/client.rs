//! The distribution of a client, which determines how endpoints are written.

use std::cell::OnceCell;
use std::path::Path;

use ros2probe_message::Dialect;
use ros2probe_model::report::snapshot::Snapshot;
use ros2probe_wire::DomainId;
use ros2probe_wire::rtps::VendorId;

use super::function::Caller;
use super::peer::{self, PeerProcess};

/// Default RMW implementation of ROS 2.
const DEFAULT_RMW: &str = "rmw_fastrtps_cpp";

/// A client with the sources that show its distribution. The sources are read only when an answer
/// needs them.
#[derive(Debug)]
pub(super) struct Client<'a> {
    /// The client's process, found at most once per connection.
    pub(super) process: &'a OnceCell<PeerProcess>,
    /// Port of the client and port of the listener.
    pub(super) ports: (u16, u16),
    /// Distribution that the configuration sets.
    pub(super) configured: Option<Dialect>,
    /// The User-Agent header.
    pub(super) user_agent: Option<&'a str>,
    /// State of the robot. Only distributions after Humble announce type hashes.
    pub(super) snapshot: &'a Snapshot,
    /// Domain of the port.
    pub(super) domain_id: DomainId,
}

impl Client<'_> {
    fn process(&self) -> &PeerProcess {
        let (client, server) = self.ports;
        let find = || peer::find(Path::new("/proc"), client, server).unwrap_or_default();
        self.process.get_or_init(find)
    }
}

impl Caller for Client<'_> {
    /// Returns the distribution from the first source that shows it. The sources are the process,
    /// which is certain, the configuration, the Python release in the User-Agent, the robot, and
    /// the default.
    fn dialect(&self) -> Dialect {
        let certain = self.process().dialect.or(self.configured);
        let guessed = || self.user_agent.and_then(of_user_agent);
        let announced = || announced(self.snapshot, self.domain_id);
        certain
            .or_else(guessed)
            .or_else(announced)
            .unwrap_or_default()
    }

    /// Returns the RMW implementation of the process. If it is unknown, returns the implementation
    /// that all participants of the domain use, or else the default.
    fn rmw_implementation(&self) -> String {
        let known = self.process().rmw_implementation.as_deref();
        let common = || common_rmw(self.snapshot, self.domain_id);
        known.or_else(common).unwrap_or(DEFAULT_RMW).to_owned()
    }
}

/// Returns the distribution that ships this Python release: 3.8 with Foxy and Galactic, 3.10 with
/// Humble, 3.12 with Jazzy and Kilted, 3.14 with Lyrical.
fn of_user_agent(value: &str) -> Option<Dialect> {
    match value.strip_prefix("Python-xmlrpc/")? {
        "3.8" | "3.10" => Some(Dialect::Humble),
        "3.12" => Some(Dialect::Jazzy),
        "3.14" => Some(Dialect::Rolling),
        _ => None,
    }
}

/// Returns the distribution that follows from the announcements in a domain: only distributions
/// after Humble announce type hashes. Returns `None` without a ROS participant.
fn announced(snapshot: &Snapshot, domain_id: DomainId) -> Option<Dialect> {
    let mut topics = snapshot
        .topics
        .iter()
        .filter(|topic| topic.domain_id == domain_id);
    if topics.any(|topic| !topic.type_hashes.is_empty()) {
        return Some(Dialect::Jazzy);
    }
    let mut participants = snapshot.participants.iter();
    let is_ros = participants.any(|each| each.domain_id == domain_id && each.enclave.is_some());
    is_ros.then_some(Dialect::Humble)
}

/// Returns the RMW implementation of all ROS participants of a domain. Returns `None` if they
/// differ or it is unknown.
fn common_rmw(snapshot: &Snapshot, domain_id: DomainId) -> Option<&'static str> {
    let participants = snapshot.participants.iter();
    let of_domain = participants.filter(|each| each.domain_id == domain_id);
    let mut vendors = of_domain
        .filter(|each| each.enclave.is_some())
        .map(|each| each.vendor);
    let first = vendors.next()?;
    if vendors.any(|vendor| vendor != first) {
        return None;
    }
    match first {
        VendorId::EPROSIMA => Some("rmw_fastrtps_cpp"),
        VendorId::CYCLONE => Some("rmw_cyclonedds_cpp"),
        VendorId::ZENOH => Some("rmw_zenoh_cpp"),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use ros2probe_testing::sample_robot;
    use ros2probe_wire::discovery::TypeHash;

    use super::*;

    /// Returns the distribution that follows from a process, a setting, a User-Agent and the
    /// robot's hashes.
    fn chosen_dialect(
        process: Option<Dialect>,
        configured: Option<Dialect>,
        user_agent: Option<&str>,
        hashes: &[TypeHash],
    ) -> Dialect {
        let found = OnceCell::from(PeerProcess {
            dialect: process,
            rmw_implementation: None,
        });
        let mut snapshot = sample_robot::snapshot(["/points"]);
        for topic in &mut snapshot.topics {
            topic.type_hashes = hashes.to_vec();
        }
        let client = Client {
            process: &found,
            ports: (1, 2),
            configured,
            user_agent,
            snapshot: &snapshot,
            domain_id: DomainId(0),
        };
        assert_eq!(client.rmw_implementation(), DEFAULT_RMW);
        client.dialect()
    }

    #[test]
    fn the_first_known_source_determines_the_distribution() {
        use Dialect::{Humble, Jazzy, Kilted, Rolling};
        let hash: &[TypeHash] = &[TypeHash([1; 32])];
        let python = |release| Some(release);
        let all = chosen_dialect(
            Some(Kilted),
            Some(Rolling),
            python("Python-xmlrpc/3.10"),
            hash,
        );
        assert_eq!(all, Kilted);
        assert_eq!(
            chosen_dialect(None, Some(Rolling), python("Python-xmlrpc/3.10"), hash),
            Rolling
        );
        for (agent, expected) in [
            ("Python-xmlrpc/3.8", Humble),
            ("Python-xmlrpc/3.10", Humble),
            ("Python-xmlrpc/3.12", Jazzy),
            ("Python-xmlrpc/3.14", Rolling),
            ("Python-xmlrpc/3.11", Jazzy),
            ("curl/8", Jazzy),
        ] {
            assert_eq!(
                chosen_dialect(None, None, python(agent), hash),
                expected,
                "{agent}"
            );
        }
        assert_eq!(
            chosen_dialect(None, None, python("Python-xmlrpc/3.11"), &[]),
            Humble
        );
        assert_eq!(announced(&Snapshot::default(), DomainId(0)), None);
    }

    #[test]
    fn the_rmw_implementation_is_that_of_all_ros_participants() {
        let mut snapshot = sample_robot::snapshot(["/points"]);
        let common = |snapshot: &Snapshot| common_rmw(snapshot, DomainId(0));
        assert_eq!(common(&snapshot), Some("rmw_fastrtps_cpp"));
        let mut other = snapshot.participants[0].clone();
        other.vendor = VendorId::CYCLONE;
        snapshot.participants.push(other.clone());
        assert_eq!(common(&snapshot), None);
        snapshot.participants = vec![other];
        assert_eq!(common(&snapshot), Some("rmw_cyclonedds_cpp"));
        assert_eq!(common_rmw(&snapshot, DomainId(1)), None);
    }
}
