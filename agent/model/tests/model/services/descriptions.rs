//! Responses of `get_type_description`, which the model passes on as a whole.

use std::sync::Arc;

use ros2probe_model::derive::type_descriptions::TypeSource;
use ros2probe_model::facts::bounded::{Declared as _, ledger};
use ros2probe_model::facts::tables::WaitingDescriptions;

use super::*;

const DESCRIBE: &str = "/talker/get_type_description";

/// Returns the responses that were passed on.
fn taken(robot: &mut Robot) -> Vec<Arc<[u8]>> {
    let sources = robot.domain.observer.drain().type_sources;
    let responses = sources.into_iter().map(|source| match source {
        TypeSource::Description(response) => response,
        TypeSource::TypeObjects(reply) => panic!("{reply:?} is no response"),
    });
    responses.collect()
}

/// Returns the payload of a response with this body.
fn payload(body: &[u8]) -> Arc<[u8]> {
    [&[0, 1, 0, 0], body].concat().into()
}

#[test]
fn a_response_is_passed_on_once_and_without_the_header_of_the_middleware() {
    with_each(|mut robot| {
        let client = robot.client(1, DESCRIBE);
        let server = robot.server(2, DESCRIBE);
        robot.request(client, 1);
        for _ in 0..3 {
            robot.reply_with(server, 1, client, 1, b"response");
        }
        assert_eq!(taken(&mut robot), [payload(b"response")]);
        robot.reply_with(server, 2, client, 2, b"another1");
        assert_eq!(taken(&mut robot), [payload(b"another1")]);
        // The call is measured as before.
        assert_eq!(robot.service(DESCRIBE).unwrap().answered, 1);
    });
}

#[test]
fn requests_and_responses_of_other_services_are_not_passed_on() {
    with_each(|mut robot| {
        let client = robot.client(1, ADD);
        let server = robot.server(2, ADD);
        let asking = robot.client(3, DESCRIBE);
        robot.request(client, 1);
        robot.request(asking, 1);
        robot.reply(server, 1, client, 1);
        assert!(taken(&mut robot).is_empty());
    });
}

#[test]
fn the_fragments_of_a_response_are_joined_in_any_order() {
    let mut robot = Robot::new(Middleware::Cyclone);
    let client = robot.client(1, DESCRIBE);
    let server = robot.server(2, DESCRIBE);
    let body: Vec<u8> = (0..4_000_u32).map(|number| number as u8).collect();
    // The header before the body has 20 bytes.
    for start in [4, 2, 1, 3, 2] {
        robot.part_of_a_reply(server, client, &body, start, 1_005);
    }
    assert_eq!(taken(&mut robot), [payload(&body)]);
}

#[test]
fn only_the_latest_responses_wait_and_large_ones_are_left_out() {
    let mut robot = Robot::new(Middleware::Fast);
    let client = robot.client(1, DESCRIBE);
    let server = robot.server(2, DESCRIBE);
    let most = WaitingDescriptions::CAP as u64;
    for number in 1..=most + 4 {
        let body = number.to_le_bytes();
        robot.reply_with(server, number, client, number, &body);
        assert_eq!(robot.domain.observer.has_much_output(), number * 2 >= most);
    }
    let taken = taken(&mut robot);
    assert_eq!(taken.len() as u64, most);
    assert_eq!(taken.first(), Some(&payload(&5_u64.to_le_bytes())));
    assert!(ledger()[WaitingDescriptions::TABLE.name].is_driven());
}
