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

/// Quality of service of the original's own subscription; accepted, so that scripts go on working.
#[derive(Args, Clone, Debug, Default)]
pub(crate) struct Matching {
    /// Accepted without effect, as all options of quality of service: there is no subscription
    #[arg(long, value_name = "PROFILE")]
    qos_profile: Option<String>,
    #[arg(long, value_name = "N", hide = true)]
    qos_depth: Option<String>,
    #[arg(long, value_name = "HISTORY", hide = true)]
    qos_history: Option<String>,
    #[arg(long, value_name = "RELIABILITY", hide = true)]
    qos_reliability: Option<String>,
    #[arg(long, value_name = "DURABILITY", hide = true)]
    qos_durability: Option<String>,
    #[arg(long, value_name = "LIVELINESS", hide = true)]
    qos_liveliness: Option<String>,
    #[arg(long, value_name = "SECONDS", hide = true)]
    qos_liveliness_lease_duration_seconds: Option<String>,
}

/// All names in the target's domain, also hidden ones. Where there is nothing but in other domains,
/// stderr says so once.
pub(crate) fn names(target: &Target) -> Result<Names> {
    let domain_id = target.domain()?;
    let agent = Agent::reach(target)?;
    names_of(&agent, domain_id)
}

/// As [`names`], of an agent that is known already.
pub(crate) fn names_of(agent: &Agent, domain_id: u32) -> Result<Names> {
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
