//! RTPS for a model in virtual time: messages, captures, domains, and hosts that receive messages.

pub mod capture;
pub mod domain;
pub mod forge;
pub mod host;
