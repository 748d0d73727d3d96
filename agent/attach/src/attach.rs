//! Attaches programs to the functions of a library's file.

use std::collections::BTreeMap;
use std::ffi::CString;
use std::fs::{self, File};
use std::io;
use std::os::fd::{AsRawFd as _, BorrowedFd, OwnedFd};

use crate::functions::{Calls, symbol};
use crate::kernel;
use crate::library::{self, LibraryError};
use crate::request::AttachMethod;

/// File with the kernel's type of perf events for uprobes. Older interfaces leave probes behind
/// when a process is killed.
const UPROBE_TYPE_PATH: &str = "/sys/bus/event_source/devices/uprobe/type";

/// Why programs are not attached.
#[derive(Debug, thiserror::Error)]
pub enum AttachError {
    /// The library is malformed, or lacks the function.
    #[error(transparent)]
    Library(#[from] LibraryError),
    /// The library has no functions to attach to.
    #[error("it exports neither ros_trace_rcl_publish nor ros_trace_rmw_take")]
    NoFunctions,
    /// The received programs are not those that the functions need.
    #[error("expected {expected} BPF programs, received {given}")]
    Programs {
        /// Number of programs that the request needs.
        expected: usize,
        /// Number of received programs.
        given: usize,
    },
    /// The kernel has no uprobes.
    #[error("the kernel has no uprobes (CONFIG_UPROBE_EVENTS)")]
    NoUprobes(#[source] io::Error),
    /// The kernel refuses the breakpoints.
    #[error("the kernel refuses the breakpoints")]
    Kernel(#[source] io::Error),
}

/// Breakpoints in one library.
#[derive(Debug)]
pub struct Attached {
    /// Descriptors of the breakpoints; closing them removes the breakpoints.
    pub descriptors: Vec<OwnedFd>,
    /// Names of the functions that the library has.
    pub functions: Vec<String>,
}

/// Attaches programs to the functions of `calls` that a library has. With links, `programs` is only
/// the one that calls the others. With perf events, and for shared memory, there is one for each
/// entry of [`Calls::programs`].
///
/// # Errors
/// Fails if the library has none of the functions, or if the kernel refuses.
pub fn attach(
    file: &File,
    calls: Calls,
    means: AttachMethod,
    programs: &[BorrowedFd<'_>],
) -> Result<Attached, AttachError> {
    let (expected, given) = (calls.expected(means), programs.len());
    if expected != given {
        return Err(AttachError::Programs { expected, given });
    }
    let found = places(file, calls)?;
    let functions = found.values().map(|place| place.function.to_owned());
    let functions = functions.collect();
    // This path refers to the inspected file, even if the file's own path now names another one.
    let path = format!("/proc/self/fd/{}", file.as_raw_fd());
    let path = CString::new(path).map_err(|error| AttachError::Kernel(error.into()))?;
    let program = |index: usize| programs.get(index).copied();
    let descriptors = match means {
        AttachMethod::Links if expected == 1 => {
            let offsets: Vec<_> = found.values().map(|place| place.offset).collect();
            let cookies: Vec<_> = found.keys().map(|index| *index as u64).collect();
            let program = program(0).ok_or(AttachError::Programs { expected, given })?;
            let link = kernel::link_functions(program, &path, &offsets, &cookies);
            vec![link.map_err(AttachError::Kernel)?]
        }
        AttachMethod::Links => {
            let links = found.iter().filter_map(|(index, place)| {
                let program = program(*index)?;
                Some(kernel::link_functions(
                    program,
                    &path,
                    &[place.offset],
                    &[0],
                ))
            });
            links
                .collect::<io::Result<_>>()
                .map_err(AttachError::Kernel)?
        }
        AttachMethod::PerfEvents => {
            let kind = fs::read_to_string(UPROBE_TYPE_PATH).map_err(AttachError::NoUprobes)?;
            let kind = kind.trim().parse().map_err(io::Error::other);
            let kind = kind.map_err(AttachError::NoUprobes)?;
            let events = found.iter().filter_map(|(index, place)| {
                let program = program(*index)?;
                Some(kernel::probe_function(program, kind, &path, place.offset))
            });
            events
                .collect::<io::Result<_>>()
                .map_err(AttachError::Kernel)?
        }
    };
    Ok(Attached {
        descriptors,
        functions,
    })
}

/// A function of a library.
struct Place {
    function: &'static str,
    offset: u64,
}

/// Returns the functions that a library has, by the index of their program.
fn places(file: &File, calls: Calls) -> Result<BTreeMap<usize, Place>, AttachError> {
    let programs = calls.programs();
    if calls == Calls::SharedMemory {
        let entry = library::find(file)?;
        let parameters = entry.form.parameters();
        let mut programs = programs.into_iter().enumerate();
        let found = programs.find(|(_, (_, function))| *function == parameters);
        let (index, (_, function)) = found.ok_or(LibraryError::NoSymbol)?;
        let offset = entry.offset;
        return Ok(BTreeMap::from([(index, Place { function, offset })]));
    }
    let symbols: Vec<_> = programs
        .iter()
        .map(|(_, function)| symbol(function))
        .collect();
    let symbols: Vec<_> = symbols.iter().map(String::as_str).collect();
    let offsets = library::functions(file, &symbols)?;
    let found = || programs.iter().zip(&offsets);
    let has = |wanted: &str| found().any(|((_, each), at)| *each == wanted && at.is_some());
    if !has("rcl_publish") && !has("rmw_take") {
        return Err(AttachError::NoFunctions);
    }
    let found = found()
        .enumerate()
        .filter_map(|(index, ((program, function), offset))| {
            let offset = (*offset)?;
            let is_chosen = calls.includes(function) && !Calls::excludes(program, has);
            is_chosen.then_some((index, Place { function, offset }))
        });
    Ok(found.collect())
}
