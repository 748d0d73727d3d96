//! The agent's part of the page: what it drops, cannot read or cannot hold (`ros2probe_*`), and its
//! own process (`process_*`).

use std::fmt;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant, SystemTime};

use super::agent_facts::{Ability, InterfaceFacts, SharedMemoryFacts};
use super::board::{Reload, State};
use super::catalogue as metric;
use super::events::EventLog;
use super::limit_facts::{LimitFacts, LimitFigures};
use super::otlp::{Exports, Outcome, Reason};
use super::page::{Label, Page};
use super::process::Process;
use super::recording_facts::{RecordingFigures, SnapshotFigures};
use super::robot::Rows;
use ros2probe_model::payloads::MissedReason;

/// What runs, where its packets come from, and whether it sees.
pub(super) fn identity(page: &mut Page<'_>, state: &State, now: Instant) -> fmt::Result {
    page.family(&metric::BUILD_INFO, |family| {
        let version = Label::Text(env!("CARGO_PKG_VERSION"));
        family.info(&[version, Label::Text(std::env::consts::ARCH)])
    })?;
    page.family(&metric::SOURCE_INFO, |family| {
        let reason = state.agent.source_reason.as_deref().unwrap_or_default();
        family.info(&[Label::Text(state.agent.source.label()), Label::Text(reason)])
    })?;
    page.family(&metric::SANDBOX_INFO, |family| {
        let sandbox = &state.agent.sandbox;
        let reason = sandbox.reason().unwrap_or_default();
        family.info(&[Label::Text(sandbox.label()), Label::Text(reason)])
    })?;
    page.family(&metric::ABILITY, |family| {
        Ability::ALL.into_iter().try_for_each(|ability| {
            let able = state.agent.abilities.contains(&ability);
            family.sample(&[Label::Text(ability.label())], able)
        })
    })?;
    page.single(&metric::READY, state.ready(now).is_ok())
}

/// The capture and the kernel filter.
pub(super) fn capture(page: &mut Page<'_>, state: &State) -> fmt::Result {
    let agent = &state.agent;
    page.family(&metric::CAPTURE_PACKETS, |family| {
        let counted = |each: &InterfaceFacts| Some((each.name.clone(), each.packets?));
        agent
            .interfaces
            .iter()
            .filter_map(counted)
            .try_for_each(|(name, packets)| family.sample(&[Label::Text(&name)], packets))
    })?;
    page.family(&metric::CAPTURE_DROPPED, |family| {
        let counted = |each: &InterfaceFacts| Some((each.name.clone(), each.dropped?));
        agent
            .interfaces
            .iter()
            .filter_map(counted)
            .try_for_each(|(name, dropped)| family.sample(&[Label::Text(&name)], dropped))
    })?;
    page.single(&metric::CAPTURE_COPIED, agent.copied_bytes)?;
    page.family(&metric::FILTER_EVENTS, |family| {
        agent
            .filter_events
            .iter()
            .try_for_each(|(event, count)| family.sample(&[Label::Text(event)], *count))
    })?;
    page.single(&metric::FILTER_REFUSED, agent.refused_updates)?;
    page.single(&metric::RECORDS_DROPPED, agent.records_dropped)?;
    page.single(&metric::PIECES_DROPPED, agent.pieces_dropped)?;
    page.single(&metric::CONTENDED, agent.contended)?;
    page.single(&metric::INCOMPLETE_DATAGRAMS, agent.incomplete_datagrams)?;
    page.single(
        &metric::REASSEMBLY,
        agent.reassembly_bytes + agent.pieces_bytes,
    )?;
    shared_memory(page, agent.shared_memory.as_ref())?;
    page.family(&metric::SHM_EXACT_INFO, |family| {
        agent.exact.iter().try_for_each(|facts| {
            let (state, reason) = match &facts.refused {
                None => ("attached", ""),
                Some(reason) => ("refused", reason.as_str()),
            };
            family.info(&[
                Label::Text(&facts.library),
                Label::Text(state),
                Label::Text(reason),
            ])
        })
    })
}

/// The look at shared memory; nothing where there is none.
fn shared_memory(page: &mut Page<'_>, facts: Option<&SharedMemoryFacts>) -> fmt::Result {
    page.family(&metric::SHM_OPEN, |family| {
        let mut open = facts.into_iter().flat_map(|facts| &facts.open);
        open.try_for_each(|(kind, count)| family.sample(&[Label::Text(kind)], *count))
    })?;
    page.family(&metric::SHM_EVENTS, |family| {
        let mut events = facts.into_iter().flat_map(|facts| &facts.events);
        events.try_for_each(|(event, count)| family.sample(&[Label::Text(event)], *count))
    })?;
    page.family(&metric::SHM_LOOKS, |family| match facts {
        Some(facts) => family.sample(&[], facts.looks),
        None => Ok(()),
    })?;
    page.family(&metric::SHM_CPU, |family| match facts {
        Some(facts) => family.sample(&[], facts.cpu_seconds),
        None => Ok(()),
    })
}

/// The model's tables and what it could not read.
pub(super) fn model(
    page: &mut Page<'_>,
    state: &State,
    rows: &Rows<'_>,
    hidden_deliveries: usize,
    limits: &LimitFigures,
) -> fmt::Result {
    let snapshot = state.snapshot.as_ref();
    let tables = || snapshot.into_iter().flat_map(|snapshot| &snapshot.tables);
    page.single(
        &metric::DATAGRAMS,
        snapshot.map_or(0, |snapshot| snapshot.datagrams),
    )?;
    page.single(
        &metric::RECORDS,
        snapshot.map_or(0, |snapshot| snapshot.records),
    )?;
    page.family(&metric::DECODE_ERRORS, |family| {
        let mut errors = snapshot
            .into_iter()
            .flat_map(|snapshot| &snapshot.decode_errors);
        errors.try_for_each(|error| {
            family.sample(
                &[Label::Text(error.stage), Label::Text(error.reason)],
                error.count,
            )
        })
    })?;
    page.family(&metric::TABLE_ENTRIES, |family| {
        tables().try_for_each(|table| family.sample(&[Label::Text(table.table)], table.size))
    })?;
    page.family(&metric::TABLE_LIMIT, |family| {
        tables().try_for_each(|table| family.sample(&[Label::Text(table.table)], table.limit))
    })?;
    page.family(&metric::TABLE_EVICTIONS, |family| {
        tables().try_for_each(|table| family.sample(&[Label::Text(table.table)], table.evictions))
    })?;
    self::limits(page, limits, state)?;
    let tracked = rows
        .shown
        .iter()
        .filter(|row| row.measurement().is_some())
        .count();
    page.single(&metric::TRACKED_TOPICS, tracked)?;
    page.single(
        &metric::TOPICS_REJECTED,
        snapshot.map_or(0, |snapshot| snapshot.topics_rejected),
    )?;
    page.single(&metric::TOPICS_HIDDEN, rows.hidden)?;
    page.single(&metric::DELIVERIES_HIDDEN, hidden_deliveries)
}

/// The caps of the configuration.
fn limits(page: &mut Page<'_>, figures: &LimitFigures, state: &State) -> fmt::Result {
    type Read = fn(&LimitFacts) -> u64;
    let families: [(_, Read); 4] = [
        (&metric::LIMIT, |facts| facts.cap),
        (&metric::LIMIT_USED, |facts| facts.used),
        (&metric::LIMIT_REACHED, |facts| facts.reached),
        (&metric::AT_LIMIT, |facts| facts.at_limit.into()),
    ];
    for (metric, read) in families {
        page.family(metric, |family| {
            let mut facts = figures.facts(state).into_iter();
            facts.try_for_each(|facts| {
                family.sample(&[Label::Text(facts.limit.key())], read(&facts))
            })
        })?;
    }
    Ok(())
}

/// What is kept for the next start, and what came from the last one.
pub(super) fn kept(page: &mut Page<'_>, state: &State) -> fmt::Result {
    let kept = state.agent.state;
    page.family(&metric::STATE_WRITES, |family| {
        let counts = kept.map_or([None, None], |kept| {
            [
                Some(("written", kept.writes)),
                Some(("failed", kept.failures)),
            ]
        });
        let mut counts = counts.into_iter().flatten();
        counts.try_for_each(|(outcome, count)| family.sample(&[Label::Text(outcome)], count))
    })?;
    let snapshot = state.snapshot.iter();
    let participants = snapshot.flat_map(|snapshot| &snapshot.participants);
    let restored = participants.filter(|participant| participant.restored);
    page.single(&metric::RESTORED, restored.count())
}

/// The surface itself.
pub(super) fn surface(
    page: &mut Page<'_>,
    state: &State,
    reload: Reload,
    last_scrape: Duration,
    now: Instant,
) -> fmt::Result {
    let age = now.saturating_duration_since(state.agent.at);
    page.single(&metric::SNAPSHOT_AGE, age.as_secs_f64())?;
    page.single(&metric::SCRAPE_DURATION, last_scrape.as_secs_f64())?;
    page.single(&metric::RELOAD_SUCCESSFUL, reload.successful)?;
    let since_epoch = reload.last_success.duration_since(SystemTime::UNIX_EPOCH);
    page.single(
        &metric::RELOAD_TIMESTAMP,
        since_epoch.unwrap_or_default().as_secs_f64(),
    )
}

/// Who gets messages one by one.
pub(super) fn subscriptions(page: &mut Page<'_>, state: &State) -> fmt::Result {
    let facts = &state.agent.subscriptions;
    page.single(&metric::SUBSCRIPTIONS, facts.open)?;
    page.single(&metric::SUBSCRIPTIONS_REFUSED, facts.refused)?;
    page.single(&metric::SAMPLES_GIVEN, facts.given)?;
    page.family(&metric::SAMPLES_MISSED, |family| {
        let mut missed = MissedReason::ALL.into_iter().zip(facts.missed);
        missed.try_for_each(|(reason, count)| family.sample(&[Label::Text(reason.label())], count))
    })?;
    page.single(&metric::SAMPLES_QUEUED, facts.queued_bytes)?;
    page.single(&metric::SAMPLES_RETAINED, facts.retained_bytes)
}

/// Events, told and not told.
pub(super) fn events(page: &mut Page<'_>, log: &EventLog, lost_lines: u64) -> fmt::Result {
    for (metric, counts) in [
        (&metric::EVENTS, log.told()),
        (&metric::EVENTS_DROPPED, log.dropped()),
    ] {
        page.family(metric, |family| {
            let mut counts = counts.into_iter();
            counts.try_for_each(|(label, count)| family.sample(&[Label::Text(label)], count))
        })?;
    }
    page.single(&metric::LOG_LINES_LOST, lost_lines)
}

/// Bags that the agent writes, and what snapshots keep.
pub(super) fn recordings(page: &mut Page<'_>, figures: &RecordingFigures) -> fmt::Result {
    let counts = [
        (&metric::RECORDINGS, &figures.active),
        (&metric::RECORDED_MESSAGES, &figures.messages),
        (&metric::RECORDED_BYTES, &figures.bytes),
        (&metric::RECORDINGS_MISSING, &figures.missing),
    ];
    for (metric, count) in counts {
        page.single(metric, count.load(Ordering::Relaxed))?;
    }
    let snapshots = figures.snapshots();
    type Read = fn(&SnapshotFigures) -> u64;
    let families: [(_, Read); 5] = [
        (&metric::SNAPSHOT_MESSAGES, |figures| figures.messages),
        (&metric::SNAPSHOT_BYTES, |figures| figures.bytes),
        (&metric::SNAPSHOT_CROWDED_OUT, |figures| figures.crowded_out),
        (&metric::SNAPSHOTS_WRITTEN, |figures| figures.written),
        (&metric::SNAPSHOTS_FAILED, |figures| figures.failed),
    ];
    for (metric, read) in families {
        page.family(metric, |family| {
            let mut snapshots = snapshots.iter();
            snapshots
                .try_for_each(|(name, figures)| family.sample(&[Label::Text(name)], read(figures)))
        })?;
    }
    Ok(())
}

/// What became of what was to be exported; nothing where nothing is.
pub(super) fn exports(page: &mut Page<'_>, exports: &Exports) -> fmt::Result {
    page.family(&metric::OTLP_EXPORTS, |family| {
        for signal in exports.signals() {
            for outcome in Outcome::ALL {
                let labels = [Label::Text(signal.label()), Label::Text(outcome.label())];
                family.sample(&labels, exports.requests(signal, outcome))?;
            }
        }
        Ok(())
    })?;
    page.family(&metric::OTLP_DROPPED, |family| {
        for signal in exports.signals() {
            for reason in Reason::ALL {
                let labels = [Label::Text(signal.label()), Label::Text(reason.label())];
                family.sample(&labels, exports.dropped(signal, reason))?;
            }
        }
        Ok(())
    })
}

/// The process; what cannot be read is left out.
pub(super) fn process(page: &mut Page<'_>) -> fmt::Result {
    let Process {
        cpu_seconds,
        resident_bytes,
        unreclaimable_bytes,
        virtual_bytes,
        open_fds,
        max_fds,
        start_time,
    } = Process::read();
    for (metric, value) in [
        (&metric::PROCESS_CPU, cpu_seconds),
        (&metric::PROCESS_RESIDENT, resident_bytes),
        (&metric::PROCESS_UNRECLAIMABLE, unreclaimable_bytes),
        (&metric::PROCESS_VIRTUAL, virtual_bytes),
        (&metric::PROCESS_OPEN_FDS, open_fds),
        (&metric::PROCESS_MAX_FDS, max_fds),
        (&metric::PROCESS_START_TIME, start_time),
    ] {
        if let Some(value) = value {
            page.single(metric, value)?;
        }
    }
    Ok(())
}
