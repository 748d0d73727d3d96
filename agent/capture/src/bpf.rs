//! The bpf system call, for commands that aya does not offer in the form needed here.

use std::io;
use std::os::fd::{FromRawFd as _, OwnedFd};

use libc::c_int;

/// Commands of `linux/bpf.h`.
const MAP_LOOKUP_ELEM: c_int = 1;
const LINK_CREATE: c_int = 28;
const ITER_CREATE: c_int = 33;

/// Links a program to a target for an attach type, without flags. Closing the descriptor removes
/// the link.
///
/// # Errors
/// Fails if the kernel refuses the link.
pub(crate) fn create_link(program: u32, target: u32, attach_type: u32) -> io::Result<OwnedFd> {
    descriptor(LINK_CREATE, &[program, target, attach_type, 0])
}

/// Starts one run of a linked iterator.
///
/// # Errors
/// Fails if the kernel refuses the iterator.
pub(crate) fn create_iterator(link: u32) -> io::Result<OwnedFd> {
    descriptor(ITER_CREATE, &[link, 0])
}

/// Looks up an element of a map that does not exist. Returns the error: `EPERM`, which the kernel
/// checks first, if the calling thread may not use maps, otherwise `EBADF`.
#[must_use]
pub fn failed_lookup() -> io::Error {
    // -1 is never a valid descriptor; key and value are null.
    let attributes = [u32::MAX, 0, 0, 0, 0, 0, 0, 0];
    match call(MAP_LOOKUP_ELEM, &attributes) {
        Ok(_) => io::Error::other("a map that does not exist was found"),
        Err(error) => error,
    }
}

fn descriptor(command: c_int, attributes: &[u32]) -> io::Result<OwnedFd> {
    let descriptor = call(command, attributes)?;
    // SAFETY: both commands return a new descriptor, which nothing else owns.
    Ok(unsafe { OwnedFd::from_raw_fd(descriptor) })
}

/// Calls a command whose attributes are words without pointers other than null.
fn call(command: c_int, attributes: &[u32]) -> io::Result<c_int> {
    // SAFETY: the attributes' size is passed, and the kernel treats attributes beyond it as zero.
    let result = unsafe {
        libc::syscall(
            libc::SYS_bpf,
            command,
            attributes.as_ptr(),
            size_of_val(attributes),
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
    fn what_does_not_exist_is_not_found() {
        let error = failed_lookup().raw_os_error();
        assert!(
            matches!(error, Some(libc::EBADF | libc::EPERM)),
            "{error:?}"
        );
    }
}
