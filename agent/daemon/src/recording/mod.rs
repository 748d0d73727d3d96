//! Recordings: which topics, what of them is in the bag, and what is not.
//!
//! A recording takes samples from a subscription, as a stream of the API does: nothing on the
//! network tells that there is one. The agent writes some itself (`service`), and the last seconds
//! before an incident (`snapshot`). How a bag looks on disk is the business of [`crate::bag`].

mod announced;
mod filter;
mod recorder;
mod report;
mod ring;
mod room;
mod service;
mod session;
mod snapshot;

pub use announced::{Announced, Graph, GraphTopic, SeenTopic, Sight, Strangers};
pub use filter::{Asked, Candidate, Filter, FilterError};
pub use recorder::{Ended, Recorder, Sources};
pub use report::{MissingRun, OtherDomain, Report, TopicReport, UnknownWriters, unobserved_lines};
pub use ring::Ring;
pub use room::Room;
pub use service::{Recording, Recordings, Refusal, Stage, Status, Wanted, default_name, schema};
pub use session::{Going, Order, record};
pub use snapshot::{Snapshots, Written};
