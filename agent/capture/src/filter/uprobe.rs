//! The probe on Fast DDS's way into shared memory, from user space: load it, attach it to libraries.
//!
//! Attached to a library's file, it puts a breakpoint into the code of every process that maps it,
//! and takes it out again: the kernel does both, also when this process is killed, because a probe
//! lives as long as its descriptor. Nothing is written to `uprobe_events`.

use std::fs::File;
use std::os::fd::AsRawFd as _;
use std::path::Path;

use aya::Ebpf;
use aya::programs::uprobe::{UProbeLink, UProbeScope};
use aya::programs::{ProgramError, UProbe};

use super::{Filter, FilterError, FilterSettings, UNUSED, open, ring_size, take};

/// Where the kernel says that it has probes of this kind. Without it older ways would be tried,
/// which outlive a process that is killed.
const KIND: &str = "/sys/bus/event_source/devices/uprobe/type";

/// How a library's function gets its message.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Form {
    /// In one piece (Fast DDS 2.x).
    Whole,
    /// In a list of buffers (Fast DDS 3.x).
    List,
}

/// The programs, to be attached; the maps are with the [`Filter`] of the same call.
pub struct Probes(Ebpf);

/// One library's; the breakpoint goes with it.
pub struct Probe {
    _link: UProbeLink,
}

impl Filter {
    /// Loads the programs for messages into shared memory, and their maps; attaches them to nothing.
    /// `within`: only what processes of this control group send, by the inode of its directory.
    ///
    /// # Errors
    /// [`FilterError::NotPermitted`] without the capabilities, others when the kernel refuses them.
    pub fn load_uprobe(
        settings: &FilterSettings,
        within: Option<u64>,
    ) -> Result<(Self, Probes), FilterError> {
        if !Path::new(KIND).exists() {
            return Err(FilterError::Missing("place to attach to: no uprobes"));
        }
        let sizes = [
            ("PIECES", ring_size(settings.piece_ring_bytes)),
            ("FLOWS", UNUSED),
            ("SOCKETS", UNUSED),
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
    /// Attaches to a library at an offset in its file: from now on every call there is seen.
    ///
    /// # Errors
    /// [`FilterError::Probe`] without CAP_SYS_ADMIN, or when no instruction is there.
    pub fn attach(&mut self, file: &File, offset: u64, form: Form) -> Result<Probe, FilterError> {
        // The very file that was looked at, whatever its name means by now.
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
