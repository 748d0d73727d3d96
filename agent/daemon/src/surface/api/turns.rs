//! Blocking work of requests, which takes turns.

use std::time::Duration;

use tokio::sync::{Semaphore, SemaphorePermit};
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
    let (result, _) = run_blocking_for(turns, within, work).await?;
    Ok(result)
}

/// Does blocking work as [`run_blocking`] does. The result comes with the turn, which ends when the
/// caller drops it: no more results than turns are in memory.
///
/// # Errors
/// Fails as [`run_blocking`] does.
pub(super) async fn run_blocking_for<T: Send + 'static>(
    turns: &'static Semaphore,
    within: Duration,
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<(T, SemaphorePermit<'static>), NoResult> {
    let done = async {
        let turn = turns.acquire().await.map_err(|_| NoResult::Ending)?;
        let done = spawn_blocking(move || (work(), turn));
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

    #[tokio::test]
    async fn a_result_keeps_its_turn_as_long_as_the_caller() {
        static TURNS: Semaphore = Semaphore::const_new(1);
        let short = Duration::from_millis(20);
        let long = Duration::from_secs(60);
        let (result, turn) = run_blocking_for(&TURNS, long, || 7).await.unwrap();
        assert_eq!(result, 7);
        assert_eq!(run_blocking(&TURNS, short, || 8).await, Err(NoResult::Late));
        drop(turn);
        assert_eq!(run_blocking(&TURNS, long, || 8).await, Ok(8));
    }
}
