//! Tests the tap on files written in Fast DDS's layout.

use std::cell::Cell;
use std::fs;
use std::os::unix::fs::MetadataExt as _;
use std::path::Path;
use std::rc::Rc;

use proptest::prelude::*;
use ros2probe_wire::Guid;
use ros2probe_wire::record::{Sample, Verdict, kind};
use ros2probe_wire::time::MILLISECOND;
use ros2probe_wire::time::SECOND;
use tempfile::TempDir;

use super::super::cpu_allowance::{MAX_SAVINGS, SHARE_DIVISOR};
use super::super::directories::Scope;
use super::super::image::{PortImage, SegmentImage};
use super::*;
use crate::tables::tests::assert_driven;

fn writer() -> Guid {
    let mut bytes = [9; 16];
    bytes[12..].copy_from_slice(&[0, 0, 1, 3]);
    Guid::from_bytes(bytes)
}

/// Returns a message with one sample of that writer.
fn sample(number: u32) -> Vec<u8> {
    let mut bytes = b"RTPS\x02\x03\x01\x0f".to_vec();
    bytes.extend([9; 12]);
    bytes.extend([0x09, 1, 8, 0, 1, 0, 0, 0, 0, 0, 0, 0]);
    bytes.extend([0x15, 0x05, 32, 0, 0, 0, 16, 0, 0, 0, 0, 0, 0, 0, 1, 3]);
    bytes.extend([0; 4]);
    bytes.extend(number.to_le_bytes());
    bytes.extend([0, 1, 0, 0, 1, 0, 0, 0, 2, 0, 0, 0]);
    bytes
}

/// The shared memory of one host, the tap on it and its clock.
struct Host {
    directory: TempDir,
    tap: Tap,
    now: u64,
    wall_clock: Rc<Cell<u64>>,
}

impl Host {
    fn new() -> Self {
        let directory = tempfile::tempdir().unwrap();
        let directories = vec![directory.path().to_path_buf()];
        let directories = ShmDirectories::new(Scope::Directories(directories));
        let wall_clock = Rc::new(Cell::new(SECOND));
        let clock = Rc::clone(&wall_clock);
        let mut tap = Tap::new(directories, move || clock.get());
        tap.classifier.set(writer(), Some(Verdict::Meter));
        Self {
            directory,
            tap,
            now: SECOND,
            wall_clock,
        }
    }

    fn path(&self) -> &Path {
        self.directory.path()
    }

    fn port(&self, number: u32) -> PortImage {
        PortImage::new(number, 16, 0x100).in_directory(self.path())
    }

    fn large_segment(&self, id: u8) -> SegmentImage {
        SegmentImage::new([id; 8], 1 << 20).in_directory(self.path())
    }

    fn segment(&self, id: u8) -> SegmentImage {
        SegmentImage::new([id; 8], 1 << 16).in_directory(self.path())
    }

    /// Advances the clock and polls.
    fn find_after(&mut self, nanoseconds: u64) -> Vec<Item> {
        self.now += nanoseconds;
        self.wall_clock.set(self.wall_clock.get() + nanoseconds);
        let mut found = Vec::new();
        self.tap.poll(self.now, &mut found);
        found
    }

    /// Advances the clock and polls; returns the numbers of the samples found.
    fn poll_after(&mut self, nanoseconds: u64) -> Vec<u64> {
        let found = self.find_after(nanoseconds);
        let numbers = found.iter().filter_map(|item| match item {
            Item::Record(record) if record.kind == kind::DATA => Some(record.sequence_number),
            _ => None,
        });
        numbers.collect()
    }

    /// Returns the number of open files of this host, without the images' own files, which are open
    /// for writing.
    fn descriptors(&self) -> usize {
        let open = fs::read_dir("/proc/self/fd").unwrap().flatten();
        let open = open.filter(|entry| {
            let link = fs::read_link(entry.path());
            let mode = fs::symlink_metadata(entry.path()).map(|metadata| metadata.mode());
            link.is_ok_and(|link| link.starts_with(self.path()))
                && mode.is_ok_and(|mode| mode & 0o200 == 0)
        });
        open.count()
    }
}

#[test]
fn a_sample_that_several_ports_announce_is_found_once() {
    let mut host = Host::new();
    let (mut one, mut two, mut segment) = (host.port(7411), host.port(7413), host.segment(1));
    host.poll_after(SECOND);
    let descriptor = segment.put(&sample(7));
    one.push(descriptor);
    two.push(descriptor);
    assert_eq!(host.poll_after(MILLISECOND), [7]);
    assert_eq!(host.poll_after(MILLISECOND), [0; 0]);
    let counters = host.tap.counters();
    assert_eq!((counters.announced, counters.read), (2, 1));
    assert_eq!((counters.ports, counters.segments), (2, 1));
}

#[test]
fn a_discovery_message_is_passed_on_whole_with_its_port() {
    let mut host = Host::new();
    let (mut port, mut segment) = (host.port(7410), host.segment(1));
    host.poll_after(SECOND);
    let mut message = sample(1);
    message[44..48].copy_from_slice(&[0, 1, 0, 0xc2]);
    port.push(segment.put(&message));
    host.wall_clock.set(4);
    let found = host.find_after(1);
    let [Item::Message { time, port, bytes }] = found.as_slice() else {
        panic!("{found:?}");
    };
    assert_eq!((*time, *port, bytes), (5, 7410, &message));
}

#[test]
fn a_message_of_200_kilobytes_in_one_buffer_is_captured_whole() {
    let mut host = Host::new();
    host.tap.classifier.set(writer(), Some(Verdict::Capture));
    let (mut port, mut segment) = (host.port(7411), host.large_segment(1));
    host.poll_after(SECOND);
    // The last submessage of a message may exceed its length field: 0 means to the end.
    let mut message = sample(1);
    message[34..36].fill(0);
    message.resize(200_000, 7);
    port.push(segment.put(&message));
    let found = host.find_after(MILLISECOND);
    let [Item::Message { bytes, .. }] = found.as_slice() else {
        panic!("{found:?}");
    };
    assert_eq!(bytes, &message);
    // When metered, the message is one sample of that size.
    host.tap.classifier.set(writer(), Some(Verdict::Meter));
    port.push(segment.put(&message));
    let found = host.find_after(MILLISECOND);
    let [Item::Record(record)] = found.as_slice() else {
        panic!("{found:?}");
    };
    assert_eq!(record.payload_len, 200_000 - 56);
    assert_eq!(host.tap.counters().malformed, 0);
}

#[test]
fn a_poll_takes_no_more_bytes_than_its_queue_holds() {
    let whole = InboxBytes::CAP >> 20;
    let mut message = sample(1);
    message[34..36].fill(0);
    message[44..48].copy_from_slice(&[0, 1, 0, 0xc2]);
    message.resize(1 << 20, 0);
    // Messages that were in the ring before it was opened count as well.
    for is_open in [true, false] {
        let mut host = Host::new();
        let mut port = PortImage::new(7410, 32, 0x100).in_directory(host.path());
        let mut segment = SegmentImage::new([1; 8], 24 << 20).in_directory(host.path());
        if is_open {
            host.poll_after(SECOND);
        }
        for _ in 0..20 {
            port.push(segment.put(&message));
        }
        assert_eq!(host.find_after(MILLISECOND).len(), whole);
        assert_eq!(host.tap.refused(), 20 - whole as u64);
        // The next poll has room again.
        port.push(segment.put(&sample(2)));
        assert_eq!(host.poll_after(MILLISECOND), [2]);
    }
}

#[test]
fn the_use_of_memory_is_measured_while_polling_is_paused() {
    let mut host = Host::new();
    let (mut port, mut segment) = (host.port(7411), host.segment(1));
    host.poll_after(SECOND);
    host.tap.close_all();
    let stale_bytes = |host: &mut Host, nanoseconds: u64| {
        host.now += nanoseconds;
        host.tap.measure_memory_use(host.now);
        host.tap.counters().memory_use.stale_bytes
    };
    assert_eq!(stale_bytes(&mut host, MEMORY_USE_INTERVAL), 0);
    let killed = host.segment(2).path(host.path());
    let _lock = lock_of(&killed, false);
    assert_eq!(stale_bytes(&mut host, SECOND), 0);
    assert!(stale_bytes(&mut host, MEMORY_USE_INTERVAL) > 0);
    fs::remove_file(killed).unwrap();
    assert_eq!(stale_bytes(&mut host, MEMORY_USE_INTERVAL), 0);
    // Polling continues with every port.
    assert!(!host.tap.has_ports());
    port.push(segment.put(&sample(1)));
    assert_eq!(host.poll_after(MILLISECOND), [1]);
}

#[test]
fn the_time_of_a_message_is_read_after_its_announcement() {
    let mut host = Host::new();
    let (mut port, mut segment) = (host.port(7411), host.segment(1));
    host.poll_after(SECOND);
    // The message is sent while the poll is in progress.
    let clock = Rc::clone(&host.wall_clock);
    host.tap.wall_clock = Box::new(move || clock.replace(clock.get() + 1000));
    port.push(segment.put(&sample(1)));
    let sent = host.wall_clock.get();
    let mut found = Vec::new();
    host.tap.poll(host.now, &mut found);
    let [Item::Record(record)] = found.as_slice() else {
        panic!("{found:?}");
    };
    assert!(record.time >= sent, "{} {sent}", record.time);
}

#[test]
fn a_silent_port_is_polled_every_time_while_every_message_is_needed() {
    let mut host = Host::new();
    let (mut port, mut segment) = (host.port(7411), host.segment(1));
    host.poll_after(SECOND);
    host.tap.needs_every_message = true;
    host.poll_after(SILENT_AFTER + 1);
    host.poll_after(MILLISECOND);
    let descriptor = segment.put(&sample(5));
    port.push(descriptor);
    assert_eq!(host.poll_after(MILLISECOND), [5]);
    // A sample that is read indicates no new participant: polls stay within the budget for readers.
    host.tap.classifier.set(writer(), Some(Verdict::Capture));
    host.tap.take_discovery_seen();
    port.push(segment.put(&sample(6)));
    assert_eq!(host.find_after(MILLISECOND).len(), 1);
    assert!(!host.tap.take_discovery_seen());
    // The buffer is reused before a silent port would be polled.
    segment.free(descriptor);
}

#[test]
fn messages_already_in_the_ring_have_no_source_timestamp() {
    let mut host = Host::new();
    let (mut port, mut segment) = (host.port(7411), host.segment(1));
    let (old, new) = (segment.put(&sample(1)), segment.put(&sample(2)));
    port.push(old);
    port.push(new);
    segment.free(old);
    let found = host.find_after(SECOND);
    let [Item::Record(record)] = found.as_slice() else {
        panic!("{found:?}");
    };
    assert_eq!((record.sequence_number, record.source_timestamp), (2, 0));
    assert_eq!(record.sample().and_then(Sample::header_stamp), None);
    assert_eq!(host.tap.counters().missed, 1);
}

/// Creates the lock file beside a file of Fast DDS; its lock shows that the process lives.
fn lock_of(path: &Path, lives: bool) -> fs::File {
    let mut name = path.as_os_str().to_owned();
    name.push("_el");
    let file = fs::File::create(name).unwrap();
    if lives {
        file.try_lock().unwrap();
    }
    file
}

#[test]
fn files_of_a_killed_process_yield_neither_a_port_nor_messages() {
    let mut host = Host::new();
    let (mut port, mut segment) = (host.port(7411), host.segment(1));
    let locks = [port.path(host.path()), segment.path(host.path())];
    let killed = locks.each_ref().map(|path| lock_of(path, false));
    port.push(segment.put(&sample(1)));
    assert_eq!(host.poll_after(SECOND), [0; 0]);
    assert!(!host.tap.has_ports() && !host.tap.take_discovery_seen());
    // A live process has taken over the port, and received a message of a live process.
    let mut living = host.segment(2);
    let lives = [port.path(host.path()), living.path(host.path())];
    let lives = lives.each_ref().map(|path| lock_of(path, true));
    port.push(living.put(&sample(2)));
    assert_eq!(host.poll_after(FIND_INTERVAL), [2]);
    assert!(host.tap.has_ports() && host.tap.take_discovery_seen());
    port.push(living.put(&sample(3)));
    assert_eq!(host.poll_after(MILLISECOND), [3]);
    drop((killed, lives));
}

#[test]
fn a_message_of_a_live_process_to_the_port_of_a_killed_process_counts() {
    let mut host = Host::new();
    let (mut port, mut segment) = (host.port(7411), host.segment(1));
    let _dead = lock_of(&port.path(host.path()), false);
    let _lives = lock_of(&segment.path(host.path()), true);
    port.push(segment.put(&sample(1)));
    assert_eq!(host.poll_after(SECOND), [1]);
    assert!(!host.tap.has_ports());
}

#[test]
fn a_message_in_a_reused_buffer_is_missed_and_not_misread() {
    let mut host = Host::new();
    let (mut port, mut segment) = (host.port(7411), host.segment(1));
    host.poll_after(SECOND);
    let descriptor = segment.put(&sample(1));
    port.push(descriptor);
    segment.free(descriptor);
    assert_eq!(host.poll_after(MILLISECOND), [0; 0]);
    assert_eq!(host.tap.counters().missed, 1);
}

#[test]
fn files_of_a_restarted_participant_replace_the_old_ones() {
    let mut host = Host::new();
    for round in 1..=5 {
        let (mut port, mut segment) = (host.port(7411), host.segment(1));
        host.poll_after(200 * MILLISECOND);
        port.push(segment.put(&sample(round)));
        assert_eq!(host.poll_after(MILLISECOND), [u64::from(round)]);
        assert_eq!(host.descriptors(), 2);
        // Each process removes the files of the previous one. The new files have the same names.
        fs::remove_file(port.path(host.path())).unwrap();
        fs::remove_file(segment.path(host.path())).unwrap();
    }
    host.poll_after(200 * MILLISECOND);
    assert_eq!(host.descriptors(), 0);
    let counters = host.tap.counters();
    assert_eq!((counters.ports, counters.segments), (0, 0));
}

#[test]
fn a_replaced_segment_is_opened_again_while_its_port_stays() {
    let mut host = Host::new();
    let (mut port, mut segment) = (host.port(7411), host.segment(1));
    host.poll_after(SECOND);
    port.push(segment.put(&sample(1)));
    assert_eq!(host.poll_after(MILLISECOND), [1]);
    fs::remove_file(segment.path(host.path())).unwrap();
    let mut segment = host.segment(1);
    host.poll_after(200 * MILLISECOND);
    port.push(segment.put(&sample(2)));
    // The new segment places its first buffer where the old one did, with the same validity.
    segment.free(segment_descriptor(&segment, 2));
    port.push(segment.put(&sample(3)));
    let found = host.poll_after(MILLISECOND);
    assert_eq!(found.last(), Some(&3));
}

fn segment_descriptor(_: &SegmentImage, number: u32) -> Descriptor {
    let mut other = SegmentImage::new([1; 8], 1 << 16);
    other.put(&sample(number))
}

#[test]
fn a_truncated_port_is_closed_and_its_successor_is_opened() {
    let mut host = Host::new();
    let (port, mut segment) = (host.port(7411), host.segment(1));
    host.poll_after(SECOND);
    fs::File::options()
        .write(true)
        .open(port.path(host.path()))
        .unwrap()
        .set_len(100)
        .unwrap();
    host.poll_after(MILLISECOND);
    assert_eq!(host.tap.counters().ports, 0);
    fs::remove_file(port.path(host.path())).unwrap();
    let mut port = host.port(7411);
    host.poll_after(200 * MILLISECOND);
    port.push(segment.put(&sample(1)));
    assert_eq!(host.poll_after(MILLISECOND), [1]);
    let descriptor = segment.put(&sample(2));
    fs::File::options()
        .write(true)
        .open(segment.path(host.path()))
        .unwrap()
        .set_len(0)
        .unwrap();
    port.push(descriptor);
    host.poll_after(MILLISECOND);
    assert_eq!(host.tap.counters().read, 1);
}

#[test]
fn an_idle_port_is_polled_rarely_until_it_has_a_message() {
    let mut host = Host::new();
    let mut ports: Vec<_> = (0..128).map(|index| host.port(7411 + 2 * index)).collect();
    let mut segment = host.segment(1);
    host.poll_after(SECOND);
    host.poll_after(SILENT_AFTER + 1);
    host.poll_after(MILLISECOND);
    let due = host.tap.ports.iter();
    let due = due.filter(|open| open.due <= host.now + MILLISECOND);
    assert_eq!(due.count(), 0);
    ports[77].push(segment.put(&sample(5)));
    assert_eq!(host.poll_after(SILENT_POLL_INTERVAL), [5]);
    // From now on that port is polled each time.
    ports[77].push(segment.put(&sample(6)));
    assert_eq!(host.poll_after(MILLISECOND), [6]);
    assert_eq!(host.tap.counters().ports, 128);
}

#[test]
fn a_flood_at_one_port_does_not_starve_the_others() {
    let mut host = Host::new();
    let mut flooded = PortImage::new(7400, 256, 0x100).in_directory(host.path());
    let (mut other, mut segment) = (host.port(7411), host.segment(1));
    host.poll_after(SECOND);
    host.tap.is_urgent = true;
    let descriptor = segment.put(&sample(1));
    let mut found = Vec::new();
    for round in 0..4 {
        for _ in 0..2 * MAX_PER_URGENT_POLL {
            flooded.push(descriptor);
        }
        if round == 0 {
            other.push(segment.put(&sample(2)));
        }
        found.extend(host.poll_after(MILLISECOND));
    }
    assert!(found.contains(&2), "{found:?}");
}

#[test]
fn constantly_expected_files_use_no_more_cpu_than_the_listing_share() {
    let mut host = Host::new();
    for number in 0..2000 {
        fs::write(host.path().join(format!("fastrtps_port{number}")), "").unwrap();
    }
    host.poll_after(SECOND);
    let (before, began) = (thread_cpu(), host.now);
    while host.now < began + 20 * SECOND {
        host.tap.expect_participant();
        host.poll_after(10 * MILLISECOND);
    }
    let spent = thread_cpu() - before;
    let most = MAX_SAVINGS + (host.now - began) / SHARE_DIVISOR;
    assert!(spent < 2 * most, "{spent} {most}");
    // A new port is opened all the same, if the share allows it.
    let (mut port, mut segment) = (host.port(7411), host.segment(1));
    host.poll_after(100 * SECOND);
    port.push(segment.put(&sample(5)));
    assert_eq!(host.poll_after(MILLISECOND), [5]);
}

#[test]
fn garbage_links_and_directories_with_names_of_ports_are_ignored() {
    let mut host = Host::new();
    let file = |name: &str| host.path().join(name);
    fs::write(file("fastrtps_port7411"), vec![0xa5; 100_000]).unwrap();
    fs::write(file("fastrtps_port7413"), "").unwrap();
    fs::create_dir(file("fastrtps_port7415")).unwrap();
    std::os::unix::fs::symlink("/dev/zero", file("fastrtps_port7417")).unwrap();
    fs::write(file("fastrtps_port7419_el"), "").unwrap();
    let mut port = host.port(7421);
    host.poll_after(SECOND);
    let counters = host.tap.counters();
    assert_eq!((counters.ports, counters.directories), (1, 1));
    // The port announces a message without a segment, and one in a file that is not a segment.
    port.push(Descriptor {
        segment: SegmentId([2; 8]),
        node: 16,
        validity: 1,
    });
    fs::write(host.path().join("fastrtps_0303030303030303"), "short").unwrap();
    port.push(Descriptor {
        segment: SegmentId([3; 8]),
        node: 16,
        validity: 1,
    });
    assert_eq!(host.poll_after(MILLISECOND), [0; 0]);
    let counters = host.tap.counters();
    assert_eq!((counters.unreachable, counters.malformed), (1, 1));
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, failure_persistence: None, ..ProptestConfig::default() })]
    #[test]
    fn the_tap_continues_and_stays_bounded_with_any_memory_content(
        damage in proptest::collection::vec((any::<bool>(), 0_usize..2000, any::<u32>()), 1..40),
    ) {
        use std::os::unix::fs::FileExt as _;
        let mut host = Host::new();
        let (mut port, mut segment) = (host.port(7411), host.segment(1));
        host.poll_after(SECOND);
        for (number, (in_port, at, word)) in damage.into_iter().enumerate() {
            let path = match in_port {
                true => port.path(host.path()),
                false => segment.path(host.path()),
            };
            let file = fs::File::options().write(true).open(path).unwrap();
            file.write_all_at(&word.to_le_bytes(), at as u64).unwrap();
            port.push(segment.put(&sample(number as u32)));
            prop_assert!(host.poll_after(MILLISECOND).len() <= 64);
            host.poll_after(200 * MILLISECOND);
        }
        prop_assert!(host.descriptors() <= 2);
    }
}

#[test]
fn ports_and_segments_beyond_the_caps_are_left_out_without_excluding_a_user() {
    let mut host = Host::new();
    let crowd: Vec<_> = (0..600).map(|number| host.port(20_000 + number)).collect();
    host.poll_after(SECOND);
    assert_eq!(host.tap.ports.len(), Ports::CAP);
    assert!(host.tap.counters.left_out >= 600 - Ports::CAP as u64);

    let real = host.port(7411);
    for path in [7411].map(|number| host.path().join(format!("fastrtps_port{number}"))) {
        std::os::unix::fs::chown(path, Some(64_123), None).unwrap();
    }
    host.poll_after(SECOND);
    assert_eq!(host.tap.ports.len(), Ports::CAP);
    assert!(host.tap.ports.iter().any(|open| open.key.2 == 7411));
    drop((crowd, real));

    let (directory, generation, _) = host.tap.ports[0].key;
    for number in 0..600_u64 {
        let id = number.to_be_bytes();
        host.tap
            .open_segment((directory, generation, SegmentId(id)), host.now);
    }
    assert_eq!(host.tap.segments.len(), Segments::CAP);
    assert_driven::<Ports>();
    assert_driven::<Segments>();
}

#[test]
fn ports_of_dead_processes_beyond_the_cap_are_opened_again() {
    let mut host = Host::new();
    host.poll_after(SECOND);
    for number in 20_000..20_000 + AbandonedPorts::CAP as u32 + 10 {
        // The lock beside the port is free: its process is dead.
        let name = format!("fastrtps_port{number}_el");
        fs::write(host.path().join(name), "").unwrap();
    }
    let numbers: Vec<_> = (20_000..20_000 + AbandonedPorts::CAP as u32 + 10).collect();
    for group in numbers.chunks(400) {
        let ports: Vec<_> = group.iter().map(|number| host.port(*number)).collect();
        // A search would forget the ports of dead processes, so it is postponed.
        host.tap.last_search = host.now + 1000 * SECOND;
        host.poll_after(100 * SECOND);
        for port in ports {
            fs::remove_file(port.path(host.path())).unwrap();
        }
    }
    assert!(host.tap.ports.is_empty());
    assert_driven::<AbandonedPorts>();
}

#[test]
fn only_node_names_of_an_unknown_writer_count_as_discovery() {
    let mut host = Host::new();
    let (mut port, mut segment) = (host.port(7411), host.segment(1));
    host.poll_after(SECOND);
    host.tap.take_discovery_seen();
    let mut data = sample(1);
    data[44..48].copy_from_slice(&[0, 0, 9, 3]);
    let mut names = data.clone();
    names.extend([9; 12]);
    names.extend([0, 0, 1, 0xc1]);
    for (message, announces) in [(data, false), (names, true)] {
        port.push(segment.put(&message));
        let found = host.find_after(MILLISECOND);
        assert!(matches!(found[..], [Item::Message { .. }]), "{found:?}");
        assert_eq!(host.tap.take_discovery_seen(), announces);
    }
}

#[test]
fn an_urgent_poll_reads_some_ports_and_the_next_polls_read_the_others() {
    let mut host = Host::new();
    let mut segment = host.segment(1);
    let mut ports: Vec<_> = (0..24).map(|index| host.port(7411 + 2 * index)).collect();
    host.poll_after(SECOND);
    host.tap.is_urgent = true;
    for round in 1..=5 {
        for (port, number) in ports.iter_mut().zip(100 * round..) {
            port.push(segment.put(&sample(number)));
        }
        let mut found = Vec::new();
        for _ in 0..24 / PORTS_PER_URGENT_POLL {
            let few = host.poll_after(1);
            assert_eq!(few.len(), PORTS_PER_URGENT_POLL);
            found.extend(few);
        }
        found.sort_unstable();
        assert_eq!(
            found,
            (100 * round..).take(24).map(u64::from).collect::<Vec<_>>()
        );
    }
}
