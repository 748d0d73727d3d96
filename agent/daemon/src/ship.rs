//! Settings of `rp ship`, from the configuration that it shares with the agent.

use ros2probe_metrics::otlp::{Host, NoHardware};
use ros2probe_ship::{RECORDS_DIRECTORY, Settings, SpaceLimits, StoreSettings};

use crate::config::{Config, StateChoice};
use crate::memory::{self, RECORDINGS_DIRECTORY};

/// Why bags cannot be delivered.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum NoShip {
    /// No destination is configured.
    #[error("no destination is configured: set `ship.url`, as in `s3://bucket/robots`")]
    Destination,
    /// No state directory is available.
    #[error("`state_directory` is off or missing: rp ship records there what is delivered")]
    State,
    /// Recordings are off.
    #[error("`recordings.directory` is off: the agent writes no bags")]
    Recordings,
    /// The robot has no name.
    #[error("this host has no name: set `ship.instance`")]
    Instance,
    /// The name of the robot stands for hardware that this host does not have.
    #[error(transparent)]
    Hardware(#[from] NoHardware),
}

/// Returns the settings of a delivery.
///
/// # Errors
/// Fails if the configuration has no destination, or no directory for bags or state.
pub fn settings(config: &Config) -> Result<Settings, NoShip> {
    let ship = &config.ship;
    let url = ship.url.clone().ok_or(NoShip::Destination)?;
    let state = memory::path(&config.state_directory).ok_or(NoShip::State)?;
    let recordings = match &config.recordings.directory {
        StateChoice::Off => return Err(NoShip::Recordings),
        StateChoice::At(path) => path.clone(),
        StateChoice::Auto => state.join(RECORDINGS_DIRECTORY),
    };
    let instance = ship.instance.as_ref();
    let instance = instance.or(config.remote_write.instance.as_ref());
    let instance = instance.or(config.otlp.robot.as_ref());
    let host = Host::read();
    let instance = instance.map(|name| host.named(name)).transpose()?;
    let instance = instance.or(host.name);
    let limits = &config.recordings.limits;
    Ok(Settings {
        store: StoreSettings {
            url,
            endpoint: ship.endpoint.clone(),
            region: ship.region.clone(),
            credentials_file: ship.credentials_file.clone(),
            ca_file: ship.ca_file.clone(),
            max_bytes_per_second: ship.max_bytes_per_second,
        },
        instance: instance.ok_or(NoShip::Instance)?,
        windows: ship.windows.clone(),
        triggered_always: ship.triggered_always,
        recordings,
        state: state.join(RECORDS_DIRECTORY),
        space: SpaceLimits {
            reserve_percent: limits.reserve_percent,
            reserve_bytes: limits.reserve_bytes,
            max_total_bytes: limits.max_total_bytes,
        },
    })
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    fn config(text: &str) -> Config {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), text).unwrap();
        Config::load(file.path()).unwrap()
    }

    #[test]
    fn the_robot_has_the_name_of_its_other_exports() {
        let instance = |more: &str| {
            let text = format!("state_directory: /state\nship: {{url: 's3://bags/a'{more}");
            settings(&config(&text)).unwrap().instance
        };
        let remote = "remote_write: {instance: of-remote-write}\n";
        let otlp = "otlp: {robot: of-otlp}\n";
        assert_eq!(
            instance(&format!(", instance: own}}\n{remote}{otlp}")),
            "own"
        );
        assert_eq!(instance(&format!("}}\n{otlp}{remote}")), "of-remote-write");
        assert_eq!(instance(&format!("}}\n{otlp}")), "of-otlp");
        assert_eq!(instance("}\n"), Host::read().name.unwrap());
    }

    #[test]
    fn directories_are_those_of_the_agent() {
        let text = "state_directory: /state\nship: {url: 'file:///mnt/bags'}\n";
        let found = settings(&config(text)).unwrap();
        assert_eq!(found.recordings, Path::new("/state/recordings"));
        assert_eq!(found.state, Path::new("/state/ship"));
        let refused = |text: &str| settings(&config(text)).unwrap_err();
        assert_eq!(refused("watch: []\n"), NoShip::Destination);
        assert_eq!(
            refused("state_directory: off\nship: {url: 'gs://bags'}\n"),
            NoShip::State
        );
        let off = format!("{text}recordings: {{directory: off}}\n");
        assert_eq!(refused(&off), NoShip::Recordings);
    }
}
