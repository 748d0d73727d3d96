//! The host hook from user space: attach it to a cgroup, read what it captured, ask about sockets.
//!
//! Attached by links: the kernel detaches them when the last descriptor is closed, so nothing stays
//! behind however the process ends. Links stand beside other people's programs on the same cgroup.

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
use super::super::tracepoints::{KernelLayout, Tracepoints};
use super::{
    Filter, FilterError, FilterSettings, UNUSED, failed, load_program, open, ring_size, take,
};

/// Attach types of linux/bpf.h.
const INGRESS: u32 = 0;
const EGRESS: u32 = 1;

/// What the host hook has besides what both hooks have.
pub(super) struct HostHook {
    /// Until they are attached: it holds the object's instructions and types, half a megabyte.
    programs: Option<Ebpf>,
    layout: KernelLayout,
    tracepoints: Option<Tracepoints>,
    egress: ProgramFd,
    links: Vec<OwnedFd>,
    /// Values are [`Socket`]s.
    sockets: HashMap<MapData, u64, [u64; 2]>,
}

/// The host hook's programs, to be linked to a cgroup.
pub struct Links {
    ingress: OwnedFd,
    egress: OwnedFd,
}

/// One piece of a captured datagram, in place in the ring: the ring has its room again when this is
/// dropped.
pub struct CapturedPiece<'a>(RingBufItem<'a>);

impl CapturedPiece<'_> {
    /// The piece and its bytes; `None` when it is not one, which the kernel program does not write.
    #[must_use]
    pub fn read(&self) -> Option<(Piece, &[u8])> {
        let (piece, bytes) = Piece::read_from_prefix(self.0.deref()).ok()?;
        let bytes = bytes.get(..usize::try_from(piece.len).ok()?)?;
        Some((piece, bytes))
    }
}

/// The host hook.
impl Filter {
    /// Loads the host hook's programs and their maps; attaches them to nothing.
    ///
    /// # Errors
    /// [`FilterError::NotPermitted`] without the capabilities, others when the kernel refuses them.
    pub fn load_host(settings: &FilterSettings) -> Result<Self, FilterError> {
        let pieces = ring_size(settings.piece_ring_bytes);
        let layout = if settings.kernel_types {
            KernelLayout::read()
        } else {
            KernelLayout::unknown("kernel types were not read".to_owned())
        };
        let sizes = [("PIECES", pieces), ("FLOWS", UNUSED)];
        let mut ebpf = open(settings, true, &sizes, Some(&layout), 0)?;
        let ingress = load_program(&mut ebpf, "host_ingress")?;
        let egress = load_program(&mut ebpf, "host_egress")?;
        let (pieces, sockets) = (take(&mut ebpf, "PIECES")?, take(&mut ebpf, "SOCKETS")?);
        let mut filter = Self::with_maps(&mut ebpf, ingress, None)?;
        filter.host = Some(HostHook {
            programs: Some(ebpf),
            layout,
            tracepoints: None,
            egress,
            links: Vec::new(),
            sockets,
        });
        filter.pieces = Some(pieces);
        Ok(filter)
    }

    /// Attaches the host hook to a cgroup (version 2), given by its directory: from now on it sees
    /// the datagrams of all sockets that were created in that cgroup or below.
    ///
    /// # Errors
    /// [`FilterError::AttachNotPermitted`] without CAP_NET_ADMIN, [`FilterError::Attach`] when the
    /// directory is no such cgroup, or another program on it excludes further ones. Then nothing is
    /// attached.
    pub fn attach(&mut self, cgroup: &File) -> Result<(), FilterError> {
        let mut links = self.links()?.create(cgroup)?;
        if let Some(host) = &mut self.host {
            host.links.append(&mut links);
        }
        Ok(())
    }

    /// What attaches the host hook to another cgroup, also after this filter is gone.
    ///
    /// # Errors
    /// On the wire hook, and when there can be no more descriptors.
    pub fn links(&self) -> Result<Links, FilterError> {
        let host = self.host.as_ref();
        let host = host.ok_or(FilterError::Missing("host hook"))?;
        let own = |program: BorrowedFd<'_>| program.try_clone_to_owned();
        Ok(Links {
            ingress: own(self.program()).map_err(FilterError::Attach)?,
            egress: own(host.egress.as_fd()).map_err(FilterError::Attach)?,
        })
    }

    /// Attaches the programs that look further inside the kernel, as many as it allows. `whole_host`:
    /// the hook is attached to the topmost cgroup, so it sees every socket. Nothing on the wire hook.
    pub fn attach_tracepoints(&mut self, whole_host: bool) {
        if let Some(host) = &mut self.host
            && let Some(programs) = &mut host.programs
        {
            let tracepoints = Tracepoints::attach(programs, &host.layout, whole_host);
            host.tracepoints = Some(tracepoints);
        }
    }

    /// Nothing more will be attached: what that takes is given up. What is in place stays.
    pub fn settle(&mut self) {
        if let Some(host) = &mut self.host {
            host.programs = None;
        }
    }

    /// What [`Filter::attach_tracepoints`] has put in place.
    #[must_use]
    pub fn tracepoints(&self) -> Option<&Tracepoints> {
        self.host.as_ref()?.tracepoints.as_ref()
    }

    /// The program for datagrams on their way out, `None` on the wire hook.
    #[must_use]
    pub fn egress_program(&self) -> Option<BorrowedFd<'_>> {
        self.host.as_ref().map(|host| host.egress.as_fd())
    }

    /// Readable when the ring of captured datagrams is half full; `None` on the wire hook.
    #[must_use]
    pub fn piece_ring(&self) -> Option<BorrowedFd<'_>> {
        self.pieces.as_ref().map(RingBuf::as_fd)
    }

    /// The oldest piece of a captured datagram not read yet.
    pub fn next_piece(&mut self) -> Option<CapturedPiece<'_>> {
        self.pieces.as_mut()?.next().map(CapturedPiece)
    }

    /// What the hook knows of a socket, by its cookie.
    ///
    /// # Errors
    /// When the kernel refuses.
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

    /// Every socket that the hook remembers, by cookie.
    pub fn sockets(&self) -> impl Iterator<Item = (u64, Socket)> + '_ {
        self.host
            .iter()
            .flat_map(|host| host.sockets.iter())
            .filter_map(Result::ok)
            .map(|(cookie, socket)| (cookie, zerocopy::transmute!(socket)))
    }
}

impl Links {
    /// Links the programs to a cgroup (version 2), given by its directory. They are detached when
    /// the descriptors are closed, and stand beside other programs on the cgroup.
    ///
    /// # Errors
    /// As [`Filter::attach`].
    pub fn create(&self, cgroup: &File) -> Result<Vec<OwnedFd>, FilterError> {
        let programs = [(&self.ingress, INGRESS), (&self.egress, EGRESS)];
        let links = programs.map(|(program, direction)| link(program, cgroup, direction));
        links
            .into_iter()
            .collect::<io::Result<_>>()
            .map_err(|error| match error.raw_os_error() {
                Some(libc::EPERM) => FilterError::AttachNotPermitted(error),
                _ => FilterError::Attach(error),
            })
    }
}

/// What is not a link would outlive the process; the kernels that have the maps we need (5.8) have
/// links (5.7).
fn link(program: &OwnedFd, cgroup: &File, direction: u32) -> io::Result<OwnedFd> {
    let [program, cgroup] = [program.as_raw_fd(), cgroup.as_raw_fd()].map(i32::cast_unsigned);
    bpf::create_link(program, cgroup, direction)
}
