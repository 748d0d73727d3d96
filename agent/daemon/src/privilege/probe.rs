//! Determines whether the owner of a map can change it without `CAP_BPF` on this kernel. Since
//! Linux 5.19 the owner can; earlier kernels allow it only if unprivileged BPF is enabled.
//!
//! A probe decides instead of the version, because distributions backport such changes.

use ros2probe_capture::bpf::failed_lookup;
use rustix::thread::CapabilitySet;

use super::capabilities::keep;

/// Returns whether updating a map needs `CAP_BPF`. A thread without privileges looks up an element
/// of a map that does not exist: the kernel checks `EPERM` before `EBADF`.
pub(super) fn map_updates_need_bpf() -> bool {
    let thread = std::thread::Builder::new().name("probe".to_owned());
    let probe = thread.spawn(|| {
        // A thread that could not drop its privileges proves nothing.
        keep(CapabilitySet::empty()).is_err() || failed_lookup().raw_os_error() == Some(libc::EPERM)
    });
    // A failed probe is treated as `CAP_BPF` required.
    probe.map_or(true, |probe| probe.join().unwrap_or(true))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn map_updates_need_cap_bpf_on_kernels_that_require_it() {
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
}
