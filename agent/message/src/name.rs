//! Names of types: `sensor_msgs/msg/Imu`.
//!
//! Their parts are identifiers, so they are valid file names and safe in any text.

use std::fmt;
use std::str::FromStr;
use std::sync::Arc;

/// Maximum length of the name of a package or type, which is also a file name.
const MAX_NAME: usize = 200;

/// Kind of file that defines a type.
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
    /// Returns the kind as in a type's name, which is also the file's extension and directory.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Action => "action",
            Self::Message => "msg",
            Self::Service => "srv",
        }
    }
}

/// Full name of a type: `sensor_msgs/msg/Imu`. Ordered like its text.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct TypeName {
    package: Arc<str>,
    kind: Kind,
    name: Arc<str>,
}

/// The text is not a type's name.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("not a type name such as std_msgs/msg/String")]
pub struct NotATypeName;

impl TypeName {
    /// Combines the parts, which must be identifiers.
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

    /// Creates the name of a message that this crate refers to.
    pub(super) fn message(package: &'static str, name: &'static str) -> Self {
        Self {
            package: package.into(),
            kind: Kind::Message,
            name: name.into(),
        }
    }

    /// Returns the package, such as `sensor_msgs`.
    pub fn package(&self) -> &str {
        &self.package
    }

    /// Returns the kind of file that defines the type.
    pub fn kind(&self) -> Kind {
        self.kind
    }

    /// Returns the name without the package, such as `Imu`.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Returns another type of the same file: this name with a suffix.
    pub(super) fn with_suffix(&self, suffix: &str) -> Self {
        Self {
            package: self.package.clone(),
            kind: self.kind,
            name: format!("{}{suffix}", self.name).into(),
        }
    }

    /// Returns the files that may define this type: its own, and the service and action files whose
    /// name with an implied suffix equals this name.
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

/// Returns whether the text is a valid name of a package, type or field.
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
    fn only_three_identifiers_form_a_name() {
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
    fn names_are_ordered_like_their_text() {
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
