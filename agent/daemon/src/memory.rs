//! Selects the state directory from the configuration or the service manager, and loads its
//! content. Problems are logged: an agent without saved state still observes.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::config::{StateChoice, Watch};
use crate::container;
use crate::state::{Loaded, Newer, StateDirectory};
use crate::watches::{self, LoadedWatches, Watches};
use anyhow::anyhow;
use ros2probe_model::graph::discovery::Memory;

/// Default directory of the package and of the service manager.
const DEFAULT_DIRECTORY: &str = "/var/lib/ros2probe";
/// Variable of the service manager.
const STATE_DIRECTORY_VARIABLE: &str = "STATE_DIRECTORY";
/// Subdirectory of recordings.
pub(crate) const RECORDINGS_DIRECTORY: &str = "recordings";

/// Opens the state directory; returns `None` if no state is saved.
pub(crate) fn open(choice: &StateChoice) -> Option<Arc<StateDirectory>> {
    if container::state(choice).is_some() {
        return None;
    }
    let opened = StateDirectory::open(&path(choice)?);
    match opened {
        Ok(directory) => Some(Arc::new(directory)),
        Err(error) => {
            let reason = format!("{:#}", anyhow!(error));
            tracing::warn!(
                reason,
                "state is not saved: a restart loses names and added watches"
            );
            None
        }
    }
}

/// Returns the path of the state directory; `None` if no state is saved.
pub(crate) fn path(choice: &StateChoice) -> Option<PathBuf> {
    match choice {
        StateChoice::Off => None,
        StateChoice::At(path) => Some(path.clone()),
        StateChoice::Auto => {
            let named = std::env::var_os(STATE_DIRECTORY_VARIABLE).filter(|path| !path.is_empty());
            let default = || {
                Path::new(DEFAULT_DIRECTORY)
                    .exists()
                    .then(|| DEFAULT_DIRECTORY.into())
            };
            named.map(PathBuf::from).or_else(default)
        }
    }
}

/// Returns the directory of bags, which is created with the first one; `None` if bags are refused.
pub(crate) fn recordings(choice: &StateChoice, state: Option<&StateDirectory>) -> Option<PathBuf> {
    match choice {
        StateChoice::Off => None,
        StateChoice::At(path) => Some(path.clone()),
        StateChoice::Auto => Some(state?.path().join(RECORDINGS_DIRECTORY)),
    }
}

/// Returns the discovery state of the previous agent, and whether this agent may overwrite it.
pub(crate) fn load(directory: &StateDirectory) -> (Option<Memory>, bool) {
    let path = directory.path().display();
    let known = match directory.load() {
        Loaded::Newer(newer) => {
            log_newer_state(&newer);
            return (None, false);
        }
        Loaded::Known(memory) => {
            let participants = memory.participants.len();
            tracing::info!(%path, participants, "restored from saved state, awaiting confirmation");
            Some(memory)
        }
        Loaded::Nothing => None,
        Loaded::AnotherBoot => {
            tracing::info!(%path, "the state is from another boot and is ignored");
            None
        }
        Loaded::Unusable { reason, moved_to } => {
            let aside = moved_to.map(|path| path.display().to_string());
            tracing::warn!(%path, reason, aside, "the state cannot be used");
            None
        }
    };
    (known, true)
}

/// Logs that state of a newer version is preserved, since the operator may upgrade again.
fn log_newer_state(newer: &Newer) {
    let Newer {
        path,
        version,
        known,
    } = newer;
    tracing::error!(
        path = %path.display(),
        version,
        known,
        "a newer rp wrote this state: starting without it and leaving the file untouched; \
         upgrade rp, or remove the file"
    );
}

/// Restores watches that clients of the previous agent had added. Returns whether this agent may
/// overwrite the saved watches.
pub(crate) fn restore_watches(directory: &StateDirectory, watches: &Watches) -> bool {
    let Some(kept) = load_watches(directory) else {
        return false;
    };
    match watches.restore(kept) {
        Ok(0) => {}
        Ok(left_out) => {
            let limit = "limits.watches";
            tracing::warn!(left_out, limit, "some saved watches exceed limits.watches");
        }
        Err(error) => tracing::warn!(%error, "the saved watches cannot be used"),
    }
    true
}

/// Reads saved watches; returns `None` if a newer version wrote them.
fn load_watches(directory: &StateDirectory) -> Option<Vec<Watch>> {
    let path = directory.path().display();
    Some(match watches::load(directory) {
        LoadedWatches::Nothing => Vec::new(),
        LoadedWatches::Newer(newer) => {
            log_newer_state(&newer);
            return None;
        }
        LoadedWatches::These(watches) => {
            tracing::info!(%path, watches = watches.len(), "restored the watches that clients \
                added");
            watches
        }
        LoadedWatches::Unusable { reason, moved_to } => {
            let aside = moved_to.map(|path| path.display().to_string());
            tracing::warn!(%path, reason, aside, "the saved watches cannot be used");
            Vec::new()
        }
    })
}
