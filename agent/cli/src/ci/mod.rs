//! Judges a robot while a command runs, as `rp ci` does.
//!
//! [`observation`] collects an agent's view of one domain once a second. [`judgement`] compares it
//! with rules and returns conditions, which [`junit`] and [`report`] write as files. Nothing here
//! performs I/O or reads a clock.

mod drawing;
pub mod judgement;
pub mod junit;
pub mod observation;
pub mod report;
pub mod series;
mod tally;

pub use judgement::{Condition, Group, Run, Verdict, judge};
pub use observation::Observation;

/// Rules of a judgement.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rules {
    /// Seconds after the start of the command that are not judged.
    pub settle: f64,
    /// Maximum length in seconds of a shutdown, which is not judged.
    pub shutdown: f64,
    /// Least severity of a finding that fails.
    pub fail_on: FailOn,
    /// Messages that the worst subscriber of a topic may lose; `None` is unlimited.
    pub max_lost: Option<u64>,
    /// A part of the run that the agent missed fails, and is no mere warning.
    pub is_strict: bool,
}

/// Findings that fail.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum FailOn {
    /// Errors.
    #[default]
    Error,
    /// Errors and warnings.
    Warning,
    /// No finding.
    None,
}
