//! Arguments of a call, from the registers that the kernel saved at its entry.

use crate::settings::read_global;

/// Architecture of the saved registers: 0 = x86-64, 1 = AArch64. Set by the loader.
#[unsafe(no_mangle)]
pub static ARCHITECTURE: u32 = 0;

/// Value of [`ARCHITECTURE`] for AArch64.
pub const AARCH64: u32 = 1;

/// Reads a register at this offset of the program's context, in one instruction, because the
/// verifier requires a constant offset.
macro_rules! register {
    ($registers:expr, $place:literal) => {{
        let value: u64;
        // SAFETY: reads the program's context, of which the verifier allows every register.
        unsafe {
            core::arch::asm!(
                concat!("{0} = *(u64 *)({1} + ", $place, ")"),
                out(reg) value,
                in(reg) $registers,
                options(readonly, nostack, preserves_flags),
            );
        }
        value
    }};
}
pub(crate) use register;

/// Returns whether the registers are those of AArch64.
#[inline(always)]
pub fn is_aarch64() -> bool {
    read_global(&ARCHITECTURE) == AARCH64
}
