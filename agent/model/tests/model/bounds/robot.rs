//! A storm of log messages from ever new writers and nodes.

use ros2probe_testing::robot_log::{DDS_TYPE, log};

use super::*;

/// Announces a writer of a log, or logs something.
pub(super) fn logs(observer: &mut Observer, dice: &mut Dice, now: u64) {
    let step = (now - START) / 1_000_000;
    let mut prefix = [6; 12];
    prefix[11] = dice.pick(40) as u8;
    let prefix = GuidPrefix(prefix);
    let guid = |number: u64| Guid::new(prefix, EntityId([0, 4, number as u8, 3]));
    let number = dice.pick(60);
    let message = Message::from(prefix);
    let message = match dice.pick(6) {
        0 => message.data(
            SPDP,
            1 + step,
            &forge::participant(prefix, 1_000_000, Some(0)),
        ),
        1 | 2 => {
            let payload = forge::endpoint(guid(number), "rt/rosout", DDS_TYPE, true);
            message.data(SEDP_WRITERS, 1 + step, &payload)
        }
        _ => {
            let logger = format!("node{:x}", dice.pick(2000));
            let text = vec![dice.roll() as u8; dice.pick(3000) as usize];
            message.data(
                guid(number).entity,
                step,
                &log(dice.roll() as u8, &logger, &text),
            )
        }
    };
    observer.input(Input::Datagram {
        envelope: &forge::multicast(now, 0),
        payload: &message.bytes(),
        handover: None,
    });
}
