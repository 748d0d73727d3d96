//! Bags on disk: their content, and how other readers read them.
#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::indexing_slicing,
    reason = "a test that meets the unexpected has failed"
)]

mod cut;
mod full;
mod humble;
mod python;
mod written;

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::time::Duration;

use ros2probe_bag::metadata::Metadata;
use ros2probe_bag::read;
use ros2probe_bag::{
    Compression, Error, Form, Options, Schema, Storage, Summary, TopicDescription, Writer,
};
use ros2probe_wire::Timestamp;
use ros2probe_wire::qos::{Durability, History, HistoryKind, Qos, Reliability, Role};
use ros2probe_wire::rtps::VendorId;
use ros2probe_wire::time::SECOND;
use serde_json::{Value, json};

const BEGIN: u64 = 1_795_142_331_000_000_000;

fn topic(name: &str, type_name: &str) -> TopicDescription {
    let history = History {
        kind: HistoryKind::KEEP_LAST,
        depth: 10,
    };
    TopicDescription {
        name: name.into(),
        type_name: type_name.into(),
        type_hash: Some("RIHS01_00".into()),
        publishers: vec![Qos {
            reliability: Reliability::RELIABLE,
            durability: Durability::VOLATILE,
            history: Some(history),
            ..Qos::defaults(Role::Writer, VendorId::CYCLONE)
        }],
        schema: Some(Schema {
            encoding: "ros2msg".into(),
            text: "string data\n".into(),
        }),
    }
}

/// Writes `count` messages of two topics, ten per second; every third message is on the larger
/// topic.
fn bag(directory: &Path, options: Options, count: u64) -> Summary {
    let mut writer = Writer::create(directory, options).unwrap();
    let chatter = writer
        .topic(topic("/chatter", "std_msgs/msg/String"))
        .unwrap();
    let points = writer
        .topic(topic("/points", "sensor_msgs/msg/PointCloud2"))
        .unwrap();
    writer.topic(topic("/silent", "std_msgs/msg/Bool")).unwrap();
    for index in 0..count {
        let time = Timestamp(BEGIN + index * SECOND / 10);
        let sent = Timestamp(time.0 - 1000);
        let (topic, data) = if index.is_multiple_of(3) {
            (points, cloud(index))
        } else {
            (chatter, text(index))
        };
        writer.write(topic, time, sent, index + 1, &data).unwrap();
    }
    writer.close(BTreeMap::new()).unwrap()
}

fn cloud(index: u64) -> Vec<u8> {
    let mut data = vec![0, 1, 0, 0];
    data.extend((0..100_000_u32).map(|at| ((at / 7) ^ index as u32) as u8));
    data
}

fn text(index: u64) -> Vec<u8> {
    [
        &[0, 1, 0, 0, 9, 0, 0, 0],
        format!("hello {index:02}").as_bytes(),
    ]
    .concat()
}

fn metadata(directory: &Path) -> Metadata {
    let text = fs::read_to_string(directory.join("metadata.yaml")).unwrap();
    Metadata::read(&text).unwrap()
}

/// Returns topic, sequence number, log time, publish time and bytes of each message, as the `mcap`
/// crate reads them.
fn messages(path: &Path) -> Vec<(String, u32, u64, u64, Vec<u8>)> {
    let bytes = fs::read(path).unwrap();
    let messages = mcap::MessageStream::new(&bytes).unwrap();
    let messages = messages.map(|message| {
        let message = message.unwrap();
        (
            message.channel.topic.clone(),
            message.sequence,
            message.log_time,
            message.publish_time,
            message.data.to_vec(),
        )
    });
    messages.collect()
}
