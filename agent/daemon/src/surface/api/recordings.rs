//! `/recordings`: bags that the agent writes, controlled by clients.
//!
//! Recordings are stored in the configured directory; a name must be a plain file name. `rp bag
//! record` writes bags elsewhere.

use std::path::{Path as FilePath, PathBuf};
use std::sync::Arc;
use std::time::{Duration, UNIX_EPOCH};

use axum::Json;
use axum::extract::{DefaultBodyLimit, Path, State};
use axum::http::StatusCode;
use axum::http::header::LOCATION;
use axum::response::{IntoResponse, Response};
use tokio::sync::Semaphore;
use tokio::task::spawn_blocking;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::Context;
use super::body::Body;
use super::kept;
use super::problem::{Code, Problem, ProblemBody};
use super::scope::domain;
use super::security::MAX_BODY;
use super::turns::run_blocking;
use crate::recording::{Command, Recording, RecordingOptions, Refusal};
use ros2probe_api::recordings::{self as answers, FilterOptions, RecordingList, RecordingRequest};
use ros2probe_bag::{Form, Options, Storage};

/// Maximum time that an answer waits for a bag to be completed.
const COMPLETION_TIMEOUT: Duration = Duration::from_secs(10);
/// Maximum time that a new recording waits for the capture to apply its subscription, and for
/// breakpoints in the processes that send the messages.
const START_TIMEOUT: Duration = Duration::from_secs(6);
/// Maximum time that the list of recordings waits for the storage. The kept bags are absent then.
const LIST_TIMEOUT: Duration = Duration::from_secs(2);
/// One thread at a time reads the directory.
static LISTING_PERMIT: Semaphore = Semaphore::const_new(1);
/// Maximum duration of one file: a year, in seconds.
const MAX_DURATION: u64 = 31_536_000;

pub(super) fn routes() -> OpenApiRouter<Context> {
    OpenApiRouter::new()
        .routes(routes!(list, begin))
        .routes(routes!(show, end))
        .routes(routes!(pause))
        .routes(routes!(resume))
        .routes(routes!(split))
        .layer(DefaultBodyLimit::max(MAX_BODY))
}

/// All recordings
#[utoipa::path(
    get,
    path = "/recordings",
    tag = "recordings",
    responses((status = 200, description = "Running recordings, and the last ones that ended.",
        body = RecordingList))
)]
async fn list(State(context): State<Context>) -> Json<RecordingList> {
    let recordings = context.recordings.all();
    let directory = context.recordings.directory();
    let known = recordings.iter().map(|each| each.name.clone()).collect();
    let root = directory.map(FilePath::to_owned);
    let listed = run_blocking(&LISTING_PERMIT, LIST_TIMEOUT, move || {
        root.map(|root| kept::kept(&root, &known))
    });
    let kept = listed.await.ok().flatten().unwrap_or_default();
    Json(RecordingList {
        directory: directory.map(|directory| directory.display().to_string()),
        recordings: recordings.iter().map(|each| view(each)).collect(),
        kept,
        limits: limits(&context),
    })
}

/// Returns the directory of a recording, or of a bag that is kept.
pub(super) async fn directory(context: &Context, name: &str) -> Result<PathBuf, Problem> {
    let missing = match find(context, name) {
        Ok(recording) => return Ok(recording.directory.clone()),
        Err(missing) => missing,
    };
    let root = context.recordings.directory().map(FilePath::to_owned);
    let name = name.to_owned();
    let found = spawn_blocking(move || kept::directory_of(&root?, &name)).await;
    found.ok().flatten().ok_or(missing)
}

/// Start a recording
///
/// The agent subscribes to nothing: it copies messages as they pass. Messages sent after the answer
/// are in the bag.
#[utoipa::path(
    post,
    path = "/recordings",
    tag = "recordings",
    request_body = RecordingRequest,
    responses(
        (status = 201, description = "The recording has started.", body = answers::Recording,
            headers(("location" = String, description = "Path of the recording."))),
        (status = 409, description = "A recording of this name exists, or the limit of recordings is reached.",
            body = ProblemBody, content_type = "application/problem+json"),
        (status = 415, description = "The content type is not JSON.",
            body = ProblemBody, content_type = "application/problem+json"),
        (status = 422, description = "The request cannot be satisfied.",
            body = ProblemBody, content_type = "application/problem+json"),
        (status = 507, description = "The bag cannot be written to the storage.",
            body = ProblemBody, content_type = "application/problem+json"),
    )
)]
async fn begin(
    State(context): State<Context>,
    Body(request): Body<RecordingRequest>,
) -> Result<Response, Problem> {
    let wanted = wanted(request)?;
    // A fresh snapshot provides the known topics for the bag's list of topics.
    context.state().await;
    let recordings = Arc::clone(&context.recordings);
    let begun = spawn_blocking(move || recordings.begin(wanted)).await;
    let begun = begun.map_err(|_| Problem::new(Code::Ending, "the agent is shutting down"))?;
    let recording = begun.map_err(|refusal| problem(&refusal))?;
    // Once the subscription is in force, the kernel's programs capture each message of the
    // requested topics.
    tokio::select! {
        _ = recording.begin().in_force(START_TIMEOUT) => {}
        () = context.stop.cancelled() => {}
    }
    let location = format!("/recordings/{}", recording.name);
    let answer = Json(view(&recording));
    Ok((StatusCode::CREATED, [(LOCATION, location)], answer).into_response())
}

/// One recording
#[utoipa::path(
    get,
    path = "/recordings/{name}",
    tag = "recordings",
    params(("name" = String, Path, description = "Name of the recording.")),
    responses(
        (status = 200, description = "The state of the recording.", body = answers::Recording),
        (status = 404, description = "The recording does not exist.",
            body = ProblemBody, content_type = "application/problem+json"),
    )
)]
async fn show(
    State(context): State<Context>,
    Path(name): Path<String>,
) -> Result<Json<answers::Recording>, Problem> {
    let recording = find(&context, &name)?;
    Ok(Json(view(&recording)))
}

/// End a recording
///
/// The answer follows once the bag is complete. The bag is kept.
#[utoipa::path(
    delete,
    path = "/recordings/{name}",
    tag = "recordings",
    params(("name" = String, Path, description = "Name of the recording.")),
    responses(
        (status = 200, description = "The recording has ended, with its report.", body = answers::Recording),
        (status = 202, description = "The recording is still ending, because the storage is slow.", body = answers::Recording),
        (status = 404, description = "The recording does not exist.",
            body = ProblemBody, content_type = "application/problem+json"),
    )
)]
async fn end(
    State(context): State<Context>,
    Path(name): Path<String>,
) -> Result<Response, Problem> {
    let recording = find(&context, &name)?;
    recording.command(Command::Stop);
    let status = if recording.wait_complete(COMPLETION_TIMEOUT).await {
        StatusCode::OK
    } else {
        StatusCode::ACCEPTED
    };
    Ok((status, Json(view(&recording))).into_response())
}

/// Pause a recording
#[utoipa::path(
    post,
    path = "/recordings/{name}/pause",
    tag = "recordings",
    params(("name" = String, Path, description = "Name of the recording.")),
    responses(
        (status = 202, description = "The recording pauses within a tenth of a second.",
            body = answers::Recording),
        (status = 404, description = "The recording does not exist.",
            body = ProblemBody, content_type = "application/problem+json"),
    )
)]
async fn pause(
    State(context): State<Context>,
    Path(name): Path<String>,
) -> Result<Response, Problem> {
    order(&context, &name, Command::Pause)
}

/// Resume a recording
#[utoipa::path(
    post,
    path = "/recordings/{name}/resume",
    tag = "recordings",
    params(("name" = String, Path, description = "Name of the recording.")),
    responses(
        (status = 202, description = "The recording resumes within a tenth of a second.",
            body = answers::Recording),
        (status = 404, description = "The recording does not exist.",
            body = ProblemBody, content_type = "application/problem+json"),
    )
)]
async fn resume(
    State(context): State<Context>,
    Path(name): Path<String>,
) -> Result<Response, Problem> {
    order(&context, &name, Command::Resume)
}

/// Continue a recording in a new file
#[utoipa::path(
    post,
    path = "/recordings/{name}/split",
    tag = "recordings",
    params(("name" = String, Path, description = "Name of the recording.")),
    responses(
        (status = 202, description = "The new file begins within a tenth of a second.", body = answers::Recording),
        (status = 404, description = "The recording does not exist.",
            body = ProblemBody, content_type = "application/problem+json"),
    )
)]
async fn split(
    State(context): State<Context>,
    Path(name): Path<String>,
) -> Result<Response, Problem> {
    order(&context, &name, Command::Split)
}

fn order(context: &Context, name: &str, command: Command) -> Result<Response, Problem> {
    let recording = find(context, name)?;
    recording.command(command);
    Ok((StatusCode::ACCEPTED, Json(view(&recording))).into_response())
}

fn find(context: &Context, name: &str) -> Result<Arc<Recording>, Problem> {
    let found = context.recordings.find(name);
    found.ok_or_else(|| {
        let name: String = name.chars().take(128).collect();
        let detail = format!("no recording `{name}`; GET /recordings lists them");
        Problem::new(Code::NoSuchRecording, detail)
    })
}

fn wanted(request: RecordingRequest) -> Result<RecordingOptions, Problem> {
    let invalid = |detail: String| Problem::new(Code::InvalidRequest, detail);
    domain(Some(request.domain_id), Code::InvalidRequest)?;
    if request.max_bag_duration_seconds > MAX_DURATION {
        let detail = format!("max_bag_duration_seconds must be at most {MAX_DURATION}");
        return Err(invalid(detail));
    }
    let asked = if request.topics == FilterOptions::default() {
        FilterOptions::everything()
    } else {
        request.topics
    };
    let options = || {
        let format = &request.file_compression;
        let mode = if format.is_empty() { "none" } else { "file" };
        let seconds = request.max_bag_duration_seconds;
        Ok::<_, ros2probe_bag::options::OptionsError>(Options {
            form: match request.distro.as_str() {
                "" => Form::default(),
                distro => Form::of(distro),
            },
            ros_distro: request.distro.clone(),
            storage: Storage::preset(&request.storage_preset_profile)?,
            file_compression: ros2probe_bag::options::file_compression(mode, format)?,
            max_file_bytes: ros2probe_bag::options::max_file_bytes(request.max_bag_size)?,
            max_file_duration: (seconds > 0).then(|| Duration::from_secs(seconds)),
            ..Options::default()
        })
    };
    Ok(RecordingOptions {
        options: options().map_err(|error| invalid(error.to_string()))?,
        name: request.name,
        requested: asked,
        domain_id: request.domain_id,
        paused: request.paused,
    })
}

fn problem(refusal: &Refusal) -> Problem {
    let code = match refusal {
        Refusal::Exists(_) => Code::RecordingExists,
        Refusal::TooMany(_) => Code::TooManyRecordings,
        Refusal::NoDirectory => Code::NoPlaceForRecordings,
        Refusal::Name(_) | Refusal::Filter(_) | Refusal::Choice(_) => Code::InvalidRequest,
        Refusal::Subscription(_) => Code::TooManySubscriptions,
        Refusal::Storage { .. } => Code::StorageRefuses,
    };
    Problem::new(code, refusal.to_string())
}

fn limits(context: &Context) -> answers::RecordingLimits {
    let limits = context.recordings.limits();
    answers::RecordingLimits {
        max_bytes: limits.max_bytes,
        max_total_bytes: limits.max_total_bytes,
        reserve_percent: limits.reserve_percent,
        reserve_bytes: limits.reserve_bytes,
    }
}

fn view(recording: &Recording) -> answers::Recording {
    let status = recording.status();
    let began = recording.began.duration_since(UNIX_EPOCH);
    answers::Recording {
        name: recording.name.clone(),
        directory: recording.directory.display().to_string(),
        domain_id: recording.domain_id,
        state: status.state.into(),
        began_timestamp_seconds: began.unwrap_or_default().as_secs_f64(),
        file_bytes: status.file_bytes,
        files: status.files,
        error: status.error,
        topics: recording.requested.clone(),
        report: status.report,
    }
}
