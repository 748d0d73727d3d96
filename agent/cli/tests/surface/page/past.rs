//! The history on disk of an agent without one.

use super::*;

#[test]
fn a_replay_keeps_no_history_on_disk_and_reports_the_reason() {
    let agent = ended("cyclonedds/points-besteffort-lossy-2ns", &[]);
    let about = get(&agent, "/history");
    assert_eq!(
        (&about["is_kept"], &about["bytes"]),
        (&json!(false), &json!(0))
    );
    assert_eq!(about["seconds"], Value::Null);
    for path in [
        "/history/moment?at=1790000000",
        "/history/moment/parameters?at=1790000000",
        "/history/processes",
        "/history/events?from=1&to=2",
        "/topics/points/history?from=1&to=2",
    ] {
        let answer = request(agent.api, "GET", path, "");
        assert_eq!(
            (answer.status, code(&answer).as_str()),
            (404, "no-history"),
            "{path}"
        );
        assert!(answer.body.contains("state directory"), "{}", answer.body);
    }
    for path in [
        "/history/processes?from=3&to=2",
        "/history/events?to=-1",
        "/history/moment?at=1e12",
        "/history/moment/chains?at=1e12",
        "/history/moment/doctor?at=1790000000",
        "/topics/points/history?step=0",
    ] {
        let answer = request(agent.api, "GET", path, "");
        assert_eq!(answer.status, 422, "{path}");
    }
}
