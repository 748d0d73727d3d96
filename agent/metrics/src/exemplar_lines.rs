//! Exemplars of chains on an OpenMetrics page.
//!
//! `prometheus-client` 0.26 encodes exemplars, but only its own histograms create them: the fields
//! of its `Exemplar` are private, and it has no constructor. The collector therefore passes
//! exemplars to the writer of the page, which appends each one to the line of its bucket. This
//! module can be removed once the library has a constructor.

use std::collections::VecDeque;
use std::fmt::{self, Write};
use std::sync::{Mutex, PoisonError};

use crate::catalogue::{CHAIN_LATENCY, HOP_LATENCY};
use ros2probe_model::derive::chain::exemplar::{Exemplar, Exemplars};

/// Families whose histograms have exemplars.
const EXEMPLAR_FAMILIES: [&str; 2] = [CHAIN_LATENCY.name, HOP_LATENCY.name];
const NANOSECONDS_PER_SECOND: u64 = 1_000_000_000;

/// Exemplars of the histograms of [`EXEMPLAR_FAMILIES`] whose lines are not written yet, in order.
#[derive(Debug, Default)]
pub(crate) struct Waiting(Mutex<VecDeque<(Exemplars, usize)>>);

/// Writes a page with its exemplars.
pub(crate) struct ExemplarLines<'a, W> {
    page: &'a mut W,
    waiting: &'a Waiting,
    /// Beginning of a line.
    line: String,
}

impl Waiting {
    /// Adds the exemplars of a histogram with this number of buckets.
    pub(crate) fn add(&self, exemplars: &Exemplars, buckets: usize) {
        let mut waiting = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        waiting.extend((0..buckets).map(|bucket| (exemplars.clone(), bucket)));
    }

    /// Returns the exemplar of the next bucket.
    fn next(&self) -> Option<Exemplar> {
        let mut waiting = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let (exemplars, bucket) = waiting.pop_front()?;
        exemplars.get(bucket).copied()
    }
}

impl<'a, W: Write> ExemplarLines<'a, W> {
    pub(crate) const fn new(page: &'a mut W, waiting: &'a Waiting) -> Self {
        Self {
            page,
            waiting,
            line: String::new(),
        }
    }

    fn end_line(&mut self, line: &str) -> fmt::Result {
        let is_bucket = |family: &str| {
            let rest = line.strip_prefix(family);
            rest.is_some_and(|rest| rest.starts_with("_bucket{"))
        };
        let is_bucket = EXEMPLAR_FAMILIES.into_iter().any(is_bucket);
        let Some(exemplar) = is_bucket.then(|| self.waiting.next()).flatten() else {
            return self.page.write_str(line);
        };
        let (trace_id, at) = (exemplar.trace_id, exemplar.at.0);
        writeln!(
            self.page,
            "{} # {{trace_id=\"{trace_id:032x}\"}} {} {}.{:09}",
            line.trim_end_matches('\n'),
            exemplar.seconds,
            at / NANOSECONDS_PER_SECOND,
            at % NANOSECONDS_PER_SECOND
        )
    }
}

/// A page must end with a line break, since only complete lines are written.
impl<W: Write> Write for ExemplarLines<'_, W> {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        for part in text.split_inclusive('\n') {
            let mut line = std::mem::take(&mut self.line);
            line.push_str(part);
            if part.ends_with('\n') {
                self.end_line(&line)?;
                line.clear();
            }
            self.line = line;
        }
        Ok(())
    }
}
