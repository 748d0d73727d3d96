//! Whether this kernel lets who holds a map change it without `CAP_BPF`: from Linux 5.19 on it does;
//! before, only where unprivileged BPF is not disabled.
//!
//! Asked of the kernel rather than of its version: distributions take such changes over.

use std::io;
use std::mem::size_of_val;

use super::capabilities::keep;

/// `BPF_MAP_LOOKUP_ELEM` of `linux/bpf.h`.
const LOOK_UP: libc::c_int = 1;

/// Tries, in a thread that has given up everything, to look up something in a map that does not
/// exist: whoever may not is told so before he is told that.
pub(super) fn map_updates_need_bpf() -> bool {
    let thread = std::thread::Builder::new().name("probe".to_owned());
    let probe = thread.spawn(|| {
        // A thread that could not give up has not tried anything.
        keep(|_| false).is_err() || probe_lookup().raw_os_error() == Some(libc::EPERM)
    });
    // No answer is no leave.
    probe.map_or(true, |probe| probe.join().unwrap_or(true))
}

/// Always fails.
fn probe_lookup() -> io::Error {
    // No descriptor has the number -1.
    let attributes = [u64::from(u32::MAX), 0, 0, 0_u64];
    // SAFETY: the attributes' size is given and they outlive the call; key and value are null, and
    // the kernel looks for the map before it looks at them.
    let found = unsafe {
        libc::syscall(
            libc::SYS_bpf,
            LOOK_UP,
            attributes.as_ptr(),
            size_of_val(&attributes),
        )
    };
    match found {
        0.. => io::Error::other("a map that does not exist was found"),
        _ => io::Error::last_os_error(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn capabilities_are_asked_for_where_the_kernel_asks_for_them() {
        let release = std::fs::read_to_string("/proc/sys/kernel/osrelease").unwrap();
        let mut numbers = release.split('.').map_while(|number| number.parse().ok());
        let version: (u32, u32) = (numbers.next().unwrap(), numbers.next().unwrap());
        let disabled = std::fs::read_to_string("/proc/sys/kernel/unprivileged_bpf_disabled");
        let is_open = disabled.is_ok_and(|disabled| disabled.trim() == "0");
        if version >= (5, 19) || is_open {
            assert!(!map_updates_need_bpf());
        } else {
            assert!(map_updates_need_bpf());
        }
    }

    #[test]
    fn what_does_not_exist_is_not_found() {
        let error = probe_lookup().raw_os_error();
        assert!(
            matches!(error, Some(libc::EBADF | libc::EPERM)),
            "{error:?}"
        );
    }
}
