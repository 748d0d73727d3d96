//! The peer on dust_dds.

use std::process::ExitCode;
use std::sync::mpsc::{Receiver, Sender, channel};

use dust_dds::dds_async::configuration::DustDdsConfigurationBuilder;
use dust_dds::dds_async::data_reader::DataReaderAsync;
use dust_dds::dds_async::data_reader_listener::DataReaderListener;
use dust_dds::dds_async::data_writer::DataWriterAsync;
use dust_dds::dds_async::data_writer_listener::DataWriterListener;
use dust_dds::domain::domain_participant::DomainParticipant;
use dust_dds::domain::domain_participant_factory::DomainParticipantFactory;
use dust_dds::infrastructure::error::DdsError;
use dust_dds::infrastructure::listener::NO_LISTENER;
use dust_dds::infrastructure::qos::{
    DataReaderQos, DataWriterQos, PublisherQos, QosKind, SubscriberQos,
};
use dust_dds::infrastructure::qos_policy::*;
use dust_dds::infrastructure::sample_info::{ANY_INSTANCE_STATE, ANY_SAMPLE_STATE, ANY_VIEW_STATE};
use dust_dds::infrastructure::status::{
    NO_STATUS, OfferedIncompatibleQosStatus, RequestedIncompatibleQosStatus, StatusKind,
};
use dust_dds::infrastructure::time::{Duration, DurationKind};
use dust_dds::infrastructure::type_support::DdsType;
use dust_dds::publication::data_writer::DataWriter;
use dust_dds::subscription::data_reader::DataReader;
use shapes::{
    Capability, Event, Guid, Options, Peer, Result, Role, SHAPE_SIZE, TYPE, payload, policy_name,
};

#[derive(Clone, Debug, DdsType)]
#[dust_dds(extensibility = "final")]
struct ShapeType {
    #[dust_dds(key)]
    color: String,
    x: i32,
    y: i32,
    shapesize: i32,
    additional_payload: Vec<u8>,
}

struct Dust {
    participant: DomainParticipant,
    has_filter: bool,
    endpoint: Endpoint,
    incompatible: Receiver<QosPolicyId>,
    shape: ShapeType,
}

/// Hears of incompatible endpoints: their status cannot be read (`todo!()` in the library).
struct Listener(Sender<QosPolicyId>);

impl DataWriterListener<ShapeType> for Listener {
    async fn on_offered_incompatible_qos(
        &mut self,
        _: DataWriterAsync<ShapeType>,
        status: OfferedIncompatibleQosStatus,
    ) {
        let _ = self.0.send(status.last_policy_id);
    }
}

impl DataReaderListener<ShapeType> for Listener {
    async fn on_requested_incompatible_qos(
        &mut self,
        _: DataReaderAsync<ShapeType>,
        status: RequestedIncompatibleQosStatus,
    ) {
        let _ = self.0.send(status.last_policy_id);
    }
}

enum Endpoint {
    Writer(DataWriter<ShapeType>),
    Reader(DataReader<ShapeType>),
}

impl Peer for Dust {
    const STACK: &str = "dust";

    /// A longer lease of a publisher matches, and a shorter one does not.
    fn supports(_: Role, capability: Capability) -> bool {
        capability != Capability::Liveliness
    }

    fn announces(_: Role, _: Capability) -> bool {
        true
    }

    fn open(options: &Options) -> Result<Dust> {
        let factory = DomainParticipantFactory::get_instance();
        // Cyclone DDS would ask for the type, and this library would not answer.
        *factory.get_mut_configuration() = DustDdsConfigurationBuilder::new()
            .enable_type_information(false)
            .build()?;
        let participant = factory.create_participant(
            options.domain.into(),
            QosKind::Default,
            NO_LISTENER,
            NO_STATUS,
        )?;
        let name = &options.topic;
        let topic = participant.create_topic::<ShapeType>(
            name,
            TYPE,
            QosKind::Default,
            NO_LISTENER,
            NO_STATUS,
        )?;
        let partition = PartitionQosPolicy {
            name: options.partitions.clone(),
        };
        let (sender, incompatible) = channel();
        let listener = Some(Listener(sender));
        let filtered = options.filter.as_ref().map(|filter| {
            let filter = filter.clone();
            participant.create_contentfilteredtopic("Filtered", &topic, filter, Vec::new())
        });
        let filtered = filtered.transpose()?;
        let endpoint = match options.role {
            Role::Publisher => {
                let qos = PublisherQos {
                    partition,
                    ..Default::default()
                };
                let qos = QosKind::Specific(qos);
                let publisher = participant.create_publisher(qos, NO_LISTENER, NO_STATUS)?;
                let qos = QosKind::Specific(writer_qos(options));
                let mask = &[StatusKind::OfferedIncompatibleQos];
                Endpoint::Writer(publisher.create_datawriter(&topic, qos, listener, mask)?)
            }
            Role::Subscriber => {
                let qos = SubscriberQos {
                    partition,
                    ..Default::default()
                };
                let qos = QosKind::Specific(qos);
                let subscriber = participant.create_subscriber(qos, NO_LISTENER, NO_STATUS)?;
                let qos = QosKind::Specific(reader_qos(options));
                let mask = &[StatusKind::RequestedIncompatibleQos];
                Endpoint::Reader(match &filtered {
                    None => subscriber.create_datareader(&topic, qos, listener, mask)?,
                    Some(topic) => subscriber.create_datareader(topic, qos, listener, mask)?,
                })
            }
        };
        Ok(Dust {
            participant,
            has_filter: filtered.is_some(),
            endpoint,
            incompatible,
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
        let handle = match &self.endpoint {
            Endpoint::Writer(writer) => writer.get_instance_handle(),
            Endpoint::Reader(reader) => reader.get_instance_handle(),
        };
        Some(handle.into())
    }

    fn write(&mut self, number: i32) -> Result<()> {
        self.shape.x = number;
        if let Endpoint::Writer(writer) = &self.endpoint {
            writer.write(self.shape.clone(), None)?;
        }
        Ok(())
    }

    fn poll(&mut self) -> Result<Vec<Event>> {
        let mut events: Vec<Event> = self.incompatible.try_iter().map(incompatible).collect();
        match &self.endpoint {
            Endpoint::Writer(writer) => {
                let status = writer.get_publication_matched_status()?;
                events.push(Event::Matched(status.current_count));
            }
            Endpoint::Reader(reader) => {
                let status = reader.get_subscription_matched_status()?;
                events.push(Event::Matched(status.current_count));
                let (any, view, instance) = (ANY_SAMPLE_STATE, ANY_VIEW_STATE, ANY_INSTANCE_STATE);
                let samples = match reader.take(i32::MAX, any, view, instance) {
                    Err(DdsError::NoData) => Vec::new(),
                    samples => samples?,
                };
                let shapes = samples.into_iter().filter_map(|sample| sample.data);
                events.extend(shapes.map(|shape| Event::Sample {
                    number: shape.x,
                    color: shape.color,
                    length: shape.additional_payload.len(),
                }));
            }
        }
        Ok(events)
    }

    fn close(self) -> Result<()> {
        self.participant.delete_contained_entities()?;
        // The library deletes no filtered topic, and no participant that has one.
        if !self.has_filter {
            DomainParticipantFactory::get_instance().delete_participant(&self.participant)?;
        }
        Ok(())
    }
}

fn incompatible(policy: QosPolicyId) -> Event {
    Event::Incompatible(usize::try_from(policy).map_or("INVALID", policy_name))
}

fn writer_qos(options: &Options) -> DataWriterQos {
    DataWriterQos {
        reliability: reliability(options),
        durability: durability(options),
        history: history(options),
        ownership: ownership(options),
        ownership_strength: OwnershipStrengthQosPolicy {
            value: options.strength,
        },
        deadline: DeadlineQosPolicy {
            period: duration(options.deadline),
        },
        lifespan: LifespanQosPolicy {
            duration: duration(options.lifespan),
        },
        liveliness: liveliness(options),
        ..Default::default()
    }
}

fn reader_qos(options: &Options) -> DataReaderQos {
    DataReaderQos {
        reliability: reliability(options),
        durability: durability(options),
        history: history(options),
        ownership: ownership(options),
        deadline: DeadlineQosPolicy {
            period: duration(options.deadline),
        },
        liveliness: liveliness(options),
        ..Default::default()
    }
}

fn reliability(options: &Options) -> ReliabilityQosPolicy {
    ReliabilityQosPolicy {
        kind: if options.best_effort {
            ReliabilityQosPolicyKind::BestEffort
        } else {
            ReliabilityQosPolicyKind::Reliable
        },
        max_blocking_time: DurationKind::Finite(Duration::new(1, 0)),
    }
}

fn durability(options: &Options) -> DurabilityQosPolicy {
    DurabilityQosPolicy {
        kind: if options.transient_local {
            DurabilityQosPolicyKind::TransientLocal
        } else {
            DurabilityQosPolicyKind::Volatile
        },
    }
}

fn history(options: &Options) -> HistoryQosPolicy {
    HistoryQosPolicy {
        kind: match options.depth {
            Some(depth) => HistoryQosPolicyKind::KeepLast(depth),
            None => HistoryQosPolicyKind::KeepAll,
        },
    }
}

fn ownership(options: &Options) -> OwnershipQosPolicy {
    OwnershipQosPolicy {
        kind: if options.exclusive {
            OwnershipQosPolicyKind::Exclusive
        } else {
            OwnershipQosPolicyKind::Shared
        },
    }
}

fn liveliness(options: &Options) -> LivelinessQosPolicy {
    LivelinessQosPolicy {
        kind: LivelinessQosPolicyKind::Automatic,
        lease_duration: duration(options.lease),
    }
}

fn duration(limit: Option<std::time::Duration>) -> DurationKind {
    limit.map_or(DurationKind::Infinite, |limit| {
        DurationKind::Finite(limit.into())
    })
}

fn main() -> ExitCode {
    shapes::run::<Dust>()
}
