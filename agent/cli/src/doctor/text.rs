//! Report as text: grouped, aligned, eighty columns wide, with commands on their own lines.
//!
//! Values from the network or from other processes are escaped.

use std::borrow::Cow;

use ros2probe_api::doctor::{Finding, Remedy, RemedyTarget, Report, Severity};
use ros2probe_daemon::escape::visible;

const WIDTH: usize = 80;
/// Columns before a sentence: two spaces, the severity and a space.
const INDENT: usize = 11;
/// Maximum number of lines of evidence for one finding without `--verbose`.
const MAX_EVIDENCE: usize = 3;
/// Path of the configuration file, as printed after a line of configuration.
const CONFIGURATION_FILE: &str = "in /etc/ros2probe/ros2probe.yaml";
/// Maximum number of characters of one value.
const MAX_VALUE: usize = 200;

/// Options of the output.
#[derive(Clone, Copy, Debug, Default)]
pub struct Style {
    /// Whether all evidence is printed, also of findings without a problem.
    pub verbose: bool,
    /// Whether colours are used.
    pub colours: bool,
}

/// Formats the whole report.
#[must_use]
pub fn text(report: &Report, style: Style) -> String {
    let mut page = Page {
        style,
        text: String::new(),
    };
    page.line(&headline(report));
    let mut area = None;
    for finding in &report.findings {
        if area != Some(finding.area) {
            area = Some(finding.area);
            page.text.push('\n');
            let title = page.painted(BOLD, finding.area.title());
            page.line(&title);
        }
        page.finding(finding);
    }
    page.text
}

/// Returns the number of findings of each severity, as text.
fn headline(report: &Report) -> String {
    let count = |severity: Severity| {
        let findings = report.findings.iter();
        let of_it = findings.filter(|each| each.severity == severity);
        match (of_it.count(), severity) {
            (0, _) => None,
            (count, Severity::Ok | Severity::Unknown) | (count @ 1, _) => {
                Some(format!("{count} {}", severity.label()))
            }
            (count, _) => Some(format!("{count} {}s", severity.label())),
        }
    };
    let counts: Vec<_> = Severity::ALL.into_iter().filter_map(count).collect();
    let (version, subject) = (&report.version, visible(&report.subject));
    format!("rp doctor {version} on {subject}: {}", counts.join(", "))
}

struct Page {
    style: Style,
    text: String,
}

const BOLD: &str = "1";
const DIM: &str = "2";

impl Page {
    fn finding(&mut self, finding: &Finding) {
        let severity = format!("{:8}", finding.severity.label());
        let severity = self.painted(colour(finding.severity), &severity);
        for (number, line) in wrapped(&visible(&finding.sentence)).iter().enumerate() {
            let start = if number == 0 {
                severity.as_str()
            } else {
                "        "
            };
            self.line(&format!("  {start} {line}"));
        }
        if self.style.verbose || finding.severity >= Severity::Unknown {
            self.evidence(finding);
        }
        if finding.severity != Severity::Ok {
            for remedy in &finding.remedies {
                self.remedy(remedy);
            }
        }
    }

    fn evidence(&mut self, finding: &Finding) {
        let shown = if self.style.verbose {
            usize::MAX
        } else {
            MAX_EVIDENCE
        };
        for evidence in finding.evidence.iter().take(shown) {
            let value: String = visible(&evidence.value).chars().take(MAX_VALUE).collect();
            let line = format!("{}: {value}", visible(&evidence.from));
            for line in wrapped(&line) {
                let line = self.painted(DIM, &line);
                self.line(&format!("{:INDENT$}{line}", ""));
            }
        }
        let left = finding.evidence.len().saturating_sub(shown);
        if left > 0 {
            let line = self.painted(DIM, &format!("{left} more with --verbose"));
            self.line(&format!("{:INDENT$}{line}", ""));
        }
    }

    /// Prints a remedy. A command is never wrapped, so that it can be pasted; a long comment
    /// precedes it.
    fn remedy(&mut self, remedy: &Remedy) {
        let line = visible(&remedy.line);
        let own = remedy.comment.as_deref().map(visible);
        let comment = match (remedy.kind, own) {
            (RemedyTarget::Configuration, None) => Some(CONFIGURATION_FILE.to_owned()),
            (RemedyTarget::Configuration, Some(own)) => {
                Some(format!("{CONFIGURATION_FILE}; {own}"))
            }
            (RemedyTarget::Command | RemedyTarget::Elsewhere, own) => own.map(Cow::into_owned),
        };
        let mut short = String::new();
        if let Some(comment) = comment {
            let both = format!("{line}    # {comment}");
            if INDENT + 2 + both.chars().count() <= WIDTH {
                short = self.painted(DIM, &format!("    # {comment}"));
            } else {
                for line in wrapped(&format!("# {comment}")) {
                    let line = self.painted(DIM, &line);
                    self.line(&format!("{:INDENT$}{line}", ""));
                }
            }
        }
        self.line(&format!("{:INDENT$}> {line}{short}", ""));
    }

    fn painted(&self, code: &str, text: &str) -> String {
        if self.style.colours {
            format!("\x1b[{code}m{text}\x1b[0m")
        } else {
            text.to_owned()
        }
    }

    fn line(&mut self, line: &str) {
        self.text.push_str(line.trim_end());
        self.text.push('\n');
    }
}

const fn colour(severity: Severity) -> &'static str {
    match severity {
        Severity::Ok => "32",
        Severity::Note => "36",
        Severity::Unknown => "35",
        Severity::Warning => "33",
        Severity::Problem => "1;31",
    }
}

/// Wraps a text to the width after the indentation. A word longer than a line is split.
fn wrapped(text: &str) -> Vec<String> {
    let width = WIDTH - INDENT;
    let mut lines = vec![String::new()];
    for word in text.split(' ') {
        for piece in pieces(word, width) {
            let Some(line) = lines.last_mut() else { break };
            let used = line.chars().count();
            if used > 0 && used + 1 + piece.chars().count() > width {
                lines.push(piece);
            } else {
                if used > 0 {
                    line.push(' ');
                }
                line.push_str(&piece);
            }
        }
    }
    lines
}

fn pieces(word: &str, width: usize) -> Vec<String> {
    let letters: Vec<char> = word.chars().collect();
    letters
        .chunks(width)
        .map(|piece| piece.iter().collect())
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use ros2probe_api::doctor::Area;

    fn report() -> Report {
        Report::new(
            "0.1.0",
            "robot1",
            vec![
                Finding::new(Area::Kernel, "version", Severity::Ok, "Linux 6.8")
                    .seen("6.8", "/proc/x"),
                Finding::new(
                    Area::Buffers,
                    "receive",
                    Severity::Warning,
                    "a socket may buffer 213 KB: two messages of /points (2.7 MB each) do not fit",
                )
                .seen("212992", "/proc/sys/net/core/rmem_max")
                .remedy(
                    "sudo sysctl -w net.core.rmem_max=6291456    # permanent: \
                    /etc/sysctl.d/60-ros.conf",
                ),
            ],
        )
    }

    #[test]
    fn a_report_is_grouped_and_aligned() {
        let version = env!("CARGO_PKG_VERSION");
        let expected = format!(
            "rp doctor {version} on robot1: 1 warning, 1 ok

Kernel
  ok       Linux \
             6.8

Buffers
  warning  a socket may buffer 213 KB: two messages of /points (2.7 MB \
             each) do
           not fit
           /proc/sys/net/core/rmem_max: 212992
           \
             # permanent: /etc/sysctl.d/60-ros.conf
           > sudo sysctl -w \
             net.core.rmem_max=6291456
"
        );
        assert_eq!(text(&report(), Style::default()), expected);
    }

    #[test]
    fn evidence_of_good_findings_is_printed_on_request() {
        let style = Style {
            verbose: true,
            colours: false,
        };
        assert!(text(&report(), style).contains("\n           /proc/x: 6.8\n"));
    }

    #[test]
    fn colours_are_printed_only_on_request() {
        assert!(!text(&report(), Style::default()).contains('\x1b'));
        let style = Style {
            verbose: false,
            colours: true,
        };
        assert!(text(&report(), style).contains("\x1b[33mwarning \x1b[0m"));
    }

    #[test]
    fn control_characters_in_findings_are_escaped() {
        let hostile = "x\x1b]0;gotcha\x07".repeat(100);
        let finding = Finding::new(Area::Graph, "x", Severity::Warning, hostile.clone())
            .seen(hostile.clone(), hostile)
            .remedy("ls");
        let text = text(
            &Report::new("0.1.0", "\x1b[31mhost", vec![finding]),
            Style::default(),
        );
        assert!(
            !text
                .chars()
                .any(|letter| letter.is_control() && letter != '\n')
        );
        assert!(
            text.lines()
                .skip(1)
                .all(|line| line.chars().count() <= WIDTH),
            "{text}"
        );
    }

    #[test]
    fn the_headline_counts_the_worst_severity_first() {
        let severities = [
            Severity::Ok,
            Severity::Ok,
            Severity::Warning,
            Severity::Problem,
            Severity::Problem,
        ];
        let findings = severities.map(|severity| Finding::new(Area::Kernel, "x", severity, "x"));
        let report = Report::new("0.1.0", "robot1", findings.into());
        assert!(headline(&report).ends_with("on robot1: 2 problems, 1 warning, 2 ok"));
    }
}
