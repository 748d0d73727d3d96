//! The peer on HDDS.

use std::collections::HashMap;
use std::process::ExitCode;
use std::sync::{Arc, Mutex};

use hdds::core::types::{FieldLayout, FieldType, PrimitiveKind, TypeDescriptor};
use hdds::dds::{
    DDS, DataReaderListener, DataWriterListener, PublicationMatchedStatus,
    RequestedIncompatibleQosStatus, SubscriptionMatchedStatus,
};
use hdds::{DataReader, DataWriter, FieldValue, Participant, QoS};
use shapes::{
    Capability, Event, Guid, Options, Peer, Result, Role, SHAPE_SIZE, TYPE, payload, policy_name,
};

struct ShapeType {
    color: String,
    x: i32,
    y: i32,
    shapesize: i32,
    additional_payload: Vec<u8>,
}

struct Hdds {
    participant: Arc<Participant>,
    topic: String,
    endpoint: Endpoint,
    events: Arc<Events>,
    shape: ShapeType,
}

enum Endpoint {
    Writer(DataWriter<ShapeType>),
    Reader(DataReader<ShapeType>),
}

impl Peer for Hdds {
    const STACK: &str = "hdds";

    /// Fragments have no encapsulation.
    const LARGEST_SIZE: usize = 8_000;

    /// A writer announces neither its lease nor its strength, and hears of no incompatible reader.
    /// A reader requests old samples only from writers of this library.
    fn supports(role: Role, capability: Capability) -> bool {
        match capability {
            Capability::LateJoiner => role == Role::Publisher,
            Capability::IncompatibleQos => role == Role::Subscriber,
            Capability::Arbitration
            | Capability::Lifespan
            | Capability::Liveliness
            | Capability::Fragments => false,
            _ => true,
        }
    }

    fn open(options: &Options) -> Result<Hdds> {
        let participant = Participant::builder("shapes")
            .domain_id(options.domain.into())
            .build()?;
        let events = Arc::new(Events::default());
        let qos = qos(options);
        let topic = participant.topic::<ShapeType>(&options.topic)?;
        let endpoint = match options.role {
            Role::Publisher => {
                let writer = topic.writer().qos(qos).with_listener(events.clone());
                Endpoint::Writer(writer.build()?)
            }
            Role::Subscriber => {
                let reader = match &options.filter {
                    None => topic.reader(),
                    Some(filter) => {
                        let name = &options.topic;
                        let filtered = participant.create_content_filtered_topic::<ShapeType>(
                            "Filtered",
                            name,
                            filter,
                            Vec::new(),
                        )?;
                        filtered.reader()
                    }
                };
                let reader = reader.qos(qos).with_listener(events.clone());
                Endpoint::Reader(reader.build()?)
            }
        };
        Ok(Hdds {
            participant,
            topic: options.topic.clone(),
            endpoint,
            events,
            shape: ShapeType {
                color: options.color.clone(),
                x: 0,
                y: 0,
                shapesize: SHAPE_SIZE,
                additional_payload: payload(options.size),
            },
        })
    }

    /// Local endpoints are among the discovered ones.
    fn guid(&self) -> Option<Guid> {
        let discovery = self.participant.discovery()?;
        let endpoints = match self.endpoint {
            Endpoint::Writer(_) => discovery.find_writers_for_topic(&self.topic),
            Endpoint::Reader(_) => discovery.find_readers_for_topic(&self.topic),
        };
        let prefix = self.participant.guid().prefix;
        let guids = endpoints.iter().map(|endpoint| endpoint.endpoint_guid);
        guids
            .filter(|guid| guid.prefix == prefix)
            .map(|guid| guid.as_bytes())
            .next()
    }

    fn write(&mut self, number: i32) -> Result<()> {
        self.shape.x = number;
        if let Endpoint::Writer(writer) = &self.endpoint {
            writer.write(&self.shape)?;
        }
        Ok(())
    }

    fn poll(&mut self) -> Result<Vec<Event>> {
        let mut events = std::mem::take(&mut *self.events.0.lock()?);
        if let Endpoint::Reader(reader) = &self.endpoint {
            while let Some(shape) = reader.take()? {
                events.push(Event::Sample {
                    number: shape.x,
                    color: shape.color,
                    length: shape.additional_payload.len(),
                });
            }
        }
        Ok(events)
    }

    /// Dropping the participant announces its end.
    fn close(self) -> Result<()> {
        Ok(())
    }
}

/// Events of the listeners since the last poll.
#[derive(Default)]
struct Events(Mutex<Vec<Event>>);

impl Events {
    fn push(&self, event: Event) {
        if let Ok(mut events) = self.0.lock() {
            events.push(event);
        }
    }
}

impl DataWriterListener<ShapeType> for Events {
    fn on_publication_matched(&self, status: PublicationMatchedStatus) {
        self.push(Event::Matched(status.current_count as i32));
    }
}

impl DataReaderListener<ShapeType> for Events {
    fn on_subscription_matched(&self, status: SubscriptionMatchedStatus) {
        self.push(Event::Matched(status.current_count as i32));
    }

    /// The numbers of the policies are not those of the standard.
    fn on_requested_incompatible_qos(&self, status: RequestedIncompatibleQosStatus) {
        self.push(Event::Incompatible(policy_name(
            match status.last_policy_id {
                2 => 3,
                5 => 6,
                7 => 2,
                11 => 11,
                13 => 4,
                21 => 8,
                23 => 23,
                _ => 0,
            },
        )));
    }
}

/// Plain CDR: the library sends these bytes with the encapsulation of XCDR1.
impl DDS for ShapeType {
    fn type_descriptor() -> &'static TypeDescriptor {
        &DESCRIPTOR
    }

    fn encode_cdr2(&self, buffer: &mut [u8]) -> hdds::Result<usize> {
        let mut bytes = Vec::with_capacity(self.additional_payload.len() + 64);
        put_string(&mut bytes, &self.color);
        for number in [self.x, self.y, self.shapesize] {
            bytes.extend(number.to_le_bytes());
        }
        bytes.extend((self.additional_payload.len() as u32).to_le_bytes());
        bytes.extend(&self.additional_payload);
        let place = buffer.get_mut(..bytes.len());
        place
            .ok_or(hdds::Error::BufferTooSmall)?
            .copy_from_slice(&bytes);
        Ok(bytes.len())
    }

    fn decode_cdr2(buffer: &[u8]) -> hdds::Result<ShapeType> {
        Cdr { buffer, place: 0 }
            .shape()
            .ok_or(hdds::Error::SerializationError)
    }

    fn get_fields(&self) -> HashMap<String, FieldValue> {
        HashMap::from([
            ("color".to_owned(), FieldValue::String(self.color.clone())),
            ("x".to_owned(), FieldValue::from_i32(self.x)),
            ("y".to_owned(), FieldValue::from_i32(self.y)),
            ("shapesize".to_owned(), FieldValue::from_i32(self.shapesize)),
        ])
    }

    /// The hash of the serialized key, big endian, since its size is unbounded.
    fn compute_key(&self) -> [u8; 16] {
        let mut key = (self.color.len() as u32 + 1).to_be_bytes().to_vec();
        key.extend(self.color.as_bytes());
        key.push(0);
        md5::compute(key).0
    }

    fn has_key() -> bool {
        true
    }
}

fn put_string(bytes: &mut Vec<u8>, text: &str) {
    bytes.extend((text.len() as u32 + 1).to_le_bytes());
    bytes.extend(text.as_bytes());
    bytes.push(0);
    bytes.resize(bytes.len().next_multiple_of(4), 0);
}

struct Cdr<'a> {
    buffer: &'a [u8],
    place: usize,
}

impl Cdr<'_> {
    fn shape(&mut self) -> Option<ShapeType> {
        let length = self.length()?;
        let color = self.bytes(length)?.strip_suffix(&[0])?;
        let color = String::from_utf8(color.to_vec()).ok()?;
        self.place = self.place.next_multiple_of(4);
        Some(ShapeType {
            color,
            x: self.number()?,
            y: self.number()?,
            shapesize: self.number()?,
            additional_payload: {
                let length = self.length()?;
                self.bytes(length)?.to_vec()
            },
        })
    }

    fn length(&mut self) -> Option<usize> {
        usize::try_from(self.number()?).ok()
    }

    fn number(&mut self) -> Option<i32> {
        Some(i32::from_le_bytes(self.bytes(4)?.try_into().ok()?))
    }

    fn bytes(&mut self, length: usize) -> Option<&[u8]> {
        let bytes = self
            .buffer
            .get(self.place..self.place.checked_add(length)?)?;
        self.place += length;
        Some(bytes)
    }
}

static DESCRIPTOR: TypeDescriptor = TypeDescriptor {
    type_id: 1,
    type_name: TYPE,
    size_bytes: 0,
    alignment: 4,
    is_variable_size: true,
    fields: &[
        field("color", FieldType::String, 0),
        field("x", FieldType::Primitive(PrimitiveKind::I32), 4),
        field("y", FieldType::Primitive(PrimitiveKind::I32), 4),
        field("shapesize", FieldType::Primitive(PrimitiveKind::I32), 4),
        field("additional_payload", FieldType::Sequence, 0),
    ],
};

const fn field(name: &'static str, field_type: FieldType, size_bytes: u32) -> FieldLayout {
    FieldLayout {
        name,
        offset_bytes: 0,
        field_type,
        alignment: 4,
        size_bytes,
        element_type: None,
    }
}

fn qos(options: &Options) -> QoS {
    let mut qos = if options.best_effort {
        QoS::best_effort()
    } else {
        QoS::reliable()
    };
    qos = if options.transient_local {
        qos.transient_local()
    } else {
        qos.volatile()
    };
    qos = match options.depth {
        Some(depth) => qos.keep_last(depth),
        None => qos.keep_all(),
    };
    if options.exclusive {
        qos = qos
            .ownership_exclusive()
            .ownership_strength(options.strength);
    }
    let milliseconds = |limit: std::time::Duration| limit.as_millis() as u64;
    if let Some(period) = options.deadline {
        qos = qos.deadline_millis(milliseconds(period));
    }
    if let Some(lifespan) = options.lifespan {
        qos = qos.lifespan_millis(milliseconds(lifespan));
    }
    if let Some(lease) = options.lease {
        qos = qos.liveliness_automatic_millis(milliseconds(lease));
    }
    for name in &options.partitions {
        qos = qos.add_partition(name);
    }
    qos.data_representation_xcdr1()
}

fn main() -> ExitCode {
    shapes::run::<Hdds>()
}
