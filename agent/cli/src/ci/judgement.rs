//! Conditions of a run: the command, the observation itself, expectations, findings and losses.

use std::collections::BTreeMap;

use ros2probe_api::live::Severity;

use super::observation::{Expected, Finding, Observation, Topic};
use super::{FailOn, Rules};

/// A run of a command.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Run {
    /// The command with its arguments, for people.
    pub command: String,
    /// Its exit code; 128 and the number of the signal that ended it.
    pub code: u8,
    /// Unix time at which it began.
    pub began: f64,
    /// Seconds that it ran.
    pub seconds: f64,
    /// Seconds after which this program received a signal that ends the command.
    pub signalled: Option<f64>,
    /// Why the agent ended before the command, and after how many seconds.
    pub agent_ended: Option<(f64, String)>,
    /// Domain that was observed.
    pub domain_id: u32,
}

/// Subject of a condition.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Group {
    /// The command itself.
    Command,
    /// Whether the agent saw the robot.
    Observation,
    /// Expectations of the watchlist.
    Expectations,
    /// Findings.
    Findings,
    /// Lost messages.
    Loss,
}

/// Result of a condition.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// It held.
    Passed,
    /// It may not have held, which does not fail.
    Warned,
    /// It did not hold.
    Failed,
    /// It could not be judged.
    Skipped,
}

/// A condition and its result.
#[derive(Clone, Debug, PartialEq)]
pub struct Condition {
    /// Subject.
    pub group: Group,
    /// Name that is unique within the group.
    pub name: String,
    /// Result.
    pub verdict: Verdict,
    /// What was seen, as lines.
    pub detail: String,
    /// Seconds that were judged.
    pub seconds: f64,
}

impl Group {
    /// All groups.
    pub const ALL: [Self; 5] = [
        Self::Command,
        Self::Observation,
        Self::Expectations,
        Self::Findings,
        Self::Loss,
    ];

    /// Returns its name in reports.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Command => "command",
            Self::Observation => "observation",
            Self::Expectations => "expectations",
            Self::Findings => "findings",
            Self::Loss => "loss",
        }
    }
}

impl Verdict {
    /// Returns its name in reports.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Passed => "passed",
            Self::Warned => "warning",
            Self::Failed => "failed",
            Self::Skipped => "not judged",
        }
    }
}

impl Run {
    /// Returns the time at which the judgement ends, in seconds.
    #[must_use]
    pub fn judged_until(&self, seen: &Observation) -> f64 {
        let agent = self.agent_ended.as_ref().map(|(time, _)| *time);
        [self.signalled, agent]
            .into_iter()
            .flatten()
            .fold(seen.judged_until(self.seconds), f64::min)
    }
}

impl FailOn {
    /// Returns whether a finding of this severity fails.
    #[must_use]
    pub fn covers(self, severity: Severity) -> bool {
        match self {
            Self::Error => severity == Severity::Error,
            Self::Warning => severity <= Severity::Warning,
            Self::None => false,
        }
    }
}

/// Returns all conditions of a run, ordered by group and name.
#[must_use]
pub fn judge(run: &Run, seen: &Observation) -> Vec<Condition> {
    let judgement = Judgement {
        run,
        seen,
        rules: seen.rules(),
        until: run.judged_until(seen),
    };
    let mut all = vec![judgement.command()];
    all.extend(judgement.observation());
    for ((pattern, name), expected) in &seen.expected {
        all.extend(judgement.expectations(pattern, name, expected));
    }
    all.extend(judgement.findings());
    let topics = seen.topics.iter();
    all.extend(topics.filter_map(|(name, topic)| judgement.loss(name, topic)));
    all
}

struct Judgement<'a> {
    run: &'a Run,
    seen: &'a Observation,
    rules: &'a Rules,
    until: f64,
}

impl Judgement<'_> {
    fn judged_seconds(&self) -> f64 {
        (self.until - self.rules.settle).max(0.0)
    }

    fn condition(
        &self,
        group: Group,
        name: impl Into<String>,
        verdict: Verdict,
        detail: impl Into<String>,
    ) -> Condition {
        let is_command = group == Group::Command;
        Condition {
            group,
            name: name.into(),
            verdict,
            detail: detail.into(),
            seconds: match is_command {
                true => self.run.seconds,
                false => self.judged_seconds(),
            },
        }
    }

    fn command(&self) -> Condition {
        let Run { code, command, .. } = self.run;
        let verdict = if *code == 0 {
            Verdict::Passed
        } else {
            Verdict::Failed
        };
        let detail = format!("it ended with {code} after {:.1} s", self.run.seconds);
        self.condition(Group::Command, command, verdict, detail)
    }

    /// Returns the conditions under which the run can be judged at all. A run that nothing observed
    /// never passes.
    fn observation(&self) -> [Condition; 4] {
        let agent = match &self.run.agent_ended {
            Some((time, reason)) => {
                let detail = format!("the agent ended after {time:.1} s: {reason}");
                self.condition(Group::Observation, "agent", Verdict::Failed, detail)
            }
            None => {
                let detail = "it observed the whole run";
                self.condition(Group::Observation, "agent", Verdict::Passed, detail)
            }
        };
        let missed = self.seen.missed(self.until);
        let (verdict, detail) = match (missed.is_empty(), self.rules.is_strict) {
            (true, _) => (Verdict::Passed, "the agent missed nothing".to_owned()),
            (false, false) => (Verdict::Warned, missed.join("; ")),
            (false, true) => (Verdict::Failed, missed.join("; ")),
        };
        let completeness = self.condition(Group::Observation, "completeness", verdict, detail);
        let (count, domain_id) = (self.seen.participants, self.run.domain_id);
        let participants = match count {
            0 => {
                let detail = format!(
                    "no participant was seen in domain {domain_id}: pass --domain N for another \
                     one; `rp doctor` checks what is visible"
                );
                self.condition(Group::Observation, "participants", Verdict::Failed, detail)
            }
            _ => {
                let detail = format!("at most {count} at once in domain {domain_id}");
                self.condition(Group::Observation, "participants", Verdict::Passed, detail)
            }
        };
        let seconds = self.judged_seconds();
        let settle = self.rules.settle;
        let time = if seconds > 0.0 {
            let detail = format!("{seconds:.1} s, from {settle} s to {:.1} s", self.until);
            self.condition(Group::Observation, "judged time", Verdict::Passed, detail)
        } else {
            let detail = format!(
                "nothing was judged: the robot ran for {:.1} s, and --settle is {settle} s",
                self.until.max(0.0)
            );
            self.condition(Group::Observation, "judged time", Verdict::Failed, detail)
        };
        [agent, completeness, participants, time]
    }

    fn expectations(&self, pattern: &str, name: &str, expected: &Expected) -> Vec<Condition> {
        let one = |key: &'static str| {
            let words = expected.expectations.in_words(key);
            let violated = expected.violated.get(key);
            let seconds = violated.map_or(0, |violated| violated.judged(self.until));
            let of = match pattern == name {
                true => String::new(),
                false => format!(" of {pattern}"),
            };
            let (verdict, detail) = if seconds > 0 {
                let first = violated.and_then(|it| it.first()).unwrap_or_default();
                let mut detail = format!(
                    "{name} does not keep {words}: violated in {seconds} of {:.0} s, first at \
                     {first:.0} s",
                    self.judged_seconds()
                );
                if expected.unpublished.judged(self.until) > 0 {
                    detail.push_str("; it had no publisher");
                } else if key.ends_with("rate_hz")
                    && let Some((mean, lowest, highest)) = self.rates(name)
                {
                    detail.push_str(&format!(
                        "; {mean:.1} Hz, from {lowest:.1} to {highest:.1} Hz"
                    ));
                }
                (Verdict::Failed, detail)
            } else if !expected.was_published {
                (Verdict::Skipped, format!("no topic {name} was published"))
            } else {
                (Verdict::Passed, words)
            };
            self.condition(
                Group::Expectations,
                format!("{name} {key}{of}"),
                verdict,
                detail,
            )
        };
        expected.expectations.keys().into_iter().map(one).collect()
    }

    /// Returns the mean, lowest and highest rate of a topic.
    fn rates(&self, name: &str) -> Option<(f64, f64, f64)> {
        let topic = self.seen.topics.get(name)?;
        topic.series.means(self.rules.settle, self.until).rate
    }

    /// Returns a condition for each kind of finding that occurred, or one if none did.
    fn findings(&self) -> Vec<Condition> {
        let mut kinds = BTreeMap::<&str, Vec<&Finding>>::new();
        for found in self.seen.own_findings() {
            kinds.entry(&found.kind).or_default().push(found);
        }
        if kinds.is_empty() {
            let none = "no finding occurred";
            return vec![self.condition(Group::Findings, "all kinds", Verdict::Passed, none)];
        }
        let of_kind = |(kind, found): (&str, Vec<&Finding>)| {
            let fails = |each: &&Finding| {
                self.rules.fail_on.covers(each.severity) && each.seconds.judged(self.until) > 0
            };
            let (failing, tolerated): (Vec<_>, Vec<_>) = found.into_iter().partition(fails);
            let verdict = match failing.is_empty() {
                true => Verdict::Passed,
                false => Verdict::Failed,
            };
            let lines = failing.iter().map(|it| sentence(it, ""));
            let tolerated = tolerated
                .iter()
                .map(|it| sentence(it, self.tolerance_reason(it)));
            let lines: Vec<_> = lines.chain(tolerated).collect();
            self.condition(Group::Findings, kind, verdict, lines.join("\n"))
        };
        kinds.into_iter().map(of_kind).collect()
    }

    fn tolerance_reason(&self, found: &Finding) -> &'static str {
        match self.rules.fail_on.covers(found.severity) {
            true => " (only at the start or the shutdown)",
            false => " (below --fail-on)",
        }
    }

    /// Returns the condition of a measured topic. A watch with `max_loss_ratio` replaces it.
    fn loss(&self, name: &str, topic: &Topic) -> Option<Condition> {
        if topic.messages + topic.lost.total() == 0 {
            return None;
        }
        let mut expected = self.seen.expected.iter();
        let is_expected = expected.any(|((_, topic), expected)| {
            topic == name && expected.expectations.max_loss_ratio.is_some()
        });
        let lost = topic.lost.judged(self.until);
        let of = topic.expected.judged(self.until);
        let mut detail = format!("{name} lost {lost} of {of} messages");
        let verdict = match self.rules.max_lost {
            _ if is_expected => {
                detail.push_str("; max_loss_ratio of the watchlist judges them");
                Verdict::Passed
            }
            Some(most) if lost > most => {
                let first = topic.lost.first().unwrap_or_default();
                detail.push_str(&format!(", first at {first:.0} s; {most} are allowed"));
                Verdict::Failed
            }
            _ => Verdict::Passed,
        };
        Some(self.condition(Group::Loss, name, verdict, detail))
    }
}

/// Returns a finding as one sentence with its remedy.
fn sentence(found: &Finding, why: &str) -> String {
    let remedy = found.remedy.as_deref();
    let remedy = remedy.map_or_else(String::new, |remedy| format!("; remedy: {remedy}"));
    format!("{}{remedy}{why}", found.text)
}

#[cfg(test)]
mod tests {
    use ros2probe_api::health::{Health, Limit};
    use ros2probe_api::live::{self, Line};

    use super::super::observation::tests::{RULES, graph, row, values};
    use super::*;

    fn run(seconds: f64) -> Run {
        Run {
            command: "ros2 launch robot".to_owned(),
            seconds,
            ..Run::default()
        }
    }

    /// Returns an observation of 20 s of a topic, which loses `lost` messages at 10 s.
    fn observed(rules: Rules, lost: u64) -> Observation {
        let mut seen = Observation::new(rules, 0);
        seen.line(graph(2, &["/a"]), 0.0);
        for second in 1..=20_u8 {
            let lost = if second < 10 { 0 } else { lost };
            seen.line(
                values(vec![row(0, u64::from(second) * 10, lost)]),
                second.into(),
            );
        }
        seen
    }

    fn failed(conditions: &[Condition]) -> Vec<(&'static str, &str)> {
        let failed = conditions.iter().filter(|it| it.verdict == Verdict::Failed);
        failed.map(|it| (it.group.name(), &*it.name)).collect()
    }

    #[test]
    fn a_healthy_run_passes_and_a_lossy_one_names_the_topic() {
        assert_eq!(failed(&judge(&run(20.0), &observed(RULES, 0))), []);
        let conditions = judge(&run(20.0), &observed(RULES, 3));
        assert_eq!(failed(&conditions), [("loss", "/a")]);
        let detail = &conditions.last().unwrap().detail;
        assert_eq!(
            detail,
            "/a lost 3 of 163 messages, first at 10 s; 0 are allowed"
        );
        for most in [Some(3), None] {
            let rules = Rules {
                max_lost: most,
                ..RULES
            };
            assert_eq!(failed(&judge(&run(20.0), &observed(rules, 3))), []);
        }
    }

    #[test]
    fn an_unobserved_run_fails() {
        let empty = Observation::new(RULES, 0);
        let conditions = judge(&run(20.0), &empty);
        assert_eq!(failed(&conditions), [("observation", "participants")]);
        let conditions = judge(&run(4.0), &observed(RULES, 0));
        assert_eq!(failed(&conditions), [("observation", "judged time")]);
        let ended = Run {
            agent_ended: Some((12.0, "killed".to_owned())),
            ..run(20.0)
        };
        let conditions = judge(&ended, &observed(RULES, 0));
        assert_eq!(failed(&conditions), [("observation", "agent")]);
    }

    #[test]
    fn what_the_agent_missed_is_a_warning_and_fails_a_strict_run() {
        let limit = |key: &'static str, reached| Limit {
            limit: key.into(),
            reached,
            ..Limit::default()
        };
        let health = Health {
            dropped_packets: 7,
            contended_datagrams: 2,
            // Clients of the agent hide nothing of the robot.
            limits: vec![
                limit("topics", 3),
                limit("api_clients", 5),
                limit("flows", 0),
            ],
            ..Health::default()
        };
        for (is_strict, expected) in [(false, Verdict::Warned), (true, Verdict::Failed)] {
            let mut seen = observed(Rules { is_strict, ..RULES }, 0);
            let of = |seen: &Observation| {
                let all = judge(&run(20.0), seen).into_iter();
                let mut found = all.filter(|it| it.name == "completeness");
                found.next().unwrap()
            };
            assert_eq!(of(&seen).verdict, Verdict::Passed);
            seen.health(&Health::default());
            assert_eq!(of(&seen).verdict, Verdict::Passed);
            seen.health(&health);
            let Condition {
                verdict, detail, ..
            } = of(&seen);
            assert_eq!(verdict, expected);
            assert!(
                detail.starts_with("the agent dropped 9 packets"),
                "{detail}"
            );
            assert!(
                detail.contains("; limits.topics was reached, and 3 entries"),
                "{detail}"
            );
            assert!(
                !detail.contains("api_clients") && !detail.contains("flows"),
                "{detail}"
            );
        }
    }

    #[test]
    fn writers_that_stay_unknown_are_a_warning() {
        let unknown = live::Finding {
            id: "unknown_writers|".to_owned(),
            kind: "unknown_writers".into(),
            severity: live::Severity::Warning,
            domain_id: None,
            topic: None,
            node: None,
            since: None,
            text: "Writers are active whose announcement was missed".to_owned(),
            remedy: None,
            writer: None,
            reader: None,
            policies: Vec::new(),
        };
        // At the start they are usual, because announcements follow.
        for (last, expected) in [(4_u8, Verdict::Passed), (8, Verdict::Warned)] {
            let mut seen = Observation::new(RULES, 0);
            seen.line(graph(1, &["/a"]), 0.0);
            for second in 1..=20_u8 {
                let present = (second <= last).then(|| unknown.clone());
                seen.line(Line::Findings(present.into_iter().collect()), second.into());
                seen.line(values(vec![row(0, u64::from(second), 0)]), second.into());
            }
            let conditions = judge(&run(20.0), &seen);
            let mut found = conditions.iter().filter(|it| it.name == "completeness");
            assert_eq!(found.next().unwrap().verdict, expected);
            assert_eq!(failed(&conditions), []);
        }
    }

    #[test]
    fn only_findings_of_the_evaluated_time_and_severity_fail() {
        let finding = |id: &str, severity| live::Finding {
            id: id.to_owned(),
            kind: id.to_owned().into(),
            severity,
            domain_id: Some(0),
            topic: None,
            node: None,
            since: None,
            text: "Something".to_owned(),
            remedy: Some("change it".to_owned()),
            writer: None,
            reader: None,
            policies: Vec::new(),
        };
        let error = finding("type_conflict", live::Severity::Error);
        let warning = finding("duplicate_node", live::Severity::Warning);
        let mut judged = Vec::new();
        for (fail_on, from) in [
            (FailOn::Error, 1_u8),
            (FailOn::Warning, 1),
            (FailOn::None, 1),
            (FailOn::Warning, 30),
        ] {
            let mut seen = Observation::new(Rules { fail_on, ..RULES }, 0);
            seen.line(graph(1, &["/a"]), 0.0);
            for second in 1..=20_u8 {
                let both = vec![error.clone(), warning.clone()];
                let late = if second >= from || second < 5 {
                    both
                } else {
                    Vec::new()
                };
                seen.line(Line::Findings(late), second.into());
                seen.line(values(vec![row(0, u64::from(second), 0)]), second.into());
            }
            let conditions = judge(&run(20.0), &seen);
            let failed: Vec<_> = failed(&conditions)
                .into_iter()
                .map(|it| it.1.to_owned())
                .collect();
            judged.push(failed.join(" "));
        }
        assert_eq!(
            judged,
            ["type_conflict", "duplicate_node type_conflict", "", ""]
        );
    }

    #[test]
    fn a_signal_ends_the_judgement() {
        let signalled = Run {
            signalled: Some(9.0),
            ..run(20.0)
        };
        assert_eq!(failed(&judge(&signalled, &observed(RULES, 3))), []);
    }
}
