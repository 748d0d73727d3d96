//! Metrics of the agent: drops, decode errors, limits (`ros2probe_*`), and its own process
//! (`process_*`).

use std::fmt;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant, SystemTime};

use super::foxglove::Viewers;
use super::process::Process;
use super::ros2_daemon::{PortState, Ros2DaemonFigures};
use super::ros2_metrics::TopicRows;
use crate::agent_facts::{Ability, InterfaceFacts, SharedMemoryFacts};
use crate::disk_history::DiskHistory;
use crate::events::EventLog;
use crate::limit_facts::{LimitFacts, LimitFigures};
use crate::recording::{RecordingFigures, SnapshotFigures};
use crate::settings_cell::Reload;
use crate::snapshot_cell::State;
use ros2probe_metrics::catalogue as metric;
use ros2probe_metrics::metric_sink::{Label, MetricSink};
use ros2probe_metrics::otlp::{Exports, Outcome, Reason, Signal};
use ros2probe_metrics::remote_write::{Figures, Request, SampleFate};
use ros2probe_model::facts::dispatch::MissedReason;

/// Writes the version, source, sandbox, abilities and readiness of the agent.
pub(super) fn identity(sink: &mut MetricSink<'_>, state: &State, now: Instant) -> fmt::Result {
    sink.family(&metric::BUILD_INFO, |family| {
        let version = Label::Text(env!("CARGO_PKG_VERSION"));
        family.info(&[version, Label::Text(std::env::consts::ARCH)])
    })?;
    sink.family(&metric::SOURCE_INFO, |family| {
        let reason = state.agent.source_reason.as_deref().unwrap_or_default();
        family.info(&[Label::Text(state.agent.source.label()), Label::Text(reason)])
    })?;
    sink.family(&metric::WIRE_INFO, |family| {
        state.agent.wire.iter().try_for_each(|wire| {
            let reason = wire.reason.as_deref().unwrap_or_default();
            family.info(&[Label::Text(wire.hook), Label::Text(reason)])
        })
    })?;
    sink.family(&metric::SANDBOX_INFO, |family| {
        let sandbox = &state.agent.sandbox;
        let reason = sandbox.reason().unwrap_or_default();
        family.info(&[Label::Text(sandbox.label()), Label::Text(reason)])
    })?;
    sink.family(&metric::ABILITY, |family| {
        Ability::ALL.into_iter().try_for_each(|ability| {
            let able = state.agent.abilities.contains(&ability);
            family.sample(&[Label::Text(ability.label())], able)
        })
    })?;
    sink.single(&metric::READY, state.ready(now).is_ok())
}

/// Writes the metrics of the capture and the kernel filter.
pub(super) fn capture(sink: &mut MetricSink<'_>, state: &State) -> fmt::Result {
    let agent = &state.agent;
    sink.family(&metric::CAPTURE_PACKETS, |family| {
        let counted = |each: &InterfaceFacts| Some((each.name.clone(), each.packets?));
        agent
            .interfaces
            .iter()
            .filter_map(counted)
            .try_for_each(|(name, packets)| family.sample(&[Label::Text(&name)], packets))
    })?;
    sink.family(&metric::CAPTURE_DROPPED, |family| {
        let counted = |each: &InterfaceFacts| Some((each.name.clone(), each.dropped?));
        agent
            .interfaces
            .iter()
            .filter_map(counted)
            .try_for_each(|(name, dropped)| family.sample(&[Label::Text(&name)], dropped))
    })?;
    sink.single(&metric::CAPTURE_COPIED, agent.copied_bytes)?;
    sink.family(&metric::FILTER_EVENTS, |family| {
        agent
            .filter_events
            .iter()
            .try_for_each(|(event, count)| family.sample(&[Label::Text(event)], *count))
    })?;
    sink.single(&metric::FILTER_REFUSED, agent.refused_updates)?;
    sink.single(&metric::RECORDS_DROPPED, agent.records_dropped)?;
    sink.single(&metric::PIECES_DROPPED, agent.pieces_dropped)?;
    sink.single(&metric::CONTENDED, agent.contended)?;
    sink.single(&metric::INCOMPLETE_DATAGRAMS, agent.incomplete_datagrams)?;
    sink.single(
        &metric::REASSEMBLY,
        agent.reassembly_bytes + agent.pieces_bytes,
    )?;
    shared_memory(sink, agent.shared_memory.as_ref())?;
    sink.family(&metric::SHM_EXACT_INFO, |family| {
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

/// Writes the metrics of shared-memory sampling, if it is enabled.
fn shared_memory(sink: &mut MetricSink<'_>, facts: Option<&SharedMemoryFacts>) -> fmt::Result {
    sink.family(&metric::SHM_OPEN, |family| {
        let mut open = facts.into_iter().flat_map(|facts| &facts.open);
        open.try_for_each(|(kind, count)| family.sample(&[Label::Text(kind)], *count))
    })?;
    sink.family(&metric::SHM_EVENTS, |family| {
        let mut events = facts.into_iter().flat_map(|facts| &facts.events);
        events.try_for_each(|(event, count)| family.sample(&[Label::Text(event)], *count))
    })?;
    sink.family(&metric::SHM_LOOKS, |family| match facts {
        Some(facts) => family.sample(&[], facts.polls),
        None => Ok(()),
    })?;
    sink.family(&metric::SHM_CPU, |family| match facts {
        Some(facts) => family.sample(&[], facts.cpu_seconds),
        None => Ok(()),
    })
}

/// Writes the metrics of the model: its input, decode errors, tables and limits, and the topics.
pub(super) fn model(
    sink: &mut MetricSink<'_>,
    state: &State,
    rows: &TopicRows<'_>,
    hidden_deliveries: usize,
    limits: &LimitFigures,
) -> fmt::Result {
    let snapshot = state.snapshot.as_deref();
    let tables = || snapshot.into_iter().flat_map(|snapshot| &snapshot.tables);
    sink.single(
        &metric::DATAGRAMS,
        snapshot.map_or(0, |snapshot| snapshot.datagrams),
    )?;
    sink.single(
        &metric::TLS_CONNECTIONS,
        snapshot.map_or(0, |snapshot| snapshot.tls_connections),
    )?;
    sink.single(
        &metric::RECORDS,
        snapshot.map_or(0, |snapshot| snapshot.records),
    )?;
    sink.family(&metric::DECODE_ERRORS, |family| {
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
    sink.family(&metric::TABLE_ENTRIES, |family| {
        tables().try_for_each(|table| family.sample(&[Label::Text(table.table)], table.size))
    })?;
    sink.family(&metric::TABLE_LIMIT, |family| {
        tables().try_for_each(|table| family.sample(&[Label::Text(table.table)], table.limit))
    })?;
    let bytes = || tables().filter_map(|table| Some((table.table, table.bytes?)));
    sink.family(&metric::TABLE_BYTES, |family| {
        bytes().try_for_each(|(table, (bytes, _))| family.sample(&[Label::Text(table)], bytes))
    })?;
    sink.family(&metric::TABLE_BYTES_LIMIT, |family| {
        bytes().try_for_each(|(table, (_, cap))| family.sample(&[Label::Text(table)], cap))
    })?;
    sink.family(&metric::TABLE_EVICTIONS, |family| {
        tables().try_for_each(|table| family.sample(&[Label::Text(table.table)], table.evictions))
    })?;
    self::limits(sink, limits, state)?;
    let tracked = rows
        .shown
        .iter()
        .filter(|row| row.measurement().is_some())
        .count();
    sink.single(&metric::TRACKED_TOPICS, tracked)?;
    sink.single(
        &metric::TOPICS_REJECTED,
        snapshot.map_or(0, |snapshot| snapshot.topics_rejected),
    )?;
    sink.single(&metric::TOPICS_HIDDEN, rows.hidden)?;
    sink.single(&metric::DELIVERIES_HIDDEN, hidden_deliveries)
}

/// Writes the limits of the configuration and their use.
fn limits(sink: &mut MetricSink<'_>, figures: &LimitFigures, state: &State) -> fmt::Result {
    type Read = fn(&LimitFacts) -> u64;
    let families: [(_, Read); 4] = [
        (&metric::LIMIT, |facts| facts.cap),
        (&metric::LIMIT_USED, |facts| facts.used),
        (&metric::LIMIT_REACHED, |facts| facts.reached),
        (&metric::AT_LIMIT, |facts| facts.at_limit.into()),
    ];
    for (metric, read) in families {
        sink.family(metric, |family| {
            let mut facts = figures.facts(state).into_iter();
            facts.try_for_each(|facts| {
                family.sample(&[Label::Text(facts.limit.key())], read(&facts))
            })
        })?;
    }
    Ok(())
}

/// Writes the metrics of saved and restored state.
pub(super) fn kept(sink: &mut MetricSink<'_>, state: &State) -> fmt::Result {
    let kept = state.agent.state;
    sink.family(&metric::STATE_WRITES, |family| {
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
    sink.single(&metric::RESTORED, restored.count())
}

/// Writes the metrics of the history on disk.
pub(super) fn history(sink: &mut MetricSink<'_>, history: &DiskHistory) -> fmt::Result {
    let store = history.store();
    sink.family(&metric::HISTORY_WRITES, |family| {
        let counts = ["written", "failed"].into_iter().zip(history.writes());
        let mut counts = counts.filter(|_| history.is_kept());
        counts.try_for_each(|(outcome, count)| family.sample(&[Label::Text(outcome)], count))
    })?;
    sink.family(&metric::HISTORY_BYTES, |family| {
        let bytes = store.map(|store| store.facts().bytes);
        bytes.map_or(Ok(()), |bytes| family.sample(&[], bytes))
    })
}

/// Writes the age of the snapshot, the duration of the last scrape, and the last reload.
pub(super) fn surface(
    sink: &mut MetricSink<'_>,
    state: &State,
    reload: Reload,
    last_scrape: Duration,
    now: Instant,
) -> fmt::Result {
    let age = now.saturating_duration_since(state.agent.collected_at);
    sink.single(&metric::SNAPSHOT_AGE, age.as_secs_f64())?;
    sink.single(&metric::SCRAPE_DURATION, last_scrape.as_secs_f64())?;
    sink.single(&metric::RELOAD_SUCCESSFUL, reload.successful)?;
    let since_epoch = reload.last_success.duration_since(SystemTime::UNIX_EPOCH);
    sink.single(
        &metric::RELOAD_TIMESTAMP,
        since_epoch.unwrap_or_default().as_secs_f64(),
    )
}

/// Writes the metrics of subscriptions.
pub(super) fn subscriptions(sink: &mut MetricSink<'_>, state: &State) -> fmt::Result {
    let facts = &state.agent.subscriptions;
    sink.single(&metric::SUBSCRIPTIONS, facts.open)?;
    sink.single(&metric::SUBSCRIPTIONS_REFUSED, facts.refused)?;
    sink.single(&metric::SAMPLES_GIVEN, facts.enqueued)?;
    sink.family(&metric::SAMPLES_MISSED, |family| {
        let mut missed = MissedReason::ALL.into_iter().zip(facts.missed);
        missed.try_for_each(|(reason, count)| family.sample(&[Label::Text(reason.label())], count))
    })?;
    sink.single(&metric::SAMPLES_QUEUED, facts.queued_bytes)?;
    sink.single(&metric::SAMPLES_RETAINED, facts.retained_bytes)
}

/// Writes the metrics of the ros2 daemon. Without the daemon, its families have no samples.
pub(super) fn ros2_daemon(sink: &mut MetricSink<'_>, figures: &Ros2DaemonFigures) -> fmt::Result {
    let ports = figures.ports();
    let is_on = !ports.is_empty();
    sink.family(&metric::ROS2_DAEMON_PORTS, |family| {
        PortState::LABELS
            .into_iter()
            .filter(|_| is_on)
            .try_for_each(|label| {
                let count = ports
                    .values()
                    .filter(|state| state.label() == label)
                    .count();
                family.sample(&[Label::Text(label)], count)
            })
    })?;
    sink.family(&metric::ROS2_DAEMON_CLIENTS, |family| match is_on {
        true => family.sample(&[], figures.clients()),
        false => Ok(()),
    })?;
    sink.family(&metric::ROS2_DAEMON_REQUESTS, |family| {
        let mut requests = figures.requests().filter(|_| is_on);
        requests.try_for_each(|(function, count)| family.sample(&[Label::Text(function)], count))
    })?;
    sink.family(&metric::ROS2_DAEMON_REFUSED, |family| {
        let mut refused = figures.refused().filter(|_| is_on);
        refused.try_for_each(|(reason, count)| family.sample(&[Label::Text(reason)], count))
    })
}

/// Writes the metrics of viewers.
pub(super) fn viewers(sink: &mut MetricSink<'_>, viewers: &Viewers) -> fmt::Result {
    let totals = viewers.totals();
    sink.single(&metric::FOXGLOVE_CLIENTS, totals.clients)?;
    sink.single(&metric::FOXGLOVE_SUBSCRIPTIONS, totals.subscriptions)?;
    sink.single(&metric::FOXGLOVE_REFUSED, totals.refused)?;
    sink.single(&metric::FOXGLOVE_SENT, totals.sent_messages)?;
    sink.single(&metric::FOXGLOVE_SENT_BYTES, totals.sent_bytes)?;
    sink.single(&metric::FOXGLOVE_DROPPED, totals.dropped_messages)
}

/// Writes the numbers of events, of dropped events and of lost log lines.
pub(super) fn events(sink: &mut MetricSink<'_>, log: &EventLog, lost_lines: u64) -> fmt::Result {
    for (metric, counts) in [
        (&metric::EVENTS, log.recorded()),
        (&metric::EVENTS_DROPPED, log.dropped()),
    ] {
        sink.family(metric, |family| {
            let mut counts = counts.into_iter();
            counts.try_for_each(|(label, count)| family.sample(&[Label::Text(label)], count))
        })?;
    }
    sink.single(&metric::LOG_LINES_LOST, lost_lines)
}

/// Writes the metrics of recordings and snapshots.
pub(super) fn recordings(sink: &mut MetricSink<'_>, figures: &RecordingFigures) -> fmt::Result {
    let counts = [
        (&metric::RECORDINGS, &figures.active),
        (&metric::RECORDED_MESSAGES, &figures.messages),
        (&metric::RECORDED_BYTES, &figures.bytes),
        (&metric::RECORDINGS_MISSING, &figures.missing),
    ];
    for (metric, count) in counts {
        sink.single(metric, count.load(Ordering::Relaxed))?;
    }
    let snapshots = figures.snapshots();
    type Read = fn(&SnapshotFigures) -> u64;
    let families: [(_, Read); 7] = [
        (&metric::SNAPSHOT_MESSAGES, |figures| figures.messages),
        (&metric::SNAPSHOT_BYTES, |figures| figures.bytes),
        (&metric::SNAPSHOT_CROWDED_OUT, |figures| figures.evicted),
        (&metric::SNAPSHOTS_WRITTEN, |figures| figures.written),
        (&metric::SNAPSHOTS_FAILED, |figures| figures.failed),
        (&metric::SNAPSHOTS_SUPPRESSED, |figures| figures.suppressed),
        (&metric::SNAPSHOTS_REMOVED, |figures| figures.removed),
    ];
    for (metric, read) in families {
        sink.family(metric, |family| {
            let mut snapshots = snapshots.iter();
            snapshots
                .try_for_each(|(name, figures)| family.sample(&[Label::Text(name)], read(figures)))
        })?;
    }
    Ok(())
}

/// Writes the results of exports, if any signal is exported.
pub(super) fn exports(sink: &mut MetricSink<'_>, exports: &Exports) -> fmt::Result {
    sink.family(&metric::OTLP_EXPORTS, |family| {
        for signal in exports.signals() {
            for outcome in Outcome::ALL {
                let labels = [Label::Text(signal.label()), Label::Text(outcome.label())];
                family.sample(&labels, exports.requests(signal, outcome))?;
            }
        }
        Ok(())
    })?;
    sink.family(&metric::OTLP_DROPPED, |family| {
        for signal in exports.signals() {
            for reason in Reason::ALL {
                let labels = [Label::Text(signal.label()), Label::Text(reason.label())];
                family.sample(&labels, exports.dropped(signal, reason))?;
            }
        }
        Ok(())
    })?;
    sink.family(&metric::OTLP_QUEUE, |family| {
        // Points of metrics do not wait: newer ones replace them.
        let mut signals = exports.signals().filter(|it| *it != Signal::Metrics);
        signals.try_for_each(|signal| {
            let labels = [Label::Text(signal.label())];
            family.sample(&labels, exports.queue_bytes(signal))
        })
    })
}

/// Writes the state of remote write; families without samples, if it has no receiver.
pub(super) fn remote_write(sink: &mut MetricSink<'_>, figures: &Figures) -> fmt::Result {
    let figures = Some(figures).filter(|figures| figures.is_enabled());
    sink.family(&metric::REMOTE_WRITE_REQUESTS, |family| {
        let mut requests = figures.into_iter().flat_map(|figures| {
            Request::ALL.map(|result| (result.label(), figures.requests(result)))
        });
        requests.try_for_each(|(label, count)| family.sample(&[Label::Text(label)], count))
    })?;
    sink.family(&metric::REMOTE_WRITE_SAMPLES, |family| {
        let mut samples = figures
            .into_iter()
            .flat_map(|figures| SampleFate::ALL.map(|fate| (fate.label(), figures.samples(fate))));
        samples.try_for_each(|(label, count)| family.sample(&[Label::Text(label)], count))
    })?;
    let numbers = [
        (&metric::REMOTE_WRITE_SENT, figures.map(Figures::sent_bytes)),
        (
            &metric::REMOTE_WRITE_QUEUE,
            figures.map(Figures::queue_bytes),
        ),
    ];
    for (metric, value) in numbers {
        sink.family(metric, |family| {
            value.map_or(Ok(()), |value| family.sample(&[], value))
        })?;
    }
    sink.family(&metric::REMOTE_WRITE_BEHIND, |family| {
        figures.map_or(Ok(()), |figures| family.sample(&[], figures.lag_seconds()))
    })
}

/// Writes the metrics of the process. Unknown values are left out.
pub(super) fn process(sink: &mut MetricSink<'_>) -> fmt::Result {
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
            sink.single(metric, value)?;
        }
    }
    Ok(())
}
