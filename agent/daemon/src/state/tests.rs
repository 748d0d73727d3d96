use rustix::fs::{CWD, FileType, Mode, mknodat};

use super::*;

fn directory() -> (tempfile::TempDir, StateDirectory) {
    let place = tempfile::tempdir().unwrap();
    let directory = StateDirectory::open(place.path()).unwrap();
    (place, directory)
}

fn unusable(directory: &StateDirectory) -> String {
    match directory.load() {
        Loaded::Unusable { reason, moved_to } => {
            assert!(moved_to.unwrap().ends_with("discovery.json.corrupt"));
            reason
        }
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_written_file_is_read_back_and_no_other_file_remains() {
    let (place, directory) = directory();
    assert_eq!(directory.load(), Loaded::Nothing);
    directory.write(Memory::default()).unwrap();
    assert_eq!(directory.load(), Loaded::Known(Memory::default()));
    let names: Vec<_> = fs::read_dir(place.path())
        .unwrap()
        .map(|entry| entry.unwrap().file_name())
        .collect();
    assert_eq!(names, [STATE_FILE]);
}

#[test]
fn an_invalid_state_file_is_moved_aside_and_a_new_one_is_written() {
    let (place, directory) = directory();
    let file = place.path().join(STATE_FILE);
    directory.write(Memory::default()).unwrap();
    let whole = fs::read(&file).unwrap();
    for length in 0..whole.len() - 2 {
        fs::write(&file, &whole[..length]).unwrap();
        unusable(&directory);
        assert_eq!(directory.load(), Loaded::Nothing, "cut at {length}");
    }
    for garbage in [&b"\0\xff\x7f"[..], b"[]", b"{}", b"{\"version\":\"1\"}"] {
        fs::write(&file, garbage).unwrap();
        unusable(&directory);
    }
    fs::write(&file, r#"{"version": 0, "boot": {}, "clouds": []}"#).unwrap();
    assert_eq!(unusable(&directory), "version 0 is not supported");
    let aside = fs::read_to_string(place.path().join("discovery.json.corrupt")).unwrap();
    assert!(aside.contains("clouds"));
    directory.write(Memory::default()).unwrap();
    assert_eq!(directory.load(), Loaded::Known(Memory::default()));
}

#[test]
fn a_file_of_a_newer_agent_stays_in_place_even_if_it_is_unreadable() {
    let (place, directory) = directory();
    let file = place.path().join(STATE_FILE);
    for (newer, version) in [
        (&br#"{"version": 2, "boot": {}, "clouds": []}"#[..], 2),
        (br#"{"clouds": [], "version": 4000000000}"#, 4_000_000_000),
        (br#"{"version":3,"clouds":["#, 3),
        (b"{\"version\":3,\0\xff\x7f", 3),
    ] {
        fs::write(&file, newer).unwrap();
        let found = Newer {
            path: file.clone(),
            version,
            known: VERSION,
        };
        assert_eq!(directory.load(), Loaded::Newer(found));
        assert_eq!(fs::read(&file).unwrap(), newer);
        assert_eq!(fs::read_dir(place.path()).unwrap().count(), 1);
    }
}

#[test]
fn every_version_is_read_by_its_own_reader_and_the_last_one_is_written() {
    assert_eq!(
        STATE_FORM.readers.last().map(|(version, _)| *version),
        Some(VERSION)
    );
    #[derive(Debug, Deserialize, PartialEq)]
    struct Old {
        degrees: i32,
    }
    #[derive(Debug, Deserialize, PartialEq)]
    struct New {
        kelvin: i32,
    }
    const THERMOMETER: Form<New> = Form {
        file: STATE_FILE,
        readers: &[
            (1, |bytes| {
                from_json::<Old>(bytes).map(|old| New {
                    kelvin: old.degrees + 273,
                })
            }),
            (3, from_json),
        ],
    };
    let (place, directory) = directory();
    let read = |text: &str| {
        fs::write(place.path().join(STATE_FILE), text).unwrap();
        directory.read(&THERMOMETER)
    };
    let this = |kelvin| Found::This(New { kelvin });
    assert_eq!(read(r#"{"version": 1, "degrees": 20}"#), this(293));
    assert_eq!(read(r#"{"version": 3, "kelvin": 20}"#), this(20));
    for none in [r#"{"version": 2, "kelvin": 20}"#, r#"{"kelvin": 20}"#] {
        assert!(matches!(read(none), Found::Unusable { .. }), "{none}");
    }
    let newer = read(r#"{"version": 4, "entropy": 20}"#);
    assert!(matches!(
        newer,
        Found::Newer(Newer {
            version: 4,
            known: 3,
            ..
        })
    ));
}

#[test]
fn a_file_in_the_first_format_is_read() {
    let (place, directory) = directory();
    let boot = boot();
    // Format before shared memory and requested QoS were added.
    let first = r#"{"version":1,"boot":"BOOT","participants":[{"prefix":"010f0102030405060708090a",
            "vendor":"010f","domain_id":5,"domain_source":"multicast_port","enclave":"/",
            "host":"robot","process_name":"lidar","process_id":42,"lease":20000000000,
            "secured":false,"addresses":{"metatraffic":["10.0.0.1:7410"],"default":[]},
            "nodes":[{"name":"/lidar","writers":["010f0102030405060708090a00001103"],
            "readers":[]}],"nodes_from":["010f0102030405060708090a00000403",1],"endpoints":[{
            "guid":"010f0102030405060708090a00001103","topic":"rt/points",
            "message_type":"sensor_msgs/msg/PointCloud2","type_hash":null,"reliability":2,
            "durability":0,"history":[0,10],"deadline":null,"lifespan":null,"liveliness":0,
            "liveliness_lease":null,"ownership":0,"minimum_separation":0,"partitions":[]}]}]}"#;
    fs::write(place.path().join(STATE_FILE), first.replace("BOOT", &boot)).unwrap();
    let Loaded::Known(memory) = directory.load() else {
        panic!("{:?}", directory.load());
    };
    assert_eq!(memory.participants.len(), 1);
}

#[test]
fn state_of_an_earlier_boot_is_not_used() {
    let (place, directory) = directory();
    let file = place.path().join(STATE_FILE);
    fs::write(&file, r#"{"version":1,"boot":"other","participants":[]}"#).unwrap();
    assert_eq!(directory.load(), Loaded::AnotherBoot);
}

#[test]
fn a_partial_file_of_a_killed_agent_is_ignored_and_removed() {
    let (place, directory) = directory();
    directory.write(Memory::default()).unwrap();
    drop(directory);
    fs::write(place.path().join(NEW_STATE_FILE), "{\"version\":1,\"bo").unwrap();
    let directory = StateDirectory::open(place.path()).unwrap();
    assert_eq!(directory.load(), Loaded::Known(Memory::default()));
    assert_eq!(fs::read_dir(place.path()).unwrap().count(), 1);
}

#[test]
fn a_symbolic_link_instead_of_a_state_file_is_neither_read_nor_written() {
    let (place, directory) = directory();
    let elsewhere = tempfile::tempdir().unwrap();
    let target = elsewhere.path().join("target");
    directory.write(Memory::default()).unwrap();
    fs::rename(place.path().join(STATE_FILE), &target).unwrap();
    let text = fs::read_to_string(&target).unwrap();
    for name in [STATE_FILE, NEW_STATE_FILE] {
        std::os::unix::fs::symlink(&target, place.path().join(name)).unwrap();
    }
    let reason = unusable(&directory);
    assert!(reason.contains("symbolic links"), "{reason}");
    directory.write(Memory::default()).unwrap();
    assert_eq!(fs::read_to_string(&target).unwrap(), text);
    assert!(
        fs::symlink_metadata(place.path().join(STATE_FILE))
            .unwrap()
            .is_file()
    );
    assert_eq!(directory.load(), Loaded::Known(Memory::default()));
}

#[test]
fn a_pipe_or_directory_instead_of_a_state_file_does_not_block_the_start() {
    let (place, directory) = directory();
    let path = place.path().join(STATE_FILE);
    mknodat(CWD, &path, FileType::Fifo, Mode::RUSR | Mode::WUSR, 0).unwrap();
    let (found, received) = std::sync::mpsc::channel();
    std::thread::spawn(move || found.send((unusable(&directory), directory)));
    let (reason, directory) = received.recv_timeout(Duration::from_secs(60)).unwrap();
    assert_eq!(reason, "not a regular file");
    let aside = place.path().join("discovery.json.corrupt");
    let error = StateDirectory::open(&aside).unwrap_err();
    assert!(matches!(error, StateError::Unusable { .. }), "{error}");
    fs::create_dir(&path).unwrap();
    fs::remove_file(aside).unwrap();
    assert_eq!(unusable(&directory), "not a regular file");
}

#[test]
fn two_agents_do_not_share_a_directory() {
    let (place, directory) = directory();
    let second = StateDirectory::open(place.path());
    assert!(matches!(second, Err(StateError::InUse { .. })));
    drop(directory);
    StateDirectory::open(place.path()).unwrap();
}

#[test]
fn a_failed_write_of_the_state_is_counted_and_retried() {
    let (place, directory) = directory();
    // A file cannot replace a directory.
    let obstacle = place.path().join(NEW_STATE_FILE);
    fs::create_dir(&obstacle).unwrap();
    let mut keeper = StateWriter::start(Arc::new(directory)).unwrap();
    let start = Instant::now();
    assert!(keeper.is_write_due(0, start));
    keeper.keep(Memory::default(), 0, start);
    while keeper.facts().failures == 0 {
        assert!(start.elapsed() < Duration::from_secs(60));
        std::thread::yield_now();
    }
    fs::remove_dir(obstacle).unwrap();
    assert!(
        !keeper.is_write_due(0, start + 2 * WRITE_INTERVAL),
        "nothing has changed"
    );
    assert!(
        keeper.is_write_due(0, start + RETRY_INTERVAL),
        "there may be room again"
    );
    assert!(
        !keeper.is_write_due(1, start + WRITE_INTERVAL / 2),
        "it is too soon"
    );
    assert!(keeper.is_write_due(1, start + WRITE_INTERVAL));
    assert_eq!(keeper.facts().writes, 0);
    keeper.finish(Memory::default());
    let directory = StateDirectory::open(place.path()).unwrap();
    assert_eq!(directory.load(), Loaded::Known(Memory::default()));
}

#[test]
fn a_hanging_file_system_delays_neither_the_agent_nor_its_end() {
    let (_place, directory) = directory();
    let (answer, answers) = std::sync::mpsc::channel::<()>();
    let keeper = StateWriter::start_with(Arc::new(directory), move |_| {
        let _ = answers.recv();
        Ok(())
    });
    let mut keeper = keeper.unwrap();
    for revision in 0..10 {
        keeper.keep(Memory::default(), revision, Instant::now());
    }
    let began = Instant::now();
    assert!(!keeper.finish_until(Memory::default(), began + Duration::from_millis(100)));
    assert!(began.elapsed() < Duration::from_secs(60));
    drop(answer);
}

#[test]
fn a_state_file_beyond_the_maximum_size_is_moved_aside() {
    let (place, directory) = directory();
    let file = File::create(place.path().join(STATE_FILE)).unwrap();
    file.set_len(MAX_BYTES + 1).unwrap();
    println!("{}", unusable(&directory));
}
