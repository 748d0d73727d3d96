//! Parser of XML-RPC requests with scalar arguments, the only requests that `ros2` sends.
//!
//! The bytes come from any process of this host. Attributes, comments, CDATA, document types, and
//! values other than texts, booleans, integers and nil are refused. The caller bounds the length.

use quick_xml::Reader;
use quick_xml::escape::resolve_predefined_entity;
use quick_xml::events::Event;

/// Maximum number of arguments of a call; no function has more than three.
const MAX_ARGUMENTS: usize = 8;

/// A request.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Call {
    /// Name of the function.
    pub method: String,
    /// Positional arguments.
    pub arguments: Vec<Argument>,
}

/// An argument.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Argument {
    /// `string`.
    Text(String),
    /// `boolean`.
    Boolean(bool),
    /// `int` or `i4`.
    Integer(i32),
    /// `nil`.
    Nil,
}

/// Why a request cannot be read.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Malformed {
    /// The bytes are not UTF-8.
    #[error("the request is not UTF-8")]
    Encoding,
    /// The bytes are not XML, or use parts of XML that XML-RPC does not need.
    #[error("the request is not well-formed XML")]
    Xml,
    /// The elements are not the elements of a call.
    #[error("the request is not a methodCall")]
    Shape,
    /// An argument has a type other than text, boolean, integer and nil.
    #[error("an argument has an unsupported type")]
    Type,
    /// The value of an argument contradicts its type.
    #[error("an argument does not fit its type")]
    Value,
    /// There are too many arguments.
    #[error("the request has more than 8 arguments")]
    Arguments,
}

/// Parses a request.
///
/// # Errors
///
/// Returns [`Malformed`] unless the bytes are a call with scalar arguments.
pub fn parse(bytes: &[u8]) -> Result<Call, Malformed> {
    let text = std::str::from_utf8(bytes).map_err(|_| Malformed::Encoding)?;
    let mut reader = Reader::from_str(text);
    let config = reader.config_mut();
    config.expand_empty_elements = true;
    config.check_comments = true;
    Elements { reader }.call()
}

/// An element of XML-RPC.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Name {
    Call,
    Method,
    Params,
    Param,
    Value,
    Text,
    Boolean,
    Integer,
    Nil,
    Other,
}

/// The start or end of an element, or the end of the request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Tag {
    Open(Name),
    Close,
    End,
}

struct Elements<'a> {
    reader: Reader<&'a [u8]>,
}

impl Name {
    /// Returns the element of a tag. `content` also contains the attributes of the tag.
    fn of(content: &str) -> Self {
        match content.trim_end() {
            "methodCall" => Self::Call,
            "methodName" => Self::Method,
            "params" => Self::Params,
            "param" => Self::Param,
            "value" => Self::Value,
            "string" => Self::Text,
            "boolean" => Self::Boolean,
            "int" | "i4" => Self::Integer,
            "nil" => Self::Nil,
            _ => Self::Other,
        }
    }
}

impl Elements<'_> {
    fn call(mut self) -> Result<Call, Malformed> {
        self.expect(Tag::Open(Name::Call))?;
        self.expect(Tag::Open(Name::Method))?;
        let method = self.text()?;
        let mut arguments = Vec::new();
        match self.tag()? {
            Tag::Open(Name::Params) => {
                self.arguments(&mut arguments)?;
                self.expect(Tag::Close)?;
            }
            Tag::Close => {}
            _ => return Err(Malformed::Shape),
        }
        self.expect(Tag::End)?;
        Ok(Call { method, arguments })
    }

    /// Reads arguments up to the end of `params`.
    fn arguments(&mut self, arguments: &mut Vec<Argument>) -> Result<(), Malformed> {
        loop {
            match self.tag()? {
                Tag::Close => return Ok(()),
                Tag::Open(Name::Param) if arguments.len() >= MAX_ARGUMENTS => {
                    return Err(Malformed::Arguments);
                }
                Tag::Open(Name::Param) => {}
                _ => return Err(Malformed::Shape),
            }
            self.expect(Tag::Open(Name::Value))?;
            arguments.push(self.value()?);
            self.expect(Tag::Close)?;
        }
    }

    /// Reads a value up to its end. A value without a type is text.
    fn value(&mut self) -> Result<Argument, Malformed> {
        let (before, tag) = self.step()?;
        let Tag::Open(name) = tag else {
            return match tag {
                Tag::Close => Ok(Argument::Text(before)),
                _ => Err(Malformed::Shape),
            };
        };
        if !before.trim().is_empty() {
            return Err(Malformed::Shape);
        }
        let content = match name {
            Name::Text | Name::Boolean | Name::Integer | Name::Nil => self.text()?,
            _ => return Err(Malformed::Type),
        };
        let scalar = content.trim();
        let argument = match name {
            Name::Boolean => match scalar {
                "0" => Argument::Boolean(false),
                "1" => Argument::Boolean(true),
                _ => return Err(Malformed::Value),
            },
            Name::Integer => Argument::Integer(scalar.parse().map_err(|_| Malformed::Value)?),
            Name::Nil if scalar.is_empty() => Argument::Nil,
            Name::Nil => return Err(Malformed::Value),
            _ => Argument::Text(content),
        };
        self.expect(Tag::Close)?;
        Ok(argument)
    }

    /// Reads the content of an element without children, and its end.
    fn text(&mut self) -> Result<String, Malformed> {
        match self.step()? {
            (text, Tag::Close) => Ok(text),
            _ => Err(Malformed::Shape),
        }
    }

    fn expect(&mut self, wanted: Tag) -> Result<(), Malformed> {
        match self.tag()? {
            tag if tag == wanted => Ok(()),
            _ => Err(Malformed::Shape),
        }
    }

    /// Returns the next tag, before which only white space is allowed.
    fn tag(&mut self) -> Result<Tag, Malformed> {
        match self.step()? {
            (text, tag) if text.trim().is_empty() => Ok(tag),
            _ => Err(Malformed::Shape),
        }
    }

    /// Returns the text up to the next tag, and that tag.
    fn step(&mut self) -> Result<(String, Tag), Malformed> {
        let mut text = String::new();
        loop {
            let tag = match self.reader.read_event().map_err(|_| Malformed::Xml)? {
                Event::Start(start) => Tag::Open(Name::of(&start)),
                Event::End(_) => Tag::Close,
                Event::Eof => Tag::End,
                Event::Text(part) => {
                    text.push_str(&part.xml10_content());
                    continue;
                }
                Event::GeneralRef(reference) => {
                    match reference.resolve_char_ref().map_err(|_| Malformed::Xml)? {
                        Some(character) => text.push(character),
                        None => text
                            .push_str(resolve_predefined_entity(&reference).ok_or(Malformed::Xml)?),
                    }
                    continue;
                }
                Event::Decl(_) if self.reader.buffer_position() <= MAX_DECLARATION => continue,
                _ => return Err(Malformed::Xml),
            };
            return Ok((text, tag));
        }
    }
}

/// Maximum position of the end of the XML declaration, in bytes.
const MAX_DECLARATION: u64 = 100;

#[cfg(test)]
mod tests {
    use super::*;

    /// A request as Python's `xmlrpc.client` writes it.
    fn call(method: &str, arguments: &[&str]) -> String {
        let params = arguments.iter();
        let params: String = params
            .map(|argument| format!("<param>\n<value>{argument}</value>\n</param>\n"))
            .collect();
        format!(
            "<?xml version='1.0'?>\n<methodCall>\n<methodName>{method}</methodName>\n\
             <params>\n{params}</params>\n</methodCall>\n"
        )
    }

    fn read(text: &str) -> Result<Call, Malformed> {
        parse(text.as_bytes())
    }

    #[test]
    fn a_request_of_the_ros2_command_line_is_parsed() {
        let none = read(&call("system.listMethods", &[])).unwrap();
        assert_eq!(none.method, "system.listMethods");
        assert_eq!(none.arguments, []);
        let one = read(&call("count_publishers", &["<string>/chatter</string>"])).unwrap();
        assert_eq!(one.arguments, [Argument::Text("/chatter".to_owned())]);
        let all = [
            "<boolean>1</boolean>",
            "<int>-7</int>",
            "<nil/>",
            "<string></string>",
            "plain",
            "<string>&lt;a&gt; &amp; &#65;</string>",
        ];
        let text = |text: &str| Argument::Text(text.to_owned());
        assert_eq!(
            read(&call("f", &all)).unwrap().arguments,
            [
                Argument::Boolean(true),
                Argument::Integer(-7),
                Argument::Nil,
                text(""),
                text("plain"),
                text("<a> & A"),
            ]
        );
        let short = "<methodCall><methodName>f</methodName></methodCall>";
        assert_eq!(read(short).unwrap().arguments, []);
    }

    #[test]
    fn a_request_other_than_a_call_with_scalars_is_refused() {
        let value = |value: &str| read(&call("f", &[value]));
        assert_eq!(value("<array><data></data></array>"), Err(Malformed::Type));
        assert_eq!(value("<struct></struct>"), Err(Malformed::Type));
        assert_eq!(value("<int>x</int>"), Err(Malformed::Value));
        assert_eq!(value("<int>4294967296</int>"), Err(Malformed::Value));
        assert_eq!(value("<boolean>2</boolean>"), Err(Malformed::Value));
        assert_eq!(value("<nil>x</nil>"), Err(Malformed::Value));
        assert_eq!(value("a<int>1</int>"), Err(Malformed::Shape));
        assert_eq!(value("<int>1</int><int>1</int>"), Err(Malformed::Shape));
        assert_eq!(value("<string a='b'>x</string>"), Err(Malformed::Type));
        assert_eq!(value("<string><![CDATA[x]]></string>"), Err(Malformed::Xml));
        assert_eq!(value("<string>&external;</string>"), Err(Malformed::Xml));
        assert_eq!(value("<string>x</int>"), Err(Malformed::Xml));
        assert_eq!(read("<!DOCTYPE a [<!ENTITY b 'c'>]>"), Err(Malformed::Xml));
        assert_eq!(read("<!-- a --><methodCall/>"), Err(Malformed::Xml));
        assert_eq!(read("<methodCall/>"), Err(Malformed::Shape));
        assert_eq!(read("<methodResponse/>"), Err(Malformed::Shape));
        assert_eq!(read(""), Err(Malformed::Shape));
        let twice = call("f", &[]).repeat(2);
        assert!(read(&twice).is_err());
        assert_eq!(parse(b"\xff"), Err(Malformed::Encoding));
        let whole = call("f", &["<string>/chatter</string>"]);
        for length in 0..whole.trim_end().len() {
            assert!(read(&whole[..length]).is_err(), "{length}");
        }
    }

    #[test]
    fn a_request_with_arguments_beyond_the_cap_is_refused() {
        let most = vec!["<int>1</int>"; MAX_ARGUMENTS];
        assert_eq!(read(&call("f", &most)).unwrap().arguments.len(), 8);
        let more = vec!["<int>1</int>"; MAX_ARGUMENTS + 1];
        assert_eq!(read(&call("f", &more)), Err(Malformed::Arguments));
    }
}
