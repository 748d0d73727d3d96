//! The resource: attributes that all points, records and spans of this agent share.

use std::collections::BTreeMap;
use std::fs;

use opentelemetry_proto::tonic::resource::v1::Resource;

use super::points::attribute;
use ros2probe_model::identity::Identity;

/// Identity of a host, from its operating system.
#[derive(Clone, Debug, Default)]
pub struct Host {
    /// Network name.
    pub name: Option<String>,
    /// Machine id, which does not change with the name.
    pub id: Option<String>,
}

impl Host {
    /// Reads the identity of this host.
    #[must_use]
    pub fn read() -> Self {
        let line = |path: &str| {
            let text = fs::read_to_string(path).ok()?;
            let text = text.trim();
            (!text.is_empty()).then(|| text.to_owned())
        };
        Self {
            name: line("/proc/sys/kernel/hostname"),
            id: line("/etc/machine-id").or_else(|| line("/var/lib/dbus/machine-id")),
        }
    }

    /// Returns the agent's identity on this host.
    pub(super) fn bits(&self) -> u128 {
        let mut identity = Identity::of(b"ros2probe service.instance.id");
        for text in [&self.id, &self.name] {
            identity.add(text.as_deref().unwrap_or_default().as_bytes());
        }
        identity.bits()
    }
}

/// Returns the resource for `host`; attributes in `given` are added and take precedence.
pub(super) fn resource(host: &Host, given: &BTreeMap<String, String>) -> Resource {
    let mut attributes = BTreeMap::from([
        ("service.name".to_owned(), "ros2probe".to_owned()),
        (
            "service.version".to_owned(),
            env!("CARGO_PKG_VERSION").to_owned(),
        ),
        ("service.instance.id".to_owned(), instance(host)),
    ]);
    let host = [("host.name", &host.name), ("host.id", &host.id)];
    attributes.extend(
        host.into_iter()
            .filter_map(|(key, value)| Some((key.to_owned(), value.clone()?))),
    );
    attributes.extend(
        given
            .iter()
            .map(|(key, value)| (key.clone(), value.clone())),
    );
    Resource {
        attributes: attributes
            .into_iter()
            .filter(|(_, value)| !value.is_empty())
            .map(|(key, value)| attribute(&key, value))
            .collect(),
        ..Resource::default()
    }
}

/// Returns a UUID (version 8) that survives restarts, so that a robot's series continue. It is
/// derived, because a machine id should not be published.
fn instance(host: &Host) -> String {
    let mut bits = host.bits();
    bits = bits & !(0xf << 76) | 0x8 << 76;
    bits = bits & !(0x3 << 62) | 0x2 << 62;
    let digits = format!("{bits:032x}");
    let part = |range: std::ops::Range<usize>| digits.get(range).unwrap_or_default();
    format!(
        "{}-{}-{}-{}-{}",
        part(0..8),
        part(8..12),
        part(12..16),
        part(16..20),
        part(20..32)
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_instance_is_identified_by_its_host_and_stays_the_same() {
        let host = |id: &str| Host {
            name: Some("robot-7".to_owned()),
            id: Some(id.to_owned()),
        };
        let one = instance(&host("0123456789abcdef0123456789abcdef"));
        assert_eq!(one, instance(&host("0123456789abcdef0123456789abcdef")));
        assert_ne!(one, instance(&host("1123456789abcdef0123456789abcdef")));
        assert!(!one.contains("0123456789abcdef"));
        let parts: Vec<usize> = one.split('-').map(str::len).collect();
        assert_eq!(parts, [8, 4, 4, 4, 12]);
        assert_eq!(one.as_bytes().get(14), Some(&b'8'));
        assert!(matches!(
            one.as_bytes().get(19),
            Some(b'8' | b'9' | b'a' | b'b')
        ));
    }

    #[test]
    fn what_is_given_replaces_what_is_known() {
        let given = BTreeMap::from([
            ("host.name".to_owned(), "R2".to_owned()),
            ("service.instance.id".to_owned(), String::new()),
            ("robot.name".to_owned(), "marvin".to_owned()),
        ]);
        let host = Host {
            name: Some("robot-7".to_owned()),
            id: None,
        };
        assert_eq!(
            resource(&host, &given).attributes,
            [
                attribute("host.name", "R2"),
                attribute("robot.name", "marvin"),
                attribute("service.name", "ros2probe"),
                attribute("service.version", env!("CARGO_PKG_VERSION")),
            ]
        );
        let here = Host::read();
        assert!(here.name.is_some());
    }
}
