//! A bound of the series that begin in an hour. A receiver keeps each of them in memory for hours.
//! Names that are new again and again, as those with a UUID, would exhaust it.

use std::collections::HashSet;
use std::hash::{BuildHasher as _, RandomState};
use std::time::{Duration, Instant};

use super::samples::parts;

const HOUR: Duration = Duration::from_hours(1);

/// The series that began in this hour. One that ends and begins again counts once.
#[derive(Debug, Default)]
pub(super) struct NewSeries {
    /// Maximum number of series in an hour; zero = no limit.
    limit: usize,
    /// Begin of the hour.
    since: Option<Instant>,
    /// Hashes of the series.
    begun: HashSet<u64>,
    hasher: RandomState,
    is_logged: bool,
}

impl NewSeries {
    pub(super) fn new(limit: usize) -> Self {
        Self {
            limit,
            ..Self::default()
        }
    }

    /// Begins another hour if the previous one is over.
    pub(super) fn at(&mut self, now: Instant) {
        let is_over = |since| now.saturating_duration_since(since) >= HOUR;
        if self.since.is_none_or(is_over) {
            self.since = Some(now);
            self.begun.clear();
            self.is_logged = false;
        }
    }

    /// Returns whether a series may begin. The log names the first one of an hour that may not.
    pub(super) fn admit(&mut self, key: &[u8]) -> bool {
        let hash = self.hasher.hash_one(key);
        if self.limit == 0 || self.begun.contains(&hash) {
            return true;
        }
        if self.begun.len() < self.limit {
            return self.begun.insert(hash);
        }
        if !std::mem::replace(&mut self.is_logged, true) {
            let series = parts(key).1.collect::<Vec<_>>().join(" ");
            let limit = self.limit;
            tracing::warn!(
                series,
                limit,
                "too many series begin in an hour: remote write omits further ones"
            );
        }
        false
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_that_are_always_new_do_not_begin_series_without_end() {
        let begun = Instant::now();
        let mut series = NewSeries::new(3);
        series.at(begun);
        let key = |name: &str| format!("g{name}").into_bytes();
        let admitted = |series: &mut NewSeries, names: &[&str]| {
            let admitted = names.iter().filter(|name| series.admit(&key(name)));
            admitted.copied().collect::<Vec<_>>().join(" ")
        };
        assert_eq!(
            admitted(&mut series, &["a", "b", "a", "c", "d", "e"]),
            "a b a c"
        );
        // One that ended begins again.
        series.at(begun + HOUR / 2);
        assert_eq!(admitted(&mut series, &["d", "b", "c"]), "b c");
        series.at(begun + HOUR);
        assert_eq!(admitted(&mut series, &["d", "e", "f", "a"]), "d e f");
        let mut series = NewSeries::new(0);
        series.at(begun);
        assert_eq!(admitted(&mut series, &["a", "b", "c", "d"]), "a b c d");
    }
}
