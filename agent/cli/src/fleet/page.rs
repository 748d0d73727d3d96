//! A fleet as one HTML page without scripts and foreign requests. All names are escaped.

use std::fmt::Write as _;
use std::time::Duration;

use jiff::Timestamp;
use quick_xml::escape::escape;
use ros2probe_api::fleet::{Fleet, Incidents, Robot, State};

use super::incidents;
use super::text::{cells, fault_count, faults};

/// Maximum number of lines about one robot.
const MAX_FAULTS: usize = 200;
const STYLE: &str = include_str!("../ci/report.css");
const HEAD: &str = "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\
<meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; style-src 'unsafe-inline'\">\
<meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\
<meta name=\"color-scheme\" content=\"light dark\">";

/// What the page shows.
#[derive(Debug)]
pub(super) struct Content<'a> {
    /// The fleet and when it was read; `None` before the first answer of the engine.
    pub fleet: Option<(&'a Fleet, Timestamp)>,
    /// Why the last request to the engine failed.
    pub problem: Option<&'a str>,
    /// Incidents of the robots; `None` without a store.
    pub incidents: Option<&'a Incidents>,
    /// Pause after which the browser reads the page again; `None` = never.
    pub refresh: Option<Duration>,
}

/// Returns the page.
pub(super) fn html(content: &Content<'_>) -> String {
    let robots = content.fleet.map_or(&[][..], |(fleet, _)| &fleet.robots);
    let title = match content.fleet {
        Some(_) => format!("{} robots", robots.len()),
        None => "Fleet".to_owned(),
    };
    let refresh = content.refresh.map_or_else(String::new, |pause| {
        format!(
            "<meta http-equiv=\"refresh\" content=\"{}\">",
            pause.as_secs()
        )
    });
    let mut page = format!(
        "{HEAD}{refresh}<title>{title}</title><style>{STYLE}</style></head><body>\n<h1>{title}</h1>\n"
    );
    if let Some(problem) = content.problem {
        let problem = escape(problem);
        let _ = writeln!(page, "<p class=\"bad\" role=\"alert\">{problem}</p>");
    }
    time(&mut page, content);
    if !robots.is_empty() {
        table(&mut page, robots);
        details(&mut page, robots);
    }
    if let Some(incidents) = content.incidents {
        incident_table(&mut page, incidents);
    }
    page.push_str("</body></html>\n");
    page
}

fn time(page: &mut String, content: &Content<'_>) {
    let refresh = match content.refresh {
        Some(pause) => format!(
            "The page is read again every {} s. <a href=\"?paused\">Pause</a>",
            pause.as_secs()
        ),
        None => "The page is paused. <a href=\"./\">Continue</a>".to_owned(),
    };
    let _ = match content.fleet {
        Some((fleet, at)) => {
            let at = at.strftime("%Y-%m-%d %H:%M:%S UTC");
            let counts = counts(&fleet.robots);
            writeln!(
                page,
                "<p>{counts}</p>\n<p><small>State of {at}. {refresh}</small></p>"
            )
        }
        None => writeln!(
            page,
            "<p>The engine has not answered yet.</p>\n<p><small>{refresh}</small></p>"
        ),
    };
}

/// Returns how many robots are in each state, the worst one first.
fn counts(robots: &[Robot]) -> String {
    let states = [
        State::OutOfReach,
        State::NotReady,
        State::Violated,
        State::Findings,
        State::Ok,
    ];
    let counts = states.iter().filter_map(|state| {
        let count = robots.iter().filter(|robot| robot.state == *state).count();
        (count > 0).then(|| {
            format!(
                "<span class=\"{}\">{count} {}</span>",
                class(*state),
                state.label()
            )
        })
    });
    match counts.collect::<Vec<_>>().join(", ") {
        counts if counts.is_empty() => "No robot delivers to the engine.".to_owned(),
        counts => counts,
    }
}

const fn class(state: State) -> &'static str {
    match state {
        State::OutOfReach | State::NotReady | State::Violated => "bad",
        State::Findings => "warn",
        State::Ok => "good",
    }
}

fn table(page: &mut String, robots: &[Robot]) {
    page.push_str(
        "<div class=\"wide\"><table><thead><tr><th scope=\"col\">Robot</th><th scope=\"col\">State</th>\
         <th scope=\"col\">Last sample</th><th scope=\"col\" class=\"n\">Nodes</th>\
         <th scope=\"col\" class=\"n\">Topics</th><th scope=\"col\" class=\"n\">Loss</th>\
         <th scope=\"col\">Version</th><th scope=\"col\">Details</th></tr></thead><tbody>\n",
    );
    for (place, robot) in robots.iter().enumerate() {
        let [name, state, seen, nodes, topics, loss, version] = cells(robot);
        let (name, version) = (escape(&*name), escape(&*version));
        let name = match &robot.page {
            Some(address) => format!("<a href=\"{}\">{name}</a>", escape(address)),
            None => name.into_owned(),
        };
        let details = match fault_count(robot) {
            0 => String::new(),
            1 => format!("<a href=\"#robot-{place}\">1 line</a>"),
            lines => format!("<a href=\"#robot-{place}\">{lines} lines</a>"),
        };
        let class = class(robot.state);
        let _ = writeln!(
            page,
            "<tr><th scope=\"row\">{name}</th><td class=\"{class}\">{state}</td><td>{seen}</td>\
             <td class=\"n\">{nodes}</td><td class=\"n\">{topics}</td><td class=\"n\">{loss}</td>\
             <td>{version}</td><td>{details}</td></tr>"
        );
    }
    page.push_str("</tbody></table></div>\n");
}

fn details(page: &mut String, robots: &[Robot]) {
    for (place, robot) in robots.iter().enumerate() {
        let count = fault_count(robot);
        if count == 0 {
            continue;
        }
        let [name, ..] = cells(robot);
        let _ = writeln!(
            page,
            "<h2 id=\"robot-{place}\">{}</h2>\n<ul>",
            escape(&*name)
        );
        for line in faults(robot).take(MAX_FAULTS) {
            let _ = writeln!(page, "<li>{}</li>", escape(&*line));
        }
        if let more @ 1.. = count.saturating_sub(MAX_FAULTS) {
            let _ = writeln!(
                page,
                "<li>and {more} more: see <a href=\"fleet.json\">fleet.json</a></li>"
            );
        }
        page.push_str("</ul>\n");
    }
}

fn incident_table(page: &mut String, incidents: &Incidents) {
    page.push_str("<h2>Incidents</h2>\n");
    if let Some(problem) = &incidents.problem {
        let problem = escape(problem);
        let _ = writeln!(
            page,
            "<p class=\"bad\" role=\"alert\">The store cannot be read: {problem}</p>"
        );
    }
    let all = incidents::of(incidents, None);
    if !all.is_empty() {
        page.push_str(
            "<div class=\"wide\"><table><thead><tr><th scope=\"col\">Begin</th><th scope=\"col\">Robot</th>\
             <th scope=\"col\">Trigger</th><th scope=\"col\" class=\"n\">Length</th>\
             <th scope=\"col\" class=\"n\">Size</th><th scope=\"col\">Bag</th>\
             <th scope=\"col\">Findings</th></tr></thead><tbody>\n",
        );
    }
    for incident in &all {
        let cells = incidents::cells(incident);
        let [begin, robot, trigger, length, size, bag] =
            cells.each_ref().map(|cell| escape(cell.as_str()));
        let details = incidents::details(incident).join("; ");
        let details = escape(&*details);
        let _ = writeln!(
            page,
            "<tr><td>{begin}</td><td>{robot}</td><td>{trigger}</td><td class=\"n\">{length}</td>\
             <td class=\"n\">{size}</td><td>{bag}</td><td>{details}</td></tr>"
        );
    }
    if !all.is_empty() {
        page.push_str("</tbody></table></div>\n");
    }
    for note in incidents::notes(incidents, all.len(), 0) {
        let _ = writeln!(page, "<p><small>{note}</small></p>");
    }
}

#[cfg(test)]
mod tests {
    use ros2probe_api::fleet::{Difference, Part};
    use ros2probe_daemon::fleet::Link;

    use super::super::text::tests::sample;
    use super::*;

    #[test]
    fn names_of_robots_are_escaped_and_link_to_their_pages() {
        let link: Link = "https://{robot}.example/?to={robot}".parse().unwrap();
        let robot = |name: &str, state| Robot {
            version: Some("<i>".to_owned()),
            page: Some(link.of(name)),
            ..sample(name, state, 2.0)
        };
        let mut hostile = robot("a\"><script>alert(1)</script>", State::Violated);
        hostile.violated = vec![("/<b>".to_owned(), "min_rate_hz".to_owned())];
        let fleet = Fleet {
            robots: vec![hostile, robot("robot-2.site", State::Ok)],
            ..Fleet::default()
        };
        let mut incident = super::super::incidents::tests::sample("<em>");
        incident.bag = "<tt>".to_owned();
        let incidents = Incidents {
            problem: Some("<del>".to_owned()),
            bags: vec![incident],
            ..Incidents::default()
        };
        let page = html(&Content {
            fleet: Some((&fleet, Timestamp::UNIX_EPOCH)),
            problem: Some("<u>"),
            incidents: Some(&incidents),
            refresh: Some(Duration::from_secs(10)),
        });
        for hostile in ["<script", "<b>", "<i>", "<u>", "<em>", "<tt>", "<del>"] {
            assert!(!page.contains(hostile), "{hostile}: {page}");
        }
        for part in [
            "<h1>2 robots</h1>",
            "<a href=\"https://robot-2.site.example/?to=robot-2.site\">robot-2.site</a>",
            "<span class=\"bad\">1 violated</span>, <span class=\"good\">1 ok</span>",
            "<li>/&lt;b&gt;: min_rate_hz is violated</li>",
            "<td class=\"n\">1.25 %</td>",
            "State of 1970-01-01 00:00:00 UTC",
            "http-equiv=\"refresh\" content=\"10\"",
            "The store cannot be read: &lt;del&gt;",
            "<td>message_lost /scan</td><td class=\"n\">7.5 s</td><td class=\"n\">3.0 MiB</td>",
        ] {
            assert!(page.contains(part), "{part}: {page}");
        }
    }

    #[test]
    fn a_robot_with_many_differences_has_a_last_line_with_their_number() {
        let difference = |number: usize| Difference {
            part: Part::Nodes,
            what: format!("node /n{number}"),
            here: None,
            usual: Some("present".to_owned()),
            robots: 2,
            of: 3,
            text: format!("node /n{number} is missing"),
        };
        let robot = Robot {
            differences: (0..MAX_FAULTS + 7).map(difference).collect(),
            ..sample("robot", State::Ok, 2.0)
        };
        let fleet = Fleet {
            robots: vec![robot],
            ..Fleet::default()
        };
        let page = html(&Content {
            fleet: Some((&fleet, Timestamp::UNIX_EPOCH)),
            problem: None,
            incidents: None,
            refresh: None,
        });
        assert_eq!(page.matches("<li>").count(), MAX_FAULTS + 1);
        assert!(page.contains("and 7 more: see"), "{page}");
    }

    #[test]
    fn a_page_before_the_first_answer_and_a_paused_one_say_so() {
        let page = html(&Content {
            fleet: None,
            problem: None,
            incidents: None,
            refresh: None,
        });
        assert!(page.contains("The engine has not answered yet."), "{page}");
        assert!(
            page.contains("paused") && !page.contains("\"refresh\""),
            "{page}"
        );
    }
}
