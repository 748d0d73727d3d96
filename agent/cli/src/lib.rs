//! `rp`: queries an agent and prints its answers in the format of `ros2`.
//!
//! - [`client`] reaches an agent at a socket or an address, or replays a capture in this process.
//! - [`ros2`] formats answers as `ros2 topic`, `ros2 node`, `ros2 bag info` and others do.
//! - [`learn`] chooses expectations from the figures of a healthy robot.
//! - [`ci`] judges a robot while a command runs, and writes the reports.
//! - [`discover`] requests announcements from running participants and routers.
//! - [`fleet`] compares the robots whose agents deliver to an engine.
//! - [`inside`] formats figures of calls inside processes.
//! - [`upgrade`] reads a feed of releases, and finds how this program was installed.
//! - [`top`] is the screen of `rp top`, [`doctor`] the checks of `rp doctor`.
//!
//! The commands themselves are in the program (`src/cli/`).
//!
//! ```
//! use ros2probe::ros2::Dialect;
//!
//! assert_eq!(Dialect::of_distro("humble"), Some(Dialect::Humble));
//! ```

#![forbid(unsafe_code)]

pub mod chain;
pub mod ci;
pub mod client;
pub mod discover;
pub mod doctor;
pub mod fleet;
pub mod frames;
pub mod inside;
pub mod learn;
pub mod ros2;
pub mod tables;
pub mod top;
pub mod upgrade;
pub mod why;
