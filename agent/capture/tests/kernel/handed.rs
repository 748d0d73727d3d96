//! The probe on the path into shared memory, tested on a program that passes messages as Fast DDS
//! does. The kernel reads the same bytes, in one piece and in a list of buffers, however they are
//! cut. The tests need root and a kernel with uprobes.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs::File;
use std::os::unix::fs::MetadataExt as _;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::{Result, ensure};
use ros2probe_attach::library;
use ros2probe_capture::breakpoints::{AttachMethod, Attached};
use ros2probe_capture::filter::{Filter, FilterSettings, Form, Probes};
use ros2probe_capture::piece_assembler::PieceAssembler;
use ros2probe_testing::forged::{SAMPLES_WRITER, Talker};
use ros2probe_testing::harness;
use ros2probe_testing::harness::network::Namespace;
use ros2probe_testing::harness::process::Process;
use ros2probe_wire::filter::{Budget, Counter};
use ros2probe_wire::record::{Record, Verdict, flag};
use ros2probe_wire::walk::{self, Envelope};
use ros2probe_wire::{EntityId, Guid, GuidPrefix};

const PATIENCE: Duration = Duration::from_secs(60);
const EXACT: u16 = flag::SHM | flag::EXACT;

/// A process that passes messages, a filter that observes it, and the participant that it imitates.
struct SharedMemorySender {
    filter: Filter,
    probe: Option<Attached>,
    _probes: Probes,
    program: PathBuf,
    sender: Process,
    host: Namespace,
    talker: Talker,
}

impl SharedMemorySender {
    fn new(form: Form) -> Result<SharedMemorySender> {
        Self::by(AttachMethod::of_this_kernel(), form)
    }

    fn by(means: AttachMethod, form: Form) -> Result<SharedMemorySender> {
        let host = Namespace::isolated()?;
        let within = File::open(host.cgroup())?.metadata()?.ino();
        let (mut filter, probes) =
            Filter::load_uprobe(&FilterSettings::default(), Some(within), means)?;
        let program = harness::peer::built(match form {
            Form::Whole => "handed",
            Form::List => "handed-list",
        })?;
        let file = File::open(&program)?;
        let entry = library::find(&file)?;
        ensure!(entry.form == form, "{entry:?}");
        let probe = Some(probes.attach_here(&file)?);
        let mut sender = Process::start(&host.on_network(), &program, [""; 0])?;
        sender.wait_for("ready", PATIENCE)?;
        let talker = Talker::new(1, "/points");
        for budget in [Budget::CaptureBytes, Budget::Records] {
            filter.set_unknown_budget(budget, 1 << 20)?;
        }
        Ok(SharedMemorySender {
            filter,
            probe,
            _probes: probes,
            program,
            sender,
            host,
            talker,
        })
    }

    /// Passes a message, cut into buffers of these lengths.
    fn hand(&mut self, message: &[u8], lengths: &[usize]) -> Result<()> {
        assert_eq!(lengths.iter().sum::<usize>(), message.len());
        hand(&mut self.sender, message, lengths)
    }

    fn set_verdict(&mut self, verdict: Verdict) -> Result<()> {
        let prefix = GuidPrefix(self.talker.prefix);
        let writer = Guid::new(prefix, EntityId(SAMPLES_WRITER));
        Ok(self.filter.set_interest(writer, Some(verdict))?)
    }

    fn records(&mut self) -> Vec<Record> {
        std::iter::from_fn(|| self.filter.next_record()).collect()
    }

    /// Returns whole captured messages.
    fn captured(&mut self) -> Vec<Vec<u8>> {
        let (mut wholes, mut messages) = (PieceAssembler::default(), Vec::new());
        while let Some(captured) = self.filter.next_piece() {
            let (piece, bytes) = captured.read().unwrap();
            assert_eq!((piece.flags, piece.socket), (EXACT, 0));
            if let Some((_, whole)) = wholes.piece(&piece, bytes) {
                messages.push(whole.into_owned());
            }
        }
        messages
    }

    fn counts(&self) -> Result<BTreeMap<&'static str, u64>> {
        let counters = self.filter.counters()?;
        let named = counters
            .into_iter()
            .map(|(one, count)| (one.label(), count));
        Ok(named.collect())
    }
}

fn hand(sender: &mut Process, message: &[u8], lengths: &[usize]) -> Result<()> {
    let mut line = String::new();
    for length in lengths {
        write!(line, "{length} ")?;
    }
    line.push(':');
    for byte in message {
        write!(line, "{byte:02x}")?;
    }
    sender.write_line(&line)?;
    sender.wait_for("handed", PATIENCE)
}

/// Returns divisions of a message of this length. Fast DDS cuts before payloads and their padding.
fn cuts(form: Form, length: usize) -> Vec<Vec<usize>> {
    if form == Form::Whole {
        return vec![vec![length]];
    }
    let every = |step: usize| {
        let starts = (0..length).step_by(step);
        starts.map(|at| step.min(length - at)).collect()
    };
    let behind = |at: usize| vec![at, 0, length - at];
    vec![
        vec![length],
        every(4),
        every(13),
        every(20),
        behind(20),
        behind(44),
        vec![44, length - 45, 1],
        vec![1, length - 1],
    ]
}

#[test]
fn metered_records_equal_those_of_user_space() -> Result<()> {
    for form in [Form::Whole, Form::List] {
        let mut handing = SharedMemorySender::new(form)?;
        handing.set_verdict(Verdict::Meter)?;
        let mut expected = Vec::new();
        for size in [9, 10, 12, 13, 320] {
            for cut in cuts(
                form,
                handing.talker.message(SAMPLES_WRITER, 1, &[0; 320]).len() - 320 + size,
            ) {
                let mut message = handing.talker.sample(size);
                // INFO_TS precedes the submessage, so that a timestamp is in force.
                let time = [9, 1, 8, 0, 1, 0, 0, 0, 2, 0, 0, 0];
                let at = 20;
                message.splice(at..at, time);
                let mut cut = cut;
                if let Some(last) = cut.last_mut() {
                    *last += time.len();
                }
                handing.hand(&message, &cut)?;
                walk::datagram(&message, &Envelope::default(), None, |found| {
                    expected.push(found.record);
                });
            }
        }
        let records = handing.records();
        assert_eq!(records.len(), expected.len(), "{:?}", handing.counts()?);
        for (record, expected) in records.iter().zip(&expected) {
            // Without an address, user space sets the IPv6 flag.
            let flags = (expected.flags & !flag::IPV6) | EXACT;
            let time = record.time;
            assert!(time > 0);
            assert_eq!(
                *record,
                Record {
                    time,
                    flags,
                    ..*expected
                }
            );
        }
        assert!(handing.captured().is_empty());
    }
    Ok(())
}

#[test]
fn captured_messages_are_whole() -> Result<()> {
    for (means, form) in [
        (AttachMethod::of_this_kernel(), Form::Whole),
        (AttachMethod::of_this_kernel(), Form::List),
        (AttachMethod::PerfEvents, Form::Whole),
        (AttachMethod::PerfEvents, Form::List),
    ] {
        let mut handing = SharedMemorySender::by(means, form)?;
        let mut expected: Vec<Vec<u8>> = Vec::new();
        let introduction = handing.talker.introduction("talker");
        for message in introduction {
            for cut in cuts(form, message.len()) {
                handing.hand(&message, &cut)?;
                expected.push(message.clone());
            }
        }
        // The message of an unannounced writer is captured, too.
        let long = handing.talker.message(SAMPLES_WRITER, 1, &vec![7; 65_000]);
        let cut = match form {
            Form::Whole => vec![long.len()],
            Form::List => vec![44, 1, 40_000, long.len() - 40_045],
        };
        handing.hand(&long, &cut)?;
        expected.push(long);
        let captured = handing.captured();
        assert_eq!(captured.len(), expected.len(), "{:?}", handing.counts()?);
        assert!(captured == expected);
        assert_eq!(handing.records(), []);
    }
    Ok(())
}

#[test]
fn messages_are_metered_while_the_ring_is_full() -> Result<()> {
    for form in [Form::Whole, Form::List] {
        let mut handing = SharedMemorySender::new(form)?;
        handing.set_verdict(Verdict::Capture)?;
        let numbers = 1..=30;
        for number in numbers.clone() {
            let message = handing.talker.message(SAMPLES_WRITER, number, &[7; 60_000]);
            let cut = match form {
                Form::Whole => vec![message.len()],
                Form::List => vec![44, message.len() - 44],
            };
            handing.hand(&message, &cut)?;
        }
        let captured = handing.captured().len();
        let metered = handing.records();
        assert_eq!(captured, 17, "as many as a ring of a megabyte holds");
        let metered: Vec<_> = (metered.iter())
            .map(|record| {
                (
                    record.sequence_number,
                    record.payload_len,
                    record.flags & EXACT,
                )
            })
            .collect();
        let rest = numbers
            .skip(captured)
            .map(|number| (u64::from(number), 60_000, EXACT));
        assert_eq!(metered, rest.collect::<Vec<_>>());
        let counts = handing.counts()?;
        let lost = counts.get(Counter::PiecesLost.label());
        assert_eq!(lost, Some(&(metered.len() as u64)), "{counts:?}");
    }
    Ok(())
}

#[test]
fn messages_longer_than_datagrams_count_and_unreadable_ones_are_counted() -> Result<()> {
    for form in [Form::Whole, Form::List] {
        let mut handing = SharedMemorySender::new(form)?;
        handing.set_verdict(Verdict::Meter)?;
        // A length of 0 means that the submessage extends to the end.
        let mut long = handing.talker.message(SAMPLES_WRITER, 5, &vec![7; 40_000]);
        long.splice(22..24, [0, 0]);
        long.extend(vec![7; 100_000]);
        let cut = match form {
            Form::Whole => vec![long.len()],
            Form::List => vec![44, long.len() - 44],
        };
        handing.hand(&long, &cut)?;
        let records = handing.records();
        let found: Vec<_> = records
            .iter()
            .map(|record| (record.sequence_number, record.payload_len))
            .collect();
        assert_eq!(found, [(5, 140_000)]);
        // The message is too long to be captured.
        handing.set_verdict(Verdict::Capture)?;
        handing.hand(&long, &cut)?;
        let records = handing.records();
        let found = records.first();
        let found = found.map(|record| (record.sequence_number, record.payload_len));
        assert_eq!((found, records.len()), (Some((5, 140_000)), 1));
        handing.sender.write_line("nowhere")?;
        handing.sender.wait_for("handed", PATIENCE)?;
        handing.hand(b"none of RTPS, and yet a message", &[31])?;
        handing.hand(b"short", &[5])?;
        let counts = handing.counts()?;
        let count = |counter: Counter| counts.get(counter.label()).copied();
        assert_eq!(count(Counter::Unreadable), Some(1), "{counts:?}");
        assert_eq!(count(Counter::Malformed), Some(2), "{counts:?}");
        assert_eq!(count(Counter::Messages), Some(2), "{counts:?}");
        assert_eq!(count(Counter::PiecesLost), Some(1), "{counts:?}");
        assert_eq!(count(Counter::Contended), Some(0), "{counts:?}");
    }
    Ok(())
}

#[test]
fn messages_of_other_cgroups_and_messages_after_detaching_are_not_seen() -> Result<()> {
    let mut handing = SharedMemorySender::new(Form::Whole)?;
    handing.set_verdict(Verdict::Meter)?;
    let message = handing.talker.sample(100);
    let elsewhere = handing.host.outside();
    let mut stranger = Process::start(&elsewhere, &handing.program, [""; 0])?;
    stranger.wait_for("ready", PATIENCE)?;
    hand(&mut stranger, &message, &[message.len()])?;
    assert_eq!(handing.records(), []);
    handing.hand(&message, &[message.len()])?;
    assert_eq!(handing.records().len(), 1);
    handing.probe = None;
    handing.hand(&message, &[message.len()])?;
    assert_eq!(handing.records(), []);
    // Probes of parallel tests are in the same file.
    let deadline = Instant::now() + PATIENCE;
    loop {
        let code = harness::code::at_function(&handing.sender, &handing.program)?;
        if code.in_memory == code.in_file {
            return Ok(());
        }
        ensure!(Instant::now() < deadline, "{code:?}");
        std::thread::sleep(Duration::from_millis(20));
    }
}
