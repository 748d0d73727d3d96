//! ros2probe: watches a ROS 2 robot from copies of its RTPS traffic, without joining the domain.
//!
//! Three layers, dependencies pointing inwards: `capture` (I/O) and `surface` (metrics, HTTP)
//! around `model` (discovery and statistics, deterministic). `client` asks a running agent, and
//! `ros2` is the text that people know. `bag` and `message` are crates of their own.

pub mod bell;
pub mod capture;
pub mod client;
pub mod config;
pub mod discover;
pub mod doctor;
pub mod file;
pub mod model;
pub mod privilege;
pub mod recording;
pub mod ros2;
pub mod run;
pub mod state;
pub mod subscriptions;
pub mod surface;
pub mod top;
pub mod visible;
pub mod watches;

pub use ros2probe_bag as bag;
pub use ros2probe_message as message;
