//! Forged calls of services and goals of actions, with identities that seldom match.

use super::*;

const ADD: [EntityId; 2] = [EntityId([0, 5, 1, 3]), EntityId([0, 5, 2, 3])];
const GOALS: [EntityId; 2] = [EntityId([0, 5, 3, 3]), EntityId([0, 5, 4, 3])];
const DESCRIPTIONS: [EntityId; 2] = [EntityId([0, 5, 5, 3]), EntityId([0, 5, 6, 3])];

/// Announces the writers of requests and replies of two services and one action.
fn announce(observer: &mut Observer) {
    let topics = [
        (ADD[0], "rq/addRequest"),
        (ADD[1], "rr/addReply"),
        (GOALS[0], "rq/fib/_action/send_goalRequest"),
        (GOALS[1], "rr/fib/_action/send_goalReply"),
        (DESCRIPTIONS[0], "rq/talker/get_type_descriptionRequest"),
        (DESCRIPTIONS[1], "rr/talker/get_type_descriptionReply"),
    ];
    let payload = forge::participant(ALICE, 1_000_000, Some(0));
    let mut messages = vec![Message::from(ALICE).data(SPDP, 1, &payload)];
    for (number, (entity, topic)) in (1..).zip(topics) {
        let guid = Guid::new(ALICE, entity);
        let payload = forge::endpoint(guid, topic, "a::srv::dds_::B_Request_", true);
        messages.push(Message::from(ALICE).data(SEDP_WRITERS, number, &payload));
    }
    for message in messages {
        observer.input(Input::Datagram {
            envelope: &forge::multicast(START, 0),
            payload: &message.bytes(),
            handover: None,
        });
    }
}

/// Sends a request, a reply, a fragment of a reply, or a reply with TypeObjects. Half of the identities repeat.
pub(super) fn calls(observer: &mut Observer, dice: &mut Dice, now: u64) {
    let step = (now - START) / 1_000_000;
    if step == 1 {
        announce(observer);
    }
    let client = match dice.pick(2) {
        0 => dice.pick(20),
        _ => dice.roll(),
    };
    let number = 1 + step / 1000 + dice.pick(3);
    let mut payload = [
        &[0, 1, 0, 0],
        &client.to_le_bytes()[..],
        &number.to_le_bytes(),
        &[1; 3000],
    ]
    .concat();
    let [requests, replies] = match dice.pick(8) {
        0 | 1 => GOALS,
        2 => DESCRIPTIONS,
        _ => ADD,
    };
    let message = Message::from(ALICE);
    let message = match dice.pick(6) {
        5 => message.data(EntityId::TYPE_LOOKUP_REPLY_WRITER, step, &payload),
        0..3 => {
            payload.truncate(40);
            message.data(requests, step, &payload)
        }
        3 => {
            payload.truncate(40);
            message.data(replies, step, &payload)
        }
        _ => message.fragment(replies, step, 1, 1000, &payload),
    };
    observer.input(Input::Datagram {
        envelope: &forge::multicast(now, 0),
        payload: &message.bytes(),
        handover: None,
    });
}
