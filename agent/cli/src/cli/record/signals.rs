//! Signals that end a recording in order, and SIGUSR1, which writes the ring of `--snapshot-mode`.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicU8, Ordering};
use std::sync::mpsc::Sender;

use ros2probe_daemon::recording::Command;
use tokio::signal::unix::{SignalKind, signal};

use super::super::interrupt::EXIT_INTERRUPTED;
use super::keys::give_back;
use super::output::log;

/// Phase of a recording, shared with the signal thread.
#[derive(Clone)]
pub(super) struct Phase(Arc<AtomicU8>);

impl Phase {
    const STARTING: u8 = 0;
    const BEGUN: u8 = 1;
    const CANCELLED: u8 = 2;

    pub(super) fn starting() -> Self {
        Self(Arc::new(AtomicU8::new(Self::STARTING)))
    }

    /// Marks that a bag exists, so that a signal completes it.
    pub(super) fn begin(&self) {
        if !self.turn(Self::BEGUN) {
            // The process is about to end.
            loop {
                std::thread::park();
            }
        }
    }

    /// Cancels a recording that has not begun. Returns `false` if it has begun.
    fn cancel(&self) -> bool {
        self.turn(Self::CANCELLED)
    }

    fn turn(&self, into: u8) -> bool {
        let turned =
            self.0
                .compare_exchange(Self::STARTING, into, Ordering::AcqRel, Ordering::Acquire);
        turned.is_ok()
    }
}

/// Handles Ctrl-C and SIGTERM: the first ends the recording in order, the second skips slow steps,
/// and the third ends the process immediately. SIGUSR1 writes the messages in memory.
pub(super) fn listen(give: Sender<Command>, phase: Phase) -> io::Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_io()
        .build()?;
    let mut signals = {
        let _entered = runtime.enter();
        let kinds = [
            SignalKind::interrupt(),
            SignalKind::terminate(),
            SignalKind::user_defined1(),
        ];
        let [interrupt, terminate, user] = kinds.map(signal);
        (interrupt?, terminate?, user?)
    };
    let wait = async move {
        let mut stops = 0_u8;
        loop {
            let is_stop = tokio::select! {
                _ = signals.0.recv() => true,
                _ = signals.1.recv() => true,
                _ = signals.2.recv() => false,
            };
            stops = stops.saturating_add(u8::from(is_stop));
            let command = match stops {
                _ if !is_stop => Command::Snapshot,
                1 if phase.cancel() => {
                    log(
                        "INFO",
                        "Interrupted before the recording began; no bag was created",
                    );
                    std::process::exit(EXIT_INTERRUPTED.into());
                }
                1 => Command::Stop,
                2 => Command::Abort,
                _ => {
                    let text = "Interrupted; `rp bag reindex` completes the bag";
                    log("ERROR", text);
                    give_back();
                    std::process::exit(EXIT_INTERRUPTED.into());
                }
            };
            // A recording that has ended accepts no commands.
            let _ = give.send(command);
        }
    };
    let thread = std::thread::Builder::new().name("signals".to_owned());
    thread.spawn(move || runtime.block_on(wait)).map(drop)
}
