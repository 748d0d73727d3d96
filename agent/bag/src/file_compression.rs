//! Compression of the complete files of a bag, which is slow and meant for another thread.

use std::fs;
use std::path::{Path, PathBuf};

use super::compression::Progress;
use super::{Compression, Error, new_file, open_file, with_suffix};

/// The task of compressing one complete file.
#[derive(Clone, Debug)]
pub struct FileCompression {
    pub(super) path: PathBuf,
    pub(super) compression: Compression,
    pub(super) index: usize,
}

/// A finished task, for [`super::Writer::compressed`].
#[derive(Debug)]
pub struct Compressed {
    pub(super) index: usize,
    pub(super) compression: Compression,
    pub(super) bytes: u64,
}

impl FileCompression {
    /// Creates the task for a complete file.
    pub(super) fn of(path: &Path, compression: Compression) -> Self {
        Self {
            path: path.to_owned(),
            compression,
            index: 0,
        }
    }

    /// Returns the size of the file in bytes.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        fs::metadata(&self.path).map_or(0, |metadata| metadata.len())
    }

    /// Compresses the file into a new one beside it, then removes the original. It is slow and
    /// needs space for both files.
    pub fn run(&self) -> Result<Compressed, Error> {
        self.run_watched(&Progress::default())
    }

    /// Does the same as [`Self::run`]. Fails if `progress` is cancelled; the file is then
    /// unchanged.
    pub fn run_watched(&self, progress: &Progress) -> Result<Compressed, Error> {
        let into = with_suffix(&self.path, self.compression.name());
        let part = with_suffix(&into, "part");
        let wrong = |error| Error::writing(&part, error);
        let done = || {
            let source = open_file(&self.path)?;
            let target = new_file(&part)?;
            self.compression.compress_file(&source, &target, progress)?;
            target.sync_data()?;
            let bytes = target.metadata()?.len();
            fs::rename(&part, &into)?;
            fs::remove_file(&self.path)?;
            Ok(bytes)
        };
        let bytes = done().map_err(|error| {
            let _ = fs::remove_file(&part);
            wrong(error)
        })?;
        Ok(Compressed {
            index: self.index,
            compression: self.compression,
            bytes,
        })
    }
}
