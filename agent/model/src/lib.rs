//! The core: a state machine without clock, thread or I/O. Time and bytes come in, facts go out.
//!
//! - [`observer::Observer`] takes datagrams, records and facts about sockets, each with its time.
//! - [`snapshot::Snapshot`] is all that it knows at a moment: participants, endpoints, topics and
//!   their figures. [`event`] tells what changed.
//! - [`interest`] is the verdict for each writer that the kernel programs need.
//! - [`watch`] and [`limits`] are what an operator wants measured, and how much it may take.
//!
//! The same input gives the same facts, live or replayed at any speed. Every table is bounded.
//!
//! ```
//! use ros2probe_model::observer::{Observer, Settings};
//! use ros2probe_wire::Timestamp;
//!
//! let mut observer = Observer::new(Settings::default());
//! observer.advance(Timestamp(1_000_000_000));
//! assert!(observer.snapshot(Timestamp(1_000_000_000)).participants.is_empty());
//! ```

#![forbid(unsafe_code)]

pub mod acknowledgement;
pub mod assembly;
pub mod calendar;
pub mod cancelled;
pub mod cause;
pub mod churn;
pub mod deaths;
pub mod delivery;
pub mod departures;
pub mod diagnosis;
pub mod discovery;
pub mod event;
pub mod expectation;
pub mod glob;
pub mod header;
pub mod histogram;
pub mod history;
pub mod identity;
pub mod in_order;
pub mod interest;
pub mod journal;
pub mod limits;
pub mod observer;
mod passage;
pub mod payloads;
pub mod pieces;
pub mod profiler;
pub mod rate;
pub mod receivers;
pub mod reception;
mod report;
pub mod sampled;
pub mod samples;
pub mod selection;
pub mod sequence;
pub mod size;
pub mod snapshot;
pub mod sockets;
pub mod subscribers;
pub mod topic;
pub mod trace;
pub mod watch;
pub mod way;
pub mod ways;
pub mod writer;
