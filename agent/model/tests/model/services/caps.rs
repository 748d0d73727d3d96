//! The caps of the tables of services.

use super::*;
use ros2probe_model::facts::bounded::ledger;
use ros2probe_model::facts::tables::ServiceWriters;

/// Returns the largest size of a table so far, and its cap.
fn size(table: &str) -> (usize, usize) {
    let used = ledger()[table];
    (used.largest, used.cap)
}

fn evictions(robot: &Robot) -> u64 {
    let tables = robot.domain.snapshot().tables;
    tables
        .iter()
        .find(|table| table.table == "calls")
        .unwrap()
        .evictions
}

/// Adds the writers of many services to one participant.
fn clients(robot: &mut Robot, count: u64) -> Vec<Party> {
    robot.domain.participant(prefix(1), LEASE);
    let client = |number: u64| {
        let [.., high, low] = (number + 256).to_be_bytes();
        let writer = Guid::new(prefix(1), EntityId([0, high, low, 3]));
        let topic = format!("rq/s{number}Request");
        robot.domain.endpoint(writer, number + 1, &topic);
        Party {
            writer,
            identity: writer.to_bytes(),
        }
    };
    (0..count).map(client).collect()
}

#[test]
fn writers_beyond_the_cap_are_not_captured() {
    let mut robot = Robot::new(Middleware::Fast);
    clients(&mut robot, 4_000);
    let full = ServiceWriters::CAP - 4_000;
    for number in 0..=full {
        let writer = Guid::new(prefix(2), EntityId([1, number as u8, 1, 3]));
        robot.domain.participant(prefix(2), LEASE);
        robot
            .domain
            .endpoint(writer, number as u64 + 1, "rr/otherReply");
    }
    assert_eq!(size("services.writers"), (4_096, 4_096));
    assert_eq!(evictions(&robot), 1);
    let interest = robot.domain.observer.drain().interest;
    let captured = interest
        .iter()
        .filter(|(_, it)| *it == Some(Verdict::Capture));
    assert_eq!(captured.count(), 4_096);
}

#[test]
fn a_new_service_displaces_the_idle_one_with_the_oldest_call() {
    let mut robot = Robot::new(Middleware::Fast);
    let server = robot.server(9, "/s0");
    let clients = clients(&mut robot, 514);
    robot.request(clients[0], 1);
    robot.reply(server, 1, clients[0], 1);
    for client in &clients[1..] {
        robot.wait(1);
        robot.request(*client, 1);
    }
    // The first service is idle; all others wait for a reply and stay.
    assert_eq!(size("services.services"), (512, 512));
    assert_eq!((robot.service("/s0"), evictions(&robot)), (None, 2));
    assert!(robot.service("/s1").is_some() && robot.service("/s512").is_some());
    assert_eq!(robot.service("/s513"), None);
}

#[test]
fn a_new_call_displaces_the_oldest_one() {
    let mut robot = Robot::new(Middleware::Cyclone);
    let client = robot.client(1, ADD);
    let server = robot.server(2, ADD);
    for number in 1..=4_100 {
        robot.request(client, number);
        robot.domain.now += MILLISECOND / 100;
    }
    assert_eq!(size("calls"), (4_096, 4_096));
    assert_eq!(size("services.identities"), (4_096, 4_096));
    assert_eq!(evictions(&robot), 4);
    robot.reply(server, 1, client, 1);
    assert_eq!(robot.counts(), (4_100, 0, 0, 0));
    robot.reply(server, 2, client, 5);
    assert_eq!(robot.counts(), (4_100, 1, 0, 0));
}

#[test]
fn a_new_client_displaces_the_one_with_the_longest_silence() {
    let mut robot = Robot::new(Middleware::Cyclone);
    let client = robot.client(1, ADD);
    for number in 0..300_u16 {
        let mut identity = [0; 16];
        identity[..2].copy_from_slice(&number.to_be_bytes());
        let message = robot.message(client, number.into(), (identity, 1), &[7; 8]);
        robot.domain.put(message);
        robot.wait(1);
    }
    assert_eq!(size("services.clients"), (256, 256));
    assert_eq!(robot.counts().0, 300);
}

#[test]
fn a_reply_in_too_many_parts_is_not_counted_as_complete() {
    let mut robot = Robot::new(Middleware::Cyclone);
    let client = robot.client(1, ADD);
    let server = robot.server(2, ADD);
    robot.request(client, 1);
    let mut fragment = |start| robot.part_of_a_reply(server, client, &[5; 10_000], start, 100);
    (0..50).for_each(|part| fragment(2 * part + 1));
    (0..50).for_each(|part| fragment(2 * part + 2));
    assert_eq!(size("services.runs"), (16, 16));
    // Runs were dropped, so the reply is not known to be complete.
    assert_eq!(robot.counts(), (1, 0, 0, 0));
}

#[test]
fn a_service_above_its_budget_of_bytes_is_temporarily_not_captured() {
    let mut robot = Robot::new(Middleware::Cyclone);
    let client = robot.client(1, ADD);
    robot.domain.observer.drain();
    let verdicts = |robot: &mut Robot| robot.domain.observer.drain().interest;
    for number in 1..=80 {
        robot.request_with(client, number, &[7; 60_000]);
    }
    assert_eq!(
        verdicts(&mut robot),
        [(client.writer, Some(Verdict::Ignore))]
    );
    let service = robot.service(ADD).unwrap();
    assert!(service.suspended);
    assert_eq!((service.open, robot.hanging()), (0, vec![]));
    robot.wait(11_000);
    assert_eq!(
        verdicts(&mut robot),
        [(client.writer, Some(Verdict::Capture))]
    );
    let before = robot.counts().0;
    robot.request(client, 100);
    assert_eq!(robot.counts(), (before + 1, 0, 0, 0));
    assert!(!robot.service(ADD).unwrap().suspended);
}
