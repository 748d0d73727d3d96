//! Kernel programs at functions of a library, in every process that maps it.
//!
//! Linux 6.6 has one link for all functions of a library: it is created and removed in the time of
//! one function, and needs no capability beyond those that load a program. Earlier kernels have a
//! perf event for each function, which now needs CAP_SYS_ADMIN, and of which each removal takes
//! 0.1 s. Either is removed by the kernel when its descriptor is closed, however this process ends.

use std::collections::{BTreeMap, HashSet};
use std::ffi::{CStr, CString};
use std::fs::File;
use std::io;
use std::os::fd::{AsFd as _, AsRawFd as _, BorrowedFd, OwnedFd};
use std::path::Path;

use aya::Ebpf;
use aya::maps::{Map, MapData};
use aya::programs::UProbe;
use aya::programs::uprobe::{UProbeLink, UProbeScope};
use aya_obj::Object;

use crate::bpf;
use crate::filter::FilterError;
use crate::tracepoints::release;

/// File in which the kernel announces uprobes. Without it aya falls back to older interfaces, whose
/// probes outlive a killed process.
const KIND: &str = "/sys/bus/event_source/devices/uprobe/type";
/// First release with links of many functions.
const HAS_LINKS: (u32, u32) = (6, 6);

/// How programs are put at functions.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Means {
    /// One link for all functions of a library.
    Links,
    /// One perf event for each function.
    PerfEvents,
}

impl Means {
    /// Returns the best that this kernel has.
    #[must_use]
    pub fn of_this_kernel() -> Self {
        match release() {
            Some(release) if release >= HAS_LINKS => Self::Links,
            _ => Self::PerfEvents,
        }
    }
}

/// A program that calls the others by the cookie of a function: their place in an array.
#[derive(Clone, Copy)]
pub(crate) struct Dispatcher {
    pub(crate) program: &'static str,
    pub(crate) array: &'static str,
}

/// Programs in the kernel, and the maps that remain of their object.
pub(crate) struct Breakpoints {
    pub(crate) ebpf: Ebpf,
    /// The programs, unless aya has loaded them.
    links: Option<Linked>,
}

/// Programs for links.
struct Linked {
    programs: BTreeMap<&'static str, OwnedFd>,
    dispatching: Option<Dispatching>,
}

/// A loaded dispatcher.
struct Dispatching {
    program: OwnedFd,
    /// The kernel empties it when it is closed.
    _array: MapData,
}

/// The breakpoints in one library; dropping them removes them.
pub(crate) enum Attached {
    /// One link, or one for each program without a dispatcher.
    Links { _links: Vec<OwnedFd> },
    /// One perf event for each function.
    PerfEvents { _links: Vec<UProbeLink> },
}

impl Breakpoints {
    /// Loads `names` of an `object` whose maps are in `ebpf`, and with links also `dispatcher`.
    pub(crate) fn load(
        mut ebpf: Ebpf,
        object: &[u8],
        names: impl Iterator<Item = &'static str>,
        dispatcher: Option<Dispatcher>,
        means: Means,
    ) -> Result<Self, FilterError> {
        if !Path::new(KIND).exists() {
            return Err(FilterError::Missing(
                "place to attach: uprobes are disabled",
            ));
        }
        if means == Means::PerfEvents {
            for name in names {
                uprobe(&mut ebpf, name)?
                    .load()
                    .map_err(FilterError::program)?;
            }
            return Ok(Self { ebpf, links: None });
        }
        let relocated = Relocated::new(object, &ebpf)?;
        let programs = names
            .map(|name| Ok((name, relocated.load(name)?)))
            .collect::<Result<BTreeMap<_, _>, FilterError>>()?;
        let dispatching = dispatcher.map(|Dispatcher { program, array }| {
            let Some(Map::ProgramArray(array)) = ebpf.take_map(array) else {
                return Err(FilterError::Missing(array));
            };
            for (index, program) in (0..).zip(programs.values()) {
                bpf::set_program(array.fd().as_fd(), index, program.as_fd())
                    .map_err(FilterError::breakpoint_program)?;
            }
            Ok(Dispatching {
                program: relocated.load(program)?,
                _array: array,
            })
        });
        let links = Some(Linked {
            dispatching: dispatching.transpose()?,
            programs,
        });
        Ok(Self { ebpf, links })
    }

    /// Returns a loaded program.
    pub(crate) fn program(&self, name: &'static str) -> Result<BorrowedFd<'_>, FilterError> {
        match &self.links {
            Some(links) => links.program(name),
            None => {
                let program = self.ebpf.program(name).ok_or(FilterError::Missing(name))?;
                let program: &UProbe = program.try_into().map_err(FilterError::Program)?;
                Ok(program.fd().map_err(FilterError::Program)?.as_fd())
            }
        }
    }

    /// Puts programs at offsets in a library's file.
    ///
    /// # Errors
    /// Returns [`FilterError::Probe`] or [`FilterError::Breakpoint`] if the kernel refuses one.
    pub(crate) fn attach(
        &mut self,
        file: &File,
        places: &[(&'static str, u64)],
    ) -> Result<Attached, FilterError> {
        // Refers to the inspected file, even if its path now names another one.
        let path = format!("/proc/self/fd/{}", file.as_raw_fd());
        if let Some(links) = &self.links {
            let path = CString::new(path).map_err(io::Error::from);
            return links.attach(&path.map_err(FilterError::Breakpoint)?, places);
        }
        let mut links = Vec::new();
        for (name, offset) in places {
            let program = uprobe(&mut self.ebpf, name)?;
            let link = program
                .attach(*offset, &path, UProbeScope::AllProcesses)
                .and_then(|id| program.take_link(id))
                .map_err(FilterError::Probe)?;
            links.push(link);
        }
        Ok(Attached::PerfEvents { _links: links })
    }
}

impl Linked {
    fn program(&self, name: &'static str) -> Result<BorrowedFd<'_>, FilterError> {
        let program = self.programs.get(name);
        Ok(program.ok_or(FilterError::Missing(name))?.as_fd())
    }

    fn attach(&self, path: &CStr, places: &[(&'static str, u64)]) -> Result<Attached, FilterError> {
        let link = |program: BorrowedFd<'_>, offsets: &[u64], cookies: &[u64]| {
            bpf::link_functions(program, path, offsets, cookies).map_err(FilterError::Breakpoint)
        };
        let Some(dispatching) = &self.dispatching else {
            let links = places
                .iter()
                .map(|(name, offset)| link(self.program(name)?, &[*offset], &[0]));
            let links = links.collect::<Result<_, _>>()?;
            return Ok(Attached::Links { _links: links });
        };
        let mut offsets = Vec::new();
        let mut cookies = Vec::new();
        for (cookie, name) in (0..).zip(self.programs.keys()) {
            let places = places.iter().filter(|(each, _)| each == name);
            for (_, offset) in places {
                offsets.push(*offset);
                cookies.push(cookie);
            }
        }
        let link = link(dispatching.program.as_fd(), &offsets, &cookies)?;
        Ok(Attached::Links { _links: vec![link] })
    }
}

fn uprobe<'a>(ebpf: &'a mut Ebpf, name: &'static str) -> Result<&'a mut UProbe, FilterError> {
    let program = ebpf.program_mut(name).ok_or(FilterError::Missing(name))?;
    program.try_into().map_err(FilterError::Program)
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

/// Returns the data of a map of the kinds that the objects use.
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
