//! Writers whose announcement the agent missed: the sentence about them, and the command that
//! requests their announcements. All surfaces use this sentence and this command.

use ros2probe_api::participants::{Participant, UnknownWriter};
use ros2probe_model::report::snapshot::{ParticipantFacts, Snapshot};
use ros2probe_wire::GuidPrefix;
use ros2probe_wire::rtps::VendorId;

/// Command that requests the announcements of all DDS participants. Without `--all`, it only lists
/// the participants.
pub const DISCOVER_COMMAND: &str = "sudo rp discover --all";
/// Command that requests the discovery state of a Zenoh router.
pub const DISCOVER_ROUTER_COMMAND: &str = "rp discover --router";
/// Both commands in one.
const DISCOVER_BOTH_COMMANDS: &str = "sudo rp discover --all && rp discover --router";

/// Command that makes participants repeat by TCP what they announce: it starts another participant
/// with the same transports.
const TCP_REMEDY: &str =
    "FASTDDS_BUILTIN_TRANSPORTS=LARGE_DATA ros2 node list --no-daemon --spin-time 5";

/// How a participant announces its endpoints.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Announces {
    /// By UDP.
    Udp,
    /// By TCP. No command of `rp` can request it.
    Tcp,
    /// As tokens of Zenoh.
    Zenoh,
}

impl Announces {
    /// Returns how this participant does.
    #[must_use]
    pub fn of(participant: &Participant<'_>) -> Self {
        match is_zenoh(&participant.vendor) {
            true => Self::Zenoh,
            false if participant.announces_by_tcp => Self::Tcp,
            false => Self::Udp,
        }
    }

    /// Returns how this participant of a snapshot does.
    fn of_facts(participant: &ParticipantFacts) -> Self {
        match participant.guid.prefix.is_zenoh() {
            true => Self::Zenoh,
            false if participant.announces_by_tcp => Self::Tcp,
            false => Self::Udp,
        }
    }
}

/// Returns the command that requests announcements; `None` without any. Announcements by TCP are
/// omitted if there are others.
pub fn command(announced: impl IntoIterator<Item = Announces>) -> Option<&'static str> {
    let (mut has_zenoh, mut has_udp, mut has_tcp) = (false, false, false);
    for each in announced {
        has_zenoh |= each == Announces::Zenoh;
        has_udp |= each == Announces::Udp;
        has_tcp |= each == Announces::Tcp;
    }
    match (has_zenoh, has_udp) {
        (false, false) => has_tcp.then_some(TCP_REMEDY),
        (false, true) => Some(DISCOVER_COMMAND),
        (true, false) => Some(DISCOVER_ROUTER_COMMAND),
        (true, true) => Some(DISCOVER_BOTH_COMMANDS),
    }
}

/// Returns the command that requests the announcements of the snapshot's unknown writers.
#[must_use]
pub fn remedy(snapshot: &Snapshot) -> Option<&'static str> {
    let announces = |prefix: GuidPrefix| {
        let mut participants = snapshot.participants.iter();
        let known = participants.find(|participant| participant.guid.prefix == prefix);
        match prefix.is_zenoh() {
            true => Announces::Zenoh,
            false => known.map_or(Announces::Udp, Announces::of_facts),
        }
    };
    let writers = snapshot.unknown_writers.iter();
    command(writers.map(|writer| announces(writer.guid.prefix)))
}

/// Returns the command that requests the announcements of participants without a known topic.
/// Returns `None` if it can request none of theirs.
#[must_use]
pub fn remedy_for_participants(participants: &[&ParticipantFacts]) -> Option<&'static str> {
    let is_alone = |each: &ParticipantFacts| {
        let mut others = participants.iter();
        !others.any(|other| other.domain_id == each.domain_id && other.guid != each.guid)
    };
    command(participants.iter().filter_map(|each| {
        let is_server = each.discovery_server && each.enclave.is_none();
        // A participant that is alone has no connection that could be unseen.
        let is_hidden = each.secured || each.announces_unseen && !is_alone(each);
        (!is_server && !is_hidden).then(|| Announces::of_facts(each))
    }))
}

/// Returns the command for writers as the API lists them, beside the participants.
#[must_use]
pub fn remedy_for(
    writers: &[UnknownWriter<'_>],
    participants: &[Participant<'_>],
) -> Option<&'static str> {
    command(writers.iter().map(|writer| {
        // A GUID begins with the prefix of its participant.
        let prefix = writer.guid.split('.').next();
        let is_own = |participant: &&Participant<'_>| participant.guid.split('.').next() == prefix;
        match (is_zenoh(&writer.vendor), participants.iter().find(is_own)) {
            (true, _) => Announces::Zenoh,
            (false, Some(participant)) => Announces::of(participant),
            (false, None) => Announces::Udp,
        }
    }))
}

/// Returns whether `vendor` is the name of Zenoh in the API.
#[must_use]
pub fn is_zenoh(vendor: &str) -> bool {
    VendorId::ZENOH.to_string() == vendor
}

/// Returns the sentence about this many active writers.
#[must_use]
pub fn sentence(writers: usize) -> String {
    match writers {
        1 => "1 writer is active whose announcement was missed; its topic is unknown".to_owned(),
        many => format!(
            "{many} writers are active whose announcement was missed; their topics are unknown"
        ),
    }
}

/// Reason for participants without a known topic if no command can request their announcements.
pub const NOTHING_TO_REQUEST: &str = "Discovery Servers have none, and encryption, or TCP between \
    other hosts, hides those of others";

/// Returns the end of a sentence about missing names: the reason and the remedy.
#[must_use]
pub fn explanation(remedy: &str) -> String {
    format!("the agent started after them; `{remedy}` requests their announcements")
}

#[cfg(test)]
mod tests {
    use ros2probe_testing::sample_robot;
    use ros2probe_wire::{DomainId, EntityId, Guid};

    use super::*;

    fn facts(number: u8, domain_id: u32) -> ParticipantFacts {
        ParticipantFacts {
            guid: Guid {
                prefix: GuidPrefix([number; 12]),
                entity: EntityId([0, 0, 1, 0xc1]),
            },
            domain_id: DomainId(domain_id),
            ..sample_robot::participant()
        }
    }

    /// Earlier, the command was also named where no participant could answer it.
    #[test]
    fn the_command_is_named_only_if_a_participant_can_answer_it() {
        let of = |participants: &[ParticipantFacts]| {
            let participants: Vec<_> = participants.iter().collect();
            remedy_for_participants(&participants)
        };
        let server = ParticipantFacts {
            discovery_server: true,
            enclave: None,
            ..facts(1, 0)
        };
        let secured = ParticipantFacts {
            secured: true,
            ..facts(2, 0)
        };
        let unseen = |number, domain_id| ParticipantFacts {
            announces_by_tcp: true,
            announces_unseen: true,
            ..facts(number, domain_id)
        };
        assert_eq!(of(&[]), None);
        assert_eq!(of(std::slice::from_ref(&server)), None);
        assert_eq!(of(&[server.clone(), secured]), None);
        assert_eq!(of(&[unseen(3, 0), unseen(4, 0)]), None);
        // The connection of a participant to one that starts later may be readable.
        assert_eq!(of(&[unseen(3, 0), unseen(4, 1)]), Some(TCP_REMEDY));
        assert_eq!(of(&[server.clone(), facts(5, 0)]), Some(DISCOVER_COMMAND));
        // A process with nodes may run a server, too.
        let both = ParticipantFacts {
            enclave: Some("/".into()),
            ..server
        };
        assert_eq!(of(&[both]), Some(DISCOVER_COMMAND));
    }

    #[test]
    fn the_remedy_requests_announcements_from_the_middleware_of_the_writers() {
        let writer = |vendor: &'static str| UnknownWriter {
            vendor: vendor.into(),
            ..UnknownWriter::default()
        };
        let (dds, zenoh) = (writer("eProsima Fast DDS"), writer("Eclipse Zenoh"));
        let remedy = |writers: &[&UnknownWriter<'static>]| {
            let writers: Vec<_> = writers.iter().map(|writer| (*writer).clone()).collect();
            remedy_for(&writers, &[])
        };
        assert_eq!(remedy(&[]), None);
        assert_eq!(remedy(&[&dds]), Some("sudo rp discover --all"));
        assert_eq!(remedy(&[&writer("")]), Some("sudo rp discover --all"));
        assert_eq!(remedy(&[&zenoh]), Some("rp discover --router"));
        let both = remedy(&[&zenoh, &dds]).unwrap();
        assert!(
            both.contains(DISCOVER_COMMAND) && both.contains(DISCOVER_ROUTER_COMMAND),
            "{both}"
        );
    }

    #[test]
    fn what_is_announced_by_tcp_is_not_requested_with_a_command_of_rp() {
        let writer = UnknownWriter {
            guid: "010f0d04ca2ab1e800000000.00001103".to_owned(),
            vendor: "eProsima Fast DDS".into(),
            ..UnknownWriter::default()
        };
        let participant = |announces_by_tcp| Participant {
            guid: "010f0d04ca2ab1e800000000.000001c1".to_owned(),
            announces_by_tcp,
            ..Participant::default()
        };
        let remedy = |by_tcp| remedy_for(std::slice::from_ref(&writer), &[participant(by_tcp)]);
        assert_eq!(remedy(true), Some(TCP_REMEDY));
        assert_eq!(remedy(false), Some(DISCOVER_COMMAND));
        let both = [Announces::Tcp, Announces::Udp];
        assert_eq!(command(both), Some(DISCOVER_COMMAND));
    }
}
