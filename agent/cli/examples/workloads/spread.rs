//! Minimum, median and maximum of alternating windows, and the additional cost of each observer.

use std::fmt;
use std::path::{Path, PathBuf};

use crate::window::{Observer, Window};

pub(crate) const HEAD: &str = "\
| workload | observer | windows | its CPU s | workload CPU s | median / alone | counted / sent |
| --- | --- | ---: | ---: | ---: | ---: | ---: |";

/// One observer, and the cost of its windows.
pub(crate) struct Subject {
    observer: Observer,
    program: PathBuf,
    note: &'static str,
    cpu: Vec<f64>,
    workload: Vec<f64>,
    counted: f64,
    sent: u64,
}

/// The windows of one workload.
pub(crate) struct Spread {
    workload: String,
    subjects: Vec<Subject>,
}

impl Subject {
    pub(crate) fn new(observer: Observer, program: &Path, note: &'static str) -> Subject {
        Subject {
            observer,
            program: program.to_path_buf(),
            note,
            cpu: Vec::new(),
            workload: Vec::new(),
            counted: 0.0,
            sent: 0,
        }
    }

    pub(crate) fn observer(&self) -> Observer {
        self.observer
    }

    pub(crate) fn program(&self) -> &Path {
        &self.program
    }

    /// Adds a window, and returns its figures as text.
    pub(crate) fn add(&mut self, window: &Window) -> String {
        self.cpu.push(window.cpu);
        self.workload.push(window.workload);
        if let Some(totals) = &window.agent_totals {
            self.counted += totals.counted;
            self.sent += window.sent;
        }
        let name = self.name();
        format!(
            "{name} {:.4} s, workload {:.3} s",
            window.cpu, window.workload
        )
    }

    fn name(&self) -> String {
        format!("{:?}{}", self.observer, self.note).to_lowercase()
    }
}

impl Spread {
    pub(crate) fn new(workload: String, mut subjects: Vec<Subject>) -> Spread {
        subjects.sort_by(|one, other| {
            let order = one.observer.cmp(&other.observer);
            order.then_with(|| other.note.cmp(one.note))
        });
        Spread { workload, subjects }
    }
}

impl fmt::Display for Spread {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut subjects = self.subjects.iter();
        let alone = subjects.find(|subject| subject.observer == Observer::None);
        let alone = alone.map(|subject| median(&subject.workload));
        for subject in &self.subjects {
            let ratio = alone.map_or_else(
                || "-".to_owned(),
                |alone| format!("{:.3}", median(&subject.workload) / alone),
            );
            writeln!(
                formatter,
                "| {} | {} | {} | {} | {} | {ratio} | {} / {} |",
                self.workload,
                subject.name(),
                subject.cpu.len(),
                spread(&subject.cpu, 4),
                spread(&subject.workload, 2),
                subject.counted,
                subject.sent,
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
