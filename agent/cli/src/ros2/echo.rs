//! Text of `ros2 topic echo`, `ros2 service echo` and `ros2 action echo`.
//!
//! The input is a payload and its type; this module sends no request and reads no clock.

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
use ros2probe_message::{
    Decoded, Limits, MessageType, Scalar, Truncation, Value, csv, decode, python,
};

/// Maximum number of writers whose unreadable messages are counted separately.
const MAX_WRITERS: usize = 256;
/// Event types of `service_msgs/msg/ServiceEventInfo`, in the order of its constants.
const SERVICE_EVENTS: [&str; 4] = [
    "REQUEST_SENT",
    "REQUEST_RECEIVED",
    "RESPONSE_SENT",
    "RESPONSE_RECEIVED",
];

/// Options for printing messages.
#[derive(Clone, Debug)]
pub struct Options {
    /// Dialect of the output.
    pub dialect: Dialect,
    /// Whether values are printed in one line instead of YAML.
    pub csv: bool,
    /// Style of YAML.
    pub style: Style,
    /// Truncation of arrays and strings.
    pub shown: Truncation,
    /// Whether the payload's bytes are printed instead of the message.
    pub raw: bool,
    /// Fields that are printed instead of the whole message.
    pub fields: Vec<FieldPath>,
    /// Filter of the printed messages.
    pub filter: Option<Filter>,
    /// Whether times and sequence numbers are printed before each message.
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

/// Prints messages, and counts unreadable ones.
#[derive(Debug)]
pub struct Echo {
    options: Options,
    unreadable: HashMap<String, u64>,
}

/// Text for one message.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct MessageText {
    /// Text for stdout. `None` if the message did not pass the filter or cannot be read.
    pub out: Option<String>,
    /// Whole lines for stderr.
    pub err: String,
}

impl Echo {
    /// Creates a printer with these options.
    #[must_use]
    pub fn new(options: Options) -> Self {
        Self {
            options,
            unreadable: HashMap::new(),
        }
    }

    /// Returns the text of a message as `topic echo` prints it. With `raw`, no type is needed.
    ///
    /// # Errors
    ///
    /// Fails if a selected field does not exist, or if the filter has no value.
    pub fn message(
        &mut self,
        sample: &Sample,
        message_type: Option<&MessageType>,
        payload: &[u8],
    ) -> Result<MessageText, Refused> {
        if self.options.raw {
            let mut fields = self.options.fields.iter();
            if let Some(refused) = fields.find_map(FieldPath::missing_in_bytes) {
                return Err(refused);
            }
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

    /// Returns the text of a service event as `service echo` prints it. `interface` is the part of
    /// an action that `action echo` prints above it.
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

    /// Returns the number of messages that could not be read.
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
                        "a message has {trailing} bytes after its last field: the node may use \
                         another definition of {name}"
                    )
                });
                (Some(decoded), strange)
            }
            Err(error) => {
                let strange = format!("a message cannot be decoded as {name}: {error}");
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
        // With one field, `m` is that field, as in ros2cli.
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
            Selected::Value(_) | Selected::Element(_) | Selected::NumpyElement(_) => {
                if *include_info {
                    out.push_str(&info_around(sample));
                }
                out.push_str(&part.text());
                out.push('\n');
                if is_last && !(*csv && *dialect == Dialect::Humble) {
                    out.push_str("---\n");
                }
            }
        }
    }
}

/// Returns ros2cli's warning on stdout about publishers with different QoS.
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

/// Returns times and sequence numbers. The middleware provides no reception number, so ros2cli
/// prints `null`.
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

/// Replaces the first number of an event, its type, by the type's name.
fn with_name_of_event(document: String) -> String {
    for (number, name) in SERVICE_EVENTS.iter().enumerate() {
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
            Self::Element(value) | Self::NumpyElement(value) => Subject::Value(value),
        }
    }

    /// Returns `str()` of a part that is not a message.
    fn text(&self) -> String {
        match self {
            Self::Message(_) => String::new(),
            Self::NumpyElement(Value::Scalar(Scalar::Float32(number))) => python::float32(*number),
            Self::Value(value) => python::str(value),
            Self::Element(value) | Self::NumpyElement(value) => python::str(value),
        }
    }
}

#[cfg(test)]
mod tests;
