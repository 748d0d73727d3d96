//! Hostile streams, a full ring, and more connections than the caps.

use super::*;

#[test]
fn hostile_streams_cause_bounded_copies_and_are_delivered() -> Result<()> {
    let mut observed = Observed::new()?;
    let endless = [
        &0xffff_u16.to_le_bytes()[..],
        &[0x25, 1, 0x1d],
        &vec![0x80; 65_532],
    ]
    .concat();
    let empty = vec![0; 100_000];
    let many: Vec<u8> = std::iter::repeat_n(with_prefix(&[4]), 30_000)
        .flatten()
        .collect();
    let extensions = with_prefix(&[&[0xa5, 1][..], &[0xff; 4000]].concat());
    let cut = with_prefix(&[0x25, 0x80, 0x80]);
    for (number, bytes) in [endless, empty, many, extensions, cut, random(9, 20 << 20)]
        .iter()
        .enumerate()
    {
        let mut connection = observed.connect("127.0.0.1:0")?;
        pass(&mut connection, true, &with_prefix(INIT))?;
        for part in bytes.chunks(150_000) {
            pass(&mut connection, true, part)?;
        }
        let copied: usize = observed.chunks().iter().map(|(_, bytes)| bytes.len()).sum();
        println!("stream {number}: {copied} of {} bytes copied", bytes.len());
        // A connection without boundaries is ignored after 16 MB.
        ensure!(
            copied <= bytes.len().min(17 << 20) + 4096,
            "{number}: {copied}"
        );
    }
    Ok(())
}

#[test]
fn user_space_detects_the_chunks_that_a_full_ring_lost() -> Result<()> {
    let mut observed = Observed::with(&FilterSettings {
        piece_ring_bytes: 65_536,
        ..FilterSettings::default()
    })?;
    let mut connection = observed.connect("127.0.0.1:0")?;
    pass(&mut connection, true, &with_prefix(INIT))?;
    for number in 0..500_u16 {
        let number = u8::try_from(number % 128)?;
        pass(
            &mut connection,
            true,
            &with_prefix(&push(number & 0x7f, [9; 16], &[3; 900])),
        )?;
    }
    assert!(observed.counter(Counter::ZenohChunksLost)? > 0);
    let seen = observed.seen();
    let [out, ..] = directions(&seen, &connection)?;
    assert_eq!(out.context("unseen")?.gaps, 0, "not known yet");
    pass(
        &mut connection,
        true,
        &with_prefix(&push(1, [9; 16], &[3; 900])),
    )?;
    pass(
        &mut connection,
        true,
        &with_prefix(&push(2, [9; 16], &[3; 900])),
    )?;
    let seen = observed.seen();
    let [out, ..] = directions(&seen, &connection)?;
    let out = out.context("unseen")?;
    assert_eq!((out.gaps, out.batches.len()), (1, 2));
    Ok(())
}

/// Opens `count` connections to one server.
fn connect_many(observed: &Observed, count: usize) -> Result<Vec<[TcpStream; 2]>> {
    let files = libc::rlimit {
        rlim_cur: 16_384,
        rlim_max: 16_384,
    };
    // SAFETY: the limit outlives the call.
    ensure!(unsafe { libc::setrlimit(libc::RLIMIT_NOFILE, &raw const files) } == 0);
    observed.make(|| -> Result<_> {
        let listener = TcpListener::bind("127.0.0.1:0")?;
        let mut all = Vec::new();
        for _ in 0..count {
            let client = TcpStream::connect(listener.local_addr()?)?;
            client.set_nodelay(true)?;
            all.push([client, listener.accept()?.0]);
        }
        Ok(all)
    })?
}

#[test]
fn connections_beyond_the_cap_evict_idle_ones() -> Result<()> {
    let mut observed = Observed::new()?;
    let mut all = connect_many(&observed, 3000)?;
    for connection in &mut all {
        for by_client in [true, false] {
            pass(connection, by_client, &with_prefix(INIT))?;
        }
    }
    let begun: u64 = observed.seen().values().map(|seen| seen.begun).sum();
    assert_eq!(begun, 6000, "each is seen when it begins");
    let before = observed.counter(Counter::ZenohBatches)?;
    for connection in &mut all {
        for by_client in [true, false] {
            let push = with_prefix(&push(1, [1; 16], &[0; 20]));
            pass(connection, by_client, &push)?;
        }
    }
    let followed = observed.counter(Counter::ZenohBatches)? - before;
    println!("{followed} of 6000 directions are followed");
    assert!(
        (2000..=u64::from(CONNECTION_CAPACITY)).contains(&followed),
        "{followed}"
    );
    Ok(())
}

#[test]
fn candidates_beyond_the_cap_evict_the_oldest_one() -> Result<()> {
    const CONNECTIONS: u64 = 2_000;
    const ROUNDS: u64 = 3;
    let observed = Observed::new()?;
    let mut all = connect_many(&observed, CONNECTIONS as usize)?;
    let push_to = |connection: &mut [TcpStream; 2], number: u8| {
        let batch = with_prefix(&push(number, [1; 16], &[0; 20]));
        pass(connection, true, &batch)
    };
    for number in 1..=ROUNDS as u8 {
        for connection in &mut all {
            push_to(connection, number)?;
        }
    }
    let candidates = observed.counter(Counter::ZenohCandidates)?;
    let found = observed.counter(Counter::ZenohConnections)?;
    println!("{candidates} candidates, {found} of {CONNECTIONS} found");
    // The kernel decides how many candidates it keeps. The others begin anew in each later round.
    let room = u64::from(CANDIDATE_CAPACITY);
    let begun_anew = (ROUNDS - 1) * (CONNECTIONS - room);
    assert!(
        candidates >= CONNECTIONS + begun_anew && found <= room,
        "{candidates} {found}"
    );
    let mut late = connect_many(&observed, 1)?;
    for number in 1..=ROUNDS as u8 {
        push_to(&mut late[0], number)?;
    }
    assert_eq!(
        observed.counter(Counter::ZenohConnections)?,
        found + 1,
        "a full table has room for the next"
    );
    Ok(())
}
