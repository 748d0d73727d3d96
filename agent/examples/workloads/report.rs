//! The table, as Markdown, and what is not as it should be.

use std::fmt;

use crate::harness::peer::Stack;
use crate::window::{Observer, Told, Window};

pub(crate) const HEAD: &str = "\
| workload | DDS | agent CPU s | subscriber CPU s | ratio | of reference | agent PSS MB | subscriber PSS MB | workload CPU s: alone, + agent, + subscriber | machine CPU s: likewise | copied | counted / sent |
| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |";

/// All windows of one workload and DDS.
pub(crate) struct Row {
    name: &'static str,
    stack: Stack,
    reference: Option<f64>,
    windows: Vec<Window>,
}

/// What the agent may cost.
pub(crate) struct Targets {
    /// Of the subscriber's CPU time.
    of_subscriber: f64,
    /// Of the reference implementation's.
    of_reference: f64,
    pss: u64,
    /// Bytes copied, of the traffic, where samples are large.
    copied: f64,
}

/// One target that was not met.
pub(crate) struct Miss {
    what: String,
    /// It does not depend on how busy the machine is.
    pub(crate) fails: bool,
}

impl Default for Targets {
    fn default() -> Self {
        Targets {
            of_subscriber: 0.1,
            of_reference: 0.05,
            pss: 16_000_000,
            copied: 0.01,
        }
    }
}

impl Row {
    pub(crate) fn new(name: &'static str, stack: Stack, reference: Option<f64>) -> Row {
        Row {
            name,
            stack,
            reference,
            windows: Vec::new(),
        }
    }

    pub(crate) fn add(&mut self, window: Window) {
        self.windows.push(window);
    }

    pub(crate) fn missed(&self, targets: &Targets) -> Vec<Miss> {
        let mut missed = Vec::new();
        let mut miss = |fails, what: String| {
            missed.push(Miss {
                what: format!("{} with {:?}: {what}", self.name, self.stack),
                fails,
            });
        };
        let agent = self.cpu(Observer::Agent);
        for (whose, theirs, target) in [
            (
                "subscriber's",
                Some(self.cpu(Observer::Subscriber)),
                targets.of_subscriber,
            ),
            ("reference's", self.reference, targets.of_reference),
        ] {
            let share = theirs.map_or(0.0, |theirs| agent / theirs);
            if share > target {
                miss(
                    false,
                    format!("CPU is {share:.3} of the {whose}, aim {target}"),
                );
            }
        }
        if self.pss(Observer::Agent) > targets.pss {
            miss(
                true,
                format!("PSS is not below {} MB", targets.pss / 1_000_000),
            );
        }
        let large = self.name.contains("MB");
        for (window, told) in self.told() {
            if large && told.copied > targets.copied {
                miss(true, format!("{:.2} % copied", told.copied * 100.0));
            }
            if told.counted as u64 != window.sent {
                let Told {
                    counted,
                    lost,
                    dropped,
                    ..
                } = told;
                miss(
                    true,
                    format!(
                        "{counted:.0} of {} messages counted, {lost:.0} lost, {dropped:.0} dropped",
                        window.sent
                    ),
                );
            }
        }
        missed
    }

    fn of(&self, observer: Observer) -> impl Iterator<Item = &Window> {
        self.windows
            .iter()
            .filter(move |window| window.observer == observer)
    }

    fn told(&self) -> impl Iterator<Item = (&Window, &Told)> {
        self.windows
            .iter()
            .filter_map(|window| Some((window, window.told.as_ref()?)))
    }

    fn cpu(&self, observer: Observer) -> f64 {
        median(self.of(observer).map(|window| window.cpu))
    }

    /// Medians with nobody, with the agent and with a subscriber.
    fn three(&self, value: impl Fn(&Window) -> f64) -> String {
        let medians = Observer::ALL.map(|who| median(self.of(who).map(&value)));
        medians.map(|median| format!("{median:.2}")).join(", ")
    }

    fn pss(&self, observer: Observer) -> u64 {
        self.of(observer)
            .map(|window| window.pss)
            .max()
            .unwrap_or(0)
    }
}

impl fmt::Display for Row {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (agent, subscriber) = (self.cpu(Observer::Agent), self.cpu(Observer::Subscriber));
        let megabytes = |observer| self.pss(observer) as f64 / 1e6;
        let of_reference = self
            .reference
            .map_or_else(|| "-".to_owned(), |theirs| format!("{:.3}", agent / theirs));
        let workload = self.three(|window| window.workload);
        let machine = self.three(|window| window.machine);
        let copied = median(self.told().map(|(_, told)| told.copied)) * 100.0;
        let counted: f64 = self.told().map(|(_, told)| told.counted).sum();
        let sent: u64 = self.told().map(|(window, _)| window.sent).sum();
        write!(
            formatter,
            "| {} | {:?} | {agent:.4} | {subscriber:.3} | {:.3} | {of_reference} | {:.1} | {:.1} \
             | {workload} | {machine} | {copied:.3} % | {counted} / {sent} |",
            self.name,
            self.stack,
            agent / subscriber,
            megabytes(Observer::Agent),
            megabytes(Observer::Subscriber),
        )
    }
}

impl fmt::Display for Miss {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mark = if self.fails { "FAILED" } else { "missed" };
        write!(formatter, "{mark}: {}", self.what)
    }
}

fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    let at = |index| values.get(index).copied().unwrap_or(f64::NAN);
    f64::midpoint(at(values.len().saturating_sub(1) / 2), at(values.len() / 2))
}
