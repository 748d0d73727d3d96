//! Content of a bag so far: its topics and complete files, for records and metadata.yaml.

use std::collections::BTreeMap;

use ros2probe_wire::qos::Qos;

use super::super::mcap::{Channel, Schema as SchemaRecord};
use super::super::{Compression, Form, metadata, qos};
use super::TopicDescription;

/// The only encoding of ROS 2 messages.
pub(super) const CDR_ENCODING: &str = "cdr";

#[derive(Debug)]
pub(super) struct Topic {
    pub(super) description: TopicDescription,
    pub(super) channel_id: u16,
    pub(super) schema_id: u16,
    /// Number of messages in complete files.
    pub(super) messages: u64,
    /// Whether the topic has messages; its description is then fixed.
    pub(super) is_written: bool,
    /// All publishers, if they changed after the first message.
    pub(super) latest_qos: Option<Vec<Qos>>,
}

#[derive(Clone, Debug)]
pub(super) struct DoneFile {
    /// Name without the suffix of a compression.
    pub(super) name: String,
    pub(super) compression: Compression,
    pub(super) times: Option<(u64, u64)>,
    pub(super) messages: u64,
    pub(super) bytes: u64,
}

impl Topic {
    pub(super) fn records(&self, form: Form) -> (SchemaRecord, Channel) {
        let description = &self.description;
        let (encoding, data) = match &description.schema {
            Some(schema) => (schema.encoding.as_str(), schema.text.as_bytes()),
            // Humble writes an empty encoding. rosbag2 accepts `unknown` as well, but PyPI
            // `rosbags` does not.
            None => ("", &[][..]),
        };
        let schema = SchemaRecord {
            id: self.schema_id,
            name: description.type_name.clone(),
            encoding: encoding.to_owned(),
            data: data.to_vec(),
        };
        let mut metadata = BTreeMap::new();
        let profiles = qos::profiles(&description.publishers, form.spelling());
        metadata.insert("offered_qos_profiles".to_owned(), profiles);
        if form != Form::Humble {
            let hash = description.type_hash.clone().unwrap_or_default();
            metadata.insert("topic_type_hash".to_owned(), hash);
        }
        let channel = Channel {
            id: self.channel_id,
            schema_id: self.schema_id,
            topic: description.name.clone(),
            message_encoding: CDR_ENCODING.to_owned(),
            metadata,
        };
        (schema, channel)
    }

    pub(super) fn metadata(&self, form: Form, in_current: u64) -> metadata::Topic {
        let hash = match form {
            Form::Humble => None,
            Form::Compatible | Form::Named => self.description.type_hash.clone(),
        };
        metadata::Topic {
            name: self.description.name.clone(),
            type_name: self.description.type_name.clone(),
            serialization_format: CDR_ENCODING.to_owned(),
            offered_qos_profiles: qos::profiles(&self.description.publishers, form.spelling()),
            type_description_hash: hash.unwrap_or_default(),
            message_count: self.messages + in_current,
        }
    }
}

impl DoneFile {
    pub(super) fn path(&self) -> String {
        match self.compression {
            Compression::None => self.name.clone(),
            Compression::Lz4 | Compression::Zstd => {
                format!("{}.{}", self.name, self.compression.name())
            }
        }
    }

    pub(super) fn metadata(&self) -> metadata::File {
        metadata::File {
            path: self.name.clone(),
            starting_time: self.times.map_or(metadata::NO_START, |(start, _)| start),
            duration: self.times.map_or(0, |(start, end)| end - start),
            message_count: self.messages,
        }
    }
}

pub(super) fn times(files: &[&DoneFile]) -> Option<(u64, u64)> {
    let times = files.iter().filter_map(|file| file.times);
    times.reduce(|a, b| (a.0.min(b.0), a.1.max(b.1)))
}
