//! Writers whose announcement the agent missed: the sentence about them, and the command that
//! requests their announcements. All surfaces use this sentence and this command.

use ros2probe_api::participants::UnknownWriter;
use ros2probe_model::report::snapshot::Snapshot;
use ros2probe_wire::rtps::VendorId;

/// Command that requests the announcements of all DDS participants. Without `--all`, it only lists
/// the participants.
pub const DISCOVER: &str = "sudo rp discover --all";
/// Command that requests the discovery state of a Zenoh router.
pub const DISCOVER_ROUTER: &str = "rp discover --router";
/// Both commands in one.
const DISCOVER_BOTH: &str = "sudo rp discover --all && rp discover --router";

/// Returns the command that requests the announcements of participants or writers, each `true` for
/// one of Zenoh; `None` without any.
pub fn command(of_zenoh: impl IntoIterator<Item = bool>) -> Option<&'static str> {
    let (mut has_zenoh, mut has_dds) = (false, false);
    for is_zenoh in of_zenoh {
        has_zenoh |= is_zenoh;
        has_dds |= !is_zenoh;
    }
    match (has_zenoh, has_dds) {
        (false, false) => None,
        (false, true) => Some(DISCOVER),
        (true, false) => Some(DISCOVER_ROUTER),
        (true, true) => Some(DISCOVER_BOTH),
    }
}

/// Returns the command that requests the announcements which the snapshot lacks: of its unknown
/// writers, else of its participants if no topic is known.
#[must_use]
pub fn remedy(snapshot: &Snapshot) -> Option<&'static str> {
    let writers = snapshot.unknown_writers.iter();
    command(writers.map(|writer| writer.guid.prefix.is_zenoh())).or_else(|| {
        let participants = snapshot.participants.iter();
        let participants = participants.filter(|_| snapshot.topics.is_empty());
        command(participants.map(|participant| participant.guid.prefix.is_zenoh()))
    })
}

/// Returns the command for writers as the API lists them.
#[must_use]
pub fn remedy_for(writers: &[UnknownWriter<'_>]) -> Option<&'static str> {
    command(writers.iter().map(|writer| is_zenoh(&writer.vendor)))
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

/// Returns the end of a sentence about missing names: the reason and the remedy.
#[must_use]
pub fn explanation(remedy: &str) -> String {
    format!("the agent started after them; `{remedy}` requests their announcements")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_remedy_requests_announcements_from_the_middleware_of_the_writers() {
        let writer = |vendor: &'static str| UnknownWriter {
            vendor: vendor.into(),
            ..UnknownWriter::default()
        };
        let (dds, zenoh) = (writer("eProsima Fast DDS"), writer("Eclipse Zenoh"));
        let remedy = |writers: &[&UnknownWriter<'static>]| {
            let writers: Vec<_> = writers.iter().map(|writer| (*writer).clone()).collect();
            remedy_for(&writers)
        };
        assert_eq!(remedy(&[]), None);
        assert_eq!(remedy(&[&dds]), Some("sudo rp discover --all"));
        assert_eq!(remedy(&[&writer("")]), Some("sudo rp discover --all"));
        assert_eq!(remedy(&[&zenoh]), Some("rp discover --router"));
        let both = remedy(&[&zenoh, &dds]).unwrap();
        assert!(
            both.contains(DISCOVER) && both.contains(DISCOVER_ROUTER),
            "{both}"
        );
    }
}
