//! Messages as YAML, byte for byte as PyYAML's `dump` prints the output of `rosidl_runtime_py`.
//!
//! Writes only that subset of YAML: block or flow style, keys in the order of the definition, lines
//! never wrapped, non-ASCII characters unescaped. It parses nothing.

use std::fmt::Write as _;
use std::sync::LazyLock;

use regex::Regex;

use crate::python;
use crate::truncation::Truncation;
use crate::value::{Array, Items, Message, Scalar, Value};

/// Spaces per level.
const INDENT_STEP: usize = 2;
/// Characters that end a line in YAML 1.1.
const LINE_BREAKS: [char; 4] = ['\n', '\u{85}', '\u{2028}', '\u{2029}'];

/// Style of sequences. Mappings outside of sequences are always in block style: PyYAML has no style
/// for the ordered mappings that represent messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Style {
    /// One line per value.
    Block,
    /// Each sequence in one line, including its mappings.
    Flow,
}

/// Returns the whole document with a final line break.
pub fn document(message: &Message<'_>, shown: &Truncation, style: Style) -> String {
    let mut writer = Writer {
        text: String::new(),
        shown,
        style,
        is_in_flow: false,
    };
    if message.values.is_empty() {
        writer.text.push_str("{}\n");
    } else {
        writer.block(message, 0, false);
    }
    writer.text
}

struct Writer<'a> {
    text: String,
    shown: &'a Truncation,
    style: Style,
    /// Whether the writer is in a sequence in flow style, where fewer strings are plain.
    is_in_flow: bool,
}

impl Writer<'_> {
    /// Writes key by key; in a sequence, the first key follows a dash.
    fn block(&mut self, message: &Message<'_>, indent: usize, behind_dash: bool) {
        for (index, (field, value)) in message.fields().enumerate() {
            if index > 0 || !behind_dash {
                self.indent(indent);
            }
            self.string(&field.name, indent + INDENT_STEP);
            self.text.push(':');
            match value {
                Value::Message(inner) if !inner.values.is_empty() => {
                    self.text.push('\n');
                    self.block(inner, indent + INDENT_STEP, false);
                }
                Value::Array(array)
                    if array.length > 0 && !self.shown.no_arrays && self.style == Style::Block =>
                {
                    self.text.push('\n');
                    self.block_sequence(array, indent);
                }
                _ => {
                    self.text.push(' ');
                    self.inline(value, indent + INDENT_STEP);
                    self.text.push('\n');
                }
            }
        }
    }

    fn block_sequence(&mut self, array: &Array<'_>, indent: usize) {
        let (count, cut) = self.shown.elements(array.length);
        let dash = |writer: &mut Self| {
            writer.indent(indent);
            writer.text.push_str("- ");
        };
        match &array.items {
            Items::Messages(messages) => {
                for message in messages.iter().take(count) {
                    dash(self);
                    if message.values.is_empty() {
                        self.text.push_str("{}\n");
                    } else {
                        self.block(message, indent + INDENT_STEP, true);
                    }
                }
            }
            Items::Texts(texts) => {
                for text in texts.iter().take(count) {
                    dash(self);
                    self.shown_string(text, indent + INDENT_STEP);
                    self.text.push('\n');
                }
            }
            Items::Scalars(scalars) => {
                for value in scalars.iter().take(count) {
                    dash(self);
                    self.scalar(value, indent + INDENT_STEP);
                    self.text.push('\n');
                }
            }
        }
        if cut {
            dash(self);
            self.string("...", indent + INDENT_STEP);
            self.text.push('\n');
        }
    }

    fn flow(&mut self, message: &Message<'_>, indent: usize) {
        self.text.push('{');
        for (index, (field, value)) in message.fields().enumerate() {
            if index > 0 {
                self.text.push_str(", ");
            }
            self.string(&field.name, indent + INDENT_STEP);
            self.text.push_str(": ");
            self.inline(value, indent + INDENT_STEP);
        }
        self.text.push('}');
    }

    fn flow_sequence(&mut self, array: &Array<'_>, indent: usize) {
        let (count, cut) = self.shown.elements(array.length);
        let outside = std::mem::replace(&mut self.is_in_flow, true);
        self.text.push('[');
        let mut first = true;
        let mut separate = |writer: &mut Self| {
            if !std::mem::replace(&mut first, false) {
                writer.text.push_str(", ");
            }
        };
        match &array.items {
            Items::Messages(messages) => {
                for message in messages.iter().take(count) {
                    separate(self);
                    self.flow(message, indent + INDENT_STEP);
                }
            }
            Items::Texts(texts) => {
                for text in texts.iter().take(count) {
                    separate(self);
                    self.shown_string(text, indent + INDENT_STEP);
                }
            }
            Items::Scalars(scalars) => {
                for value in scalars.iter().take(count) {
                    separate(self);
                    self.scalar(value, indent + INDENT_STEP);
                }
            }
        }
        if cut {
            separate(self);
            self.string("...", indent + INDENT_STEP);
        }
        self.text.push(']');
        self.is_in_flow = outside;
    }

    /// Writes a value on the line of its key or dash.
    fn inline(&mut self, value: &Value<'_>, indent: usize) {
        match value {
            Value::Scalar(value) => self.scalar(*value, indent),
            Value::Text(text) => self.shown_string(text, indent),
            Value::Message(message) => self.flow(message, indent),
            Value::Array(array) => match self.shown.array(array) {
                Some(words) => self.string(&words, indent),
                None => self.flow_sequence(array, indent),
            },
        }
    }

    fn indent(&mut self, indent: usize) {
        self.text.extend(std::iter::repeat_n(' ', indent));
    }

    fn scalar(&mut self, value: Scalar, indent: usize) {
        let number = match value {
            Scalar::Bool(value) => return self.text.push_str(if value { "true" } else { "false" }),
            Scalar::Byte(byte) => {
                let shown = if self.shown.truncate == Some(0) {
                    "...".to_owned()
                } else {
                    char::from(byte).to_string()
                };
                return self.string(&shown, indent);
            }
            Scalar::Int(number) => return self.text.push_str(&number.to_string()),
            Scalar::UInt(number) => return self.text.push_str(&number.to_string()),
            Scalar::Float32(number) => f64::from(number),
            Scalar::Float64(number) => number,
        };
        self.text.push_str(&float(number));
    }

    fn shown_string(&mut self, text: &str, indent: usize) {
        match self.shown.text(text) {
            Some(shown) => self.string(&shown, indent),
            None => self.string(text, indent),
        }
    }

    /// Writes a string in the plainest form that reads back as the same string.
    fn string(&mut self, text: &str, indent: usize) {
        let forms = Forms::of(text);
        let plain = if self.is_in_flow {
            forms.flow_plain
        } else {
            forms.block_plain
        };
        if plain && !text.is_empty() && !is_other_type(text) {
            self.text.push_str(text);
        } else if forms.single_quoted {
            self.single_quoted(text, indent);
        } else {
            self.double_quoted(text);
        }
    }

    /// Writes a single-quoted string. Line breaks are doubled: a single one would read back as a
    /// space.
    fn single_quoted(&mut self, text: &str, indent: usize) {
        self.text.push('\'');
        let mut in_breaks = false;
        for character in text.chars() {
            if LINE_BREAKS.contains(&character) {
                if !in_breaks && character == '\n' {
                    self.text.push('\n');
                }
                self.text.push(character);
            } else {
                if in_breaks {
                    self.indent(indent);
                }
                self.text.push(character);
                if character == '\'' {
                    self.text.push('\'');
                }
            }
            in_breaks = LINE_BREAKS.contains(&character);
        }
        if in_breaks {
            self.indent(indent);
        }
        self.text.push('\'');
    }

    fn double_quoted(&mut self, text: &str) {
        self.text.push('"');
        for character in text.chars() {
            let code = u32::from(character);
            let escape = match character {
                '\0' => '0',
                '\u{7}' => 'a',
                '\u{8}' => 'b',
                '\t' => 't',
                '\n' => 'n',
                '\u{b}' => 'v',
                '\u{c}' => 'f',
                '\r' => 'r',
                '\u{1b}' => 'e',
                '"' => '"',
                '\\' => '\\',
                '\u{85}' => 'N',
                '\u{2028}' => 'L',
                '\u{2029}' => 'P',
                ' '..='~' => {
                    self.text.push(character);
                    continue;
                }
                '\u{feff}' => {
                    self.text.push_str("\\uFEFF");
                    continue;
                }
                '\u{a0}'..='\u{d7ff}' | '\u{e000}'..='\u{fffd}' => {
                    self.text.push(character);
                    continue;
                }
                _ => {
                    let _ = match code {
                        0..=0xff => write!(self.text, "\\x{code:02X}"),
                        0x100..=0xffff => write!(self.text, "\\u{code:04X}"),
                        _ => write!(self.text, "\\U{code:08X}"),
                    };
                    continue;
                }
            };
            self.text.push('\\');
            self.text.push(escape);
        }
        self.text.push('"');
    }
}

/// Returns a float in YAML 1.1: with a point, also before an exponent.
fn float(number: f64) -> String {
    if number.is_nan() {
        return ".nan".to_owned();
    }
    if number.is_infinite() {
        return if number > 0.0 { ".inf" } else { "-.inf" }.to_owned();
    }
    let text = python::float(number);
    if text.contains('.') {
        text
    } else {
        text.replacen('e', ".0e", 1)
    }
}

/// Returns whether the plain text would be read as a number, boolean, null or time.
fn is_other_type(text: &str) -> bool {
    static OTHER_TYPE_PATTERN: LazyLock<Option<Regex>> = LazyLock::new(|| {
        let float =
            r"[-+]?[0-9][0-9_]*\.[0-9_]*(?:[eE][-+][0-9]+)?|\.[0-9][0-9_]*(?:[eE][-+][0-9]+)?";
        let other_float =
            r"[-+]?[0-9][0-9_]*(?::[0-5]?[0-9])+\.[0-9_]*|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)";
        let integer = r"[-+]?0b[0-1_]+|[-+]?0[0-7_]+|[-+]?(?:0|[1-9][0-9_]*)|[-+]?0x[0-9a-fA-F_]+|[-+]?[1-9][0-9_]*(?::[0-5]?[0-9])+";
        let time = r"[0-9]{4}-[0-9]{2}-[0-9]{2}|[0-9]{4}-[0-9][0-9]?-[0-9][0-9]?(?:[Tt]|[ \t]+)[0-9][0-9]?:[0-9]{2}:[0-9]{2}(?:\.[0-9]*)?(?:[ \t]*(?:Z|[-+][0-9][0-9]?(?::[0-9]{2})?))?";
        Regex::new(&format!("^(?:{float}|{other_float}|{integer}|{time})$")).ok()
    });
    match text.as_bytes().first() {
        Some(b'0'..=b'9' | b'-' | b'+' | b'.') => OTHER_TYPE_PATTERN
            .as_ref()
            .is_none_or(|regex| regex.is_match(text)),
        Some(b'y' | b'Y' | b'n' | b'N' | b't' | b'T' | b'f' | b'F' | b'o' | b'O') => {
            let lower = text.to_ascii_lowercase();
            let word =
                ["yes", "no", "true", "false", "on", "off", "null"].contains(&lower.as_str());
            let (first, rest) = text.split_at_checked(1).unwrap_or((text, ""));
            let upper = |part: &str| part.bytes().all(|byte| byte.is_ascii_uppercase());
            word && (text == lower
                || (upper(first) && (rest == lower.get(1..).unwrap_or_default() || upper(rest))))
        }
        Some(b'~' | b'=') => text.len() == 1,
        Some(b'<') => text == "<<",
        _ => false,
    }
}

/// The styles in which a string can be written.
struct Forms {
    block_plain: bool,
    flow_plain: bool,
    single_quoted: bool,
}

impl Forms {
    /// Follows PyYAML's `analyze_scalar`.
    fn of(text: &str) -> Self {
        let blank = |character: Option<&char>| {
            character.is_none_or(|character| {
                matches!(character, '\0' | ' ' | '\t' | '\r') || LINE_BREAKS.contains(character)
            })
        };
        let document = text.starts_with("---") || text.starts_with("...");
        let (mut block, mut flow) = (document, document);
        let (mut broken, mut special) = (false, false);
        let (mut space_break, mut break_space) = (false, false);
        let mut previous = None;
        let mut characters = text.chars().peekable();
        while let Some(character) = characters.next() {
            let blank_follows = blank(characters.peek());
            match (character, previous) {
                (
                    '#' | ',' | '[' | ']' | '{' | '}' | '&' | '*' | '!' | '|' | '>' | '\'' | '"'
                    | '%' | '@' | '`',
                    None,
                ) => (block, flow) = (true, true),
                ('?' | ':', None) => (block, flow) = (block | blank_follows, true),
                ('-', None) if blank_follows => (block, flow) = (true, true),
                (',' | '?' | '[' | ']' | '{' | '}', Some(_)) => flow = true,
                (':', Some(_)) => (block, flow) = (block | blank_follows, true),
                ('#', Some(_)) if blank(previous.as_ref()) => (block, flow) = (true, true),
                _ => {}
            }
            broken |= LINE_BREAKS.contains(&character);
            special |= !matches!(
                character,
                '\n' | ' '..='~' | '\u{85}' | '\u{a0}'..='\u{d7ff}' | '\u{e000}'..='\u{fefe}'
                    | '\u{ff00}'..='\u{fffd}' | '\u{10000}'..='\u{10fffe}'
            );
            let after_break = previous.is_some_and(|previous| LINE_BREAKS.contains(&previous));
            break_space |= character == ' ' && after_break;
            space_break |= LINE_BREAKS.contains(&character) && previous == Some(' ');
            previous = Some(character);
        }
        let edge = |character: Option<char>| {
            character.is_some_and(|character| character == ' ' || LINE_BREAKS.contains(&character))
        };
        let edges = edge(text.chars().next()) || edge(previous);
        let only_double = special || space_break;
        let plain = !edges && !break_space && !only_double && !broken;
        Self {
            block_plain: plain && !block,
            flow_plain: plain && !flow,
            single_quoted: !break_space && !only_double,
        }
    }
}
