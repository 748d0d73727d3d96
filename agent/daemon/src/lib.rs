//! The agent: feeds captured traffic to the model, and serves the model's state.
//!
//! - [`agent::run`] is the lifecycle of an agent. [`agent::Components`] composes one, live or
//!   replayed.
//! - [`config`] reads the configuration, [`watches`] merges the watched topics.
//! - [`run`] is the loop of the working thread, the only thread that accesses the model.
//! - [`snapshot_cell`] holds the latest snapshot, [`events`] the log of events, [`limit_facts`] the
//!   caps.
//! - [`surface`] serves snapshots: Prometheus, the API and the page. OTLP exports them.
//! - [`disk_history`] is the history of the last days.
//! - [`subscriptions`] and [`recording`] pass single messages into streams and bags.
//!
//! ```
//! use ros2probe_daemon::config::Config;
//!
//! let config = Config::parse(b"watch: [/points]\n")?;
//! assert_eq!(config.watches[0].pattern, "/points");
//! # Ok::<_, ros2probe_daemon::config::Mistakes>(())
//! ```

#![cfg_attr(not(test), forbid(unsafe_code))]

pub mod agent;
pub mod agent_facts;
pub mod config;
pub mod container;
mod control;
pub mod disk_history;
pub mod escape;
pub mod events;
pub mod file;
pub mod fleet;
mod latched;
pub mod limit_facts;
pub mod logging;
mod memory;
pub mod missed_announcements;
pub mod private_agent;
pub mod privilege;
pub mod recording;
pub mod replay_pace;
pub mod run;
pub mod settings_cell;
pub mod ship;
pub mod snapshot_cell;
pub mod state;
pub mod subscriptions;
mod supervise;
pub mod surface;
pub mod tables;
pub mod watches;
