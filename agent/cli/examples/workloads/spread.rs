//! Minimum, median and maximum of alternating windows, and the additional cost of each observer.

use std::fmt;

use crate::subject::Subject;
use crate::window::{Observer, Window};

pub(crate) const HEAD: &str = "\
| workload | observer | windows | its CPU s | workload CPU s | median / alone | counted / sent |
| --- | --- | ---: | ---: | ---: | ---: | ---: |";

/// One observer, and the cost of its windows.
pub(crate) struct Windows {
    subject: Subject,
    cpu: Vec<f64>,
    workload: Vec<f64>,
    counted: f64,
    sent: u64,
}

/// The windows of one workload.
pub(crate) struct Spread {
    workload: String,
    observers: Vec<Windows>,
}

impl Windows {
    pub(crate) const fn new(subject: Subject) -> Windows {
        Windows {
            subject,
            cpu: Vec::new(),
            workload: Vec::new(),
            counted: 0.0,
            sent: 0,
        }
    }

    pub(crate) const fn subject(&self) -> &Subject {
        &self.subject
    }

    /// Adds a window, and returns its figures as text.
    pub(crate) fn add(&mut self, window: &Window) -> String {
        self.cpu.push(window.cpu);
        self.workload.push(window.workload);
        if let Some(totals) = &window.agent_totals {
            self.counted += totals.counted;
            self.sent += window.sent;
        }
        let name = self.subject.name();
        format!(
            "{name} {:.4} s, workload {:.3} s",
            window.cpu, window.workload
        )
    }
}

impl Spread {
    pub(crate) fn new(workload: String, mut observers: Vec<Windows>) -> Spread {
        observers.sort_by(|one, other| {
            let (one, other) = (&one.subject, &other.subject);
            let order = one.observer.cmp(&other.observer);
            order.then_with(|| other.note.cmp(one.note))
        });
        Spread {
            workload,
            observers,
        }
    }
}

impl fmt::Display for Spread {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut observers = self.observers.iter();
        let alone = observers.find(|windows| windows.subject.observer == Observer::None);
        let alone = alone.map(|windows| median(&windows.workload));
        for windows in &self.observers {
            let ratio = alone.map_or_else(
                || "-".to_owned(),
                |alone| format!("{:.3}", median(&windows.workload) / alone),
            );
            writeln!(
                formatter,
                "| {} | {} | {} | {} | {} | {ratio} | {} / {} |",
                self.workload,
                windows.subject.name(),
                windows.cpu.len(),
                spread(&windows.cpu, 4),
                spread(&windows.workload, 2),
                windows.counted,
                windows.sent,
            )?;
        }
        Ok(())
    }
}

/// Formats minimum, median and maximum.
fn spread(values: &[f64], digits: usize) -> String {
    let least = values.iter().copied().fold(f64::INFINITY, f64::min);
    let most = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let median = median(values);
    format!("{least:.digits$}, {median:.digits$}, {most:.digits$}")
}

fn median(values: &[f64]) -> f64 {
    crate::report::median(values.iter().copied())
}
