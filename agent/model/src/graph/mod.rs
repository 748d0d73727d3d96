//! Discovery of RTPS and of Zenoh: participants, nodes, endpoints, sockets.

pub mod discovery;
pub mod discovery_fragments;
pub mod sockets;
pub mod zenoh;
