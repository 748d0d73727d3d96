//! Constants that the loader sets before it loads the programs, and the processes that a constant
//! selects.

use aya_ebpf::helpers::generated::bpf_get_current_ancestor_cgroup_id;

/// Maximum number of ancestor control groups that are compared.
const MAX_CGROUP_DEPTH: i32 = 16;

/// Id of the control group in or below which processes are observed; 0 = all processes. Set by the
/// loader.
#[unsafe(no_mangle)]
pub static WITHIN: u64 = 0;

/// Reads a constant that the loader may have changed.
#[inline(always)]
pub fn read_global<T: Copy>(global: &'static T) -> T {
    // SAFETY: a constant of the loaded object, never written while the program runs.
    unsafe { core::ptr::read_volatile(global) }
}

/// Returns whether the running process is in the observed control group.
#[inline(always)]
pub fn is_in_target_cgroup() -> bool {
    let target = read_global(&WITHIN);
    if target == 0 {
        return true;
    }
    let mut level = 0;
    while level < MAX_CGROUP_DEPTH {
        // SAFETY: no preconditions.
        if unsafe { bpf_get_current_ancestor_cgroup_id(level) } == target {
            return true;
        }
        level += 1;
    }
    false
}
