//! Whether this kernel lets who holds a map change it without `CAP_BPF`: from Linux 5.19 on it does;
//! before, only where unprivileged BPF is not disabled.
//!
//! Asked of the kernel rather than of its version: distributions take such changes over.

use ros2probe_capture::bpf::failed_lookup;
use rustix::thread::CapabilitySet;

use super::capabilities::keep;

/// Tries, in a thread that has given up everything, to look up something in a map that does not
/// exist: the kernel checks `EPERM` before `EBADF`.
pub(super) fn map_updates_need_bpf() -> bool {
    let thread = std::thread::Builder::new().name("probe".to_owned());
    let probe = thread.spawn(|| {
        // A thread that could not give up has not tried anything.
        keep(CapabilitySet::empty()).is_err() || failed_lookup().raw_os_error() == Some(libc::EPERM)
    });
    // A failed probe is treated as `CAP_BPF` required.
    probe.map_or(true, |probe| probe.join().unwrap_or(true))
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
}
