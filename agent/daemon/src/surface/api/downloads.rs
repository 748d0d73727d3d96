//! `/recordings/{name}/files` and `/recordings/{name}/archive`: downloads of a bag's files.
//!
//! Only files in the listing are served: plain files in the recording's own directory. Links are
//! not followed.

use std::collections::VecDeque;
use std::fs::{self, File};
use std::io::{self, Read as _};
use std::path::{Path as FilePath, PathBuf};
use std::time::UNIX_EPOCH;

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
use super::recordings::directory;
use crate::file;
use ros2probe_api::recordings::{RecordingFile, RecordingFiles};

/// Maximum number of files listed per bag.
const MAX_FILES: usize = 10_000;
/// Maximum size of one read, in bytes.
const READ_BYTES: usize = 64 << 10;

pub(super) fn routes() -> OpenApiRouter<Context> {
    OpenApiRouter::new()
        .routes(routes!(list))
        .routes(routes!(download))
        .routes(routes!(archive))
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
    let directory = directory(&context, &name).await?;
    let listed = spawn_blocking(move || files(&directory)).await;
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
    let directory = directory(&context, &name).await?;
    let opened = spawn_blocking(move || {
        // Only listed files are served, so no path leads out of the directory.
        let files = files(&directory);
        let found = files.into_iter().find(|each| each.file == file)?;
        let open = File::open(directory.join(&found.file)).ok()?;
        Some((found, open))
    });
    let opened = opened.await;
    let opened = opened.map_err(|_| Problem::new(Code::Ending, "the agent is shutting down"))?;
    let missing = || {
        let detail = format!("no such file; GET /recordings/{name}/files lists them");
        Problem::new(Code::NoSuchRecording, detail)
    };
    let (RecordingFile { file, bytes }, open) = opened.ok_or_else(missing)?;
    let part = Part::File {
        path: PathBuf::new(),
        open: Some(open),
        left: bytes,
    };
    let disposition = format!("attachment; filename=\"{file}\"");
    let headers = [(CONTENT_DISPOSITION, disposition)];
    Ok((headers, answer("application/octet-stream", vec![part])).into_response())
}

/// All files of a recording
///
/// The answer is a tar archive with the bag's directory. It has the lengths of the files at the
/// time of the request; data appended later are not included.
#[utoipa::path(
    get,
    path = "/recordings/{name}/archive",
    tag = "recordings",
    params(("name" = String, Path, description = "Name of the recording.")),
    responses(
        (status = 200, description = "The archive.", body = Vec<u8>, content_type = "application/x-tar"),
        (status = 404, description = "The recording does not exist.",
            body = ProblemBody, content_type = "application/problem+json"),
    )
)]
async fn archive(
    State(context): State<Context>,
    Path(name): Path<String>,
) -> Result<Response, Problem> {
    let directory = directory(&context, &name).await?;
    let parts = spawn_blocking(move || archive_parts(&directory)).await;
    let parts = parts.map_err(|_| Problem::new(Code::Ending, "the agent is shutting down"))?;
    Ok(answer("application/x-tar", parts))
}

/// A part of an answer.
#[derive(Debug)]
enum Part {
    Bytes(Bytes),
    /// The next bytes of a file, which is opened when they are due.
    File {
        path: PathBuf,
        open: Option<File>,
        left: u64,
    },
}

impl Part {
    const fn length(&self) -> u64 {
        match self {
            Self::Bytes(bytes) => bytes.len() as u64,
            Self::File { left, .. } => *left,
        }
    }

    /// Reads the next bytes. Returns them with the part that is left.
    fn read(self) -> io::Result<(Bytes, Self)> {
        let (path, open, left) = match self {
            Self::Bytes(bytes) => return Ok((bytes, Self::Bytes(Bytes::new()))),
            Self::File { path, open, left } => (path, open, left),
        };
        let mut file = open.map_or_else(|| file::open_no_link(&path), Ok)?;
        let mut piece = Vec::with_capacity(READ_BYTES);
        let most = left.min(READ_BYTES as u64);
        let read = io::Read::take(&mut file, most).read_to_end(&mut piece)? as u64;
        if read < most {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        let rest = Self::File {
            path,
            open: Some(file),
            left: left - read,
        };
        Ok((piece.into(), rest))
    }
}

/// Returns an answer of these parts, which are read while the client reads.
fn answer(content_type: &'static str, mut parts: Vec<Part>) -> Response {
    parts.retain(|part| part.length() > 0);
    let length: u64 = parts.iter().map(Part::length).sum();
    let pieces = stream::unfold(VecDeque::from(parts), |mut parts| async {
        let part = parts.pop_front()?;
        let read = spawn_blocking(move || part.read()).await;
        Some(
            match read.unwrap_or_else(|error| Err(io::Error::other(error))) {
                Ok((piece, rest)) => {
                    if rest.length() > 0 {
                        parts.push_front(rest);
                    }
                    (Ok(piece), parts)
                }
                // The error breaks the connection, so the client notices the missing bytes.
                Err(error) => (Err(error), VecDeque::new()),
            },
        )
    });
    let headers = [
        (CACHE_CONTROL, "no-store".to_owned()),
        (CONTENT_TYPE, content_type.to_owned()),
        (X_CONTENT_TYPE_OPTIONS, "nosniff".to_owned()),
        (CONTENT_LENGTH, length.to_string()),
    ];
    (headers, Body::from_stream(pieces)).into_response()
}

/// Returns the parts of a tar archive of a bag: for each file its header, its content, and zeros up
/// to a whole block; at the end two empty blocks.
fn archive_parts(directory: &FilePath) -> Vec<Part> {
    const TAR_BLOCK_BYTES: u64 = 512;
    let name = directory.file_name().unwrap_or_default();
    let mut parts = Vec::new();
    for RecordingFile { file, bytes } in files(directory) {
        let path = directory.join(&file);
        let mut header = tar::Header::new_ustar();
        if header.set_path(FilePath::new(name).join(&file)).is_err() {
            // A longer path does not fit into the format: the file alone has a shorter one.
            let _ = header.set_path(&file);
        }
        header.set_size(bytes);
        header.set_mode(0o644);
        let modified = fs::metadata(&path).and_then(|metadata| metadata.modified());
        let since = modified
            .ok()
            .and_then(|time| time.duration_since(UNIX_EPOCH).ok());
        header.set_mtime(since.unwrap_or_default().as_secs());
        header.set_cksum();
        parts.push(Part::Bytes(Bytes::copy_from_slice(header.as_bytes())));
        parts.push(Part::File {
            path,
            open: None,
            left: bytes,
        });
        let padding = (TAR_BLOCK_BYTES - bytes % TAR_BLOCK_BYTES) % TAR_BLOCK_BYTES;
        let zeros = vec![0; usize::try_from(padding).unwrap_or_default()];
        parts.push(Part::Bytes(zeros.into()));
    }
    parts.push(Part::Bytes(vec![0; 1024].into()));
    parts
}

/// Returns the plain files of a directory whose names are valid in a header.
pub(super) fn files(directory: &FilePath) -> Vec<RecordingFile> {
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
    fn an_archive_has_every_file_in_the_directory_of_the_bag() {
        let directory = tempfile::tempdir().unwrap();
        let bag = directory.path().join("lap");
        fs::create_dir(&bag).unwrap();
        let contents = [
            ("lap_0.mcap", vec![7; 700]),
            ("metadata.yaml", vec![8; 512]),
            ("empty", vec![]),
        ];
        for (name, content) in &contents {
            fs::write(bag.join(name), content).unwrap();
        }
        let mut bytes = Vec::new();
        for part in archive_parts(&bag) {
            match part {
                Part::Bytes(own) => bytes.extend_from_slice(&own),
                Part::File { path, .. } => bytes.extend(fs::read(path).unwrap()),
            }
        }
        assert_eq!(bytes.len() % 512, 0);
        let mut archive = tar::Archive::new(&bytes[..]);
        let mut found = std::collections::BTreeMap::new();
        for entry in archive.entries().unwrap() {
            let mut entry = entry.unwrap();
            let mut content = Vec::new();
            entry.read_to_end(&mut content).unwrap();
            found.insert(entry.path().unwrap().display().to_string(), content);
        }
        let expected = contents.map(|(name, content)| (format!("lap/{name}"), content));
        assert_eq!(found, expected.into());
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
