//! What real bags of Humble look like, and what is said of them.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use ros2probe::bag::mcap::{self as records, Opcode};
use ros2probe::bag::metadata::Metadata;
use ros2probe::bag::read::{self, Contents};
use ros2probe::bag::{
    Compression, Form, Options, Schema, Storage, TopicDescription, TopicId, Writer,
};
use ros2probe_wire::Timestamp;
use ros2probe_wire::qos::{Durability, History, HistoryKind, Qos, Reliability, Role};
use ros2probe_wire::rtps::VendorId;

/// Files that are not in the repository, and their sizes.
const SIZES: [(&str, u64); 8] = [
    ("bag_all/bag_all_0.mcap", 747_624),
    ("bag_default/bag_default_0.mcap", 9225237),
    ("bag_fastwrite/bag_fastwrite_0.mcap", 427_849),
    ("bag_split/bag_split_0.mcap", 158_126),
    ("bag_split/bag_split_1.mcap", 157_755),
    ("bag_split/bag_split_2.mcap", 158_126),
    ("bag_split/bag_split_3.mcap", 145_808),
    ("bag_sqlite3/bag_sqlite3_0.db3", 24_576),
];

fn real() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../testing/data/bags")
}

fn rp(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_rp"))
        .args(arguments)
        .env("TZ", "UTC")
        .env_remove("ROS_DISTRO")
        .output()
        .unwrap()
}

/// Copies of all real bags, with files of zeros where only the size matters.
fn copies(into: &Path) -> Vec<PathBuf> {
    let mut bags = Vec::new();
    for entry in fs::read_dir(real()).unwrap() {
        let from = entry.unwrap().path();
        if !from.is_dir() {
            continue;
        }
        let to = into.join(from.file_name().unwrap());
        fs::create_dir(&to).unwrap();
        for file in fs::read_dir(&from).unwrap() {
            let file = file.unwrap().path();
            if file.file_name().unwrap() != "info.txt" {
                fs::copy(&file, to.join(file.file_name().unwrap())).unwrap();
            }
        }
        bags.push(to);
    }
    for (name, size) in SIZES {
        File::create(into.join(name))
            .unwrap()
            .set_len(size)
            .unwrap();
    }
    bags.sort();
    bags
}

#[test]
fn info_of_every_real_bag_is_what_the_original_printed() {
    let directory = tempfile::tempdir().unwrap();
    let bags = copies(directory.path());
    assert_eq!(bags.len(), 7);
    for bag in bags {
        let name = bag.file_name().unwrap().to_str().unwrap();
        let said = fs::read_to_string(real().join(name).join("info.txt")).unwrap();
        let printed = rp(&["bag", "info", bag.to_str().unwrap(), "--distro", "humble"]);
        let printed = String::from_utf8(printed.stdout).unwrap();
        assert_eq!(printed.repeat(2), said, "{name}");
    }
}

#[test]
fn later_distributions_add_theirs_and_sort() {
    let bag = real().join("bag_zstd_fast");
    let bag = bag.to_str().unwrap();
    let printed = |arguments: &[&str]| {
        let output = rp(&[&["bag", "info", bag], arguments].concat());
        assert!(output.status.success());
        String::from_utf8(output.stdout).unwrap()
    };
    let jazzy = printed(&["--sort", "count"]);
    let expected =
        "\nStorage id:        mcap\nROS Distro:        unknown\nDuration:          5.752179901s\n";
    assert!(jazzy.contains(expected), "{jazzy}");
    let end = "Topic information: \
        Topic: /tf_static | Type: tf2_msgs/msg/TFMessage | Count: 1 | Serialization Format: cdr
                   Topic: /chatter | Type: std_msgs/msg/String | Count: 58 | Serialization Format: cdr
                   Topic: /robot1/imu/data | Type: sensor_msgs/msg/Imu | Count: 1152 | Serialization Format: cdr
Service:           0\nService information: \n";
    assert!(jazzy.ends_with(end), "{jazzy}");
    let kilted = printed(&["--distro", "kilted"]);
    let end = "\nServices:          0\nService information: \nActions:           0\nAction information: \n";
    assert!(kilted.ends_with(end), "{kilted}");
    assert_eq!(printed(&["-t"]), "/chatter\n/robot1/imu/data\n/tf_static\n");
    let verbose = printed(&["-v"]);
    // 1152 messages of 324 bytes.
    let imu = "Count: 1152 | Size Contribution: 364.5 KiB | Serialization Format: cdr\n";
    assert!(verbose.contains(imu), "{verbose}");
}

#[test]
fn one_file_is_enough_and_says_the_same() {
    for (file, messages) in [
        ("bag_zstd_fast/bag_zstd_fast_0.mcap", 1211),
        ("bag_filezstd/bag_filezstd_0.mcap.zstd", 1230),
    ] {
        let path = real().join(file);
        let printed = rp(&["bag", "info", path.to_str().unwrap()]);
        let printed = String::from_utf8(printed.stdout).unwrap();
        assert!(printed.starts_with(&format!("\nFiles:             {}\n", path.display())));
        assert!(
            printed.contains("\nROS Distro:        humble\n"),
            "{printed}"
        );
        assert!(
            printed.contains(&format!("\nMessages:          {messages}\n")),
            "{printed}"
        );
    }
}

#[test]
fn what_is_no_bag_is_refused_as_the_original_does() {
    let directory = tempfile::tempdir().unwrap();
    let nothing = directory.path().join("nothing");
    let refused = |path: &Path, code: i32, text: &str| {
        let output = rp(&["bag", "info", path.to_str().unwrap()]);
        let stderr = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(code), "{stderr}");
        assert!(
            stderr.contains(&text.replace("{}", path.to_str().unwrap())),
            "{stderr}"
        );
    };
    refused(
        &nothing,
        2,
        "argument bag_path: Bag path '{}' does not exist!",
    );
    refused(
        directory.path(),
        1,
        "Could not find metadata in bag directory {}",
    );
    let text = directory.path().join("a.mcap");
    fs::write(&text, "not a bag").unwrap();
    refused(&text, 1, "No plugin detected that could open file {}");
    let sqlite3 = directory.path().join("a.db3");
    fs::write(&sqlite3, b"SQLite format 3\0 and so on").unwrap();
    refused(
        &sqlite3,
        1,
        "{} is in the sqlite3 storage, which rp does not read",
    );
    fs::write(
        directory.path().join("metadata.yaml"),
        "rosbag2_bagfile_information:\n",
    )
    .unwrap();
    refused(directory.path(), 1, "Exception on parsing info file: ");
}

#[test]
fn metadata_of_real_bags_comes_back_byte_for_byte() {
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

/// Records in order, as text; what must differ is left out.
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
            // One for each channel, in any order.
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
            // Offsets follow from how small the chunk became.
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
fn records_are_those_that_humble_writes() {
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
    // Humble writes no sequence numbers and no times of sending.
    let write = &mut |message: &records::Message<'_>, _: &Contents| {
        let time = Timestamp(message.log_time);
        let topic = topics[&message.channel_id];
        writer.write(topic, time, time, 0, message.data).unwrap();
    };
    read::scan(&original, write).unwrap();
    let summary = writer.close(BTreeMap::new()).unwrap();
    let ours = listing(&fs::read(&summary.files[0]).unwrap());
    let theirs = listing(&fs::read(&original).unwrap());
    assert_eq!(ours.len(), theirs.len());
    for (ours, theirs) in ours.iter().zip(&theirs) {
        assert_eq!(ours, theirs);
    }
    // And metadata.yaml, but for the order of topics.
    let theirs = fs::read_to_string(real().join("bag_zstd_fast/metadata.yaml")).unwrap();
    let mut theirs = Metadata::read(&theirs).unwrap();
    let ours = fs::read_to_string(path.join("metadata.yaml")).unwrap();
    let mut ours = Metadata::read(&ours).unwrap();
    ours.topics.sort_by(|a, b| a.name.cmp(&b.name));
    theirs.topics.sort_by(|a, b| a.name.cmp(&b.name));
    assert_eq!(ours, theirs);
}
