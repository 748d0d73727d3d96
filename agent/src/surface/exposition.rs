//! One scrape as text: OpenMetrics 1.0 when the client asks for it, classic Prometheus text
//! otherwise. Both come from the same writer, so they cannot disagree.

use std::fmt::{self, Write};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use prometheus_client::collector::Collector;
use prometheus_client::encoding::{DescriptorEncoder, text};
use prometheus_client::registry::Registry;

use super::board::Board;
use super::page::Page;
use super::walk::walk;

/// The two text formats.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// `application/openmetrics-text; version=1.0.0`.
    OpenMetrics,
    /// `text/plain; version=0.0.4`.
    Classic,
}

/// Writes scrapes of a board.
#[derive(Debug)]
pub struct Exposition {
    registry: Registry,
    last_scrape_nanoseconds: Arc<AtomicU64>,
}

impl Format {
    /// The best of what an `Accept` header allows; classic text when it says nothing.
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
                            if media == OPENMETRICS && !["1.0.0", "0.0.1"].contains(&version) =>
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
        let openmetrics = quality(|media| media == OPENMETRICS);
        let classic = quality(|media| media == "text/plain");
        if openmetrics > 0.0 && openmetrics >= classic {
            Self::OpenMetrics
        } else {
            Self::Classic
        }
    }

    /// The answer's `Content-Type`.
    #[must_use]
    pub const fn content_type(self) -> &'static str {
        match self {
            Self::OpenMetrics => "application/openmetrics-text; version=1.0.0; charset=utf-8",
            Self::Classic => "text/plain; version=0.0.4; charset=utf-8",
        }
    }
}

const OPENMETRICS: &str = "application/openmetrics-text";

impl Exposition {
    /// Of what is pinned to `board`.
    #[must_use]
    pub fn new(board: Arc<Board>) -> Self {
        let last_scrape_nanoseconds = Arc::new(AtomicU64::new(0));
        let mut registry = Registry::default();
        let last_scrape = Arc::clone(&last_scrape_nanoseconds);
        registry.register_collector(Box::new(Scrape { board, last_scrape }));
        Self {
            registry,
            last_scrape_nanoseconds,
        }
    }

    /// The whole page.
    ///
    /// # Errors
    /// Never while writing to memory; the formatting machinery wants to be asked.
    pub fn render(&self, format: Format) -> Result<String, fmt::Error> {
        let mut page = String::new();
        self.write(format, &mut page)?;
        Ok(page)
    }

    /// Writes the whole page.
    ///
    /// # Errors
    /// `page` takes no more.
    pub fn write(&self, format: Format, page: &mut impl Write) -> fmt::Result {
        let start = Instant::now();
        match format {
            Format::OpenMetrics => text::encode(page, &self.registry)?,
            Format::Classic => text::encode(&mut Classic::new(page), &self.registry)?,
        }
        let took = u64::try_from(start.elapsed().as_nanos()).unwrap_or(u64::MAX);
        self.last_scrape_nanoseconds.store(took, Ordering::Relaxed);
        Ok(())
    }
}

/// Called by the registry on each scrape.
#[derive(Debug)]
struct Scrape {
    board: Arc<Board>,
    last_scrape: Arc<AtomicU64>,
}

impl Collector for Scrape {
    fn encode(&self, encoder: DescriptorEncoder<'_>) -> fmt::Result {
        let last_scrape = Duration::from_nanos(self.last_scrape.load(Ordering::Relaxed));
        walk(&mut Page::Text(encoder), &self.board, last_scrape)
    }
}

/// Turns OpenMetrics into text format 0.0.4: families carry their full names, an info is a gauge,
/// and there are no units and no end mark. Samples are the same in both and pass through.
struct Classic<'a, W> {
    out: &'a mut W,
    place: Place,
    /// The comment line so far.
    comment: String,
    help: String,
}

/// Where in a line the writer is.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Place {
    Start,
    Sample,
    Comment,
}

impl<'a, W: Write> Classic<'a, W> {
    fn new(out: &'a mut W) -> Self {
        Self {
            out,
            place: Place::Start,
            comment: String::new(),
            help: String::new(),
        }
    }

    /// A part of a line.
    fn part(&mut self, text: &str) -> fmt::Result {
        if self.place == Place::Start && !text.is_empty() {
            // Label values come later in a line, so nothing from outside can begin one.
            self.place = if text.starts_with('#') {
                Place::Comment
            } else {
                Place::Sample
            };
        }
        match self.place {
            Place::Comment => self.comment.push_str(text),
            _ => self.out.write_str(text)?,
        }
        Ok(())
    }

    fn end_line(&mut self) -> fmt::Result {
        match self.place {
            Place::Start => {}
            Place::Sample => self.out.write_char('\n')?,
            Place::Comment => self.end_comment()?,
        }
        self.place = Place::Start;
        Ok(())
    }

    fn end_comment(&mut self) -> fmt::Result {
        let line = std::mem::take(&mut self.comment);
        if let Some(help) = line.strip_prefix("# HELP ") {
            help.split_once(' ')
                .map_or("", |(_, text)| text)
                .clone_into(&mut self.help);
        } else if let Some((name, kind)) = line
            .strip_prefix("# TYPE ")
            .and_then(|rest| rest.split_once(' '))
        {
            let (suffix, kind) = match kind {
                "counter" => ("_total", kind),
                "info" => ("_info", "gauge"),
                _ => ("", kind),
            };
            writeln!(self.out, "# HELP {name}{suffix} {}", self.help)?;
            writeln!(self.out, "# TYPE {name}{suffix} {kind}")?;
        }
        Ok(())
    }
}

impl<W: Write> Write for Classic<'_, W> {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        if !text.as_bytes().contains(&b'\n') {
            return self.part(text);
        }
        for (index, part) in text.split('\n').enumerate() {
            if index > 0 {
                self.end_line()?;
            }
            self.part(part)?;
        }
        Ok(())
    }
}
