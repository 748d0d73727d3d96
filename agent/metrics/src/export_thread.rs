//! Threads that push to receivers on the network.

use std::io;
use std::thread::{self, JoinHandle};
use std::time::Duration;

use tokio::sync::oneshot;
use tokio::time::timeout;
use tokio_util::sync::CancellationToken;

/// Maximum time to stop, whatever the receiver does.
const STOP_TIMEOUT: Duration = Duration::from_secs(2);

/// Starts a thread with only the privileges of exports, and returns after all other privileges are
/// dropped.
///
/// Fails if the system cannot create the thread, or if the thread cannot be confined.
pub type Spawn = fn(thread::Builder, Box<dyn FnOnce() + Send>) -> io::Result<JoinHandle<()>>;

/// A running thread.
pub struct ExportThread {
    thread: JoinHandle<()>,
    stop: CancellationToken,
    ended: oneshot::Receiver<()>,
}

impl ExportThread {
    /// Starts a thread, which ends soon after `stop`.
    ///
    /// # Errors
    ///
    /// Fails like [`Spawn`].
    pub fn start(
        name: &str,
        stop: CancellationToken,
        spawn: Spawn,
        work: impl FnOnce() + Send + 'static,
    ) -> io::Result<Self> {
        let (end, ended) = oneshot::channel();
        let work = move || {
            work();
            let _ = end.send(());
        };
        let thread = spawn(thread::Builder::new().name(name.to_owned()), Box::new(work))?;
        Ok(Self {
            thread,
            stop,
            ended,
        })
    }

    /// Lets the thread export a last time.
    pub fn stop(&self) {
        self.stop.cancel();
    }

    /// Exports a last time and stops, within two seconds.
    pub async fn finish(self) {
        self.stop();
        if timeout(STOP_TIMEOUT, self.ended).await.is_err() {
            tracing::warn!("the last export did not end in time");
        } else if self.thread.join().is_err() {
            tracing::error!("the exporting thread panicked");
        }
    }
}
