//! `/transforms`: the trees of frames.

use std::borrow::Cow;

use axum::Json;
use axum::extract::State;
use axum::response::{IntoResponse, Response};
use serde::Deserialize;
use utoipa::IntoParams;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::Context;
use super::parameters::Parameters;
use super::problem::{Problem, ProblemBody};
use super::scope::Domain;
use ros2probe_api::transforms::{
    Broadcaster, TransformEdge, TransformJumps, TransformTree, Transforms,
};
use ros2probe_model::facts::wall_clock::WallClock;
use ros2probe_model::report::snapshot::{EdgeFacts, Snapshot, TreeFacts};

/// The query of `/transforms`.
#[derive(Clone, Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields, default)]
#[into_params(parameter_in = Query)]
struct Of {
    /// Domain id; by default every domain.
    #[param(minimum = 0, maximum = 232)]
    domain_id: Option<u32>,
}

pub(super) fn routes() -> OpenApiRouter<Context> {
    OpenApiRouter::new().routes(routes!(transforms))
}

/// The trees of frames
///
/// The agent reads `/tf` and `/tf_static`, in any namespace, as they pass. Static transforms that
/// were sent before the agent started are absent until a further subscription requests them.
#[utoipa::path(
    get,
    path = "/transforms",
    tag = "robot",
    params(Of),
    responses(
        (status = 200, description = "The last transform of each edge.", body = Transforms<'static>),
        (status = 422, description = "The domain is invalid.",
            body = ProblemBody, content_type = "application/problem+json"),
    )
)]
async fn transforms(
    State(context): State<Context>,
    Parameters(of): Parameters<Of>,
) -> Result<Response, Problem> {
    let domain = Domain::of(of.domain_id).checked()?;
    let state = context.state().await;
    Ok(Json(answer(state.known(), domain)).into_response())
}

/// Returns the answer with the trees of a domain.
pub(super) fn answer(snapshot: &Snapshot, domain: Domain) -> Transforms<'_> {
    let trees = snapshot.transforms.trees.iter();
    let trees = trees.filter(|tree| domain.admits(tree.domain_id));
    Transforms {
        timestamp_seconds: snapshot.time().seconds(),
        is_on: snapshot.transforms.are_read,
        trees: trees.map(|tree| view(tree, snapshot.wall_clock)).collect(),
    }
}

fn view(tree: &TreeFacts, clock: WallClock) -> TransformTree<'_> {
    TransformTree {
        domain_id: tree.domain_id.0,
        namespace: Cow::Borrowed(&tree.namespace),
        unread_static_publishers: tree.unread_static as u64,
        edges: tree
            .edges
            .iter()
            .map(|edge| edge_view(edge, clock))
            .collect(),
    }
}

fn edge_view(edge: &EdgeFacts, clock: WallClock) -> TransformEdge<'_> {
    let broadcasters = edge.broadcasters.iter().map(|each| Broadcaster {
        ros_node: each.node.as_deref().map(Cow::Borrowed),
        writer: each.writer.to_string(),
    });
    TransformEdge {
        parent: Cow::Borrowed(&edge.parent),
        child: Cow::Borrowed(&edge.child),
        is_static: edge.is_static,
        broadcasters: broadcasters.collect(),
        messages: edge.count,
        rate_hz: edge.rate,
        longest_interval_seconds: edge.longest_interval.map(|interval| interval.as_secs_f64()),
        jumps: TransformJumps {
            translation: edge.jumps.translation,
            rotation: edge.jumps.rotation,
            time: edge.jumps.time,
        },
        timestamp_seconds: clock.wall_time(edge.at).seconds(),
        stamp_sec: edge.stamp.0,
        stamp_nanosec: edge.stamp.1,
        // JSON has no infinity and no NaN.
        translation: edge.pose.translation.map(finite),
        rotation: edge.pose.rotation.map(finite),
    }
}

fn finite(number: f64) -> f64 {
    if number.is_finite() { number } else { 0.0 }
}
