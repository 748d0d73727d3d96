//! Bodies of requests: Prometheus remote write 1.0 (`prometheus.WriteRequest`) and 2.0
//! (`io.prometheus.write.v2.Request`), compressed with Snappy's block format.

use std::collections::HashMap;
use std::sync::Arc;

use prost::encoding::{WireType, encode_key, encode_varint};

use super::samples::{Scrape, parts};

/// Version of the protocol.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Version {
    /// Remote write 1.0: each series carries its name and labels as text.
    One,
    /// Remote write 2.0: series refer to texts by number, and metrics have types.
    Two,
}

/// Labels that all series have, by name.
pub(super) type Labels = Vec<(String, String)>;

/// Samples of one series, the oldest first: milliseconds since 1970, and values.
type Points = Vec<(i64, f64)>;

impl Version {
    /// Returns the value of `Content-Type`.
    pub(super) const fn content_type(self) -> &'static str {
        match self {
            Self::One => "application/x-protobuf",
            Self::Two => "application/x-protobuf;proto=io.prometheus.write.v2.Request",
        }
    }

    /// Returns the value of `X-Prometheus-Remote-Write-Version`.
    pub(super) const fn header(self) -> &'static str {
        match self {
            Self::One => "0.1.0",
            Self::Two => "2.0.0",
        }
    }
}

/// Returns the compressed body of a request with these samples.
pub(super) fn body(scrapes: &[Arc<Scrape>], labels: &Labels, version: Version) -> Vec<u8> {
    let mut series: Vec<(&[u8], Points)> = Vec::new();
    let mut places = HashMap::new();
    for scrape in scrapes {
        for (key, value) in &scrape.samples {
            let place = *places.entry(&**key).or_insert(series.len());
            match series.get_mut(place) {
                Some((_, points)) => points.push((scrape.at, *value)),
                None => series.push((key, vec![(scrape.at, *value)])),
            }
        }
    }
    let message = match version {
        Version::One => version_one(&series, labels),
        Version::Two => version_two(&series, labels),
    };
    let mut encoder = snap::raw::Encoder::new();
    // The limits of a batch are far below the 4 GiB of a block.
    encoder.compress_vec(&message).unwrap_or_default()
}

fn version_one(series: &[(&[u8], Points)], common: &Labels) -> Vec<u8> {
    let (mut message, mut one, mut part) = (Vec::new(), Vec::new(), Vec::new());
    for (key, points) in series {
        one.clear();
        for (name, value) in labels(key, common) {
            part.clear();
            bytes(1, name.as_bytes(), &mut part);
            bytes(2, value.as_bytes(), &mut part);
            bytes(1, &part, &mut one);
        }
        samples(points, &mut one);
        bytes(1, &one, &mut message);
    }
    message
}

fn version_two(series: &[(&[u8], Points)], common: &Labels) -> Vec<u8> {
    // The first symbol is the empty text.
    let mut symbols = vec![""];
    let mut numbers = HashMap::from([("", 0)]);
    let (mut all, mut one, mut part) = (Vec::new(), Vec::new(), Vec::new());
    for (key, points) in series {
        one.clear();
        part.clear();
        for text in labels(key, common).into_iter().flat_map(<[&str; 2]>::from) {
            let number = *numbers.entry(text).or_insert(symbols.len());
            if number == symbols.len() {
                symbols.push(text);
            }
            encode_varint(number as u64, &mut part);
        }
        bytes(1, &part, &mut one);
        samples(points, &mut one);
        // Metadata has the type alone.
        part.clear();
        encode_key(1, WireType::Varint, &mut part);
        encode_varint(parts(key).0.into(), &mut part);
        bytes(5, &part, &mut one);
        bytes(5, &one, &mut all);
    }
    let mut message = Vec::with_capacity(all.len() * 2);
    for symbol in symbols {
        bytes(4, symbol.as_bytes(), &mut message);
    }
    message.extend_from_slice(&all);
    message
}

/// Returns names and values of all labels of a series, in the order of names.
fn labels<'a>(key: &'a [u8], common: &'a Labels) -> Vec<(&'a str, &'a str)> {
    let (_, mut texts) = parts(key);
    let mut labels = vec![("__name__", texts.next().unwrap_or_default())];
    while let Some(name) = texts.next() {
        labels.push((name, texts.next().unwrap_or_default()));
    }
    let own = labels.len();
    for (name, value) in common {
        let (own, _) = labels.split_at(own);
        if own.iter().all(|(taken, _)| taken != name) {
            labels.push((name, value));
        }
    }
    // A label without a value is the same as none.
    labels.retain(|(_, value)| !value.is_empty());
    labels.sort_unstable();
    labels
}

/// Writes the samples of a series, which have the same form in both versions.
fn samples(points: &Points, series: &mut Vec<u8>) {
    let mut sample = Vec::with_capacity(20);
    for (at, value) in points {
        sample.clear();
        encode_key(1, WireType::SixtyFourBit, &mut sample);
        sample.extend_from_slice(&value.to_le_bytes());
        encode_key(2, WireType::Varint, &mut sample);
        encode_varint(at.cast_unsigned(), &mut sample);
        bytes(2, &sample, series);
    }
}

/// Writes a field of texts, bytes or messages.
fn bytes(tag: u32, content: &[u8], message: &mut Vec<u8>) {
    encode_key(tag, WireType::LengthDelimited, message);
    encode_varint(content.len() as u64, message);
    message.extend_from_slice(content);
}
