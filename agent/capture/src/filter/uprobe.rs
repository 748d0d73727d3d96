//! The probe on Fast DDS's path into shared memory, from user space: loads it, attaches it to
//! libraries.
//!
//! Attached to a library's file, it puts a breakpoint into the code of every process that maps the
//! file. The kernel inserts and removes the breakpoint, also if this process is killed, because a
//! probe lives as long as its descriptor. Nothing is written to `uprobe_events`.

use std::fs::File;
use std::os::fd::AsRawFd as _;
use std::path::Path;

use aya::Ebpf;
use aya::programs::uprobe::{UProbeLink, UProbeScope};
use aya::programs::{ProgramError, UProbe};

use super::{Filter, FilterError, FilterSettings, UNUSED, open, ring_size, take};

/// File in which the kernel announces this type of probe. Without it aya falls back to older
/// interfaces, whose probes outlive a killed process.
const KIND: &str = "/sys/bus/event_source/devices/uprobe/type";

/// How a library's function receives its message.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Form {
    /// In one piece (Fast DDS 2.x).
    Whole,
    /// In a list of buffers (Fast DDS 3.x).
    List,
}

/// The loaded programs; their maps are in the [`Filter`] returned with them.
pub struct Probes(Ebpf);

/// The probe of one library; dropping it removes the breakpoint.
pub struct Probe {
    _link: UProbeLink,
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
    ) -> Result<(Self, Probes), FilterError> {
        if !Path::new(KIND).exists() {
            return Err(FilterError::Missing(
                "place to attach: uprobes are disabled",
            ));
        }
        let sizes = [
            ("PIECES", ring_size(settings.piece_ring_bytes)),
            ("FLOWS", UNUSED),
            ("SOCKETS", UNUSED),
            ("CONNECTIONS", UNUSED),
            ("CANDIDATES", UNUSED),
        ];
        let mut ebpf = open(settings, false, &sizes, None, within.unwrap_or(0))?;
        for form in [Form::Whole, Form::List] {
            program(&mut ebpf, form)?
                .load()
                .map_err(FilterError::program)?;
        }
        let program = program(&mut ebpf, Form::Whole)?
            .fd()
            .map_err(FilterError::Program)?
            .try_clone()
            .map_err(|error| FilterError::Program(ProgramError::IOError(error)))?;
        let mut filter = Self::with_maps(&mut ebpf, program, None)?;
        filter.pieces = Some(take(&mut ebpf, "PIECES")?);
        Ok((filter, Probes(ebpf)))
    }
}

impl Probes {
    /// Attaches to a library at an offset in its file: every call there is then seen.
    ///
    /// # Errors
    /// Returns [`FilterError::Probe`] without CAP_SYS_ADMIN, or if the offset is not an
    /// instruction.
    pub fn attach(&mut self, file: &File, offset: u64, form: Form) -> Result<Probe, FilterError> {
        // Refers to the inspected file, even if its path now names another one.
        let path = format!("/proc/self/fd/{}", file.as_raw_fd());
        let program = program(&mut self.0, form)?;
        let link = program
            .attach(offset, path, UProbeScope::AllProcesses)
            .and_then(|id| program.take_link(id))
            .map_err(FilterError::Probe)?;
        Ok(Probe { _link: link })
    }
}

fn program(ebpf: &mut Ebpf, form: Form) -> Result<&mut UProbe, FilterError> {
    let name = match form {
        Form::Whole => "shm_handed",
        Form::List => "shm_handed_list",
    };
    let program = ebpf.program_mut(name).ok_or(FilterError::Missing(name))?;
    program.try_into().map_err(FilterError::Program)
}
