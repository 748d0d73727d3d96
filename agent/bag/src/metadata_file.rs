//! Atomic replacement of a bag's metadata.yaml.

use std::fs;
use std::io::{self, Write as _};
use std::path::Path;

use super::metadata::{self, Metadata};
use super::{Error, new_file, with_suffix};

/// The failure that a new metadata.yaml must survive.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(super) enum Durability {
    /// The end of this process.
    Process,
    /// A loss of power.
    Power,
}

/// Writes the new text beside the file, then renames it over the file.
pub(super) fn write_metadata(
    directory: &Path,
    metadata: &Metadata,
    durability: Durability,
) -> Result<(), Error> {
    let path = directory.join(metadata::FILE_NAME);
    let part = with_suffix(&path, "part");
    let write = || {
        // A killed process leaves this file behind. It is recreated, so that nothing is written
        // through a link.
        match fs::remove_file(&part) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
            _ => {}
        }
        let mut file = new_file(&part)?;
        file.write_all(metadata.file_text().as_bytes())?;
        if durability == Durability::Power {
            file.sync_data()?;
        }
        fs::rename(&part, &path)
    };
    write().map_err(|error| {
        let _ = fs::remove_file(&part);
        Error::writing(&path, error)
    })
}
