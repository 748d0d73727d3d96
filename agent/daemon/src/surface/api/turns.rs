//! Blocking work of requests, which takes turns.

use std::time::Duration;

use tokio::sync::Semaphore;
use tokio::task::spawn_blocking;
use tokio::time::timeout;

/// Why the work of a request has no result.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum NoResult {
    /// It takes too long.
    Late,
    /// The agent stops.
    Ending,
}

/// Does blocking work on another thread, and waits for at most `within`, including the time until
/// its turn. Work that hangs keeps its turn, so it holds as many threads as there are turns.
///
/// # Errors
/// Fails if the work takes too long, or if the agent stops.
pub(super) async fn run_blocking<T: Send + 'static>(
    turns: &'static Semaphore,
    within: Duration,
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<T, NoResult> {
    let done = async {
        let turn = turns.acquire().await.map_err(|_| NoResult::Ending)?;
        let done = spawn_blocking(move || {
            let _turn = turn;
            work()
        });
        done.await.map_err(|_| NoResult::Ending)
    };
    timeout(within, done).await.unwrap_or(Err(NoResult::Late))
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::channel;

    use super::*;

    #[tokio::test]
    async fn hanging_work_keeps_its_permit() {
        static TURNS: Semaphore = Semaphore::const_new(1);
        let short = Duration::from_millis(20);
        let (end, ended) = channel::<()>();
        let hanging = run_blocking(&TURNS, short, move || ended.recv().is_err());
        assert_eq!(hanging.await, Err(NoResult::Late));
        assert_eq!(run_blocking(&TURNS, short, || 7).await, Err(NoResult::Late));
        drop(end);
        assert_eq!(
            run_blocking(&TURNS, Duration::from_secs(60), || 7).await,
            Ok(7)
        );
    }
}
