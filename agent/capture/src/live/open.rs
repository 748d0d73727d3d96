//! Opens the configured taps, or the best ones available.

use std::path::PathBuf;

use super::super::cgroup::CgroupError;
use super::super::host_tap::{HostTap, HostTapError, HostTapSettings};
use super::super::interfaces::Selection;
use super::super::netns;
use super::super::shm::directories::Scope;
use super::super::uprobe::Uprobe;
use super::super::wire_tap::{WireTap, WireTapSettings};
use super::CaptureError;
use crate::error_chain::in_words;
use crate::inside::Inside;
use crate::reassembly::Limits;
use crate::settings::{CaptureSettings, ExactChoice, InsideChoice, LateChoice, SourceChoice};

/// Minimum bytes of a namespace: one fragmented datagram fits, however many namespaces share the
/// cap.
const MIN_REASSEMBLY_BYTES: usize = 1 << 17;

/// Returns the shared memory that belongs to the observed sockets or namespaces.
pub(super) fn scope(settings: &CaptureSettings, host: bool) -> Scope {
    match &settings.cgroup {
        Some(cgroup) if host => Scope::Cgroup(cgroup.clone()),
        _ if host => Scope::AllProcesses,
        _ => {
            let own = PathBuf::from("/proc/self/ns/net");
            let networks = std::iter::once(own).chain(settings.network_namespaces.clone());
            Scope::Networks(networks.collect())
        }
    }
}

/// Returns the tap at the sockets, or why it is unavailable.
pub(super) fn open_host(
    settings: &CaptureSettings,
) -> Result<(Option<HostTap>, Option<String>), CaptureError> {
    let named = !settings.include_interfaces.is_empty() || !settings.exclude_interfaces.is_empty();
    match settings.source {
        SourceChoice::Wire => return Ok((None, None)),
        SourceChoice::Auto if named => {
            let reason = "the configuration names interfaces (capture.interfaces)";
            return Ok((None, Some(reason.to_owned())));
        }
        SourceChoice::Host | SourceChoice::Auto => {}
    }
    let opened = HostTap::open(&HostTapSettings {
        cgroup: settings.cgroup.clone(),
        ring_bytes: settings.ring_bytes,
        record_ring_bytes: settings.record_ring_bytes,
        zenoh_ports: settings.zenoh_ports.clone(),
        deliveries: observes_late_calls(settings),
    });
    match opened {
        Ok(host) => Ok((Some(host), None)),
        Err(error) if settings.source == SourceChoice::Host => Err(error.into()),
        // The group may be created later, and interfaces would show more than the group.
        Err(error @ HostTapError::Hierarchy(CgroupError::Open { .. }))
            if settings.cgroup.is_some() =>
        {
            Err(error.into())
        }
        Err(error) => Ok((None, Some(in_words(&error)))),
    }
}

/// Returns the programs for shared-memory messages, or why they are unavailable. Without them
/// shared memory is sampled.
pub(super) fn open_exact(
    settings: &CaptureSettings,
    host: bool,
) -> (Option<Uprobe>, Option<String>) {
    if !settings.shm.reads_in_senders() {
        return (None, None);
    }
    if !host {
        // Where these programs run, processes can be selected by control group only.
        let reason = "uprobes require observing the host's sockets (capture.source: host)";
        return (None, Some(reason.to_owned()));
    }
    let opened = Uprobe::open(
        settings.cgroup.as_deref(),
        &settings.broker,
        settings.ring_bytes,
        settings.record_ring_bytes,
        settings.shm.exact == ExactChoice::Auto,
    );
    match opened {
        Ok(exact) => (Some(exact), None),
        Err(error) => (None, Some(in_words(&error))),
    }
}

/// Returns the programs inside processes, or why they are unavailable.
/// `host` has the programs that follow deliveries of messages.
pub(super) fn open_inside(
    settings: &CaptureSettings,
    host: Option<&mut HostTap>,
) -> (Option<Inside>, Option<String>) {
    if settings.inside == InsideChoice::Off {
        return (None, None);
    }
    let deliveries = host.and_then(|host| {
        let cgroup = host.directory().try_clone().ok()?;
        Some((host.filter_mut().take_deliveries()?, cgroup))
    });
    match Inside::open(
        (settings.inside, settings.late),
        settings.cgroup.as_deref(),
        &settings.broker,
        deliveries,
    ) {
        Ok(inside) => (Some(inside), None),
        Err(error) => (None, Some(in_words(&error))),
    }
}

/// Returns whether late calls of callbacks are observed.
fn observes_late_calls(settings: &CaptureSettings) -> bool {
    let has_callbacks = matches!(settings.inside, InsideChoice::Full | InsideChoice::Auto);
    has_callbacks && settings.late != LateChoice::Off
}

/// Opens a tap for this namespace and for each configured one.
pub(super) fn open_wires(
    settings: &CaptureSettings,
    limits: Limits,
    selection: Selection,
) -> Result<Vec<WireTap>, CaptureError> {
    // All namespaces together stay within the cap.
    let share = limits.bytes / (1 + settings.network_namespaces.len());
    let limits = Limits {
        bytes: share.max(MIN_REASSEMBLY_BYTES),
        ..limits
    };
    let wire = WireTapSettings {
        wire: settings.wire,
        selection,
        ring_bytes: settings.ring_bytes,
        record_ring_bytes: settings.record_ring_bytes,
        reassembly: limits,
        zenoh_ports: settings.zenoh_ports.clone(),
    };
    let mut wires = vec![WireTap::open(&wire, 0, None)?];
    for (number, path) in (1..).zip(&settings.network_namespaces) {
        let open = || WireTap::open(&wire, number, Some(path.clone()));
        wires.push(netns::within(path, open)??);
    }
    Ok(wires)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::settings::{ShmMode, ShmSettings, WireChoice};

    #[test]
    fn no_program_for_shared_memory_is_loaded_where_it_is_off() {
        let settings = |mode, exact| CaptureSettings {
            source: SourceChoice::Host,
            wire: WireChoice::default(),
            cgroup: None,
            mirror_interfaces: Vec::new(),
            include_interfaces: Vec::new(),
            exclude_interfaces: Vec::new(),
            network_namespaces: Vec::new(),
            ring_bytes: 1 << 20,
            record_ring_bytes: 1 << 20,
            shm: ShmSettings {
                mode,
                exact,
                cpu_percent: 1.0,
                reading_cpu_percent: 1.0,
            },
            inside: InsideChoice::Off,
            late: LateChoice::Off,
            broker: PathBuf::new(),
            zenoh_ports: Vec::new(),
        };
        for (mode, exact) in [
            (ShmMode::Off, ExactChoice::Auto),
            (ShmMode::Off, ExactChoice::Uprobe),
            (ShmMode::Auto, ExactChoice::Off),
        ] {
            let (programs, reason) = open_exact(&settings(mode, exact), true);
            assert!(programs.is_none() && reason.is_none(), "{mode:?} {exact:?}");
        }
        // Without the host's sockets, the reason is reported before a program is loaded.
        let (programs, reason) = open_exact(&settings(ShmMode::Auto, ExactChoice::Auto), false);
        assert!(programs.is_none() && reason.is_some());
    }
}
