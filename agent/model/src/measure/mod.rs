//! Writers, deliveries, losses and rates.

pub mod acknowledgement;
pub(crate) mod allowance;
pub mod assembly;
pub mod delivery;
pub mod departures;
pub mod expectation;
pub mod history;
pub mod in_order;
pub mod latched;
pub mod links;
pub mod loss_causes;
pub mod payloads;
pub mod profiler;
pub mod receivers;
pub mod reception;
pub mod rehearsal;
pub mod routes;
pub mod sampled;
pub mod samples;
pub mod sequence;
pub mod subscribers;
pub mod tls;
pub mod topic;
pub mod undelivered;
pub mod writer;
