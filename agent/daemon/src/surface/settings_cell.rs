//! The part of the configuration that decides what is shown, replaced by reloads.

use std::sync::Arc;
use std::time::SystemTime;

use arc_swap::ArcSwap;

use crate::config::{Config, Limits, Watch};

/// The settings in force, and how the last reload went.
#[derive(Debug)]
pub struct SettingsCell {
    settings: ArcSwap<Settings>,
    reload: ArcSwap<Reload>,
}

/// The part of the configuration that decides what is shown.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Settings {
    /// Expectations are shown as configured.
    pub watches: Vec<Arc<Watch>>,
    /// Histograms of watched topics.
    pub histograms: bool,
    /// Series per writer.
    pub per_writer: bool,
    /// Caps; those of the start stay in force.
    pub limits: Limits,
}

/// How the last reload of the configuration went.
#[derive(Clone, Copy, Debug)]
pub struct Reload {
    /// It was taken over.
    pub successful: bool,
    /// When one was last taken over.
    pub last_success: SystemTime,
}

impl Settings {
    /// What `config` wants to be shown, with the watches that are in force.
    #[must_use]
    pub fn new(config: &Config) -> Self {
        Self {
            watches: config.watches.iter().cloned().map(Arc::new).collect(),
            histograms: config.metrics.histograms,
            per_writer: config.metrics.per_writer,
            limits: config.limits,
        }
    }
}

impl SettingsCell {
    /// Of an agent that read its configuration now.
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

    /// The settings in force.
    #[must_use]
    pub fn settings(&self) -> Arc<Settings> {
        self.settings.load_full()
    }

    /// How the last reload went.
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

    /// Takes over the settings of a reload that worked.
    pub fn reloaded(&self, settings: Settings) {
        self.settings.store(Arc::new(settings));
        let reload = Reload {
            successful: true,
            last_success: SystemTime::now(),
        };
        self.reload.store(Arc::new(reload));
    }

    /// Notes that a reload was refused.
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
}
