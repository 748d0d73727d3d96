//! The tables of the kernel filter, each driven over its capacity.

use std::collections::BTreeMap;

use ros2probe_capture::filter_reader::FilterReader;
use ros2probe_capture::system::Clocks;
use ros2probe_capture::tables::{FreshDatagrams, WaitingRecords};
use ros2probe_model::observe::observer::{Observer, Settings};
use ros2probe_testing::program_run::{self, Hook, Kernel};
use ros2probe_wire::filter::{
    Counter, FLOW_CAPACITY, INTEREST_CAPACITY, INTERFACE_CAPACITY, PARTICIPANT_CAPACITY,
    RUN_CAPACITY, UNKNOWN_CAPACITY, UNKNOWN_CAPTURE_BYTES,
};
use ros2probe_wire::record::Verdict;
use ros2probe_wire::{EntityId, Guid, GuidPrefix, Record, Timestamp};

fn prefix(number: u32) -> GuidPrefix {
    let mut prefix = [6; 12];
    prefix[8..].copy_from_slice(&number.to_be_bytes());
    GuidPrefix(prefix)
}

fn writer(number: u32) -> Guid {
    Guid::new(prefix(number), EntityId([0, 0, 1, 3]))
}

#[test]
fn endpoints_beyond_the_cap_of_the_interest_map_are_refused() {
    let mut kernel = Kernel::load();
    let mut put = |number| {
        kernel
            .filter
            .set_interest(writer(number), Some(Verdict::Meter))
    };
    for number in 0..INTEREST_CAPACITY {
        put(number).unwrap();
    }
    assert!(put(INTEREST_CAPACITY).is_err());
    // Existing entries can still be changed.
    put(0).unwrap();
}

#[test]
fn participants_beyond_the_cap_are_refused() {
    let mut kernel = Kernel::load();
    for number in 0..PARTICIPANT_CAPACITY {
        kernel
            .filter
            .follow_participant(prefix(number), true)
            .unwrap();
    }
    let next = prefix(PARTICIPANT_CAPACITY);
    assert!(kernel.filter.follow_participant(next, true).is_err());
    kernel.filter.follow_participant(prefix(0), false).unwrap();
    kernel.filter.follow_participant(next, true).unwrap();
}

#[test]
fn interfaces_beyond_the_cap_are_refused() {
    let mut kernel = Kernel::load();
    let taken = (1_000_000..1_010_000)
        .take_while(|index| kernel.filter.accept_interface(*index, true).is_ok())
        .count();
    let capacity = INTERFACE_CAPACITY as usize;
    assert!((capacity - 8..=capacity).contains(&taken), "{taken}");
    kernel.filter.forget_interface(1_000_000).unwrap();
    kernel.filter.accept_interface(2_000_000, true).unwrap();
}

#[test]
fn an_unknown_writer_gets_a_new_capture_budget_after_many_other_writers() {
    let mut kernel = Kernel::load();
    let frame = |number, sn| program_run::data(writer(number), sn, 1000);
    let captured = |kernel: &mut Kernel, number| {
        kernel.set_unknown_budget(1 << 30, 1 << 20);
        (1..1000)
            .take_while(|sn| kernel.frame(&frame(number, *sn)).kept)
            .count()
    };
    let of_one = captured(&mut kernel, 0);
    let most = UNKNOWN_CAPTURE_BYTES as usize / 1000 + 1;
    assert!(
        (most * 9 / 10..=most).contains(&of_one),
        "{of_one} of {most}"
    );
    assert_eq!(captured(&mut kernel, 0), 0);
    for number in 1..=4 * UNKNOWN_CAPACITY {
        assert!(kernel.frame(&frame(number, 1)).kept);
    }
    assert_eq!(captured(&mut kernel, 0), of_one);
}

#[test]
fn a_fragmented_datagram_is_forgotten_after_too_many_others() {
    let mut kernel = Kernel::load();
    let metered = writer(0);
    kernel.set_interest(&BTreeMap::from([(metered, Verdict::Meter)]));
    let message = program_run::message(metered, 1..=1, 3000);
    let mut records_after = |others: u32| {
        let identification = kernel.next_identification();
        let fragments = program_run::fragments(&message, 1480, false, identification);
        let mut records = kernel.frame(&fragments[0]).records.len();
        for _ in 0..others {
            let identification = kernel.next_identification();
            let other = program_run::fragments(&message, 1480, false, identification);
            kernel.frame(&other[0]);
        }
        for fragment in &fragments[1..] {
            records += kernel.frame(fragment).records.len();
        }
        (records, kernel.counter(Counter::FragmentsWithoutFlow))
    };
    assert_eq!(records_after(0), (1, 0));
    let (records, without) = records_after(4 * FLOW_CAPACITY);
    assert_eq!((records, without > 0), (0, true));
}

#[test]
fn runs_beyond_the_cap_yield_a_record_for_each_fragment() {
    let mut kernel = Kernel::load();
    let all: BTreeMap<_, _> = (0..2 * RUN_CAPACITY)
        .map(|number| (writer(number), Verdict::Meter))
        .collect();
    kernel.set_interest(&all);
    let mut written = 0;
    for writer in all.keys() {
        let fragment = program_run::fragment(*writer, 1, 1, 100);
        written += kernel.frame(&fragment).records.len();
    }
    let waiting = kernel.take_stalled().len();
    let capacity = RUN_CAPACITY as usize;
    println!("{written} written, {waiting} waiting");
    assert_eq!(written + waiting, 2 * capacity);
    assert!(waiting <= capacity && waiting * 10 >= capacity * 9);
}

#[test]
fn captured_datagrams_beyond_the_cap_stay_in_the_ring() {
    let mut kernel = Kernel::load_hook(Hook::Ingress);
    kernel.set_interest(&BTreeMap::from([(writer(0), Verdict::Capture)]));
    let mut intake = FilterReader::new(kernel.filter, &[]);
    let mut observer = Observer::new(Settings::default());
    // All datagrams are younger than this reading, so none is read.
    let before = Clocks::read();
    for number in 1..=100 {
        let message = program_run::message(writer(0), number..=number, 16);
        let datagram = program_run::datagram(&message);
        program_run::run(intake.filter().program(), &datagram, 1);
    }
    intake.poll(&before, &mut observer);
    assert_eq!(intake.datagrams(), FreshDatagrams::CAP as u64);
    intake.poll(&before, &mut observer);
    assert_eq!(intake.datagrams(), FreshDatagrams::CAP as u64);
    intake.drain(&Clocks::read(), &mut observer);
    intake.drain(&Clocks::read(), &mut observer);
    assert_eq!(intake.datagrams(), 100);
}

#[test]
fn records_beyond_the_cap_stay_in_the_ring_and_lost_ones_are_counted() {
    use ros2probe_wire::time::SECOND;
    const SAMPLES: u32 = 32;
    let mut kernel = Kernel::load_hook(Hook::Ingress);
    kernel.set_interest(&BTreeMap::from([(writer(0), Verdict::Meter)]));
    let mut intake = FilterReader::new(kernel.filter, &[]);
    let mut observer = Observer::new(Settings::default());
    let counter = |intake: &FilterReader, which| {
        let counters = intake.filter().counters().unwrap();
        let found = counters.iter().find(|(counter, _)| *counter == which);
        found.unwrap().1
    };
    let mut sent = 0;
    let mut send = |intake: &FilterReader| {
        let message = program_run::message(writer(0), sent + 1..=sent + SAMPLES, 16);
        program_run::run(
            intake.filter().program(),
            &program_run::datagram(&message),
            1,
        );
        sent += SAMPLES;
        sent
    };
    // All records are younger than this reading, so none is settled.
    let before = Clocks::read();
    while counter(&intake, Counter::RecordsLost) == 0 {
        for _ in 0..50 {
            send(&intake);
        }
        intake.poll(&before, &mut observer);
    }
    let taken = intake.copied_bytes() as usize / size_of::<Record>();
    assert_eq!(taken, WaitingRecords::CAP);
    assert_eq!(observer.snapshot(before.now).records, 0);

    // Afterwards the buffer accepts records again: those left in the ring count, and so do new
    // ones.
    let mut later = Clocks::read();
    later.now = Timestamp(later.now.0 + SECOND);
    later.monotonic += SECOND;
    intake.poll(&later, &mut observer);
    let lost = counter(&intake, Counter::RecordsLost);
    let sent = u64::from(send(&intake));
    later.monotonic += SECOND;
    intake.poll(&later, &mut observer);
    let counted = observer.snapshot(later.now).records;
    println!("{sent} sent, {lost} lost, {counted} counted");
    assert_eq!(counter(&intake, Counter::RecordsLost), lost);
    assert_eq!(counted, sent - lost);
}
