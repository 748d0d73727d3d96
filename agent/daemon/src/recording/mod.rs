//! Recordings: selected topics, recorded messages, and missing ones.
//!
//! A recording receives samples from a subscription, as a stream of the API does; it is invisible
//! on the network. The agent writes recordings on request (`service`), and the last seconds before
//! an incident (`snapshot`). `ros2probe_bag` implements the format on disk.

mod disk_quota;
mod figures;
mod filter;
mod graph;
mod recorder;
pub(super) mod report;
mod sample_ring;
mod service;
mod session;
mod snapshot;

pub use disk_quota::DiskQuota;
pub use figures::{RecordingFigures, SnapshotFigures};
pub use filter::{Candidate, Filter, FilterError};
pub use graph::{DiscoveredTopic, GraphSnapshot, PublishedTopic, by_name};
pub use recorder::{Finished, Recorder, Sources};
pub use sample_ring::SampleRing;
pub use service::{
    Components, Recording, RecordingOptions, Recordings, Refusal, Status, default_name, schema,
};
pub use session::{Activity, Command, record};
pub use snapshot::{Snapshots, TriggeredBag, WrittenBag};
