//! The host hook from user space: attach it to a cgroup, read what it captured, ask about sockets.
//!
//! Attached by links: the kernel detaches them when the last descriptor is closed, so nothing stays
//! behind however the process ends. Links stand beside other people's programs on the same cgroup.

use std::fs::File;
use std::ops::Deref;
use std::os::fd::{AsFd, BorrowedFd};

use aya::Ebpf;
use aya::maps::ring_buf::RingBufItem;
use aya::maps::{HashMap, MapData, MapError, RingBuf};
use aya::programs::links::FdLink;
use aya::programs::{CgroupAttachMode, CgroupSkb, CgroupSkbAttachType, ProgramError, ProgramFd};
use ros2probe_wire::host::{Piece, Socket};
use zerocopy::FromBytes;

use super::super::inside::{Inside, Places};
use super::{
    Filter, FilterError, FilterSettings, UNUSED, failed, load_program, not_permitted, open,
    ring_size, take,
};

/// The host hook's programs by direction.
const PROGRAMS: [(&str, CgroupSkbAttachType); 2] = [
    ("host_ingress", CgroupSkbAttachType::Ingress),
    ("host_egress", CgroupSkbAttachType::Egress),
];

/// What the host hook has besides what both hooks have.
pub(super) struct Hook {
    /// Until they are attached: it holds the object's instructions and types, half a megabyte.
    programs: Option<Ebpf>,
    places: Places,
    inside: Option<Inside>,
    egress: ProgramFd,
    links: Vec<FdLink>,
    /// Values are [`Socket`]s.
    sockets: HashMap<MapData, u64, [u64; 2]>,
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
        let places = if settings.kernel_types {
            Places::look_up()
        } else {
            Places::unknown("kernel types were not read".to_owned())
        };
        let sizes = [("PIECES", pieces), ("FLOWS", UNUSED)];
        let mut ebpf = open(settings, true, &sizes, Some(&places), 0)?;
        let ingress = load_program(&mut ebpf, "host_ingress")?;
        let egress = load_program(&mut ebpf, "host_egress")?;
        let (pieces, sockets) = (take(&mut ebpf, "PIECES")?, take(&mut ebpf, "SOCKETS")?);
        let mut filter = Self::with_maps(&mut ebpf, ingress, None)?;
        filter.host = Some(Hook {
            programs: Some(ebpf),
            places,
            inside: None,
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
        let Some(host) = &mut self.host else {
            return Err(FilterError::Missing("host hook"));
        };
        let mut links = Vec::new();
        let programs = host.programs.as_mut();
        let programs = programs.ok_or(FilterError::Missing("object any more"))?;
        for (name, direction) in PROGRAMS {
            let program: &mut CgroupSkb = programs
                .program_mut(name)
                .ok_or(FilterError::Missing(name))?
                .try_into()
                .map_err(FilterError::Program)?;
            // A link takes no flags: links always stand beside others.
            let link = program
                .attach(cgroup, direction, CgroupAttachMode::Single)
                .and_then(|id| program.take_link(id))
                .map_err(attach_failed)?;
            // What is not a link would outlive the process; the kernels that have the maps we need
            // (5.8) have links (5.7).
            let link = FdLink::try_from(link)
                .map_err(|_| FilterError::Attach(ProgramError::NotAttached))?;
            links.push(link);
        }
        host.links.append(&mut links);
        Ok(())
    }

    /// Attaches the programs that look further inside the kernel, as many as it allows. `whole_host`:
    /// the hook is attached to the topmost cgroup, so it sees every socket. Nothing on the wire hook.
    pub fn look_inside(&mut self, whole_host: bool) {
        if let Some(host) = &mut self.host
            && let Some(programs) = &mut host.programs
        {
            let inside = Inside::attach(programs, &host.places, whole_host);
            host.inside = Some(inside);
        }
    }

    /// Nothing more will be attached: what that takes is given up. What is in place stays.
    pub fn settle(&mut self) {
        if let Some(host) = &mut self.host {
            host.programs = None;
        }
    }

    /// What [`Filter::look_inside`] has put in place.
    #[must_use]
    pub fn inside(&self) -> Option<&Inside> {
        self.host.as_ref()?.inside.as_ref()
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

fn attach_failed(error: ProgramError) -> FilterError {
    match not_permitted(&error) {
        Some(error) => FilterError::AttachNotPermitted(error),
        None => FilterError::Attach(error),
    }
}
