//! What the Rust peers of the interoperability matrix share: the command line, the log and the
//! course of a peer. Each binary adds one DDS implementation as a [`Peer`].

mod log;
mod options;
mod run;

pub use log::Log;
pub use options::{Capability, Options, Role};
pub use run::{Event, Peer, run};

pub type Guid = [u8; 16];
pub type Result<T> = std::result::Result<T, Failure>;

/// Why a peer cannot go on.
pub struct Failure(String);

impl<E: std::fmt::Debug> From<E> for Failure {
    fn from(error: E) -> Failure {
        Failure(format!("{error:?}"))
    }
}

pub const TYPE: &str = "ShapeType";
pub const SHAPE_SIZE: i32 = 30;

/// The standard names of the policies, by their standard numbers.
const POLICIES: [&str; 25] = [
    "INVALID",
    "USER_DATA",
    "DURABILITY",
    "PRESENTATION",
    "DEADLINE",
    "LATENCY_BUDGET",
    "OWNERSHIP",
    "OWNERSHIP_STRENGTH",
    "LIVELINESS",
    "TIME_BASED_FILTER",
    "PARTITION",
    "RELIABILITY",
    "DESTINATION_ORDER",
    "HISTORY",
    "RESOURCE_LIMITS",
    "ENTITY_FACTORY",
    "WRITER_DATA_LIFECYCLE",
    "READER_DATA_LIFECYCLE",
    "TOPIC_DATA",
    "GROUP_DATA",
    "TRANSPORT_PRIORITY",
    "LIFESPAN",
    "DURABILITY_SERVICE",
    "DATA_REPRESENTATION",
    "TYPE_CONSISTENCY_ENFORCEMENT",
];

/// Returns the standard name of the policy with this standard number.
pub fn policy_name(number: usize) -> &'static str {
    POLICIES.get(number).unwrap_or(&POLICIES[0])
}

/// Returns the additional payload of each sample.
pub fn payload(size: usize) -> Vec<u8> {
    (0..size).map(|place| place as u8).collect()
}
