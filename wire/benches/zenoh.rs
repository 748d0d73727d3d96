//! Measures the Zenoh decoder on a batch of small publications, as a busy publisher sends it. Other
//! inputs are a batch of declarations, as a new peer receives it, and single tokens and keys.

#![expect(clippy::unwrap_used, reason = "a benchmark may panic on its own input")]

use std::hint::black_box;

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use ros2probe_wire::zenoh::{
    Attachment, Batch, Declaration, Gid, Key, Message, NetworkMessage, Sample, Token,
};

/// A captured PUSH of a node with a payload of 20 bytes, an alias, a timestamp and an attachment.
const PUSH: [u8; 85] = *b"\x1d\x03\xa1\xb0\x94\xc0\xaf\xbb\x8e\xc0\x80\x6b\x10\xe8\x73\x83\xf7\
    \x0e\xa9\xbd\xcb\x55\x2c\xc6\x2c\x63\xa1\x0c\xd1\x43\x21\x04\0\0\0\0\0\0\0\0\x36\xe4\xba\x23\
    \xee\xe9\x18\x10\0\x01\x02\x03\x04\x05\x06\x07\x08\x09\x0a\x0b\x0c\x0d\x0e\x0f\x14\0\x01\0\0\
    \x0c\0\0\0hello world\0";
const TOKEN: &str = "@ros2_lv/0/d10ca1632cc62c55cbbda90ef78373e8/0/10/MP/%/%/talker/%chatter/\
    std_msgs::msg::dds_::String_/\
    RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18/::,7:,:,:,,";
const KEY: &str = "0/chatter/std_msgs::msg::dds_::String_/\
    RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18";
const COUNT: u8 = 50;

/// A FRAME of publications, each with another sequence number.
fn publications() -> Vec<u8> {
    let mut batch = vec![0x25, 1];
    for number in 0..COUNT {
        let mut push = PUSH;
        *push.get_mut(31).unwrap() = number;
        batch.extend(push);
    }
    batch
}

/// A FRAME on the control lane that declares an alias and a token for each of several endpoints.
fn declarations() -> Vec<u8> {
    let mut batch = vec![0xa5, 1, 0x31, 0];
    for id in 1..=COUNT {
        let length = u8::try_from(TOKEN.len() & 0x7f | 0x80).unwrap();
        batch.extend([0x9e, 0x21, 0x08, 0x20, id, 0, length, 1]);
        batch.extend(TOKEN.as_bytes());
        batch.extend([0x9e, 0x21, 0x08, 0x46, id, id]);
    }
    batch
}

fn batches(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("zenoh batch");
    group.throughput(Throughput::Elements(u64::from(COUNT)));
    let batch = publications();
    group.bench_function("50 publications", |bencher| {
        bencher.iter(|| {
            let mut sum = 0;
            for message in Batch::whole(black_box(&batch)) {
                if let Message::Network(NetworkMessage::Push(push)) = message.unwrap()
                    && let Sample::Put(put) = push.sample
                {
                    let bytes = put.attachment.unwrap().whole().unwrap();
                    sum += Attachment::parse(bytes).unwrap().sequence_number.0;
                }
            }
            sum
        });
    });
    let batch = declarations();
    group.bench_function("50 aliases and tokens", |bencher| {
        bencher.iter(|| {
            let mut length = 0;
            for message in Batch::whole(black_box(&batch)) {
                if let Message::Network(NetworkMessage::Declare(declare)) = message.unwrap()
                    && let Declaration::KeyExpr { key, .. } = declare.declaration
                {
                    length += key.suffix.len();
                }
            }
            length
        });
    });
    group.finish();
}

fn names(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("zenoh name");
    group.bench_function("token", |bencher| {
        bencher.iter(|| Token::parse(black_box(TOKEN)));
    });
    group.bench_function("key", |bencher| {
        bencher.iter(|| Key::parse(black_box(KEY)));
    });
    group.bench_function("gid of a token", |bencher| {
        bencher.iter(|| Gid::of_token(black_box(TOKEN)));
    });
    group.finish();
}

criterion_group!(benches, batches, names);
criterion_main!(benches);
