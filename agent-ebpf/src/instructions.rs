//! Single instructions that the optimizer leaves as they are.

use core::arch::asm;

/// Adds to a field of a map value atomically.
#[inline(always)]
pub fn atomic_add(to: *mut u64, by: u64) {
    // SAFETY: `to` is a field of a map value. Without a returned value this is an instruction that
    // every BPF verifier accepts.
    unsafe {
        asm!("lock *(u64 *)({to} + 0) += {by}", to = in(reg) to, by = in(reg) by, options(nostack));
    }
}

/// Returns the same number with its bounds hidden from the optimizer. So the optimizer keeps a mask
/// that follows, and every verifier sees the mask.
#[inline(always)]
pub fn hide_bounds(value: u32) -> u64 {
    let mut value = u64::from(value);
    // The assembly must not be empty: the verifier refuses line information without an instruction.
    // SAFETY: changes nothing.
    unsafe { asm!("{0} = {0}", inout(reg) value, options(pure, nomem, nostack, preserves_flags)) }
    value
}
