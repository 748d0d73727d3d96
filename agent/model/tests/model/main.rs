//! Tests of the model with forged and captured traffic, in virtual time.
#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::indexing_slicing,
    reason = "a test that meets the unexpected has failed"
)]

mod allocator;
mod batches;
mod bounds;
mod buffers;
mod chains;
mod churn;
mod clocks;
mod deadlines;
mod deliveries;
mod diagnosis;
mod diagnostics;
mod fields;
mod fixtures;
mod forged;
mod frames;
mod header;
mod healthy;
mod inside;
mod latched;
mod layers;
mod lifecycle;
mod loss;
mod memory;
mod observer;
mod order;
mod parameters;
mod plain_collections;
mod restart;
mod robot;
mod room;
mod services;
mod stamps;
mod start_orders;
mod tls;
mod transforms;
mod transports;
mod type_objects;
mod zenoh;
