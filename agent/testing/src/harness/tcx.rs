//! Programs at the tcx hooks of a host's interfaces, as the kernel lists them.

use std::time::Duration;

use anyhow::{Context as _, Result};
use ros2probe_capture::bpf::count_programs;
use ros2probe_capture::interfaces::Interfaces;
use ros2probe_capture::netns;
use ros2probe_capture::tcx::{BPF_TCX_EGRESS, BPF_TCX_INGRESS};

use super::network::Namespace;
use super::wait_within;

/// Returns the index of an interface of the calling thread's namespace.
pub fn interface_index(interface: &str) -> Result<u32> {
    let interfaces = Interfaces::open()?;
    let found = interfaces.iter().find(|it| it.name == interface);
    Ok(found.context("the interface does not exist")?.index)
}

/// Returns the number of programs at an interface of a host, for received and for sent packets.
pub fn attached(host: &Namespace, interface: &str) -> Result<[u32; 2]> {
    let count = netns::within(&host.network(), || -> Result<[u32; 2]> {
        let index = interface_index(interface)?;
        Ok([
            count_programs(index, BPF_TCX_INGRESS)?,
            count_programs(index, BPF_TCX_EGRESS)?,
        ])
    })?;
    count.with_context(|| format!("{interface} of {}", host.name()))
}

/// Waits for the number of programs: the kernel removes links shortly after their last descriptor
/// is closed.
pub fn wait_attached(
    host: &Namespace,
    interface: &str,
    programs: [u32; 2],
    limit: Duration,
) -> Result<()> {
    let what = format!("{programs:?} programs at {interface}");
    wait_within(limit, &what, || Ok(attached(host, interface)? == programs))
}
