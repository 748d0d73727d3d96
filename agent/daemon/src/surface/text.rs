//! Families and samples as text: OpenMetrics 1.0 and the classic Prometheus format 0.0.4, which
//! differ in the first lines of a family.

use std::fmt::{self, Write};

use super::catalogue::{Kind, Metric};
use super::exposition::Format;
use super::metric_sink::{Label, Number, write_capped};
use ros2probe_model::histogram::Histogram;

/// A page in progress.
pub(super) struct Text<'a> {
    out: &'a mut dyn Write,
    format: Format,
}

impl<'a> Text<'a> {
    /// Creates an empty page.
    pub(super) fn new(out: &'a mut dyn Write, format: Format) -> Self {
        Self { out, format }
    }

    /// Writes the first lines of a family.
    pub(super) fn begin(&mut self, metric: &Metric) -> fmt::Result {
        let Metric { name, help, .. } = metric;
        match self.format {
            Format::Classic => {
                let kind = match metric.kind {
                    Kind::Info => Kind::Gauge,
                    kind => kind,
                };
                writeln!(self.out, "# HELP {name} {help}")?;
                writeln!(self.out, "# TYPE {name} {}", kind.label())
            }
            // The family's name lacks the suffix of its samples.
            Format::OpenMetrics => {
                let family = metric.family();
                writeln!(self.out, "# HELP {family} {help}")?;
                writeln!(self.out, "# TYPE {family} {}", metric.kind.label())?;
                match metric.unit {
                    Some(unit) => writeln!(self.out, "# UNIT {family} {unit}"),
                    None => Ok(()),
                }
            }
        }
    }

    /// Writes the end of the page.
    pub(super) fn end(&mut self) -> fmt::Result {
        match self.format {
            Format::Classic => Ok(()),
            Format::OpenMetrics => self.out.write_str("# EOF\n"),
        }
    }

    /// Writes a counter, a gauge or an info, whose value is always 1.
    pub(super) fn sample(
        &mut self,
        metric: &Metric,
        labels: &[Label<'_>],
        value: Number,
    ) -> fmt::Result {
        self.out.write_str(metric.name)?;
        self.labels(metric, labels, None)?;
        match (metric.kind, value) {
            (Kind::Info, _) => writeln!(self.out, " 1"),
            (_, Number::Count(count)) => writeln!(self.out, " {count}"),
            (_, Number::Real(real)) => writeln!(self.out, " {}", Real(real)),
        }
    }

    /// Writes a histogram: sum, count and cumulative buckets.
    pub(super) fn histogram(
        &mut self,
        metric: &Metric,
        labels: &[Label<'_>],
        values: &Histogram,
    ) -> fmt::Result {
        let name = metric.name;
        write!(self.out, "{name}_sum")?;
        self.labels(metric, labels, None)?;
        writeln!(self.out, " {}", Real(values.sum()))?;
        write!(self.out, "{name}_count")?;
        self.labels(metric, labels, None)?;
        writeln!(self.out, " {}", values.count())?;
        let mut below = 0_u64;
        for (bound, count) in values.buckets() {
            below = below.saturating_add(count);
            write!(self.out, "{name}_bucket")?;
            self.labels(metric, labels, Some(Real(bound)))?;
            writeln!(self.out, " {below}")?;
        }
        Ok(())
    }

    fn labels(
        &mut self,
        metric: &Metric,
        labels: &[Label<'_>],
        bound: Option<Real>,
    ) -> fmt::Result {
        debug_assert_eq!(metric.labels.len(), labels.len(), "{}", metric.name);
        let mut before = '{';
        if let Some(bound) = bound {
            write!(self.out, "{{le=\"{bound}\"")?;
            before = ',';
        }
        for (name, value) in metric.labels.iter().zip(labels) {
            write!(self.out, "{before}{name}=\"")?;
            let mut escaped = Escaped(self.out);
            match value {
                Label::Text(text) => write_capped(&mut escaped, text)?,
                Label::Number(number) => write!(escaped, "{number}")?,
                Label::Guid(guid) => write!(escaped, "{guid}")?,
                Label::Address(address) => write!(escaped, "{address}")?,
                Label::Vendor(vendor) => write!(escaped, "{vendor}")?,
                Label::Subscriber(subscriber) => write!(escaped, "{subscriber}")?,
            }
            self.out.write_char('"')?;
            before = ',';
        }
        match before {
            ',' => self.out.write_char('}'),
            _ => Ok(()),
        }
    }
}

/// Writes a label value, escaping backslash, quotation mark and line feed.
struct Escaped<'a>(&'a mut dyn Write);

impl Write for Escaped<'_> {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        for part in text.split_inclusive(['\\', '"', '\n']) {
            let (plain, escape) = match part.as_bytes().last() {
                Some(b'\\') => (part.strip_suffix('\\'), "\\\\"),
                Some(b'"') => (part.strip_suffix('"'), "\\\""),
                Some(b'\n') => (part.strip_suffix('\n'), "\\n"),
                _ => (None, ""),
            };
            self.0.write_str(plain.unwrap_or(part))?;
            self.0.write_str(escape)?;
        }
        Ok(())
    }
}

/// Writes a number as both formats require it, always with a point or an exponent.
struct Real(f64);

impl fmt::Display for Real {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0 {
            f64::INFINITY => f.write_str("+Inf"),
            f64::NEG_INFINITY => f.write_str("-Inf"),
            real => write!(f, "{real:?}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::catalogue::TOPIC_MESSAGES;

    fn page(format: Format, write: impl FnOnce(&mut Text<'_>)) -> String {
        let mut page = String::new();
        write(&mut Text::new(&mut page, format));
        page
    }

    #[test]
    fn label_values_and_numbers_are_written_as_the_formats_say() {
        let escaped = |text: &str| {
            let mut out = String::new();
            Escaped(&mut out).write_str(text).unwrap();
            out
        };
        assert_eq!(escaped("a\\b\"c\nd"), "a\\\\b\\\"c\\nd");
        assert_eq!(escaped("\n\n\"ü"), "\\n\\n\\\"ü");
        assert_eq!(escaped(""), "");
        for (real, written) in [
            (1.0, "1.0"),
            (0.001, "0.001"),
            (f64::INFINITY, "+Inf"),
            (f64::NEG_INFINITY, "-Inf"),
            (f64::NAN, "NaN"),
        ] {
            assert_eq!(Real(real).to_string(), written);
        }
    }

    #[test]
    fn a_counter_has_its_family_in_openmetrics_and_its_name_in_classic_text() {
        let (counter, family) = (&TOPIC_MESSAGES, "ros2_topic_messages");
        let open = page(Format::OpenMetrics, |text| text.begin(counter).unwrap());
        assert!(
            open.contains(&format!("# TYPE {family} counter\n")),
            "{open}"
        );
        let classic = page(Format::Classic, |text| text.begin(counter).unwrap());
        assert!(classic.contains(&format!("# TYPE {family}_total counter\n")));
    }
}
