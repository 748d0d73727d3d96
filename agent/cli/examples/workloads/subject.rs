//! An observer that is measured, with the binary of the agent.

use std::path::{Path, PathBuf};

use crate::window::Observer;

/// The note of the binary that `--before` names.
const BEFORE: &str = ", before";

#[derive(Clone, Debug)]
pub(crate) struct Subject {
    pub(crate) observer: Observer,
    pub(crate) program: PathBuf,
    /// Empty, or [`BEFORE`].
    pub(crate) note: &'static str,
}

impl Subject {
    /// Returns the observers of `kinds` that are `chosen`, which is empty for all. Each agent follows
    /// the one with the binary `before`, if there is one.
    pub(crate) fn all(
        kinds: &[Observer],
        chosen: &[Observer],
        (program, before): (&Path, Option<&Path>),
    ) -> Vec<Subject> {
        let is_chosen = |observer: &&Observer| chosen.is_empty() || chosen.contains(observer);
        let subject = |observer, program: &Path, note| Subject {
            observer,
            program: program.to_path_buf(),
            note,
        };
        let each = kinds.iter().filter(is_chosen).flat_map(|&observer| {
            let before = before.filter(|_| observer.is_agent());
            let before = before.map(|before| subject(observer, before, BEFORE));
            before.into_iter().chain([subject(observer, program, "")])
        });
        each.collect()
    }

    pub(crate) fn name(&self) -> String {
        format!("{:?}{}", self.observer, self.note).to_lowercase()
    }
}
