//! ros2probe: watches a ROS 2 robot from copies of its RTPS traffic, without joining the domain.

pub use ros2probe_bag as bag;
pub use ros2probe_capture as capture;
pub use ros2probe_message as message;
pub use ros2probe_model as model;

pub mod client;
pub mod config;
pub mod discover;
pub mod doctor;
pub mod file;
pub mod privilege;
pub mod recording;
pub mod ros2;
pub mod run;
pub mod state;
pub mod subscriptions;
pub mod surface;
pub mod top;
pub mod visible;
pub mod watches;
