//! Options for writing a bag: form, chunks, compression, limits of a file.
//!
//! The presets and the keys of a storage configuration file are those of rosbag2's MCAP plugin.
//! Options without an effect here are rejected rather than ignored.

use std::collections::BTreeMap;
use std::time::Duration;

use serde::Deserialize;

use super::compression::Compression;
use super::qos::Spelling;

/// All options of a bag.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub struct Options {
    /// Form of metadata.yaml and of QoS.
    pub form: Form,
    /// Distribution of ROS, as in `ROS_DISTRO`; may be empty.
    pub ros_distro: String,
    /// Layout of the MCAP files.
    pub storage: Storage,
    /// Compression of whole files after they are complete.
    pub file_compression: Compression,
    /// Splits a file before the next message once it has this many bytes.
    pub max_file_bytes: Option<u64>,
    /// Splits a file before a message that is later than the file's first one by more than this.
    pub max_file_duration: Option<Duration>,
    /// Splits a file when its index, which is kept in memory, takes this many bytes.
    pub max_index_bytes: Option<u64>,
    /// Entries that are added to metadata.yaml.
    pub custom_data: BTreeMap<String, String>,
}

/// The distributions that can read metadata.yaml and the QoS of topics.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub enum Form {
    /// Version 5 and QoS as numbers: readable by every distribution since Humble. Additions of
    /// later versions are placed where Humble does not read them.
    #[default]
    Compatible,
    /// Exactly what Humble writes.
    Humble,
    /// Version 9 and QoS as names: readable by Jazzy and later.
    Named,
}

impl Form {
    /// Returns the form that a distribution writes.
    #[must_use]
    pub fn of(distro: &str) -> Self {
        match distro {
            "humble" => Self::Humble,
            _ => Self::Named,
        }
    }

    /// Returns the version of metadata.yaml.
    #[must_use]
    pub const fn version(self) -> u32 {
        match self {
            Self::Compatible | Self::Humble => 5,
            Self::Named => 9,
        }
    }

    /// Returns the spelling of QoS.
    #[must_use]
    pub const fn spelling(self) -> Spelling {
        match self {
            Self::Compatible | Self::Humble => Spelling::Numbers,
            Self::Named => Spelling::Names,
        }
    }
}

/// Layout of an MCAP file.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Storage {
    /// Whether messages are collected in chunks, which are indexed and may be compressed.
    pub chunked: bool,
    /// Size at which a chunk ends, before compression.
    pub chunk_bytes: u64,
    /// Compression of chunks, if it makes them smaller.
    pub compression: Compression,
    /// Whether each chunk has a checksum of its records before compression.
    pub chunk_crc: bool,
    /// Whether the summary has a checksum.
    pub summary_crc: bool,
    /// Whether a checksum of everything before the summary is written.
    pub data_crc: bool,
}

impl Default for Storage {
    /// Returns rosbag2's defaults: no compression, no checksum of chunks, 768 KiB.
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

/// Why options are invalid.
#[derive(Clone, PartialEq, Eq, Debug, thiserror::Error)]
pub enum OptionsError {
    /// The preset does not exist.
    #[error(
        "unknown MCAP storage preset profile \
        (valid options are 'none', 'fastwrite', 'zstd_fast', 'zstd_small'): {0}"
    )]
    Preset(String),
    /// The configuration file is invalid.
    #[error("{0}")]
    Configuration(String),
    /// The mode is not possible with MCAP.
    #[error(
        "MCAP storage plugin does not support message compression, consider using chunk compression \
        by setting `compression: 'Zstd'` in storage config"
    )]
    MessageCompression,
    /// The mode does not exist.
    #[error("invalid compression mode '{0}': one of none, file, message")]
    Mode(String),
    /// The format does not exist.
    #[error("Requested compression format '{0}' unavailable: one of zstd, lz4, none")]
    Format(String),
    /// Mode `file` without a format.
    #[error("Invalid choice: Cannot specify compression mode without a compression format.")]
    ModeWithoutFormat,
    /// The limit is below 1024 bytes, the minimum of the MCAP plugin.
    #[error(
        "Invalid bag splitting size given. Please provide a value greater than 1024. Specified value \
        of {0}"
    )]
    FileBytes(u64),
}

impl Storage {
    /// Returns the layout of a `--storage-preset-profile`.
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
            // The plugin uses the slowest level; only the fastest is implemented here.
            "zstd_small" => Self {
                compression: Compression::Zstd,
                chunk_bytes: 4 << 20,
                chunk_crc: true,
                ..usual
            },
            other => return Err(OptionsError::Preset(other.to_owned())),
        })
    }

    /// Applies the text of a `--storage-config-file` to the preset.
    pub fn overlaid(self, yaml: &str) -> Result<Self, OptionsError> {
        let wrong = |what: String| OptionsError::Configuration(what);
        if yaml.trim().is_empty() {
            return Ok(self);
        }
        let keys: Keys = serde_yaml::from_str(yaml).map_err(|error| wrong(error.to_string()))?;
        for (key, value) in keys.needed() {
            if value {
                let why = "is always written, because readers need it";
                return Err(wrong(format!("`{key}: true`: this part of a file {why}")));
            }
        }
        if keys.force_compression {
            let why = "a chunk that would grow is stored uncompressed";
            return Err(wrong(format!("`forceCompression: true`: {why}")));
        }
        let compression = match keys.compression.as_deref() {
            None => self.compression,
            Some("None") => Compression::None,
            Some("Lz4") => Compression::Lz4,
            Some("Zstd") => Compression::Zstd,
            Some(other) => {
                return Err(wrong(format!(
                    "compression: `{other}` must be None, Lz4 or Zstd"
                )));
            }
        };
        match keys.compression_level.as_deref() {
            None | Some("Fastest" | "Fast" | "Default" | "Slow" | "Slowest") => {}
            Some(other) => {
                let levels = "Fastest, Fast, Default, Slow, Slowest";
                return Err(wrong(format!(
                    "compressionLevel: `{other}` must be one of {levels}"
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

/// Maximum size of a chunk, in bytes: a chunk is held in memory until it is full.
const MAX_CHUNK_BYTES: u64 = 64 << 20;

/// Keys of a storage configuration file. Attachments are never written, so their keys have no
/// effect; the only zstd level is the fastest.
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

/// Parses `--compression-mode` and `--compression-format` as compression of whole files.
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

/// Parses `--max-bag-size`: 0 is no limit.
pub fn max_file_bytes(bytes: u64) -> Result<Option<u64>, OptionsError> {
    match bytes {
        0 => Ok(None),
        // The smallest size that the MCAP plugin accepts.
        1..1024 => Err(OptionsError::FileBytes(bytes)),
        _ => Ok(Some(bytes)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn presets_and_keys_match_those_of_the_mcap_plugin() {
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
    fn unsupported_and_invalid_storage_options_are_refused() {
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
    fn compression_of_single_messages_is_rejected() {
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
