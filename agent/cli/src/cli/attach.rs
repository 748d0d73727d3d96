//! `rp attach`: the broker.

use std::path::PathBuf;

use anyhow::Result;
use clap::Args;

use crate::broker;

/// Options of `rp attach`.
#[derive(Debug, Args)]
pub(crate) struct Attach {
    /// Create this socket and listen on it
    #[arg(long, value_name = "PATH")]
    listen: Option<PathBuf>,
    /// User that may connect, in addition to root
    #[arg(long, value_name = "NAME", default_value = "ros2probe")]
    user: String,
}

impl Attach {
    /// Answers requests until no connection is left, or with `--listen` until it is terminated.
    pub(crate) fn run(self) -> Result<()> {
        broker::run(self.listen.as_deref(), &self.user)
    }
}
