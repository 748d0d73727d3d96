//! The configuration: YAML shape first, then meaning; all mistakes reported with their place.

pub mod watch;
