//! Answers of the agent's API, declared once for the server and for its client `rp`.
//!
//! Each noun of the API has a module. The agent serializes an answer that borrows from its
//! snapshot; a client deserializes the same type and owns it. A field that an older agent does not
//! send takes its default. A field that only a newer agent sends is ignored, and [`Open`] keeps
//! values of an enumeration that this version does not know. The feature `openapi` derives the
//! schemas of the OpenAPI document.
//!
//! ```
//! use ros2probe_api::health::Health;
//!
//! let health: Health = serde_json::from_str(r#"{"ready": true, "source": "host"}"#)?;
//! assert!(health.ready && health.limits.is_empty());
//! assert_eq!(ros2probe_api::path::encoded("/camera/image raw"), "/camera/image%20raw");
//! # Ok::<_, serde_json::Error>(())
//! ```

#![forbid(unsafe_code)]

pub mod attributes;
pub mod chains;
pub mod clocks;
pub mod diagnosis;
pub mod diagnostics;
pub mod doctor;
pub mod endpoints;
pub mod events;
pub mod fleet;
pub mod graph;
pub mod health;
pub mod history;
pub mod inside;
pub mod latched;
pub mod live;
pub mod logs;
pub mod measurement;
pub mod messages;
pub mod names;
pub mod nodes;
mod open;
pub mod parameters;
pub mod participants;
pub mod path;
pub mod problem;
pub mod recording_report;
pub mod recordings;
pub mod replay;
pub mod samples;
pub mod services;
pub mod snapshots;
pub mod topics;
pub mod transforms;
pub mod watches;
pub mod why;

pub use open::Open;

/// Highest DDS domain id that RTPS maps to ports (RTPS 2.5, 9.6.2.3).
pub const MAX_DOMAIN_ID: u32 = 232;
