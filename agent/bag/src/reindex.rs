//! Completes a bag: adds the summary to unfinished files, and regenerates metadata.yaml from the
//! files.
//!
//! A file is rewritten beside itself and replaced once the copy is on disk. The bytes after its
//! last complete record are kept in a separate file. Complete files are not rewritten, except that
//! they are compressed if another file is. Files that are not MCAP stay unchanged and are reported.

use std::collections::BTreeMap;
use std::fmt;
use std::fs::{self, File};
use std::io::{self, Read as _, Seek as _, SeekFrom};
use std::path::{Path, PathBuf};

use ros2probe_wire::Expansion;

use super::file::FileWriter;
use super::mcap::{self, Message, Opcode};
use super::metadata::{self, Metadata, Topic};
use super::metadata_file::{Durability, write_metadata};
use super::read::{self, Contents, ReadError, Scan};
use super::{Compression, Error, FileCompression, info, open_file, with_suffix};

/// Result of completing a bag.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Report {
    /// Each file, in order.
    pub files: Vec<FileReport>,
    /// The new content of metadata.yaml.
    pub metadata: Metadata,
}

/// Result for one file.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct FileReport {
    /// Name of the file.
    pub name: String,
    /// Number of messages in the file afterwards.
    pub messages: u64,
    /// State of the file before.
    pub found: Found,
}

/// State of a file before it was completed.
#[derive(Clone, PartialEq, Eq, Debug)]
pub enum Found {
    /// It had a summary and was not rewritten.
    Complete,
    /// It had no summary and was completed.
    Unfinished {
        /// Number of messages recovered from a truncated chunk.
        salvaged: u64,
        /// Number of bytes after the last complete record; 0 if they are all zeros.
        cut: u64,
        /// Name of the file that keeps the bytes after the last complete record, if there are any.
        kept: Option<String>,
        /// Number of chunks that cannot be decompressed or parsed; they stay in the file.
        unreadable_chunks: u64,
    },
    /// It is not an MCAP file: it is unchanged, and not in metadata.yaml.
    NotMcap,
}

/// Why a bag could not be completed.
#[derive(Debug, thiserror::Error)]
pub enum ReindexError {
    /// The directory contains no files of a bag.
    #[error("No storage files found for reindexing in {}", .0.display())]
    NoFiles(PathBuf),
    /// The bag uses another storage.
    #[error("{} is in the sqlite3 storage, which rp does not read: use `ros2 bag reindex`", .0.display())]
    Sqlite3(PathBuf),
    /// A file cannot be read.
    #[error(transparent)]
    Read(#[from] ReadError),
    /// A file cannot be written; the original file is unchanged.
    #[error(transparent)]
    Write(#[from] Error),
}

/// Completes all files of a bag and writes its metadata.yaml.
pub fn reindex(directory: &Path, expansion: Expansion) -> Result<Report, ReindexError> {
    let mut names = files(directory)?;
    let before = info::read_text(&directory.join(metadata::FILE_NAME)).ok();
    let before = before.and_then(|text| Metadata::read(&text).ok());
    let compression = names.iter().map(|name| read::compression(Path::new(name)));
    let compression = compression.max_by_key(|compression| *compression != Compression::None);
    let compression = compression.unwrap_or_default();
    let mut reports = Vec::new();
    let mut parts = Vec::new();
    for name in &mut names {
        let path = directory.join(&*name);
        let (found, contents) = complete(&path, expansion)?;
        if let Some(contents) = &contents
            && compression != Compression::None
            && read::compression(&path) == Compression::None
            && found != Found::NotMcap
        {
            // In a bag, either all files are compressed or none.
            FileCompression::of(&path, compression).run()?;
            name.push('.');
            name.push_str(compression.name());
            parts.push((name.clone(), contents.clone()));
        } else if let Some(contents) = &contents {
            parts.push((name.clone(), contents.clone()));
        }
        reports.push(FileReport {
            name: name.clone(),
            messages: contents.map_or(0, |contents| contents.messages()),
            found,
        });
    }
    let metadata = metadata_of(&parts, before, compression, &reports);
    write_metadata(directory, &metadata, Durability::Power)?;
    Ok(Report {
        files: reports,
        metadata,
    })
}

/// Returns the names of a bag's files, in order of their number.
fn files(directory: &Path) -> Result<Vec<String>, ReindexError> {
    let wrong = |source| ReadError::Io {
        path: directory.to_owned(),
        source,
    };
    let mut names = Vec::new();
    let mut is_sqlite3 = false;
    for entry in fs::read_dir(directory).map_err(wrong)? {
        let name = entry.map_err(wrong)?.file_name();
        let Some(name) = name.to_str() else {
            continue;
        };
        is_sqlite3 |= name.ends_with(".db3");
        if [".mcap", ".mcap.zstd", ".mcap.lz4"]
            .iter()
            .any(|suffix| name.ends_with(suffix))
        {
            names.push(name.to_owned());
        }
    }
    // A process that was killed between compressing a file and removing the original leaves both.
    let all = names.clone();
    names.retain(|name| {
        let is_compressed = |suffix| all.contains(&format!("{name}.{suffix}"));
        !is_compressed("zstd") && !is_compressed("lz4")
    });
    names.sort_by_cached_key(|name| (number(name), name.clone()));
    if names.is_empty() {
        return Err(match is_sqlite3 {
            true => ReindexError::Sqlite3(directory.to_owned()),
            false => ReindexError::NoFiles(directory.to_owned()),
        });
    }
    Ok(names)
}

/// Returns the number of a file: `12` for `bag_12.mcap`, and for `12_bag_2026_05_22-10_11_58.mcap`,
/// as Lyrical names it. Files without a number are first.
fn number(name: &str) -> Option<u64> {
    let (stem, _) = name.split_once(".mcap")?;
    match stem.split_once('_') {
        Some((first, rest)) if ends_with_time(rest) => first.parse().ok(),
        _ => stem.rsplit_once('_')?.1.parse().ok(),
    }
}

/// Returns whether a name ends with a time, `YYYY_MM_DD-HH_MM_SS`.
fn ends_with_time(name: &str) -> bool {
    const TIME_SHAPE: &[u8; 19] = b"0000_00_00-00_00_00";
    let time = name.as_bytes().last_chunk::<19>();
    time.is_some_and(|time| {
        let mut pairs = TIME_SHAPE.iter().zip(time);
        pairs.all(|(shape, byte)| match shape {
            b'0' => byte.is_ascii_digit(),
            _ => byte == shape,
        })
    })
}

fn complete(path: &Path, expansion: Expansion) -> Result<(Found, Option<Contents>), ReindexError> {
    if read::compression(path) == Compression::None {
        match Contents::of_summary(path) {
            Err(ReadError::NotMcap(_)) => return Ok((Found::NotMcap, None)),
            Err(error) => return Err(error.into()),
            Ok(Some(contents)) => return Ok((Found::Complete, Some(contents))),
            Ok(None) => {}
        }
        let scan = read::scan(path, expansion, &mut |_, _| {})?;
        let written = |error| Error::writing(path, error);
        let found = rewrite(path, &scan).map_err(written)?;
        let contents = Contents::of_summary(path)?;
        return Ok((found, contents));
    }
    match read::scan(path, expansion, &mut |_, _| {}) {
        Err(ReadError::NotMcap(_)) => Ok((Found::NotMcap, None)),
        Err(error) => Err(error.into()),
        Ok(scan) => Ok((Found::Complete, Some(scan.contents))),
    }
}

fn rewrite(path: &Path, scan: &Scan) -> io::Result<Found> {
    let part = with_suffix(path, "part");
    remove(&part)?;
    let done = write_part(path, &part, scan);
    if done.is_err() {
        let _ = fs::remove_file(&part);
    }
    done
}

fn write_part(path: &Path, part: &Path, scan: &Scan) -> io::Result<Found> {
    let mut source = open_file(path)?;
    let mut writer = FileWriter::resume(part, &mut source, scan)?;
    let mut salvaged = 0;
    let mut known = scan.contents.clone();
    let mut rest = scan.cut.as_slice();
    while let Some((opcode, content, after)) = mcap::next_record(rest) {
        rest = after;
        if opcode != Opcode::MESSAGE {
            known.take(opcode, content);
            continue;
        }
        let message = Message::read(content);
        let definition = message
            .as_ref()
            .and_then(|message| definition(&known, message));
        if let (Some(message), Some(definition)) = (message, definition) {
            writer.write(&message, || definition)?;
            salvaged += 1;
        }
    }
    let cut = cut_bytes(&mut source, scan)?;
    writer.finish(std::iter::empty())?;
    writer.sync()?;
    let kept = save_remainder(path, &mut source, scan)?;
    fs::rename(part, path)?;
    Ok(Found::Unfinished {
        salvaged,
        cut,
        kept,
        unreadable_chunks: scan.unreadable_chunks,
    })
}

fn definition(known: &Contents, message: &Message<'_>) -> Option<(mcap::Schema, mcap::Channel)> {
    let channel = known.channels.get(&message.channel_id)?;
    let schema = known.schemas.get(&channel.schema_id)?;
    Some((schema.clone(), channel.clone()))
}

/// Returns the number of bytes after the last complete record; 0 if they are all zeros.
fn cut_bytes(source: &mut File, scan: &Scan) -> io::Result<u64> {
    let length = source.metadata()?.len();
    if scan.is_ended || is_zero(source, scan.end)? {
        return Ok(0);
    }
    Ok(length - scan.end)
}

/// Copies the bytes after the last complete record into a file beside it, for manual recovery.
fn save_remainder(path: &Path, source: &mut File, scan: &Scan) -> io::Result<Option<String>> {
    if cut_bytes(source, scan)? == 0 {
        return Ok(None);
    }
    let rest = with_suffix(path, "rest");
    remove(&rest)?;
    let mut file = super::new_file(&rest)?;
    source.seek(SeekFrom::Start(scan.end))?;
    io::copy(source, &mut file)?;
    file.sync_data()?;
    Ok(rest
        .file_name()
        .and_then(|name| name.to_str())
        .map(str::to_owned))
}

fn is_zero(source: &mut File, from: u64) -> io::Result<bool> {
    source.seek(SeekFrom::Start(from))?;
    let mut buffer = vec![0; 1 << 16];
    loop {
        let read = source.read(&mut buffer)?;
        if read == 0 {
            return Ok(true);
        }
        if buffer.iter().take(read).any(|byte| *byte != 0) {
            return Ok(false);
        }
    }
}

fn remove(path: &Path) -> io::Result<()> {
    match fs::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
        _ => Ok(()),
    }
}

fn metadata_of(
    parts: &[(String, Contents)],
    before: Option<Metadata>,
    compression: Compression,
    reports: &[FileReport],
) -> Metadata {
    let mut topics: BTreeMap<String, Topic> = BTreeMap::new();
    let mut files = Vec::new();
    let mut stored: Option<Metadata> = before;
    let mut times: Option<(u64, u64)> = None;
    for (name, contents) in parts {
        let suffix = format!(".{}", compression.name());
        let path = name.strip_suffix(&suffix).unwrap_or(name);
        let mut part = info::of_contents(contents, path);
        files.append(&mut part.files);
        if let Some((start, end)) = contents.times {
            let (first, last) = times.unwrap_or((start, end));
            times = Some((first.min(start), last.max(end)));
        }
        for topic in &part.topics {
            let known = topics.entry(topic.name.clone()).or_insert_with(|| Topic {
                message_count: 0,
                ..topic.clone()
            });
            // For a topic without messages, a later file may have a better description.
            if known.message_count == 0 {
                *known = Topic {
                    message_count: 0,
                    ..topic.clone()
                };
            }
            known.message_count = known.message_count.saturating_add(topic.message_count);
        }
        stored.get_or_insert(part);
    }
    let is_named = |topic: &Topic| {
        let history = topic.offered_qos_profiles.strip_prefix("- history: ");
        history.is_some_and(|history| history.starts_with(|c: char| c.is_ascii_alphabetic()))
    };
    let version = match &stored {
        _ if topics.values().any(is_named) => 9,
        Some(stored) => stored.version.max(5),
        None => 5,
    };
    let mut custom_data = stored
        .as_ref()
        .map(|stored| stored.custom_data.clone())
        .unwrap_or_default();
    for report in reports {
        if report.found != Found::Complete {
            custom_data.insert(
                format!("ros2probe.reindexed {}", report.name),
                report.to_string(),
            );
        }
    }
    Metadata {
        version,
        storage_identifier: "mcap".to_owned(),
        duration: times.map_or(0, |(start, end)| end.saturating_sub(start)),
        starting_time: times.map_or(metadata::NO_START, |(start, _)| start),
        message_count: topics
            .values()
            .fold(0, |sum, topic| sum.saturating_add(topic.message_count)),
        topics: topics.into_values().collect(),
        compression_format: compression.name().to_owned(),
        compression_mode: match compression {
            Compression::None => String::new(),
            Compression::Lz4 | Compression::Zstd => "FILE".to_owned(),
        },
        relative_file_paths: parts.iter().map(|(name, _)| name.clone()).collect(),
        files,
        custom_data,
        ros_distro: stored.map(|stored| stored.ros_distro).unwrap_or_default(),
    }
}

/// Formats one line with unescaped names, which may contain any character but a slash.
impl fmt::Display for FileReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            name,
            messages,
            found,
        } = self;
        match found {
            Found::Complete => write!(f, "{name}: complete, {messages} messages"),
            Found::NotMcap => write!(
                f,
                "{name}: not an MCAP file; left unchanged, not in the bag"
            ),
            Found::Unfinished {
                salvaged,
                cut,
                kept,
                unreadable_chunks,
            } => {
                write!(
                    f,
                    "{name}: was unfinished, now complete, {messages} messages"
                )?;
                if *salvaged > 0 {
                    write!(f, ", {salvaged} of them from a chunk that was cut")?;
                }
                if *unreadable_chunks > 0 {
                    write!(f, ", {unreadable_chunks} chunks are unreadable")?;
                }
                match kept {
                    Some(kept) => {
                        write!(f, ", {cut} bytes of an incomplete record kept in {kept}")
                    }
                    None => Ok(()),
                }
            }
        }
    }
}
