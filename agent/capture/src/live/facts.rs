//! What the live source reports about itself: its taps, its counters, and what it does not see.

use std::collections::BTreeMap;
use std::path::Path;

use ros2probe_wire::filter::Counter;
use ros2probe_wire::{GuidPrefix, Timestamp};

use super::{CaptureError, DropCount, InterfaceCount, LiveSource, Part, Shm, Stalled};
use crate::filter::Filter;
use crate::filter_reader::FilterReader;
use crate::host_tap::HostTap;
use crate::inside::{Facts as InsideFacts, Inside};
use crate::settings::WireChoice;
use crate::shm;
use crate::streams::Streams;
use crate::uprobe::Uprobe;
use crate::uprobe::search::Facts as UprobeFacts;
use crate::wire_tap::WireTap;

impl LiveSource {
    /// Returns the state of the source inside processes, if it is used.
    #[must_use]
    pub fn inside(&self) -> Option<InsideFacts> {
        self.inside.as_ref().map(Inside::facts)
    }

    /// Returns why processes are not observed from inside although that is configured.
    #[must_use]
    pub fn without_inside(&self) -> Option<&str> {
        self.without_inside.as_deref()
    }

    /// Returns the tap at the host's sockets, if it is used.
    #[must_use]
    pub const fn host(&self) -> Option<&HostTap> {
        self.host.as_ref()
    }

    /// Returns whether interfaces are observed.
    #[must_use]
    pub const fn is_on_the_wire(&self) -> bool {
        !self.wires.is_empty()
    }

    /// Returns how interfaces are observed, which is the same in all namespaces; `None` if none are.
    #[must_use]
    pub fn wire_hook(&self) -> Option<WireChoice> {
        self.wires.first().map(WireTap::hook)
    }

    /// Returns why tcx is not used on interfaces, as a sentence; `None` if it is used, or not
    /// configured.
    #[must_use]
    pub fn without_tcx(&self) -> Option<&str> {
        self.wires.iter().find_map(WireTap::without_tcx)
    }

    /// Returns why the host hook is not used although it would show more, as a sentence; `None` if
    /// it is used, or not configured.
    #[must_use]
    pub fn without_host(&self) -> Option<&str> {
        self.without_host.as_deref()
    }

    /// Returns the number of updates that did not fit a kernel map or that the kernel refused.
    #[must_use]
    pub fn refused_updates(&self) -> u64 {
        let interfaces: u64 = self.wires.iter().map(WireTap::refused_interfaces).sum();
        self.refused_updates + interfaces
    }

    /// Returns the time before which all captured data has been passed to the model.
    #[must_use]
    pub const fn clock(&self) -> Timestamp {
        self.clock
    }

    /// Returns the time of each followed participant's last message.
    #[must_use]
    pub fn last_seen(&self) -> BTreeMap<GuidPrefix, Timestamp> {
        let mut seen = BTreeMap::new();
        for (participant, at) in self.filters().flat_map(Filter::participants) {
            let at = self.clocks.wall_time_of(at);
            let latest = seen.entry(participant).or_insert(at);
            *latest = at.max(*latest);
        }
        seen
    }

    /// Iterates over captured frames by interface.
    pub fn packets(&self) -> impl Iterator<Item = InterfaceCount> + '_ {
        self.wires.iter().flat_map(|wire| {
            wire.packets().map(|(name, packets)| InterfaceCount {
                namespace: wire.namespace().map(Path::to_path_buf),
                name,
                packets,
            })
        })
    }

    /// Returns the number of frames that the kernel dropped in each namespace.
    ///
    /// # Errors
    /// Fails if the kernel's statistics cannot be read.
    pub fn drops(&mut self) -> Result<Vec<DropCount>, CaptureError> {
        self.wires
            .iter_mut()
            .map(|wire| {
                wire.check_namespace();
                Ok(DropCount {
                    dropped: wire.drops()?,
                    namespace: wire.namespace().map(Path::to_path_buf),
                })
            })
            .collect()
    }

    /// Returns the kernel programs' counters, summed over all filters.
    ///
    /// # Errors
    /// Fails if the kernel's counters cannot be read.
    pub fn counters(&self) -> Result<Vec<(Counter, u64)>, CaptureError> {
        let mut sums: Vec<_> = Counter::ALL.map(|counter| (counter, 0)).into();
        for filter in self.filters() {
            for ((_, sum), (_, value)) in sums.iter_mut().zip(filter.counters()?) {
                *sum += value;
            }
        }
        Ok(sums)
    }

    /// Returns the bytes read from the kernel: frames, datagrams and records.
    #[must_use]
    pub fn copied_bytes(&self) -> u64 {
        let host: u64 = self.readers().map(FilterReader::copied_bytes).sum();
        host + self.wires.iter().map(WireTap::copied_bytes).sum::<u64>()
    }

    /// Returns the number of datagrams that never became complete, in the kernel programs or here.
    #[must_use]
    pub fn incomplete_datagrams(&self) -> u64 {
        let host: u64 = self.readers().map(FilterReader::incomplete_datagrams).sum();
        let wires = self.wires.iter().map(WireTap::incomplete_datagrams);
        host + wires.sum::<u64>()
    }

    /// Returns the bytes held for IP reassembly.
    #[must_use]
    pub fn reassembly_bytes(&self) -> usize {
        self.wires.iter().map(WireTap::reassembly_bytes).sum()
    }

    /// Returns the bytes held for captured datagrams that arrive in pieces.
    #[must_use]
    pub fn waiting_bytes(&self) -> usize {
        self.readers().map(FilterReader::waiting_bytes).sum()
    }

    /// Returns the number of datagrams discarded because of the caps of IP reassembly.
    #[must_use]
    pub fn reassembly_evicted(&self) -> u64 {
        self.wires.iter().map(WireTap::reassembly_evicted).sum()
    }

    /// Iterates over the tables of Zenoh connections: one for the sockets, and one for each
    /// namespace.
    pub fn streams(&self) -> impl Iterator<Item = &Streams> {
        let host = self.host.iter().map(|host| host.reader().streams());
        host.chain(self.wires.iter().map(WireTap::streams))
    }

    /// Returns facts about the shared-memory tap, if it runs.
    #[must_use]
    pub fn shared_memory(&self) -> Option<shm::Facts> {
        match &self.shared_memory {
            Shm::Running(shared_memory) => Some(shared_memory.facts()),
            Shm::Off | Shm::Later(..) => None,
        }
    }

    /// Returns whether shared memory is, or will be, observed.
    #[must_use]
    pub const fn looks_at_shared_memory(&self) -> bool {
        !matches!(self.shared_memory, Shm::Off)
    }

    /// Returns facts about the probes in processes that send through shared memory; `None` if
    /// probes are not configured or not available.
    #[must_use]
    pub fn exact(&self) -> Option<UprobeFacts> {
        self.exact.as_ref().map(Uprobe::facts)
    }

    /// Returns the number of messages captured whole in the processes that sent them; `None`
    /// without uprobes.
    #[must_use]
    pub fn messages_of_processes(&self) -> Option<u64> {
        Some(self.exact.as_ref()?.reader().datagrams())
    }

    /// Returns why messages are not read in their senders although that is configured, as a
    /// sentence; otherwise `None`.
    #[must_use]
    pub fn without_exact(&self) -> Option<&str> {
        self.without_exact.as_deref()
    }

    /// Returns a sentence about a configured object that does not exist and yields no data; `None` if
    /// all exist.
    #[must_use]
    pub fn missing_object(&self) -> Option<String> {
        let cgroup = self.host.as_ref().and_then(HostTap::detached);
        let gone = || self.wires.iter().find_map(WireTap::missing_object);
        cgroup.or_else(gone).or_else(|| self.absent_interface())
    }

    /// Returns a sentence about an interface that the configuration names and that no observed
    /// namespace has had since the start.
    fn absent_interface(&self) -> Option<String> {
        let mut names = self.wires.first()?.named_interfaces();
        let is_absent = |name: &&str| !self.wires.iter().any(|wire| wire.has_known(name));
        let name = names.find(is_absent)?;
        Some(format!("the interface {name} does not exist"))
    }

    /// Returns a sentence about what is not observed yet after the start; `None` if everything is
    /// observed. Processes that started before the agent may use a library that has no probes yet.
    #[must_use]
    pub fn pending(&self) -> Option<String> {
        let exact = self.exact.as_ref().map(|exact| exact.facts().has_inspected);
        let inside = self.inside().map(|facts| facts.has_inspected);
        let sources = [("capture.shm.exact", exact), ("capture.inside", inside)];
        let mut pending = sources.iter().filter(|(_, done)| *done == Some(false));
        let (key, _) = pending.next()?;
        Some(format!(
            "{key}: the running processes have not been inspected yet"
        ))
    }

    /// Iterates over the parts whose threads make no progress: a file or a system call does not
    /// return.
    pub fn stalled(&self) -> impl Iterator<Item = Stalled> {
        let shared_memory = match &self.shared_memory {
            Shm::Running(shared_memory) => shared_memory.stalled(),
            Shm::Off | Shm::Later(..) => None,
        };
        let threads = [
            (
                Part::ControlGroup,
                self.host.as_ref().and_then(HostTap::stalled),
            ),
            (Part::SharedMemory, shared_memory),
            (Part::Exact, self.exact.as_ref().and_then(Uprobe::stalled)),
            (Part::Inside, self.inside.as_ref().and_then(Inside::stalled)),
        ];
        let stalled = threads.into_iter();
        stalled.filter_map(|(part, time)| time.map(|time| Stalled { part, time }))
    }

    /// Returns the number of attachments of the host hook to a recreated control group.
    #[must_use]
    pub fn reattachments(&self) -> u64 {
        self.host.as_ref().map_or(0, HostTap::reattachments)
    }
}
