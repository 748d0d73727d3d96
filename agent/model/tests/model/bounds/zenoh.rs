//! Forged connections of Zenoh: sessions, aliases, tokens, publications and unfinished messages.

use super::*;
use ros2probe_model::graph::zenoh::{StreamEvent, Unseen};
use ros2probe_testing::zenoh::{
    Role, connection, declare_key, declare_token, fragment, frame, init, publisher, push, report,
    response, send,
};

const SERVICE: &str = "0/stop/std_srvs::srv::dds_::Empty_/TypeHashNotSupported";

/// Sends one batch.
pub(super) fn batches(observer: &mut Observer, dice: &mut Dice, now: u64) {
    let [mut there, back] = connection(u16::try_from(dice.pick(3_000)).unwrap());
    if dice.pick(3) == 0 {
        there = back;
    }
    let id = u32::try_from(dice.pick(20_000)).unwrap() + 1;
    let mut zid = [9; 16];
    zid[..4].copy_from_slice(&id.to_le_bytes());
    if dice.pick(100) == 0 {
        report(observer, &there, now, StreamEvent::Unseen(Unseen::Tls));
    }
    let server = publisher(zid, id, "/stop").replace("/MP/", "/SS/");
    let server = server.replace(
        "std_msgs::msg::dds_::String_",
        "std_srvs::srv::dds_::Empty_",
    );
    let batch = match dice.pick(8) {
        6 => frame(id, &[declare_token(id, &server)]),
        7 => {
            let reply = response(SERVICE, zid, dice.number(), &[0; 8]);
            let declared = declare_token(id, &server);
            frame(id, &[declared, reply])
        }
        0 => init(zid, Role::Peer, None),
        1 => {
            let key = format!("0/t{id}/std_msgs::msg::dds_::String_/TypeHashNotSupported");
            frame(id, &[declare_key(u16::try_from(id).unwrap(), &key)])
        }
        2 | 3 => frame(id, &[declare_token(id, &publisher(zid, id, "/chatter"))]),
        4 => frame(id, &[push(3, zid, dice.number(), &[0; 40])]),
        _ => {
            let message = push(3, zid, 1, &[0; 4_000]);
            fragment(id, true, true, &message[..2_000])
        }
    };
    send(observer, &there, now, &batch);
}
