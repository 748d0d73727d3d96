//! A scrape as text: OpenMetrics 1.0 if the client requests it, otherwise classic Prometheus text.
//! `prometheus-client` writes both from one collector over the agent's figures; its registry holds
//! no series.
//!
//! Classic text remains because some clients request nothing else: VictoriaMetrics
//! (`lib/promscrape/client.go`), Netdata (`src/go/plugins/pkg/prometheus`) and Telegraf
//! (`plugins/inputs/prometheus`) by default, the Datadog agent without `use_latest_spec`, and
//! browsers.

use std::fmt::{self, Write};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use prometheus_client::collector::Collector;
use prometheus_client::encoding::{DescriptorEncoder, prometheus_text, text};
use prometheus_client::registry::Registry;

use crate::exemplar_lines::{ExemplarLines, Waiting};
use crate::metric_sink::MetricSink;
use crate::metric_source::MetricSource;

/// The two text formats.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// `application/openmetrics-text; version=1.0.0`.
    OpenMetrics,
    /// `text/plain; version=0.0.4`.
    Classic,
}

/// Writes scrapes.
#[derive(Debug)]
pub struct Exposition {
    registry: Registry,
    source: Arc<dyn MetricSource>,
    last_scrape_nanoseconds: Arc<AtomicU64>,
}

/// The collector of all families.
#[derive(Debug)]
struct Page {
    source: Arc<dyn MetricSource>,
    last_scrape_nanoseconds: Arc<AtomicU64>,
    /// Accepts exemplars, if the page shows them.
    exemplars: Option<Arc<Waiting>>,
}

impl Format {
    /// Returns the best format that an `Accept` header allows; classic text by default.
    #[must_use]
    pub fn negotiate(accept: &str) -> Self {
        let quality = |wanted: fn(&str) -> bool| {
            let offers = accept.split(',').filter_map(|offer| {
                let mut parameters = offer.split(';').map(str::trim);
                let media = parameters.next().unwrap_or_default();
                let mut weight = 1.0;
                for parameter in parameters {
                    match parameter.split_once('=') {
                        Some(("q", value)) => weight = value.parse().unwrap_or(0.0),
                        Some(("version", version))
                            if media == OPENMETRICS_TYPE
                                && !["1.0.0", "0.0.1"].contains(&version) =>
                        {
                            return None;
                        }
                        _ => {}
                    }
                }
                wanted(media).then_some(weight)
            });
            offers.fold(0.0_f32, f32::max)
        };
        let openmetrics = quality(|media| media == OPENMETRICS_TYPE);
        let classic = quality(|media| media == "text/plain");
        if openmetrics > 0.0 && openmetrics >= classic {
            Self::OpenMetrics
        } else {
            Self::Classic
        }
    }

    /// Returns the value of the response's `Content-Type`.
    #[must_use]
    pub const fn content_type(self) -> &'static str {
        match self {
            Self::OpenMetrics => "application/openmetrics-text; version=1.0.0; charset=utf-8",
            Self::Classic => prometheus_text::CONTENT_TYPE,
        }
    }
}

const OPENMETRICS_TYPE: &str = "application/openmetrics-text";

impl Exposition {
    /// Creates an exposition of this source.
    #[must_use]
    pub fn new(source: impl MetricSource + 'static) -> Self {
        let source: Arc<dyn MetricSource> = Arc::new(source);
        let last_scrape_nanoseconds = Arc::default();
        let page = Page {
            source: Arc::clone(&source),
            last_scrape_nanoseconds: Arc::clone(&last_scrape_nanoseconds),
            exemplars: None,
        };
        Self {
            registry: page.registry(),
            source,
            last_scrape_nanoseconds,
        }
    }

    /// Returns the complete page.
    ///
    /// # Errors
    /// Never fails in practice, because it writes to memory.
    pub fn render(&self, format: Format) -> Result<String, fmt::Error> {
        let mut page = String::new();
        self.write(format, &mut page)?;
        Ok(page)
    }

    /// Writes the complete page, in pieces of a few kilobytes.
    ///
    /// # Errors
    /// Fails if `page` does.
    pub fn write(&self, format: Format, page: &mut impl Write) -> fmt::Result {
        let start = Instant::now();
        match format {
            Format::OpenMetrics if self.source.has_exemplars() => self.write_exemplars(page)?,
            Format::OpenMetrics => text::encode(page, &self.registry)?,
            Format::Classic => prometheus_text::encode(page, &self.registry)?,
        }
        let took = u64::try_from(start.elapsed().as_nanos()).unwrap_or(u64::MAX);
        self.last_scrape_nanoseconds.store(took, Ordering::Relaxed);
        Ok(())
    }

    /// Writes a page whose collector and writer share exemplars.
    fn write_exemplars(&self, page: &mut impl Write) -> fmt::Result {
        let waiting = Arc::<Waiting>::default();
        let collector = Page {
            source: Arc::clone(&self.source),
            last_scrape_nanoseconds: Arc::clone(&self.last_scrape_nanoseconds),
            exemplars: Some(Arc::clone(&waiting)),
        };
        let mut lines = ExemplarLines::new(page, &waiting);
        text::encode(&mut lines, &collector.registry())
    }
}

impl Page {
    fn registry(self) -> Registry {
        let mut registry = Registry::default();
        registry.register_collector(Box::new(self));
        registry
    }
}

impl Collector for Page {
    fn encode(&self, encoder: DescriptorEncoder<'_>) -> fmt::Result {
        let last = Duration::from_nanos(self.last_scrape_nanoseconds.load(Ordering::Relaxed));
        let mut sink = MetricSink::page(encoder, self.exemplars.clone());
        self.source.collect(&mut sink, last)
    }
}
