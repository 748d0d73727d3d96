//! Source of packets: this host or a capture, with one interface for the working thread.
//!
//! The source also logs its abilities at the start, and adds facts about itself to each snapshot.

use std::os::fd::BorrowedFd;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use ros2probe_wire::Timestamp;
use ros2probe_wire::filter::Counter;

use super::RunError;
use super::replay::Replay;
use crate::agent_facts::{
    Ability, AgentFacts, ExactFacts, InsideLibrary, InsideSourceFacts, InterfaceFacts,
    SharedMemoryFacts, SourceKind, WireFacts,
};
use crate::config::{CaptureSettings, ExactChoice, InsideChoice};
use ros2probe_capture::error_chain::Reason;
use ros2probe_capture::host_tap::HostTap;
use ros2probe_capture::live::{CaptureError, LiveSource, Part};
use ros2probe_capture::reassembly::Limits;
use ros2probe_capture::shm;
use ros2probe_capture::streams::{Counters, Streams};
use ros2probe_capture::tables::{ZenohStreamBytes, ZenohStreams};
use ros2probe_model::facts::bounded::Declared as _;
use ros2probe_model::observe::observer::Observer;
use ros2probe_model::report::snapshot::TableFacts;

/// Reason why calls are not observed at present.
const INSIDE_IDLE: &str = "capture.inside is auto, and no client needs calls";

/// Source of packets.
pub enum Source {
    /// This host.
    Live(Box<LiveSource>),
    /// A capture.
    Replay(Box<Replay>),
}

/// Returns the facts about an agent with these settings on this host. The taps are opened briefly,
/// but nothing is read.
///
/// # Errors
///
/// Fails if a capability is missing or the kernel refuses.
pub fn probe(settings: &CaptureSettings) -> Result<AgentFacts, CaptureError> {
    let live = LiveSource::open(settings, Limits::default())?;
    Ok(Source::Live(Box::new(live)).facts())
}

impl Source {
    /// Returns the kind of the source.
    #[must_use]
    pub const fn kind(&self) -> SourceKind {
        match self {
            Self::Live(live) => kind(live),
            Self::Replay(_) => SourceKind::Replay,
        }
    }

    /// Logs the source, its abilities and its limits.
    pub fn announce(&self, settings: &CaptureSettings) {
        let Self::Live(live) = self else { return };
        if let Some(reason) = live.without_host() {
            tracing::warn!("host hook not used: {reason}; observing interfaces");
        }
        if let Some(hook) = live.wire_hook() {
            let (hook, reason) = (hook.label(), live.without_tcx());
            tracing::info!(hook, reason, "observing interfaces");
        }
        if let Some(reason) = live.without_exact() {
            let text = format!("capture.shm.exact not used: {reason}; shared memory is sampled");
            match (settings.shm.exact, live.host()) {
                (ExactChoice::Auto, None) => tracing::info!("{text}"),
                _ => tracing::warn!("{text}"),
            }
        }
        if let Some(reason) = live.without_inside() {
            match settings.inside {
                InsideChoice::Auto => tracing::info!("capture.inside not used: {reason}"),
                _ => tracing::warn!("capture.inside not used: {reason}"),
            }
        }
        if !live.is_on_the_wire() && !settings.network_namespaces.is_empty() {
            tracing::info!("capture.network_namespaces is not needed: all sockets are seen");
        }
        for (ability, able) in tracepoint_abilities(live).into_iter().flatten() {
            if let Err(reason) = able {
                tracing::warn!(
                    ability = ability.label(),
                    reason = reason.as_str(),
                    "ability not available on this kernel"
                );
            }
        }
        let able = abilities(live);
        let (sees, blind): (Vec<_>, Vec<_>) = Ability::ALL
            .into_iter()
            .partition(|ability| able.contains(ability));
        let words = |list: Vec<Ability>| list.into_iter().map(Ability::label).collect::<Vec<_>>();
        tracing::info!(
            source = self.kind().label(),
            cgroup = live.host().map(|host| host.cgroup().display().to_string()),
            sees = words(sees).join(", "),
            blind = words(blind).join(", "),
            "observing"
        );
    }

    /// Reads packets for at most `timeout`; from a capture, only those before `until`.
    pub(super) fn poll(
        &mut self,
        timeout: Duration,
        until: Option<Timestamp>,
        bell: Option<BorrowedFd<'_>>,
        observer: &mut Observer,
    ) -> Result<(), RunError> {
        match self {
            Self::Live(live) => Ok(live.poll(timeout, bell, observer)?),
            Self::Replay(replay) => replay
                .poll(timeout, until, observer)
                .map_err(RunError::Replay),
        }
    }

    pub(super) fn clock(&self) -> Timestamp {
        match self {
            Self::Live(live) => live.clock(),
            Self::Replay(replay) => replay.clock(),
        }
    }

    pub(super) fn is_finished(&self) -> bool {
        match self {
            Self::Live(_) => false,
            Self::Replay(replay) => replay.is_finished(),
        }
    }

    /// Returns the time at which a replay ended before its capture; `None` if it did not.
    pub(super) fn cut(&self) -> Option<Timestamp> {
        match self {
            Self::Live(_) => None,
            Self::Replay(replay) => replay.cut(),
        }
    }

    /// Returns whether a replay has reached its pause, at which the state is to be published.
    pub(super) fn reached_pause(&self) -> bool {
        match self {
            Self::Live(_) => false,
            Self::Replay(replay) => replay.reached_pause(),
        }
    }

    /// Returns whether a replay is paused. The state of a paused replay is always current.
    pub(super) fn is_paused(&self) -> bool {
        match self {
            Self::Live(_) => false,
            Self::Replay(replay) => replay.is_paused(),
        }
    }

    /// Reports the pause after the publication.
    pub(super) fn report_pause(&mut self) {
        if let Self::Replay(replay) = self {
            replay.report_pause();
        }
    }

    /// Returns the tables of the source: connections of Zenoh, and the bytes that wait in them.
    pub(super) fn tables(&self) -> [TableFacts; 2] {
        let streams: Vec<_> = match self {
            Self::Live(live) => live.streams().collect(),
            Self::Replay(replay) => vec![replay.streams()],
        };
        let mut sums = [ZenohStreams::TABLE, ZenohStreamBytes::TABLE].map(|table| TableFacts {
            table: table.name,
            size: 0,
            limit: 0,
            bytes: None,
            evictions: 0,
        });
        for each in streams {
            for (sum, table) in sums.iter_mut().zip(each.tables()) {
                sum.size += table.size;
                sum.limit += table.limit;
                sum.evictions += table.evictions;
            }
        }
        sums
    }

    pub(super) fn facts(&mut self) -> AgentFacts {
        let now = Instant::now();
        match self {
            Self::Live(live) => live_facts(live, now),
            Self::Replay(replay) => {
                let (packets, bytes) = replay.progress();
                let reassembly = replay.reassembly();
                let counters = reassembly.counters();
                AgentFacts {
                    finished: replay.is_finished(),
                    capture_begin: replay.began(),
                    replayed: replay.part_read(),
                    replay_speed: Some(replay.started_speed()),
                    replay_faults: replay.faults(),
                    replay_incident: replay.incident().map(|(_, trigger)| trigger.clone()),
                    unsupported_packets: replay
                        .unsupported()
                        .iter()
                        .map(|(link, packets)| (*link, *packets))
                        .collect(),
                    interfaces: vec![InterfaceFacts {
                        name: "replay".to_owned(),
                        packets: Some(packets),
                        dropped: None,
                    }],
                    copied_bytes: bytes,
                    incomplete_datagrams: counters.evicted + counters.timed_out,
                    reassembly_bytes: reassembly.bytes() as u64,
                    reassembly_evicted: counters.evicted,
                    ..AgentFacts::new(SourceKind::Replay, now)
                }
            }
        }
    }
}

fn live_facts(live: &mut LiveSource, now: Instant) -> AgentFacts {
    let named = |namespace: Option<PathBuf>, name: &str| match namespace {
        Some(path) => format!("{}:{name}", path.display()),
        None => name.to_owned(),
    };
    // A socket for all interfaces of a namespace has one drop counter.
    let drops = live.drops().unwrap_or_default();
    let mut interfaces: Vec<_> = drops
        .into_iter()
        .map(|count| InterfaceFacts {
            name: named(count.namespace, "any"),
            packets: None,
            dropped: Some(count.dropped),
        })
        .collect();
    interfaces.extend(live.packets().map(|count| InterfaceFacts {
        name: named(count.namespace, &count.name),
        packets: Some(count.packets),
        dropped: None,
    }));
    interfaces.extend(live.host().map(|host| InterfaceFacts {
        name: "sockets".to_owned(),
        packets: Some(host.reader().datagrams()),
        dropped: None,
    }));
    interfaces.extend(live.messages_of_processes().map(|messages| InterfaceFacts {
        name: "processes".to_owned(),
        packets: Some(messages),
        dropped: None,
    }));
    let gone = live.missing_object();
    let stalled = live.stalled().next().map(|stalled| stalled.to_string());
    let pending = live.pending();
    let counters = live.counters().unwrap_or_default();
    let value = |wanted: Counter| {
        counters
            .iter()
            .find(|(counter, _)| *counter == wanted)
            .map_or(0, |(_, value)| *value)
    };
    AgentFacts {
        interfaces,
        // Bytes are not events; copied bytes are counted below.
        filter_events: counters
            .iter()
            .filter(|(counter, _)| *counter != Counter::CapturedBytes)
            .map(|(counter, value)| (counter.label(), *value))
            .chain(streams(live))
            .collect(),
        copied_bytes: live.copied_bytes(),
        records_dropped: value(Counter::RecordsLost),
        incomplete_datagrams: live.incomplete_datagrams(),
        reassembly_bytes: live.reassembly_bytes() as u64,
        reassembly_evicted: live.reassembly_evicted(),
        pieces_bytes: live.waiting_bytes() as u64,
        refused_updates: live.refused_updates(),
        source_reason: live.without_host().map(str::to_owned),
        wire: live.wire_hook().map(|hook| WireFacts {
            hook: hook.label(),
            reason: live.without_tcx().map(str::to_owned),
        }),
        abilities: abilities(live),
        on_demand: on_demand(live),
        missing_abilities: blind(live),
        missing_object: gone,
        stalled,
        pending,
        reattachments: live.reattachments(),
        pieces_dropped: value(Counter::PiecesLost),
        contended: value(Counter::Contended),
        shared_memory: live.shared_memory().map(shared_memory),
        exact: exact(live),
        inside: inside(live),
        ..AgentFacts::new(kind(live), now)
    }
}

/// Returns the number of batches, frames and gaps that were read in connections of Zenoh and RTPS.
fn streams(live: &LiveSource) -> [(&'static str, u64); 4] {
    let mut events = [
        ("zenoh_read_batches", 0),
        ("zenoh_read_gaps", 0),
        ("rtps_tcp_read_frames", 0),
        ("rtps_tcp_read_gaps", 0),
    ];
    for counters in live.streams().map(Streams::counters) {
        let Counters {
            batches,
            gaps,
            frames,
            frame_gaps,
            ..
        } = counters;
        for ((_, sum), count) in events.iter_mut().zip([batches, gaps, frames, frame_gaps]) {
            *sum += count;
        }
    }
    events
}

/// Returns the state of the source inside processes; `None` if it is off.
fn inside(live: &LiveSource) -> Option<InsideSourceFacts> {
    let Some(facts) = live.inside() else {
        let reason = live.without_inside()?;
        return Some(InsideSourceFacts {
            reason_off: Some(reason.to_owned()),
            ..InsideSourceFacts::default()
        });
    };
    let libraries = facts.libraries.into_iter().map(|library| InsideLibrary {
        path: library.path.display().to_string(),
        processes: library.processes as u64,
        refused: library.refused,
    });
    let idle = || facts.is_idle.then(|| INSIDE_IDLE.to_owned());
    let reason_off = facts.detached.or_else(|| stalled(live, Part::Inside));
    Some(InsideSourceFacts {
        mode: match (facts.is_on_demand, facts.has_callbacks) {
            (true, _) => "auto",
            (false, true) => "full",
            (false, false) => "topics",
        },
        is_idle: facts.is_idle,
        shows_rates: facts.shows_rates,
        libraries: libraries.collect(),
        counters: facts.counters,
        late: facts.late,
        without_events: facts.without_events,
        without_deliveries: facts.without_deliveries,
        reason_off: reason_off.or_else(idle),
    })
}

/// Returns why a part of the source is stalled; `None` if it is not.
fn stalled(live: &LiveSource, part: Part) -> Option<String> {
    let stalled = live.stalled().find(|stalled| stalled.part == part);
    stalled.map(|stalled| stalled.to_string())
}

/// Returns the state of exact mode for each library; empty if exact mode is off. If exact mode is
/// unavailable, one entry without a library has the reason.
fn exact(live: &LiveSource) -> Vec<ExactFacts> {
    let whole = |reason: &str| ExactFacts {
        library: String::new(),
        refused: Some(reason.to_owned()),
    };
    let Some(facts) = live.exact() else {
        return live.without_exact().map(whole).into_iter().collect();
    };
    let libraries = facts.libraries.into_iter().map(|library| ExactFacts {
        library: library.path.display().to_string(),
        refused: library.refused,
    });
    // Several containers may have the same library at the same path.
    let mut libraries: Vec<_> = libraries.collect();
    libraries.sort();
    libraries.dedup();
    libraries.extend(facts.uncovered.as_deref().map(whole));
    libraries
}

fn shared_memory(facts: shm::Facts) -> SharedMemoryFacts {
    let counters = facts.counters;
    SharedMemoryFacts {
        open: vec![
            ("port", counters.ports),
            ("segment", counters.segments),
            ("directory", counters.directories),
        ],
        events: vec![
            ("announced", counters.announced),
            ("read", counters.read),
            ("captured", counters.captured),
            ("missed", counters.missed),
            ("unfilled", counters.unfilled),
            ("unreachable", counters.unreachable),
            ("malformed", counters.malformed),
            ("abandoned", counters.abandoned),
            ("uncertain", counters.uncertain),
            ("left_out", counters.left_out),
            ("refused", facts.refused),
        ],
        cpu_seconds: facts.cpu_seconds,
        polls: facts.polls,
    }
}

/// Returns the abilities of this source on this kernel and with this configuration.
fn abilities(live: &LiveSource) -> Vec<Ability> {
    let mut abilities = kind(live).abilities().to_vec();
    if live.host().is_some_and(|host| host.detached().is_some()) {
        // The sockets, the processes and their shared memory ended with the cgroup.
        return match live.is_on_the_wire() {
            true => vec![Ability::Forwarded],
            false => Vec::new(),
        };
    }
    if live.host().is_some_and(HostTap::is_whole_host) {
        abilities.push(Ability::Containers);
    }
    let inside = tracepoint_abilities(live).into_iter().flatten();
    abilities.extend(inside.filter_map(|(ability, able)| able.is_ok().then_some(ability)));
    if live.host().is_some() && live.is_on_the_wire() {
        abilities.push(Ability::Forwarded);
    }
    let is_stalled = |part| stalled(live, part).is_some();
    if live.looks_at_shared_memory() && !is_stalled(Part::SharedMemory) {
        abilities.push(Ability::SharedMemory);
    }
    let is_exact = live.exact().is_some_and(|facts| facts.uncovered.is_none());
    if is_exact && !is_stalled(Part::Exact) {
        abilities.push(Ability::SharedMemoryExact);
    }
    let is_observed = live.inside().is_some_and(|facts| !facts.is_idle);
    if is_observed && !is_stalled(Part::Inside) {
        abilities.push(Ability::Inside);
    }
    let has_causes = |facts: InsideSourceFacts| {
        facts.late == "events" && facts.reason_off.is_none() && facts.without_causes().is_none()
    };
    if self::inside(live).is_some_and(has_causes) {
        abilities.push(Ability::LateCauses);
    }
    abilities
}

/// Returns missing abilities that this source gains while a client needs them.
fn on_demand(live: &LiveSource) -> Vec<Ability> {
    let is_exact_resting = live.exact().is_some_and(|facts| facts.is_resting);
    let is_inside_resting = live.inside().is_some_and(|facts| facts.is_idle);
    let is_at_sums =
        |facts: InsideSourceFacts| facts.late == "sums" && facts.without_causes().is_none();
    let abilities = [
        is_exact_resting.then_some(Ability::SharedMemoryExact),
        is_inside_resting.then_some(Ability::Inside),
        inside(live)
            .is_some_and(is_at_sums)
            .then_some(Ability::LateCauses),
    ];
    abilities.into_iter().flatten().collect()
}

/// Returns the reasons for missing abilities, if known.
fn blind(live: &LiveSource) -> Vec<(Ability, String)> {
    if let Some(reason) = live.host().and_then(HostTap::detached) {
        let able = abilities(live);
        let lost = Ability::ALL.into_iter().filter(|one| !able.contains(one));
        return lost.map(|ability| (ability, reason.clone())).collect();
    }
    let inside = tracepoint_abilities(live).into_iter().flatten();
    let mut blind: Vec<_> = inside
        .filter_map(|(ability, able)| Some((ability, able.as_ref().err()?.to_string())))
        .collect();
    let uncovered = live.exact().and_then(|facts| facts.uncovered);
    let exact = live.without_exact().map(str::to_owned).or(uncovered);
    let exact = exact.or_else(|| stalled(live, Part::Exact));
    blind.extend(exact.map(|reason| (Ability::SharedMemoryExact, reason)));
    let shared_memory = stalled(live, Part::SharedMemory);
    blind.extend(shared_memory.map(|reason| (Ability::SharedMemory, reason)));
    let inside = live.without_inside().map(str::to_owned);
    let observed = self::inside(live).unwrap_or_default();
    let causes = observed.without_causes().map(str::to_owned);
    let inside = inside.or(observed.reason_off);
    blind.extend(inside.map(|reason| (Ability::Inside, reason)));
    blind.extend(causes.map(|reason| (Ability::LateCauses, reason)));
    blind
}

/// Returns the abilities that depend on tracepoints of the kernel.
fn tracepoint_abilities(live: &LiveSource) -> Option<[(Ability, &Result<(), Reason>); 3]> {
    let abilities = live.host()?.abilities()?;
    Some([
        (Ability::SocketLosses, &abilities.socket_losses),
        (Ability::ReassemblyLosses, &abilities.reassembly_losses),
        (Ability::Owners, &abilities.owners),
    ])
}

const fn kind(live: &LiveSource) -> SourceKind {
    if live.host().is_some() {
        SourceKind::Host
    } else {
        SourceKind::Wire
    }
}
