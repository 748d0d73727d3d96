//! The resource: attributes that all points, records and spans of this agent share.

use std::fs;
use std::path::Path;

use opentelemetry::{KeyValue, Value};
use opentelemetry_sdk::Resource;
use opentelemetry_sdk::resource::{EnvResourceDetector, ResourceDetector as _};
use percent_encoding::percent_decode_str;

use super::hardware::{self, NoHardware};
use super::settings::OtlpSettings;
use ros2probe_model::facts::identity::Identity;

/// Identity of a host, from its operating system.
#[derive(Clone, Debug, Default)]
pub struct Host {
    /// Network name.
    pub name: Option<String>,
    /// Machine id, which does not change with the name.
    pub id: Option<String>,
    /// Serial number of the board, which does not change with the image.
    pub serial: Option<String>,
    /// Address of its first network interface, which does not change with the image.
    pub mac: Option<String>,
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
            serial: hardware::serial(Path::new("/sys")),
            mac: hardware::mac(Path::new("/sys")),
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

/// Returns the resource for `host`. Attributes of the environment override those of the host, and
/// attributes of the file override both.
///
/// Fails if the name of the robot stands for hardware that this host does not have.
pub(super) fn resource(host: &Host, file: &OtlpSettings) -> Result<Resource, NoHardware> {
    let of_host = [("host.name", &host.name), ("host.id", &host.id)];
    let of_host = of_host
        .into_iter()
        .filter_map(|(key, value)| Some(KeyValue::new(key, value.clone()?)));
    let robot = file.robot.as_deref().map(|robot| host.named(robot));
    let robot = robot.transpose()?.map(|robot| ("robot.name", robot));
    let of_file = file.attributes.iter();
    let of_file = of_file.map(|(key, value)| KeyValue::new(key.clone(), value.clone()));
    let resource = Resource::builder_empty()
        .with_attributes([
            KeyValue::new("service.name", "ros2probe"),
            KeyValue::new("service.version", env!("CARGO_PKG_VERSION")),
            KeyValue::new("service.instance.id", instance(host)),
        ])
        .with_attributes(of_host)
        .with_attributes(environment(&EnvResourceDetector::new().detect()))
        .with_attributes(service_name())
        .with_attributes(of_file)
        .with_attributes(robot.map(|(key, value)| KeyValue::new(key, value)))
        .build();
    // An empty value removes an attribute.
    let kept = resource.iter();
    let kept = kept.filter(|(_, value)| !value.as_str().is_empty());
    let kept = kept.map(|(key, value)| KeyValue::new(key.clone(), value.clone()));
    Ok(Resource::builder_empty().with_attributes(kept).build())
}

/// Returns the attributes of `OTEL_RESOURCE_ATTRIBUTES`. The SDK leaves their values
/// percent-encoded.
fn environment(detected: &Resource) -> Vec<KeyValue> {
    let decoded = |value: &Value| {
        let value = value.as_str();
        percent_decode_str(&value).decode_utf8_lossy().into_owned()
    };
    let attributes = detected.iter();
    attributes
        .map(|(key, value)| KeyValue::new(key.clone(), decoded(value)))
        .collect()
}

/// Returns the name in `OTEL_SERVICE_NAME`. The SDK's detector invents a name if it is unset.
fn service_name() -> Option<KeyValue> {
    let name = std::env::var("OTEL_SERVICE_NAME").ok()?;
    Some(KeyValue::new("service.name", name)).filter(|name| !name.value.as_str().is_empty())
}

/// Returns a UUID (version 8) that survives restarts, so that a robot's series continue. It is
/// derived from the machine id, which should not be published itself.
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
    fn an_instance_id_depends_on_the_host_and_stays_the_same() {
        let host = |id: &str| Host {
            name: Some("robot-7".to_owned()),
            id: Some(id.to_owned()),
            ..Host::default()
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
    fn configured_attributes_replace_detected_ones() {
        let attributes = [("host.name", "R2"), ("service.instance.id", "")];
        let file = OtlpSettings {
            robot: Some("marvin".to_owned()),
            attributes: attributes
                .map(|(key, value)| (key.to_owned(), value.to_owned()))
                .into(),
            ..OtlpSettings::default()
        };
        let host = Host {
            name: Some("robot-7".to_owned()),
            ..Host::default()
        };
        let resource = resource(&host, &file).unwrap();
        let mut attributes: Vec<_> = resource
            .iter()
            .map(|(key, value)| (key.as_str(), value.as_str().into_owned()))
            .collect();
        attributes.sort_unstable();
        assert_eq!(
            attributes,
            [
                ("host.name", "R2".to_owned()),
                ("robot.name", "marvin".to_owned()),
                ("service.name", "ros2probe".to_owned()),
                ("service.version", env!("CARGO_PKG_VERSION").to_owned()),
            ]
        );
        let here = Host::read();
        assert!(here.name.is_some());
    }

    #[test]
    fn values_of_the_environment_are_percent_decoded() {
        let given = Resource::builder_empty();
        let given = given.with_attribute(KeyValue::new("site", "hall%2C 2"));
        assert_eq!(
            environment(&given.build()),
            [KeyValue::new("site", "hall, 2")]
        );
    }
}
