//! `GET /health`: whether the agent sees the robot, and how well.

use std::collections::BTreeSet;
use std::sync::LazyLock;
use std::time::{Instant, SystemTime};

use axum::Json;
use axum::extract::State;
use serde::Serialize;
use utoipa::ToSchema;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::Context;
use crate::privilege;
use crate::surface::agent_facts::{Ability, AgentFacts};
use crate::surface::otlp::Host;
use crate::surface::process::Process;

/// Read once: a robot is not renamed while its agent runs.
pub(super) static HOST: LazyLock<Option<String>> = LazyLock::new(|| Host::read().name);

/// How the agent is.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct Health {
    /// Packets are captured and what is known is fresh.
    ready: bool,
    /// Why it is not.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(nullable = false)]
    reason: Option<String>,
    /// Why part of the robot is not seen although it is ready: which limits are reached.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(nullable = false)]
    degraded: Option<String>,
    /// Name of its host.
    host: Option<String>,
    /// Version of the agent.
    version: &'static str,
    /// Where it looks: `host`, `wire` or `replay`.
    source: &'static str,
    /// The replay has come to the end of its capture: nothing changes any more.
    finished: bool,
    /// Age of what is known; null while nothing is.
    age_seconds: Option<f64>,
    /// Watches in force, of every origin.
    watches: usize,
    /// Watches that clients add outlive the agent: there is a state directory that can be written.
    watches_kept: bool,
    /// Packets lost because a ring was full: above 0, counts are lower bounds.
    dropped_packets: u64,
    /// Measurement records lost likewise.
    dropped_records: u64,
    /// Datagrams captured at the host's sockets that were lost likewise.
    dropped_datagrams: u64,
    /// Datagrams that the kernel programs could not look at.
    contended_datagrams: u64,
    /// Senders whose announcement was missed: their topics have no name.
    unknown_writers: usize,
    /// Topics that a watch matched but `limits.topics` kept from being measured.
    topics_rejected: u64,
    /// Why it does not look where it would see more.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(nullable = false)]
    source_reason: Option<String>,
    /// What it can see and what not.
    abilities: Vec<AbilityView>,
    /// Where packets come from: interfaces, or `sockets`.
    interfaces: Vec<InterfaceView>,
    /// Bounded tables.
    tables: Vec<TableView>,
    /// Caps of the configuration.
    limits: Vec<LimitView>,
    /// Capabilities that some thread of it holds, after it has given up what it does not need any
    /// more. The thread that answers holds none.
    capabilities: Vec<String>,
    /// Its threads, as the kernel sees them.
    threads: Vec<ThreadView>,
    /// Why system calls are not filtered.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(nullable = false)]
    unfiltered_reason: Option<&'static str>,
    /// Its process, in its own process namespace.
    process_id: u32,
    /// Since its process started; null where that cannot be read.
    uptime_seconds: Option<f64>,
}

/// One thing that an agent may be able to see.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Ability)]
struct AbilityView {
    /// Which: see `ros2probe_capture_ability`.
    #[schema(value_type = String, example = "socket_losses")]
    ability: &'static str,
    /// Whether this one can.
    able: bool,
    /// Why not, where there is more to say than that it was not asked for.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(nullable = false)]
    reason: Option<String>,
}

/// A thread and what it may do.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Thread)]
struct ThreadView {
    /// Its name; `rp` for the one that answers.
    #[schema(example = "capture")]
    thread: String,
    /// Capabilities that it holds.
    capabilities: Vec<String>,
    /// The kernel refuses all system calls but those that it makes.
    filtered: bool,
}

/// Where packets come from.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Interface)]
struct InterfaceView {
    /// Its name; `sockets` for those of this host, `any` for all interfaces of a namespace.
    interface: String,
    /// Packets that the filter let through, where they are counted so.
    packets: Option<u64>,
    /// Packets lost because a ring was full, where they are counted so.
    dropped_packets: Option<u64>,
}

/// A bounded table.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Table)]
struct TableView {
    /// Its name, as in `limits`.
    #[schema(value_type = String, example = "endpoints")]
    table: &'static str,
    /// Entries; bytes for `reassembly`.
    entries: u64,
    /// Its cap.
    limit: u64,
    /// Entries given up because of the cap.
    evictions: u64,
}

/// A cap of the configuration.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Limit)]
struct LimitView {
    /// Its key below `limits`.
    #[schema(value_type = String, example = "topics")]
    limit: &'static str,
    /// Entries, connections or bytes that may be.
    cap: u64,
    /// That are.
    used: u64,
    /// What was refused, or given up to make room, because of it.
    reached: u64,
    /// There is no room, or there was none within the last minute.
    at_limit: bool,
}

pub(super) fn routes() -> OpenApiRouter<Context> {
    OpenApiRouter::new().routes(routes!(health))
}

/// Whether the agent sees the robot
#[utoipa::path(
    get,
    path = "/health",
    tag = "agent",
    responses((status = 200, description = "How it is, also when it is not well.", body = Health))
)]
async fn health(State(context): State<Context>) -> Json<Health> {
    let state = context.board.state();
    let instant = Instant::now();
    let ready = state.ready(instant);
    let (agent, snapshot) = (&state.agent, state.snapshot.as_ref());
    let interfaces = agent.interfaces.iter();
    let tables = snapshot.into_iter().flat_map(|snapshot| &snapshot.tables);
    let age = instant.saturating_duration_since(agent.at);
    let started = Process::read().start_time;
    let now = SystemTime::UNIX_EPOCH.elapsed().unwrap_or_default();
    let threads = privilege::threads();
    let held = threads.iter().flat_map(|thread| &thread.capabilities);
    let held: BTreeSet<_> = held.cloned().collect();
    let threads = threads.into_iter().map(|thread| ThreadView {
        thread: thread.name,
        capabilities: thread.capabilities,
        filtered: thread.filtered,
    });
    Json(Health {
        ready: ready.is_ok(),
        reason: ready.err(),
        degraded: context.board.limits().degraded(&state),
        host: HOST.clone(),
        version: env!("CARGO_PKG_VERSION"),
        source: agent.source.label(),
        finished: agent.finished,
        age_seconds: snapshot.map(|_| age.as_secs_f64()),
        watches: context.watches.in_force().entries().len(),
        watches_kept: context.watches.is_kept(),
        dropped_packets: interfaces.clone().filter_map(|each| each.dropped).sum(),
        dropped_records: agent.records_dropped,
        dropped_datagrams: agent.pieces_dropped,
        contended_datagrams: agent.contended,
        unknown_writers: snapshot.map_or(0, |snapshot| snapshot.unknown_writers.len()),
        topics_rejected: snapshot.map_or(0, |snapshot| snapshot.topics_rejected),
        source_reason: agent.source_reason.clone(),
        abilities: abilities(agent),
        interfaces: interfaces
            .map(|each| InterfaceView {
                interface: each.name.clone(),
                packets: each.packets,
                dropped_packets: each.dropped,
            })
            .collect(),
        tables: tables
            .map(|table| TableView {
                table: table.table,
                entries: table.size,
                limit: table.limit,
                evictions: table.evictions,
            })
            .collect(),
        limits: context
            .board
            .limits()
            .facts(&state)
            .map(|facts| LimitView {
                limit: facts.limit.key(),
                cap: facts.cap,
                used: facts.used,
                reached: facts.reached,
                at_limit: facts.at_limit,
            })
            .into(),
        capabilities: held.into_iter().collect(),
        threads: threads.collect(),
        unfiltered_reason: agent.sandbox.reason(),
        process_id: std::process::id(),
        uptime_seconds: started.map(|started| (now.as_secs_f64() - started).max(0.0)),
    })
}

fn abilities(agent: &AgentFacts) -> Vec<AbilityView> {
    let view = |ability: Ability| {
        let reason = agent.blind.iter().find(|(blind, _)| *blind == ability);
        AbilityView {
            ability: ability.label(),
            able: agent.abilities.contains(&ability),
            reason: reason.map(|(_, reason)| reason.clone()),
        }
    };
    Ability::ALL.map(view).into()
}
