//! `POST /-/reload`: has the configuration read again, the same way as SIGHUP.

use axum::Json;
use axum::extract::State;
use tokio::sync::{mpsc, oneshot};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::Context;
use ros2probe_api::health::Reloaded;

use super::problem::{Code, Problem, ProblemBody};

/// Requests reloads of the owner of the configuration.
#[derive(Clone, Debug)]
pub struct Reloader(mpsc::Sender<Answer>);

/// What was asked.
#[derive(Debug)]
pub struct Reloads(mpsc::Receiver<Answer>);

/// Where the outcome goes.
pub type Answer = oneshot::Sender<Result<Reloaded, NotReloaded>>;

/// The configuration stays what it was.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum NotReloaded {
    /// There is no file.
    NoFile,
    /// The file has mistakes, or cannot be read.
    Mistakes(Vec<String>),
}

/// Both ends.
#[must_use]
pub fn channel() -> (Reloader, Reloads) {
    let (ask, asked) = mpsc::channel(1);
    (Reloader(ask), Reloads(asked))
}

impl Reloads {
    /// Waits for a request; `None` once none can come.
    pub async fn next(&mut self) -> Option<Answer> {
        self.0.recv().await
    }
}

pub(super) fn routes() -> OpenApiRouter<Context> {
    OpenApiRouter::new().routes(routes!(reload))
}

/// Read the configuration file again
///
/// As `systemctl reload` does: mistakes change nothing and are answered, all of them. Watches that
/// clients have added stay.
#[utoipa::path(
    post,
    path = "/-/reload",
    tag = "agent",
    responses(
        (status = 200, description = "The configuration was taken over.", body = Reloaded),
        (status = 409, description = "The agent runs without a configuration file.",
            body = ProblemBody, content_type = "application/problem+json"),
        (status = 422, description = "The file has mistakes, which `mistakes` lists.",
            body = ProblemBody, content_type = "application/problem+json"),
    )
)]
async fn reload(State(context): State<Context>) -> Result<Json<Reloaded>, Problem> {
    let (answer, answered) = oneshot::channel();
    let asked = context.reloader.0.send(answer).await;
    let ending = || Problem::new(Code::Ending, "the agent is shutting down");
    asked.map_err(|_| ending())?;
    match answered.await.map_err(|_| ending())? {
        Ok(reloaded) => Ok(Json(reloaded)),
        Err(NotReloaded::NoFile) => Err(Problem::new(
            Code::NothingToReload,
            "the agent was started without a configuration file",
        )),
        Err(NotReloaded::Mistakes(mistakes)) => {
            let detail = "the agent keeps its configuration; fix the file and reload";
            let problem = Problem::new(Code::InvalidConfiguration, detail);
            Err(problem.with_mistakes(mistakes))
        }
    }
}
