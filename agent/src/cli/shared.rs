//! What the verbs of the graph share: options that the original has and that change nothing here,
//! and asking for names.

use anyhow::Result;
use clap::Args;
use ros2probe::client::{Agent, Target};
use ros2probe::ros2::facts::Names;

/// Options that concern the original's own node; accepted, so that scripts go on working.
#[derive(Args, Clone, Debug, Default)]
pub(crate) struct Spinning {
    /// Accepted without effect: nothing has to be waited for
    #[arg(long, value_name = "SPIN_TIME")]
    spin_time: Option<f64>,
    /// Accepted without effect
    #[arg(long, short = 's')]
    use_sim_time: bool,
    /// Accepted without effect: there is no daemon
    #[arg(long)]
    no_daemon: bool,
}

/// All names in the target's domain, also hidden ones. Where there is nothing but in other domains,
/// stderr says so once.
pub(crate) fn names(target: &Target) -> Result<Names> {
    let domain_id = target.domain()?;
    let agent = Agent::reach(target)?;
    let names: Names = agent.get(&format!("/names?domain_id={domain_id}&hidden=true"))?;
    let others = names.domains.iter().filter(|other| **other != domain_id);
    let others: Vec<String> = others.map(u32::to_string).collect();
    if names.is_empty() && !others.is_empty() {
        eprintln!(
            "rp: nothing is in domain {domain_id}; the agent sees domain {}: pass `--domain N`",
            others.join(", ")
        );
    }
    Ok(names)
}
