//! `GET /doctor`: the checks of `rp doctor` on the agent's host.

use std::sync::Arc;
use std::time::Duration;

use axum::body::{Body, Bytes, to_bytes};
use axum::extract::State;
use axum::http::Request;
use axum::{Extension, Json};
use hyper::service::Service as _;
use hyper_util::service::TowerToHyperService;
use serde_json::Value;
use tokio::sync::Semaphore;
use tokio::task::spawn_blocking;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::problem::{Code, Problem, ProblemBody};
use super::security::Granted;
use super::{Context, nouns};
use ros2probe_api::doctor::Report;

/// Maximum time of an examination. It reads files of all processes.
const WITHIN: Duration = Duration::from_secs(10);
static TURN: Semaphore = Semaphore::const_new(1);

/// Examines this host with the agent's own answers.
#[derive(Clone)]
pub struct Doctor(Arc<Examine>);

/// Returns a report as JSON, in the format of [`Report`].
type Examine = dyn Fn(&OwnAnswers) -> Value + Send + Sync;

/// The agent's own answers, as JSON.
#[derive(Clone, Debug, Default)]
pub struct OwnAnswers {
    /// `GET /health`.
    pub health: Bytes,
    /// `GET /participants`.
    pub participants: Bytes,
    /// `GET /topics`.
    pub topics: Bytes,
    /// `GET /watch`.
    pub watches: Bytes,
    /// `GET /clocks`.
    pub clocks: Bytes,
}

impl std::fmt::Debug for Doctor {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Doctor")
    }
}

impl Doctor {
    /// Creates a doctor that examines with this function, in the format of [`Report`].
    pub fn new(examine: impl Fn(&OwnAnswers) -> Value + Send + Sync + 'static) -> Self {
        Self(Arc::new(examine))
    }
}

pub(super) fn routes() -> OpenApiRouter<Context> {
    OpenApiRouter::new().routes(routes!(examine))
}

/// The report of `rp doctor` about this host
///
/// The agent examines with its own rights: what it may not read is `unknown`. The shell and the
/// rights of a user are only in the report of the command.
#[utoipa::path(
    get,
    path = "/doctor",
    tag = "agent",
    responses(
        (status = 200, description = "The report.", body = Report<'static>),
        (status = 503, description = "The examination does not end, or the agent stops.",
            body = ProblemBody, content_type = "application/problem+json"),
    )
)]
async fn examine(
    State(context): State<Context>,
    Extension(granted): Extension<Granted>,
) -> Result<Json<Value>, Problem> {
    let doctor = context.doctor.clone();
    let unanswered = |_| Problem::new(Code::Ending, "the examination of this host does not end");
    let report = async {
        let _turn = TURN.acquire().await.map_err(|_| ending())?;
        let answers = own_answers(&context, &granted).await?;
        let examined = spawn_blocking(move || (doctor.0)(&answers)).await;
        examined.map_err(|_| ending())
    };
    let report = tokio::time::timeout(WITHIN, report).await;
    Ok(Json(report.map_err(unanswered)??))
}

fn ending() -> Problem {
    Problem::new(Code::Ending, "the agent is shutting down")
}

async fn own_answers(context: &Context, granted: &Granted) -> Result<OwnAnswers, Problem> {
    let ask = |path: &'static str| async move {
        let (router, _) = nouns(Some(context)).split_for_parts();
        let router = TowerToHyperService::new(router.with_state(context.clone()));
        let mut request = Request::new(Body::empty());
        *request.uri_mut() = axum::http::Uri::from_static(path);
        request.extensions_mut().insert(granted.clone());
        let answer = router
            .call(request)
            .await
            .unwrap_or_else(|never| match never {});
        let body = to_bytes(answer.into_body(), usize::MAX).await;
        body.map_err(|_| ending())
    };
    Ok(OwnAnswers {
        health: ask("/health").await?,
        participants: ask("/participants").await?,
        topics: ask("/topics").await?,
        watches: ask("/watch").await?,
        clocks: ask("/clocks").await?,
    })
}
