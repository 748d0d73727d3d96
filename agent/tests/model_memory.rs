//! What deliveries take: measured in a process of its own, in which nothing else happens.
#![allow(
    clippy::unwrap_used,
    clippy::indexing_slicing,
    reason = "a test that meets the unexpected has failed"
)]

#[path = "model/forge.rs"]
#[allow(dead_code, reason = "shared with other tests")]
mod forge;
#[path = "model/host.rs"]
#[allow(dead_code, reason = "shared with other tests")]
mod host;

use std::fs;

use host::{BOB, Host, Seen};

/// Bytes of this process in memory.
fn resident() -> usize {
    let status = fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find(|line| line.starts_with("VmRSS:"));
    let kibibytes = line.and_then(|line| line.split_whitespace().nth(1));
    1024 * kibibytes.unwrap().parse::<usize>().unwrap()
}

#[test]
fn an_idle_delivery_takes_less_than_a_kibibyte_and_a_half() {
    const DELIVERIES: u64 = 500;
    const ROUNDS: u64 = 6;
    let mut worlds: Vec<_> = (0..ROUNDS).map(|_| Host::new()).collect();
    let address = worlds[0].reader(BOB, 7411);
    let at = |socket: u64| Seen {
        socket,
        ..address.multicast(socket)
    };
    for world in &mut worlds {
        world.data(at(1), 1);
    }
    let before = resident();
    for world in &mut worlds {
        // Busy for longer than a gap stays open, then idle.
        for number in 2..=150 {
            (1..=DELIVERIES).for_each(|socket| world.data(at(socket), number));
            world.wait(100);
        }
        (0..20).for_each(|_| world.wait(1000));
        assert_eq!(world.deliveries().len() as u64, DELIVERIES);
    }
    let each = (resident() - before) / usize::try_from(DELIVERIES * ROUNDS).unwrap();
    assert!((300..1536).contains(&each), "{each} bytes");
    println!("{each} bytes a delivery");
}
