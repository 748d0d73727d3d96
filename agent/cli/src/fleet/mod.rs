//! The robots of a fleet: which is in trouble, and what differs from the others.
//!
//! The figures come from an engine with the query API of Prometheus, to which the robots' agents
//! deliver. Nothing is stored here, and no robot is contacted. They are text, JSON or a page.

mod differences;
mod engine;
mod page;
mod robot;
mod serve;
mod text;

pub use differences::Difference;
pub use engine::{Engine, EngineError, InvalidAddress};
pub use page::{InvalidLink, Link};
pub use robot::{Fleet, Question, Robot, State};
pub use serve::{Page, PageError};
