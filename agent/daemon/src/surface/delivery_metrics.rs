//! Metrics of deliveries to receivers: sums per topic, and series per delivery for topics whose
//! watch requests them. The number of series is bounded, and omitted deliveries are counted.

use std::cmp::Reverse;
use std::fmt;
use std::net::SocketAddr;

use super::ros2_metrics::TopicRow;
use crate::settings_cell::Settings;
use ros2probe_metrics::catalogue::{self as metric, Metric};
use ros2probe_metrics::metric_sink::{Family, Label, MetricSink, Number};
use ros2probe_model::facts::histogram::Histogram;
use ros2probe_model::facts::loss::LossCause;
use ros2probe_model::report::snapshot::Subscriber;
use ros2probe_model::report::snapshot::{
    AcknowledgementFacts, Breakdown, Delivered, DeliveryFacts, Direction, SocketFacts, TopicFacts,
};

/// Maximum number of deliveries, and of acknowledging readers, with their own series.
const MAX_SHOWN: usize = 1_000;
/// Maximum number of sockets with their own series.
const MAX_SOCKETS: usize = 64;
/// Loss cause of messages that arrived but were never taken by the process.
const READER_QUEUE: &str = "reader_queue";
/// Maximum number of nodes in one label.
const MAX_NODES: usize = 4;

/// Reads a counter.
type Count = fn(&Delivered) -> u64;
/// Reads a value of a reader.
type Acknowledged = fn(&AcknowledgementFacts) -> Number;
/// Reads a histogram.
type Values = fn(&Breakdown) -> &Histogram;

/// Deliveries and acknowledging readers with their own series.
pub(super) struct Deliveries<'a> {
    sent: Vec<Delivery<'a>>,
    received: Vec<Delivery<'a>>,
    readers: Vec<(&'a TopicRow<'a>, &'a AcknowledgementFacts)>,
    /// Number of deliveries and readers without series.
    pub(super) hidden: usize,
}

/// A series: the sum of all deliveries with equal labels.
struct Delivery<'a> {
    row: &'a TopicRow<'a>,
    facts: &'a DeliveryFacts,
    delivered: Delivered,
}

impl<'a> Deliveries<'a> {
    pub(super) fn new(rows: &'a [TopicRow<'a>]) -> Self {
        let mut all = Self {
            sent: Vec::new(),
            received: Vec::new(),
            readers: Vec::new(),
            hidden: 0,
        };
        for row in rows.iter().filter(|row| row.per_subscriber) {
            for facts in row.facts.iter().flat_map(|topic| &topic.deliveries) {
                all.add(row, facts);
            }
            let acknowledgements = row.facts.iter().flat_map(|topic| &topic.acknowledgements);
            for facts in acknowledgements {
                if all.readers.len() < MAX_SHOWN {
                    all.readers.push((row, facts));
                } else {
                    all.hidden += 1;
                }
            }
        }
        all
    }

    /// Adds a delivery. The snapshot's lists are sorted by the labels, so deliveries with equal
    /// labels are adjacent.
    fn add(&mut self, row: &'a TopicRow<'a>, facts: &'a DeliveryFacts) {
        let shown = self.sent.len() + self.received.len();
        let list = match facts.direction {
            Direction::Sent => &mut self.sent,
            Direction::Received => &mut self.received,
        };
        let identity =
            |facts: &'a DeliveryFacts| (facts.writer, facts.destination, facts.subscriber);
        if let Some(twin) = list
            .last_mut()
            .filter(|last| std::ptr::eq(last.row, row) && identity(last.facts) == identity(facts))
        {
            twin.delivered.add(&facts.delivered);
        } else if shown < MAX_SHOWN {
            list.push(Delivery {
                row,
                facts,
                delivered: facts.delivered,
            });
        } else {
            self.hidden += 1;
        }
    }

    pub(super) fn write(&self, sink: &mut MetricSink<'_>) -> fmt::Result {
        let sent: [(&Metric, Count); 2] = [
            (&metric::WRITER_SENT, |sent| sent.messages),
            (&metric::WRITER_SENT_BYTES, |sent| sent.bytes),
        ];
        for (metric, value) in sent {
            sink.family(metric, |family| {
                self.sent.iter().try_for_each(|delivery| {
                    let [domain_id, topic, writer, destination, _] = delivery.labels();
                    let labels = [domain_id, topic, writer, destination];
                    family.sample(&labels, value(&delivery.delivered))
                })
            })?;
        }
        sink.family(&metric::SUBSCRIBER_INFO, |family| self.subscribers(family))?;
        self.for_each_received(sink, &metric::SUBSCRIBER_RECEIVED, |got| {
            got.messages.into()
        })?;
        self.for_each_received(sink, &metric::SUBSCRIBER_RECEIVED_BYTES, |got| {
            got.bytes.into()
        })?;
        sink.family(&metric::SUBSCRIBER_LOST, |family| {
            self.received.iter().try_for_each(|delivery| {
                let [domain_id, topic, writer, destination, subscriber] = delivery.labels();
                LossCause::ALL.into_iter().try_for_each(|cause| {
                    let cause_label = Label::Text(cause.label());
                    let labels = [
                        domain_id,
                        topic,
                        writer,
                        destination,
                        subscriber,
                        cause_label,
                    ];
                    family.sample(&labels, delivery.delivered.lost_by(cause))
                })?;
                match delivery.facts.lost_in_reader_queue {
                    Some(lost) => {
                        let cause = Label::Text(READER_QUEUE);
                        let labels = [domain_id, topic, writer, destination, subscriber, cause];
                        family.sample(&labels, lost)
                    }
                    None => Ok(()),
                }
            })
        })?;
        self.for_each_received(sink, &metric::SUBSCRIBER_PENDING, |got| got.open().into())?;
        self.for_each_received(sink, &metric::SUBSCRIBER_RECOVERED, |got| {
            got.recovered.into()
        })?;
        self.for_each_received(sink, &metric::SUBSCRIBER_RECOVERY_SECONDS, |got| {
            got.recovery_seconds.into()
        })?;
        self.for_each_received(sink, &metric::SUBSCRIBER_IRRELEVANT, |got| {
            got.irrelevant.into()
        })?;
        self.for_each_received(sink, &metric::SUBSCRIBER_UNMATCHED, |got| {
            got.unmatched.into()
        })?;
        self.acknowledgements(sink)
    }

    fn for_each_received(
        &self,
        sink: &mut MetricSink<'_>,
        metric: &'static Metric,
        value: fn(&Delivered) -> Number,
    ) -> fmt::Result {
        sink.family(metric, |family| {
            self.received.iter().try_for_each(|delivery| {
                family.sample(&delivery.labels(), value(&delivery.delivered))
            })
        })
    }

    /// Writes each receiver once, regardless of the number of its writers.
    fn subscribers(&self, family: &mut Family<'_>) -> fmt::Result {
        let mut subscribers: Vec<&Delivery<'_>> = self.received.iter().collect();
        // Among one receiver's deliveries, the latest has the most complete facts.
        subscribers.sort_by_key(|one| (one.receiver(), Reverse(one.facts.last_seen)));
        subscribers.dedup_by_key(|one| one.receiver());
        for Delivery { row, facts, .. } in subscribers {
            let [domain_id, topic] = row.labels();
            let shown = facts.nodes.len().min(MAX_NODES);
            let mut nodes = facts.nodes.get(..shown).unwrap_or_default().join(",");
            if shown < facts.nodes.len() {
                nodes.push_str(",...");
            }
            let participant = facts.participant.map_or(Label::Text(""), Label::Guid);
            family.info(&[
                domain_id,
                topic,
                Label::Address(facts.destination),
                Label::Subscriber(facts.subscriber),
                Label::Text(&nodes),
                participant,
                Label::Text(facts.process.as_deref().unwrap_or_default()),
                number_or_nothing(facts.process_id),
                Label::Text(facts.cgroup.as_deref().unwrap_or_default()),
            ])?;
        }
        Ok(())
    }

    fn acknowledgements(&self, sink: &mut MetricSink<'_>) -> fmt::Result {
        let values: [(&Metric, Acknowledged); 4] = [
            (&metric::READER_LAG, |facts| facts.lag_samples.into()),
            (&metric::READER_LAG_SECONDS, |facts| {
                lag_seconds(facts).into()
            }),
            (&metric::READER_MISSING, |facts| facts.missing.into()),
            (&metric::READER_REQUESTED, |facts| facts.requested.into()),
        ];
        for (metric, value) in values {
            sink.family(metric, |family| {
                self.readers.iter().try_for_each(|(row, facts)| {
                    let [domain_id, topic] = row.labels();
                    let labels = [
                        domain_id,
                        topic,
                        Label::Guid(facts.writer),
                        Label::Guid(facts.reader),
                        Label::Text(facts.node.as_deref().unwrap_or_default()),
                    ];
                    family.sample(&labels, value(facts))
                })
            })?;
        }
        Ok(())
    }
}

impl<'a> Delivery<'a> {
    /// Returns the key that identifies a receiver in the labels.
    fn receiver(&self) -> (*const TopicRow<'a>, SocketAddr, Subscriber) {
        let row = std::ptr::from_ref(self.row);
        (row, self.facts.destination, self.facts.subscriber)
    }

    fn labels(&self) -> [Label<'_>; 5] {
        let [domain_id, topic] = self.row.labels();
        [
            domain_id,
            topic,
            Label::Guid(self.facts.writer),
            Label::Address(self.facts.destination),
            Label::Subscriber(self.facts.subscriber),
        ]
    }
}

/// Writes the sums over the deliveries of each topic that has deliveries.
pub(super) fn sums(
    sink: &mut MetricSink<'_>,
    rows: &[TopicRow<'_>],
    settings: &Settings,
) -> fmt::Result {
    let sent: [(&Metric, Count); 2] = [
        (&metric::TOPIC_SENT, |sent| sent.messages),
        (&metric::TOPIC_SENT_BYTES, |sent| sent.bytes),
    ];
    for (metric, value) in sent {
        each(sink, metric, rows, |topic| {
            Some(value(topic.sent.as_deref()?))
        })?;
    }
    let delivered: [(&Metric, Count); 2] = [
        (&metric::TOPIC_DELIVERED, |got| got.messages),
        (&metric::TOPIC_DELIVERED_BYTES, |got| got.bytes),
    ];
    for (metric, value) in delivered {
        each(sink, metric, rows, |topic| {
            Some(value(topic.received.as_deref()?))
        })?;
    }
    sink.family(&metric::TOPIC_DELIVERY_LOST, |family| {
        let received = rows
            .iter()
            .filter_map(|row| Some((row, row.facts?.received.as_deref()?)));
        for (row, received) in received {
            let [domain_id, topic] = row.labels();
            for cause in LossCause::ALL {
                let labels = [domain_id, topic, Label::Text(cause.label())];
                family.sample(&labels, received.lost_by(cause))?;
            }
        }
        for row in rows {
            let inside = row.facts.and_then(|topic| topic.inside.as_deref());
            if let Some(lost) = inside.and_then(|inside| inside.lost_in_queues) {
                let [domain_id, topic] = row.labels();
                family.sample(&[domain_id, topic, Label::Text(READER_QUEUE)], lost)?;
            }
        }
        Ok(())
    })?;
    let rest: [(&Metric, Count); 4] = [
        (&metric::TOPIC_DELIVERY_PENDING, |got| got.open()),
        (&metric::TOPIC_DELIVERY_RECOVERED, |got| got.recovered),
        (&metric::TOPIC_DELIVERY_IRRELEVANT, |got| got.irrelevant),
        (&metric::TOPIC_DELIVERY_UNMATCHED, |got| got.unmatched),
    ];
    for (metric, value) in rest {
        each(sink, metric, rows, |topic| {
            Some(value(topic.received.as_deref()?))
        })?;
    }
    each(sink, &metric::TOPIC_LAG, rows, |topic| {
        topic
            .acknowledgements
            .iter()
            .map(|each| each.lag_samples)
            .max()
    })?;
    each(sink, &metric::TOPIC_LAG_SECONDS, rows, |topic| {
        topic
            .acknowledgements
            .iter()
            .map(lag_seconds)
            .reduce(f64::max)
    })?;
    let breakdown: [(&Metric, Values); 4] = [
        (&metric::TOPIC_SEND_DELAY, |spent| &spent.send_delay),
        (&metric::TOPIC_TRANSIT, |spent| &spent.transit),
        (&metric::TOPIC_TRANSFER, |spent| &spent.transfer),
        (&metric::TOPIC_RETRANSMISSION, |spent| &spent.retransmission),
    ];
    for (metric, values) in breakdown {
        sink.family(metric, |family| {
            for row in rows.iter().filter(|_| settings.histograms) {
                let spent = row.facts.and_then(|topic| topic.breakdown.as_deref());
                if let Some(values) = spent.map(values).filter(|values| values.count() > 0) {
                    family.histogram(&row.labels(), values)?;
                }
            }
            Ok(())
        })?;
    }
    Ok(())
}

/// Writes a sample for each topic that has a value.
fn each<N: Into<Number>>(
    sink: &mut MetricSink<'_>,
    metric: &'static Metric,
    rows: &[TopicRow<'_>],
    value: impl Fn(&TopicFacts) -> Option<N>,
) -> fmt::Result {
    sink.family(metric, |family| {
        rows.iter()
            .try_for_each(|row| match row.facts.and_then(&value) {
                Some(value) => family.sample(&row.labels(), value),
                None => Ok(()),
            })
    })
}

/// Writes the sockets that dropped datagrams with unknown content.
pub(super) fn sockets(sink: &mut MetricSink<'_>, sockets: &[SocketFacts]) -> fmt::Result {
    sink.family(&metric::SOCKET_DROPS, |family| {
        let dropping = sockets
            .iter()
            .filter(|socket| socket.unidentified_drops > 0);
        for socket in dropping.take(MAX_SOCKETS) {
            let labels = [
                Label::Number(socket.cookie),
                Label::Text(socket.process.as_deref().unwrap_or_default()),
                number_or_nothing(socket.process_id),
                Label::Text(socket.cgroup.as_deref().unwrap_or_default()),
            ];
            family.sample(&labels, socket.unidentified_drops)?;
        }
        Ok(())
    })
}

/// Returns the lag in seconds, or infinity if it is no longer known.
fn lag_seconds(facts: &AcknowledgementFacts) -> f64 {
    facts.lag_seconds.unwrap_or(f64::INFINITY)
}

fn number_or_nothing(number: Option<u32>) -> Label<'static> {
    number.map_or(Label::Text(""), |number| Label::Number(number.into()))
}
