//! The log: events to standard error, in a form the journal keeps well.

mod lines;

use std::io;
use std::sync::atomic::AtomicU64;
use std::sync::{Arc, Mutex};

use crate::config::Level;
use lines::Lines;
use tracing_subscriber::filter::{EnvFilter, LevelFilter};
use tracing_subscriber::layer::SubscriberExt as _;
use tracing_subscriber::util::SubscriberInitExt as _;
use tracing_subscriber::{Layer as _, Registry, fmt, reload};

/// Changes the level of the running agent.
#[derive(Debug)]
pub(crate) struct Log {
    level: reload::Handle<EnvFilter, Registry>,
    /// `RUST_LOG` was given: it stays in force.
    fixed: bool,
    lost: Arc<AtomicU64>,
}

impl Log {
    /// Begins logging at `level`, or as `RUST_LOG` says.
    pub(crate) fn start(level: Level) -> Self {
        let fixed = EnvFilter::try_from_default_env().ok();
        let (filter, handle) = reload::Layer::new(fixed.clone().unwrap_or_else(|| filter(level)));
        // The journal stamps each line itself.
        let journal = std::env::var_os("JOURNAL_STREAM").is_some();
        let lost = Arc::<AtomicU64>::default();
        let target = Mutex::new(Lines::new(io::stderr(), Arc::clone(&lost)));
        let lines = fmt::layer().with_writer(target).with_target(false);
        let lines = if journal {
            lines.without_time().boxed()
        } else {
            lines.boxed()
        };
        // Fails when a log has begun already, which only a test could do.
        let _ = tracing_subscriber::registry()
            .with(filter)
            .with(lines)
            .try_init();
        Self {
            level: handle,
            fixed: fixed.is_some(),
            lost,
        }
    }

    /// Lines that standard error did not take, as they are counted.
    pub(crate) fn lost_lines(&self) -> Arc<AtomicU64> {
        Arc::clone(&self.lost)
    }

    /// Changes the level.
    pub(crate) fn set(&self, level: Level) {
        if !self.fixed
            && let Err(error) = self.level.reload(filter(level))
        {
            tracing::warn!(%error, "the log level was not changed");
        }
    }
}

fn filter(level: Level) -> EnvFilter {
    let level = match level {
        Level::Error => LevelFilter::ERROR,
        Level::Warn => LevelFilter::WARN,
        Level::Info => LevelFilter::INFO,
        Level::Debug => LevelFilter::DEBUG,
        Level::Trace => LevelFilter::TRACE,
    };
    EnvFilter::default().add_directive(level.into())
}
