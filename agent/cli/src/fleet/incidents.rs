//! Incidents of a fleet as text.

use std::fmt;

use jiff::Timestamp;
use ros2probe_api::fleet::{Incident, Incidents};
use ros2probe_daemon::escape::visible;

/// Maximum number of incidents in the text about all robots.
const MAX_INCIDENTS: usize = 10;

/// Incidents as text: those of one robot, or the latest of all.
#[derive(Debug)]
pub(super) struct IncidentText<'a> {
    pub incidents: &'a Incidents,
    pub robot: Option<&'a str>,
}

impl fmt::Display for IncidentText<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let incidents = self.incidents;
        writeln!(f, "\nincidents")?;
        if let Some(problem) = &incidents.problem {
            writeln!(f, "  the store cannot be read: {}", visible(problem))?;
        }
        let all = of(incidents, self.robot);
        let most = self.robot.map_or(MAX_INCIDENTS, |_| usize::MAX);
        let rows: Vec<_> = all
            .iter()
            .take(most)
            .map(|incident| cells(incident))
            .collect();
        let mut widths = [0; 6];
        for row in &rows {
            for (width, cell) in widths.iter_mut().zip(row) {
                *width = (*width).max(cell.chars().count());
            }
        }
        for (row, incident) in rows.iter().zip(&all) {
            let cells = row.iter().zip(widths);
            let line: String = cells
                .map(|(cell, width)| format!("  {cell:<width$}"))
                .collect();
            writeln!(f, "{}", line.trim_end())?;
            for line in details(incident) {
                writeln!(f, "      {line}")?;
            }
        }
        for line in notes(incidents, all.len(), all.len().saturating_sub(rows.len())) {
            writeln!(f, "  {line}")?;
        }
        Ok(())
    }
}

/// Returns the incidents of a robot, or all.
pub(super) fn of<'a>(incidents: &'a Incidents, robot: Option<&str>) -> Vec<&'a Incident> {
    let is_wanted = |incident: &&Incident| robot.is_none_or(|robot| incident.robot == robot);
    incidents.bags.iter().filter(is_wanted).collect()
}

/// Returns the cells of an incident's row: begin, robot, trigger, length, size, and bag. They have no
/// control characters.
pub(super) fn cells(incident: &Incident) -> [String; 6] {
    let time = |text: &Option<String>| text.as_deref()?.parse::<Timestamp>().ok();
    let (start, end) = (time(&incident.start), time(&incident.end));
    let trigger = match &incident.topic {
        Some(topic) => format!("{} {}", visible(&incident.trigger), visible(topic)),
        None => visible(&incident.trigger).into_owned(),
    };
    [
        start.map_or_else(
            || "no messages".to_owned(),
            |start| start.strftime("%Y-%m-%d %H:%M:%S UTC").to_string(),
        ),
        visible(&incident.robot).into_owned(),
        trigger,
        match (start, end) {
            (Some(start), Some(end)) => {
                format!("{:.1} s", end.duration_since(start).as_secs_f64())
            }
            _ => "-".to_owned(),
        },
        size(incident.bytes),
        visible(&incident.bag).into_owned(),
    ]
}

/// Returns further lines about an incident.
pub(super) fn details(incident: &Incident) -> Vec<String> {
    let mut lines = Vec::new();
    match &incident.findings {
        None => lines.push("findings unknown: the agent did not answer".to_owned()),
        Some(findings) if findings.is_empty() => {}
        Some(findings) => {
            let each = findings
                .iter()
                .map(|(event, count)| format!("{count} x {}", visible(event)));
            lines.push(each.collect::<Vec<_>>().join(", "));
        }
    }
    if !incident.is_complete {
        lines.push("the recording did not end in order: rp bag reindex".to_owned());
    }
    lines
}

/// Returns what a list does not have, of `shown` incidents.
pub(super) fn notes(incidents: &Incidents, known: usize, hidden: usize) -> Vec<String> {
    let mut lines = Vec::new();
    if hidden > 0 {
        lines.push(format!("and {hidden} more: rp fleet ROBOT"));
    }
    if incidents.at.is_none() && incidents.problem.is_none() {
        lines.push("the store is being read".to_owned());
    } else if known == 0 && incidents.problem.is_none() {
        lines.push("none".to_owned());
    }
    if incidents.unread > 0 {
        lines.push(format!(
            "bags whose manifests were not read: {}",
            incidents.unread
        ));
    }
    if incidents.unfinished > 0 {
        lines.push(format!(
            "bags that are being delivered: {}",
            incidents.unfinished
        ));
    }
    if incidents.is_cut {
        lines.push("the store has more objects than are listed".to_owned());
    }
    lines
}

/// Returns a number of bytes with a unit.
#[must_use]
pub fn size(bytes: u64) -> String {
    const SIZE_UNITS: [(u64, &str); 3] = [(1 << 30, "GiB"), (1 << 20, "MiB"), (1 << 10, "KiB")];
    let unit = SIZE_UNITS.iter().find(|(unit, _)| bytes >= *unit);
    match unit {
        Some((unit, name)) => format!("{:.1} {name}", bytes as f64 / *unit as f64),
        None => format!("{bytes} B"),
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// Returns an incident of a robot.
    pub(in super::super) fn sample(robot: &str) -> Incident {
        Incident {
            robot: robot.to_owned(),
            bag: "incident_1".to_owned(),
            snapshot: "incident".to_owned(),
            trigger: "message_lost".to_owned(),
            event: Some("ros2.message.lost".to_owned()),
            topic: Some("/scan".to_owned()),
            start: Some("2026-11-20T02:34:00Z".to_owned()),
            end: Some("2026-11-20T02:34:07.5Z".to_owned()),
            findings: Some([("ros2.message.lost".to_owned(), 2)].into()),
            messages: 75,
            bytes: 3 << 20,
            is_complete: true,
        }
    }

    #[test]
    fn incidents_are_printed_with_what_is_missing() {
        let mut other = sample("robot-10");
        (other.findings, other.is_complete) = (None, false);
        other.start = None;
        let incidents = Incidents {
            at: Some(1.0),
            bags: vec![sample("robot-7"), other],
            unread: 3,
            unfinished: 1,
            ..Incidents::default()
        };
        let text = |robot| {
            let incidents = &incidents;
            IncidentText { incidents, robot }.to_string()
        };
        let expected = "
incidents
  2026-11-20 02:34:00 UTC  robot-7   message_lost /scan  7.5 s  3.0 MiB  incident_1
      2 x ros2.message.lost
  no messages              robot-10  message_lost /scan  -      3.0 MiB  incident_1
      findings unknown: the agent did not answer
      the recording did not end in order: rp bag reindex
  bags whose manifests were not read: 3
  bags that are being delivered: 1
";
        assert_eq!(text(None), expected);
        assert!(!text(Some("robot-7")).contains("robot-10"));
        assert!(text(Some("robot-1")).contains("\n  none\n"));
    }

    #[test]
    fn a_store_that_cannot_be_read_has_no_empty_list() {
        let mut incidents = Incidents {
            problem: Some("the store is out of reach: no\nroute".to_owned()),
            ..Incidents::default()
        };
        let text = |incidents: &Incidents| {
            IncidentText {
                incidents,
                robot: None,
            }
            .to_string()
        };
        let failed = text(&incidents);
        assert!(
            failed.contains("cannot be read: the store is out of reach: no"),
            "{failed}"
        );
        assert!(
            !failed.contains("none") && failed.lines().count() == 3,
            "{failed}"
        );
        incidents.problem = None;
        assert!(text(&incidents).contains("is being read"));
        let at = Some(1.0);
        let many = Incidents {
            at,
            bags: vec![sample("a"); MAX_INCIDENTS + 2],
            ..incidents
        };
        assert!(text(&many).contains("and 2 more: rp fleet ROBOT"));
    }

    #[test]
    fn sizes_have_a_unit() {
        let sizes = [0, 1_023, 1_024, 8 << 20, 3 << 29].map(size);
        assert_eq!(sizes, ["0 B", "1023 B", "1.0 KiB", "8.0 MiB", "1.5 GiB"]);
    }
}
