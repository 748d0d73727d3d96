//! `/recordings/{name}/files`: downloads of a bag's files.
//!
//! Only files in the listing are served: plain files in the recording's own directory. Links are
//! not followed.

use std::fs::{self, File};
use std::io::{self, Read as _};
use std::path::Path as FilePath;

use axum::Json;
use axum::body::{Body, Bytes};
use axum::extract::{Path, State};
use axum::http::header::{
    CACHE_CONTROL, CONTENT_DISPOSITION, CONTENT_LENGTH, CONTENT_TYPE, X_CONTENT_TYPE_OPTIONS,
};
use axum::response::{IntoResponse, Response};
use futures_util::stream;
use tokio::task::spawn_blocking;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::Context;
use super::problem::{Code, Problem, ProblemBody};
use super::recordings::find;
use ros2probe_api::recordings::{RecordingFile, RecordingFiles};

/// Maximum number of files listed per bag.
const MAX_FILES: usize = 10_000;
/// Maximum size of one read, in bytes.
const PIECE: usize = 64 << 10;

pub(super) fn routes() -> OpenApiRouter<Context> {
    OpenApiRouter::new()
        .routes(routes!(list))
        .routes(routes!(download))
}

/// The files of a recording
#[utoipa::path(
    get,
    path = "/recordings/{name}/files",
    tag = "recordings",
    params(("name" = String, Path, description = "Name of the recording.")),
    responses(
        (status = 200, description = "The files of the recording.", body = RecordingFiles),
        (status = 404, description = "The recording does not exist.",
            body = ProblemBody, content_type = "application/problem+json"),
    )
)]
async fn list(
    State(context): State<Context>,
    Path(name): Path<String>,
) -> Result<Json<RecordingFiles>, Problem> {
    let recording = find(&context, &name)?;
    let listed = spawn_blocking(move || files(&recording.directory)).await;
    let files = listed.map_err(|_| Problem::new(Code::Ending, "the agent is shutting down"))?;
    Ok(Json(RecordingFiles { files }))
}

/// A file of a recording
///
/// The answer has the file's length at the time of the request; data appended later is not
/// included.
#[utoipa::path(
    get,
    path = "/recordings/{name}/files/{file}",
    tag = "recordings",
    params(
        ("name" = String, Path, description = "Name of the recording."),
        ("file" = String, Path, description = "Name of the file."),
    ),
    responses(
        (status = 200, description = "The content of the file.", body = Vec<u8>,
            content_type = "application/octet-stream"),
        (status = 404, description = "The recording or the file does not exist.",
            body = ProblemBody, content_type = "application/problem+json"),
    )
)]
async fn download(
    State(context): State<Context>,
    Path((name, file)): Path<(String, String)>,
) -> Result<Response, Problem> {
    let recording = find(&context, &name)?;
    let opened = spawn_blocking(move || {
        // Only listed files are served, so no path leads out of the directory.
        let files = files(&recording.directory);
        let found = files.into_iter().find(|each| each.file == file)?;
        let open = File::open(recording.directory.join(&found.file)).ok()?;
        Some((found, open))
    });
    let opened = opened.await;
    let opened = opened.map_err(|_| Problem::new(Code::Ending, "the agent is shutting down"))?;
    let missing = || {
        let detail = format!("no such file; GET /recordings/{name}/files lists them");
        Problem::new(Code::NoSuchRecording, detail)
    };
    let (RecordingFile { file, bytes }, open) = opened.ok_or_else(missing)?;
    let pieces = stream::unfold(Some((open, bytes)), |open| async {
        let (open, left) = open.filter(|(_, left)| *left > 0)?;
        let read = spawn_blocking(move || piece(open, left)).await;
        Some(
            match read.unwrap_or_else(|error| Err(io::Error::other(error))) {
                Ok((piece, rest)) => (Ok(piece), Some(rest)),
                // The error breaks the connection, so the client notices the missing bytes.
                Err(error) => (Err(error), None),
            },
        )
    });
    let headers = [
        (CACHE_CONTROL, "no-store".to_owned()),
        (CONTENT_TYPE, "application/octet-stream".to_owned()),
        (X_CONTENT_TYPE_OPTIONS, "nosniff".to_owned()),
        (CONTENT_LENGTH, bytes.to_string()),
        (
            CONTENT_DISPOSITION,
            format!("attachment; filename=\"{file}\""),
        ),
    ];
    Ok((headers, Body::from_stream(pieces)).into_response())
}

/// Reads the next bytes of a file. Returns them with the file and the number of bytes left.
fn piece(mut file: File, left: u64) -> io::Result<(Bytes, (File, u64))> {
    let mut piece = Vec::with_capacity(PIECE);
    let most = left.min(PIECE as u64);
    let read = io::Read::take(&mut file, most).read_to_end(&mut piece)? as u64;
    if read < most {
        return Err(io::ErrorKind::UnexpectedEof.into());
    }
    Ok((piece.into(), (file, left - read)))
}

/// Returns the plain files of a directory whose names are valid in a header.
fn files(directory: &FilePath) -> Vec<RecordingFile> {
    let entries = fs::read_dir(directory).into_iter().flatten();
    let files = entries.filter_map(|entry| {
        let entry = entry.ok()?;
        // The metadata describe the entry itself, so links are not followed.
        let metadata = entry.metadata().ok().filter(fs::Metadata::is_file)?;
        let file = entry.file_name().into_string().ok()?;
        let is_plain = |byte: u8| byte.is_ascii_alphanumeric() || b"._-".contains(&byte);
        file.bytes().all(is_plain).then_some(RecordingFile {
            file,
            bytes: metadata.len(),
        })
    });
    let mut files: Vec<_> = files.take(MAX_FILES).collect();
    files.sort_unstable();
    files
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_plain_files_are_listed() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path();
        fs::write(path.join("metadata.yaml"), "12345").unwrap();
        fs::write(path.join("bag_0.mcap"), "1").unwrap();
        fs::write(path.join("with \"quotes\".mcap"), "1").unwrap();
        fs::create_dir(path.join("folder")).unwrap();
        std::os::unix::fs::symlink("/etc/passwd", path.join("link")).unwrap();
        let listed = files(path);
        let names: Vec<_> = listed.iter().map(|each| each.file.as_str()).collect();
        assert_eq!(names, ["bag_0.mcap", "metadata.yaml"]);
        assert_eq!(listed[1].bytes, 5);
        assert!(files(&path.join("nowhere")).is_empty());
    }

    #[test]
    fn files_beyond_the_cap_are_not_listed() {
        let directory = tempfile::tempdir().unwrap();
        for number in 0..MAX_FILES + 5 {
            File::create(directory.path().join(format!("bag_{number}.mcap"))).unwrap();
        }
        assert_eq!(files(directory.path()).len(), MAX_FILES);
    }
}
