//! Facts derived from measurements: chains, services, calls inside processes, findings.

pub mod chain;
pub mod clocks;
pub mod examiner;
pub mod inside;
pub mod robot;
pub mod services;
pub mod stamps;
pub mod trace;
pub mod type_descriptions;
