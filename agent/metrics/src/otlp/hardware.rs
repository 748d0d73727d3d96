//! Names of a robot from its hardware, so that one image serves many robots, and a robot with a new
//! image keeps its name.

use std::fs;
use std::path::Path;

use super::resource::Host;

/// A name has a placeholder for hardware that this host does not have.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("this host has no {what}, for which `{placeholder}` in the name of the robot stands")]
pub struct NoHardware {
    placeholder: &'static str,
    what: &'static str,
}

impl Host {
    /// Returns a configured name of the robot, with `{serial}` and `{mac}` replaced.
    ///
    /// # Errors
    /// Fails if the name has one of them, and this host has no such number.
    pub fn named(&self, text: &str) -> Result<String, NoHardware> {
        let mut name = text.to_owned();
        for (placeholder, what, value) in [
            ("{serial}", "serial number in a device tree", &self.serial),
            ("{mac}", "interface with a permanent address", &self.mac),
        ] {
            if name.contains(placeholder) {
                let missing = NoHardware { placeholder, what };
                name = name.replace(placeholder, value.as_ref().ok_or(missing)?);
            }
        }
        Ok(name)
    }
}

/// Returns the serial number in the device tree of a board, such as a Raspberry Pi or a Jetson.
/// `system` is `/sys`.
pub(super) fn serial(system: &Path) -> Option<String> {
    let text = fs::read(system.join("firmware/devicetree/base/serial-number")).ok()?;
    // The text ends with a zero.
    let text = String::from_utf8_lossy(&text);
    let is_part = |letter: &char| letter.is_ascii_alphanumeric() || "-_.".contains(*letter);
    let serial: String = text.chars().filter(is_part).collect();
    serial
        .contains(|letter: char| letter != '0')
        .then_some(serial)
}

/// Returns the permanent address of the first interface by name that has a device: a wired one
/// before a wireless one. `system` is `/sys`.
pub(super) fn mac(system: &Path) -> Option<String> {
    let entries = fs::read_dir(system.join("class/net")).ok()?;
    let interfaces = entries.filter_map(|entry| {
        let interface = entry.ok()?;
        let file = |name: &str| fs::read_to_string(interface.path().join(name)).ok();
        let is_permanent = file("addr_assign_type")?.trim() == "0";
        let is_hardware = interface.path().join("device").exists();
        let address = file("address")?.trim().replace(':', "");
        (is_permanent && is_hardware).then(|| (interface.file_name(), address))
    });
    interfaces.min().map(|(_, address)| address)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_from_the_hardware_does_not_depend_on_the_image() {
        let system = tempfile::tempdir().unwrap();
        let write = |path: &str, text: &str| {
            let path = system.path().join(path);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, text).unwrap();
        };
        assert_eq!((serial(system.path()), mac(system.path())), (None, None));
        write("firmware/devicetree/base/serial-number", "10000000a1b2\0");
        // A wireless interface, one of containers, and one whose address is random.
        for (name, address, kind) in [
            ("wlan0", "dc:a6:32:00:00:09", "0"),
            ("eth1", "dc:a6:32:00:00:02", "0"),
            ("docker0", "02:42:00:00:00:01", "0"),
            ("eth0", "aa:00:00:00:00:01", "1"),
        ] {
            write(
                &format!("class/net/{name}/address"),
                &format!("{address}\n"),
            );
            write(
                &format!("class/net/{name}/addr_assign_type"),
                &format!("{kind}\n"),
            );
            if name != "docker0" {
                write(&format!("class/net/{name}/device/vendor"), "");
            }
        }
        let host = Host {
            serial: serial(system.path()),
            mac: mac(system.path()),
            ..Host::default()
        };
        let named = |text: &str| host.named(text).unwrap();
        assert_eq!(named("robot-{serial}"), "robot-10000000a1b2");
        assert_eq!(named("{mac}.hall"), "dca632000002.hall");
        assert_eq!(named("robot-7"), "robot-7");
        let error = Host::default().named("{serial}").unwrap_err().to_string();
        assert!(error.contains("no serial number"), "{error}");
        // Boards without a number have zeros.
        write("firmware/devicetree/base/serial-number", "0000\0");
        assert_eq!(serial(system.path()), None);
    }
}
