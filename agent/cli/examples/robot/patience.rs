//! Allows the process to be stopped and continued. SIGCONT, like a debugger, interrupts
//! `epoll_wait` with EINTR. RustDDS 0.15 treats EINTR as the end of its event loop and would never
//! receive again.

use std::ffi::c_int;

/// Replaces the C library's function in this program. Waits again after an interruption.
///
/// # Safety
/// The same as for `epoll_wait(2)`: `events` has space for `max_events`.
#[unsafe(no_mangle)]
unsafe extern "C" fn epoll_wait(
    epoll: c_int,
    events: *mut libc::epoll_event,
    max_events: c_int,
    timeout: c_int,
) -> c_int {
    loop {
        // SAFETY: the caller's arguments, unchanged; without a signal mask it equals epoll_wait.
        let ready =
            unsafe { libc::epoll_pwait(epoll, events, max_events, timeout, std::ptr::null()) };
        let interrupted = std::io::Error::last_os_error().kind() == std::io::ErrorKind::Interrupted;
        if ready >= 0 || !interrupted {
            return ready;
        }
    }
}
