//! Runs the kernel filter on frames built by a test.

use std::collections::BTreeMap;
use std::io;
use std::ops::RangeInclusive;
use std::os::fd::{AsRawFd as _, BorrowedFd};
use std::time::Duration;

use ros2probe_capture::ahead::{Ahead, ReadyItem};
use ros2probe_capture::filter::{Filter, FilterSettings};
use ros2probe_capture::reassembly::{FlowKey, Limits, Reassembly};
use ros2probe_capture::tcx::{self, TcxError};
use ros2probe_wire::filter::{Budget, Counter};
use ros2probe_wire::frame::{self, PacketType, Payload};
use ros2probe_wire::host::Piece;
use ros2probe_wire::record::{Record, Verdict, flag, kind};
use ros2probe_wire::time::RtpsTime;
use ros2probe_wire::walk::{self, Envelope};
use ros2probe_wire::{Guid, Timestamp};

/// Length of the header in front of the IP packet.
const ETHERNET_LEN: usize = 14;
/// Interface index of the frames.
pub const INTERFACE: u32 = 1;

/// Result for one frame.
pub struct FrameResult {
    /// Whether user space receives it.
    pub kept: bool,
    /// Valid records.
    pub records: Vec<Record>,
}

/// Result for one datagram at a socket.
pub struct SocketResult {
    /// Its first piece and all its bytes, if it is captured.
    pub captured: Option<(Piece, Vec<u8>)>,
    /// Its records, including records that wait for more fragments.
    pub records: Vec<Record>,
}

/// One of the kernel programs.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Hook {
    Wire,
    TcxIngress,
    TcxEgress,
    Ingress,
    Egress,
}

impl Hook {
    /// Returns the hooks at interfaces that this kernel has.
    pub fn at_interfaces() -> Vec<Self> {
        match tcx::check() {
            Ok(()) => vec![Self::Wire, Self::TcxIngress, Self::TcxEgress],
            Err(TcxError::Unsupported) => vec![Self::Wire],
            Err(error) => panic!("{error}: run the tests with sudo"),
        }
    }
}

/// A loaded filter, and the processing of fragments in user space.
pub struct Kernel {
    pub filter: Filter,
    hook: Hook,
    ahead: Ahead,
    reassembly: Reassembly,
    rest: Vec<Record>,
    identification: u32,
    now: u64,
}

impl Kernel {
    pub fn load() -> Self {
        Self::load_hook(Hook::Wire)
    }

    pub fn load_hook(hook: Hook) -> Self {
        stay_on_cpu();
        let settings = FilterSettings {
            record_ring_bytes: 1 << 20,
            ..FilterSettings::default()
        };
        let filter = match hook {
            Hook::Wire => Filter::load(&settings),
            Hook::TcxIngress | Hook::TcxEgress => Filter::load_tcx(&settings),
            Hook::Ingress | Hook::Egress => Filter::load_host(&settings),
        };
        let filter = filter.expect("loading the kernel filter needs root: run the tests with sudo");
        Self {
            filter,
            hook,
            ahead: Ahead::default(),
            reassembly: Reassembly::new(Limits::default()),
            rest: Vec::new(),
            identification: 0,
            now: 1,
        }
    }

    pub fn set_interest(&mut self, interest: &BTreeMap<Guid, Verdict>) {
        for (guid, verdict) in interest {
            self.filter.set_interest(*guid, Some(*verdict)).unwrap();
        }
    }

    pub fn forget_interest(&mut self, interest: &BTreeMap<Guid, Verdict>) {
        for guid in interest.keys() {
            self.filter.set_interest(*guid, None).unwrap();
        }
    }

    pub fn set_unknown_budget(&mut self, bytes: u32, records: u32) {
        for (budget, amount) in [(Budget::CaptureBytes, bytes), (Budget::Records, records)] {
            self.filter.set_unknown_budget(budget, amount).unwrap();
        }
    }

    pub fn next_identification(&mut self) -> u32 {
        self.identification += 1;
        self.identification
    }

    /// Returns records that user space read from handed-over datagrams since the last call.
    pub fn take_remainder(&mut self) -> Vec<Record> {
        std::mem::take(&mut self.rest)
    }

    /// Returns incomplete runs of fragments.
    pub fn take_stalled(&mut self) -> Vec<Record> {
        self.filter.stalled_runs(u64::MAX)
    }

    /// Runs the program on one IP packet.
    pub fn frame(&mut self, packet: &[u8]) -> FrameResult {
        let (result, _) = self.run(packet, 1);
        let kept = match self.hook {
            Hook::Wire => result != 0,
            _ => self.kept_at_tcx(packet, result),
        };
        self.now += 1;
        let mut ready = Vec::new();
        if kept {
            self.keep(packet, &mut ready);
        }
        while let Some(record) = self.filter.next_record() {
            if record.kind == kind::HANDOVER {
                let key = FlowKey::of_handover(0, &record);
                if let Some(rest) = self.reassembly.hand_over(Timestamp(self.now), key, &record) {
                    self.ahead.add_remainder(0, rest, |each| ready.push(each));
                }
            }
            self.ahead.record(0, record, |each| ready.push(each));
        }
        let mut records = Vec::new();
        let rest_came = ready
            .iter()
            .any(|each| matches!(each, ReadyItem::Remainder(_)));
        for each in ready {
            match each {
                ReadyItem::Record(record) if rest_came => self.rest.push(record),
                ReadyItem::Record(record) => records.push(record),
                ReadyItem::Remainder(rest) => {
                    let handover = rest.handover.map(|record| record.handover());
                    let envelope = Envelope::default();
                    walk::datagram(rest.payload(), &envelope, handover.as_ref(), |found| {
                        self.rest.push(found.record);
                    });
                }
            }
        }
        FrameResult { kept, records }
    }

    /// Returns whether a program at tcx has passed a packet to user space, which must be the whole one
    /// from its IP header on.
    fn kept_at_tcx(&mut self, packet: &[u8], result: u32) -> bool {
        /// `TCX_NEXT`.
        const NEXT: u32 = -1_i32 as u32;
        assert_eq!(result, NEXT, "a packet was not passed on: {packet:02x?}");
        let mut bytes = Vec::new();
        while let Some(piece) = self.filter.next_piece() {
            let (piece, part) = piece.read().unwrap();
            let outgoing = piece.flags & flag::OUTGOING != 0;
            assert_ne!(piece.flags & flag::FRAME, 0);
            assert_eq!(outgoing, self.hook == Hook::TcxEgress);
            assert_eq!(piece.offset as usize, bytes.len(), "pieces come in order");
            bytes.extend_from_slice(part);
        }
        assert!(bytes.is_empty() || bytes == packet, "the bytes are others");
        !bytes.is_empty()
    }

    /// Runs a program of the host hook on one datagram in one IP packet.
    pub fn datagram(&mut self, packet: &[u8]) -> SocketResult {
        let (verdict, _) = self.run(packet, 1);
        assert_eq!(verdict, 1, "a datagram was dropped: {packet:02x?}");
        let mut captured: Option<(Piece, Vec<u8>)> = None;
        while let Some(piece) = self.filter.next_piece() {
            let (piece, bytes) = piece.read().unwrap();
            let (first, so_far) = captured.get_or_insert((piece, Vec::new()));
            assert_eq!(first.datagram, piece.datagram, "one datagram was shown");
            assert_eq!(piece.offset as usize, so_far.len(), "pieces come in order");
            so_far.extend_from_slice(bytes);
        }
        let mut records: Vec<_> = std::iter::from_fn(|| self.filter.next_record()).collect();
        records.extend(self.take_stalled());
        SocketResult { captured, records }
    }

    pub fn counter(&self, which: Counter) -> u64 {
        let counters = self.filter.counters().unwrap();
        let found = counters.iter().find(|(counter, _)| *counter == which);
        found.unwrap().1
    }

    fn keep(&mut self, packet: &[u8], ready: &mut Vec<ReadyItem>) {
        let protocol = if packet[0] >> 4 == 4 { 0x0800 } else { 0x86dd };
        let len = u32::try_from(packet.len()).unwrap();
        let Ok(Some(parsed)) = frame::parse_cooked(protocol, PacketType::HOST, packet, len) else {
            return;
        };
        if let Payload::Fragment(fragment) = &parsed.payload {
            let outgoing = self.hook == Hook::TcxEgress;
            let key = FlowKey::new(0, INTERFACE, outgoing, &parsed, fragment);
            let whole = self.reassembly.fragment(Timestamp(self.now), key, fragment);
            if let Some(rest) = whole.filter(|whole| whole.handover.is_some()) {
                self.ahead.add_remainder(0, rest, |each| ready.push(each));
            }
        }
    }

    /// Returns the total time of `repeat` runs of the program on one IP packet.
    pub fn time(&self, packet: &[u8], repeat: u32) -> Duration {
        let (_, mean) = self.run(packet, repeat);
        mean * repeat
    }

    /// Discards unread records and pieces.
    pub fn drain(&mut self) {
        while self.filter.next_record().is_some() {}
        while self.filter.next_piece().is_some() {}
    }

    /// Returns the program that [`Self::run`] runs.
    pub fn program(&self) -> BorrowedFd<'_> {
        match self.hook {
            Hook::Wire | Hook::Ingress => self.filter.program(),
            Hook::TcxIngress => self.filter.tcx_programs().unwrap()[0],
            Hook::TcxEgress => self.filter.tcx_programs().unwrap()[1],
            Hook::Egress => self.filter.egress_program().unwrap(),
        }
    }

    /// Returns the program's own instructions after verification, without the functions that it
    /// calls (BPF_OBJ_GET_INFO_BY_FD).
    pub fn verified_main(&self) -> Vec<[u8; 8]> {
        /// The head of `struct bpf_prog_info` (linux/bpf.h).
        #[repr(C)]
        #[derive(Clone, Default)]
        struct ProgramInfo {
            head: [u32; 4],
            jited_len: u32,
            xlated_len: u32,
            jited: u64,
            xlated: u64,
            load_time: u64,
            created_by_uid: u32,
            map_id_count: u32,
            map_ids: u64,
            name: [u8; 16],
            interface: [u32; 2],
            namespace: [u64; 2],
            jited_counts: [u32; 2],
            jited_symbols: [u64; 2],
            btf_id: u32,
            function_size: u32,
            functions: u64,
            function_count: u32,
            line_count: u32,
        }
        #[repr(C)]
        struct Query {
            fd: u32,
            len: u32,
            info: u64,
        }
        const BPF_OBJ_GET_INFO_BY_FD: libc::c_int = 15;
        let ask = |info: &mut ProgramInfo| {
            let mut query = Query {
                fd: self.program().as_raw_fd().cast_unsigned(),
                len: u32::try_from(size_of::<ProgramInfo>()).unwrap(),
                info: (&raw mut *info) as u64,
            };
            // SAFETY: the attribute and the information have the sizes passed, and the buffers in
            // the information have the sizes that the kernel returned.
            let result = unsafe {
                libc::syscall(
                    libc::SYS_bpf,
                    BPF_OBJ_GET_INFO_BY_FD,
                    &raw mut query,
                    size_of::<Query>(),
                )
            };
            let error = io::Error::last_os_error();
            assert!(result >= 0, "BPF_OBJ_GET_INFO_BY_FD: {error}");
        };
        let mut sizes = ProgramInfo::default();
        ask(&mut sizes);
        let mut instructions = vec![[0_u8; 8]; sizes.xlated_len as usize / 8];
        let mut functions = vec![[0_u32; 2]; sizes.function_count as usize];
        assert_eq!(sizes.function_size, 8, "struct bpf_func_info");
        let mut info = ProgramInfo {
            xlated_len: sizes.xlated_len,
            xlated: instructions.as_mut_ptr() as u64,
            function_size: sizes.function_size,
            functions: functions.as_mut_ptr() as u64,
            function_count: sizes.function_count,
            ..ProgramInfo::default()
        };
        ask(&mut info);
        // The first function is the program; the next one begins at its end.
        let end = functions.get(1).map_or(usize::MAX, |each| each[0] as usize);
        instructions.truncate(end);
        instructions
    }

    /// Runs this hook's program as [`run`] does.
    pub fn run(&self, packet: &[u8], repeat: u32) -> (u32, Duration) {
        run(self.program(), packet, repeat)
    }

    /// Runs the program on one IP packet, and returns the packet afterwards.
    pub fn after_run(&self, packet: &[u8]) -> Vec<u8> {
        let mut after = vec![0; ETHERNET_LEN + packet.len() + 64];
        let len = run_into(self.program(), packet, 1, &mut after).2;
        after[ETHERNET_LEN..len].to_vec()
    }
}

/// Runs BPF_PROG_TEST_RUN. Returns the program's result, and its mean time.
pub fn run(program: BorrowedFd<'_>, packet: &[u8], repeat: u32) -> (u32, Duration) {
    let (result, mean, _) = run_into(program, packet, repeat, &mut []);
    (result, mean)
}

/// Runs BPF_PROG_TEST_RUN, and writes the frame afterwards to `after`, unless that is empty. Also
/// returns the length of that frame.
fn run_into(
    program: BorrowedFd<'_>,
    packet: &[u8],
    repeat: u32,
    after: &mut [u8],
) -> (u32, Duration, usize) {
    /// The head of `union bpf_attr` for BPF_PROG_TEST_RUN (linux/bpf.h).
    #[repr(C)]
    #[derive(Default)]
    struct TestRun {
        prog_fd: u32,
        retval: u32,
        data_size_in: u32,
        data_size_out: u32,
        data_in: u64,
        data_out: u64,
        repeat: u32,
        duration: u32,
        ctx_size_in: u32,
        ctx_size_out: u32,
        ctx_in: u64,
        ctx_out: u64,
    }
    const BPF_PROG_TEST_RUN: libc::c_int = 10;
    let ether_type = if packet[0] >> 4 == 4 {
        [0x08, 0x00]
    } else {
        [0x86, 0xdd]
    };
    let frame = [
        &[2, 0, 0, 0, 0, 1, 2, 0, 0, 0, 0, 2][..],
        &ether_type,
        packet,
    ]
    .concat();
    let mut attributes = TestRun {
        prog_fd: program.as_raw_fd().cast_unsigned(),
        data_size_in: u32::try_from(frame.len()).unwrap(),
        data_size_out: u32::try_from(after.len()).unwrap(),
        data_in: frame.as_ptr() as u64,
        data_out: after.as_mut_ptr() as u64,
        repeat,
        ..TestRun::default()
    };
    if after.is_empty() {
        attributes.data_out = 0;
    }
    // SAFETY: the attribute's size is passed, and both frames outlive the call.
    let result = unsafe {
        libc::syscall(
            libc::SYS_bpf,
            BPF_PROG_TEST_RUN,
            &raw mut attributes,
            size_of::<TestRun>(),
        )
    };
    assert!(
        result >= 0,
        "BPF_PROG_TEST_RUN: {}",
        io::Error::last_os_error()
    );
    (
        attributes.retval,
        Duration::from_nanos(attributes.duration.into()),
        attributes.data_size_out as usize,
    )
}

/// Keeps this thread on its current CPU.
fn stay_on_cpu() {
    // SAFETY: takes no arguments.
    let cpu = unsafe { libc::sched_getcpu() };
    go_to_cpu(usize::try_from(cpu).unwrap());
}

/// Moves this thread to a CPU. The filter joins fragments per CPU, because packets arrive per CPU.
pub fn go_to_cpu(cpu: usize) {
    // SAFETY: a set of bits, for which all zero is valid.
    let mut set: libc::cpu_set_t = unsafe { std::mem::zeroed() };
    // SAFETY: `cpu` is far below the 1024 bits of the set.
    unsafe { libc::CPU_SET(cpu, &mut set) };
    // SAFETY: 0 is this thread, and the set outlives the call.
    let pinned = unsafe { libc::sched_setaffinity(0, size_of_val(&set), &raw const set) };
    assert_eq!(
        pinned,
        0,
        "sched_setaffinity: {}",
        io::Error::last_os_error()
    );
}

/// Returns an RTPS message of one DATA per sequence number, each with `size` bytes of payload.
pub fn message(writer: Guid, numbers: RangeInclusive<u32>, size: usize) -> Vec<u8> {
    let mut bytes = b"RTPS\x02\x03\x01\x0f".to_vec();
    bytes.extend_from_slice(&writer.prefix.0);
    for number in numbers {
        let body = [&[0, 0, 16, 0, 0, 0, 0, 0][..], &writer.entity.0, &[0; 4]].concat();
        bytes.extend_from_slice(&[0x15, 5]);
        bytes.extend_from_slice(&u16::try_from(20 + size).unwrap().to_le_bytes());
        bytes.extend_from_slice(&body);
        bytes.extend_from_slice(&number.to_le_bytes());
        bytes.extend_from_slice(&[0, 1, 0, 0]);
        bytes.extend(std::iter::repeat_n(0x33, size - 4));
    }
    bytes
}

/// Returns an RTPS message of one DATA with a source timestamp.
pub fn stamped(writer: Guid, source: Timestamp, number: u32) -> Vec<u8> {
    let RtpsTime(time) = RtpsTime::of(source);
    let [seconds, fraction] = [time >> 32, time & 0xffff_ffff].map(|word| word as u32);
    let mut bytes = message(writer, number..=number, 16);
    let stamp = [
        0x09_01_08_00_u32.to_be_bytes(),
        seconds.to_le_bytes(),
        fraction.to_le_bytes(),
    ];
    bytes.splice(20..20, stamp.concat());
    bytes
}

/// Returns one DATA as an IPv4 packet.
pub fn data(writer: Guid, number: u32, size: usize) -> Vec<u8> {
    datagram(&message(writer, number..=number, size))
}

/// Returns one DATA_FRAG with one fragment of 1000 bytes, as an IPv4 packet.
pub fn fragment(writer: Guid, number: u32, start: u32, of: u32) -> Vec<u8> {
    data_frags(writer, number, [start], of, 1000)
}

/// Returns DATA_FRAGs with one fragment of `size` bytes each, in one datagram, as an IPv4 packet.
pub fn data_frags(
    writer: Guid,
    number: u32,
    starts: impl IntoIterator<Item = u32>,
    of: u32,
    size: u16,
) -> Vec<u8> {
    let mut bytes = b"RTPS\x02\x04\x01\x12".to_vec();
    bytes.extend_from_slice(&writer.prefix.0);
    for start in starts {
        bytes.extend_from_slice(&[0x16, 1]);
        bytes.extend_from_slice(&(32 + size).to_le_bytes());
        bytes.extend_from_slice(&[0, 0, 28, 0, 0, 0, 0, 0]);
        bytes.extend_from_slice(&writer.entity.0);
        for word in [0, number, start] {
            bytes.extend_from_slice(&word.to_le_bytes());
        }
        bytes.extend_from_slice(&[1, 0]);
        bytes.extend_from_slice(&size.to_le_bytes());
        bytes.extend_from_slice(&(of * u32::from(size)).to_le_bytes());
        bytes.extend(std::iter::repeat_n(0x33, size.into()));
    }
    datagram(&bytes)
}

/// Returns a UDP payload as an IPv4 packet.
pub fn datagram(payload: &[u8]) -> Vec<u8> {
    fragments(payload, 65_000, false, 0).remove(0)
}

/// Returns a UDP payload as IP packets that carry at most `size` bytes of IP payload.
pub fn fragments(payload: &[u8], size: usize, ipv6: bool, identification: u32) -> Vec<Vec<u8>> {
    fragments_of(payload, &[size], ipv6, identification)
}

/// Returns packets as [`fragments`] does, with these sizes in rotation.
pub fn fragments_of(
    payload: &[u8],
    sizes: &[usize],
    ipv6: bool,
    identification: u32,
) -> Vec<Vec<u8>> {
    let udp_len = u16::try_from(payload.len() + 8).unwrap();
    let udp = [
        &7411_u16.to_be_bytes()[..],
        &7411_u16.to_be_bytes(),
        &udp_len.to_be_bytes(),
        &[0; 2],
        payload,
    ];
    let udp = udp.concat();
    let (mut packets, mut at) = (Vec::new(), 0);
    for size in sizes.iter().cycle() {
        let rest = &udp[at..];
        let piece = &rest[..rest.len().min(size / 8 * 8)];
        let offset = u16::try_from(at).unwrap();
        at += piece.len();
        let more = at < udp.len();
        packets.push(if ipv6 {
            v6(piece, offset, more, identification)
        } else {
            let single = offset == 0 && !more;
            v4(piece, offset, more, identification, single)
        });
        if !more {
            break;
        }
    }
    packets
}

fn v4(piece: &[u8], offset: u16, more: bool, identification: u32, single: bool) -> Vec<u8> {
    let total = u16::try_from(piece.len() + 20).unwrap().to_be_bytes();
    let id = u16::try_from(identification).unwrap().to_be_bytes();
    let flags = if single {
        0x4000
    } else {
        (u16::from(more) << 13) | (offset / 8)
    }
    .to_be_bytes();
    let header = [
        0x45, 0, total[0], total[1], id[0], id[1], flags[0], flags[1], 64, 17, 0, 0,
    ];
    [&header[..], &[10, 99, 0, 1], &[10, 99, 0, 2], piece].concat()
}

fn v6(piece: &[u8], offset: u16, more: bool, identification: u32) -> Vec<u8> {
    let len = u16::try_from(piece.len() + 8).unwrap().to_be_bytes();
    let mut address = [0xfd, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1];
    let mut bytes = vec![0x60, 0, 0, 0, len[0], len[1], 44, 64];
    bytes.extend_from_slice(&address);
    address[15] = 2;
    bytes.extend_from_slice(&address);
    bytes.extend_from_slice(&[17, 0]);
    bytes.extend_from_slice(&(offset | u16::from(more)).to_be_bytes());
    bytes.extend_from_slice(&identification.to_be_bytes());
    bytes.extend_from_slice(piece);
    bytes
}
