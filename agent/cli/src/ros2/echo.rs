//! What `ros2 topic echo` prints of messages, `ros2 service echo` of service events and
//! `ros2 action echo` of what an action's parts say.
//!
//! A payload and its type go in, text comes out; nothing is asked for, and no clock is read.

mod field;
mod lost;

use std::collections::HashMap;

pub use field::FieldPath;
use field::Selected;
pub use lost::Lost;

use super::{Dialect, Refused};
use ros2probe_api::endpoints::Endpoint;
use ros2probe_api::samples::Sample;
use ros2probe_message::filter::{Filter, Subject};
use ros2probe_message::yaml::{self, Style};
use ros2probe_message::{Decoded, Limits, MessageType, Truncation, Value, csv, decode, python};

/// Writers whose unreadable messages are counted apart.
const MAX_WRITERS: usize = 256;
/// `service_msgs/msg/ServiceEventInfo`, in the order of its constants.
const EVENTS: [&str; 4] = [
    "REQUEST_SENT",
    "REQUEST_RECEIVED",
    "RESPONSE_SENT",
    "RESPONSE_RECEIVED",
];

/// How messages are printed.
#[derive(Clone, Debug)]
pub struct Options {
    /// Whose output.
    pub dialect: Dialect,
    /// A line of values each instead of YAML.
    pub csv: bool,
    /// YAML in one line.
    pub style: Style,
    /// What of arrays and strings.
    pub shown: Truncation,
    /// The payload's bytes instead of the message.
    pub raw: bool,
    /// Parts instead of the whole.
    pub fields: Vec<FieldPath>,
    /// Which messages.
    pub filter: Option<Filter>,
    /// Times and numbers before each message.
    pub include_info: bool,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            dialect: Dialect::default(),
            csv: false,
            style: Style::Block,
            shown: Truncation {
                truncate: Some(128),
                ..Truncation::default()
            },
            raw: false,
            fields: Vec::new(),
            filter: None,
            include_info: false,
        }
    }
}

/// Prints messages, and remembers whose it could not read.
#[derive(Debug)]
pub struct Echo {
    options: Options,
    unreadable: HashMap<String, u64>,
}

/// The text for one message.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct MessageText {
    /// For stdout; `None` where the message did not pass the filter or cannot be read.
    pub out: Option<String>,
    /// For stderr, whole lines.
    pub err: String,
}

impl Echo {
    /// Prints this way.
    #[must_use]
    pub fn new(options: Options) -> Self {
        Self {
            options,
            unreadable: HashMap::new(),
        }
    }

    /// A message as `topic echo` prints it. With `raw` no type is needed.
    ///
    /// # Errors
    /// A field that is not there, or a filter without a value.
    pub fn message(
        &mut self,
        sample: &Sample,
        message_type: Option<&MessageType>,
        payload: &[u8],
    ) -> Result<MessageText, Refused> {
        if self.options.raw {
            if !self.passes(Subject::Bytes(payload))? {
                return Ok(MessageText::default());
            }
            let bytes = python::bytes(payload);
            let info = self.options.include_info.then(|| info_around(sample));
            let out = format!("{}{bytes}\n---\n", info.unwrap_or_default());
            return Ok(MessageText {
                out: Some(out),
                err: String::new(),
            });
        }
        let Some(message_type) = message_type else {
            return Ok(MessageText::default());
        };
        let (decoded, err) = self.decode(sample, message_type, payload);
        let Some(decoded) = decoded else {
            return Ok(MessageText { out: None, err });
        };
        let out = self.print(sample, &decoded)?;
        Ok(MessageText { out, err })
    }

    /// An event of a service as `service echo` prints it; `interface` is the part of an action that
    /// `action echo` names above it.
    #[must_use]
    pub fn event(
        &mut self,
        sample: &Sample,
        message_type: &MessageType,
        payload: &[u8],
        interface: Option<&str>,
    ) -> MessageText {
        let (decoded, err) = self.decode(sample, message_type, payload);
        let Some(Decoded { message, .. }) = decoded else {
            return MessageText { out: None, err };
        };
        let mut out = interface.map_or_else(String::new, |name| format!("interface: {name}\n"));
        if self.options.csv {
            out.push_str(&csv::line(&message, &self.options.shown));
            out.push('\n');
        } else {
            let document = yaml::document(&message, &self.options.shown, self.options.style);
            out.push_str(&with_name_of_event(document));
            out.push_str("---\n");
        }
        MessageText {
            out: Some(out),
            err,
        }
    }

    /// How many messages could not be read, if any.
    #[must_use]
    pub fn unreadable(&self) -> u64 {
        self.unreadable.values().sum()
    }

    fn decode<'a>(
        &mut self,
        sample: &Sample,
        message_type: &'a MessageType,
        payload: &'a [u8],
    ) -> (Option<Decoded<'a>>, String) {
        let shown = &self.options.shown;
        let whole = self.options.filter.is_some() || !self.options.fields.is_empty();
        let limits = Limits {
            kept: match shown.truncate {
                _ if whole => usize::MAX,
                _ if shown.no_arrays => 0,
                Some(length) => length,
                None => usize::MAX,
            },
            ..Limits::default()
        };
        let name = &message_type.root;
        let (decoded, strange) = match decode(message_type, payload, &limits) {
            Ok(decoded) => {
                let trailing = decoded.oddities.trailing;
                let strange = (trailing > 0).then(|| {
                    format!(
                        "a message has {trailing} bytes behind its last field: is the definition \
                         of {name} the one that the node uses?"
                    )
                });
                (Some(decoded), strange)
            }
            Err(error) => {
                let strange = format!("a message is no {name}: {error}");
                (None, Some(strange))
            }
        };
        let Some(strange) = strange else {
            return (decoded, String::new());
        };
        let is_known = self.unreadable.contains_key(&sample.writer);
        if !is_known && self.unreadable.len() == MAX_WRITERS {
            return (decoded, String::new());
        }
        let count = self.unreadable.entry(sample.writer.clone()).or_default();
        *count += u64::from(decoded.is_none());
        let err = if is_known {
            String::new()
        } else {
            format!(
                "rp: {} of writer {}: {strange}\n",
                sample.topic, sample.writer
            )
        };
        (decoded, err)
    }

    fn passes(&self, subject: Subject<'_>) -> Result<bool, Refused> {
        let Some(filter) = &self.options.filter else {
            return Ok(true);
        };
        filter
            .passes(subject)
            .map_err(|error| Refused(error.to_string()))
    }

    fn print(&self, sample: &Sample, decoded: &Decoded<'_>) -> Result<Option<String>, Refused> {
        let message = &decoded.message;
        let mut parts = Vec::with_capacity(self.options.fields.len().max(1));
        for field in &self.options.fields {
            parts.push(field.select(message)?);
        }
        // With one field that is `m`, as in the original.
        let subject = match parts.as_slice() {
            [one] => one.subject(),
            _ => Subject::Message(message),
        };
        if !self.passes(subject)? {
            return Ok(None);
        }
        if parts.is_empty() {
            parts.push(Selected::Message(message));
        }
        let mut out = String::new();
        let last = parts.len() - 1;
        for (index, part) in parts.iter().enumerate() {
            self.part(&mut out, sample, part, index == last);
        }
        Ok(Some(out))
    }

    fn part(&self, out: &mut String, sample: &Sample, part: &Selected<'_>, is_last: bool) {
        let Options {
            dialect,
            csv,
            style,
            shown,
            include_info,
            ..
        } = &self.options;
        match part {
            Selected::Message(message) if *csv => {
                if *include_info {
                    out.push_str(&info_in_line(sample));
                }
                out.push_str(&csv::line(message, shown));
                out.push('\n');
            }
            Selected::Message(message) => {
                if *include_info {
                    out.push_str(&info_document(sample));
                    out.push_str("---\n");
                }
                out.push_str(&yaml::document(message, shown, *style));
                if is_last {
                    out.push_str("---\n");
                }
            }
            Selected::Value(_) | Selected::Element(_) => {
                if *include_info {
                    out.push_str(&info_around(sample));
                }
                out.push_str(&part.value().map_or_else(String::new, python::str));
                out.push('\n');
                if is_last && !(*csv && *dialect == Dialect::Humble) {
                    out.push_str("---\n");
                }
            }
        }
    }
}

/// What the original says on stdout where publishers differ in what they offer.
#[must_use]
pub fn mixed_offers(publishers: &[Endpoint<'_>]) -> String {
    let some = |offers: &dyn Fn(&Endpoint<'_>) -> bool| {
        let count = publishers.iter().filter(|one| offers(one)).count();
        count > 0 && count < publishers.len()
    };
    let mut text = String::new();
    let mut warn = |is_mixed: bool, kind: &str, offered: &str, used: &str| {
        if is_mixed {
            text.push_str(&format!(
                "Some, but not all, publishers are offering {kind}.{offered}. Falling back to \
                 {kind}.{used} as it will connect to all publishers\n"
            ));
        }
    };
    warn(
        some(&|one| one.qos.reliability == "RELIABLE"),
        "QoSReliabilityPolicy",
        "RELIABLE",
        "BEST_EFFORT",
    );
    warn(
        some(&|one| one.qos.durability == "TRANSIENT_LOCAL"),
        "QoSDurabilityPolicy",
        "TRANSIENT_LOCAL",
        "VOLATILE",
    );
    text
}

/// Neither middleware numbers what it receives: the original prints `null`.
fn info_document(sample: &Sample) -> String {
    let Sample {
        sequence_number,
        time_ns,
        source_timestamp_ns,
        ..
    } = sample;
    format!(
        "publication_sequence_number: {sequence_number}\nreceived_timestamp: {time_ns}\n\
         reception_sequence_number: null\nsource_timestamp: {}\n",
        source_timestamp_ns.unwrap_or(0)
    )
}

fn info_in_line(sample: &Sample) -> String {
    format!(
        "{},{},{},None,",
        sample.source_timestamp_ns.unwrap_or(0),
        sample.time_ns,
        sample.sequence_number
    )
}

fn info_around(sample: &Sample) -> String {
    format!(
        "---Got new message, message info:---\n{{'source_timestamp': {}, 'received_timestamp': {}, \
         'publication_sequence_number': {}, 'reception_sequence_number': None}}\n\
         ---Message data:---\n",
        sample.source_timestamp_ns.unwrap_or(0),
        sample.time_ns,
        sample.sequence_number
    )
}

/// The first number of an event is its kind, which is printed as its name.
fn with_name_of_event(document: String) -> String {
    for (number, name) in EVENTS.iter().enumerate() {
        let start = format!("info:\n  event_type: {number}\n");
        if let Some(rest) = document.strip_prefix(&start) {
            return format!("info:\n  event_type: {name}\n{rest}");
        }
    }
    document
}

impl Selected<'_> {
    fn subject(&self) -> Subject<'_> {
        match self {
            Self::Message(message) => Subject::Message(message),
            Self::Value(value) => Subject::Value(value),
            Self::Element(value) => Subject::Value(value),
        }
    }

    fn value(&self) -> Option<&Value<'_>> {
        match self {
            Self::Message(_) => None,
            Self::Value(value) => Some(value),
            Self::Element(value) => Some(value),
        }
    }
}

#[cfg(test)]
mod tests;
