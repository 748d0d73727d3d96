//! Log on standard error, in a format that suits the journal, and on request over OTLP.

mod lines;

use std::io;
use std::sync::atomic::AtomicU64;
use std::sync::{Arc, Mutex};

use crate::config::Level;
use lines::Lines;
use ros2probe_attach::client::set_log_level;
use ros2probe_metrics::otlp::LogQueue;
use tracing_subscriber::filter::{EnvFilter, LevelFilter};
use tracing_subscriber::layer::SubscriberExt as _;
use tracing_subscriber::util::SubscriberInitExt as _;
use tracing_subscriber::{Layer as _, Registry, fmt, reload};

/// Log whose level can change at run time. Logging continues after this handle is dropped.
#[derive(Debug)]
pub struct Log {
    level: reload::Handle<EnvFilter, Registry>,
    /// Whether `RUST_LOG` is set, which then takes precedence.
    fixed: bool,
    lost: Arc<AtomicU64>,
    exported: Option<Arc<LogQueue>>,
}

impl Log {
    /// Starts logging at `level`, or as `RUST_LOG` sets. Lines of the level `exported` and of more
    /// severe ones are queued for export. A process has one log: the first one that is started.
    #[must_use]
    pub fn start(level: Level, exported: Option<LevelFilter>) -> Self {
        let fixed = EnvFilter::try_from_default_env().ok();
        if fixed.is_none() {
            set_log_level(level.filter());
        }
        let (filter, handle) = reload::Layer::new(fixed.clone().unwrap_or_else(|| filter(level)));
        // The journal adds its own timestamps.
        let journal = std::env::var_os("JOURNAL_STREAM").is_some();
        let lost = Arc::<AtomicU64>::default();
        let target = Mutex::new(Lines::new(io::stderr(), Arc::clone(&lost)));
        let lines = fmt::layer().with_writer(target).with_target(false);
        let lines = if journal {
            lines.without_time().with_filter(filter).boxed()
        } else {
            lines.with_filter(filter).boxed()
        };
        let queue = exported.map(|_| Arc::<LogQueue>::default());
        let export = queue.as_ref().zip(exported);
        let export = export.map(|(queue, level)| LogQueue::layer(queue, level));
        // Fails if a log exists already, which happens only in tests.
        let _ = tracing_subscriber::registry()
            .with(lines)
            .with(export)
            .try_init();
        Self {
            level: handle,
            fixed: fixed.is_some(),
            lost,
            exported: queue,
        }
    }

    /// Returns the queue of lines to export, if lines are exported.
    pub(crate) fn exported_lines(&self) -> Option<Arc<LogQueue>> {
        self.exported.clone()
    }

    /// Returns the counter of lines that standard error did not accept.
    pub(crate) fn lost_lines(&self) -> Arc<AtomicU64> {
        Arc::clone(&self.lost)
    }

    /// Changes the level.
    pub(crate) fn set(&self, level: Level) {
        if self.fixed {
            return;
        }
        set_log_level(level.filter());
        if let Err(error) = self.level.reload(filter(level)) {
            tracing::warn!(%error, "the log level was not changed");
        }
    }
}

fn filter(level: Level) -> EnvFilter {
    EnvFilter::default().add_directive(level.filter().into())
}
