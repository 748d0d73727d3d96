//! `/replay`: how the replay of a capture goes on.

use std::sync::Arc;
use std::time::Duration;

use axum::Json;
use axum::extract::State;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::Context;
use super::body::Body;
use super::problem::{Code, Problem, ProblemBody};
use crate::agent_facts::SourceKind;
use crate::replay_pace::{Jump, Pace};
use crate::snapshot_cell::State as Known;
use ros2probe_api::replay::{ReplayRequest, ReplayState};
use ros2probe_capture::pcap::Speed;
use ros2probe_wire::Timestamp;
use ros2probe_wire::time::SECOND;

/// Maximum multiple of the speed of the capture.
const MAX_SPEED: f64 = 1000.0;

pub(super) fn routes() -> OpenApiRouter<Context> {
    OpenApiRouter::new()
        .routes(routes!(show))
        .routes(routes!(change))
}

/// Position and pace of the replay
#[utoipa::path(
    get,
    path = "/replay",
    tag = "agent",
    responses(
        (status = 200, description = "Position and pace.", body = ReplayState),
        (status = 404, description = "The agent replays no capture.",
            body = ProblemBody, content_type = "application/problem+json"),
    )
)]
async fn show(State(context): State<Context>) -> Result<Json<ReplayState>, Problem> {
    // The position after a jump is at least as new as its end.
    let pace = context.latest.replay_pace().get();
    let state = replayed(&context).await?;
    Ok(Json(view(&state, pace)))
}

/// Pause the replay, change its speed, or go to another time
///
/// The change takes effect within a tenth of a second. To go back, the replay begins again, and goes
/// on to the time without waiting. All figures then begin again, too.
#[utoipa::path(
    post,
    path = "/replay",
    tag = "agent",
    request_body(content = ReplayRequest, description = "The change."),
    responses(
        (status = 200, description = "Position and new pace.", body = ReplayState),
        (status = 404, description = "The agent replays no capture.",
            body = ProblemBody, content_type = "application/problem+json"),
        (status = 422, description = "The speed is out of range, or the time is before the begin of the capture.",
            body = ProblemBody, content_type = "application/problem+json"),
    )
)]
async fn change(
    State(context): State<Context>,
    Body(request): Body<ReplayRequest>,
) -> Result<Json<ReplayState>, Problem> {
    let state = replayed(&context).await?;
    let requested = requested(&request, state.agent.capture_begin)?;
    let pace = context.latest.pace_replay(|pace| {
        pace.is_paused = request.is_paused.unwrap_or(pace.is_paused);
        pace.speed = requested.speed.or(pace.speed);
        // A pause also ends a jump.
        if request.is_paused == Some(true) || requested.jump.is_some() {
            pace.jump = requested.jump;
        }
    });
    Ok(Json(view(&state, pace)))
}

/// # Errors
/// Fails if the agent replays no capture.
async fn replayed(context: &Context) -> Result<Arc<Known>, Problem> {
    let state = context.state().await;
    match state.agent.source {
        SourceKind::Replay => Ok(state),
        _ => Err(Problem::new(
            Code::NoReplay,
            "the agent observes a robot; `rp run --replay FILE` replays a capture",
        )),
    }
}

/// Returns the requested speed and jump.
///
/// # Errors
/// Fails if the speed is impossible, or the time is before the begin of the capture.
fn requested(request: &ReplayRequest, begin: Option<Timestamp>) -> Result<Pace, Problem> {
    let invalid = |detail| Problem::new(Code::InvalidRequest, detail);
    let speed = match request.speed {
        None => None,
        Some(0.0) => Some(Speed::Max),
        Some(times) if times > 0.0 && times <= MAX_SPEED => Some(Speed::Times(times)),
        Some(_) => return Err(invalid("`speed` must be between 0 and 1000")),
    };
    let jump = match request.to_timestamp_seconds {
        Some(_) if request.to_next_event => {
            return Err(invalid(
                "`to_timestamp_seconds` and `to_next_event` exclude each other",
            ));
        }
        Some(time) => match timestamp(time) {
            Some(time) if begin.is_some_and(|begin| time >= begin) => Some(Jump::To(time)),
            _ => {
                return Err(invalid(
                    "`to_timestamp_seconds` is before the begin of the capture",
                ));
            }
        },
        None => request.to_next_event.then_some(Jump::NextEvent),
    };
    Ok(Pace {
        is_paused: false,
        speed,
        jump,
    })
}

/// Returns a Unix time in nanoseconds; `None` if it is out of range.
fn timestamp(seconds: f64) -> Option<Timestamp> {
    let whole = Duration::try_from_secs_f64(seconds).ok()?;
    let nanoseconds = whole.as_secs().checked_mul(SECOND)?;
    nanoseconds
        .checked_add(whole.subsec_nanos().into())
        .map(Timestamp)
}

fn view(state: &Known, pace: Pace) -> ReplayState {
    let agent = &state.agent;
    ReplayState {
        begin_timestamp_seconds: agent.capture_begin.map(|begin| begin.seconds()),
        timestamp_seconds: state.known().time().seconds(),
        read_ratio: agent.replayed,
        is_finished: agent.finished,
        is_paused: pace.is_paused(),
        speed: pace.times(agent.replay_speed),
        is_jumping: match pace.jump {
            Some(Jump::To(time)) => !agent.finished || time < state.known().time(),
            Some(Jump::NextEvent) => !agent.finished,
            None => false,
        },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn replay_requests_before_the_begin_or_at_an_invalid_speed_are_refused() {
        let begin = Some(Timestamp(100 * SECOND));
        let of = |change: fn(&mut ReplayRequest)| {
            let mut request = ReplayRequest::default();
            change(&mut request);
            requested(&request, begin).map_err(|problem| problem.code())
        };
        assert_eq!(of(|_| {}), Ok(Pace::default()));
        let speed = |speed| Pace {
            speed: Some(speed),
            ..Pace::default()
        };
        assert_eq!(of(|it| it.speed = Some(0.0)), Ok(speed(Speed::Max)));
        assert_eq!(of(|it| it.speed = Some(0.5)), Ok(speed(Speed::Times(0.5))));
        let jump = of(|it| it.to_timestamp_seconds = Some(100.5)).unwrap().jump;
        assert_eq!(jump, Some(Jump::To(Timestamp(100 * SECOND + SECOND / 2))));
        for change in [
            (|it| it.speed = Some(-1.0)) as fn(&mut ReplayRequest),
            |it| it.speed = Some(1000.1),
            |it| it.speed = Some(f64::NAN),
            |it| it.to_timestamp_seconds = Some(99.9),
            |it| it.to_timestamp_seconds = Some(-1.0),
            |it| it.to_timestamp_seconds = Some(1e300),
            |it| (it.to_timestamp_seconds, it.to_next_event) = (Some(101.0), true),
        ] {
            assert_eq!(of(change), Err(Code::InvalidRequest));
        }
    }
}
