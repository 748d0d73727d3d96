//! A report for people: one HTML file without scripts, foreign requests or a server. All names are
//! escaped. Its Content-Security-Policy forbids everything but its own style.

use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::time::Duration;

use jiff::{Timestamp, Unit};
use quick_xml::escape::escape;
use ros2probe_api::live::Severity;

use super::drawing;
use super::observation::{Finding, Observation};
use super::series::Means;
use super::{Condition, Group, Run, Verdict};

const HTML_HEAD: &str = "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\
<meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; style-src 'unsafe-inline'\">\
<meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\
<meta name=\"color-scheme\" content=\"light dark\">";

const STYLE: &str = include_str!("report.css");

/// Returns the file. `bag` describes the bag in words.
#[must_use]
pub fn html(run: &Run, conditions: &[Condition], seen: &Observation, bag: &str) -> String {
    let failed = count(conditions, Verdict::Failed);
    let verdict = if failed == 0 { "passed" } else { "failed" };
    let command = escape(&*run.command);
    let mut page = format!(
        "{HTML_HEAD}<title>rp ci: {verdict}: {command}</title><style>{STYLE}</style></head><body>\n\
         <h1><span class=\"{0}\">{verdict}</span> {command}</h1>\n",
        class(failed > 0)
    );
    summary(&mut page, run, conditions, seen, bag);
    of_conditions(&mut page, conditions);
    of_findings(&mut page, run, seen);
    of_topics(&mut page, run, conditions, seen);
    of_graph(&mut page, conditions, seen);
    page.push_str("</body></html>\n");
    page
}

/// Returns a Unix time in UTC, to the second (RFC 3339).
#[must_use]
pub fn time(seconds: f64) -> String {
    let duration = Duration::try_from_secs_f64(seconds).unwrap_or_default();
    let time = jiff::SignedDuration::try_from(duration).ok();
    let time = time.and_then(|time| Timestamp::from_duration(time).ok());
    let time = time.and_then(|time| time.round(Unit::Second).ok());
    time.map_or_else(String::new, |time| time.to_string())
}

fn count(conditions: &[Condition], verdict: Verdict) -> usize {
    conditions.iter().filter(|it| it.verdict == verdict).count()
}

const fn class(is_bad: bool) -> &'static str {
    if is_bad { "bad" } else { "good" }
}

fn summary(page: &mut String, run: &Run, conditions: &[Condition], seen: &Observation, bag: &str) {
    let [failed, warned, passed, skipped] = [
        Verdict::Failed,
        Verdict::Warned,
        Verdict::Passed,
        Verdict::Skipped,
    ]
    .map(|it| count(conditions, it));
    let until = run.judged_until(seen);
    let rows = [
        (
            "Conditions",
            format!("{failed} failed, {warned} warnings, {passed} passed, {skipped} not judged"),
        ),
        ("Began", time(run.began)),
        ("Duration", format!("{:.1} s", run.seconds)),
        (
            "Judged",
            format!("{} s to {until:.1} s", seen.rules().settle),
        ),
        ("Exit code of the command", run.code.to_string()),
        ("Domain", run.domain_id.to_string()),
        (
            "Seen",
            format!(
                "{} participants, {} nodes, {} topics",
                seen.participants,
                seen.nodes.len(),
                seen.topics.len()
            ),
        ),
        ("Bag", bag.to_owned()),
    ];
    page.push_str("<dl>");
    for (name, value) in rows {
        let _ = write!(page, "<dt>{name}</dt><dd>{}</dd>", escape(&*value));
    }
    page.push_str("</dl>\n");
    if seen.omitted > 0 {
        let _ = writeln!(
            page,
            "<p>{} names are left out: the report is full.</p>",
            seen.omitted
        );
    }
}

fn of_conditions(page: &mut String, conditions: &[Condition]) {
    page.push_str(
        "<h2>Conditions</h2>\n<div class=\"wide\"><table><tr><th></th><th>Subject</th>\
         <th>Condition</th><th>What was seen</th></tr>\n",
    );
    let order = [
        Verdict::Failed,
        Verdict::Warned,
        Verdict::Skipped,
        Verdict::Passed,
    ];
    for verdict in order {
        for each in conditions.iter().filter(|it| it.verdict == verdict) {
            let class = match verdict {
                Verdict::Failed | Verdict::Warned => "bad",
                Verdict::Passed => "good",
                Verdict::Skipped => "",
            };
            let _ = writeln!(
                page,
                "<tr><td class=\"{class}\">{}</td><td>{}</td><td>{}</td><td>{}</td></tr>",
                verdict.name(),
                each.group.name(),
                escape(&*each.name),
                escape(&*each.detail).replace('\n', "<br>")
            );
        }
    }
    page.push_str("</table></div>\n");
}

fn of_findings(page: &mut String, run: &Run, seen: &Observation) {
    page.push_str("<h2>Findings</h2>\n");
    let mut findings: Vec<&Finding> = seen.findings.values().collect();
    findings.sort_by(|one, other| (one.severity, &one.text).cmp(&(other.severity, &other.text)));
    if findings.is_empty() {
        page.push_str("<p>None.</p>\n");
        return;
    }
    let until = run.judged_until(seen);
    page.push_str("<ul>\n");
    for found in findings {
        let (class, severity) = match found.severity {
            Severity::Error => ("bad", "error"),
            Severity::Warning => ("warn", "warning"),
            Severity::Note => ("", "note"),
        };
        let judged = found.seconds.judged(until);
        let when = match (judged, found.seconds.first()) {
            (0, _) | (_, None) => "only at the start or the shutdown".to_owned(),
            (_, Some(first)) => format!("{judged} s, first at {first:.0} s"),
        };
        let _ = write!(
            page,
            "<li><span class=\"{class}\">{severity}</span> {} <small>({}, {when})</small>",
            escape(&*found.text),
            escape(&*found.kind)
        );
        if let Some(remedy) = &found.remedy {
            let _ = write!(page, "<br><code>{}</code>", escape(remedy.as_str()));
        }
        page.push_str("</li>\n");
    }
    page.push_str("</ul>\n");
}

fn of_topics(page: &mut String, run: &Run, conditions: &[Condition], seen: &Observation) {
    let until = run.judged_until(seen);
    let settle = seen.rules().settle;
    let _ = writeln!(
        page,
        "<h2>Topics</h2>\n<p>Rates, bandwidths and latencies are means from {settle} s to {until:.1} \
         s. The charts show rates over the whole run; dashed lines bound the judged part.</p>\n\
         <div class=\"wide\"><table><tr><th>Topic</th><th>Rate</th><th>Lowest</th><th>Highest</th>\
         <th>Bandwidth</th><th>Messages</th><th>Lost</th><th>Latency</th><th>Highest p99</th>\
         <th>Rate over the run</th></tr>"
    );
    let failed = failed_topics(conditions);
    for (name, topic) in &seen.topics {
        if topic.messages == 0 && topic.is_hidden {
            continue;
        }
        let Means {
            rate,
            bandwidth,
            median,
            p99,
        } = topic.series.means(settle, until);
        let hertz = |value: Option<f64>| value.map_or_else(dash, |value| format!("{value:.1} Hz"));
        let seconds = |value: Option<f64>| value.map_or_else(dash, duration);
        let cells = [
            hertz(rate.map(|(mean, _, _)| mean)),
            hertz(rate.map(|(_, lowest, _)| lowest)),
            hertz(rate.map(|(_, _, highest)| highest)),
            bandwidth.map_or_else(dash, bytes),
            topic.messages.to_string(),
            topic.lost.judged(until).to_string(),
            seconds(median),
            seconds(p99),
        ];
        let class = if failed.contains(&**name) { "bad" } else { "" };
        let _ = write!(
            page,
            "<tr><td><span class=\"{class}\">{}</span><br><small>{}</small></td>",
            escape(name.as_str()),
            escape(&*topic.types.join(", "))
        );
        for cell in cells {
            let _ = write!(page, "<td class=\"n\">{cell}</td>");
        }
        let chart = drawing::chart(&topic.series, run.seconds, (settle, until));
        let _ = writeln!(page, "<td>{chart}</td></tr>");
    }
    page.push_str("</table></div>\n");
}

fn of_graph(page: &mut String, conditions: &[Condition], seen: &Observation) {
    let (svg, left_out) = drawing::graph(seen, &failed_topics(conditions));
    let _ = writeln!(
        page,
        "<h2>Graph</h2>\n<p>Publishers, topics and subscribers of the whole run.</p>\n\
         <div class=\"wide\">{svg}</div>"
    );
    if left_out > 0 {
        let _ = writeln!(
            page,
            "<p>{left_out} further topics are only in the list.</p>"
        );
    }
    page.push_str("<details><summary>As a list</summary><ul>\n");
    for edge in &seen.edges {
        let verb = if edge.is_publisher {
            "publishes"
        } else {
            "subscribes to"
        };
        let _ = writeln!(
            page,
            "<li>{} {verb} {}</li>",
            escape(edge.node.as_str()),
            escape(edge.topic.as_str())
        );
    }
    page.push_str("</ul></details>\n");
}

/// Returns the topics whose loss or expectations failed.
fn failed_topics(conditions: &[Condition]) -> BTreeSet<&str> {
    let failed = conditions.iter().filter(|it| {
        it.verdict == Verdict::Failed && matches!(it.group, Group::Loss | Group::Expectations)
    });
    failed.filter_map(|it| it.name.split(' ').next()).collect()
}

fn dash() -> String {
    "–".to_owned()
}

fn duration(seconds: f64) -> String {
    if seconds < 1e-3 {
        format!("{:.0} µs", seconds * 1e6)
    } else if seconds < 1.0 {
        format!("{:.1} ms", seconds * 1e3)
    } else {
        format!("{seconds:.2} s")
    }
}

fn bytes(per_second: f64) -> String {
    if per_second < 1e3 {
        format!("{per_second:.0} B/s")
    } else if per_second < 1e6 {
        format!("{:.1} kB/s", per_second / 1e3)
    } else {
        format!("{:.1} MB/s", per_second / 1e6)
    }
}

#[cfg(test)]
mod tests {
    use super::super::judge;
    use super::super::observation::tests::{RULES, graph, row, values};
    use super::*;

    #[test]
    fn a_report_escapes_names_and_has_no_external_reference() {
        let mut seen = Observation::new(RULES, 0);
        seen.line(graph(1, &["/a'\"><img src=x onerror=alert(1)>", "/b"]), 0.0);
        for second in 1..=20_u8 {
            let lost = u64::from(second);
            seen.line(
                values(vec![row(0, 10 * lost, lost), row(1, 10 * lost, 0)]),
                second.into(),
            );
        }
        let run = Run {
            command: "sh -c '</title><script>'".to_owned(),
            began: 1.7e9,
            seconds: 20.0,
            ..Run::default()
        };
        let page = html(&run, &judge(&run, &seen), &seen, "none");
        for forbidden in [
            "<script", "<img", "://", "href=", " src=\"", "url(", "@import",
        ] {
            assert!(!page.contains(forbidden), "{forbidden} in {page}");
        }
        assert!(page.contains("2023-11-14T22:13:20Z"), "{page}");
        assert!(
            page.contains("<span class=\"bad\">failed</span> sh -c"),
            "{page}"
        );
        assert!(page.contains("<td class=\"n\">10.0 Hz</td>"), "{page}");
        assert_eq!(page.matches("aria-label=\"rate up to 10.0 Hz\"").count(), 2);
    }
}
