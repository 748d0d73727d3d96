//! Constants that the loader sets before it loads the programs, and what some of them select: the
//! observed processes, and the stack of programs of uprobes.

use aya_ebpf::{
    helpers::generated::bpf_get_current_ancestor_cgroup_id, macros::map, maps::ProgramArray,
    programs::ProbeContext,
};

/// Maximum number of ancestor control groups that are compared.
const MAX_CGROUP_DEPTH: i32 = 16;

/// Id of the control group in or below which processes are observed; 0 = all processes. Set by the
/// loader.
#[unsafe(no_mangle)]
pub static WITHIN: u64 = 0;

/// Whether programs of uprobes may contain tail calls: on kernels with links for functions (Linux
/// 6.6), on every architecture. Set by the loader.
#[unsafe(no_mangle)]
pub static TAIL_CALLS: u32 = 0;

/// An array without programs, for [`keep_frames_of_task`].
#[map]
static NO_PROGRAMS: ProgramArray = ProgramArray::with_max_entries(1, 0);

/// Keeps the frames of a uprobe's program on the stack of the running task.
///
/// From Linux 6.13 on, the kernel moves large frames of these programs to memory of the CPU. It
/// also preempts the programs, so that two tasks would overwrite each other's variables. A program
/// with a tail call is excepted. This call finds no program and returns.
#[inline(always)]
pub fn keep_frames_of_task(context: &ProbeContext) {
    if read_global(&TAIL_CALLS) != 0 {
        // SAFETY: the context is the kernel's, and the array is empty.
        unsafe { NO_PROGRAMS.tail_call(context, 0) };
    }
}

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
