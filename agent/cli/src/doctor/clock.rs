//! Checks of the clock: whether timestamps of this host are comparable with those of others.

use super::host_state::HostState;
use ros2probe_api::clocks::{ClockOffset, Clocks};
use ros2probe_api::doctor::{Area, Finding, Severity};

const AREA: Area = Area::Clock;
/// Programs that synchronize clocks.
const TIME_DAEMONS: [&str; 7] = [
    "chronyd",
    "ntpd",
    "systemd-timesyn",
    "ptp4l",
    "phc2sys",
    "ntpd-rs",
    "openntpd",
];
/// Estimated error in microseconds above which latencies between hosts are unreliable.
const COARSE_ERROR_MICROSECONDS: i64 = 10_000;
/// Maximum number of hosts in one sentence.
const MAX_NAMED_HOSTS: usize = 3;

/// Returns the findings of all clock checks.
#[must_use]
pub fn check(host: &HostState) -> Vec<Finding> {
    let keepers = keepers(host);
    let report =
        |severity, sentence: String| Finding::new(AREA, "synchronised", severity, sentence);
    let kept = match keepers.as_slice() {
        [] => "no NTP/PTP service found".to_owned(),
        names => format!("kept by {}", names.join(", ")),
    };
    let finding = match &host.clock {
        Err(error) => report(
            Severity::Unknown,
            format!("the kernel does not report whether the clock is synchronised; {kept}"),
        )
        .seen(error.to_string(), "adjtimex(2)")
        .remedy("timedatectl    # or: chronyc tracking"),
        Ok(state) => {
            let (estimated, maximum) = (
                milliseconds(state.estimated_error),
                milliseconds(state.maximum_error),
            );
            let finding = if !state.synchronised {
                let sentence = format!(
                    "the clock is not synchronised ({kept}): latency within this host is right; \
                     between hosts it is off by the difference of their clocks"
                );
                report(Severity::Warning, sentence).remedy(
                    "sudo apt install chrony    # on every host; for microseconds: linuxptp",
                )
            } else if state.maximum_error > COARSE_ERROR_MICROSECONDS
                && state.estimated_error > COARSE_ERROR_MICROSECONDS
            {
                let sentence = format!(
                    "the clock is synchronised to {estimated} ms ({kept}): shorter latencies \
                     between hosts are not meaningful"
                );
                report(Severity::Note, sentence)
                    .remedy("chronyc tracking    # or ptp, for microseconds")
            } else {
                let sentence = format!(
                    "the clock is synchronised, estimated error {estimated} ms, at most {maximum} ms \
                     ({kept})"
                );
                report(Severity::Ok, sentence)
            };
            finding.seen(
                format!(
                    "synchronised {}, error {estimated} ms estimated, {maximum} ms at most",
                    state.synchronised
                ),
                "adjtimex(2)",
            )
        }
    };
    vec![finding.seen(kept, "/proc/<pid>/comm")]
}

/// Returns the finding about the clocks of other hosts; `None` if no offset is known.
#[must_use]
pub fn compared(clocks: &Clocks<'_>) -> Option<Finding> {
    let shown = |offset: &ClockOffset<'_>| {
        let (ahead, error) = (
            1e3 * offset.offset_seconds,
            1e3 * offset.uncertainty_seconds,
        );
        format!("{} {ahead:+.2} ms (± {error:.2} ms)", offset.peer)
    };
    // The offsets of this host come first, one for each peer with both bounds.
    let host = &clocks.offsets.first()?.host;
    let own = clocks
        .offsets
        .iter()
        .take_while(|offset| offset.host == *host);
    let mut own: Vec<_> = own.collect();
    own.sort_by(|one, other| {
        other
            .offset_seconds
            .abs()
            .total_cmp(&one.offset_seconds.abs())
    });
    let apart = own.iter().filter(|offset| {
        1e6 * (offset.offset_seconds.abs() - offset.uncertainty_seconds)
            > COARSE_ERROR_MICROSECONDS as f64
    });
    let apart = apart.count();
    let listed: Vec<_> = own
        .iter()
        .take(MAX_NAMED_HOSTS)
        .map(|offset| shown(offset))
        .collect();
    let severity = if apart > 0 {
        Severity::Warning
    } else {
        Severity::Ok
    };
    let sentence = format!(
        "clocks of other hosts, ahead of this one: {}",
        listed.join(", ")
    );
    let finding = Finding::new(AREA, "offsets", severity, sentence);
    let finding = own.iter().fold(finding, |finding, offset| {
        finding.seen(shown(offset), "GET /clocks")
    });
    Some(match apart {
        0 => finding,
        _ => finding.remedy("chronyc tracking    # on each host"),
    })
}

fn keepers(host: &HostState) -> Vec<&'static str> {
    let mut found: Vec<_> = host
        .files
        .processes()
        .into_iter()
        .filter_map(|id| {
            let name = host.files.text(&format!("/proc/{id}/comm")).ok()?;
            TIME_DAEMONS.into_iter().find(|keeper| *keeper == name)
        })
        .collect();
    found.sort_unstable();
    found.dedup();
    found
}

#[expect(
    clippy::cast_precision_loss,
    reason = "microseconds to be read by people"
)]
fn milliseconds(microseconds: i64) -> String {
    let milliseconds = microseconds as f64 / 1000.0;
    if milliseconds < 10.0 {
        format!("{milliseconds:.2}")
    } else {
        format!("{milliseconds:.0}")
    }
}

#[cfg(test)]
mod tests {
    use super::super::host_state::ReadFailure;
    use super::super::host_state::tests::host;
    use super::*;
    use ros2probe_capture::system::ClockState;

    fn found(clock: Result<ClockState, ReadFailure>) -> Finding {
        let (_directory, mut host) =
            host(&[("/proc/5/comm", "chronyd\n"), ("/proc/6/comm", "sshd\n")]);
        host.clock = clock;
        check(&host).remove(0)
    }

    fn state(synchronised: bool, estimated_error: i64, maximum_error: i64) -> ClockState {
        ClockState {
            synchronised,
            estimated_error,
            maximum_error,
        }
    }

    #[test]
    fn a_synchronized_clock_is_reported_with_its_error_and_its_daemon() {
        let good = found(Ok(state(true, 120, 3_400)));
        assert_eq!(good.severity, Severity::Ok);
        assert_eq!(
            good.sentence,
            "the clock is synchronised, estimated error 0.12 ms, at most 3.40 ms (kept by chronyd)"
        );
    }

    #[test]
    fn offsets_of_other_hosts_are_listed_and_certain_ones_are_a_warning() {
        assert_eq!(compared(&Clocks::default()), None);
        let offset = |host: &'static str, peer: &'static str, offset_seconds| ClockOffset {
            host: host.into(),
            peer: peer.into(),
            offset_seconds,
            uncertainty_seconds: 0.0003,
        };
        let mut clocks = Clocks {
            offsets: vec![
                offset("robot", "nas", 0.0004),
                offset("robot", "camera", -0.009),
                offset("nas", "camera", -0.0094),
            ],
            ..Clocks::default()
        };
        let fine = compared(&clocks).unwrap();
        assert_eq!(fine.severity, Severity::Ok);
        assert_eq!(
            fine.sentence,
            "clocks of other hosts, ahead of this one: camera -9.00 ms (± 0.30 ms), nas +0.40 ms \
             (± 0.30 ms)"
        );
        clocks.offsets[1].offset_seconds = -0.0204;
        let warning = compared(&clocks).unwrap();
        assert_eq!(warning.severity, Severity::Warning);
        assert!(!warning.remedies.is_empty());
    }

    #[test]
    fn coarse_unsynchronized_and_unknown_clocks_are_distinguished() {
        assert_eq!(
            found(Ok(state(true, 50_000, 90_000))).severity,
            Severity::Note
        );
        assert_eq!(found(Ok(state(false, 0, 0))).severity, Severity::Warning);
        let unknown = found(Err(ReadFailure::NotPermitted));
        assert_eq!(unknown.severity, Severity::Unknown);
        assert!(!unknown.remedies.is_empty());
    }
}
