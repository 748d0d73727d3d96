//! The core: a state machine without clock, thread or I/O. It takes times and bytes and returns
//! facts.
//!
//! - [`observer::Observer`] takes [`input::Input`] values, each with its time, and is drained of its
//!   [`input::Output`].
//! - [`snapshot::Snapshot`] contains the state at one moment: participants, endpoints, topics and
//!   their counts.
//! - [`interest`] holds the verdict for each writer, which the kernel programs need.
//! - [`watch`] and [`limits`] hold what an operator wants to measure, and the resources for it.
//!
//! The same input yields the same facts, live or replayed at any speed. Every table is bounded.
//!
//! ```
//! use ros2probe_model::input::Input;
//! use ros2probe_model::observer::{Observer, Settings};
//! use ros2probe_wire::Timestamp;
//!
//! let mut observer = Observer::new(Settings::default());
//! observer.input(Input::Time(Timestamp(1_000_000_000)));
//! assert!(observer.drain().events.events.is_empty());
//! assert!(observer.snapshot(Timestamp(1_000_000_000)).participants.is_empty());
//! ```

#![forbid(unsafe_code)]

pub mod acknowledgement;
pub mod assembly;
pub mod bounded;
pub mod chain;
pub mod churn;
pub mod delivery;
pub mod departures;
pub mod diagnosis;
pub mod discovery;
pub mod discovery_fragments;
pub mod dispatch;
pub mod event;
pub mod examiner;
pub mod expectation;
pub mod glob;
pub mod header;
pub mod histogram;
pub mod history;
pub mod identity;
pub mod in_order;
pub mod input;
pub mod inside;
pub mod interest;
pub mod journal;
pub mod limits;
pub mod loss;
pub mod loss_causes;
pub mod loss_share;
pub mod measurement;
pub mod names;
pub mod naming;
pub mod observer;
pub mod payloads;
pub mod profiler;
pub mod rate;
pub mod receivers;
pub mod reception;
pub mod rehearsal;
pub mod route;
pub mod routes;
pub mod sampled;
pub mod samples;
pub mod selection;
pub mod sequence;
pub mod services;
pub mod snapshot;
pub mod sockets;
pub mod subscribers;
pub mod tables;
pub mod topic;
pub mod topic_kind;
pub mod trace;
mod transport;
pub mod undelivered;
pub mod wall_clock;
pub mod watch;
pub mod writer;
pub mod zenoh;
