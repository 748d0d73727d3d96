//! A storm of log messages from ever new writers and nodes.

use ros2probe_testing::robot_log::{DDS_TYPE, log};
use ros2probe_testing::{robot_diagnostics, robot_parameters, robot_states, robot_transforms};

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

/// Announces a writer of diagnostics or parameters, or sends some.
pub(super) fn parts(observer: &mut Observer, dice: &mut Dice, now: u64) {
    let step = (now - START) / 1_000_000;
    let mut prefix = [7; 12];
    prefix[11] = dice.pick(40) as u8;
    let prefix = GuidPrefix(prefix);
    let (number, kind) = (dice.pick(20), dice.pick(5));
    let guid = Guid::new(prefix, EntityId([kind as u8, 4, number as u8, 3]));
    let message = Message::from(prefix);
    let (topic, type_name) = [
        ("rt/diagnostics".to_owned(), robot_diagnostics::DDS_TYPE),
        ("rt/parameter_events".to_owned(), robot_parameters::EVENT),
        (
            format!("rq/n{number}/set_parametersRequest"),
            robot_parameters::REQUEST,
        ),
        ("rt/tf".to_owned(), robot_transforms::DDS_TYPE),
        (
            format!("rt/r{number}/tf_static"),
            robot_transforms::DDS_TYPE,
        ),
    ][kind as usize]
        .clone();
    let name = format!("{:x}", dice.pick(10_000)).repeat(20);
    let message = match dice.pick(6) {
        0 => message.data(
            SPDP,
            1 + step,
            &forge::participant(prefix, 1_000_000, Some(0)),
        ),
        1 => {
            let payload = forge::endpoint(guid, &topic, type_name, true);
            message.data(SEDP_WRITERS, 1 + step, &payload)
        }
        _ => {
            let value = i64::from_le_bytes([dice.roll() as u8; 8]);
            let text = "x".repeat(dice.pick(300) as usize);
            let payload = match kind {
                0 => robot_diagnostics::diagnostics(&[robot_diagnostics::Status {
                    level: dice.roll() as u8 % 5,
                    name: &name,
                    message: &text,
                    values: &vec![("key", &*text); dice.pick(80) as usize],
                }]),
                1 => {
                    let node = format!("/n{}", dice.pick(100_000));
                    let names: Vec<_> = (0..8).map(|part| format!("{part}{name}")).collect();
                    let values = names
                        .iter()
                        .map(|name| (&**name, dice.roll().cast_signed()));
                    let integers: Vec<_> = values.collect();
                    match dice.pick(2) {
                        0 => robot_parameters::event(&node, &integers, &[], &[]),
                        _ => robot_parameters::event(&node, &[], &integers, &[]),
                    }
                }
                3 | 4 => {
                    let parent = format!("frame{}", dice.pick(300));
                    let children = [0; 6].map(|_| format!("frame{}", dice.pick(3000)));
                    let all = children
                        .each_ref()
                        .map(|child| robot_transforms::Transform {
                            parent: &parent,
                            child,
                            stamp: dice.pick(1 << 40),
                            x: dice.roll() as f64,
                            yaw: dice.roll() as f64,
                        });
                    robot_transforms::transforms(&all)
                }
                _ => robot_parameters::request(&[(&*name, value); 3], true),
            };
            message.data(guid.entity, step, &payload)
        }
    };
    observer.input(Input::Datagram {
        envelope: &forge::multicast(now, 0),
        payload: &message.bytes(),
        handover: None,
    });
}

/// Announces a managed node, a battery or a camera, or sends its state or a message.
pub(super) fn states(observer: &mut Observer, dice: &mut Dice, now: u64) {
    let step = (now - START) / 1_000_000;
    let mut prefix = [8; 12];
    prefix[11] = dice.pick(40) as u8;
    let prefix = GuidPrefix(prefix);
    let (number, kind) = (dice.pick(60), [0, 0, 1, 1, 2, 2][dice.pick(6) as usize]);
    let guid = Guid::new(prefix, EntityId([kind as u8, 5, number as u8, 3]));
    let node = u64::from(prefix.0[11]) * 60 + number;
    let (topic, type_name) = [
        (
            format!("rt/n{node}/transition_event"),
            robot_states::TRANSITION,
        ),
        (format!("rt/battery{node}"), robot_states::BATTERY),
        (
            format!("rt/image{number}"),
            "sensor_msgs::msg::dds_::Image_",
        ),
    ][kind]
        .clone();
    let message = Message::from(prefix);
    let message = match dice.pick(6) {
        0 => message.data(
            SPDP,
            1 + step,
            &forge::participant(prefix, 1_000_000, Some(0)),
        ),
        1 | 2 => {
            let payload = forge::endpoint(guid, &topic, type_name, true);
            message.data(SEDP_WRITERS, 1 + step, &payload)
        }
        _ => {
            let frame = format!("frame{}", dice.pick(3000));
            let payload = match kind {
                0 => robot_states::transition(dice.pick(17) as u8, dice.pick(17) as u8),
                _ => robot_states::with_header(&frame, dice.pick(60_000) as usize),
            };
            message.data(guid.entity, step, &payload)
        }
    };
    observer.input(Input::Datagram {
        envelope: &forge::multicast(now, 0),
        payload: &message.bytes(),
        handover: None,
    });
}
