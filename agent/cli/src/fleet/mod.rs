//! `rp fleet`: the robots of a fleet ([`ros2probe_daemon::fleet`]) as text and as a page.

mod incidents;
mod page;
mod serve;
mod text;

pub use incidents::size;
pub use serve::{Page, PageError};
pub use text::{FleetText, RobotText};
