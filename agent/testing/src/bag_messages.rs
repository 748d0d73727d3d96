//! Messages of a bag, as the crate `mcap` reads them, which has no code in common with the agent's
//! writer.

use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result};

/// Calls `each` for every message of the bag's uncompressed files, in the order of their names.
///
/// # Errors
///
/// Fails if a file cannot be read or is damaged, or `each` fails.
pub fn for_each_message(
    bag: &Path,
    mut each: impl FnMut(mcap::Message<'_>) -> Result<()>,
) -> Result<()> {
    let files = std::fs::read_dir(bag)?.map(|file| Ok(file?.path()));
    let mut files: Vec<PathBuf> = files.collect::<Result<_>>()?;
    files.retain(|path| {
        path.extension()
            .is_some_and(|extension| extension == "mcap")
    });
    files.sort();
    for path in files {
        let bytes = std::fs::read(&path)?;
        for message in mcap::MessageStream::new(&bytes)? {
            each(message.with_context(|| path.display().to_string())?)?;
        }
    }
    Ok(())
}
