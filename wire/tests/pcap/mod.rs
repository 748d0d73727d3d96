//! Reads captures for the tests that compare decoders: little-endian pcap files.

use std::collections::{BTreeMap, HashMap};
use std::fs;
use std::io::Read;
use std::path::Path;

use ros2probe_wire::frame::{self, Link};

/// Returns the bytes of a capture or of its facts, decompressed.
pub fn read(path: &Path) -> Vec<u8> {
    let bytes = fs::read(path).unwrap();
    if path.extension().is_some_and(|extension| extension == "gz") {
        let mut plain = Vec::new();
        flate2::read::MultiGzDecoder::new(&*bytes)
            .read_to_end(&mut plain)
            .unwrap();
        return plain;
    }
    bytes
}

fn word(bytes: &[u8]) -> u32 {
    u32::from_le_bytes(bytes[..4].try_into().unwrap())
}

/// Parts of one fragmented datagram.
#[derive(Default)]
struct Parts {
    bytes: BTreeMap<u32, Vec<u8>>,
    end: Option<u32>,
}

/// Visits every whole datagram of a little-endian pcap capture; returns whether every frame was
/// captured as a whole.
pub fn datagrams(capture: &[u8], mut each: impl FnMut(&[u8])) -> bool {
    let link = Link(u16::try_from(word(&capture[20..]) & 0xffff).unwrap());
    let mut parts: HashMap<([u8; 16], [u8; 16], u32), Parts> = HashMap::new();
    let mut rest = &capture[24..];
    let mut is_whole = true;
    while rest.len() >= 16 {
        let captured = usize::try_from(word(&rest[8..])).unwrap();
        let length = word(&rest[12..]);
        let bytes = &rest[16..16 + captured];
        rest = &rest[16 + captured..];
        is_whole &= u32::try_from(captured).unwrap() == length;
        let Some(packet) = frame::parse(link, bytes, length).unwrap().packet else {
            continue;
        };
        match packet.payload {
            frame::Payload::Datagram(datagram) => {
                if u32::try_from(datagram.payload.len()) == Ok(datagram.length) {
                    each(datagram.payload);
                }
            }
            frame::Payload::Fragment(fragment) => {
                let key = (packet.source, packet.destination, fragment.id);
                let entry = parts.entry(key).or_default();
                entry.bytes.insert(fragment.offset, fragment.bytes.to_vec());
                if !fragment.more {
                    entry.end = Some(fragment.end());
                }
                let have: usize = entry.bytes.values().map(Vec::len).sum();
                if entry.end.is_some_and(|end| u32::try_from(have) == Ok(end)) {
                    let whole: Vec<u8> = parts
                        .remove(&key)
                        .unwrap()
                        .bytes
                        .into_values()
                        .flatten()
                        .collect();
                    each(&whole[8..]);
                }
            }
            frame::Payload::Segment(_) | frame::Payload::Other(_) => {}
        }
    }
    is_whole
}
