//! Counts the heap bytes of a test exactly. A test binary has one global allocator, so it counts
//! per thread, and concurrent tests do not affect each other.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

thread_local! {
    static HELD: Cell<isize> = const { Cell::new(0) };
}

struct Counting;

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Returns the bytes that this thread has allocated, minus those it has freed.
pub(crate) fn held() -> usize {
    usize::try_from(HELD.get()).unwrap_or(0)
}

fn count(bytes: isize) {
    HELD.set(HELD.get().wrapping_add(bytes));
}

// SAFETY: all calls are forwarded to the system's allocator. The counter has no destructor and no
// lazy initialization, so counting allocates nothing.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count(layout.size().cast_signed());
        // SAFETY: the caller satisfies the contract of `alloc`.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // A thread may free memory that another one allocated.
        count(-layout.size().cast_signed());
        // SAFETY: the caller satisfies the contract of `dealloc`.
        unsafe { System.dealloc(pointer, layout) }
    }
}
