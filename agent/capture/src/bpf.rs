//! The bpf system call, for commands that aya does not offer in the form needed here.

use std::ffi::CStr;
use std::io;
use std::os::fd::{AsRawFd as _, BorrowedFd, FromRawFd as _, OwnedFd};

use aya_obj::Function;
use libc::c_int;
use ros2probe_attach::kernel::TRACE_UPROBE_MULTI;

/// Commands of `linux/bpf.h`.
const MAP_LOOKUP_ELEM: c_int = 1;
const MAP_UPDATE_ELEM: c_int = 2;
const PROG_LOAD: c_int = 5;
const PROG_QUERY: c_int = 16;
const RAW_TRACEPOINT_OPEN: c_int = 17;
const BTF_LOAD: c_int = 18;
const LINK_CREATE: c_int = 28;
const ITER_CREATE: c_int = 33;

/// Type of programs attached to functions.
const PROG_TYPE_KPROBE: u32 = 2;

/// Attributes of `BPF_PROG_LOAD`.
#[repr(C)]
#[derive(Default)]
struct LoadAttributes {
    program_type: u32,
    instruction_count: u32,
    instructions: u64,
    license: u64,
    log_level: u32,
    log_bytes: u32,
    log: u64,
    kernel_version: u32,
    flags: u32,
    name: [u8; 16],
    interface: u32,
    attach_type: u32,
    types: u32,
    function_bytes: u32,
    functions: u64,
    function_count: u32,
    unused: u32,
}

/// Attributes of `BPF_BTF_LOAD`.
#[repr(C)]
#[derive(Default)]
struct TypesAttributes {
    types: u64,
    log: u64,
    bytes: u32,
    log_bytes: u32,
    log_level: u32,
    unused: u32,
}

/// Attributes of `BPF_MAP_UPDATE_ELEM`.
#[repr(C)]
struct UpdateAttributes {
    map: u32,
    unused: u32,
    key: u64,
    value: u64,
    flags: u64,
}

/// Loads types in BTF format.
///
/// # Errors
/// Fails if the kernel refuses them.
pub(crate) fn load_types(types: &[u8]) -> io::Result<OwnedFd> {
    let attributes = TypesAttributes {
        types: address(types.as_ptr()),
        bytes: length(types)?,
        ..TypesAttributes::default()
    };
    // SAFETY: the types outlive the call.
    unsafe { descriptor(BTF_LOAD, &attributes) }
}

/// Loads a program for [`link_functions`](ros2probe_attach::kernel::link_functions), which aya 0.14
/// cannot load. `license` is that of the object. Without `types` of the object, the kernel verifies
/// each global function with its callers.
///
/// # Errors
/// Fails if the verifier refuses the program, or if a capability is missing.
pub(crate) fn load_for_functions(
    name: &str,
    function: &Function,
    license: &CStr,
    types: Option<BorrowedFd<'_>>,
) -> io::Result<OwnedFd> {
    let functions = function.func_info.func_info_bytes();
    let mut attributes = LoadAttributes {
        program_type: PROG_TYPE_KPROBE,
        instruction_count: length(&function.instructions)?,
        instructions: address(function.instructions.as_ptr()),
        license: address(license.as_ptr()),
        attach_type: TRACE_UPROBE_MULTI,
        ..LoadAttributes::default()
    };
    // The last byte is the terminating zero.
    let name = name.bytes().take(attributes.name.len() - 1);
    for (to, from) in attributes.name.iter_mut().zip(name) {
        *to = from;
    }
    if let Some(types) = types {
        attributes.types = number(types);
        attributes.functions = address(functions.as_ptr());
        attributes.function_count = length(&function.func_info.func_info)?;
        attributes.function_bytes = u32::try_from(function.func_info_rec_size)
            .map_err(|_| io::Error::from(io::ErrorKind::InvalidInput))?;
    }
    // SAFETY: instructions, license and functions outlive the call.
    unsafe { descriptor(PROG_LOAD, &attributes) }
}

/// Sets an entry of an array of programs.
///
/// # Errors
/// Fails if the program cannot be called from the programs that use the array.
pub(crate) fn set_program(
    array: BorrowedFd<'_>,
    index: u32,
    program: BorrowedFd<'_>,
) -> io::Result<()> {
    let value = number(program);
    let attributes = UpdateAttributes {
        map: number(array),
        unused: 0,
        key: address(&raw const index),
        value: address(&raw const value),
        flags: 0,
    };
    // SAFETY: key and value outlive the call, and have the sizes of such an array.
    unsafe { call(MAP_UPDATE_ELEM, &attributes) }.map(drop)
}

/// Links a program to a target for an attach type, without flags. Closing the descriptor removes
/// the link.
///
/// # Errors
/// Fails if the kernel refuses the link.
pub(crate) fn create_link(program: u32, target: u32, attach_type: u32) -> io::Result<OwnedFd> {
    // SAFETY: the attributes contain no pointer.
    unsafe { descriptor(LINK_CREATE, &[program, target, attach_type, 0]) }
}

/// Links a program to an interface of the calling thread's network namespace, in front of the
/// programs that it has. Closing the descriptor removes the link.
///
/// # Errors
/// Fails if the kernel refuses the link, or if the interface is gone (`ENODEV`).
pub(crate) fn create_first_link(
    program: BorrowedFd<'_>,
    interface: u32,
    attach_type: u32,
) -> io::Result<OwnedFd> {
    /// `BPF_F_BEFORE`; without another program, the position is the first one.
    const BEFORE: u32 = 1 << 3;
    // SAFETY: the attributes contain no pointer.
    unsafe {
        descriptor(
            LINK_CREATE,
            &[number(program), interface, attach_type, BEFORE],
        )
    }
}

/// Returns the number of programs that an interface of the calling thread's network namespace has
/// for an attach type.
///
/// # Errors
/// Fails if the kernel does not know the attach type (`EINVAL`), or without CAP_NET_ADMIN.
pub fn count_programs(interface: u32, attach_type: u32) -> io::Result<u32> {
    /// Attributes of `BPF_PROG_QUERY`.
    #[repr(C)]
    #[derive(Default)]
    struct Query {
        target: u32,
        attach_type: u32,
        query_flags: u32,
        attach_flags: u32,
        programs: u64,
        count: u32,
        unused: u32,
        program_flags: u64,
        links: u64,
        link_flags: u64,
        revision: u64,
    }
    let mut query = Query {
        target: interface,
        attach_type,
        ..Query::default()
    };
    // SAFETY: the kernel writes only to the attributes, because every pointer in them is null. They
    // outlive the call, and are passed with their size.
    unsafe { call_mut(PROG_QUERY, &mut query) }?;
    Ok(query.count)
}

/// Runs a program at a tracepoint, such as `sched_switch`. Closing the descriptor ends it.
///
/// # Errors
/// Fails if the kernel has no such tracepoint, or refuses.
pub(crate) fn open_tracepoint(name: &CStr, program: BorrowedFd<'_>) -> io::Result<OwnedFd> {
    let attributes = [address(name.as_ptr()), u64::from(number(program))];
    // SAFETY: the name outlives the call.
    unsafe { descriptor(RAW_TRACEPOINT_OPEN, &attributes) }
}

/// Starts one run of a linked iterator.
///
/// # Errors
/// Fails if the kernel refuses the iterator.
pub(crate) fn create_iterator(link: u32) -> io::Result<OwnedFd> {
    // SAFETY: the attributes contain no pointer.
    unsafe { descriptor(ITER_CREATE, &[link, 0]) }
}

/// Looks up an element of a map that does not exist. Returns the error: `EPERM`, which the kernel
/// checks first, if the calling thread may not use maps, otherwise `EBADF`.
#[must_use]
pub fn failed_lookup() -> io::Error {
    // -1 is never a valid descriptor; key and value are null.
    let attributes = [u32::MAX, 0, 0, 0, 0, 0, 0, 0];
    // SAFETY: the attributes contain no pointer other than null.
    match unsafe { call(MAP_LOOKUP_ELEM, &attributes) } {
        Ok(_) => io::Error::other("a map that does not exist was found"),
        Err(error) => error,
    }
}

fn address<T>(pointer: *const T) -> u64 {
    pointer.expose_provenance() as u64
}

fn number(descriptor: BorrowedFd<'_>) -> u32 {
    descriptor.as_raw_fd().cast_unsigned()
}

fn length<T>(slice: &[T]) -> io::Result<u32> {
    u32::try_from(slice.len()).map_err(|_| io::ErrorKind::InvalidInput.into())
}

/// Calls a command that returns a new descriptor.
///
/// # Safety
/// The conditions are those of [`call`].
unsafe fn descriptor<T>(command: c_int, attributes: &T) -> io::Result<OwnedFd> {
    // SAFETY: the caller meets the conditions of `call`.
    let descriptor = unsafe { call(command, attributes) }?;
    // SAFETY: the command returns a new descriptor, which nothing else owns.
    Ok(unsafe { OwnedFd::from_raw_fd(descriptor) })
}

/// Calls a command that also writes to its attributes.
///
/// # Safety
/// The conditions are those of [`call`].
unsafe fn call_mut<T>(command: c_int, attributes: &mut T) -> io::Result<c_int> {
    // SAFETY: as in `call`.
    let result =
        unsafe { libc::syscall(libc::SYS_bpf, command, &raw mut *attributes, size_of::<T>()) };
    match c_int::try_from(result) {
        Ok(result @ 0..) => Ok(result),
        _ => Err(io::Error::last_os_error()),
    }
}

/// Calls a command with its attributes. The kernel treats attributes beyond the passed size as
/// zero.
///
/// # Safety
/// Pointers in the attributes are null, or refer to as much memory as the command reads.
unsafe fn call<T>(command: c_int, attributes: &T) -> io::Result<c_int> {
    // SAFETY: the attributes' size is passed; the caller ensures the rest.
    let result = unsafe {
        libc::syscall(
            libc::SYS_bpf,
            command,
            &raw const *attributes,
            size_of::<T>(),
        )
    };
    match c_int::try_from(result) {
        Ok(result @ 0..) => Ok(result),
        _ => Err(io::Error::last_os_error()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lookup_without_a_map_fails_with_ebadf_or_eperm() {
        let error = failed_lookup().raw_os_error();
        assert!(
            matches!(error, Some(libc::EBADF | libc::EPERM)),
            "{error:?}"
        );
    }
}
