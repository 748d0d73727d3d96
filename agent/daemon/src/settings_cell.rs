//! Settings of the displayed data, which reloads replace.

use std::sync::Arc;
use std::time::SystemTime;

use arc_swap::ArcSwap;

use crate::config::{Config, Limits, Watch};

/// Settings in force, and the result of the last reload.
#[derive(Debug)]
pub struct SettingsCell {
    settings: ArcSwap<Settings>,
    reload: ArcSwap<Reload>,
}

/// Settings of the displayed data.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Settings {
    /// Watches, whose expectations are shown as configured.
    pub watches: Vec<Arc<Watch>>,
    /// Whether watched topics have histograms.
    pub histograms: bool,
    /// Whether watched topics have series per writer.
    pub per_writer: bool,
    /// Values of diagnostics with a metric: patterns of name, slash and key.
    pub diagnostic_values: Vec<String>,
    /// Caps, which never change after the start.
    pub limits: Limits,
}

/// Result of the last reload of the configuration.
#[derive(Clone, Copy, Debug)]
pub struct Reload {
    /// Whether it was applied.
    pub successful: bool,
    /// Time of the last successful reload.
    pub last_success: SystemTime,
}

impl Settings {
    /// Returns the settings of `config`.
    #[must_use]
    pub fn new(config: &Config) -> Self {
        Self {
            watches: config.watches.iter().cloned().map(Arc::new).collect(),
            histograms: config.metrics.histograms,
            per_writer: config.metrics.per_writer,
            diagnostic_values: config.diagnostic_values.clone(),
            limits: config.limits,
        }
    }
}

impl SettingsCell {
    /// Creates the cell of an agent that read its configuration now.
    #[must_use]
    pub fn new(settings: Settings) -> Self {
        let reload = Reload {
            successful: true,
            last_success: SystemTime::now(),
        };
        Self {
            settings: ArcSwap::from_pointee(settings),
            reload: ArcSwap::from_pointee(reload),
        }
    }

    /// Returns the settings in force.
    #[must_use]
    pub fn settings(&self) -> Arc<Settings> {
        self.settings.load_full()
    }

    /// Returns the result of the last reload.
    #[must_use]
    pub fn reload(&self) -> Reload {
        **self.reload.load()
    }

    /// Replaces the watches in force.
    pub fn watch(&self, watches: &[Arc<Watch>]) {
        self.settings.rcu(|settings| Settings {
            watches: watches.to_vec(),
            ..(**settings).clone()
        });
    }

    /// Applies the settings of a successful reload. The watches in force stay: [`Self::watch`]
    /// already has those of the reload, and a client may add one at the same time.
    pub fn reloaded(&self, settings: &Settings) {
        self.settings.rcu(|before| Settings {
            watches: before.watches.clone(),
            ..settings.clone()
        });
        let reload = Reload {
            successful: true,
            last_success: SystemTime::now(),
        };
        self.reload.store(Arc::new(reload));
    }

    /// Records a refused reload.
    pub fn reload_failed(&self) {
        let last_success = self.reload.load().last_success;
        self.reload.store(Arc::new(Reload {
            successful: false,
            last_success,
        }));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_refused_reload_keeps_the_settings() {
        let settings = Settings {
            per_writer: true,
            ..Settings::default()
        };
        let cell = SettingsCell::new(settings.clone());
        let first = cell.reload().last_success;
        cell.reload_failed();
        assert_eq!(*cell.settings(), settings);
        assert!(!cell.reload().successful);
        assert_eq!(cell.reload().last_success, first);
    }

    #[test]
    fn a_reload_keeps_a_watch_that_was_added_at_the_same_time() {
        let cell = SettingsCell::new(Settings::default());
        // The reload has read the watches in force when a client adds one.
        let reloaded = Settings {
            histograms: true,
            ..Settings::clone(&cell.settings())
        };
        let added = Arc::new(Watch::named("/added").unwrap());
        cell.watch(&[Arc::clone(&added)]);
        cell.reloaded(&reloaded);
        let settings = cell.settings();
        assert!(settings.histograms);
        assert_eq!(settings.watches, [added]);
    }
}
