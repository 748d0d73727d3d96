//! `rp`: asks an agent, and prints what it answers as `ros2` does.

pub use ros2probe_bag as bag;
pub use ros2probe_capture as capture;
pub use ros2probe_daemon::{
    config, discover, escape, file, privilege, recording, run, state, subscriptions, surface,
    watches,
};
pub use ros2probe_message as message;
pub use ros2probe_model as model;

pub mod client;
pub mod doctor;
pub mod ros2;
pub mod top;
