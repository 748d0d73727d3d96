//! The probe on Fast DDS's path into shared memory, from user space: loads it, attaches it to
//! libraries.
//!
//! A probe attached to a library's file puts a breakpoint into the code of every process that maps
//! the file. The kernel inserts and removes the breakpoint, also if this process is killed, because
//! a probe lives as long as its descriptor. Nothing is written to `uprobe_events`.

use std::fs::File;
use std::os::fd::AsFd as _;

use ros2probe_attach::attach::AttachError;
use ros2probe_attach::client::Broker;
use ros2probe_attach::functions::Calls;
pub use ros2probe_attach::library::Form;
use ros2probe_attach::request::Place;

use super::{
    Filter, FilterError, FilterSettings, NO_DELIVERIES, OBJECT, Reads, UNUSED_MAP_ENTRIES, open,
    ring_size, take,
};
use crate::breakpoints::{AttachMethod, Attached, Breakpoints};
use crate::uprobe::attachments::Refusal;

/// The loaded programs; their maps are in the [`Filter`] returned with them.
pub struct Probes(Breakpoints);

impl Filter {
    /// Loads the programs for shared-memory messages and their maps, without attaching them.
    /// `within`: restricts them to processes of this control group, given by the inode of its
    /// directory.
    ///
    /// # Errors
    /// Returns [`FilterError::NotPermitted`] without the capabilities, other errors if the kernel
    /// refuses them.
    pub fn load_uprobe(
        settings: &FilterSettings,
        within: Option<u64>,
        means: AttachMethod,
    ) -> Result<(Self, Probes), FilterError> {
        let mut sizes = vec![
            ("PIECES", ring_size(settings.piece_ring_bytes)),
            ("FLOWS", UNUSED_MAP_ENTRIES),
            ("SOCKETS", UNUSED_MAP_ENTRIES),
            ("CONNECTIONS", UNUSED_MAP_ENTRIES),
            ("CANDIDATES", UNUSED_MAP_ENTRIES),
        ];
        sizes.extend(NO_DELIVERIES);
        let ebpf = open(
            settings,
            Reads::WithHelper,
            &sizes,
            None,
            within.unwrap_or(0),
        )?;
        let calls = Calls::SharedMemory;
        let mut breakpoints = Breakpoints::load(ebpf, &OBJECT.0, calls, None, means)?;
        let program = breakpoints.programs()?.into_iter().next();
        let program = program.ok_or(FilterError::Missing("shm_handed"))?;
        let program = program.try_clone_to_owned().map_err(FilterError::Attach)?;
        let ebpf = &mut breakpoints.ebpf;
        let mut filter = Self::with_maps(ebpf, program.as_fd(), None)?;
        filter.pieces = Some(take(ebpf, "PIECES")?);
        Ok((filter, Probes(breakpoints)))
    }
}

impl Probes {
    /// Lets the broker attach to a library. From then on, every message that processes with this
    /// library put into shared memory is seen.
    ///
    /// # Errors
    /// Returns why the broker refuses.
    pub fn attach(&self, broker: &mut Broker, place: Place) -> Result<Attached, Refusal> {
        self.0.attach(broker, Calls::SharedMemory, place)
    }

    /// Attaches to a library's file with the rights of this process, for tests.
    ///
    /// # Errors
    /// Fails if the library lacks the function, or if the kernel refuses.
    pub fn attach_here(&self, file: &File) -> Result<Attached, AttachError> {
        self.0.attach_here(Calls::SharedMemory, file)
    }
}
