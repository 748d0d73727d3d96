//! Compares metadata and records with real bags of Humble.

use std::collections::BTreeMap;
use std::fs;
use std::path::PathBuf;

use ros2probe_bag::mcap::{self as records, Opcode};
use ros2probe_bag::metadata::Metadata;
use ros2probe_bag::read::{self, Contents};
use ros2probe_bag::{
    Compression, Form, Options, Schema, Storage, TopicDescription, TopicId, Writer,
};
use ros2probe_testing::repository;
use ros2probe_wire::qos::{Durability, History, HistoryKind, Qos, Reliability, Role};
use ros2probe_wire::rtps::VendorId;
use ros2probe_wire::{Expansion, Timestamp};

fn real() -> PathBuf {
    repository("agent/testing/data/bags")
}

#[test]
fn metadata_of_real_bags_is_formatted_byte_for_byte() {
    for bag in fs::read_dir(real()).unwrap() {
        let file = bag.unwrap().path().join("metadata.yaml");
        let Ok(text) = fs::read_to_string(&file) else {
            continue;
        };
        let text = text.trim_end_matches('\n');
        assert_eq!(
            Metadata::read(text).unwrap().file_text(),
            text,
            "{}",
            file.display()
        );
    }
}

fn qos(depth: i32, reliability: Reliability, durability: Durability) -> Qos {
    Qos {
        history: Some(History {
            kind: HistoryKind::KEEP_LAST,
            depth,
        }),
        reliability,
        durability,
        ..Qos::defaults(Role::Writer, VendorId::CYCLONE)
    }
}

/// Returns the records of a file in order, as text, without fields that must differ.
fn listing(bytes: &[u8]) -> Vec<String> {
    let mut listing = Vec::new();
    let mut rest = &bytes[records::MAGIC.len()..bytes.len() - records::MAGIC.len()];
    while let Some((opcode, content, after)) = records::next_record(rest) {
        rest = after;
        match opcode {
            Opcode::HEADER => {
                listing.push(format!("header {:?}", records::read_header(content)));
            }
            Opcode::CHUNK => {
                let chunk = records::Chunk::read(content).unwrap();
                let crc = chunk.uncompressed_crc;
                let times = (chunk.start, chunk.end);
                let size = chunk.uncompressed_size;
                listing.push(format!(
                    "chunk {} {size} {crc} {times:?}",
                    chunk.compression
                ));
                let compression = Compression::named(chunk.compression).unwrap();
                let inside = compression.decompressed(chunk.records, size).unwrap();
                let mut inside = inside.as_slice();
                while let Some((opcode, content, after)) = records::next_record(inside) {
                    inside = after;
                    listing.push(format!("  {} {content:?}", opcode.0));
                }
            }
            // A chunk has one index per channel, in any order.
            Opcode::MESSAGE_INDEX => {
                let at = listing
                    .iter()
                    .rposition(|line| !line.starts_with("7 "))
                    .unwrap()
                    + 1;
                listing.push(format!("7 {content:?}"));
                listing[at..].sort();
            }
            Opcode::STATISTICS => {
                listing.push(format!("{:?}", records::Statistics::read(content).unwrap()));
            }
            Opcode::CHUNK_INDEX => {
                let index = records::ChunkIndex::read(content).unwrap();
                let size = index.uncompressed_size;
                let indexes = (index.message_indexes.len(), index.message_indexes_length);
                listing.push(format!(
                    "chunk index {size} {indexes:?} {}",
                    index.compression
                ));
            }
            // Offsets depend on the compressed size of the chunk.
            Opcode::SUMMARY_OFFSET => {
                listing.push(format!("offset of {} {:?}", content[0], &content[9..]));
            }
            Opcode::FOOTER => {
                let footer = records::Footer::read(content).unwrap();
                listing.push(format!("footer {}", footer.summary_crc != 0));
            }
            Opcode::METADATA_INDEX => {
                let (_, length) = records::read_metadata_index(content).unwrap();
                listing.push(format!("metadata index {length}"));
            }
            other => listing.push(format!("{} {content:?}", other.0)),
        }
    }
    listing
}

#[test]
fn written_records_equal_those_of_humble() {
    let original = real().join("bag_zstd_fast/bag_zstd_fast_0.mcap");
    let contents = Contents::of_summary(&original).unwrap().unwrap();
    let directory = tempfile::tempdir().unwrap();
    let options = Options {
        form: Form::Humble,
        ros_distro: "humble".into(),
        storage: Storage::preset("zstd_fast").unwrap(),
        ..Options::default()
    };
    let path = directory.path().join("bag_zstd_fast");
    let mut writer = Writer::create(&path, options).unwrap();
    let mut topics: BTreeMap<u16, TopicId> = BTreeMap::new();
    for channel in contents.channels.values() {
        let schema = &contents.schemas[&channel.schema_id];
        let publisher = match channel.topic.as_str() {
            "/tf_static" => qos(1, Reliability::RELIABLE, Durability::TRANSIENT_LOCAL),
            "/chatter" => qos(10, Reliability::RELIABLE, Durability::VOLATILE),
            _ => qos(5, Reliability::BEST_EFFORT, Durability::VOLATILE),
        };
        let description = TopicDescription {
            name: channel.topic.clone(),
            type_name: schema.name.clone(),
            type_hash: None,
            publishers: vec![publisher],
            schema: Some(Schema {
                encoding: schema.encoding.clone(),
                text: String::from_utf8(schema.data.clone()).unwrap().into(),
            }),
        };
        topics.insert(channel.id, writer.topic(description).unwrap());
    }
    // Humble writes neither sequence numbers nor times of sending.
    let write = &mut |message: &records::Message<'_>, _: &Contents| {
        let time = Timestamp(message.log_time);
        let topic = topics[&message.channel_id];
        writer.write(topic, time, time, 0, message.data).unwrap();
    };
    read::scan(&original, Expansion::Limited, write).unwrap();
    let summary = writer.close(BTreeMap::new()).unwrap();
    let ours = listing(&fs::read(&summary.files[0]).unwrap());
    let theirs = listing(&fs::read(&original).unwrap());
    assert_eq!(ours.len(), theirs.len());
    for (ours, theirs) in ours.iter().zip(&theirs) {
        assert_eq!(ours, theirs);
    }
    // metadata.yaml is equal as well, except for the order of topics.
    let theirs = fs::read_to_string(real().join("bag_zstd_fast/metadata.yaml")).unwrap();
    let mut theirs = Metadata::read(&theirs).unwrap();
    let ours = fs::read_to_string(path.join("metadata.yaml")).unwrap();
    let mut ours = Metadata::read(&ours).unwrap();
    ours.topics.sort_by(|a, b| a.name.cmp(&b.name));
    theirs.topics.sort_by(|a, b| a.name.cmp(&b.name));
    assert_eq!(ours, theirs);
}
