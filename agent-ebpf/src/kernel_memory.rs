//! Reads the kernel's own structures at offsets that the loader has resolved.
//!
//! A wrong address yields `None`, never a fault: the helper refuses it.

use core::mem::MaybeUninit;

use aya_ebpf::helpers::generated::bpf_probe_read_kernel;
use ros2probe_wire::host::Layout;

/// Offsets and enumerators, indexed by `host::Layout`. Set by the loader.
#[unsafe(no_mangle)]
pub static LAYOUT: [u32; Layout::COUNT] = [Layout::ABSENT; Layout::COUNT];

/// Returns the offset of a member, or an enumerator, in the running kernel; [`Layout::ABSENT`] if
/// it does not exist.
#[inline(always)]
pub fn layout_entry(entry: Layout) -> u32 {
    // SAFETY: an index below the array's length.
    let address = unsafe { (&raw const LAYOUT).cast::<u32>().add(entry as usize) };
    // SAFETY: a constant of the loaded object, never written while the program runs.
    unsafe { core::ptr::read_volatile(address) }
}

/// Reads the member `entry` of the structure at `address`.
#[inline(always)]
pub fn read_member<T: Copy>(address: u64, entry: Layout) -> Option<T> {
    read_kernel(address.wrapping_add(u64::from(layout_entry(entry))))
}

/// Reads a plain value from kernel memory.
#[inline(always)]
pub fn read_kernel<T: Copy>(address: u64) -> Option<T> {
    let mut value = MaybeUninit::<T>::uninit();
    // SAFETY: the destination has the size given; the kernel checks the address.
    let result = unsafe {
        bpf_probe_read_kernel(
            value.as_mut_ptr().cast(),
            size_of::<T>() as u32,
            address as *const _,
        )
    };
    if result != 0 {
        return None;
    }
    // SAFETY: the helper has filled all of it; only integers and arrays of them are read.
    Some(unsafe { value.assume_init() })
}
