//! Lets the process be stopped and continued. SIGCONT, like a debugger, ends a waiting `epoll_wait`
//! with EINTR, which RustDDS 0.15 takes for the end of its event loop: it would never receive again.

use std::ffi::c_int;

/// Takes the place of the C library's function in this program: waits again when interrupted.
///
/// # Safety
/// As of `epoll_wait(2)`: `events` has room for `max_events`.
#[unsafe(no_mangle)]
unsafe extern "C" fn epoll_wait(
    epoll: c_int,
    events: *mut libc::epoll_event,
    max_events: c_int,
    timeout: c_int,
) -> c_int {
    loop {
        // SAFETY: the caller's arguments, unchanged; without a signal mask it is epoll_wait.
        let ready =
            unsafe { libc::epoll_pwait(epoll, events, max_events, timeout, std::ptr::null()) };
        let interrupted = std::io::Error::last_os_error().kind() == std::io::ErrorKind::Interrupted;
        if ready >= 0 || !interrupted {
            return ready;
        }
    }
}
