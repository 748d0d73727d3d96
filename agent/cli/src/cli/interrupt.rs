//! Handles Ctrl-C: a verb ends immediately with the exit code of ros2cli. The code depends on verb
//! and distribution, and differs from that of a process ended by a signal.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, channel};

use rustix::process::Signal;
use tokio::signal::unix::{SignalKind, signal};

/// ros2cli's default exit code after Ctrl-C.
pub(crate) const EXIT_INTERRUPTED: u8 = 2;

/// Makes Ctrl-C end the process with `code`.
///
/// # Errors
///
/// Fails if the signal handler cannot be installed.
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

/// Returns a flag that the first Ctrl-C or SIGTERM sets. The second one ends the process.
///
/// # Errors
///
/// Fails if the signal handlers cannot be installed.
pub(crate) fn flag() -> io::Result<Arc<AtomicBool>> {
    let flag = Arc::new(AtomicBool::new(false));
    let is_set = Arc::clone(&flag);
    on_each_signal(move |_| {
        if is_set.swap(true, Ordering::Relaxed) {
            std::process::exit(EXIT_INTERRUPTED.into());
        }
        true
    })?;
    Ok(flag)
}

/// Returns SIGINT and SIGTERM as they arrive.
///
/// # Errors
///
/// Fails if the signal handlers cannot be installed.
pub(crate) fn signals() -> io::Result<Receiver<Signal>> {
    let (give, signals) = channel();
    on_each_signal(move |signal| give.send(signal).is_ok())?;
    Ok(signals)
}

/// Calls `act` on a thread for each SIGINT and SIGTERM, until it returns false.
fn on_each_signal(mut act: impl FnMut(Signal) -> bool + Send + 'static) -> io::Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_io()
        .build()?;
    let (mut interrupts, mut ends) = {
        let _entered = runtime.enter();
        (
            signal(SignalKind::interrupt())?,
            signal(SignalKind::terminate())?,
        )
    };
    let wait = async move {
        loop {
            let signal = tokio::select! {
                _ = interrupts.recv() => Signal::INT,
                _ = ends.recv() => Signal::TERM,
            };
            if !act(signal) {
                return;
            }
        }
    };
    let thread = std::thread::Builder::new().name("interrupt".to_owned());
    thread.spawn(move || runtime.block_on(wait)).map(drop)
}
