//! A fleet as text.

use std::fmt;

use ros2probe_daemon::escape::visible;

use super::robot::{Fleet, Robot, State};

/// Maximum number of printed differences of a robot.
const MAX_DIFFERENCES: usize = 12;

impl fmt::Display for Fleet {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let head = [
            "ROBOT", "STATE", "SEEN", "NODES", "TOPICS", "LOSS", "VERSION",
        ];
        let mut rows = vec![head.map(str::to_owned)];
        rows.extend(self.robots.iter().map(cells));
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
        for robot in &self.robots {
            details(f, robot)?;
        }
        Ok(())
    }
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
    let violated = robot.violated.iter().map(|(topic, expectation)| {
        format!("{}: {} is violated", visible(topic), visible(expectation))
    });
    let findings = robot
        .findings
        .iter()
        .map(|(kind, count)| format!("{count} x {}", visible(kind)));
    let differences = robot.differences.iter();
    let differences = differences.map(|difference| visible(&difference.to_string()).to_string());
    violated.chain(findings).chain(differences)
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
        more => writeln!(f, "  ... and {more} more differences (--json)"),
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
mod tests {
    use super::*;

    #[test]
    fn a_fleet_is_printed_as_a_table_with_details_of_faulty_robots() {
        let robot = Robot::sample;
        let mut late = robot("robot-2", State::Violated, 4.2);
        late.violated = vec![("/scan".to_owned(), "min_rate_hz".to_owned())];
        late.findings = [("qos_incompatible".to_owned(), 2)].into();
        let fleet = Fleet {
            robots: vec![
                robot("robot-10", State::OutOfReach, 4_000.0),
                late,
                robot("robot-1", State::Ok, 1.0),
            ],
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
        assert_eq!(fleet.to_string(), expected);
    }
}
