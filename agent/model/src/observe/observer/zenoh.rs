//! Connections of Zenoh: announcements for discovery, and observations for everything else.

use foldhash::{HashMap, HashMapExt as _};
use ros2probe_wire::discovery::{EndpointAnnouncement, Role};
use ros2probe_wire::record::Verdict;
use ros2probe_wire::rtps::{StatusInfo, VendorId};
use ros2probe_wire::zenoh::{Gid, ZenohId};
use ros2probe_wire::{EntityId, Guid, GuidPrefix, RtpsTime, SequenceNumber};

use super::Observer;
use super::references::CountedAs;
use crate::derive::services::service::CallId;
use crate::facts::model_time::ModelTime;
use crate::facts::observation::{Content, DatagramFate, Head, Observation, Path, Sample};
use crate::facts::route::Direction;
use crate::graph::discovery::{Origin, Priority};
use crate::graph::zenoh::{
    GraphChange, Holder, ReportFact, StreamEvent, StreamId, StreamReport, ZenohSample, unknown_guid,
};
use crate::measure::topic::Accelerated;

/// Numbers of graph changes, and gids of writers, for Zenoh.
#[derive(Debug)]
pub(super) struct ZenohNames {
    /// Number of the last change of the graph.
    changes: SequenceNumber,
    /// Writers with a verdict, and their gids.
    keys: HashMap<Guid, Guid>,
}

impl Default for ZenohNames {
    fn default() -> Self {
        Self {
            changes: SequenceNumber(1),
            keys: HashMap::new(),
        }
    }
}

impl Observer {
    pub(super) fn zenoh_report(&mut self, report: &StreamReport<'_>) {
        // The state is taken out, because its callback borrows the observer.
        let mut zenoh = std::mem::take(&mut self.zenoh);
        let at = self.graph.wall_clock.model_time(report.time);
        let mut alive = None;
        let wants_bytes = self.measure.payloads.needs_any_payload()
            || self.measure.latched.is_used()
            || self.derive.robot.is_used();
        // A sample may precede its writer's announcement in a batch. It then has an unknown writer.
        zenoh.report(report, at, wants_bytes, &mut |shown| match shown {
            ReportFact::Sample(sample) => self.zenoh_sample(report.stream, at, sample),
            ReportFact::Owner(socket, prefix) => self.graph.receivers.add_owner(socket, prefix),
            ReportFact::Disowned(socket, prefix) => {
                self.graph.receivers.remove_owner(socket, prefix);
            }
            ReportFact::Alive(session) => alive = Some(session),
            ReportFact::Relayed(session) => {
                self.graph
                    .discovery
                    .seen(session.guid_prefix(), at, Priority::NO_EVIDENCE);
            }
            ReportFact::Missed(destination) => {
                self.measure.profiler.missed(destination, at);
            }
            ReportFact::Malformed(reason) => self.decode_error("zenoh", reason),
        });
        if let Some(session) = alive {
            let prefix = session.guid_prefix();
            match self.graph.discovery.knows(prefix) {
                true => {
                    self.graph.discovery.seen(prefix, at, Priority::NO_EVIDENCE);
                }
                false => zenoh.graph.announce_again(session, at),
            }
        }
        if matches!(report.event, StreamEvent::End) {
            self.measure.links.end(report.stream);
        }
        self.zenoh = zenoh;
        self.change_zenoh_graph(at);
    }

    /// Returns whether a connection of Zenoh has begun since [`Self::link_sessions`]. It may be
    /// short, so the process that holds its socket should be looked up soon.
    #[must_use]
    pub const fn awaits_holders(&self) -> bool {
        self.zenoh.has_begun
    }

    /// Determines which sessions of Zenoh send, from the processes that hold the sockets.
    pub(super) fn link_sessions(&mut self) {
        self.zenoh.has_begun = false;
        let receivers = &self.graph.receivers;
        let holder = |socket| {
            let process_id = receivers.sockets().get(socket)?.process_id?;
            Some(Holder {
                process_id,
                session: receivers.session_in(process_id),
            })
        };
        for change in self.zenoh.link(holder) {
            if let Some(before) = change.before {
                self.graph
                    .receivers
                    .remove_owner(change.socket, before.guid_prefix());
            }
            if let Some(after) = change.after {
                self.graph
                    .receivers
                    .add_owner(change.socket, after.guid_prefix());
            }
        }
    }

    /// Ends the sessions of Zenoh that a router no longer reaches, and those whose lease has ended.
    pub(super) fn end_unreachable_sessions(&mut self, now: ModelTime) {
        self.zenoh.end_unreachable(now);
        let discovery = &self.graph.discovery;
        let is_known = |session: ZenohId| discovery.knows(session.guid_prefix());
        self.zenoh.end_expired(is_known);
        self.change_zenoh_graph(now);
    }

    /// Replaces the GUIDs of Zenoh writers in changed verdicts by their gids, which messages
    /// contain. Verdicts on readers of Zenoh are removed.
    pub(super) fn zenoh_interest(&mut self, interest: &mut Vec<(Guid, Option<Verdict>)>) {
        let (keys, discovery) = (&mut self.zenoh_names.keys, &self.graph.discovery);
        interest.retain_mut(|(guid, verdict)| {
            if !guid.prefix.is_zenoh() {
                return true;
            }
            let endpoint = discovery.endpoints().get(guid);
            let key = match endpoint.filter(|_| verdict.is_some() && guid.entity.is_writer()) {
                Some(endpoint) => {
                    let key = Guid::from_bytes(endpoint.gid);
                    keys.insert(*guid, key);
                    Some(key)
                }
                None => keys.remove(guid),
            };
            if let Some(key) = key {
                *guid = key;
            }
            key.is_some()
        });
    }

    /// Applies changes of the graph.
    fn change_zenoh_graph(&mut self, at: ModelTime) {
        let changes = self.zenoh.graph.take();
        if changes.is_empty() {
            return;
        }
        for change in changes {
            // The number increases, so that a token that returns is not taken for a delayed copy.
            self.zenoh_names.changes = self.zenoh_names.changes.next();
            let origin = |prefix: GuidPrefix| Origin {
                at,
                sender: prefix,
                sequence_number: self.zenoh_names.changes,
                destination: [0; 16],
                port: 0,
            };
            match change {
                GraphChange::Participant(announcement) => {
                    let origin = origin(announcement.guid.prefix);
                    self.learn_participant(&announcement, &origin);
                    // The sockets of a session without tokens are not remembered.
                    for socket in self.zenoh.sockets(announcement.guid.prefix) {
                        self.graph
                            .receivers
                            .add_owner(socket, announcement.guid.prefix);
                    }
                }
                GraphChange::ParticipantGone(guid) => {
                    let origin = origin(guid.prefix);
                    self.graph
                        .discovery
                        .participant_gone(guid, &origin, &mut self.journal);
                }
                GraphChange::Endpoint(announcement) => {
                    let origin = origin(announcement.guid.prefix);
                    self.name_writer(&announcement);
                    self.learn_endpoint(*announcement, &origin);
                }
                GraphChange::EndpointGone(guid) => {
                    let origin = origin(guid.prefix);
                    self.graph
                        .discovery
                        .endpoint_gone(guid, &origin, &mut self.journal);
                }
                GraphChange::Nodes(entities) => {
                    let origin = origin(entities.participant.prefix);
                    self.learn_entities(&entities, entities.participant, &origin);
                }
            }
        }
        self.apply_discovery_changes(at);
    }

    /// Assigns the samples that a writer sent while its token was unknown to the announced writer.
    fn name_writer(&mut self, announcement: &EndpointAnnouncement) {
        if announcement.role == Role::Writer {
            let before = unknown_guid(Gid(announcement.gid));
            self.measure.profiler.rename(before, announcement.guid);
            self.measure
                .payloads
                .rename_unknown_writer(before, announcement.guid);
            self.requested.interest.remove(before);
        }
    }

    /// Counts a sample, request or reply.
    fn zenoh_sample(&mut self, stream: &StreamId, at: ModelTime, sample: &ZenohSample<'_>) {
        if !self.counts_as_message(at, sample) {
            return;
        }
        let observed = observed(stream, at, sample);
        let writer = sample.writer;
        if let Some((client, number)) = sample.call {
            let call = CallId {
                client: client.0,
                number,
            };
            let captured = sample.payload.captured;
            let services = &mut self.derive.services;
            let is_over = services.identified(writer, sample.number, call, captured, at);
            self.follow_call(writer, is_over);
        }
        let payload = sample.payload.whole();
        if let Some(payload) = payload.filter(|_| self.derive.services.describes_types(writer)) {
            let descriptions = &mut self.derive.type_descriptions;
            descriptions.add(writer, sample.number, None, payload);
        }
        if let Some(payload) = payload.filter(|_| sample.referring.is_none()) {
            self.keep_payload(&observed, payload);
            let call = |_| {
                let (client, number) = sample.call?;
                let client = client.0;
                Some(CallId { client, number })
            };
            self.read_robot_sample(&observed, payload, VendorId::default(), call);
        }
        self.observe(&Observation::Sample(observed));
        if stream.outgoing && stream.is_loopback() {
            // The receiver's socket is not read, because the sender's socket has shown the sample.
            let head = Head {
                direction: Direction::Received,
                socket: sample.receiving_socket,
                ..observed.head
            };
            self.observe(&Observation::Sample(Sample { head, ..observed }));
        }
    }

    /// Returns whether a sample counts as a message of its publisher. Of several samples for one
    /// message, each with a number of its own, one counts: the message itself, otherwise the
    /// references to buffers for the first subscription. Gaps between their numbers are no losses.
    fn counts_as_message(&mut self, at: ModelTime, sample: &ZenohSample<'_>) -> bool {
        let reference = self.references.get(sample.writer);
        let accelerated = reference.map_or(Accelerated::None, |known| known.accelerated);
        if accelerated != Accelerated::None || sample.referring.is_some() {
            self.measure.profiler.skip_numbers(sample.writer, at);
        }
        let Some(gid) = sample.referring else {
            return true;
        };
        accelerated == Accelerated::All
            && self.references.count(sample.writer, gid.0, at) != CountedAs::Copy
    }
}

/// Returns the observation of a sample that has arrived whole.
fn observed(stream: &StreamId, at: ModelTime, sample: &ZenohSample<'_>) -> Sample {
    let receiver = sample.receiver.unwrap_or(GuidPrefix::UNKNOWN);
    Sample {
        head: Head {
            at,
            elapsed: u32::try_from((at - sample.began).as_nanos()).unwrap_or(u32::MAX),
            writer: sample.writer,
            reader: Guid::new(receiver, EntityId::UNKNOWN),
            path: Path::Stream {
                relayed: sample.is_relayed,
                at_socket: stream.socket != 0,
            },
            direction: match stream.outgoing {
                true => Direction::Sent,
                false => Direction::Received,
            },
            socket: stream.socket,
            destination: stream.flow.destination,
            tcp_source_port: 0,
            interface: stream.interface,
            datagram_len: 0,
        },
        sequence_number: sample.number,
        source_timestamp: sample
            .source_timestamp
            .map_or(RtpsTime::default(), RtpsTime::of),
        status_info: StatusInfo::ALIVE,
        has_value: true,
        has_known_begin: true,
        header_stamp: header_stamp(sample.payload.captured),
        fate: DatagramFate::Passed,
        content: Content::Data {
            size: u32::try_from(sample.payload.length).unwrap_or(u32::MAX),
        },
    }
}

/// Returns the stamp of a header at the beginning of a payload, as seconds and nanoseconds.
fn header_stamp(payload: &[u8]) -> Option<(i32, u32)> {
    let ([_, order, _, _], rest) = payload.split_first_chunk()?;
    let (seconds, rest) = rest.split_first_chunk()?;
    let nanoseconds = rest.first_chunk()?;
    // The lowest bit of the identifier is the byte order (RTPS 2.5, 10.5).
    let word = |bytes: &[u8; 4]| match order & 1 {
        0 => u32::from_be_bytes(*bytes),
        _ => u32::from_le_bytes(*bytes),
    };
    let nanoseconds = word(nanoseconds);
    (nanoseconds < 1_000_000_000).then(|| (word(seconds).cast_signed(), nanoseconds))
}
