//! The host hook from user space: attaches it to a cgroup, reads its captures, looks up sockets.
//!
//! It is attached by links: the kernel removes them with the last descriptor, so nothing stays
//! behind however the process ends. Links coexist with other programs on the same cgroup.

use std::fs::File;
use std::io;
use std::ops::Deref;
use std::os::fd::{AsFd, AsRawFd as _, BorrowedFd, OwnedFd};

use aya::Ebpf;
use aya::maps::ring_buf::RingBufItem;
use aya::maps::{HashMap, MapData, MapError, RingBuf};
use aya::programs::ProgramFd;
use ros2probe_wire::host::{Piece, Socket};
use zerocopy::FromBytes;

use super::super::bpf;
use super::super::error_chain::Reason;
use super::super::tracepoints::{KernelLayout, Tracepoints};
use super::{
    Deliveries, Filter, FilterError, FilterSettings, NO_DELIVERIES, Reads, UNUSED_MAP_ENTRIES,
    failed, load_program, open, ring_size, take,
};

/// Attach types of linux/bpf.h.
const BPF_CGROUP_INET_INGRESS: u32 = 0;
const BPF_CGROUP_INET_EGRESS: u32 = 1;

/// State of the host hook in addition to the shared state.
pub(super) struct HostHook {
    /// Present until the programs are attached: it holds the object's instructions and types, half
    /// a megabyte.
    programs: Option<Ebpf>,
    layout: KernelLayout,
    tracepoints: Option<Tracepoints>,
    egress: ProgramFd,
    /// The programs for TCP segments of Zenoh, or why the kernel refuses them.
    zenoh: Result<[ProgramFd; 2], FilterError>,
    links: Vec<OwnedFd>,
    deliveries: Option<Deliveries>,
    /// Values are [`Socket`]s.
    sockets: HashMap<MapData, u64, [u64; 3]>,
}

/// The host hook's programs, to be linked to a cgroup.
pub struct Links {
    ingress: OwnedFd,
    egress: OwnedFd,
    zenoh: Option<[OwnedFd; 2]>,
}

/// One piece of a captured datagram, read in place; dropping it frees its space in the ring.
pub struct CapturedPiece<'a>(RingBufItem<'a>);

impl CapturedPiece<'_> {
    /// Returns the piece and its bytes; `None` if it is malformed, which the kernel program never
    /// writes.
    #[must_use]
    pub fn read(&self) -> Option<(Piece, &[u8])> {
        let (piece, bytes) = Piece::read_from_prefix(self.0.deref()).ok()?;
        let bytes = bytes.get(..usize::try_from(piece.len).ok()?)?;
        Some((piece, bytes))
    }
}

/// Methods of the host hook.
impl Filter {
    /// Loads the host hook's programs and their maps, without attaching them.
    ///
    /// # Errors
    /// Returns [`FilterError::NotPermitted`] without the capabilities, other errors if the kernel
    /// refuses them.
    pub fn load_host(settings: &FilterSettings) -> Result<Self, FilterError> {
        let pieces = ring_size(settings.piece_ring_bytes);
        let layout = if settings.kernel_types {
            KernelLayout::read()
        } else {
            KernelLayout::unknown(Reason("kernel types were not read".to_owned()))
        };
        let mut sizes = vec![("PIECES", pieces), ("FLOWS", UNUSED_MAP_ENTRIES)];
        if !settings.deliveries {
            sizes.extend(NO_DELIVERIES);
        }
        let mut ebpf = open(settings, Reads::InPlace, &sizes, Some(&layout), 0)?;
        let ingress = load_program(&mut ebpf, "host_ingress")?;
        let egress = load_program(&mut ebpf, "host_egress")?;
        let zenoh = load_program(&mut ebpf, "zenoh_ingress")
            .and_then(|ingress| Ok([ingress, load_program(&mut ebpf, "zenoh_egress")?]));
        let deliveries = match settings.deliveries {
            true => Some(Deliveries::load(&mut ebpf)?),
            false => None,
        };
        let (pieces, sockets) = (take(&mut ebpf, "PIECES")?, take(&mut ebpf, "SOCKETS")?);
        let mut filter = Self::with_maps(&mut ebpf, ingress.as_fd(), None)?;
        filter.host = Some(HostHook {
            programs: Some(ebpf),
            layout,
            tracepoints: None,
            egress,
            zenoh,
            links: Vec::new(),
            deliveries,
            sockets,
        });
        filter.pieces = Some(pieces);
        Ok(filter)
    }

    /// Attaches the host hook to a cgroup (version 2), given by its directory. From then on it sees
    /// the datagrams of all sockets created in that cgroup or below.
    ///
    /// # Errors
    /// Returns [`FilterError::NetAdmin`] without CAP_NET_ADMIN, and
    /// [`FilterError::Attach`] if the directory is not such a cgroup or another program on it
    /// excludes further ones. In both cases, nothing is attached.
    pub fn attach(&mut self, cgroup: &File) -> Result<(), FilterError> {
        let mut links = self.links()?.create(cgroup)?;
        if let Some(host) = &mut self.host {
            host.links.append(&mut links);
        }
        Ok(())
    }

    /// Returns the programs for attaching the host hook to another cgroup, even after this filter
    /// is dropped.
    ///
    /// # Errors
    /// Fails on the wire hook, and if no more descriptors are available.
    pub fn links(&self) -> Result<Links, FilterError> {
        let host = self.host.as_ref();
        let host = host.ok_or(FilterError::Missing("host hook"))?;
        let own = |program: BorrowedFd<'_>| program.try_clone_to_owned();
        Ok(Links {
            ingress: own(self.program()).map_err(FilterError::Attach)?,
            egress: own(host.egress.as_fd()).map_err(FilterError::Attach)?,
            zenoh: match &host.zenoh {
                Ok([ingress, egress]) => {
                    let ingress = own(ingress.as_fd()).map_err(FilterError::Attach)?;
                    Some([ingress, own(egress.as_fd()).map_err(FilterError::Attach)?])
                }
                Err(_) => None,
            },
        })
    }

    /// Attaches the tracepoint programs that the kernel supports. `whole_host`: the hook is
    /// attached to the topmost cgroup, so it sees every socket. Does nothing on the wire hook.
    pub fn attach_tracepoints(&mut self, whole_host: bool) {
        if let Some(host) = &mut self.host
            && let Some(programs) = &mut host.programs
        {
            let tracepoints = Tracepoints::attach(programs, &host.layout, whole_host);
            host.tracepoints = Some(tracepoints);
        }
    }

    /// Removes and returns the programs and tables of deliveries; `None` if they are not loaded.
    pub fn take_deliveries(&mut self) -> Option<Deliveries> {
        self.host.as_mut()?.deliveries.take()
    }

    /// Frees memory that only further attaching would need. Attached programs stay.
    pub fn settle(&mut self) {
        if let Some(host) = &mut self.host {
            host.programs = None;
        }
    }

    /// Returns the programs that [`Filter::attach_tracepoints`] has attached; `None` before that
    /// and on the wire hook.
    #[must_use]
    pub fn tracepoints(&self) -> Option<&Tracepoints> {
        self.host.as_ref()?.tracepoints.as_ref()
    }

    /// Returns the program for sent datagrams; `None` on the wire hook.
    #[must_use]
    pub fn egress_program(&self) -> Option<BorrowedFd<'_>> {
        self.host.as_ref().map(|host| host.egress.as_fd())
    }

    /// Returns the programs for received and sent TCP segments of Zenoh; `None` on the wire hook.
    ///
    /// # Errors
    /// Returns why the kernel refuses them.
    pub fn zenoh_programs(&self) -> Option<Result<[BorrowedFd<'_>; 2], &FilterError>> {
        let programs = self.host.as_ref()?.zenoh.as_ref();
        Some(programs.map(|programs| programs.each_ref().map(ProgramFd::as_fd)))
    }

    /// Returns a descriptor that is readable when the ring of captured datagrams is half full;
    /// `None` on the wire hook.
    #[must_use]
    pub fn piece_ring(&self) -> Option<BorrowedFd<'_>> {
        self.pieces.as_ref().map(RingBuf::as_fd)
    }

    /// Returns the oldest unread piece of a captured datagram; `None` if the ring is empty, and on
    /// the wire hook.
    pub fn next_piece(&mut self) -> Option<CapturedPiece<'_>> {
        self.pieces.as_mut()?.next().map(CapturedPiece)
    }

    /// Returns the hook's entry for a socket, by its cookie.
    ///
    /// # Errors
    /// Fails if the kernel refuses the lookup.
    pub fn socket(&self, cookie: u64) -> Result<Option<Socket>, FilterError> {
        let Some(host) = &self.host else {
            return Ok(None);
        };
        match host.sockets.get(&cookie, 0) {
            Ok(socket) => Ok(Some(zerocopy::transmute!(socket))),
            Err(MapError::KeyNotFound) => Ok(None),
            Err(error) => Err(failed("SOCKETS", "read")(error)),
        }
    }

    /// Iterates over the sockets that the hook remembers, by cookie.
    pub fn sockets(&self) -> impl Iterator<Item = (u64, Socket)> + '_ {
        self.host
            .iter()
            .flat_map(|host| host.sockets.iter())
            .filter_map(Result::ok)
            .map(|(cookie, socket)| (cookie, zerocopy::transmute!(socket)))
    }
}

impl Links {
    /// Links the programs to a cgroup (version 2), given by its directory. Closing the descriptors
    /// detaches them; they coexist with other programs on the cgroup.
    ///
    /// # Errors
    /// Fails as [`Filter::attach`] does.
    pub fn create(&self, cgroup: &File) -> Result<Vec<OwnedFd>, FilterError> {
        let zenoh = self.zenoh.iter();
        let zenoh = zenoh.flat_map(|[one, other]| {
            [
                (one, BPF_CGROUP_INET_INGRESS),
                (other, BPF_CGROUP_INET_EGRESS),
            ]
        });
        [
            (&self.ingress, BPF_CGROUP_INET_INGRESS),
            (&self.egress, BPF_CGROUP_INET_EGRESS),
        ]
        .into_iter()
        .chain(zenoh)
        .map(|(program, direction)| link(program, cgroup, direction))
        .collect::<io::Result<_>>()
        .map_err(|error| match error.raw_os_error() {
            Some(libc::EPERM) => FilterError::attachment_refused(error),
            _ => FilterError::Attach(error),
        })
    }
}

/// Creates a link. Any other attachment would outlive the process; kernels with the required maps
/// (5.8) have links (5.7).
fn link(program: &OwnedFd, cgroup: &File, direction: u32) -> io::Result<OwnedFd> {
    let [program, cgroup] = [program.as_raw_fd(), cgroup.as_raw_fd()].map(i32::cast_unsigned);
    bpf::create_link(program, cgroup, direction)
}
