//! The entry of the model: one `input`, one `drain`.

pub mod input;
pub mod interest;
pub mod observer;
