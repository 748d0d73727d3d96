//! Writes a bag: its directory, its files one after the other, its metadata.yaml.
//!
//! The writer starts no thread and reads no clock. The caller decides when to flush; sizes and the
//! messages' times decide when to split. metadata.yaml exists from the beginning and is updated at
//! each flush and split, so that `ros2 bag info` opens a bag whose writer was killed. Compressing
//! whole files is slow, so the caller receives it as a task for another thread.

mod contents;

use std::collections::{BTreeMap, HashMap};
use std::fs::{self, DirBuilder, File};
use std::os::unix::fs::DirBuilderExt as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use ros2probe_wire::Timestamp;
use ros2probe_wire::qos::Qos;

use super::file::{FileWriter, METADATA_NAME};
use super::mcap::{Message, Metadata as MetadataRecord};
use super::metadata::{self, Metadata};
use super::metadata_file::{Durability, write_metadata};
use super::{Compressed, Compression, Error, FileCompression, Form, Options, lock, qos};
use contents::{DoneFile, Topic, times};

/// Description of a topic in a bag.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct TopicDescription {
    /// Name, with leading `/`.
    pub name: String,
    /// Type: `pkg/msg/Type`.
    pub type_name: String,
    /// Type hash `RIHS01_...`, if a publisher announced it.
    pub type_hash: Option<String>,
    /// QoS of every observed publisher.
    pub publishers: Vec<Qos>,
    /// Definition of its messages, if known.
    pub schema: Option<Schema>,
}

/// A definition, as returned by `message::MessageType::schema_text`.
#[derive(Clone, PartialEq, Eq, Hash, Debug)]
pub struct Schema {
    /// Encoding of the text: `ros2msg` or `ros2idl`.
    pub encoding: String,
    /// Text with all nested types; topics of the same type share it.
    pub text: Arc<str>,
}

/// Identifies a topic of one [`Writer`].
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub struct TopicId(u16);

/// A bag that is being written.
#[derive(Debug)]
pub struct Writer {
    directory: PathBuf,
    /// Name of the directory, which is part of its files' names.
    name: String,
    options: Options,
    topics: Vec<Topic>,
    by_name: HashMap<String, TopicId>,
    schemas: HashMap<(String, Option<Schema>), u16>,
    /// Complete files; `current` follows them.
    complete_files: Vec<DoneFile>,
    current: Option<FileWriter>,
    /// Files to be compressed.
    uncompressed: Vec<FileCompression>,
    /// Accepted messages that were never written: number and bytes per channel.
    unwritten: BTreeMap<u16, (u64, u64)>,
    /// Holds the lock until the writer ends.
    _lock: Option<File>,
}

/// Result of writing a bag.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Summary {
    /// Path of the directory.
    pub directory: PathBuf,
    /// Paths of its files, in order, without metadata.yaml.
    pub files: Vec<PathBuf>,
    /// Size of the files in bytes.
    pub bytes: u64,
    /// Number of messages in the files.
    pub messages: u64,
    /// Earliest and latest log time.
    pub times: Option<(Timestamp, Timestamp)>,
    /// Topics, in the order in which they were described.
    pub topics: Vec<TopicSummary>,
}

/// Result for one topic.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct TopicSummary {
    /// Name of the topic.
    pub name: String,
    /// Number of messages in the files.
    pub messages: u64,
    /// Number of messages accepted by [`Writer::write`] but lost because the storage failed.
    pub unwritten: u64,
}

impl Writer {
    /// Creates the directory, which must not exist, the first file and a metadata.yaml without
    /// messages.
    pub fn create(directory: &Path, options: Options) -> Result<Self, Error> {
        let name = directory.file_name().and_then(|name| name.to_str());
        let Some(name) = name.map(str::to_owned) else {
            return Err(match directory.exists() {
                true => Error::Exists(directory.to_owned()),
                false => Error::Name(directory.to_owned()),
            });
        };
        if let Some(parent) = directory.parent() {
            fs::create_dir_all(parent).map_err(|error| Error::creating(parent, error))?;
        }
        let made = DirBuilder::new().mode(0o750).create(directory);
        made.map_err(|error| match error.kind() {
            std::io::ErrorKind::AlreadyExists => Error::Exists(directory.to_owned()),
            _ => Error::creating(directory, error),
        })?;
        let mut writer = Self {
            directory: directory.to_owned(),
            name,
            options,
            topics: Vec::new(),
            by_name: HashMap::new(),
            schemas: HashMap::new(),
            complete_files: Vec::new(),
            current: None,
            uncompressed: Vec::new(),
            unwritten: BTreeMap::new(),
            _lock: lock::hold(directory),
        };
        let begun = writer.open_file();
        if let Err(error) = begun.and_then(|()| writer.write_metadata_file()) {
            // The empty bag is removed, since the next attempt would leave another one. Its files
            // are removed by name: listing the directory needs a descriptor, which may be the
            // missing resource.
            let file = directory.join(writer.file_name(0));
            drop(writer);
            let _ = fs::remove_file(file);
            let _ = fs::remove_file(directory.join(metadata::FILE_NAME));
            let _ = fs::remove_dir(directory);
            return Err(error);
        }
        Ok(writer)
    }

    /// Returns the path of the bag.
    #[must_use]
    pub fn directory(&self) -> &Path {
        &self.directory
    }

    /// Describes a topic before its first message, or again when its publishers change. The last
    /// description before the first message stays in all files and in metadata.yaml: readers
    /// compare both descriptions (PyPI `rosbags` omits topics that differ). Later publishers are
    /// listed in the custom data.
    pub fn topic(&mut self, mut description: TopicDescription) -> Result<TopicId, Error> {
        let known = self.by_name.get(&description.name).copied();
        if let Some(known) = known
            && let Some(topic) = self.topics.get_mut(usize::from(known.0))
        {
            if topic.description.type_name != description.type_name {
                return Err(Error::TypeConflict {
                    topic: description.name,
                    first: topic.description.type_name.clone(),
                    second: description.type_name,
                });
            }
            if topic.is_written {
                topic.latest_qos = Some(description.publishers);
            } else {
                // The schema already has its id.
                let schema = topic.description.schema.take();
                topic.description = TopicDescription {
                    schema,
                    ..description
                };
            }
            return Ok(known);
        }
        let index = u16::try_from(self.topics.len()).ok();
        let index = index.filter(|index| *index < u16::MAX);
        let index = index.ok_or(Error::TooManyTopics)?;
        let next_schema = u16::try_from(self.schemas.len() + 1);
        let schema = (description.type_name.clone(), description.schema.clone());
        let schema_id = match self.schemas.get_key_value(&schema) {
            Some(((_, shared), id)) => {
                description.schema.clone_from(shared);
                *id
            }
            None => {
                let id = next_schema.map_err(|_| Error::TooManyTopics)?;
                self.schemas.insert(schema, id);
                id
            }
        };
        self.by_name
            .insert(description.name.clone(), TopicId(index));
        self.topics.push(Topic {
            description,
            channel_id: index + 1,
            schema_id,
            messages: 0,
            is_written: false,
            latest_qos: None,
        });
        Ok(TopicId(index))
    }

    /// Accepts one message: its bytes with the encapsulation header, its times of reception and
    /// sending, and its publisher's sequence number. If it fails, the message was not accepted.
    /// Earlier messages are in a file or still pending, and the next call retries them.
    pub fn write(
        &mut self,
        topic: TopicId,
        log_time: Timestamp,
        publish_time: Timestamp,
        sequence: u64,
        data: &[u8],
    ) -> Result<(), Error> {
        if self.is_due(log_time) {
            self.split()?;
        }
        if self.current.is_none() {
            self.open_file()?;
        }
        let (Some(topic), Some(current)) = (
            self.topics.get_mut(usize::from(topic.0)),
            self.current.as_mut(),
        ) else {
            // The topic does not belong to this bag.
            return Ok(());
        };
        let message = Message {
            channel_id: topic.channel_id,
            // The record holds the low 32 bits.
            sequence: (sequence & u64::from(u32::MAX)) as u32,
            log_time: log_time.0,
            publish_time: publish_time.0,
            data,
        };
        let spelling = self.options.form;
        let written = current.write(&message, || topic.records(spelling));
        topic.is_written |= written.is_ok();
        written.map_err(|error| Error::writing(current.path(), error))
    }

    /// Writes all accepted messages to the system and updates metadata.yaml. They then survive the
    /// end of this process.
    pub fn flush(&mut self) -> Result<(), Error> {
        if let Some(current) = &mut self.current {
            current
                .flush()
                .map_err(|error| Error::writing(current.path(), error))?;
        }
        write_metadata(&self.directory, &self.metadata(), Durability::Process)
    }

    /// Flushes, and waits until everything is on disk, where it survives a loss of power.
    pub fn sync(&mut self) -> Result<(), Error> {
        if let Some(current) = &mut self.current {
            let synced = current.flush().and_then(|()| current.sync());
            synced.map_err(|error| Error::writing(current.path(), error))?;
        }
        self.write_metadata_file()?;
        let synced = File::open(&self.directory).and_then(|directory| directory.sync_all());
        synced.map_err(|error| Error::writing(&self.directory, error))
    }

    /// Completes the current file and begins the next one, unless the file has no messages.
    pub fn split(&mut self) -> Result<(), Error> {
        if self
            .current
            .as_ref()
            .is_none_or(|current| current.messages() == 0)
        {
            return Ok(());
        }
        self.finish_file()?;
        self.open_file()?;
        self.write_metadata_file()
    }

    /// Writes the pending messages. If the storage fails, they are discarded, and
    /// [`Self::unwritten`] counts them.
    pub fn settle(&mut self) {
        if matches!(self.current.as_mut().map(FileWriter::flush), Some(Err(_))) {
            self.cancel_compression();
        }
    }

    /// Iterates over topics with messages that were accepted but discarded. Yields the topic's name
    /// and the number and bytes of these messages.
    pub fn unwritten(&self) -> impl Iterator<Item = (&str, u64, u64)> {
        self.topics.iter().filter_map(|topic| {
            let (messages, bytes) = self.unwritten.get(&topic.channel_id)?;
            Some((topic.description.name.as_str(), *messages, *bytes))
        })
    }

    /// Completes the bag. `custom_data`, such as losses and omissions, is added to metadata.yaml
    /// and to the last file. If the storage fails, pending messages are discarded and counted in
    /// the summary, and the file is completed in the reserved space.
    pub fn close(self, custom_data: BTreeMap<String, String>) -> Result<Summary, Error> {
        match self.close_with(custom_data, |work| work.run().map(Some)) {
            (summary, None) => Ok(summary),
            (_, Some(error)) => Err(error),
        }
    }

    /// Does the same as [`Self::close`], compressing files with `compress`. If `compress` returns
    /// `None`, the file stays uncompressed, which [`super::reindex`] accepts. Returns the summary
    /// and an error of the storage. A full disk is not an error here: the summary counts the
    /// messages that did not fit.
    pub fn close_with(
        mut self,
        custom_data: BTreeMap<String, String>,
        mut compress: impl FnMut(FileCompression) -> Result<Option<Compressed>, Error>,
    ) -> (Summary, Option<Error>) {
        self.options.custom_data.extend(custom_data);
        let mut refused = None;
        if let Err(error) = self.finish_file() {
            self.cancel_compression();
            // Without the summary a file is still readable, and `rp bag reindex` completes it.
            if self.finish_file().is_err() {
                self.abandon_file();
            }
            refused = Some(error);
        }
        for work in self.take_file_compressions() {
            let compressed = compress(work).and_then(|done| match done {
                Some(done) => self.compressed(&done),
                None => Ok(()),
            });
            if let Err(error) = compressed {
                refused.get_or_insert(error);
            }
        }
        match self.write_metadata_file() {
            Err(error) if refused.is_none() && self.unwritten.is_empty() => refused = Some(error),
            _ => {}
        }
        // A full disk is not an error here: the summary counts the messages that did not fit.
        let error = refused
            .filter(|error| !matches!(error, Error::DiskFull { .. } | Error::FileTooLarge { .. }));
        (self.summary(), error)
    }

    /// Returns the complete files to compress, each once. [`Self::close`] compresses the files that
    /// were not returned.
    pub fn take_file_compressions(&mut self) -> Vec<FileCompression> {
        std::mem::take(&mut self.uncompressed)
    }

    /// Records that a file is compressed.
    pub fn compressed(&mut self, done: &Compressed) -> Result<(), Error> {
        if let Some(file) = self.complete_files.get_mut(done.index) {
            file.compression = done.compression;
            file.bytes = done.bytes;
        }
        self.write_metadata_file()
    }

    /// Returns the size of the bag's files so far, in bytes.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        let current = self.current.as_ref().map_or(0, FileWriter::position);
        current + self.complete_bytes()
    }

    /// Returns the same as [`Self::bytes`], plus the bytes that are not written yet.
    #[must_use]
    pub fn expected_bytes(&self) -> u64 {
        let current = self.current.as_ref().map_or(0, FileWriter::expected_bytes);
        current + self.complete_bytes()
    }

    fn complete_bytes(&self) -> u64 {
        self.complete_files.iter().map(|file| file.bytes).sum()
    }

    /// Returns the number of files begun so far.
    #[must_use]
    pub fn files(&self) -> usize {
        self.complete_files.len() + usize::from(self.current.is_some())
    }

    fn is_due(&self, log_time: Timestamp) -> bool {
        let Some(current) = &self.current else {
            return false;
        };
        let Some((start, _)) = current.times() else {
            return false;
        };
        let bytes = self.options.max_file_bytes;
        let duration = self.options.max_file_duration;
        let index = self.options.max_index_bytes;
        bytes.is_some_and(|limit| current.expected_bytes() >= limit)
            || index.is_some_and(|limit| current.index_bytes() >= limit)
            || duration.is_some_and(|limit| {
                u128::from(log_time.0.saturating_sub(start)) > limit.as_nanos()
            })
    }

    fn open_file(&mut self) -> Result<(), Error> {
        let path = self
            .directory
            .join(self.file_name(self.complete_files.len()));
        let begin = self.metadata_record();
        let file = FileWriter::create(&path, self.options.storage, &begin);
        match file {
            Ok(file) => {
                self.current = Some(file);
                Ok(())
            }
            Err(error) => {
                // The file could not be started and is on no list, so it is removed.
                let _ = fs::remove_file(&path);
                Err(Error::creating(&path, error))
            }
        }
    }

    /// Completes the current file. If that fails, the file stays the current one: its pending
    /// messages may fit later.
    fn finish_file(&mut self) -> Result<(), Error> {
        if let Some(current) = &mut self.current {
            current
                .flush()
                .map_err(|error| Error::writing(current.path(), error))?;
        }
        let end = self.metadata_record();
        let Some(current) = &mut self.current else {
            return Ok(());
        };
        let form = self.options.form;
        let channels = self.topics.iter().map(|topic| topic.records(form));
        let finished = match form {
            // Humble writes its record at the beginning only.
            Form::Humble => Ok(()),
            Form::Compatible | Form::Named => current.write_metadata(&end),
        };
        let finished = finished.and_then(|()| current.finish(channels));
        let finished = finished.and_then(|()| current.sync());
        finished.map_err(|error| Error::writing(current.path(), error))?;
        self.abandon_file();
        Ok(())
    }

    /// Adds the current file, as it is, to the complete files.
    fn abandon_file(&mut self) {
        let Some(current) = self.current.take() else {
            return;
        };
        for topic in &mut self.topics {
            topic.messages += current
                .counts()
                .get(&topic.channel_id)
                .copied()
                .unwrap_or(0);
        }
        let index = self.complete_files.len();
        self.complete_files.push(DoneFile {
            name: self.file_name(index),
            compression: Compression::None,
            times: current.times(),
            messages: current.messages(),
            bytes: current.position(),
        });
        if self.options.file_compression != Compression::None {
            self.uncompressed.push(FileCompression {
                path: current.path().to_owned(),
                compression: self.options.file_compression,
                index,
            });
        }
    }

    fn cancel_compression(&mut self) {
        if let Some(current) = &mut self.current {
            for (channel, (messages, bytes)) in current.discard() {
                let unwritten = self.unwritten.entry(channel).or_default();
                unwritten.0 += messages;
                unwritten.1 += bytes;
            }
        }
    }

    fn file_name(&self, index: usize) -> String {
        format!("{}_{index}.mcap", self.name)
    }

    fn metadata(&self) -> Metadata {
        let current = self.current.as_ref().map(|current| DoneFile {
            name: self.file_name(self.complete_files.len()),
            compression: Compression::None,
            times: current.times(),
            messages: current.messages(),
            bytes: current.position(),
        });
        let files: Vec<&DoneFile> = self.complete_files.iter().chain(&current).collect();
        let times = times(&files);
        let compression = files.iter().map(|file| file.compression);
        let compression = compression.max_by_key(|compression| *compression != Compression::None);
        let compression = compression.unwrap_or_default();
        let in_current = self.current.as_ref().map(FileWriter::counts);
        let topics = self.topics.iter().map(|topic| {
            let current = in_current.and_then(|counts| counts.get(&topic.channel_id));
            topic.metadata(self.options.form, current.copied().unwrap_or(0))
        });
        let custom_data = match self.options.form {
            Form::Humble => BTreeMap::new(),
            Form::Compatible | Form::Named => self.custom_data(),
        };
        let ros_distro = match self.options.form {
            Form::Humble => String::new(),
            Form::Compatible | Form::Named => self.options.ros_distro.clone(),
        };
        Metadata {
            version: self.options.form.version(),
            storage_identifier: "mcap".to_owned(),
            duration: times.map_or(0, |(start, end)| end - start),
            starting_time: times.map_or(metadata::NO_START, |(start, _)| start),
            message_count: files.iter().map(|file| file.messages).sum(),
            topics: topics.collect(),
            compression_format: compression.name().to_owned(),
            compression_mode: match compression {
                Compression::None => String::new(),
                Compression::Lz4 | Compression::Zstd => "FILE".to_owned(),
            },
            relative_file_paths: files.iter().map(|file| file.path()).collect(),
            files: files.iter().map(|file| file.metadata()).collect(),
            custom_data,
            ros_distro,
        }
    }

    fn custom_data(&self) -> BTreeMap<String, String> {
        let mut data = self.options.custom_data.clone();
        for topic in &self.topics {
            if let Some(publishers) = &topic.latest_qos
                && *publishers != topic.description.publishers
            {
                let key = format!("ros2probe.later_qos_profiles {}", topic.description.name);
                data.insert(key, qos::profiles(publishers, self.options.form.spelling()));
            }
        }
        data
    }

    /// Returns the metadata record that each file contains.
    fn metadata_record(&self) -> MetadataRecord {
        let mut entries = BTreeMap::new();
        if self.options.form != Form::Named {
            entries.insert("ROS_DISTRO".to_owned(), self.options.ros_distro.clone());
        }
        if self.options.form != Form::Humble {
            let text = self.metadata().record_text();
            entries.insert("serialized_metadata".to_owned(), text);
        }
        MetadataRecord {
            name: METADATA_NAME.to_owned(),
            entries,
        }
    }

    fn write_metadata_file(&self) -> Result<(), Error> {
        write_metadata(&self.directory, &self.metadata(), Durability::Power)
    }

    fn summary(&self) -> Summary {
        let files: Vec<&DoneFile> = self.complete_files.iter().collect();
        let topics = self.topics.iter().map(|topic| TopicSummary {
            name: topic.description.name.clone(),
            messages: topic.messages,
            unwritten: self.unwritten.get(&topic.channel_id).map_or(0, |it| it.0),
        });
        Summary {
            directory: self.directory.clone(),
            files: files
                .iter()
                .map(|file| self.directory.join(file.path()))
                .collect(),
            bytes: self.bytes(),
            messages: files.iter().map(|file| file.messages).sum(),
            times: times(&files).map(|(start, end)| (Timestamp(start), Timestamp(end))),
            topics: topics.collect(),
        }
    }
}
