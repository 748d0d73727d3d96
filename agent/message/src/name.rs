//! Types' names: `sensor_msgs/msg/Imu`.
//!
//! Their parts are identifiers, so they can be names of files and stand in any text.

use std::fmt;
use std::str::FromStr;
use std::sync::Arc;

/// How long a package's or a type's name may be: both are names of files.
const MAX_NAME: usize = 200;

/// What kind of file a type is defined in.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Kind {
    /// An `.action` file.
    Action,
    /// A `.msg` file.
    Message,
    /// A `.srv` file.
    Service,
}

impl Kind {
    /// As it stands in a type's name; also the file's extension and its directory.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Action => "action",
            Self::Message => "msg",
            Self::Service => "srv",
        }
    }
}

/// A type's full name: `sensor_msgs/msg/Imu`. Ordered as its text is.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct TypeName {
    package: Arc<str>,
    kind: Kind,
    name: Arc<str>,
}

/// Why a text is no type's name.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("not a type's name: it has to look like std_msgs/msg/String")]
pub struct NotATypeName;

impl TypeName {
    /// From its parts, which have to be identifiers.
    pub fn new(package: &str, kind: Kind, name: &str) -> Result<Self, NotATypeName> {
        if !is_identifier(package) || !is_identifier(name) {
            return Err(NotATypeName);
        }
        Ok(Self {
            package: package.into(),
            kind,
            name: name.into(),
        })
    }

    /// A message that this program itself names.
    pub(super) fn message(package: &'static str, name: &'static str) -> Self {
        Self {
            package: package.into(),
            kind: Kind::Message,
            name: name.into(),
        }
    }

    /// `sensor_msgs`.
    pub fn package(&self) -> &str {
        &self.package
    }

    /// What kind of file it is defined in.
    pub fn kind(&self) -> Kind {
        self.kind
    }

    /// `Imu`.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Another type of the same file: this one's name and an ending.
    pub(super) fn with_suffix(&self, suffix: &str) -> Self {
        Self {
            package: self.package.clone(),
            kind: self.kind,
            name: format!("{}{suffix}", self.name).into(),
        }
    }

    /// The types whose file may define this one: its own, and those whose name with one of the
    /// endings that services and actions have gives this name.
    pub(super) fn files(&self) -> Vec<Self> {
        const SERVICE: [&str; 3] = ["_Request", "_Response", "_Event"];
        const ACTION: [&str; 12] = [
            "_SendGoal_Request",
            "_SendGoal_Response",
            "_SendGoal_Event",
            "_GetResult_Request",
            "_GetResult_Response",
            "_GetResult_Event",
            "_SendGoal",
            "_GetResult",
            "_FeedbackMessage",
            "_Goal",
            "_Result",
            "_Feedback",
        ];
        let endings: &[&str] = match self.kind {
            Kind::Message => &[],
            Kind::Service => &SERVICE,
            Kind::Action => &ACTION,
        };
        let mut found = vec![self.clone()];
        for ending in endings {
            if let Some(name) = self.name.strip_suffix(ending)
                && !name.is_empty()
            {
                found.push(Self {
                    name: name.into(),
                    ..self.clone()
                });
                break;
            }
        }
        found
    }
}

impl FromStr for TypeName {
    type Err = NotATypeName;

    fn from_str(text: &str) -> Result<Self, NotATypeName> {
        let mut parts = text.split('/');
        let (Some(package), Some(kind), Some(name), None) =
            (parts.next(), parts.next(), parts.next(), parts.next())
        else {
            return Err(NotATypeName);
        };
        let kind = match kind {
            "action" => Kind::Action,
            "msg" => Kind::Message,
            "srv" => Kind::Service,
            _ => return Err(NotATypeName),
        };
        Self::new(package, kind, name)
    }
}

impl fmt::Display for TypeName {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            formatter,
            "{}/{}/{}",
            self.package,
            self.kind.as_str(),
            self.name
        )
    }
}

/// Whether a name of a package, type or field can be this.
pub(super) fn is_identifier(text: &str) -> bool {
    text.len() <= MAX_NAME
        && text.starts_with(|first: char| first.is_ascii_alphabetic())
        && text
            .bytes()
            .all(|byte| byte.is_ascii_alphanumeric() || byte == b'_')
}

#[cfg(test)]
mod tests {
    use super::*;

    fn name(text: &str) -> TypeName {
        text.parse().unwrap()
    }

    #[test]
    fn names_are_three_identifiers() {
        for text in [
            "std_msgs/msg/String",
            "a/srv/B_Request",
            "a/action/B_FeedbackMessage",
        ] {
            assert_eq!(name(text).to_string(), text);
        }
        for text in [
            "",
            "String",
            "std_msgs/String",
            "std_msgs/msg/",
            "/msg/A",
            "a/msg/B/c",
            "a/idl/B",
            "../msg/B",
            "a/msg/../../etc",
            "a/msg/B.C",
            "a/msg/1",
            "a/msg/Ä",
        ] {
            assert_eq!(text.parse::<TypeName>(), Err(NotATypeName), "{text}");
        }
        assert!(
            format!("a/msg/B{}", "b".repeat(MAX_NAME))
                .parse::<TypeName>()
                .is_err()
        );
    }

    #[test]
    fn names_are_ordered_as_their_text_is() {
        let texts = [
            "a/action/Z",
            "a/msg/B",
            "a/msg/B_Event",
            "a/srv/A",
            "ab/msg/A",
            "a_b/msg/A",
        ];
        let mut names = texts.map(name);
        let mut sorted = texts;
        names.sort();
        sorted.sort_unstable();
        assert_eq!(names.map(|name| name.to_string()), sorted);
    }
}
