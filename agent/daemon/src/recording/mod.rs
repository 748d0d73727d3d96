//! Recordings: which topics, what of them is in the bag, and what is not.
//!
//! A recording takes samples from a subscription, as a stream of the API does: nothing on the
//! network tells that there is one. The agent writes some itself (`service`), and the last seconds
//! before an incident (`snapshot`). How a bag looks on disk is the business of `ros2probe_bag`.

mod disk_quota;
mod figures;
mod filter;
mod graph;
mod recorder;
mod report;
mod sample_ring;
mod service;
mod session;
mod snapshot;

pub use disk_quota::DiskQuota;
pub use figures::{RecordingFigures, SnapshotFigures};
pub use filter::{Candidate, Filter, FilterError};
pub use graph::{DiscoveredTopic, GraphSnapshot, PublishedTopic, by_name};
pub use recorder::{Finished, Recorder, Sources};
pub use report::{shortfalls, unobserved_lines};
pub use sample_ring::SampleRing;
pub use service::{
    Components, Recording, RecordingOptions, Recordings, Refusal, Status, default_name, schema,
};
pub use session::{Activity, Command, record};
pub use snapshot::{Snapshots, WrittenBag};
