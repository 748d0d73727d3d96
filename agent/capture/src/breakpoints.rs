//! Kernel programs attached to functions of a library, in every process that maps it.
//!
//! From Linux 6.6 on, one link covers all functions of a library. It is created and removed as fast
//! as for one function, and needs no capability beyond those for loading a program. Earlier kernels
//! need a perf event for each function, which requires CAP_SYS_ADMIN. The removal of an event takes
//! 0.1 s. The kernel removes links and events when their descriptors are closed, however this
//! process ends.
//!
//! This process loads the programs. The broker attaches them, and returns the descriptors.

use std::collections::HashSet;
use std::fs::File;
use std::os::fd::{AsFd as _, AsRawFd as _, BorrowedFd, OwnedFd};

use aya::Ebpf;
use aya::maps::{Map, MapData};
use aya::programs::UProbe;
use aya_obj::Object;
use ros2probe_attach::attach::{self, AttachError};
use ros2probe_attach::client::Broker;
use ros2probe_attach::functions::Calls;
use ros2probe_attach::request::Place;

use crate::bpf;
use crate::filter::FilterError;
use crate::uprobe::attachments::Refusal;

pub use ros2probe_attach::request::AttachMethod;

/// Returns 1 on kernels on which programs of uprobes may contain tail calls, else 0: the value of
/// `TAIL_CALLS` in the programs. AArch64 permits it from Linux 6.0 on.
pub(crate) fn permits_tail_calls() -> u32 {
    u32::from(AttachMethod::of_this_kernel() == AttachMethod::Links)
}

/// A program that tail-calls another one: the cookie of a function is its index in a program array.
#[derive(Clone, Copy)]
pub(crate) struct Dispatcher {
    pub(crate) program: &'static str,
    pub(crate) array: &'static str,
}

/// Loaded programs, and the remaining maps of their object.
pub(crate) struct Breakpoints {
    pub(crate) ebpf: Ebpf,
    /// Functions that have a loaded program.
    pub(crate) calls: Calls,
    method: AttachMethod,
    /// Programs for links, in the order of [`Calls::programs`]. Programs for perf events are in
    /// `ebpf`.
    linked: Vec<OwnedFd>,
    dispatching: Option<Dispatching>,
}

/// A loaded dispatcher.
struct Dispatching {
    program: OwnedFd,
    /// The kernel empties the array when it is closed.
    _array: MapData,
}

/// The breakpoints in one library; dropping the value removes them.
pub struct Attached {
    _descriptors: Vec<OwnedFd>,
    /// Names of the functions that the library has, as in [`Calls::programs`].
    pub functions: Vec<String>,
}

impl Breakpoints {
    /// Loads the programs of `calls` from an `object` whose maps are in `ebpf`. With links, it also
    /// loads `dispatcher`.
    pub(crate) fn load(
        mut ebpf: Ebpf,
        object: &[u8],
        calls: Calls,
        dispatcher: Option<Dispatcher>,
        means: AttachMethod,
    ) -> Result<Self, FilterError> {
        let names = calls.programs().into_iter().map(|(name, _)| name);
        if means == AttachMethod::PerfEvents {
            for name in names {
                let program = ebpf.program_mut(name).ok_or(FilterError::Missing(name))?;
                let program: &mut UProbe = program.try_into().map_err(FilterError::Program)?;
                program.load().map_err(FilterError::program)?;
            }
            return Ok(Self {
                ebpf,
                calls,
                method: means,
                linked: Vec::new(),
                dispatching: None,
            });
        }
        let relocated = Relocated::new(object, &ebpf)?;
        let linked = names.map(|name| relocated.load(name));
        let linked = linked.collect::<Result<Vec<_>, _>>()?;
        let dispatching = dispatcher.map(|Dispatcher { program, array }| {
            let Some(Map::ProgramArray(array)) = ebpf.take_map(array) else {
                return Err(FilterError::Missing(array));
            };
            for (index, program) in (0..).zip(&linked) {
                bpf::set_program(array.fd().as_fd(), index, program.as_fd())
                    .map_err(FilterError::breakpoint_program)?;
            }
            Ok(Dispatching {
                program: relocated.load(program)?,
                _array: array,
            })
        });
        Ok(Self {
            dispatching: dispatching.transpose()?,
            ebpf,
            calls,
            method: means,
            linked,
        })
    }

    /// Returns the loaded programs, in the order of [`Calls::programs`].
    pub(crate) fn programs(&self) -> Result<Vec<BorrowedFd<'_>>, FilterError> {
        if self.method == AttachMethod::Links {
            return Ok(self.linked.iter().map(|program| program.as_fd()).collect());
        }
        let programs = self.calls.programs().into_iter().map(|(name, _)| {
            let program = self.ebpf.program(name).ok_or(FilterError::Missing(name))?;
            let program: &UProbe = program.try_into().map_err(FilterError::Program)?;
            Ok(program.fd().map_err(FilterError::Program)?.as_fd())
        });
        programs.collect()
    }

    /// Lets the broker attach the programs to functions of a library. `calls` is the set for which
    /// the programs are loaded, or a subset.
    ///
    /// # Errors
    /// Returns [`Refusal`] if the broker refuses or cannot be reached.
    pub(crate) fn attach(
        &self,
        broker: &mut Broker,
        calls: Calls,
        place: Place,
    ) -> Result<Attached, Refusal> {
        let attached = match &self.dispatching {
            Some(dispatching) => {
                let programs = [dispatching.program.as_fd()];
                broker.attach((calls, place, self.method), &programs)
            }
            None => {
                let programs = self
                    .programs()
                    .map_err(|error| Refusal::Program(error.into()))?;
                broker.attach((calls, place, self.method), &programs)
            }
        };
        let (descriptors, functions) = attached?;
        Ok(Attached {
            _descriptors: descriptors,
            functions,
        })
    }

    /// Attaches the programs to functions of a file with the rights of this process, without a
    /// broker: for tests and examples.
    ///
    /// # Errors
    /// Fails as [`attach::attach`] does.
    pub(crate) fn attach_here(&self, calls: Calls, file: &File) -> Result<Attached, AttachError> {
        let programs = self.programs().unwrap_or_default();
        let dispatcher = self.dispatching.as_ref();
        let programs = match dispatcher.map(|dispatching| dispatching.program.as_fd()) {
            Some(program) => vec![program],
            None => programs,
        };
        let attached = attach::attach(file, calls, self.method, &programs)?;
        Ok(Attached {
            _descriptors: attached.descriptors,
            functions: attached.functions,
        })
    }
}

/// An object whose programs refer to loaded maps and types.
struct Relocated {
    object: Object,
    types: Option<OwnedFd>,
}

impl Relocated {
    fn new(object: &[u8], ebpf: &Ebpf) -> Result<Self, FilterError> {
        let failed = |error: aya::EbpfError| FilterError::Load(error);
        let mut object = Object::parse(object).map_err(|error| failed(error.into()))?;
        let types = match aya::features().btf() {
            Some(features) => {
                let types = object.fixup_and_sanitize_btf(features);
                types.map_err(|error| failed(error.into()))?
            }
            None => None,
        };
        let types = types.map(|types| bpf::load_types(&types.to_bytes()));
        let types = types.transpose().map_err(FilterError::breakpoint_program)?;
        let text = object.functions.keys().map(|(section, _)| *section);
        let text: HashSet<_> = text.collect();
        let maps = std::mem::take(&mut object.maps);
        let maps: Vec<_> = maps
            .iter()
            .filter_map(|(name, map)| {
                let loaded = data(ebpf.map(name)?)?;
                Some((name.as_str(), loaded.fd().as_fd().as_raw_fd(), map))
            })
            .collect();
        let relocated = object.relocate_maps(maps.into_iter(), &text);
        relocated.map_err(|error| failed(error.into()))?;
        let relocated = object.relocate_calls(&text);
        relocated.map_err(|error| failed(error.into()))?;
        Ok(Self { object, types })
    }

    fn load(&self, name: &'static str) -> Result<OwnedFd, FilterError> {
        let program = self.object.programs.get(name);
        let program = program.ok_or(FilterError::Missing(name))?;
        let function = self.object.functions.get(&program.function_key());
        let function = function.ok_or(FilterError::Missing(name))?;
        let types = self.types.as_ref().map(|types| types.as_fd());
        bpf::load_for_functions(name, function, &program.license, types)
            .map_err(FilterError::breakpoint_program)
    }
}

/// Returns the data of a map if the objects use maps of its type.
fn data(map: &Map) -> Option<&MapData> {
    match map {
        Map::Array(data)
        | Map::HashMap(data)
        | Map::LruHashMap(data)
        | Map::PerCpuArray(data)
        | Map::PerCpuHashMap(data)
        | Map::ProgramArray(data)
        | Map::RingBuf(data) => Some(data),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use aya_obj::ProgramSection;
    use aya_obj::generated::{BPF_CALL, BPF_JMP};

    use super::*;

    /// Number of the helper `bpf_tail_call`.
    const TAIL_CALL: i32 = 12;

    #[test]
    fn programs_of_uprobes_keep_their_frames_on_the_stack_of_their_task() {
        let objects: [&[u8]; 2] = [
            include_bytes!("filter.bpf.o"),
            include_bytes!("inside/inside.bpf.o"),
        ];
        let mut names = 0;
        for object in objects {
            let object = Object::parse(object).unwrap();
            for (name, program) in &object.programs {
                if !matches!(program.section, ProgramSection::UProbe { .. }) {
                    continue;
                }
                let function = &object.functions[&program.function_key()];
                let has_tail_call = function.instructions.iter().any(|instruction| {
                    let is_call = u32::from(instruction.code) == BPF_JMP | BPF_CALL;
                    is_call && instruction.src_reg() == 0 && instruction.imm == TAIL_CALL
                });
                assert!(has_tail_call, "{name}");
                names += 1;
            }
        }
        assert!(names > 20, "{names}");
    }
}
