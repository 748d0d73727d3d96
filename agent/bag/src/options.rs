//! How a bag is written: form, chunks, compression, limits of a file.
//!
//! The presets and the keys of a storage configuration file are those of rosbag2's MCAP plugin. What
//! has no effect here is refused rather than ignored.

use std::collections::BTreeMap;
use std::time::Duration;

use serde::Deserialize;

use super::compression::Compression;
use super::qos::Spelling;

/// Everything that can be chosen about a bag.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub struct Options {
    /// Of metadata.yaml and of QoS.
    pub form: Form,
    /// As in `ROS_DISTRO`; may be empty.
    pub ros_distro: String,
    /// Inside a file.
    pub storage: Storage,
    /// Of whole files, once they are complete.
    pub file_compression: Compression,
    /// A file is split before the message that would come after this many bytes.
    pub max_file_bytes: Option<u64>,
    /// A file is split before the message that is later than its first by more than this.
    pub max_file_duration: Option<Duration>,
    /// A file is split when its index, which is kept in memory, takes this many bytes.
    pub max_index_bytes: Option<u64>,
    /// Also written into metadata.yaml.
    pub custom_data: BTreeMap<String, String>,
}

/// Which distributions can read metadata.yaml and the QoS of topics.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub enum Form {
    /// Version 5 and QoS as numbers: read by every distribution from Humble on. What later versions
    /// added stands beside it, where Humble does not look.
    #[default]
    Compatible,
    /// As Humble itself writes.
    Humble,
    /// Version 9 and QoS as names: Jazzy and later.
    Named,
}

impl Form {
    /// What this distribution would write.
    #[must_use]
    pub fn of(distro: &str) -> Self {
        match distro {
            "humble" => Self::Humble,
            _ => Self::Named,
        }
    }

    /// Of metadata.yaml.
    #[must_use]
    pub const fn version(self) -> u32 {
        match self {
            Self::Compatible | Self::Humble => 5,
            Self::Named => 9,
        }
    }

    /// Of QoS.
    #[must_use]
    pub const fn spelling(self) -> Spelling {
        match self {
            Self::Compatible | Self::Humble => Spelling::Numbers,
            Self::Named => Spelling::Names,
        }
    }
}

/// How an MCAP file is written.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Storage {
    /// Messages are collected in chunks, which are indexed and may be compressed.
    pub chunked: bool,
    /// A chunk ends with the message that fills it to this.
    pub chunk_bytes: u64,
    /// Of chunks that it makes smaller.
    pub compression: Compression,
    /// Of chunks, before compression.
    pub chunk_crc: bool,
    /// Of the summary.
    pub summary_crc: bool,
    /// Of everything before the summary.
    pub data_crc: bool,
}

impl Default for Storage {
    /// rosbag2's: no compression, no checksum of chunks, 768 KiB.
    fn default() -> Self {
        Self {
            chunked: true,
            chunk_bytes: 768 << 10,
            compression: Compression::None,
            chunk_crc: false,
            summary_crc: true,
            data_crc: false,
        }
    }
}

/// Why options are none.
#[derive(Clone, PartialEq, Eq, Debug, thiserror::Error)]
pub enum OptionsError {
    /// Not a preset.
    #[error(
        "unknown MCAP storage preset profile \
        (valid options are 'none', 'fastwrite', 'zstd_fast', 'zstd_small'): {0}"
    )]
    Preset(String),
    /// The configuration file cannot be used.
    #[error("{0}")]
    Configuration(String),
    /// Not possible with MCAP.
    #[error(
        "MCAP storage plugin does not support message compression, consider using chunk compression \
        by setting `compression: 'Zstd'` in storage config"
    )]
    MessageCompression,
    /// Not a mode.
    #[error("invalid compression mode '{0}': one of none, file, message")]
    Mode(String),
    /// Not a format.
    #[error("Requested compression format '{0}' unavailable: one of zstd, lz4, none")]
    Format(String),
    /// `file` without a format.
    #[error("Invalid choice: Cannot specify compression mode without a compression format.")]
    ModeWithoutFormat,
    /// A limit that no file can keep.
    #[error(
        "Invalid bag splitting size given. Please provide a value greater than 1024. Specified value \
        of {0}"
    )]
    FileBytes(u64),
}

impl Storage {
    /// `--storage-preset-profile`.
    pub fn preset(name: &str) -> Result<Self, OptionsError> {
        let usual = Self::default();
        Ok(match name {
            "" | "none" => usual,
            "fastwrite" => Self {
                chunked: false,
                summary_crc: false,
                ..usual
            },
            "zstd_fast" => Self {
                compression: Compression::Zstd,
                ..usual
            },
            // The plugin's level is the slowest there is; here only the fastest exists.
            "zstd_small" => Self {
                compression: Compression::Zstd,
                chunk_bytes: 4 << 20,
                chunk_crc: true,
                ..usual
            },
            other => return Err(OptionsError::Preset(other.to_owned())),
        })
    }

    /// `--storage-config-file`: its text laid over the preset.
    pub fn overlaid(self, yaml: &str) -> Result<Self, OptionsError> {
        let wrong = |what: String| OptionsError::Configuration(what);
        if yaml.trim().is_empty() {
            return Ok(self);
        }
        let keys: Keys = serde_yaml::from_str(yaml).map_err(|error| wrong(error.to_string()))?;
        for (key, value) in keys.needed() {
            if value {
                let why = "is always written: without it a bag cannot be played or seen through";
                return Err(wrong(format!("`{key}: true`: that part of a file {why}")));
            }
        }
        if keys.force_compression {
            let why = "a chunk that compression makes larger is stored as it is";
            return Err(wrong(format!("`forceCompression: true`: {why}")));
        }
        let compression = match keys.compression.as_deref() {
            None => self.compression,
            Some("None") => Compression::None,
            Some("Lz4") => Compression::Lz4,
            Some("Zstd") => Compression::Zstd,
            Some(other) => {
                return Err(wrong(format!(
                    "compression: `{other}` is none of None, Lz4, Zstd"
                )));
            }
        };
        match keys.compression_level.as_deref() {
            None | Some("Fastest" | "Fast" | "Default" | "Slow" | "Slowest") => {}
            Some(other) => {
                let levels = "Fastest, Fast, Default, Slow, Slowest";
                return Err(wrong(format!(
                    "compressionLevel: `{other}` is none of {levels}"
                )));
            }
        }
        Ok(Self {
            chunked: keys.no_chunking.map_or(self.chunked, |no| !no),
            chunk_bytes: keys
                .chunk_size
                .unwrap_or(self.chunk_bytes)
                .min(MAX_CHUNK_BYTES),
            compression,
            chunk_crc: keys.no_chunk_crc.map_or(self.chunk_crc, |no| !no),
            summary_crc: keys.no_summary_crc.map_or(self.summary_crc, |no| !no),
            data_crc: keys.enable_data_crc.unwrap_or(self.data_crc),
        })
    }
}

/// A chunk is held in memory until it is full.
const MAX_CHUNK_BYTES: u64 = 64 << 20;

/// Keys of a storage configuration file. Attachments are never written, so theirs change nothing;
/// the one zstd level is the fastest.
#[derive(Default, Deserialize)]
#[serde(default, deny_unknown_fields, rename_all = "camelCase")]
struct Keys {
    #[serde(rename = "noChunkCRC")]
    no_chunk_crc: Option<bool>,
    #[serde(rename = "noAttachmentCRC")]
    _no_attachment_crc: Option<bool>,
    #[serde(rename = "enableDataCRC")]
    enable_data_crc: Option<bool>,
    #[serde(rename = "noSummaryCRC")]
    no_summary_crc: Option<bool>,
    no_chunking: Option<bool>,
    chunk_size: Option<u64>,
    compression: Option<String>,
    compression_level: Option<String>,
    force_compression: bool,
    #[serde(rename = "noAttachmentIndex")]
    _no_attachment_index: Option<bool>,
    no_message_index: bool,
    no_summary: bool,
    no_repeated_schemas: bool,
    no_repeated_channels: bool,
    no_metadata_index: bool,
    no_chunk_index: bool,
    no_statistics: bool,
    no_summary_offsets: bool,
}

impl Keys {
    fn needed(&self) -> [(&'static str, bool); 8] {
        [
            ("noMessageIndex", self.no_message_index),
            ("noSummary", self.no_summary),
            ("noRepeatedSchemas", self.no_repeated_schemas),
            ("noRepeatedChannels", self.no_repeated_channels),
            ("noMetadataIndex", self.no_metadata_index),
            ("noChunkIndex", self.no_chunk_index),
            ("noStatistics", self.no_statistics),
            ("noSummaryOffsets", self.no_summary_offsets),
        ]
    }
}

/// `--compression-mode` and `--compression-format`, as compression of whole files.
pub fn file_compression(mode: &str, format: &str) -> Result<Compression, OptionsError> {
    let format = match format {
        "" | "none" => Compression::None,
        other => Compression::named(other).ok_or_else(|| OptionsError::Format(other.to_owned()))?,
    };
    match (mode, format) {
        ("" | "none", _) => Ok(Compression::None),
        ("file", Compression::None) => Err(OptionsError::ModeWithoutFormat),
        ("file", format) => Ok(format),
        ("message", _) => Err(OptionsError::MessageCompression),
        (other, _) => Err(OptionsError::Mode(other.to_owned())),
    }
}

/// `--max-bag-size`: 0 is none.
pub fn max_file_bytes(bytes: u64) -> Result<Option<u64>, OptionsError> {
    match bytes {
        0 => Ok(None),
        // What the MCAP plugin calls its least size.
        1..1024 => Err(OptionsError::FileBytes(bytes)),
        _ => Ok(Some(bytes)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn presets_and_keys_are_those_of_the_plugin() {
        let small = Storage::preset("zstd_small").unwrap();
        assert_eq!((small.chunk_bytes, small.chunk_crc), (4 << 20, true));
        let keys = "noChunkCRC: true\nchunkSize: 1000\ncompression: Lz4\ncompressionLevel: Slow\n";
        let overlaid = small.overlaid(keys).unwrap();
        assert_eq!(
            (
                overlaid.chunk_bytes,
                overlaid.chunk_crc,
                overlaid.compression
            ),
            (1000, false, Compression::Lz4)
        );
        assert!(!Storage::preset("fastwrite").unwrap().chunked);
        assert_eq!(small.overlaid("# nothing\n").unwrap(), small);
        assert!(
            Storage::preset("zstd")
                .unwrap_err()
                .to_string()
                .ends_with("'zstd_small'): zstd")
        );
    }

    #[test]
    fn what_would_have_no_effect_is_refused() {
        for keys in [
            "noSummary: true",
            "chunksize: 5",
            "compression: zstd",
            "[",
            "chunkSize: -1",
        ] {
            assert!(Storage::default().overlaid(keys).is_err(), "{keys}");
        }
        assert_eq!(
            Storage::default().overlaid("noSummary: false").unwrap(),
            Storage::default()
        );
    }

    #[test]
    fn messages_are_not_compressed_one_by_one() {
        assert_eq!(file_compression("file", "zstd"), Ok(Compression::Zstd));
        assert_eq!(file_compression("none", "zstd"), Ok(Compression::None));
        assert_eq!(
            file_compression("file", "none"),
            Err(OptionsError::ModeWithoutFormat)
        );
        assert_eq!(
            file_compression("message", "zstd"),
            Err(OptionsError::MessageCompression)
        );
        assert!(file_compression("file", "gz").is_err());
        assert!(max_file_bytes(1023).is_err());
        assert_eq!(max_file_bytes(0), Ok(None));
    }
}
