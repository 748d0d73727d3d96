//! Times of a question, and the thread that reads the store for the answer.

use std::sync::Arc;
use std::time::Duration;

use serde::Deserialize;
use tokio::sync::{Semaphore, SemaphorePermit};
use utoipa::IntoParams;

use super::super::Context;
use super::super::problem::{Code, Problem};
use super::super::scope::Domain;
use super::super::turns::{NoResult, run_blocking_for};
use super::writer::seconds;
use ros2probe_history::Store;

/// Number of answers that read the storage at the same time.
pub(super) const MAX_READERS: usize = 2;
pub(super) static READER_PERMITS: Semaphore = Semaphore::const_new(MAX_READERS);
/// Maximum number of rows in an answer; a smaller step becomes longer.
const MAX_ROWS: u32 = 2_000;
/// Number of rows in an answer without `step`.
const DEFAULT_ROWS: u32 = 600;
/// Time of an answer without `from`, in seconds.
const DEFAULT_SPAN_SECONDS: u32 = 3_600;
/// Maximum time of an answer.
const READ_TIMEOUT: Duration = Duration::from_secs(10);

/// Times of a question.
#[derive(Clone, Copy, Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields, default)]
#[into_params(parameter_in = Query)]
pub(in super::super) struct TimeRange {
    /// Unix time of the begin; an hour before `to` by default.
    #[param(example = 1_790_000_000)]
    pub(in super::super) from: Option<f64>,
    /// Unix time of the end; now by default.
    #[param(example = 1_790_003_600)]
    pub(in super::super) to: Option<f64>,
    /// Seconds between two rows; by default so many that there are at most 600 rows. There are
    /// never more than 2000.
    #[param(minimum = 1)]
    pub(in super::super) step: Option<u32>,
}

/// Times of a question about one topic.
#[derive(Clone, Copy, Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields, default)]
#[into_params(parameter_in = Query)]
pub(in super::super) struct TopicRange {
    /// Domain id; required only if the name exists in several domains.
    #[param(minimum = 0, maximum = 232)]
    domain_id: Option<u32>,
    /// Unix time of the begin in the history on disk; an hour before `to` by default.
    #[param(example = 1_790_000_000)]
    from: Option<f64>,
    /// Unix time of the end; now by default.
    #[param(example = 1_790_003_600)]
    to: Option<f64>,
    /// Seconds between two rows; by default so many that there are at most 600 rows. There are
    /// never more than 2000.
    #[param(minimum = 1)]
    step: Option<u32>,
}

/// Times that were checked.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in super::super) struct Times {
    pub(super) from: u32,
    pub(super) to: u32,
    pub(super) step: u32,
}

impl TopicRange {
    /// Returns the domain and, unless only the last minutes are requested, the times.
    pub(in super::super) fn parts(self) -> (Domain, Option<TimeRange>) {
        let Self {
            domain_id,
            from,
            to,
            step,
        } = self;
        let is_empty = from.is_none() && to.is_none() && step.is_none();
        let range = (!is_empty).then_some(TimeRange { from, to, step });
        (Domain::of(domain_id), range)
    }
}

impl TimeRange {
    /// # Errors
    /// Fails if the end is before the begin, or a number is impossible.
    pub(in super::super) fn checked(self, now: u32) -> Result<Times, Problem> {
        let to = self.to.map_or(Ok(now), second)?;
        let from = self
            .from
            .map_or(Ok(to.saturating_sub(DEFAULT_SPAN_SECONDS)), second)?;
        let span = to.checked_sub(from).filter(|span| *span > 0);
        let span = span.ok_or_else(|| invalid("`to` must be later than `from`"))?;
        let step = match self.step {
            None => span.div_ceil(DEFAULT_ROWS),
            Some(0) => return Err(invalid("`step` must be at least 1")),
            Some(step) => step.max(span.div_ceil(MAX_ROWS)),
        };
        Ok(Times { from, to, step })
    }
}

impl Times {
    /// Returns the times after `from` and up to `to`.
    pub(super) const fn times(&self) -> std::ops::Range<u32> {
        self.from..self.to
    }
}

/// Returns a Unix time in whole seconds.
///
/// # Errors
/// Fails if it is before 1970 or after 2106.
pub(super) fn second(time: f64) -> Result<u32, Problem> {
    let whole = time.round();
    if !(0.0..=f64::from(u32::MAX)).contains(&whole) {
        return Err(invalid("a time is the number of seconds since 1970"));
    }
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "checked above"
    )]
    let whole = whole as u32;
    Ok(whole)
}

/// Returns the current time of the source.
pub(super) fn now(context: &Context) -> u32 {
    seconds(context.latest.state().known().time())
}

/// Permission to read the store, which ends when the answer is created.
pub(super) type ReaderPermit = SemaphorePermit<'static>;

/// Reads the store on another thread. A storage that hangs holds [`MAX_READERS`] threads, whatever
/// the number of clients, and no client longer than [`READ_TIMEOUT`].
///
/// # Errors
/// Fails if no history is kept, if the storage does not answer, or if the agent stops.
pub(super) async fn read_store<T: Send + 'static>(
    context: &Context,
    read: impl FnOnce(&Store) -> T + Send + 'static,
) -> Result<(T, ReaderPermit), Problem> {
    let missing = |detail| Problem::new(Code::NoHistory, detail);
    let none = "no history is kept on disk: it needs a readable state directory, and page.history_bytes above 0";
    let history = Arc::clone(&context.disk_history);
    if !history.is_kept() {
        return Err(missing(none));
    }
    let answer = run_blocking_for(&READER_PERMITS, READ_TIMEOUT, move || {
        history.opened().map(read)
    })
    .await;
    match answer {
        Ok((answer, permit)) => Ok((answer.ok_or_else(|| missing(none))?, permit)),
        Err(NoResult::Late) => Err(missing("the storage of the history does not answer")),
        Err(NoResult::Ending) => Err(Problem::new(Code::Ending, "the agent is shutting down")),
    }
}

fn invalid(detail: &'static str) -> Problem {
    Problem::new(Code::InvalidRequest, detail)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_range_has_at_most_as_many_rows_as_an_answer_may_have() {
        let range = |from: f64, to: f64, step: Option<u32>| {
            let (from, to) = (Some(from), Some(to));
            TimeRange { from, to, step }.checked(5_000)
        };
        let times = |from, to, step| Times { from, to, step };
        assert_eq!(range(0.0, 600.0, None).unwrap(), times(0, 600, 1));
        assert_eq!(range(0.0, 86_400.0, None).unwrap(), times(0, 86_400, 144));
        assert_eq!(range(0.0, 86_400.0, Some(1)).unwrap(), times(0, 86_400, 44));
        assert_eq!(
            range(0.0, 86_400.0, Some(600)).unwrap(),
            times(0, 86_400, 600)
        );
        let hour = TimeRange::default().checked(5_000).unwrap();
        assert_eq!(hour, times(1_400, 5_000, 6));
        for (from, to, step) in [
            (600.0, 600.0, None),
            (601.0, 600.0, None),
            (-1.0, 600.0, None),
            (0.0, 1e10, None),
            (f64::NAN, 600.0, None),
            (0.0, 600.0, Some(0)),
        ] {
            let code = range(from, to, step).unwrap_err().code();
            assert_eq!(code, Code::InvalidRequest, "{from} {to} {step:?}");
        }
    }
}
