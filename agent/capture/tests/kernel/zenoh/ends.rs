//! Ends of connections, and connections that cannot be read.

use super::*;

#[test]
fn the_end_of_a_connection_is_reported_by_each_sender_and_a_reset_at_least_once() -> Result<()> {
    for is_reset in [false, true] {
        let mut observed = Observed::new()?;
        let mut connection = observed.connect("127.0.0.1:0")?;
        for by_client in [true, false] {
            pass(&mut connection, by_client, &with_prefix(INIT))?;
        }
        let [client, server] = connection;
        if is_reset {
            // With unread bytes at the close, the kernel resets the connection.
            (&server).write_all(&with_prefix(&[4]))?;
            while client.peek(&mut [0; 3])? < 3 {}
        }
        drop(client);
        drop(server);
        let seen = observed.seen();
        assert_eq!(seen.len(), 2, "{seen:?}");
        for (id, seen) in &seen {
            assert_eq!((seen.begun, seen.gaps), (1, 0), "{is_reset} {id:?}");
        }
        let ended: u64 = seen.values().map(|seen| seen.ended).sum();
        let expected = if is_reset { 1..=2 } else { 2..=2 };
        assert!(expected.contains(&ended), "{is_reset} {seen:?}");
    }
    Ok(())
}

// Coverage: Zenoh over TLS | - | - | named
#[test]
fn tls_and_other_versions_are_reported_only_on_a_port_of_zenoh() -> Result<()> {
    let mut observed = Observed::new()?;
    let hello = [
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03".as_slice(),
        &random(1, 506),
    ]
    .concat();
    let other = [&[0x41, 0x08][..], &INIT[2..]].concat();
    for (port, ends) in [(7447, true), (7448, false)] {
        for (bytes, is_tls) in [(&hello, true), (&with_prefix(&other), false)] {
            let mut connection = observed.connect(&format!("127.0.0.1:{port}"))?;
            pass(&mut connection, true, bytes)?;
            for _ in 0..10 {
                pass(&mut connection, true, &random(3, 5000))?;
            }
            let chunks = observed.chunks();
            assert!(ends || chunks.iter().all(|(_, bytes)| bytes.is_empty()));
            let seen = observed.read(chunks);
            let [out, ..] = directions(&seen, &connection)?;
            assert_eq!(out.is_some(), ends, "{port} {is_tls}");
            let Some(out) = out else { continue };
            assert_eq!(out.unseen, if is_tls { vec![Unseen::Tls] } else { vec![] });
            assert_eq!(out.batches.len(), usize::from(!is_tls));
            // The port is reused immediately.
            rst_on_close(&connection[1]);
            drop(connection);
            let ended: u64 = observed.seen().values().map(|seen| seen.ended).sum();
            assert!(ended >= 1, "the end of a connection that cannot be read");
        }
    }
    Ok(())
}

#[test]
fn of_a_clients_hello_on_another_port_the_addresses_are_passed_on_and_no_byte() -> Result<()> {
    let mut observed = Observed::new()?;
    let client = b"\x16\x03\x01\x00\x20\x01\x00\x00\x1c\x03\x03".as_slice();
    let server = b"\x16\x03\x03\x00\x20\x02\x00\x00\x1c\x03\x03".as_slice();
    let mut connection = observed.connect("127.0.0.1:0")?;
    let [from, to] = [connection[0].local_addr()?, connection[1].local_addr()?];
    pass(&mut connection, true, client)?;
    pass(&mut connection, false, server)?;
    pass(&mut connection, true, &random(5, 5000))?;
    let chunks = observed.chunks();
    let [(piece, bytes)] = &chunks[..] else {
        panic!("{chunks:?}")
    };
    assert_ne!(piece.chunk & chunk::CLIENT_HELLO, 0);
    assert_eq!(
        (piece.source_port, piece.destination_port),
        (from.port(), to.port())
    );
    assert_eq!(
        (piece.datagram_len as usize, bytes.len()),
        (client.len(), 0)
    );
    Ok(())
}

/// Makes the close of a socket reset the connection, so that it leaves no state.
fn rst_on_close(socket: &TcpStream) {
    use std::os::fd::AsRawFd as _;
    let linger = libc::linger {
        l_onoff: 1,
        l_linger: 0,
    };
    // SAFETY: the option has the given size.
    let set = unsafe {
        libc::setsockopt(
            socket.as_raw_fd(),
            libc::SOL_SOCKET,
            libc::SO_LINGER,
            (&raw const linger).cast(),
            size_of::<libc::linger>() as u32,
        )
    };
    assert_eq!(set, 0);
}
