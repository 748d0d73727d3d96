//! Tests of the kernel programs, which the kernel itself runs: on packets of a test, and on sockets
//! in network namespaces. They need root.
#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::indexing_slicing,
    reason = "a test that meets the unexpected has failed"
)]

mod caps;
mod filter;
mod handed;
mod host_hook;
mod inside;
mod inside_processes;
mod maps;
mod tcx;
mod zenoh;
