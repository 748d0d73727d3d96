//! All findings about one host, in the order in which they are read.

use serde::Serialize;

use super::finding::{Finding, Verdict};
use ros2probe_daemon::escape::visible;

/// A report.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Report {
    /// Version of this program.
    pub version: &'static str,
    /// Whom it is about: a host, an agent elsewhere, a capture.
    pub subject: String,
    /// The worst verdict of all.
    pub verdict: Verdict,
    /// By area, in the order in which they are printed.
    pub findings: Vec<Finding>,
}

impl Report {
    /// About `subject`.
    #[must_use]
    pub fn new(subject: impl Into<String>, findings: Vec<Finding>) -> Self {
        let worst = findings.iter().map(|finding| finding.verdict).max();
        Self {
            version: env!("CARGO_PKG_VERSION"),
            subject: subject.into(),
            verdict: worst.unwrap_or(Verdict::Ok),
            findings,
        }
    }

    /// Something is broken.
    #[must_use]
    pub fn has_problems(&self) -> bool {
        self.verdict == Verdict::Problem
    }

    /// How many of each verdict.
    #[must_use]
    pub fn headline(&self) -> String {
        let count = |verdict: Verdict| {
            let of_it = self.findings.iter().filter(|each| each.verdict == verdict);
            match (of_it.count(), verdict) {
                (0, _) => None,
                (count, Verdict::Ok | Verdict::Unknown) | (count @ 1, _) => {
                    Some(format!("{count} {}", verdict.label()))
                }
                (count, _) => Some(format!("{count} {}s", verdict.label())),
            }
        };
        let counts: Vec<_> = Verdict::ALL.into_iter().filter_map(count).collect();
        let (version, subject) = (self.version, visible(&self.subject));
        format!("rp doctor {version} on {subject}: {}", counts.join(", "))
    }
}

#[cfg(test)]
mod tests {
    use super::super::finding::Area;
    use super::*;

    fn report(verdicts: &[Verdict]) -> Report {
        let finding = |verdict: &Verdict| Finding::new(Area::Kernel, "x", *verdict, "x");
        Report::new("robot1", verdicts.iter().map(finding).collect())
    }

    #[test]
    fn only_a_problem_is_a_problem() {
        assert!(!report(&[]).has_problems());
        assert!(!report(&[Verdict::Ok, Verdict::Warning, Verdict::Unknown]).has_problems());
        assert!(report(&[Verdict::Problem, Verdict::Ok]).has_problems());
    }

    #[test]
    fn the_headline_counts_the_worst_first() {
        let report = report(&[
            Verdict::Ok,
            Verdict::Ok,
            Verdict::Warning,
            Verdict::Problem,
            Verdict::Problem,
        ]);
        assert!(
            report
                .headline()
                .ends_with("on robot1: 2 problems, 1 warning, 2 ok")
        );
    }

    #[test]
    fn the_report_is_json_for_fleets() {
        let json = serde_json::to_value(report(&[Verdict::Warning])).unwrap();
        assert_eq!(json["verdict"], "warning");
        assert_eq!(json["findings"][0]["area"], "kernel");
        assert_eq!(json["findings"][0]["evidence"], serde_json::json!([]));
    }
}
