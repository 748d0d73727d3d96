//! The peer on RustDDS.

use std::process::ExitCode;

use rustdds::dds::qos::QosPolicyId;
use rustdds::dds::statusevents::{DataReaderStatus, DataWriterStatus};
use rustdds::policy::{
    Deadline, Durability, History, Lifespan, Liveliness, Ownership, Reliability,
};
use rustdds::with_key::{DataReader, DataWriter, Sample};
use rustdds::{
    DomainParticipant, Duration, Keyed, QosPolicies, QosPolicyBuilder, RTPSEntity, StatusEvented,
    TopicKind,
};
use serde::{Deserialize, Serialize};
use shapes::{
    Capability, Event, Guid, Options, Peer, Result, Role, SHAPE_SIZE, TYPE, payload, policy_name,
};

#[derive(Clone, Debug, Serialize, Deserialize)]
struct ShapeType {
    color: String,
    x: i32,
    y: i32,
    shapesize: i32,
    additional_payload: Vec<u8>,
}

impl Keyed for ShapeType {
    type K = String;

    fn key(&self) -> String {
        self.color.clone()
    }
}

struct RustDds {
    _participant: DomainParticipant,
    endpoint: Endpoint,
    shape: ShapeType,
}

enum Endpoint {
    Writer(Box<DataWriter<ShapeType>>),
    Reader(Box<DataReader<ShapeType>>),
}

impl Peer for RustDds {
    const STACK: &str = "rustdds";

    /// A writer takes an exclusive reader for a shared one, and a reader hears every writer.
    fn supports(role: Role, capability: Capability) -> bool {
        match capability {
            Capability::Ownership => role == Role::Subscriber,
            Capability::Arbitration
            | Capability::Lifespan
            | Capability::Partition
            | Capability::Filter => false,
            _ => true,
        }
    }

    fn open(options: &Options) -> Result<RustDds> {
        let participant = DomainParticipant::new(options.domain)?;
        let qos = qos(options);
        let topic = participant.create_topic(
            options.topic.clone(),
            TYPE.to_owned(),
            &qos,
            TopicKind::WithKey,
        )?;
        let endpoint = match options.role {
            Role::Publisher => {
                let publisher = participant.create_publisher(&qos)?;
                Endpoint::Writer(Box::new(publisher.create_datawriter_cdr(&topic, None)?))
            }
            Role::Subscriber => {
                let subscriber = participant.create_subscriber(&qos)?;
                Endpoint::Reader(Box::new(subscriber.create_datareader_cdr(&topic, None)?))
            }
        };
        Ok(RustDds {
            _participant: participant,
            endpoint,
            shape: ShapeType {
                color: options.color.clone(),
                x: 0,
                y: 0,
                shapesize: SHAPE_SIZE,
                additional_payload: payload(options.size),
            },
        })
    }

    fn guid(&self) -> Option<Guid> {
        let guid = match &self.endpoint {
            Endpoint::Writer(writer) => writer.guid(),
            Endpoint::Reader(reader) => reader.guid(),
        };
        Some(guid.to_bytes())
    }

    fn write(&mut self, number: i32) -> Result<()> {
        self.shape.x = number;
        if let Endpoint::Writer(writer) = &self.endpoint {
            writer.write(self.shape.clone(), None)?;
        }
        Ok(())
    }

    fn poll(&mut self) -> Result<Vec<Event>> {
        let mut events = Vec::new();
        match &mut self.endpoint {
            Endpoint::Writer(writer) => {
                while let Some(status) = writer.try_recv_status() {
                    match status {
                        DataWriterStatus::PublicationMatched { current, .. } => {
                            events.push(Event::Matched(current.count()));
                        }
                        DataWriterStatus::OfferedIncompatibleQos { last_policy_id, .. } => {
                            events.push(incompatible(last_policy_id));
                        }
                        _ => (),
                    }
                }
            }
            Endpoint::Reader(reader) => {
                while let Some(status) = reader.try_recv_status() {
                    match status {
                        DataReaderStatus::SubscriptionMatched { current, .. } => {
                            events.push(Event::Matched(current.count()));
                        }
                        DataReaderStatus::RequestedIncompatibleQos { last_policy_id, .. } => {
                            events.push(incompatible(last_policy_id));
                        }
                        _ => (),
                    }
                }
                while let Some(sample) = reader.take_next_sample()? {
                    if let Sample::Value(shape) = sample.into_value() {
                        events.push(Event::Sample {
                            number: shape.x,
                            color: shape.color,
                            length: shape.additional_payload.len(),
                        });
                    }
                }
            }
        }
        Ok(events)
    }

    /// Dropping the participant announces its end.
    fn close(self) -> Result<()> {
        Ok(())
    }
}

fn incompatible(policy: QosPolicyId) -> Event {
    Event::Incompatible(policy_name(match policy {
        QosPolicyId::Durability => 2,
        QosPolicyId::Presentation => 3,
        QosPolicyId::Deadline => 4,
        QosPolicyId::LatencyBudget => 5,
        QosPolicyId::Ownership => 6,
        QosPolicyId::Liveliness => 8,
        QosPolicyId::Reliability => 11,
        QosPolicyId::DestinationOrder => 12,
        QosPolicyId::Representation => 23,
        _ => 0,
    }))
}

fn qos(options: &Options) -> QosPolicies {
    let mut qos = QosPolicyBuilder::new()
        .reliability(if options.best_effort {
            Reliability::BestEffort
        } else {
            Reliability::Reliable {
                max_blocking_time: Duration::from_secs(1),
            }
        })
        .durability(if options.transient_local {
            Durability::TransientLocal
        } else {
            Durability::Volatile
        })
        .history(match options.depth {
            Some(depth) => History::KeepLast {
                depth: depth as i32,
            },
            None => History::KeepAll,
        });
    if options.exclusive {
        qos = qos.ownership(Ownership::Exclusive {
            strength: options.strength,
        });
    }
    if let Some(period) = options.deadline {
        qos = qos.deadline(Deadline(Duration::from_std(period)));
    }
    if let (Role::Publisher, Some(lifespan)) = (options.role, options.lifespan) {
        qos = qos.lifespan(Lifespan {
            duration: Duration::from_std(lifespan),
        });
    }
    if let Some(lease) = options.lease {
        qos = qos.liveliness(Liveliness::Automatic {
            lease_duration: Duration::from_std(lease),
        });
    }
    qos.build()
}

fn main() -> ExitCode {
    shapes::run::<RustDds>()
}
