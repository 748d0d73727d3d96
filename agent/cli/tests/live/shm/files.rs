//! Content of the files in shared memory, and the system calls that open them.

use super::*;

/// Number of attempts after which the surviving peer is replaced, too.
const MAX_ATTEMPTS_PER_PEER: u32 = 3;

#[test]
fn idle_malformed_truncated_and_foreign_files_are_ignored() -> Result<()> {
    let network = Namespace::isolated()?;
    let host = Host::new(&network)?;
    let directory = tempfile::tempdir()?;
    let agent = start_agent(&network, directory.path())?;
    let stream = Stream {
        count: 1_000_000,
        ..shared()
    };
    let (mut publisher, mut subscriber) = host.known_pair(&agent, &stream)?;
    let memory = host.shared_memory();
    let (ports, segments) = files_of(&memory)?;
    write_idle_and_broken_files(&memory, &ports[0])?;
    publisher.start_sending()?;
    let open = |page: &Scrape| page.sum("ros2probe_shm_open", &[("kind", "port")]);
    let idle = agent.scrape_until("128 more ports", |page| open(page) >= 130.0)?;
    let began = messages(&idle);
    agent.scrape_until("messages beside them", |page| {
        messages(page) > began + 200.0
    })?;
    println!("{}", shared_memory_metrics(&agent.scrape()?));

    replaced_and_removed_files_are_closed(&host, &agent, &ports, &segments[0])?;
    // The peers cannot continue without their memory; the agent can.
    for name in files_of(&memory)?.1 {
        let file = fs::File::options().write(true).open(memory.join(name))?;
        file.set_len(100)?;
    }
    std::thread::sleep(Duration::from_secs(1));
    for peer in [&mut publisher, &mut subscriber] {
        peer.process.signal("KILL")?;
        peer.process.wait(PATIENCE)?;
    }
    host.remove_shared_memory()?;
    wait_until("everything is let go", || {
        Ok(host.files_open_in(&agent)?.is_empty())
    })?;
    a_new_pair_is_counted(&host, &agent, &stream)
}

fn messages(page: &Scrape) -> f64 {
    page.sum("ros2_topic_messages_total", &[("topic", "/imu")])
}

/// Writes 128 ports that no process uses, copies of this one, and files that are not ports.
fn write_idle_and_broken_files(memory: &Path, port_name: &str) -> Result<()> {
    let port = fs::read(memory.join(port_name))?;
    let number: u32 = port_name.trim_start_matches("fastrtps_port").parse()?;
    let at = port
        .windows(4)
        .position(|word| word == number.to_le_bytes())
        .context("a port does not say its number")?;
    for idle in 20_000..20_128_u32 {
        let mut copy = port.clone();
        copy[at..at + 4].copy_from_slice(&idle.to_le_bytes());
        fs::write(memory.join(format!("fastrtps_port{idle}")), copy)?;
    }
    let noise: Vec<u8> = (0..70_000_u32)
        .map(|i| (i.wrapping_mul(2_654_435_761) >> 13) as u8)
        .collect();
    for (name, bytes) in [
        ("fastrtps_port21000", &noise[..]),
        ("fastrtps_port21001", &[]),
        ("fastrtps_port21002", &port[..300]),
        ("fastrtps_0123456789abcdef", &noise[..]),
        ("fastdds_port21003", &noise[..1]),
    ] {
        fs::write(memory.join(name), bytes)?;
    }
    Ok(())
}

/// Replaces a segment by a file of another user, removes all ports but these, and waits until the
/// agent has closed the deleted files.
fn replaced_and_removed_files_are_closed(
    host: &Host<'_>,
    agent: &Agent<'_>,
    ports: &[String],
    segment: &str,
) -> Result<()> {
    let memory = host.shared_memory();
    let copy = memory.join("copy");
    fs::write(&copy, fs::read(memory.join(segment))?)?;
    std::os::unix::fs::chown(&copy, Some(65534), Some(65534))?;
    fs::rename(&copy, memory.join(segment))?;
    for name in files_of(&memory)?
        .0
        .iter()
        .filter(|name| !ports.contains(name))
    {
        fs::remove_file(memory.join(name))?;
    }
    wait_until("what is gone is let go", || {
        Ok(host
            .files_open_in(agent)?
            .iter()
            .all(|name| !name.ends_with(" (deleted)")))
    })
}

/// Tries several pairs: the killed participants stay in the graph until their leases end.
fn a_new_pair_is_counted(host: &Host<'_>, agent: &Agent<'_>, stream: &Stream) -> Result<()> {
    for attempt in 1..=MAX_START_ATTEMPTS {
        let (mut publisher, _subscriber) = host.pair(stream)?;
        let before = messages(&agent.scrape()?);
        publisher.start_sending()?;
        let deadline = Instant::now() + Duration::from_secs(5);
        while Instant::now() < deadline {
            if messages(&agent.scrape()?) > before + 200.0 {
                println!("messages again at attempt {attempt}");
                return Ok(());
            }
            std::thread::sleep(Duration::from_millis(100));
        }
    }
    bail!("no messages of a new pair")
}

#[test]
fn after_a_kill_of_either_peer_counts_recover_and_no_file_stays_open() -> Result<()> {
    let network = Namespace::isolated()?;
    let host = Host::new(&network)?;
    let directory = tempfile::tempdir()?;
    let agent = start_agent(&network, directory.path())?;
    let stream = Stream {
        count: 1_000_000,
        ..shared()
    };
    let (mut publisher, mut subscriber) = host.known_pair(&agent, &stream)?;
    publisher.start_sending()?;
    let flows = || -> Result<bool> {
        let sum = |page: Scrape| page.sum("ros2_topic_messages_total", &[("topic", "/imu")]);
        let before = sum(agent.scrape()?);
        std::thread::sleep(Duration::from_secs(1));
        Ok(sum(agent.scrape()?) - before > 100.0)
    };
    wait_until("messages flow", flows)?;
    let mut most = 0;
    for round in 0..2 {
        let role = match round % 2 {
            0 => Role::Subscriber,
            _ => Role::Publisher,
        };
        // Endpoints are announced in shared memory, so a new publisher may go unnoticed. A peer
        // that is killed while it holds the lock of the other's port leaves the other unable to
        // receive.
        let mut is_right_again = |attempt: u32| -> Result<bool> {
            println!("{role:?} killed, attempt {attempt}");
            for (each, peer) in [
                (Role::Subscriber, &mut subscriber),
                (Role::Publisher, &mut publisher),
            ] {
                if each != role && attempt <= MAX_ATTEMPTS_PER_PEER {
                    continue;
                }
                peer.process.signal("KILL")?;
                peer.process.wait(PATIENCE)?;
                *peer = host.launch(each, &stream)?;
                peer.wait_ready()?;
                if each == Role::Publisher {
                    peer.start_sending()?;
                }
            }
            std::thread::sleep(Duration::from_secs(2));
            most = most.max(host.files_open_in(&agent)?.len());
            Ok(flows()? || flows()?)
        };
        let mut attempts = 1..=MAX_START_ATTEMPTS;
        loop {
            let Some(attempt) = attempts.next() else {
                let page = agent.scrape()?;
                bail!("not found again:\n{}", page.0);
            };
            if is_right_again(attempt)? {
                break;
            }
        }
    }
    // Each of two peers has a port and a segment, and killed peers have left some.
    assert!((4..=64).contains(&most), "{most} files");
    for peer in [&mut publisher, &mut subscriber] {
        peer.process.terminate()?;
    }
    host.remove_shared_memory()?;
    wait_until("everything is let go", || {
        Ok(host.files_open_in(&agent)?.is_empty())
    })?;
    let page = agent.settled_scrape(&stream.topic, 0)?;
    assert_eq!(page.sum("ros2_topic_lost_messages_total", &[]), 0.0);
    assert_eq!(page.sum("ros2probe_shm_open", &[("kind", "port")]), 0.0);
    Ok(())
}

/// The files of killed processes remain, with their last messages. An agent that starts later
/// counts none of these messages.
#[test]
fn files_of_killed_processes_lead_to_no_node_and_no_unknown_writer() -> Result<()> {
    let network = Namespace::isolated()?;
    let host = Host::new(&network)?;
    let stream = Stream {
        count: 400,
        linger: 60.0,
        ..shared()
    };
    let (mut publisher, mut subscriber) = host.pair(&stream)?;
    publisher.start_sending()?;
    publisher.wait_sent(PATIENCE)?;
    for peer in [&mut publisher, &mut subscriber] {
        peer.process.signal("KILL")?;
        peer.process.wait(PATIENCE)?;
    }
    let (ports, segments) = files_of(&host.shared_memory())?;
    ensure!(!ports.is_empty() && !segments.is_empty(), "nothing is left");
    let directory = tempfile::tempdir()?;
    let agent = start_agent(&network, directory.path())?;
    let looked = |page: &Scrape| page.sum("ros2probe_shm_open", &[("kind", "directory")]) > 0.0;
    agent.scrape_until("shared memory is found", looked)?;
    // Unknown writers are shown after 3 s.
    std::thread::sleep(Duration::from_secs(5));
    let page = agent.scrape()?;
    assert_eq!(page.sum("ros2_unknown_writers", &[]), 0.0, "{}", page.0);
    assert_eq!(page.samples("ros2_node_info", &[]).count(), 0);
    assert_eq!(page.sum("ros2_participants", &[]), 0.0);
    assert_eq!(page.sum("ros2probe_shm_open", &[("kind", "port")]), 0.0);
    Ok(())
}

#[test]
fn files_below_dev_shm_are_opened_only_for_reading_and_never_mapped() -> Result<()> {
    let network = Namespace::isolated()?;
    let host = Host::new(&network)?;
    let directory = tempfile::tempdir()?;
    let agent = start_agent(&network, directory.path())?;
    let stream = Stream {
        count: 400,
        linger: 60.0,
        ..shared()
    };
    let (publisher, _subscriber) = host.known_pair(&agent, &stream)?;
    let trace = directory.path().join("trace");
    let pid = agent.process.pid().to_string();
    let mut strace = Command::new("strace")
        .args(["-f", "-y", "-qq", "-p", &pid, "-o"])
        .arg(&trace)
        .spawn()
        .context("cannot run strace: apt-get install strace")?;
    wait_until("strace traces", || {
        let status = fs::read_to_string(format!("/proc/{pid}/status"))?;
        Ok(!status.contains("TracerPid:\t0\n"))
    })?;
    // strace sees the agent open the files of new peers. It makes the agent too slow to read their
    // names.
    let _newcomers = host.pair(&Stream {
        topic: "/late".to_owned(),
        ..shared()
    })?;
    let page = run(&agent, publisher, &stream)?;
    let _ = Command::new("kill")
        .args(["-INT", &strace.id().to_string()])
        .status();
    strace.wait()?;
    assert!(
        page.sum("ros2_topic_sampled_seen_messages_total", &[]) > 0.0,
        "{}",
        shared_memory_metrics(&page)
    );

    let trace = fs::read_to_string(&trace)?;
    let of_shared_memory: Vec<&str> = trace
        .lines()
        .filter(|line| line.contains("dev/shm"))
        .collect();
    for call in ["openat(", "pread64("] {
        assert!(
            of_shared_memory.iter().any(|line| line.contains(call)),
            "{call}"
        );
    }
    for line in of_shared_memory {
        let (_, call) = line.trim().split_once(' ').unwrap_or_default();
        let name = call.trim().split('(').next().unwrap_or_default();
        let is_harmless = match name {
            "openat" => {
                let writes = ["O_WRONLY", "O_RDWR", "O_CREAT", "O_TRUNC"];
                line.contains("O_RDONLY") && !writes.iter().any(|flag| line.contains(flag))
            }
            // The standard library checks a descriptor that it closes.
            "fcntl" => line.contains("F_GETFD"),
            "pread64" | "inotify_add_watch" | "statx" | "statfs" | "fstat" | "newfstatat"
            | "getdents64" | "close" | "lseek" | "readlink" => true,
            // This is the second half of a call that strace split in two; the first half is
            // checked.
            _ => call.starts_with("<...") || call.trim().starts_with("<..."),
        };
        assert!(is_harmless, "{line}");
    }
    // Except for futexes of its own threads, the agent waits on nothing and locks nothing.
    for call in ["flock(", "F_SETLK", "PROT_WRITE, MAP_SHARED, 3<"] {
        let wrong = trace
            .lines()
            .find(|line| line.contains(call) && line.contains("shm"));
        assert_eq!(wrong, None);
    }
    Ok(())
}
