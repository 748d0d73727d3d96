//! Starts this program again if it does not become ready. RustDDS 0.15 seldom hangs at its start: of
//! about 10,000 participants on a busy machine, one was not ready after a minute.

use std::io;
use std::os::unix::process::CommandExt as _;
use std::process::Command;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

/// Time in which a participant becomes ready on a busy machine.
const PATIENCE: Duration = Duration::from_secs(20);

static IS_READY: AtomicBool = AtomicBool::new(false);

/// Prints that the program is ready.
pub(crate) fn ready() {
    IS_READY.store(true, Ordering::Release);
    println!("ready");
}

/// Replaces this process by a new one if it is not [`ready`] in time.
///
/// # Errors
/// Fails if no thread can be started.
pub(crate) fn watch() -> io::Result<()> {
    let thread = std::thread::Builder::new().name("start".to_owned());
    let watched = thread.spawn(|| {
        std::thread::sleep(PATIENCE);
        if IS_READY.load(Ordering::Acquire) {
            return;
        }
        eprintln!("robot: RustDDS is not ready after {PATIENCE:?}; starting again");
        let mut again = Command::new("/proc/self/exe");
        let error = again.args(std::env::args_os().skip(1)).exec();
        eprintln!("robot: cannot start again: {error}");
    });
    watched.map(drop)
}
