//! The option of commands that read compressed files.

use clap::Args;
use ros2probe_daemon::agent::Expansion;

/// How far a compressed file may expand.
#[derive(Args, Clone, Copy, Debug, Default)]
pub struct Compressed {
    /// Read a compressed FILE also if it expands to far more than its size
    #[arg(long)]
    no_expansion_limit: bool,
}

impl From<Compressed> for Expansion {
    fn from(compressed: Compressed) -> Self {
        match compressed.no_expansion_limit {
            true => Self::Unlimited,
            false => Self::Limited,
        }
    }
}
