//! Decodes captured frames into datagrams, and passes them to the model in the time of the frames.
//!
//! The live source reads its frames from the ring itself. The decoder never waits; a replay at a
//! given speed waits between packets.

use ros2probe_model::observe::input::Input;
use ros2probe_wire::Timestamp;
use ros2probe_wire::frame::{self, PacketType, Payload};
use ros2probe_wire::walk::Envelope;

use super::pcap::{Captured, PcapError, PcapReader};
use crate::reassembly::{FlowKey, Limits, Reassembly};
use crate::streams::{Chunk, Streams, flow, flow_of};
use ros2probe_model::graph::zenoh::StreamId;
use ros2probe_model::observe::observer::Observer;

/// State of one replayed capture.
#[derive(Debug)]
pub struct FrameDecoder {
    reassembly: Reassembly,
    streams: Streams,
    last: Timestamp,
}

impl FrameDecoder {
    /// Creates a decoder at the start of a capture.
    #[must_use]
    pub fn new(limits: Limits) -> Self {
        Self {
            reassembly: Reassembly::new(limits),
            streams: Streams::default(),
            last: Timestamp(0),
        }
    }

    /// Replays the rest of a capture without pauses, and ends the model's input.
    ///
    /// # Errors
    /// Fails if the capture cannot be read further; the packets before the error count.
    pub fn run(
        &mut self,
        reader: &mut PcapReader,
        observer: &mut Observer,
    ) -> Result<(), PcapError> {
        while let Some(captured) = reader.next_packet()? {
            self.packet(&captured, observer);
        }
        observer.input(Input::End);
        Ok(())
    }

    /// Replays one frame.
    pub fn packet(&mut self, captured: &Captured<'_>, observer: &mut Observer) {
        // Several interfaces of one capture may be slightly out of order.
        self.last = self.last.max(captured.time);
        observer.input(Input::Time(self.last));
        self.streams
            .advance(self.last, |streamed| streamed.pass_to(observer));
        let parsed = match frame::parse(captured.link, captured.bytes, captured.length) {
            Ok(parsed) => parsed,
            Err(error) => {
                observer.input(Input::DecodeError {
                    stage: "frame",
                    reason: error.reason,
                });
                return;
            }
        };
        let Some(packet) = parsed.packet else { return };
        let interface = parsed.interface.unwrap_or(captured.interface);
        let outgoing = parsed.packet_type == PacketType::OUTGOING;
        let envelope = Envelope {
            time: captured.time.0,
            destination: packet.destination,
            interface,
            outgoing,
            ..Envelope::default()
        };
        match packet.payload {
            Payload::Datagram(datagram) => {
                let stream = StreamId {
                    flow: flow_of(&packet, datagram.source_port, datagram.destination_port),
                    ..StreamId::default()
                };
                let (bytes, length) = (datagram.payload, datagram.length);
                let is_quic =
                    self.streams
                        .datagram((captured.time, stream), bytes, length, |streamed| {
                            streamed.pass_to(observer);
                        });
                if is_quic {
                    return;
                }
                let envelope = Envelope {
                    source_port: datagram.source_port,
                    destination_port: datagram.destination_port,
                    ..envelope
                };
                pass_datagram(observer, &envelope, datagram.payload, datagram.length);
            }
            Payload::Fragment(fragment) => {
                let key = FlowKey::new(0, interface, outgoing, &packet, &fragment);
                let whole = self.reassembly.fragment(captured.time, key, &fragment);
                if let Some(whole) = whole {
                    let envelope = Envelope {
                        source_port: whole.source_port,
                        destination_port: whole.destination_port,
                        fragmented: true,
                        ..envelope
                    };
                    pass_datagram(observer, &envelope, whole.payload(), whole.length);
                }
            }
            Payload::Segment(segment) => {
                let stream = StreamId {
                    flow: flow(&packet, &segment),
                    ..StreamId::default()
                };
                let chunk = Chunk::of_segment(&segment, captured.time, stream);
                self.streams
                    .chunk(&chunk, |streamed| streamed.pass_to(observer));
            }
            Payload::Other(_) => {}
        }
    }

    /// Returns the connections of Zenoh, for their counters.
    #[must_use]
    pub const fn streams(&self) -> &Streams {
        &self.streams
    }

    /// Returns the reassembly, for its counters.
    #[must_use]
    pub const fn reassembly(&self) -> &Reassembly {
        &self.reassembly
    }

    /// Returns the time of the latest frame.
    #[must_use]
    pub const fn last(&self) -> Timestamp {
        self.last
    }
}

fn pass_datagram(observer: &mut Observer, envelope: &Envelope, payload: &[u8], length: u32) {
    if payload.len() < usize::try_from(length).unwrap_or(usize::MAX) {
        observer.input(Input::CutDatagram {
            envelope,
            payload,
            length,
        });
    } else {
        observer.input(Input::Datagram {
            envelope,
            payload,
            handover: None,
        });
    }
}
