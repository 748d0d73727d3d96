//! The agent's one working thread: takes packets from the source, feeds the model, pins a snapshot
//! to the board about once a second. Surfaces never reach in here; they read the board.

pub mod replay;

use std::sync::Arc;
use std::sync::mpsc::{Receiver, TryRecvError};
use std::time::{Duration, Instant};

use tokio_util::sync::CancellationToken;

use crate::capture::pcap::PcapError;
use crate::config::Watchlist;
use crate::model::snapshot::Snapshot;
use crate::surface::{AgentFacts, Board, InterfaceFacts, SourceKind};
use replay::Replay;

/// Longest time without looking at commands and the clock.
const SLICE: Duration = Duration::from_millis(100);
/// How often surfaces get a new snapshot.
const PUBLISH: Duration = Duration::from_secs(1);

/// Where packets come from.
pub enum Source {
    /// A capture.
    Replay(Box<Replay>),
}

/// What the agent is told while it runs.
#[derive(Debug)]
pub enum Order {
    /// Measure these topics from now on.
    Watch(Watchlist),
}

/// Why the working thread ended although nobody asked it to.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// The rest of a capture cannot be read; what came before it is on the board.
    #[error("the capture was replayed up to a fault")]
    Replay(#[source] PcapError),
}

/// Source, model and board, for one thread.
pub struct Run {
    source: Source,
    watchlist: Watchlist,
    board: Arc<Board>,
    orders: Receiver<Order>,
    stop: CancellationToken,
}

impl Run {
    /// Ready to run.
    #[must_use]
    pub fn new(
        source: Source,
        watchlist: Watchlist,
        board: Arc<Board>,
        orders: Receiver<Order>,
        stop: CancellationToken,
    ) -> Self {
        Self {
            source,
            watchlist,
            board,
            orders,
            stop,
        }
    }

    /// Works until told to stop or until the capture ends; the last state stays on the board.
    ///
    /// # Errors
    /// When the source fails for good.
    pub fn run(mut self) -> Result<(), RunError> {
        self.publish();
        let mut published = Instant::now();
        while !self.stop.is_cancelled() {
            self.take_orders();
            let polled = self.source.poll(SLICE);
            let finished = self.source.is_finished();
            if finished || polled.is_err() || published.elapsed() >= PUBLISH {
                self.publish();
                published = Instant::now();
            }
            polled?;
            if finished {
                break;
            }
        }
        Ok(())
    }

    fn take_orders(&mut self) {
        loop {
            match self.orders.try_recv() {
                Ok(Order::Watch(watchlist)) => self.watchlist = watchlist,
                // Without a supervisor there are no more orders; its token says when to stop.
                Err(TryRecvError::Empty | TryRecvError::Disconnected) => return,
            }
        }
    }

    fn publish(&mut self) {
        let snapshot = Snapshot {
            at: self.source.clock(),
            ..Snapshot::default()
        };
        self.board.publish(snapshot, self.source.facts());
    }
}

impl Source {
    /// Live or replay.
    #[must_use]
    pub const fn kind(&self) -> SourceKind {
        match self {
            Self::Replay(_) => SourceKind::Replay,
        }
    }

    fn poll(&mut self, timeout: Duration) -> Result<(), RunError> {
        match self {
            Self::Replay(replay) => replay.poll(timeout, |_| {}).map_err(RunError::Replay),
        }
    }

    fn clock(&self) -> ros2probe_wire::Timestamp {
        match self {
            Self::Replay(replay) => replay.clock(),
        }
    }

    fn is_finished(&self) -> bool {
        match self {
            Self::Replay(replay) => replay.is_finished(),
        }
    }

    fn facts(&self) -> AgentFacts {
        let now = Instant::now();
        match self {
            Self::Replay(replay) => {
                let (packets, bytes) = replay.progress();
                AgentFacts {
                    finished: replay.is_finished(),
                    interfaces: vec![InterfaceFacts {
                        name: "replay".to_owned(),
                        packets,
                        dropped: 0,
                    }],
                    copied_bytes: bytes,
                    ..AgentFacts::new(SourceKind::Replay, now)
                }
            }
        }
    }
}
