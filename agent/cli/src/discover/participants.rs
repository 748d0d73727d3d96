//! Finds participants by their periodic announcements, with the agent's capture. Nothing is sent.

use std::time::{Duration, Instant};

use anyhow::Result;
use ros2probe_capture::live::LiveSource;
use ros2probe_capture::reassembly::Limits;
use ros2probe_daemon::config::{CaptureSettings, InsideChoice, ShmMode, SourceChoice};
use ros2probe_daemon::privilege;
use ros2probe_model::graph::discovery::hexadecimal;
use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::{Observer, Settings};
use ros2probe_model::report::snapshot::{ParticipantFacts, ProcessFacts};
use ros2probe_wire::GuidPrefix;

use super::Refusal;
use super::session::Target;

/// The polling period while listening.
const POLL_INTERVAL: Duration = Duration::from_millis(250);

/// Sources, duration and filter of listening.
#[derive(Clone, Debug)]
pub struct Listening {
    /// Interface to capture instead of the configured sources.
    pub interface: Option<String>,
    /// Domain; `None` for any.
    pub domain_id: Option<u32>,
    /// Participant whose first announcement ends the listening; `None` for any.
    pub participant: Option<GuidPrefix>,
    /// Duration of listening.
    pub time: Duration,
}

/// A participant that announced itself.
#[derive(Clone, Debug)]
pub struct FoundParticipant {
    /// The participant's GUID prefix.
    pub prefix: GuidPrefix,
    /// Domain of the participant.
    pub domain_id: u32,
    /// DDS implementation.
    pub vendor: String,
    /// Name of its process, if known.
    pub process: Option<String>,
    /// Id of its process, if known.
    pub process_id: Option<u32>,
    /// Host, if known.
    pub host: Option<String>,
    /// Target of requests, or the reason why the participant receives none.
    pub target: Result<Target, Refusal>,
}

/// Opens the configured sources, drops the privileges of this thread, and listens.
///
/// # Errors
///
/// Returns [`privilege::Missing`] if a capability is missing, or the error of a source that cannot
/// be opened or read.
pub fn listen(configured: CaptureSettings, listening: &Listening) -> Result<Vec<FoundParticipant>> {
    let capture = capture(configured, listening.interface.as_deref());
    privilege::check(&capture)?;
    let mut live = LiveSource::open(&capture, Limits::default())?;
    privilege::drop_capabilities(privilege::Role::capture())?;
    let mut observer = Observer::new(Settings::default());
    let end = Instant::now() + listening.time;
    let is_meant = |participant: &ParticipantFacts| {
        let (domain_id, prefix) = (participant.domain_id.0, participant.guid.prefix);
        listening.domain_id.is_none_or(|it| it == domain_id)
            && listening.participant.is_none_or(|it| it == prefix)
    };
    loop {
        let left = end.saturating_duration_since(Instant::now());
        live.poll(left.min(POLL_INTERVAL), None, &mut observer)?;
        observer.input(Input::Time(live.clock()));
        live.apply(&observer.drain().interest);
        let mut found = observer.snapshot(live.clock()).participants;
        found.retain(is_meant);
        let is_found = listening.participant.is_some() && !found.is_empty();
        if left.is_zero() || is_found {
            return Ok(found.iter().map(FoundParticipant::of).collect());
        }
    }
}

/// Parses a GUID prefix of 24 hexadecimal digits. The entity id that the `participant` label of
/// metrics appends is accepted. Returns `None` for any other text.
#[must_use]
pub fn prefix(text: &str) -> Option<GuidPrefix> {
    let text = text.strip_suffix(".000001c1").unwrap_or(text);
    hexadecimal(text).map(GuidPrefix)
}

impl FoundParticipant {
    fn of(facts: &ParticipantFacts) -> Self {
        let ProcessFacts { name, id, host, .. } = &facts.process;
        Self {
            prefix: facts.guid.prefix,
            domain_id: facts.domain_id.0,
            vendor: facts
                .vendor
                .name()
                .map_or_else(|| facts.vendor.to_string(), str::to_owned),
            process: name.as_deref().map(str::to_owned),
            process_id: *id,
            host: host.as_deref().map(str::to_owned),
            target: Target::of(facts),
        }
    }
}

/// Returns the configured capture, or the capture of one interface.
fn capture(mut configured: CaptureSettings, interface: Option<&str>) -> CaptureSettings {
    // Participants announce themselves on the network.
    configured.shm.mode = ShmMode::Off;
    configured.inside = InsideChoice::Off;
    let Some(interface) = interface else {
        return configured;
    };
    CaptureSettings {
        source: SourceChoice::Wire,
        cgroup: None,
        mirror_interfaces: Vec::new(),
        include_interfaces: vec![interface.to_owned()],
        exclude_interfaces: Vec::new(),
        ..configured
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ros2probe_daemon::config::Config;

    #[test]
    fn listening_loads_no_program_for_other_processes() {
        for interface in [None, Some("eth0")] {
            let capture = capture(Config::default().capture, interface);
            assert!(!capture.shm.reads_in_senders());
            assert_eq!(capture.inside, InsideChoice::Off);
        }
    }

    #[test]
    fn a_participant_can_be_named_as_in_the_metrics() {
        let digits = "010f1a2b3c4d5e6f00000000";
        assert_eq!(prefix(digits).unwrap().to_string(), digits);
        assert_eq!(prefix(&format!("{digits}.000001c1")), prefix(digits));
        for wrong in [
            "",
            "010f",
            "all",
            &digits[1..],
            &format!("{digits}.00000103"),
        ] {
            assert!(prefix(wrong).is_none(), "{wrong}");
        }
    }
}
