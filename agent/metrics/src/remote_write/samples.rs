//! Samples of one collection, with the names and labels that a scrape of the page has.

use std::collections::HashMap;
use std::fmt::{self, Write as _};
use std::sync::Arc;
use std::time::Instant;

use ros2probe_model::facts::histogram::Histogram;

use super::new_series::NewSeries;
use crate::catalogue::{Kind, Metric};
use crate::metric_sink::{Label, Number};

/// Maximum number of series of a collection, and of a file of the queue before the next collection.
/// The tables of the model allow fewer.
pub(super) const MAX_SERIES: usize = 100_000;
/// Ends each text of a key. No text contains it, because UTF-8 does not.
pub(super) const TEXT_END: u8 = 0xff;
/// Value of a series that ended (`StaleNaN` of Prometheus).
pub(super) const STALE_NAN: f64 = f64::from_bits(0x7ff0_0000_0000_0002);

/// A series: the type of its metric as one byte, its name, and names and values of its labels.
/// [`TEXT_END`] ends each text.
pub(super) type Key = Arc<[u8]>;

/// The samples of one moment.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Scrape {
    /// Milliseconds since 1970.
    pub(super) at: i64,
    /// Each series once.
    pub(super) samples: Vec<(Key, f64)>,
}

/// Collects samples, and remembers the series of the previous collection.
#[derive(Debug, Default)]
pub(crate) struct Samples {
    metric: Option<&'static Metric>,
    /// Series of this collection and of the previous one, with the number of the last one.
    known: HashMap<Key, u64>,
    collection: u64,
    collected: Vec<(Key, f64)>,
    /// Samples that exceed [`MAX_SERIES`].
    refused: u64,
    new_series: NewSeries,
    /// Samples of series that [`NewSeries`] does not admit.
    omitted: u64,
    key: Vec<u8>,
    text: String,
}

impl Samples {
    /// Creates a collector without series, of which at most this number begins in an hour; zero =
    /// no limit.
    pub(super) fn new(max_new_series: usize) -> Self {
        Self {
            new_series: NewSeries::new(max_new_series),
            ..Self::default()
        }
    }

    /// Begins a collection.
    pub(super) fn begin(&mut self) {
        self.collection += 1;
        self.new_series.at(Instant::now());
        self.collected = Vec::with_capacity(self.known.len());
        self.key.clear();
        self.key.push(kind(Kind::Gauge));
        self.extend("up");
        self.add(1.0);
    }

    /// Ends a collection. Returns its samples, with [`STALE_NAN`] for each series that ended, and
    /// the number of samples that did not fit.
    pub(super) fn end(&mut self, at: i64) -> (Scrape, u64) {
        let mut samples = std::mem::take(&mut self.collected);
        self.known.retain(|key, last| {
            let continues = *last == self.collection;
            if !continues {
                samples.push((Arc::clone(key), STALE_NAN));
            }
            continues
        });
        (Scrape { at, samples }, std::mem::take(&mut self.refused))
    }

    /// Returns the number of samples that were omitted since the last call.
    pub(super) fn take_omitted(&mut self) -> u64 {
        std::mem::take(&mut self.omitted)
    }

    /// Returns the end of all series.
    pub(super) fn end_all(&mut self, at: i64) -> Scrape {
        let samples = self
            .known
            .drain()
            .map(|(key, _)| (key, STALE_NAN))
            .collect();
        Scrape { at, samples }
    }

    /// Begins a family.
    pub(crate) const fn open(&mut self, metric: &'static Metric) {
        self.metric = Some(metric);
    }

    /// Adds a sample of a counter, gauge or info.
    #[expect(
        clippy::cast_precision_loss,
        reason = "Prometheus has only real values"
    )]
    pub(crate) fn number(&mut self, labels: &[Label<'_>], value: Number) {
        let Some(metric) = self.metric else {
            return;
        };
        self.series(metric, "", labels);
        self.add(match (metric.kind, value) {
            (Kind::Info, _) => 1.0,
            (_, Number::Count(count)) => count as f64,
            (_, Number::Real(real)) => real,
        });
    }

    /// Adds the samples of a histogram.
    #[expect(
        clippy::cast_precision_loss,
        reason = "Prometheus has only real values"
    )]
    pub(crate) fn histogram(&mut self, labels: &[Label<'_>], values: &Histogram) {
        let Some(metric) = self.metric else {
            return;
        };
        self.series(metric, "_sum", labels);
        self.add(values.sum());
        self.series(metric, "_count", labels);
        self.add(values.count() as f64);
        let mut up_to = 0;
        for (bound, count) in values.buckets() {
            up_to += count;
            self.series(metric, "_bucket", labels);
            self.extend("le");
            self.text.clear();
            // Writing to memory cannot fail.
            let _ = write_bound(&mut self.text, bound);
            self.extend_by_text();
            self.add(up_to as f64);
        }
    }

    /// Sets the key to that of a series.
    fn series(&mut self, metric: &'static Metric, suffix: &str, labels: &[Label<'_>]) {
        self.key.clear();
        self.key.push(kind(metric.kind));
        self.key.extend_from_slice(metric.name.as_bytes());
        self.extend(suffix);
        for (name, label) in metric.labels.iter().zip(labels) {
            self.extend(name);
            self.text.clear();
            let _ = label.write(&mut self.text);
            self.extend_by_text();
        }
    }

    fn extend(&mut self, text: &str) {
        self.key.extend_from_slice(text.as_bytes());
        self.key.push(TEXT_END);
    }

    fn extend_by_text(&mut self) {
        self.key.extend_from_slice(self.text.as_bytes());
        self.key.push(TEXT_END);
    }

    fn add(&mut self, value: f64) {
        let key = match self.known.get_key_value(self.key.as_slice()) {
            Some((key, _)) => Arc::clone(key),
            None if self.known.len() >= MAX_SERIES => {
                self.refused += 1;
                return;
            }
            None if !self.new_series.admit(&self.key) => {
                self.omitted += 1;
                return;
            }
            None => Arc::from(self.key.as_slice()),
        };
        self.known.insert(Arc::clone(&key), self.collection);
        self.collected.push((key, value));
    }
}

/// Writes the upper bound of a bucket as Prometheus stores it after a scrape: with a decimal point,
/// or below 1e-4 with an exponent of at least two digits.
fn write_bound(text: &mut String, bound: f64) -> fmt::Result {
    if bound.is_infinite() {
        return text.write_str("+Inf");
    }
    if bound > 0.0 && bound < 1e-4 {
        let short = format!("{bound:e}");
        let (digits, exponent) = short.split_once("e-").unwrap_or((short.as_str(), "0"));
        return write!(text, "{digits}e-{exponent:0>2}");
    }
    write!(text, "{bound:?}")
}

/// Returns the first byte of keys: the number of the type in version 2.0 (`Metadata.MetricType`).
const fn kind(kind: Kind) -> u8 {
    match kind {
        Kind::Counter => 1,
        Kind::Gauge => 2,
        Kind::Histogram => 3,
        Kind::Info => 6,
    }
}

/// Returns the type of a key, and its texts: name, and names and values of labels.
pub(super) fn parts(key: &[u8]) -> (u8, impl Iterator<Item = &str>) {
    let (kind, texts) = key
        .split_first()
        .map_or((0, key), |(kind, rest)| (*kind, rest));
    let texts = texts.split_inclusive(|byte| *byte == TEXT_END);
    let texts =
        texts.map(|text| std::str::from_utf8(text.strip_suffix(&[TEXT_END]).unwrap_or(text)));
    (kind, texts.map(Result::unwrap_or_default))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::catalogue::{OTLP_EXPORTS, SUBSCRIPTIONS};

    fn texts(scrape: &Scrape) -> Vec<(String, f64)> {
        let text = |key: &Key| parts(key).1.collect::<Vec<_>>().join(" ");
        let samples = scrape.samples.iter();
        samples.map(|(key, value)| (text(key), *value)).collect()
    }

    #[test]
    fn bounds_are_those_that_prometheus_stores_after_a_scrape() {
        for (bound, expected) in [
            (1e-12, "1e-12"),
            (0.00001, "1e-05"),
            (0.000025, "2.5e-05"),
            (0.0001, "0.0001"),
            (0.5, "0.5"),
            (10.0, "10.0"),
            (f64::INFINITY, "+Inf"),
        ] {
            let mut text = String::new();
            write_bound(&mut text, bound).unwrap();
            assert_eq!(text, expected);
        }
    }

    #[test]
    fn series_beyond_the_cap_have_no_samples() {
        let mut samples = Samples::default();
        samples.begin();
        samples.open(&OTLP_EXPORTS);
        for number in 0..MAX_SERIES as u64 {
            let labels = [Label::Number(number), Label::Text("failed")];
            samples.number(&labels, Number::Count(1));
        }
        let (scrape, refused) = samples.end(7);
        // One place is that of `up`.
        assert_eq!((scrape.samples.len(), refused), (MAX_SERIES, 1));
    }

    #[test]
    fn an_ended_series_gets_one_staleness_marker() {
        let mut samples = Samples::default();
        let mut collect = |requests: Option<u64>| {
            samples.begin();
            samples.open(&SUBSCRIPTIONS);
            samples.number(&[], Number::Real(2.5));
            samples.open(&OTLP_EXPORTS);
            let labels = [Label::Text("log"), Label::Text("failed")];
            requests
                .into_iter()
                .for_each(|count| samples.number(&labels, Number::Count(count)));
            samples.end(7)
        };
        let always = [
            ("up".to_owned(), 1.0),
            ("ros2probe_subscriptions".to_owned(), 2.5),
        ];
        let requests = "ros2probe_otlp_exports_total signal log outcome failed";
        let (first, refused) = collect(Some(3));
        assert_eq!((first.at, refused), (7, 0));
        let with = always.iter().cloned().chain([(requests.to_owned(), 3.0)]);
        assert_eq!(texts(&first), with.collect::<Vec<_>>());
        let second = texts(&collect(None).0);
        assert_eq!(second[..2], always);
        assert_eq!(second[2].0, requests);
        assert_eq!(second[2].1.to_bits(), STALE_NAN.to_bits());
        assert_eq!(texts(&collect(None).0), always);
        assert!(
            texts(&samples.end_all(9))
                .iter()
                .all(|(_, value)| value.is_nan())
        );
        assert_eq!(samples.end_all(9).samples, []);
    }
}
