//! `/clocks`: offsets between the clocks of hosts.

use std::borrow::Cow;

use axum::Json;
use axum::extract::State;
use axum::response::{IntoResponse, Response};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::Context;
use ros2probe_api::clocks::{ClockOffset, Clocks, PeerClock};
use ros2probe_model::derive::clocks::{THIS_HOST, seconds};
use ros2probe_model::report::snapshot::{self, Snapshot};

pub(super) fn routes() -> OpenApiRouter<Context> {
    OpenApiRouter::new().routes(routes!(clocks))
}

/// Offsets between the clocks of hosts
///
/// They follow from stamps of messages, replies and acknowledgements. The agent sends
/// nothing and uses no time server. An offset is absent while one of its bounds has no evidence.
#[utoipa::path(
    get,
    path = "/clocks",
    tag = "robot",
    responses((status = 200, description = "Clocks and offsets.", body = Clocks<'static>))
)]
async fn clocks(State(context): State<Context>) -> Response {
    let state = context.state().await;
    Json(answer(state.known())).into_response()
}

/// Returns the answer.
pub(super) fn answer(snapshot: &Snapshot) -> Clocks<'_> {
    Clocks {
        timestamp_seconds: snapshot.time().seconds(),
        is_on: snapshot.clocks.are_compared,
        peers: snapshot.clocks.peers.iter().map(peer).collect(),
        offsets: snapshot.clocks.offsets.iter().map(offset).collect(),
    }
}

fn peer(clock: &snapshot::PeerClock) -> PeerClock<'_> {
    let (least, most) = clock.ahead;
    PeerClock {
        peer: Cow::Borrowed(&clock.peer),
        address: clock.address.to_string(),
        ahead_at_least_seconds: least.map(seconds),
        ahead_at_most_seconds: most.map(seconds),
        evidence: clock.source.map(|source| source.label().into()),
        steps: clock.steps,
    }
}

fn offset(clock: &snapshot::ClockOffset) -> ClockOffset<'_> {
    ClockOffset {
        host: Cow::Borrowed(clock.host.as_deref().unwrap_or(THIS_HOST)),
        peer: Cow::Borrowed(&clock.peer),
        offset_seconds: seconds(clock.offset),
        uncertainty_seconds: seconds(clock.uncertainty),
    }
}
