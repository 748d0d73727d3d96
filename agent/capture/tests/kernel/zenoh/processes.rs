//! Processes of sessions, found by the owners of their sockets.

use super::*;

#[test]
fn a_session_runs_in_the_process_that_holds_its_socket() -> Result<()> {
    const ROUTER: [u8; 16] = [0x22; 16];
    let name = std::fs::read_to_string("/proc/self/comm")?;
    for (talker, is_late) in [([0x11; 16], false), ([0x33; 16], true)] {
        let mut observed = Observed::new()?;
        observed.filter.attach_tracepoints(false);
        let token = forged::publisher(talker, 10, "/chatter");
        let mut to_router = observed.connect("127.0.0.1:0")?;
        // One process has both ends here, and a process with a router has no session beside it.
        let role = match is_late {
            true => forged::Role::Peer,
            false => forged::Role::Router,
        };
        let ack = forged::init(ROUTER, role, Some(&[]));
        let declared = forged::frame(7, &[forged::declare_token(1, &token)]);
        // A late agent learns the token from the router.
        if !is_late {
            let init = forged::init(talker, forged::Role::Peer, None);
            pass(&mut to_router, true, &with_prefix(&init))?;
        }
        pass(&mut to_router, false, &with_prefix(&ack))?;
        pass(&mut to_router, is_late, &with_prefix(&ack))?;
        pass(&mut to_router, !is_late, &with_prefix(&declared))?;
        let mut observer = Observer::new(Settings::default());
        observed.feed(&mut observer);
        if is_late {
            let mut connection = observed.connect("127.0.0.1:0")?;
            for number in 1..=10 {
                let gid = Gid::of_token(&token).0;
                let push = forged::push(3, gid, number, b"\0\x01\0\0");
                let batch = forged::frame(u32::try_from(number)?, &[push]);
                pass(&mut connection, true, &with_prefix(&batch))?;
            }
            observed.feed(&mut observer);
            check_process(&observed, observer, &name, 3)?;
        } else {
            check_process(&observed, observer, &name, 2)?;
        }
    }
    Ok(())
}

/// Checks the process of the only participant, and the number of sockets that were looked up.
fn check_process(
    observed: &Observed,
    mut observer: Observer,
    name: &str,
    expected: usize,
) -> Result<()> {
    let path = observed.cgroup.path();
    let hierarchy = path.parent().context("no parent")?;
    let mut sockets = Sockets::new(hierarchy.to_owned());
    let now = Clocks::read().monotonic;
    sockets.follow(&observed.filter, now, &mut observer);
    let snapshot = observer.snapshot(Timestamp(now + SECOND));
    let [participant] = &snapshot.participants[..] else {
        anyhow::bail!("{:?}", snapshot.participants);
    };
    let process = &participant.process;
    assert_eq!(process.id, Some(std::process::id()), "{process:?}");
    assert_eq!(process.name.as_deref(), Some(name.trim_end()));
    let cgroup = path.file_name().context("no name")?.display();
    assert_eq!(process.cgroup.as_deref(), Some(&*format!("/{cgroup}")));
    assert_eq!(observed.filter.sockets().count(), expected);
    Ok(())
}
