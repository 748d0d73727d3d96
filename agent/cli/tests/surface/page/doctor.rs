//! The report of `rp doctor` in the API.

use super::*;
use ros2probe_api::doctor::{Area, Report};

#[test]
fn the_doctor_of_a_replay_examines_only_the_capture() {
    let agent = ended("cyclonedds/qos-mismatch-2ns", &[]);
    let report = get(&agent, "/doctor");
    let report: Report = serde_json::from_value(report).unwrap();
    assert_eq!(report.subject, "this capture");
    assert!(!report.findings.is_empty());
    let mut areas = report.findings.iter();
    assert!(
        areas.all(|finding| finding.area == Area::Graph),
        "{report:?}"
    );
}
