//! Ctrl-C: a verb ends at once with the exit code of the original, which differs by verb and
//! distribution and is not that of a process that a signal ended.

use std::io;

use tokio::signal::unix::{SignalKind, signal};

/// What the original answers to Ctrl-C by default.
pub(crate) const INTERRUPTED: u8 = 2;

/// From now on Ctrl-C ends the process with this code.
///
/// # Errors
/// Signals cannot be listened to.
pub(crate) fn listen(code: u8) -> io::Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_io()
        .build()?;
    let mut interrupts = {
        let _entered = runtime.enter();
        signal(SignalKind::interrupt())?
    };
    let wait = move || {
        runtime.block_on(interrupts.recv());
        super::notes::end();
        std::process::exit(code.into());
    };
    let thread = std::thread::Builder::new().name("interrupt".to_owned());
    thread.spawn(wait).map(drop)
}
