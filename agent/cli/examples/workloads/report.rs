//! The table, as Markdown, and the targets that were missed.

use std::fmt;

use crate::window::{AgentTotals, Observer, UNIT_SECONDS, Window};
use ros2probe_testing::harness::peer::Stack;
use ros2probe_testing::harness::usage::Memory;

const AGENTS: [(Observer, &str); 2] = [(Observer::Host, "host"), (Observer::Wire, "wire")];

pub(crate) const HEAD: &str = "\
| workload | DDS | agent CPU s: host, wire | subscriber CPU s | host / subscriber | host / reference | agent MB unreclaimable / RSS / PSS: host, wire | subscriber likewise | workload CPU s: alone, + host, + wire, + subscriber | + host / alone | machine CPU s: likewise | copied: host, wire | counted / sent |
| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |";

/// All windows of one workload and DDS.
pub(crate) struct Row {
    name: &'static str,
    stack: Stack,
    reference: Option<f64>,
    windows: Vec<Window>,
}

/// Limits for the agent's cost.
pub(crate) struct Targets {
    /// Maximum CPU time, as a fraction of the subscriber's.
    max_subscriber_ratio: f64,
    /// Maximum CPU time, as a fraction of the reference implementation's.
    max_reference_ratio: f64,
    /// Maximum number of bytes that cannot be reclaimed.
    unreclaimable: u64,
    /// Maximum fraction of the traffic that is copied, for large samples.
    copied: f64,
    /// Maximum fraction of a core for the agent with the host hook.
    max_core_share: f64,
    /// Maximum CPU time of all processes with the host hook, as a fraction of that without it, for
    /// large samples.
    of_workload: f64,
}

/// One target that was missed.
pub(crate) struct Miss {
    what: String,
    /// Whether the miss is a failure: the figure does not depend on the machine's load.
    pub(crate) fails: bool,
}

impl Miss {
    /// Creates a miss that fails on any machine.
    pub(crate) const fn failing(what: String) -> Miss {
        Miss { what, fails: true }
    }

    /// Creates a miss that is only noted, since it depends on the machine's load.
    pub(crate) const fn noted(what: String) -> Miss {
        Miss { what, fails: false }
    }
}

impl Default for Targets {
    fn default() -> Self {
        Targets {
            max_subscriber_ratio: 0.1,
            max_reference_ratio: 0.05,
            unreclaimable: 16_000_000,
            copied: 0.01,
            max_core_share: 0.001,
            of_workload: 1.02,
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
        for (observer_kind, name) in AGENTS {
            let agent = self.cpu(observer_kind);
            for (reference_name, reference_cpu, target) in [
                (
                    "subscriber's",
                    Some(self.cpu(Observer::Subscriber)),
                    targets.max_subscriber_ratio,
                ),
                ("reference's", self.reference, targets.max_reference_ratio),
            ] {
                let share = reference_cpu.map_or(0.0, |reference_cpu| agent / reference_cpu);
                if share > target {
                    miss(
                        false,
                        format!("{name} CPU is {share:.3} of the {reference_name}, aim {target}"),
                    );
                }
            }
            if self.memory(observer_kind).unreclaimable > targets.unreclaimable {
                miss(
                    true,
                    format!(
                        "{name} takes no less than {} MB that cannot be reclaimed",
                        targets.unreclaimable / 1_000_000
                    ),
                );
            }
        }
        let share = self.cpu(Observer::Host) / UNIT_SECONDS;
        if share > targets.max_core_share {
            miss(
                false,
                format!(
                    "host CPU is {:.3} % of a core, aim {} %",
                    share * 100.0,
                    targets.max_core_share * 100.0
                ),
            );
        }
        let more = self.without_observer(Observer::Host);
        if self.is_large() && more > targets.of_workload {
            miss(
                false,
                format!(
                    "with the host hook the workload takes {more:.3} of what it takes alone, aim {}",
                    targets.of_workload
                ),
            );
        }
        for (window, agent_totals) in self.agent_totals() {
            if self.is_large() && agent_totals.copied > targets.copied {
                miss(true, format!("{:.2} % copied", agent_totals.copied * 100.0));
            }
            if agent_totals.counted as u64 != window.sent {
                let AgentTotals {
                    counted,
                    lost,
                    dropped,
                    ..
                } = agent_totals;
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

    fn agent_totals(&self) -> impl Iterator<Item = (&Window, &AgentTotals)> {
        self.windows
            .iter()
            .filter_map(|window| Some((window, window.agent_totals.as_ref()?)))
    }

    fn cpu(&self, observer: Observer) -> f64 {
        median(self.of(observer).map(|window| window.cpu))
    }

    /// Returns the CPU time of all processes, as a fraction of that without an observer. It
    /// includes the observer's work in the kernel on behalf of other processes.
    fn without_observer(&self, observer: Observer) -> f64 {
        let median = |observer_kind| median(self.of(observer_kind).map(|window| window.workload));
        median(observer) / median(Observer::None)
    }

    fn is_large(&self) -> bool {
        !self.name.contains("320 B")
    }

    /// Returns the median for each observer.
    fn each(&self, value: impl Fn(&Window) -> f64) -> String {
        let medians = Observer::ALL.map(|observer_kind| median(self.of(observer_kind).map(&value)));
        medians.map(|median| format!("{median:.2}")).join(", ")
    }

    fn copied(&self, observer: Observer) -> f64 {
        let agent_totals = self
            .of(observer)
            .filter_map(|window| window.agent_totals.as_ref());
        median(agent_totals.map(|agent_totals| agent_totals.copied)) * 100.0
    }

    fn memory(&self, observer: Observer) -> Memory {
        let memory = self.of(observer).map(|window| window.memory);
        memory.fold(Memory::default(), Memory::max)
    }
}

impl fmt::Display for Row {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (host, wire) = (self.cpu(Observer::Host), self.cpu(Observer::Wire));
        let subscriber = self.cpu(Observer::Subscriber);
        let megabytes = |observer| self.memory(observer).megabytes();
        let of_reference = self.reference.map_or_else(
            || "-".to_owned(),
            |reference_cpu| format!("{:.3}", host / reference_cpu),
        );
        let counted: f64 = self
            .agent_totals()
            .map(|(_, agent_totals)| agent_totals.counted)
            .sum();
        let sent: u64 = self.agent_totals().map(|(window, _)| window.sent).sum();
        write!(
            formatter,
            "| {} | {:?} | {host:.4}, {wire:.4} | {subscriber:.3} | {:.3} | {of_reference} \
             | {}, {} | {} | {} | {:.3} | {} | {:.3} %, {:.3} % | {counted} / {sent} |",
            self.name,
            self.stack,
            host / subscriber,
            megabytes(Observer::Host),
            megabytes(Observer::Wire),
            megabytes(Observer::Subscriber),
            self.each(|window| window.workload),
            self.without_observer(Observer::Host),
            self.each(|window| window.machine),
            self.copied(Observer::Host),
            self.copied(Observer::Wire),
        )
    }
}

impl fmt::Display for Miss {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mark = if self.fails { "FAILED" } else { "missed" };
        write!(formatter, "{mark}: {}", self.what)
    }
}

/// Returns the median; NaN without values.
pub(crate) fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    let at = |index| values.get(index).copied().unwrap_or(f64::NAN);
    f64::midpoint(at(values.len().saturating_sub(1) / 2), at(values.len() / 2))
}
