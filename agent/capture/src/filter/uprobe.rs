//! The probe on Fast DDS's path into shared memory, from user space: loads it, attaches it to
//! libraries.
//!
//! Attached to a library's file, it puts a breakpoint into the code of every process that maps the
//! file. The kernel inserts and removes the breakpoint, also if this process is killed, because a
//! probe lives as long as its descriptor. Nothing is written to `uprobe_events`.

use std::fs::File;
use std::os::fd::AsFd as _;

use super::{Filter, FilterError, FilterSettings, OBJECT, UNUSED, open, ring_size, take};
use crate::breakpoints::{Attached, Breakpoints, Means};

/// How a library's function receives its message.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Form {
    /// In one piece (Fast DDS 2.x).
    Whole,
    /// In a list of buffers (Fast DDS 3.x).
    List,
}

/// The loaded programs; their maps are in the [`Filter`] returned with them.
pub struct Probes(Breakpoints);

/// The probe of one library; dropping it removes the breakpoint.
pub struct Probe {
    _attached: Attached,
}

impl Form {
    const fn program(self) -> &'static str {
        match self {
            Self::Whole => "shm_handed",
            Self::List => "shm_handed_list",
        }
    }
}

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
        means: Means,
    ) -> Result<(Self, Probes), FilterError> {
        let sizes = [
            ("PIECES", ring_size(settings.piece_ring_bytes)),
            ("FLOWS", UNUSED),
            ("SOCKETS", UNUSED),
            ("CONNECTIONS", UNUSED),
            ("CANDIDATES", UNUSED),
        ];
        let ebpf = open(settings, false, &sizes, None, within.unwrap_or(0))?;
        let names = [Form::Whole, Form::List].into_iter().map(Form::program);
        let mut breakpoints = Breakpoints::load(ebpf, &OBJECT.0, names, None, means)?;
        let program = breakpoints.program(Form::Whole.program())?;
        let program = program.try_clone_to_owned().map_err(FilterError::Attach)?;
        let ebpf = &mut breakpoints.ebpf;
        let mut filter = Self::with_maps(ebpf, program.as_fd(), None)?;
        filter.pieces = Some(take(ebpf, "PIECES")?);
        Ok((filter, Probes(breakpoints)))
    }
}

impl Probes {
    /// Attaches to a library at an offset in its file: every call there is then seen.
    ///
    /// # Errors
    /// Returns [`FilterError::Probe`] or [`FilterError::Breakpoint`] without the privilege for
    /// `means`, or if the offset is not an instruction.
    pub fn attach(&mut self, file: &File, offset: u64, form: Form) -> Result<Probe, FilterError> {
        let attached = self.0.attach(file, &[(form.program(), offset)])?;
        Ok(Probe {
            _attached: attached,
        })
    }
}
