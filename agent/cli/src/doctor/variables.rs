//! ROS settings in the variables of a shell or a process: domain, implementation and discovery
//! range.
//!
//! Only the variables named here are ever shown. Variables of DDS security are paths and switches;
//! the files that they name are not opened.

use std::collections::BTreeMap;

/// Maximum length of a shown value, in characters.
const MAX_VALUE: usize = 120;

/// A value of `ROS_DOMAIN_ID` that is not a valid domain, truncated to [`MAX_VALUE`].
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
#[error("`{0}` is not a domain ID")]
pub struct InvalidDomain(String);

/// Variables that affect the communication of ROS.
const VARIABLE_NAMES: [&str; 21] = [
    "ROS_DISTRO",
    "RMW_IMPLEMENTATION",
    "ROS_DOMAIN_ID",
    "ROS_LOCALHOST_ONLY",
    "ROS_AUTOMATIC_DISCOVERY_RANGE",
    "ROS_STATIC_PEERS",
    "ROS_DISCOVERY_SERVER",
    "ROS_SUPER_CLIENT",
    "ROS2_EASY_MODE",
    "FASTRTPS_DEFAULT_PROFILES_FILE",
    "FASTDDS_DEFAULT_PROFILES_FILE",
    "FASTDDS_BUILTIN_TRANSPORTS",
    "RMW_FASTRTPS_USE_QOS_FROM_XML",
    "CYCLONEDDS_URI",
    "ROS_SECURITY_ENABLE",
    "ROS_SECURITY_STRATEGY",
    "ROS_SECURITY_KEYSTORE",
    "ROS_SECURITY_ENCLAVE_OVERRIDE",
    "ROS_DISABLE_LOANED_MESSAGES",
    "AMENT_PREFIX_PATH",
    "ROS_VERSION",
];

/// ROS variables and their values.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Variables(BTreeMap<&'static str, String>);

/// Discovery range of nodes.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Range {
    /// All hosts reached by multicast; the default.
    Subnet,
    /// Nodes of the same host.
    Localhost,
    /// No discovery.
    Off,
    /// The settings of the RMW implementation.
    System,
    /// An unknown value, which ROS treats as `LOCALHOST`.
    Wrong(String),
}

impl Variables {
    /// Returns the ROS variables of a shell.
    #[must_use]
    pub fn of(environment: &BTreeMap<String, String>) -> Self {
        let known = VARIABLE_NAMES.into_iter().filter_map(|name| {
            let value = environment.get(name).filter(|value| !value.is_empty())?;
            Some((name, value.clone()))
        });
        Self(known.collect())
    }

    /// Parses `/proc/<pid>/environ`.
    #[must_use]
    pub fn parse(bytes: &[u8]) -> Self {
        let mut known = BTreeMap::new();
        for variable in bytes.split(|byte| *byte == 0) {
            let text = String::from_utf8_lossy(variable);
            let Some((name, value)) = text.split_once('=') else {
                continue;
            };
            if let Some(name) = VARIABLE_NAMES.into_iter().find(|known| *known == name)
                && !value.is_empty()
            {
                // Of several values of one variable, getenv(3) returns the first.
                known.entry(name).or_insert_with(|| value.to_owned());
            }
        }
        Self(known)
    }

    /// Returns the value of a variable; `None` if it is unset.
    #[must_use]
    pub fn get(&self, name: &str) -> Option<&str> {
        self.0.get(name).map(String::as_str)
    }

    /// Returns the value of a variable, truncated to [`MAX_VALUE`]; `None` if it is unset.
    #[must_use]
    pub fn shown(&self, name: &str) -> Option<String> {
        let value = self.get(name)?;
        Some(match value.char_indices().nth(MAX_VALUE) {
            Some((end, _)) => format!("{}...", value.get(..end).unwrap_or_default()),
            None => value.to_owned(),
        })
    }

    /// Returns whether a ROS environment is set up.
    #[must_use]
    pub fn is_ros(&self) -> bool {
        self.0.keys().any(|name| *name != "CYCLONEDDS_URI")
    }

    /// Returns the domain of the environment.
    ///
    /// # Errors
    ///
    /// Fails if the value of `ROS_DOMAIN_ID` is not a valid domain.
    pub fn domain(&self) -> Result<u32, InvalidDomain> {
        let Some(text) = self.get("ROS_DOMAIN_ID") else {
            return Ok(0);
        };
        let number = text.trim().parse().ok();
        let number = number.filter(|number| *number <= ros2probe_api::MAX_DOMAIN_ID);
        number.ok_or_else(|| InvalidDomain(self.shown("ROS_DOMAIN_ID").unwrap_or_default()))
    }

    /// Returns whether `ROS_LOCALHOST_ONLY` restricts discovery to this host, as rcl reads it.
    #[must_use]
    pub fn is_localhost_only(&self) -> bool {
        self.get("ROS_LOCALHOST_ONLY") == Some("1")
    }

    /// Returns the discovery range.
    #[must_use]
    pub fn range(&self) -> Range {
        if self.is_localhost_only() {
            return Range::Localhost;
        }
        match self.get("ROS_AUTOMATIC_DISCOVERY_RANGE") {
            None | Some("SUBNET" | "NOT_SET") => Range::Subnet,
            Some("LOCALHOST") => Range::Localhost,
            Some("OFF") => Range::Off,
            Some("SYSTEM_DEFAULT") => Range::System,
            Some(_) => Range::Wrong(
                self.shown("ROS_AUTOMATIC_DISCOVERY_RANGE")
                    .unwrap_or_default(),
            ),
        }
    }

    /// Returns whether DDS security is enabled.
    #[must_use]
    pub fn is_secured(&self) -> bool {
        self.get("ROS_SECURITY_ENABLE") == Some("true")
    }
}

impl Range {
    /// Returns the range as text.
    #[must_use]
    pub fn words(&self) -> String {
        match self {
            Self::Subnet => "the subnet".to_owned(),
            Self::Localhost => "localhost only".to_owned(),
            Self::Off => "no discovery".to_owned(),
            Self::System => "as the implementation is configured".to_owned(),
            Self::Wrong(value) => format!("`{value}`, treated as localhost only"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn variables(text: &str) -> Variables {
        Variables::parse(text.replace(' ', "\0").as_bytes())
    }

    #[test]
    fn only_known_variables_of_a_process_are_kept() {
        let found = variables(
            "SECRET=x ROS_DOMAIN_ID=7 ROS_DOMAIN_ID=8 ROS_SECURITY_X=pass RMW_IMPLEMENTATION=",
        );
        assert_eq!(found.domain(), Ok(7));
        assert_eq!(found.get("ROS_SECURITY_X"), None);
        assert_eq!(found.get("RMW_IMPLEMENTATION"), None);
        assert_eq!(found.0.len(), 1);
        assert_eq!(
            Variables::parse(b"\xff\xfe\0=\0=x\0ROS_DOMAIN_ID"),
            Variables::default()
        );
    }

    #[test]
    fn a_number_without_ports_is_not_a_domain() {
        assert_eq!(variables("A=b").domain(), Ok(0));
        assert_eq!(variables("ROS_DOMAIN_ID=232").domain(), Ok(232));
        assert_eq!(
            variables("ROS_DOMAIN_ID=233").domain(),
            Err(InvalidDomain("233".to_owned()))
        );
        let invalid = InvalidDomain("-1".to_owned());
        assert_eq!(variables("ROS_DOMAIN_ID=-1").domain(), Err(invalid));
        let long = format!("ROS_DOMAIN_ID={}", "\u{e9}".repeat(500));
        let InvalidDomain(shown) = variables(&long).domain().unwrap_err();
        assert_eq!(shown.chars().count(), MAX_VALUE + 3);
    }

    #[test]
    fn ros_localhost_only_takes_precedence_over_the_discovery_range() {
        for (text, range) in [
            ("", Range::Subnet),
            ("ROS_LOCALHOST_ONLY=0", Range::Subnet),
            (
                "ROS_LOCALHOST_ONLY=1 ROS_AUTOMATIC_DISCOVERY_RANGE=OFF",
                Range::Localhost,
            ),
            ("ROS_AUTOMATIC_DISCOVERY_RANGE=OFF", Range::Off),
            (
                "ROS_AUTOMATIC_DISCOVERY_RANGE=SYSTEM_DEFAULT",
                Range::System,
            ),
            (
                "ROS_AUTOMATIC_DISCOVERY_RANGE=localhost",
                Range::Wrong("localhost".to_owned()),
            ),
        ] {
            assert_eq!(variables(text).range(), range, "{text}");
        }
    }
}
