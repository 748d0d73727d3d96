//! RTPS for a model in virtual time: messages, captures of them, domains, and hosts that receive them.

pub mod capture;
pub mod domain;
pub mod forge;
pub mod host;
