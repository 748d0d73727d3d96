//! `GET /health`: whether the agent observes the robot, and how completely.

use ros2probe_model::graph::zenoh::ZenohFacts;
use std::collections::BTreeSet;
use std::sync::LazyLock;
use std::time::{Instant, SystemTime};

use axum::Json;
use axum::extract::State;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::Context;
use crate::agent_facts::{Ability, AgentFacts};
use crate::missed_announcements;
use crate::privilege;
use crate::surface::foxglove::{ViewerListener, Viewers};
use crate::surface::process::Process;
use crate::surface::ros2_daemon::{PortState, Ros2DaemonFigures, port};
use ros2probe_api::health::{self, Health, Interface, Limit, Table, Thread, Wire};
use ros2probe_metrics::otlp::Host;

/// Name of the host. It is read once, because it rarely changes while the agent runs.
pub(super) static HOST_NAME: LazyLock<Option<String>> = LazyLock::new(|| Host::read().name);

pub(super) fn routes() -> OpenApiRouter<Context> {
    OpenApiRouter::new().routes(routes!(health))
}

/// Whether the agent observes the robot
#[utoipa::path(
    get,
    path = "/health",
    tag = "agent",
    responses((status = 200, description = "The state of the agent, even if it is not ready.", body = Health))
)]
async fn health(State(context): State<Context>) -> Json<Health> {
    Json(answer(&context))
}

/// Returns the answer.
pub(super) fn answer(context: &Context) -> Health {
    let state = context.latest.state();
    let instant = Instant::now();
    let ready = state.ready(instant);
    let (agent, snapshot) = (&state.agent, state.snapshot.as_deref());
    let interfaces = agent.interfaces.iter();
    let tables = snapshot.into_iter().flat_map(|snapshot| &snapshot.tables);
    let age = instant.saturating_duration_since(agent.collected_at);
    let started = Process::read().start_time;
    let now = SystemTime::UNIX_EPOCH.elapsed().unwrap_or_default();
    let threads = privilege::threads();
    let held = threads.iter().flat_map(|thread| &thread.capabilities);
    let held: BTreeSet<_> = held.cloned().collect();
    let threads = threads.into_iter().map(|thread| Thread {
        thread: thread.name,
        capabilities: thread.capabilities,
        filtered: thread.filtered,
    });
    Health {
        ready: ready.is_ok(),
        reason: ready.err().map(|reason| reason.to_string()),
        degraded: context.limits.degraded(&state),
        host: HOST_NAME.clone(),
        version: env!("CARGO_PKG_VERSION").into(),
        source: agent.source.label().into(),
        finished: agent.finished,
        age_seconds: snapshot.map(|_| age.as_secs_f64()),
        watches: context.watches.active().entries().len(),
        watches_kept: context.watches.is_kept(),
        dropped_packets: interfaces.clone().filter_map(|each| each.dropped).sum(),
        dropped_records: agent.records_dropped,
        dropped_datagrams: agent.pieces_dropped,
        contended_datagrams: agent.contended,
        unknown_writers: snapshot.map_or(0, |snapshot| snapshot.unknown_writers.len()),
        unknown_writers_remedy: snapshot
            .and_then(missed_announcements::remedy)
            .map(str::to_owned),
        topics_rejected: snapshot.map_or(0, |snapshot| snapshot.topics_rejected),
        source_reason: agent.source_reason.clone(),
        wire: agent.wire.as_ref().map(|wire| Wire {
            hook: wire.hook.into(),
            reason: wire.reason.clone(),
        }),
        abilities: abilities(agent),
        interfaces: interfaces
            .map(|each| Interface {
                interface: each.name.clone(),
                packets: each.packets,
                dropped_packets: each.dropped,
            })
            .collect(),
        tables: tables
            .map(|table| Table {
                table: table.table.into(),
                entries: table.size,
                limit: table.limit,
                evictions: table.evictions,
            })
            .collect(),
        limits: context
            .limits
            .facts(&state)
            .map(|facts| Limit {
                limit: facts.limit.key().into(),
                cap: facts.cap,
                used: facts.used,
                reached: facts.reached,
                at_limit: facts.at_limit,
            })
            .into(),
        capabilities: held.into_iter().collect(),
        threads: threads.collect(),
        unfiltered_reason: agent
            .sandbox
            .reason()
            .map(|reason| reason.to_owned().into()),
        foxglove: foxglove(&context.viewers),
        ros2_daemon: ros2_daemon(&context.ros2_daemon),
        zenoh: snapshot.and_then(|snapshot| snapshot.zenoh.as_ref().map(zenoh)),
        page: context.page.address(),
        process_id: std::process::id(),
        uptime_seconds: started.map(|started| (now.as_secs_f64() - started).max(0.0)),
    }
}

fn zenoh(facts: &ZenohFacts) -> health::Zenoh {
    let unseen = facts.unseen();
    health::Zenoh {
        connections: facts.connections,
        routers: facts.routers,
        gaps: facts.counters.gaps,
        unseen: unseen
            .map(|(reason, connections)| health::UnseenConnections {
                reason: reason.label().into(),
                text: reason.in_words().into(),
                connections,
            })
            .collect(),
    }
}

/// Returns the listener for viewers; `None` if it is off.
fn foxglove(viewers: &Viewers) -> Option<health::Foxglove> {
    let (address, access, reason) = match viewers.listener() {
        ViewerListener::Off => return None,
        ViewerListener::At(address, access) => (address, access, None),
        ViewerListener::Failed(address, reason) => (address, None, Some(reason)),
    };
    let clients = viewers.connected().into_iter();
    let clients = clients.map(|viewer| health::FoxgloveClient {
        address: viewer.address.map(|address| address.to_string()),
        access: viewer.access.name().into(),
        subscriptions: viewer.subscriptions,
        sent_messages: viewer.sent_messages,
        dropped_messages: viewer.dropped_messages,
    });
    Some(health::Foxglove {
        address: match address.ip() {
            ip if ip.is_loopback() && ip.is_ipv4() => format!("ws://localhost:{}/", address.port()),
            _ => format!("ws://{address}/"),
        },
        reason,
        access: access.map(|access| access.name().into()),
        clients: clients.collect(),
    })
}

/// Returns the ports of the ros2 daemon.
fn ros2_daemon(figures: &Ros2DaemonFigures) -> Vec<health::Ros2DaemonPort> {
    let ports = figures.ports().into_iter();
    let ports = ports.filter_map(|(domain_id, state)| {
        Some(health::Ros2DaemonPort {
            domain_id,
            port: port(domain_id)?,
            state: state.label().into(),
            reason: match state {
                PortState::Failed(reason) => Some(reason),
                _ => None,
            },
        })
    });
    ports.collect()
}

fn abilities(agent: &AgentFacts) -> Vec<health::Ability> {
    let view = |ability: Ability| {
        let reason = agent
            .missing_abilities
            .iter()
            .find(|(blind, _)| *blind == ability);
        health::Ability {
            ability: ability.label().into(),
            able: agent.abilities.contains(&ability),
            on_demand: agent.on_demand.contains(&ability),
            reason: reason.map(|(_, reason)| reason.clone()),
        }
    };
    Ability::ALL.map(view).into()
}
