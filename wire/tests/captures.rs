//! Compares the parsers with an independent decoder on real captures.
//!
//! Runs on the captures in `tests/data`, and on those in `../shared/fixtures` beside the workspace
//! if that exists.

#![expect(
    clippy::unwrap_used,
    clippy::indexing_slicing,
    reason = "a failed expectation may panic here"
)]

#[expect(dead_code, reason = "only the datagram's entry is needed here")]
#[path = "../fuzz/src/lib.rs"]
mod entry;
mod pcap;

use std::collections::{BTreeMap, HashMap, HashSet};
use std::fs;
use std::path::{Path, PathBuf};

use ros2probe_wire::discovery::{
    self, Discovery, EndpointAnnouncement, ParticipantAnnouncement, Role,
};
use ros2probe_wire::entities::ParticipantEntities;
use ros2probe_wire::names::Demangled;
use ros2probe_wire::rtps::{InlineQos, Locator, LocatorKind, Payload};
use ros2probe_wire::{EntityId, Guid, RtpsDuration};
use serde_json::{Value, json};

use entry::oracle::{Body, Message};
use pcap::{datagrams, read};

/// Results of this crate for one capture.
#[derive(Default)]
struct Found {
    submessages: BTreeMap<String, u64>,
    participants: HashMap<Guid, ParticipantAnnouncement>,
    endpoints: HashMap<Guid, EndpointAnnouncement>,
    gone: Vec<(String, u32)>,
    entities: Vec<((String, u64), ParticipantEntities)>,
    writers: HashMap<Guid, Writer>,
    discovery_info_writers: HashSet<Guid>,
}

#[derive(Default)]
struct Writer {
    submessages: u64,
    sequence_numbers: HashSet<u64>,
    payload_sizes: BTreeMap<String, u64>,
    sample_size: Option<u32>,
}

impl Found {
    fn datagram(&mut self, bytes: &[u8]) {
        let Ok(message) = Message::parse(bytes) else {
            return;
        };
        for submessage in message {
            let submessage = submessage.unwrap();
            let id = format!("0x{:02x}", submessage.id.0);
            *self.submessages.entry(id).or_default() += 1;
            match submessage.body {
                Body::Data(data) => {
                    let vendor = submessage.receiver.vendor;
                    let inline_qos = data
                        .inline_qos
                        .map(|list| InlineQos::parse(list, vendor).unwrap())
                        .unwrap_or_default();
                    let writer = self.writers.entry(data.writer).or_default();
                    writer.submessages += 1;
                    writer.sequence_numbers.insert(data.sequence_number.0);
                    if let Payload::Data(payload) = data.payload {
                        *writer
                            .payload_sizes
                            .entry(payload.len().to_string())
                            .or_default() += 1;
                    }
                    match data.writer.entity {
                        EntityId::SPDP_WRITER => {
                            match discovery::participant(vendor, data.payload, &inline_qos).unwrap()
                            {
                                Discovery::Alive(alive) => {
                                    self.participants.entry(alive.guid).or_insert(alive);
                                }
                                Discovery::Gone { guid, status } => {
                                    self.gone.push((guid.to_string(), status.0));
                                }
                            }
                        }
                        EntityId::SEDP_PUBLICATIONS_WRITER => {
                            self.endpoint(Role::Writer, vendor, data.payload, &inline_qos);
                        }
                        EntityId::SEDP_SUBSCRIPTIONS_WRITER => {
                            self.endpoint(Role::Reader, vendor, data.payload, &inline_qos);
                        }
                        _ if self.discovery_info_writers.contains(&data.writer) => {
                            let entities = ParticipantEntities::parse(data.payload.bytes());
                            let key = (data.writer.to_string(), data.sequence_number.0);
                            // The facts list each sample once.
                            if !self.entities.iter().any(|(known, _)| *known == key) {
                                self.entities.push((key, entities.unwrap()));
                            }
                        }
                        _ => {}
                    }
                }
                Body::DataFrag(fragments) => {
                    let writer = self.writers.entry(fragments.writer).or_default();
                    writer.submessages += 1;
                    writer.sequence_numbers.insert(fragments.sequence_number.0);
                    writer.sample_size = Some(fragments.sample_size);
                }
                _ => {}
            }
        }
    }

    fn endpoint(
        &mut self,
        role: Role,
        vendor: ros2probe_wire::rtps::VendorId,
        payload: Payload<'_>,
        inline_qos: &InlineQos,
    ) {
        match discovery::endpoint(role, vendor, payload, inline_qos).unwrap() {
            Discovery::Alive(endpoint) => {
                if endpoint.topic.demangle() == Demangled::RosDiscovery && role == Role::Writer {
                    self.discovery_info_writers.insert(endpoint.guid);
                }
                self.endpoints.entry(endpoint.guid).or_insert(endpoint);
            }
            Discovery::Gone { guid, status } => self.gone.push((guid.to_string(), status.0)),
        }
    }
}

/// Adds the captures with facts under a directory to `found`.
fn captures(directory: &Path, found: &mut Vec<(PathBuf, PathBuf)>) {
    for entry in fs::read_dir(directory).unwrap() {
        let path = entry.unwrap().path();
        // Zenoh traffic is not RTPS, and RTPS over TCP is not read.
        if path.ends_with("zenoh") || path.ends_with("fastrtps-tcp") {
            continue;
        }
        if path.is_dir() {
            captures(&path, found);
            continue;
        }
        let name = path.file_name().unwrap().to_str().unwrap();
        let stem = name.trim_end_matches(".gz");
        let Some(capture) = stem.strip_suffix(".facts.json") else {
            continue;
        };
        let capture = format!("{}.pcap.gz", capture.trim_end_matches(".pcap"));
        found.push((path.with_file_name(capture), path));
    }
}

fn seconds(duration: RtpsDuration) -> Value {
    duration
        .seconds()
        .map_or_else(|| json!("inf"), |seconds| json!(seconds))
}

fn locators(locators: &[Locator]) -> Value {
    let text = |locator: &Locator| match (locator.kind, locator.udp()) {
        (LocatorKind::UDP_V4, Some(address)) => format!("udp4:{address}"),
        _ => {
            let hex: String = locator
                .address
                .iter()
                .map(|byte| format!("{byte:02x}"))
                .collect();
            format!("shm({}):{hex}:{}", locator.kind.0, locator.port)
        }
    };
    locators.iter().map(text).collect()
}

/// Compares `ours` with the fact under `key`. A value without a fact was not on the wire.
fn check(context: &str, facts: &Value, key: &str, ours: &Value) {
    if let Some(theirs) = facts.get(key) {
        assert_eq!(theirs, ours, "{context}: {key}");
    }
}

fn check_participants(facts: &Value, found: &Found) {
    let theirs = facts["participants"].as_object().unwrap();
    assert_eq!(theirs.len(), found.participants.len(), "participants");
    for participant in found.participants.values() {
        let context = participant.guid.to_string();
        let theirs = &theirs[&context];
        let [high, low] = participant.vendor.0;
        check(&context, theirs, "vendor", &json!(format!("{high}.{low}")));
        check(
            &context,
            theirs,
            "protover",
            &json!(participant.protocol_version.to_string()),
        );
        check(&context, theirs, "lease", &seconds(participant.lease));
        check(
            &context,
            theirs,
            "entity_name",
            &json!(participant.entity_name),
        );
        let builtin = format!("0x{:08x}", participant.builtin_endpoints.0);
        check(&context, theirs, "builtin_endpoints", &json!(builtin));
        check(
            &context,
            theirs,
            "metatraffic_unicast",
            &locators(&participant.metatraffic_unicast),
        );
        let multicast = locators(&participant.metatraffic_multicast);
        check(&context, theirs, "metatraffic_multicast", &multicast);
        check(
            &context,
            theirs,
            "default_unicast",
            &locators(&participant.default_unicast),
        );
        check(
            &context,
            theirs,
            "default_multicast",
            &locators(&participant.default_multicast),
        );
        let properties: Value = participant
            .properties
            .iter()
            .map(|property| (property.name.to_string(), json!(property.value)))
            .collect::<serde_json::Map<_, _>>()
            .into();
        check(&context, theirs, "property_list", &properties);
        let user_data = theirs["user_data"].as_str().unwrap().trim_end_matches('\0');
        assert_eq!(
            user_data,
            format!("enclave={};", participant.enclave.as_ref().unwrap())
        );
        let domain = theirs["other"]["0x000f"].as_str();
        let ours = participant
            .domain_id
            .map(|id| id.0.to_le_bytes().map(|b| format!("{b:02x}")));
        assert_eq!(
            domain.map(Into::into),
            ours.map(|bytes| bytes.concat()),
            "{context}: domain"
        );
        if let Some(pid) = theirs["property_list"]["__Pid"].as_str() {
            assert_eq!(participant.process_id(), pid.parse().ok());
            assert_eq!(participant.host_name(), Some("vm"));
        }
        assert!(
            !participant.is_secured && !participant.is_truncated,
            "{context}"
        );
    }
}

fn check_endpoints(facts: &Value, found: &Found) {
    let theirs = facts["endpoints"].as_object().unwrap();
    assert_eq!(theirs.len(), found.endpoints.len(), "endpoints");
    for endpoint in found.endpoints.values() {
        let context = endpoint.guid.to_string();
        let theirs = &theirs[&context];
        let kind = if endpoint.role == Role::Writer {
            "writer"
        } else {
            "reader"
        };
        check(&context, theirs, "kind", &json!(kind));
        check(&context, theirs, "topic", &json!(endpoint.topic.as_str()));
        check(
            &context,
            theirs,
            "type",
            &json!(endpoint.type_name.as_str()),
        );
        check_qos(&context, theirs, endpoint);
        let hash = theirs["user_data"].as_str().and_then(|text| {
            Some(
                text.split_once("typehash=")?
                    .1
                    .split_once(';')?
                    .0
                    .to_owned(),
            )
        });
        assert_eq!(
            hash,
            endpoint.type_hash.map(|hash| hash.to_string()),
            "{context}"
        );
        assert!(
            !endpoint.is_truncated && endpoint.qos.partitions.is_empty(),
            "{context}"
        );
    }
}

fn check_qos(context: &str, theirs: &Value, endpoint: &EndpointAnnouncement) {
    check(
        context,
        theirs,
        "reliability",
        &json!(endpoint.qos.reliability.to_string()),
    );
    check(
        context,
        theirs,
        "durability",
        &json!(endpoint.qos.durability.to_string()),
    );
    check(context, theirs, "lifespan", &seconds(endpoint.qos.lifespan));
    check(context, theirs, "deadline", &seconds(endpoint.qos.deadline));
    check(
        context,
        theirs,
        "unicast_locator",
        &locators(&endpoint.unicast),
    );
    let lease = seconds(endpoint.qos.liveliness_lease);
    check(
        context,
        theirs,
        "liveliness",
        &json!([endpoint.qos.liveliness.to_string(), lease]),
    );
    let history = endpoint.qos.history;
    let text = history.map(|history| format!("{}({})", history.kind, history.depth));
    check(context, theirs, "history", &json!(text));
    let is_fast = theirs["vendor"] == "1.15";
    assert_eq!(history.is_none(), is_fast, "{context}: history");
    if theirs.get("reliability").is_none() {
        let default = if endpoint.role == Role::Writer {
            "RELIABLE"
        } else {
            "BEST_EFFORT"
        };
        assert_eq!(endpoint.qos.reliability.to_string(), default);
    }
}

fn check_rest(facts: &Value, found: &Found) {
    let gone: Vec<(String, u32)> = facts["events"]
        .as_array()
        .unwrap()
        .iter()
        .map(|event| {
            let status = event["status"].as_u64().unwrap();
            (
                event["guid"].as_str().unwrap().to_owned(),
                u32::try_from(status).unwrap(),
            )
        })
        .collect();
    assert_eq!(gone, found.gone);

    let theirs = facts["ros_discovery_info"].as_array().unwrap();
    assert_eq!(theirs.len(), found.entities.len(), "ros_discovery_info");
    for (theirs, ((writer, sequence_number), entities)) in theirs.iter().zip(&found.entities) {
        let guids = |guids: &[Guid]| guids.iter().map(ToString::to_string).collect::<Vec<_>>();
        let nodes: Vec<Value> = entities
            .nodes
            .iter()
            .map(|node| {
                json!({
                    "ns": node.namespace,
                    "name": node.name,
                    "readers": guids(&node.readers),
                    "writers": guids(&node.writers),
                })
            })
            .collect();
        assert_eq!(theirs["writer"], json!(writer));
        assert_eq!(theirs["seq"], json!(sequence_number));
        assert_eq!(theirs["gid"], json!(entities.participant.to_string()));
        assert_eq!(theirs["nodes"], json!(nodes));
    }
}

fn check_writers(facts: &Value, found: &Found) {
    let theirs = facts["writers"].as_object().unwrap();
    assert_eq!(theirs.len(), found.writers.len(), "writers");
    for (guid, writer) in &found.writers {
        let context = guid.to_string();
        let theirs = &theirs[&context];
        check(&context, theirs, "submessages", &json!(writer.submessages));
        check(
            &context,
            theirs,
            "distinct_seqs",
            &json!(writer.sequence_numbers.len()),
        );
        let range = [
            writer.sequence_numbers.iter().min(),
            writer.sequence_numbers.iter().max(),
        ];
        check(&context, theirs, "seq_range", &json!(range));
        if let Some(size) = writer.sample_size {
            assert_eq!(
                theirs["sample_size"].to_string().trim_matches(['[', ']']),
                size.to_string()
            );
        } else {
            // The facts list the most frequent sizes only.
            for (size, count) in theirs["payload_sizes"].as_object().unwrap() {
                let ours = writer.payload_sizes.get(size);
                assert_eq!(*count, json!(ours), "{context}: {size}");
            }
        }
    }
}

#[test]
fn captures_yield_the_facts_of_the_independent_decoder() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut all = Vec::new();
    captures(&root.join("tests/data"), &mut all);
    assert_eq!(all.len(), 3);
    let shared = root.join("../../shared/fixtures");
    if shared.is_dir() {
        captures(&shared, &mut all);
    }
    for (capture, facts) in all {
        println!("{}", capture.display());
        let facts: Value = serde_json::from_slice(&read(&facts)).unwrap();
        let capture = read(&capture);
        // There are two passes, because a sample may precede its writer's announcement.
        let mut first = Found::default();
        datagrams(&capture, |bytes| {
            // Checks the invariants for any bytes, including the agreement with the kernel filter's
            // walk.
            entry::datagram(bytes);
            first.datagram(bytes);
        });
        let discovery_info_writers = first.discovery_info_writers;
        let mut found = Found {
            discovery_info_writers,
            ..Found::default()
        };
        let is_whole = datagrams(&capture, |bytes| found.datagram(bytes));
        check_participants(&facts, &found);
        check_endpoints(&facts, &found);
        check_rest(&facts, &found);
        if is_whole {
            assert_eq!(
                facts["submessages"],
                json!(found.submessages),
                "submessages"
            );
            check_writers(&facts, &found);
        }
    }
}
