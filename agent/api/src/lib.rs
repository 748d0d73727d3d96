//! What the agent's API answers, declared once for the server and for `rp`, its client.
//!
//! A module for each noun of the API has its types. The agent borrows an answer from its snapshot and
//! writes it; a client reads the same type and owns it. A field that an older agent does not send has
//! its default, a field that only a newer agent sends is left out, and [`Open`] keeps values of an
//! enumeration that this version does not know. The feature `openapi` derives the schemas of the
//! OpenAPI document.
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
pub mod diagnosis;
pub mod endpoints;
pub mod events;
pub mod graph;
pub mod health;
pub mod live;
pub mod measurement;
pub mod messages;
pub mod names;
pub mod nodes;
mod open;
pub mod participants;
pub mod path;
pub mod problem;
pub mod recording_report;
pub mod recordings;
pub mod samples;
pub mod services;
pub mod snapshots;
pub mod topics;
pub mod watches;

pub use open::Open;

/// The highest domain id of DDS for which RTPS has ports (RTPS 2.5, 9.6.2.3).
pub const MAX_DOMAIN_ID: u32 = 232;
