//! Metrics of fields of messages: those of standard types, and those that the configuration
//! extracts.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::{Duration, Instant};

use ros2probe_message::filter::{Filter, Subject};
use ros2probe_message::{Decoded, Library, Limits, MessageType, Sources, decode};
use ros2probe_metrics::catalogue::{self, Kind, Metric};
use ros2probe_metrics::metric_sink::{Label, MetricSink};
use ros2probe_metrics::stability::Stability;
use ros2probe_model::derive::robot::fields::BATTERY_TYPE;
use ros2probe_model::facts::names::{TopicName, TypeName};
use ros2probe_model::report::snapshot::{FieldMessage, Snapshot};
use tokio::runtime::Handle;

use crate::config::Extraction;

/// Fields of standard types, each with its metric.
const STANDARD_FIELDS: [(&str, &str, &Metric); 4] = [
    (BATTERY_TYPE, "percentage", &catalogue::BATTERY_CHARGE),
    (BATTERY_TYPE, "voltage", &catalogue::BATTERY_VOLTAGE),
    (BATTERY_TYPE, "current", &catalogue::BATTERY_CURRENT),
    (BATTERY_TYPE, "temperature", &catalogue::BATTERY_TEMPERATURE),
];
/// Elements of an array that are kept.
const MAX_ELEMENTS: usize = 1024;
/// Time after which a type that was not found is searched for again: a package may be installed.
const SEARCH_INTERVAL: Duration = Duration::from_secs(60);
/// Number of failures that are reported in the log.
const MAX_REPORTED: usize = 64;

/// The metrics of fields.
#[derive(Debug)]
pub struct FieldMetrics {
    library: Arc<Library>,
    /// Fields, those with one metric together.
    fields: Vec<Field>,
    /// The types of the messages of the last page.
    types: Mutex<Types>,
    /// Failures that the log contains already.
    reported: Mutex<BTreeSet<(&'static str, String)>>,
}

/// Name and hash of a type.
type TypeKey = (TypeName, Option<String>);

/// Types of messages, each with its latest search.
type Types = BTreeMap<TypeKey, Arc<Search>>;

/// A search for a type, which may still run.
#[derive(Debug)]
struct Search {
    found: OnceLock<Found>,
    /// Result of the search before, which counts until this one ends.
    before: Option<Found>,
}

/// The result of the search for a type.
#[derive(Clone, Debug)]
struct Found {
    message_type: Result<Arc<MessageType>, NoValue>,
    /// Revision of the library at that time. A later one may have the type.
    revision: u64,
    at: Instant,
}

impl Found {
    /// Returns whether a further search would have the same result, at this revision.
    fn is_valid(&self, revision: u64) -> bool {
        self.message_type.is_ok()
            || (self.revision == revision && self.at.elapsed() < SEARCH_INTERVAL)
    }
}

impl Search {
    /// Begins to search, within a thread for blocking work if there is a runtime.
    fn begin(library: &Arc<Library>, (name, hash): &TypeKey, before: Option<Found>) -> Arc<Self> {
        let search = Arc::new(Self {
            found: OnceLock::new(),
            before,
        });
        let task = {
            let (library, search) = (Arc::clone(library), Arc::clone(&search));
            let (name, hash) = (name.clone(), hash.clone());
            move || {
                let revision = library.revision();
                let found = library.find(&name, hash.as_deref());
                let message_type = found.map_err(|error| NoValue::Type(error.to_string()));
                search.found.get_or_init(|| Found {
                    message_type,
                    revision,
                    at: Instant::now(),
                });
            }
        };
        match Handle::try_current() {
            Ok(runtime) => drop(runtime.spawn_blocking(task)),
            Err(_) => task(),
        }
        search
    }

    /// Returns the latest result; `None` during the first search.
    fn result(&self) -> Option<&Found> {
        self.found.get().or(self.before.as_ref())
    }

    /// Returns whether it still runs, or a further search would have the same result.
    fn is_valid(&self, revision: u64) -> bool {
        self.found
            .get()
            .is_none_or(|found| found.is_valid(revision))
    }
}

/// A field of messages, with its metric.
#[derive(Debug)]
struct Field {
    of: Scope,
    /// The field as it is configured.
    text: String,
    expression: Filter,
    metric: &'static Metric,
}

/// The messages that have a field.
#[derive(Debug)]
enum Scope {
    Topic(TopicName),
    Type(&'static str),
}

/// Why a field of a message has no value.
#[derive(Clone, Debug, thiserror::Error)]
enum NoValue {
    #[error("{0}")]
    Type(String),
    #[error("{0}")]
    Decode(String),
    #[error("{0}")]
    Field(String),
}

impl NoValue {
    const fn label(&self) -> &'static str {
        match self {
            Self::Type(_) => "unknown_type",
            Self::Decode(_) => "malformed",
            Self::Field(_) => "no_number",
        }
    }
}

impl Default for FieldMetrics {
    fn default() -> Self {
        Self::new(&[], Arc::new(Library::new(Sources::default())))
    }
}

impl FieldMetrics {
    /// Creates the metrics of the standard types and of these fields.
    #[must_use]
    pub fn new(extractions: &[Extraction], library: Arc<Library>) -> Self {
        let standard = STANDARD_FIELDS.iter().filter_map(|(name, field, metric)| {
            Some(Field {
                of: Scope::Type(name),
                text: (*field).to_owned(),
                expression: Filter::of_field(field).ok()?,
                metric,
            })
        });
        let mut fields: Vec<_> = standard.collect();
        let mut sorted: Vec<_> = extractions.iter().collect();
        sorted.sort_by(|one, other| one.metric.cmp(&other.metric));
        for extraction in sorted {
            let Ok(expression) = Filter::of_field(&extraction.field) else {
                continue;
            };
            let known = fields.last().map(|field: &Field| field.metric);
            let known = known.filter(|metric| metric.name == extraction.metric);
            fields.push(Field {
                of: Scope::Topic(extraction.topic.as_str().into()),
                text: extraction.field.clone(),
                expression,
                metric: known.unwrap_or_else(|| metric(&extraction.metric)),
            });
        }
        Self {
            library,
            fields,
            types: Mutex::default(),
            reported: Mutex::default(),
        }
    }

    /// Writes the metrics, and which fields have no value.
    pub(super) fn write(&self, sink: &mut MetricSink<'_>, snapshot: &Snapshot) -> fmt::Result {
        let mut lacking = BTreeSet::new();
        let types = self.types(&snapshot.fields);
        let messages = snapshot.fields.iter().zip(&types);
        // The type of a message may still be searched for.
        let messages: Vec<_> = messages
            .filter_map(|(message, found)| Some((message, decoded(message, found.result()?))))
            .collect();
        let of_one_metric = self
            .fields
            .chunk_by(|one, other| one.metric.name == other.metric.name);
        for fields in of_one_metric {
            let Some(first) = fields.first() else {
                continue;
            };
            sink.family(first.metric, |family| {
                let mut written = BTreeSet::new();
                for field in fields {
                    for (message, decoded) in messages.iter().filter(|(each, _)| field.covers(each))
                    {
                        // The latest message of a topic with several publishers comes first.
                        if !written.insert((message.domain_id, &message.topic)) {
                            continue;
                        }
                        let labels = labels(message);
                        match field.value(decoded) {
                            Ok(value) if value.is_nan() => {}
                            Ok(value) => family.sample(&labels, value)?,
                            Err(error) => {
                                self.report(field, message, &error);
                                let name = (field.metric.name, error.label());
                                lacking.insert((message.domain_id, &message.topic, name));
                            }
                        }
                    }
                }
                Ok(())
            })?;
        }
        sink.family(&catalogue::FIELD_UNREADABLE, |family| {
            for (domain_id, topic, (name, reason)) in &lacking {
                let labels = [
                    Label::Number(domain_id.0.into()),
                    Label::Text(topic),
                    Label::Text(name),
                    Label::Text(reason),
                ];
                family.sample(&labels, true)?;
            }
            Ok(())
        })
    }

    /// Returns the type of each message. With a runtime, a thread for blocking work reads the files
    /// of the search, and the next scrape has the result.
    fn types(&self, messages: &[FieldMessage]) -> Vec<Arc<Search>> {
        let mut known = self.types.lock().unwrap_or_else(PoisonError::into_inner);
        let before = std::mem::take(&mut *known);
        let revision = self.library.revision();
        let types = messages.iter().map(|message| {
            let key = (message.message_type.clone(), message.hash.clone());
            let found = known
                .entry(key)
                .or_insert_with_key(|key| match before.get(key) {
                    Some(search) if search.is_valid(revision) => Arc::clone(search),
                    earlier => {
                        let earlier = earlier.and_then(|search| search.result().cloned());
                        Search::begin(&self.library, key, earlier)
                    }
                });
            Arc::clone(found)
        });
        types.collect()
    }

    /// Reports a failure in the log, once.
    fn report(&self, field: &Field, message: &FieldMessage, error: &NoValue) {
        let key = (error.label(), format!("{}|{}", message.topic, field.text));
        let mut reported = self.reported.lock().unwrap_or_else(PoisonError::into_inner);
        if reported.len() < MAX_REPORTED && reported.insert(key) {
            tracing::warn!(
                topic = %message.topic,
                message_type = %message.message_type,
                field = field.text,
                "the field has no metric: {error}"
            );
        }
    }
}

/// Decodes a message, if its type was found.
fn decoded<'a>(message: &'a FieldMessage, found: &'a Found) -> Result<Decoded<'a>, NoValue> {
    let limits = Limits {
        kept: MAX_ELEMENTS,
        ..Limits::default()
    };
    let message_type = found.message_type.as_ref().map_err(Clone::clone)?;
    let decoded = decode(message_type, &message.payload, &limits);
    decoded.map_err(|error| NoValue::Decode(error.to_string()))
}

impl Field {
    fn value(&self, decoded: &Result<Decoded<'_>, NoValue>) -> Result<f64, NoValue> {
        let decoded = decoded.as_ref().map_err(Clone::clone)?;
        let value = self.expression.number(Subject::Message(&decoded.message));
        value.map_err(|error| NoValue::Field(error.message))
    }

    fn covers(&self, message: &FieldMessage) -> bool {
        match &self.of {
            Scope::Topic(topic) => message.topic == *topic,
            Scope::Type(name) => message.message_type.as_str() == *name,
        }
    }
}

fn labels(message: &FieldMessage) -> [Label<'_>; 2] {
    [
        Label::Number(message.domain_id.0.into()),
        Label::Text(&message.topic),
    ]
}

/// Returns the metric of a configured name. It lives as long as the agent.
fn metric(name: &str) -> &'static Metric {
    Box::leak(Box::new(Metric {
        name: Box::leak(name.into()),
        kind: Kind::Gauge,
        unit: None,
        labels: &["domain_id", "topic"],
        help: "Last value of a field of messages; robot.extract names it.",
        stability: Stability::Stable,
    }))
}

#[cfg(test)]
mod tests {
    use ros2probe_metrics::exposition::{Exposition, Format};
    use ros2probe_testing::sample_robot::snapshot;

    use super::*;
    use crate::agent_facts::{AgentFacts, SourceKind};
    use crate::settings_cell::Settings;
    use crate::surface::MetricSources;

    fn page(extractions: &[(&str, &str, &str)]) -> Vec<String> {
        let extractions: Vec<_> = extractions
            .iter()
            .map(|(topic, field, metric)| Extraction {
                topic: (*topic).to_owned(),
                field: (*field).to_owned(),
                metric: (*metric).to_owned(),
            })
            .collect();
        let library = Arc::new(Library::new(Sources::default()));
        let mut sources = MetricSources::new(SourceKind::Wire, Settings::default());
        sources.fields = Arc::new(FieldMetrics::new(&extractions, library));
        sources.latest.publish(
            snapshot([]),
            AgentFacts::new(SourceKind::Wire, Instant::now()),
        );
        let text = Exposition::new(sources)
            .render(Format::OpenMetrics)
            .unwrap();
        let lines = text.lines().filter(|line| !line.starts_with('#'));
        let own = lines.filter(|line| line.contains("battery"));
        own.map(str::to_owned).collect()
    }

    #[test]
    fn the_result_before_counts_until_the_next_search_ends() {
        let library = Arc::new(Library::new(Sources::default()));
        let key = ("absent_msgs/msg/Absent".into(), None);
        let ended = Search::begin(&library, &key, None);
        let before = ended.result().cloned();
        assert!(
            before
                .as_ref()
                .is_some_and(|found| found.message_type.is_err())
        );
        assert!(ended.is_valid(library.revision()) && !ended.is_valid(library.revision() + 1));
        let running = Search {
            found: OnceLock::new(),
            before,
        };
        assert!(running.result().is_some() && running.is_valid(7));
    }

    #[test]
    fn fields_of_batteries_and_of_the_configuration_have_values_and_failures_reasons() {
        let lines = page(&[
            ("/battery", "cell_voltage[1]", "robot_cell_volts"),
            ("/battery", "present", "robot_battery_present"),
            ("/battery", "location", "robot_battery_location"),
            ("/battery", "absent.field", "robot_battery_absent"),
        ]);
        let value = |name: &str, topic: &str| {
            let start = format!("{name}{{domain_id=\"0\",topic=\"{topic}\"");
            let mut found = lines.iter().filter(|line| line.starts_with(&start));
            found
                .next()
                .map(|line| line.rsplit(' ').next().unwrap().to_owned())
        };
        let values = [
            "ros2_battery_charge_ratio",
            "ros2_battery_voltage_volts",
            "ros2_battery_current_amperes",
            "ros2_battery_temperature_celsius",
            "robot_battery_present",
        ]
        .map(|name| value(name, "/battery"));
        assert_eq!(
            values.map(Option::unwrap),
            ["0.75", "24.5", "-1.5", "31.0", "1.0"]
        );
        assert!(
            value("robot_cell_volts", "/battery")
                .unwrap()
                .starts_with("3.79999")
        );
        assert_eq!(value("ros2_battery_voltage_volts", "/spare_battery"), None);
        let unreadable = |metric: &str, reason: &str| {
            let end = format!("metric=\"{metric}\",reason=\"{reason}\"}} 1");
            lines.iter().any(|line| line.contains(&end))
        };
        assert!(
            unreadable("robot_battery_location", "no_number"),
            "{lines:#?}"
        );
        assert!(
            unreadable("robot_battery_absent", "no_number"),
            "{lines:#?}"
        );
        assert!(
            unreadable("ros2_battery_voltage_volts", "malformed"),
            "{lines:#?}"
        );
    }
}
