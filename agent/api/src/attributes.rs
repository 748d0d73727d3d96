//! Names and values whose set depends on the event or finding that they describe.

use std::borrow::Cow;
use std::fmt;

use serde::de::{IgnoredAny, MapAccess, Visitor};
use serde::ser::SerializeMap as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// Attributes in the order of the answer.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Attributes<'a>(pub Vec<(Cow<'a, str>, Value<'a>)>);

/// The value of an attribute.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Value<'a> {
    /// Text.
    Text(Cow<'a, str>),
    /// An unsigned integer, such as a count.
    Number(u64),
    /// A floating-point number, such as a rate in hertz.
    Real(f64),
    /// A list of texts.
    List(Vec<Cow<'a, str>>),
    /// A value of a type that this version does not know.
    #[serde(skip_serializing)]
    Unknown(IgnoredAny),
}

impl<'a> Attributes<'a> {
    /// Returns the value of the attribute of this name, or `None` if it is missing.
    #[must_use]
    pub fn get(&self, name: &str) -> Option<&Value<'a>> {
        let mut attributes = self.0.iter();
        attributes.find_map(|(key, value)| (*key == name).then_some(value))
    }
}

impl Serialize for Attributes<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut map = serializer.serialize_map(Some(self.0.len()))?;
        for (name, value) in &self.0 {
            map.serialize_entry(name, value)?;
        }
        map.end()
    }
}

impl<'de> Deserialize<'de> for Attributes<'_> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_map(Entries).map(Self)
    }
}

struct Entries;

impl<'de> Visitor<'de> for Entries {
    type Value = Vec<(Cow<'static, str>, Value<'static>)>;

    fn expecting(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("an object")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Self::Value, A::Error> {
        let mut entries = Vec::new();
        while let Some(entry) = map.next_entry()? {
            entries.push(entry);
        }
        Ok(entries)
    }
}
