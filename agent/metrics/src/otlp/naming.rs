//! Names of the catalogue in OpenTelemetry's form: the inverse of the standard mapping to
//! Prometheus.
//!
//! Namespaces end with dots; type and unit are not part of a name. The forward mapping yields
//! exactly the Prometheus name, so a dashboard can read both.

use crate::catalogue::{Kind, Metric};

/// Prefixes of names, which become namespaces.
const NAMESPACES: &[&str] = &[
    "build",
    "capture",
    "config",
    "discovery",
    "filter",
    "node",
    "otlp",
    "participant",
    "qos",
    "reader",
    "socket",
    "subscriber",
    "table",
    "topic",
    "unknown_writer",
    "watch",
    "writer",
];

/// Suffixes that OpenTelemetry expresses as a unit, in UCUM.
const UNITS: &[(&str, &str)] = &[
    ("_bytes_per_second", "By/s"),
    ("_seconds", "s"),
    ("_hertz", "Hz"),
    ("_bytes", "By"),
    ("_ratio", "1"),
];

/// Counted items as UCUM annotations, which the mapping does not turn into a suffix.
const ANNOTATIONS: &[(&str, &str)] = &[
    ("datagrams", "{datagram}"),
    ("deliveries", "{delivery}"),
    ("drops", "{drop}"),
    ("entries", "{entry}"),
    ("errors", "{error}"),
    ("events", "{event}"),
    ("evictions", "{eviction}"),
    ("exports", "{request}"),
    ("fds", "{file_descriptor}"),
    ("messages", "{message}"),
    ("nodes", "{node}"),
    ("packets", "{packet}"),
    ("pairs", "{pair}"),
    ("participants", "{participant}"),
    ("publishers", "{publisher}"),
    ("records", "{record}"),
    ("subscriptions", "{subscription}"),
    ("topics", "{topic}"),
    ("updates", "{update}"),
    ("writers", "{writer}"),
    ("writes", "{write}"),
];

impl Metric {
    /// Returns the name in OpenTelemetry, such as `ros2.topic.messages`.
    #[must_use]
    pub fn otlp_name(&self) -> String {
        let (namespace, rest) = self.split();
        let name = match UNITS.iter().find(|(suffix, _)| rest.ends_with(suffix)) {
            Some((suffix, _)) if !self.counts_bytes() => rest.strip_suffix(suffix),
            _ => None,
        };
        let name = name.unwrap_or(rest);
        let about = NAMESPACES.iter().find_map(|about| {
            let rest = name.strip_prefix(about)?.strip_prefix('_')?;
            Some((*about, rest))
        });
        match about {
            Some((about, name)) => format!("{namespace}.{about}.{name}"),
            None => format!("{namespace}.{name}"),
        }
    }

    /// Returns the unit in UCUM; empty for states and information.
    #[must_use]
    pub fn ucum(&self) -> &'static str {
        let (_, name) = self.split();
        if self.kind == Kind::Info {
            return "";
        }
        if let Some((_, unit)) = UNITS.iter().find(|(suffix, _)| name.ends_with(suffix)) {
            return unit;
        }
        let words = name.rsplit('_');
        let thing = |word: &str| ANNOTATIONS.iter().find(|(thing, _)| *thing == word);
        words.filter_map(thing).next().map_or("", |(_, unit)| unit)
    }

    /// Splits the name into its namespace and the remainder, such as `ros2` and `topic_messages`,
    /// without `_total`.
    fn split(&self) -> (&'static str, &'static str) {
        let name = match self.kind {
            Kind::Counter => self.name.strip_suffix("_total").unwrap_or(self.name),
            _ => self.name,
        };
        name.split_once('_').unwrap_or((name, ""))
    }

    /// Returns whether bytes are the counted item of the name rather than only its unit.
    fn counts_bytes(&self) -> bool {
        self.kind == Kind::Counter && self.ucum() == "By"
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::catalogue::CATALOGUE;

    /// Applies the specification's mapping of a metric ("OTLP Metric points to Prometheus"):
    /// tokens, unit suffix unless the name has it, `_total`, `_ratio`.
    fn forward(name: &str, unit: &str, kind: Kind) -> String {
        let word = |unit: &str| match unit {
            "s" => "seconds",
            "By" => "bytes",
            "Hz" => "hertz",
            _ if unit.is_empty() || unit == "1" || unit.starts_with('{') => "",
            _ => panic!("{unit} is not mapped here"),
        };
        let mut tokens: Vec<&str> = name
            .split(|c: char| !c.is_ascii_alphanumeric())
            .filter(|token| !token.is_empty())
            .collect();
        let (main, per) = unit.split_once('/').unwrap_or((unit, ""));
        let main = word(main);
        if !main.is_empty() && !tokens.contains(&main) {
            tokens.push(main);
        }
        if !per.is_empty() {
            assert_eq!(per, "s");
            tokens.extend(["per", "second"]);
        }
        if kind == Kind::Counter {
            tokens.retain(|token| *token != "total");
            tokens.push("total");
        }
        if unit == "1" && matches!(kind, Kind::Gauge | Kind::Info) {
            tokens.retain(|token| *token != "ratio");
            tokens.push("ratio");
        }
        tokens.join("_")
    }

    #[test]
    fn each_name_maps_back_to_its_prometheus_name() {
        for metric in CATALOGUE {
            let (name, unit) = (metric.otlp_name(), metric.ucum());
            assert_eq!(forward(&name, unit, metric.kind), metric.name, "{name}");
            let allowed =
                |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || "._".contains(c);
            assert!(name.chars().all(allowed) && !name.ends_with('.'), "{name}");
        }
        let mut names: Vec<String> = CATALOGUE.iter().map(Metric::otlp_name).collect();
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), CATALOGUE.len());
    }

    #[test]
    fn names_and_units_follow_the_conventions_of_opentelemetry() {
        let named = |name: &str| {
            let metric = CATALOGUE.iter().find(|metric| metric.name == name).unwrap();
            (metric.otlp_name(), metric.ucum())
        };
        for (prometheus, name, unit) in [
            (
                "ros2_topic_messages_total",
                "ros2.topic.messages",
                "{message}",
            ),
            ("ros2_topic_bytes_total", "ros2.topic.bytes", "By"),
            ("ros2_topic_rate_hertz", "ros2.topic.rate", "Hz"),
            (
                "ros2_topic_bandwidth_bytes_per_second",
                "ros2.topic.bandwidth",
                "By/s",
            ),
            ("ros2_topic_latency_seconds", "ros2.topic.latency", "s"),
            ("ros2_topic_info", "ros2.topic.info", ""),
            ("ros2_participants", "ros2.participants", "{participant}"),
            ("ros2probe_ready", "ros2probe.ready", ""),
            ("process_cpu_seconds_total", "process.cpu", "s"),
            (
                "process_resident_memory_bytes",
                "process.resident_memory",
                "By",
            ),
        ] {
            assert_eq!(named(prometheus), (name.to_owned(), unit), "{prometheus}");
        }
    }
}
