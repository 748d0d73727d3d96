//! The send queue of a connection to another host, compared with that of its socket.

use std::io::ErrorKind;
use std::os::fd::AsRawFd as _;

use ros2probe_testing::forged::framed;
use ros2probe_testing::harness::network::Link;
use ros2probe_testing::harness::wait_until;
use ros2probe_wire::host::Link as State;
use ros2probe_wire::{EntityId, GuidPrefix};
use zerocopy::FromBytes as _;

use super::*;

/// `SIOCOUTQNSD` of linux/sockios.h: bytes that were written and not sent.
const SIOCOUTQNSD: libc::c_ulong = 0x894b;

/// Returns the bytes of a socket that are sent and not acknowledged, and those that are not sent.
fn queues(socket: &TcpStream) -> Result<(u32, u32)> {
    let read = |request| {
        let mut bytes: libc::c_int = 0;
        // SAFETY: both requests write one integer (tcp(7)).
        let result = unsafe { libc::ioctl(socket.as_raw_fd(), request, &raw mut bytes) };
        ensure!(result == 0, "{}", std::io::Error::last_os_error());
        Ok(u32::try_from(bytes)?)
    };
    let (all, unsent) = (read(libc::TIOCOUTQ)?, read(SIOCOUTQNSD)?);
    Ok((all - unsent, unsent))
}

/// Returns the last report about this connection.
fn last_report(observed: &mut Observed, port: u16) -> Option<State> {
    let chunks = observed.chunks().into_iter();
    let reports = chunks.filter(|(piece, _)| {
        piece.source_port == port && piece.chunk & chunk::LINK != 0 && piece.interface != 1
    });
    reports
        .filter_map(|(_, bytes)| Some(State::read_from_prefix(&bytes).ok()?.0))
        .next_back()
}

/// Opens a connection from an observed socket of the robot to a socket of the monitor.
fn connect_over(link: &Link, observed: &Observed) -> Result<[TcpStream; 2]> {
    let address = (link.monitor.address(), 0);
    let listener = netns::within(&link.monitor.network(), || TcpListener::bind(address))??;
    let to = listener.local_addr()?;
    let client = observed
        .cgroup
        .hold(|| netns::within(&link.robot.network(), || TcpStream::connect(to)))???;
    client.set_nodelay(true)?;
    let (server, _) = listener.accept()?;
    Ok([client, server])
}

#[test]
fn the_send_queue_of_a_receiver_that_stops_reading_equals_that_of_the_socket() -> Result<()> {
    let link = Link::new()?;
    let mut observed = Observed::new()?;
    let [client, server] = connect_over(&link, &observed)?;
    let port = client.local_addr()?.port();
    let message = rtps::data(GuidPrefix([1; 12]), EntityId([0, 0, 1, 3]), &[7; 20_000]);
    let frame = framed(&message);

    // The receiver has read everything: a frame that is under way does not wait.
    (&client).write_all(&frame)?;
    let report = last_report(&mut observed, port).context("no report")?;
    assert_eq!((report.unsent_known, report.unacknowledged > 0), (1, true));

    client.set_nonblocking(true)?;
    let mut rest: &[u8] = &[];
    wait_until("a queue that equals the socket's", || {
        loop {
            if rest.is_empty() {
                rest = &frame;
            }
            match (&client).write(rest) {
                Ok(written) => rest = rest.get(written..).unwrap_or_default(),
                Err(error) if error.kind() == ErrorKind::WouldBlock => break,
                Err(error) => return Err(error.into()),
            }
        }
        let expected = queues(&client)?;
        let Some(report) = last_report(&mut observed, port) else {
            return Ok(false);
        };
        assert_eq!(report.unsent_known, 1);
        let seen = (report.unacknowledged, report.unsent);
        Ok(expected.1 > 100_000 && seen == expected)
    })?;

    // The receiver reads again, and the queue of the next report is empty.
    server.set_nonblocking(true)?;
    let mut buffer = vec![0; 1 << 20];
    wait_until("an empty queue", || {
        while matches!((&server).read(&mut buffer), Ok(length) if length > 0) {}
        match (&client).write(rest) {
            Ok(written) => rest = rest.get(written..).unwrap_or_default(),
            Err(error) if error.kind() == ErrorKind::WouldBlock => {}
            Err(error) => return Err(error.into()),
        }
        if rest.is_empty() {
            rest = &frame;
        }
        let report = last_report(&mut observed, port);
        Ok(report.is_some_and(|report| report.unsent == 0) && queues(&client)?.1 == 0)
    })
}
