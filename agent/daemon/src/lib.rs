//! The agent: feeds the model from its sources and serves what the model knows.

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
