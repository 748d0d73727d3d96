//! One stretch of a stream at one subscriber, and the losses that the agent reports for it.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;

use ros2probe_model::facts::loss::LossCause;

/// Sent, lost and reported samples of a stretch, by the writer's sequence numbers.
#[derive(Debug)]
pub(crate) struct Cell {
    /// Stack, size, trouble, subscriber.
    pub(crate) name: String,
    pub(crate) sent: BTreeSet<u64>,
    /// Samples of `sent` that the subscriber did not receive.
    pub(crate) lost: BTreeSet<u64>,
    /// Samples that the agent reports as lost, with the reported cause.
    pub(crate) reported: BTreeMap<u64, LossCause>,
    /// Causes that the trouble may have.
    pub(crate) possible_causes: BTreeSet<LossCause>,
    /// Whether the trouble is certain to drop samples.
    pub(crate) drops_samples: bool,
}

impl Cell {
    fn found(&self) -> usize {
        let reported = self.reported.keys();
        reported.filter(|number| self.lost.contains(number)).count()
    }

    /// Returns the share of the lost samples that the agent reports.
    fn recall(&self) -> f64 {
        share(self.found(), self.lost.len())
    }

    /// Returns the share of the reported samples that were lost.
    fn precision(&self) -> f64 {
        share(self.found(), self.reported.len())
    }

    /// Returns the number of samples that the agent reports as lost by this cause.
    pub(crate) fn losses_by(&self, cause: LossCause) -> usize {
        let causes = self.reported.values();
        causes.filter(|each| **each == cause).count()
    }

    /// Returns the deviations from a correct report.
    pub(crate) fn faults(&self) -> Vec<String> {
        let named: BTreeSet<u64> = self.reported.keys().copied().collect();
        let mut faults = Vec::new();
        let mut fault = |what: &str, numbers: Vec<u64>| {
            if !numbers.is_empty() {
                faults.push(format!("{}: {what} {numbers:?}", self.name));
            }
        };
        fault(
            "not reported",
            self.lost.difference(&named).copied().collect(),
        );
        fault("not lost", named.difference(&self.lost).copied().collect());
        for cause in LossCause::ALL {
            let wrong = self.reported.iter().filter(|(_, reported)| {
                **reported == cause && !self.possible_causes.contains(&cause)
            });
            let wrong = wrong.map(|(number, _)| *number).collect();
            fault(&format!("cannot be of {}", cause.label()), wrong);
        }
        if self.drops_samples && self.lost.is_empty() {
            faults.push(format!("{}: lost nothing", self.name));
        }
        faults
    }
}

impl fmt::Display for Cell {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "{:60} {:5} sent {:4} lost {:4} reported  recall {:.3} precision {:.3} ",
            self.name,
            self.sent.len(),
            self.lost.len(),
            self.reported.len(),
            self.recall(),
            self.precision()
        )?;
        for cause in LossCause::ALL {
            let count = self.losses_by(cause);
            if count > 0 {
                write!(f, " {} {count}", cause.label())?;
            }
        }
        Ok(())
    }
}

/// Returns the share of `whole`, which is 1 if `whole` is 0.
fn share(part: usize, whole: usize) -> f64 {
    match whole {
        0 => 1.0,
        _ => part as f64 / whole as f64,
    }
}
