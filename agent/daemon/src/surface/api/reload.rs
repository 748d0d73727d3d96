//! `POST /-/reload`: reloads the configuration, as SIGHUP does.

use axum::Json;
use axum::extract::State;
use tokio::sync::{mpsc, oneshot};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::Context;
use ros2probe_api::health::Reloaded;

use super::problem::{Code, Problem, ProblemBody};

/// Sends reload requests to the owner of the configuration.
#[derive(Clone, Debug)]
pub struct Reloader(mpsc::Sender<Answer>);

/// Receives reload requests.
#[derive(Debug)]
pub struct Reloads(mpsc::Receiver<Answer>);

/// Returns the result of a reload to the client that requested it.
pub type Answer = oneshot::Sender<Result<Reloaded, NotReloaded>>;

/// Why the configuration is unchanged.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum NotReloaded {
    /// The agent runs without a configuration file.
    NoFile,
    /// The file cannot be read or has errors.
    Mistakes(Vec<String>),
}

/// Creates both ends of the channel for reload requests.
#[must_use]
pub fn channel() -> (Reloader, Reloads) {
    let (ask, asked) = mpsc::channel(1);
    (Reloader(ask), Reloads(asked))
}

impl Reloads {
    /// Waits for a request; returns `None` once no further request can arrive.
    pub async fn next(&mut self) -> Option<Answer> {
        self.0.recv().await
    }
}

pub(super) fn routes() -> OpenApiRouter<Context> {
    OpenApiRouter::new().routes(routes!(reload))
}

/// Reload the configuration file
///
/// The request has the effect of `systemctl reload`. If the file has errors, the configuration
/// stays unchanged and the answer lists all errors. Watches of clients stay.
#[utoipa::path(
    post,
    path = "/-/reload",
    tag = "agent",
    responses(
        (status = 200, description = "The configuration is applied.", body = Reloaded),
        (status = 409, description = "The agent runs without a configuration file.",
            body = ProblemBody, content_type = "application/problem+json"),
        (status = 422, description = "The file has errors; `mistakes` lists them.",
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
