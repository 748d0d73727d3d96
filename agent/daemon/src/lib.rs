//! The agent: brings what its sources capture to the model, and serves what the model knows.
//!
//! - [`agent::run`] is the life of an agent. [`agent::Components`] composes one, live or replayed.
//! - [`config`] reads the configuration, [`watches`] merges what is watched.
//! - [`run`] is the loop of the working thread, the only one that touches the model.
//! - [`surface`] serves snapshots: Prometheus, OTLP, the API and the page.
//! - [`subscriptions`] and [`recording`] take single messages, into streams and bags.
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
pub mod config;
mod control;
pub mod discover;
pub mod escape;
pub mod file;
mod logging;
mod memory;
pub mod privilege;
pub mod recording;
pub mod run;
pub mod state;
pub mod subscriptions;
mod supervise;
pub mod surface;
pub mod watches;
