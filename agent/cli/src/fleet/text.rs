//! A fleet as text.

use std::fmt;

use ros2probe_api::fleet::{Comparison, Fleet, Part, Robot, State};
use ros2probe_daemon::escape::visible;

use super::incidents::IncidentText;

/// Maximum number of printed differences of a robot.
const MAX_DIFFERENCES: usize = 12;

/// A fleet as text.
#[derive(Debug)]
pub struct FleetText<'a>(pub &'a Fleet);

/// A robot of a fleet as text, with all that differs from the others.
#[derive(Debug)]
pub struct RobotText<'a>(pub &'a Robot, pub &'a Fleet);

impl fmt::Display for FleetText<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        table(f, &self.0.robots)?;
        let mut robots = self.0.robots.iter();
        robots.try_for_each(|robot| details(f, robot))?;
        incidents(f, self.0, None)
    }
}

impl fmt::Display for RobotText<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let robot = self.0;
        table(f, std::slice::from_ref(robot))?;
        let mut wrong = trouble(robot).peekable();
        if wrong.peek().is_some() {
            writeln!(f, "\nin trouble")?;
            wrong.try_for_each(|line| writeln!(f, "  {line}"))?;
        }
        for part in Part::ALL {
            let those = robot.differences.iter();
            let mut those = those
                .filter(|difference| difference.part == part)
                .peekable();
            if those.peek().is_some() {
                writeln!(f, "\n{}", part.label())?;
                those.try_for_each(|difference| writeln!(f, "  {}", visible(&difference.text)))?;
            }
        }
        self.comparison(f)?;
        incidents(f, self.1, Some(&robot.name))
    }
}

impl RobotText<'_> {
    /// Writes why there are no differences.
    fn comparison(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let robot = self.0;
        if !robot.differences.is_empty() {
            return Ok(());
        }
        let Comparison { in_reach, minimum } = self.1.comparison;
        if robot.state == State::OutOfReach {
            writeln!(f, "\nnot compared with the others: it is out of reach")
        } else if !self.1.comparison.is_possible() {
            writeln!(
                f,
                "\nnot compared with the others: {in_reach} in reach, of {minimum} at least"
            )
        } else {
            writeln!(f, "\nno difference from the other robots")
        }
    }
}

fn incidents(f: &mut fmt::Formatter<'_>, fleet: &Fleet, robot: Option<&str>) -> fmt::Result {
    match &fleet.incidents {
        Some(incidents) => write!(f, "{}", IncidentText { incidents, robot }),
        None => Ok(()),
    }
}

fn table(f: &mut fmt::Formatter<'_>, robots: &[Robot]) -> fmt::Result {
    let head = [
        "ROBOT", "STATE", "SEEN", "NODES", "TOPICS", "LOSS", "VERSION",
    ];
    let mut rows = vec![head.map(str::to_owned)];
    rows.extend(robots.iter().map(cells));
    let mut widths = [0; 7];
    for row in &rows {
        for (width, cell) in widths.iter_mut().zip(row) {
            *width = (*width).max(cell.chars().count());
        }
    }
    for row in &rows {
        let cells = row.iter().zip(widths);
        let line: String = cells
            .map(|(cell, width)| format!("{cell:<width$}  "))
            .collect();
        writeln!(f, "{}", line.trim_end())?;
    }
    Ok(())
}

/// Returns the cells of a robot's row: its name, state, age of the last sample, numbers of nodes and
/// topics, loss, and version. They have no control characters.
pub(super) fn cells(robot: &Robot) -> [String; 7] {
    let is_known = robot.state != State::OutOfReach;
    let known = |text: String| if is_known { text } else { "-".to_owned() };
    [
        visible(&robot.name).to_string(),
        robot.state.label().to_owned(),
        format!("{} ago", duration(robot.age_s)),
        known(robot.nodes.to_string()),
        known(robot.topics.to_string()),
        match robot.loss {
            Some(loss) if is_known => format!("{:.2} %", loss * 100.0),
            _ => "-".to_owned(),
        },
        robot
            .version
            .as_deref()
            .map_or_else(|| "-".to_owned(), |version| visible(version).to_string()),
    ]
}

/// Returns what is wrong with a robot, and what differs from the others, as lines without control
/// characters.
pub(super) fn faults(robot: &Robot) -> impl Iterator<Item = String> {
    let differences = robot.differences.iter();
    trouble(robot).chain(differences.map(|difference| visible(&difference.text).to_string()))
}

/// Returns violated expectations and findings as such lines.
fn trouble(robot: &Robot) -> impl Iterator<Item = String> {
    let violated = robot.violated.iter().map(|(topic, expectation)| {
        format!("{}: {} is violated", visible(topic), visible(expectation))
    });
    let findings = robot
        .findings
        .iter()
        .map(|(kind, count)| format!("{count} x {}", visible(kind)));
    violated.chain(findings)
}

/// Returns the number of lines that [`faults`] has.
pub(super) fn fault_count(robot: &Robot) -> usize {
    robot.violated.len() + robot.findings.len() + robot.differences.len()
}

fn details(f: &mut fmt::Formatter<'_>, robot: &Robot) -> fmt::Result {
    let more = robot.differences.len().saturating_sub(MAX_DIFFERENCES);
    let count = fault_count(robot);
    if count == 0 {
        return Ok(());
    }
    writeln!(f, "\n{}", visible(&robot.name))?;
    let mut lines = faults(robot).take(count - more);
    lines.try_for_each(|line| writeln!(f, "  {line}"))?;
    match more {
        0 => Ok(()),
        more => writeln!(
            f,
            "  ... and {more} more differences: rp fleet {}",
            visible(&robot.name)
        ),
    }
}

/// Returns a duration in its largest whole unit.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "a positive number"
)]
fn duration(seconds: f64) -> String {
    match seconds as u64 {
        seconds @ 0..120 => format!("{seconds} s"),
        seconds @ 120..7_200 => format!("{} min", seconds / 60),
        seconds @ 7_200..172_800 => format!("{} h", seconds / 3_600),
        seconds => format!("{} d", seconds / 86_400),
    }
}

#[cfg(test)]
pub(super) mod tests {
    use std::collections::BTreeMap;

    use ros2probe_api::fleet::Difference;

    use super::*;

    /// Returns a robot without findings and differences.
    pub(in super::super) fn sample(name: &str, state: State, age_s: f64) -> Robot {
        Robot {
            name: name.to_owned(),
            state,
            age_s,
            version: Some("0.1.0".to_owned()),
            nodes: 5,
            topics: 7,
            loss: Some(0.0125),
            violated: Vec::new(),
            findings: BTreeMap::new(),
            differences: Vec::new(),
            page: None,
        }
    }

    #[test]
    fn a_fleet_is_printed_as_a_table_with_details_of_faulty_robots() {
        let robot = sample;
        let mut late = robot("robot-2", State::Violated, 4.2);
        late.violated = vec![("/scan".to_owned(), "min_rate_hz".to_owned())];
        late.findings = [("qos_incompatible".to_owned(), 2)].into();
        let fleet = Fleet {
            robots: vec![
                robot("robot-10", State::OutOfReach, 4_000.0),
                late,
                robot("robot-1", State::Ok, 1.0),
            ],
            ..Fleet::default()
        };
        let expected = "\
ROBOT     STATE         SEEN        NODES  TOPICS  LOSS    VERSION
robot-10  out of reach  66 min ago  -      -       -       0.1.0
robot-2   violated      4 s ago     5      7       1.25 %  0.1.0
robot-1   ok            1 s ago     5      7       1.25 %  0.1.0

robot-2
  /scan: min_rate_hz is violated
  2 x qos_incompatible
";
        assert_eq!(FleetText(&fleet).to_string(), expected);
    }

    #[test]
    fn a_robot_is_printed_with_its_graph_against_the_usual_one() {
        let difference = |part, text: &str| Difference {
            part,
            what: String::new(),
            here: None,
            usual: None,
            robots: 2,
            of: 3,
            text: text.to_owned(),
        };
        let robot = Robot {
            violated: vec![("/scan".to_owned(), "min_rate_hz".to_owned())],
            differences: vec![
                difference(
                    Part::Rates,
                    "rate of /scan: 5.0 Hz, usually 10.0 Hz (2 of 3)",
                ),
                difference(Part::Nodes, "node /other is only here (2 of 3)"),
                difference(Part::Nodes, "node /planner is missing (2 of 3)"),
            ],
            ..sample("robot-7", State::Violated, 2.0)
        };
        let expected = "\
ROBOT    STATE     SEEN     NODES  TOPICS  LOSS    VERSION
robot-7  violated  2 s ago  5      7       1.25 %  0.1.0

in trouble
  /scan: min_rate_hz is violated

nodes
  node /other is only here (2 of 3)
  node /planner is missing (2 of 3)

rates
  rate of /scan: 5.0 Hz, usually 10.0 Hz (2 of 3)
";
        let fleet = |names: &[&str]| Fleet {
            robots: names
                .iter()
                .map(|name| sample(name, State::Ok, 1.0))
                .collect(),
            comparison: Comparison {
                in_reach: names.len(),
                minimum: 3,
            },
            ..Fleet::default()
        };
        let three = fleet(&["robot-1", "robot-2", "robot-3"]);
        assert_eq!(RobotText(&robot, &three).to_string(), expected);
        let usual = sample("robot-1", State::Ok, 1.0);
        let text = RobotText(&usual, &fleet(&["robot-1", "robot-2"])).to_string();
        assert!(
            text.ends_with("\n\nnot compared with the others: 2 in reach, of 3 at least\n"),
            "{text}"
        );
        let lost = sample("robot-4", State::OutOfReach, 1.0);
        let text = RobotText(&lost, &three).to_string();
        assert!(
            text.ends_with("\n\nnot compared with the others: it is out of reach\n"),
            "{text}"
        );
        let text = RobotText(&usual, &three).to_string();
        assert!(
            text.ends_with("\n\nno difference from the other robots\n"),
            "{text}"
        );
    }
}
