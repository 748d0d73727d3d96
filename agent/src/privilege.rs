//! What the agent may do: which capabilities live capture needs, and giving up the rest once
//! sockets and BPF programs are open.

use std::fmt;

use caps::errors::CapsError;
use caps::{CapSet, Capability, CapsHashSet};

use crate::config::CaptureSettings;

/// Packet sockets; the kernel filter; tracing helpers and the verifier's leave to skip Spectre
/// barriers, without which 5.15 to 6.8 refuse the filter.
const LIVE: [Capability; 3] = [
    Capability::CAP_NET_RAW,
    Capability::CAP_BPF,
    Capability::CAP_PERFMON,
];

/// Live capture is not possible for lack of these.
#[derive(Debug, PartialEq, Eq)]
pub struct Missing(Vec<Capability>);

/// Why privileges could not be given up.
#[derive(Debug, thiserror::Error)]
#[error("cannot give up privileges: {0}")]
pub struct DropError(CapsError);

/// Looks for what capturing as `settings` say needs.
///
/// # Errors
/// The capabilities that are not effective. When they cannot be read, opening the sockets will tell.
pub fn check(settings: &CaptureSettings) -> Result<(), Missing> {
    let Ok(effective) = caps::read(None, CapSet::Effective) else {
        return Ok(());
    };
    let missing = missing(&effective, !settings.network_namespaces.is_empty());
    if missing.is_empty() {
        Ok(())
    } else {
        Err(Missing(missing))
    }
}

fn missing(effective: &CapsHashSet, namespaces: bool) -> Vec<Capability> {
    // The old, wider capability still counts for both of its successors.
    let admin = effective.contains(&Capability::CAP_SYS_ADMIN);
    let has = |capability: &Capability| {
        effective.contains(capability) || (admin && *capability != Capability::CAP_NET_RAW)
    };
    let entering = namespaces.then_some(Capability::CAP_SYS_ADMIN);
    LIVE.into_iter()
        .chain(entering)
        .filter(|capability| !has(capability))
        .collect()
}

/// Gives up every capability but `CAP_BPF`, which later changes of the filter's maps need where
/// unprivileged BPF is disabled. Call it while the process has one thread: capabilities belong
/// to threads, and new ones inherit them.
///
/// # Errors
/// When the kernel refuses, which it does not for a process that gives up what it has.
pub fn give_up() -> Result<(), DropError> {
    let keep = |set: CapsHashSet| -> CapsHashSet {
        set.into_iter()
            .filter(|capability| *capability == Capability::CAP_BPF)
            .collect()
    };
    let permitted = caps::read(None, CapSet::Permitted).map_err(DropError)?;
    if caps::has_cap(None, CapSet::Effective, Capability::CAP_SETPCAP).map_err(DropError)? {
        for capability in caps::read(None, CapSet::Bounding).map_err(DropError)? {
            caps::drop(None, CapSet::Bounding, capability).map_err(DropError)?;
        }
    }
    let kept = keep(permitted);
    caps::clear(None, CapSet::Ambient).map_err(DropError)?;
    caps::clear(None, CapSet::Inheritable).map_err(DropError)?;
    caps::set(None, CapSet::Effective, &kept).map_err(DropError)?;
    caps::set(None, CapSet::Permitted, &kept).map_err(DropError)
}

impl fmt::Display for Missing {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let names: Vec<String> = self.0.iter().map(Capability::to_string).collect();
        let grant: Vec<String> = LIVE
            .iter()
            .chain(
                self.0
                    .iter()
                    .filter(|capability| !LIVE.contains(capability)),
            )
            .map(|capability| capability.to_string().to_lowercase())
            .collect();
        let program = std::env::current_exe();
        let program = program.map_or_else(|_| "rp".to_owned(), |path| path.display().to_string());
        write!(
            f,
            "live capture needs {}: run `sudo setcap {}+ep {program}`, use sudo, or start the \
             service ros2probe",
            names.join(", "),
            grant.join(","),
        )
    }
}

impl std::error::Error for Missing {}

#[cfg(test)]
mod tests {
    use super::*;

    fn set(capabilities: &[Capability]) -> CapsHashSet {
        capabilities.iter().copied().collect()
    }

    #[test]
    fn three_capabilities_are_enough_for_this_host() {
        assert_eq!(missing(&set(&LIVE), false), []);
        assert_eq!(missing(&set(&LIVE), true), [Capability::CAP_SYS_ADMIN]);
        assert_eq!(missing(&set(&[]), false), LIVE);
        let old = set(&[Capability::CAP_NET_RAW, Capability::CAP_SYS_ADMIN]);
        assert_eq!(missing(&old, true), []);
    }

    #[test]
    fn the_message_names_what_is_missing_and_the_command_that_grants_it() {
        let message = Missing(vec![Capability::CAP_BPF]).to_string();
        assert!(
            message.starts_with("live capture needs CAP_BPF: "),
            "{message}"
        );
        assert!(
            message.contains("sudo setcap cap_net_raw,cap_bpf,cap_perfmon+ep /"),
            "{message}"
        );
    }
}
