//! `GET /doctor`: the checks of `rp doctor` on the agent's host.

use std::sync::Arc;
use std::time::Duration;

use axum::body::{Body, Bytes, to_bytes};
use axum::extract::State;
use axum::http::{Request, Uri};
use axum::{Extension, Json};
use hyper::service::Service as _;
use hyper_util::service::TowerToHyperService;
use tokio::sync::Semaphore;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::problem::{Code, Problem, ProblemBody};
use super::security::Rights;
use super::turns::{NoResult, run_blocking};
use super::{Context, nouns};
use ros2probe_api::doctor::Report;

/// Maximum time of an examination. It reads files of all processes.
const EXAMINATION_TIMEOUT: Duration = Duration::from_secs(10);
static EXAMINATION_PERMIT: Semaphore = Semaphore::const_new(1);

/// Examines this host with the agent's own answers.
#[derive(Clone)]
pub struct Doctor(Arc<Examine>);

type Examine = dyn Fn(&OwnAnswers) -> Report + Send + Sync;

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
    /// Creates a doctor that examines with this function.
    pub fn new(examine: impl Fn(&OwnAnswers) -> Report + Send + Sync + 'static) -> Self {
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
        (status = 200, description = "The report.", body = Report),
        (status = 503, description = "The examination does not end, or the agent stops.",
            body = ProblemBody, content_type = "application/problem+json"),
    )
)]
async fn examine(
    State(context): State<Context>,
    Extension(granted): Extension<Rights>,
) -> Result<Json<Report>, Problem> {
    let doctor = context.doctor.clone();
    let answers = own_answers(&context, granted).await?;
    let report = run_blocking(&EXAMINATION_PERMIT, EXAMINATION_TIMEOUT, move || {
        (doctor.0)(&answers)
    })
    .await;
    report.map(Json).map_err(|no_result| match no_result {
        NoResult::Late => Problem::new(Code::Ending, "the examination of this host does not end"),
        NoResult::Ending => ending(),
    })
}

fn ending() -> Problem {
    Problem::new(Code::Ending, "the agent is shutting down")
}

async fn own_answers(context: &Context, granted: Rights) -> Result<OwnAnswers, Problem> {
    let (router, _) = nouns(Some(context)).split_for_parts();
    let router = router.layer(Extension(granted)).with_state(context.clone());
    let router = &TowerToHyperService::new(router);
    let ask = |path: &'static str| async move {
        let mut request = Request::new(Body::empty());
        *request.uri_mut() = Uri::from_static(path);
        let answer = router.call(request).await;
        let answer = answer.unwrap_or_else(|never| match never {});
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
