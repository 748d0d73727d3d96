//! `/processes`: CPU time and memory of the processes of known participants, read at each request.
//!
//! Only processes that the kernel reports as owners of a participant's socket are read. A process
//! id that a participant announces may belong to another host or namespace.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::SystemTime;

use axum::Json;
use axum::extract::State;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::Context;
use super::problem::{Code, Problem};
use crate::surface::process::{Usage, script};
use ros2probe_api::participants::{ProcessList, ProcessUsage};
use ros2probe_model::report::snapshot::Snapshot;

/// Maximum number of processes per answer.
pub(super) const MAX_PROCESSES: usize = 512;

pub(super) fn routes() -> OpenApiRouter<Context> {
    OpenApiRouter::new().routes(routes!(list))
}

/// CPU and memory of the robot's processes
#[utoipa::path(
    get,
    path = "/processes",
    tag = "graph",
    responses((status = 200, description = "Processes of this host.", body = ProcessList))
)]
async fn list(State(context): State<Context>) -> Result<Json<ProcessList>, Problem> {
    let ids = local(context.state().await.known());
    let read = tokio::task::spawn_blocking(move || read(ids)).await;
    read.map(Json)
        .map_err(|_| Problem::new(Code::Ending, "the agent is shutting down"))
}

/// Returns the processes that own a participant's socket on this host, with their announced names.
pub(super) fn local(snapshot: &Snapshot) -> BTreeMap<u32, Option<Arc<str>>> {
    let mut ids = BTreeMap::new();
    for participant in &snapshot.participants {
        let process = &participant.process;
        // Only the kernel provides a control group, so its presence shows that the id is the
        // kernel's.
        if let (Some(id), Some(_)) = (process.id, &process.cgroup) {
            ids.insert(id, process.name.clone());
        }
    }
    ids
}

fn read(ids: BTreeMap<u32, Option<Arc<str>>>) -> ProcessList {
    let mut unreadable = 0;
    let mut processes = Vec::new();
    for (process_id, name) in ids.into_iter().take(MAX_PROCESSES) {
        let Some(usage) = Usage::read(process_id) else {
            unreadable += 1;
            continue;
        };
        let started_timestamp_seconds = usage.started();
        processes.push(ProcessUsage {
            process_id,
            process: name.map_or(usage.name, |name| name.to_string()),
            script: script(process_id),
            cpu_seconds: usage.cpu_seconds,
            memory_bytes: usage.resident_bytes,
            threads: usage.threads,
            started_timestamp_seconds,
        });
    }
    let now = SystemTime::UNIX_EPOCH.elapsed().unwrap_or_default();
    ProcessList {
        timestamp_seconds: now.as_secs_f64(),
        processes,
        unreadable,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ros2probe_model::report::snapshot::{ParticipantFacts, ProcessFacts};
    use ros2probe_testing::sample_robot;

    fn participant(id: u32, cgroup: Option<&str>) -> ParticipantFacts {
        ParticipantFacts {
            process: ProcessFacts {
                host: None,
                id: Some(id),
                name: None,
                cgroup: cgroup.map(Into::into),
            },
            ..sample_robot::participant()
        }
    }

    #[test]
    fn only_processes_that_own_a_socket_on_this_host_are_read() {
        let own = std::process::id();
        let snapshot = Snapshot {
            participants: vec![
                participant(own, Some("/robot.slice")),
                participant(1, None),
                participant(u32::MAX - 1, Some("/gone")),
            ],
            ..Snapshot::default()
        };
        let view = read(local(&snapshot));
        let ids: Vec<_> = view.processes.iter().map(|each| each.process_id).collect();
        assert_eq!((ids, view.unreadable), (vec![own], 1));
        let process = &view.processes[0];
        assert_eq!(process.script, None);
        assert!(
            process.memory_bytes > 100_000 && process.threads >= 1,
            "{process:?}"
        );
        // CPU time has a resolution of 10 ms, and a busy machine updates it late.
        let later = (0_u64..)
            .map(|_| {
                (0..10_000_000).for_each(|step| {
                    std::hint::black_box(step);
                });
                read(local(&snapshot))
            })
            .find(|later| later.processes[0].cpu_seconds > process.cpu_seconds)
            .unwrap();
        assert!(later.timestamp_seconds > view.timestamp_seconds);
    }

    #[test]
    fn processes_beyond_the_cap_are_not_read() {
        // No process has an id this large.
        let first = 1 << 30;
        let participants = (first..).take(MAX_PROCESSES + 9);
        let snapshot = Snapshot {
            participants: participants
                .map(|id| participant(id, Some("/gone")))
                .collect(),
            ..Snapshot::default()
        };
        let view = read(local(&snapshot));
        assert_eq!((view.processes.len(), view.unreadable), (0, MAX_PROCESSES));
    }
}
