//! RTPS for a model in virtual time: messages, captures of them, and hosts that receive them.

pub mod capture;
pub mod forge;
pub mod host;
