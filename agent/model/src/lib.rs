//! The core: a state machine without clock, thread or I/O. It takes times and bytes and returns
//! facts.
//!
//! The folders are layers. Each imports only those above it in this list, which a test holds:
//!
//! - [`facts`]: identities, names, times, bounded tables, and the values that layers exchange:
//!   watches in [`facts::watch`], and the caps of tables in [`facts::limits`].
//! - [`graph`]: discovery of RTPS and of Zenoh.
//! - [`measure`]: writers, deliveries, losses and rates. A HEARTBEAT ends in [`measure::sequence`].
//! - [`derive`]: what follows from these: chains, services, calls inside processes, findings.
//! - [`report`]: the state at one moment, [`report::snapshot::Snapshot`].
//! - [`observe`]: the entry. An [`observe::observer::Observer`] takes [`observe::input::Input`] values,
//!   each with its time, and is drained of its [`observe::input::Output`]. The kernel programs need
//!   [`observe::interest`], the verdict for each writer.
//!
//! The same input yields the same facts, live or replayed at any speed. Every table is bounded.
//!
//! ```
//! use ros2probe_model::observe::input::Input;
//! use ros2probe_model::observe::observer::{Observer, Settings};
//! use ros2probe_wire::Timestamp;
//!
//! let mut observer = Observer::new(Settings::default());
//! observer.input(Input::Time(Timestamp(1_000_000_000)));
//! assert!(observer.drain().events.events.is_empty());
//! assert!(observer.snapshot(Timestamp(1_000_000_000)).participants.is_empty());
//! ```

#![forbid(unsafe_code)]

pub mod derive;
pub mod facts;
pub mod graph;
pub mod measure;
pub mod observe;
pub mod report;
