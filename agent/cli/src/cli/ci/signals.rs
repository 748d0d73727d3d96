//! Signals to `rp ci`, which the command receives.

use std::io;
use std::sync::mpsc::{Receiver, channel};

use rustix::process::Signal;
use tokio::signal::unix::{SignalKind, signal};

/// Returns SIGINT and SIGTERM as they arrive.
///
/// # Errors
///
/// Fails if the signal handlers cannot be installed.
pub(super) fn listen() -> io::Result<Receiver<Signal>> {
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
    let (give, signals) = channel();
    let wait = async move {
        loop {
            let signal = tokio::select! {
                _ = interrupts.recv() => Signal::INT,
                _ = ends.recv() => Signal::TERM,
            };
            if give.send(signal).is_err() {
                return;
            }
        }
    };
    let thread = std::thread::Builder::new().name("signals".to_owned());
    thread.spawn(move || runtime.block_on(wait))?;
    Ok(signals)
}
