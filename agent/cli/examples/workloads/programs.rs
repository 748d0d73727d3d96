//! Run times of kernel programs, as the kernel counts them.

use std::collections::BTreeMap;
use std::fmt;
use std::time::Duration;

use anyhow::{Context as _, Result};
use aya::programs::loaded_programs;
use aya::sys::{Stats, enable_stats};

use crate::window::UNIT_SECONDS;

/// The loaded programs by id.
pub(crate) struct Programs(BTreeMap<u32, Counts>);

struct Counts {
    name: String,
    runs: u64,
    time: Duration,
}

/// What one program took.
pub(crate) struct ProgramCost {
    name: String,
    /// Runs per second.
    rate: f64,
    /// Mean time of a run.
    run: Duration,
    /// CPU seconds per 20 s.
    seconds: f64,
}

impl Programs {
    pub(crate) fn loaded() -> Result<Programs> {
        let programs = loaded_programs().map(|program| {
            let program = program.context("cannot list the kernel's programs")?;
            let counts = Counts {
                name: program.name_as_str().unwrap_or("?").to_owned(),
                runs: program.run_count(),
                time: program.run_time(),
            };
            Ok((program.id(), counts))
        });
        Ok(Programs(programs.collect::<Result<_>>()?))
    }

    /// Leaves out these programs.
    pub(crate) fn without(mut self, others: &Programs) -> Programs {
        self.0.retain(|id, _| !others.0.contains_key(id));
        self
    }

    /// Returns what these programs take in this time, the most expensive one first.
    pub(crate) fn run_for(self, length: Duration) -> Result<Vec<ProgramCost>> {
        let _statistics = enable_stats(Stats::RunTime).context("no statistics of programs")?;
        let before = Programs::loaded()?;
        std::thread::sleep(length);
        let after = Programs::loaded()?;
        let costs = self.0.keys().filter_map(|id| {
            let (before, after) = (before.0.get(id)?, after.0.get(id)?);
            let (runs, time) = (after.runs - before.runs, after.time - before.time);
            (runs > 0).then(|| ProgramCost {
                name: after.name.clone(),
                rate: runs as f64 / length.as_secs_f64(),
                run: time.div_f64(runs as f64),
                seconds: time.as_secs_f64() / length.as_secs_f64() * UNIT_SECONDS,
            })
        });
        let mut costs: Vec<_> = costs.collect();
        costs.sort_by(|one, other| other.seconds.total_cmp(&one.seconds));
        Ok(costs)
    }
}

impl fmt::Display for ProgramCost {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (name, rate, run) = (&self.name, self.rate, self.run.as_nanos());
        let seconds = self.seconds;
        write!(
            formatter,
            "`{name}` ran {rate:.0} times a second for {run} ns, {seconds:.4} CPU s"
        )
    }
}
