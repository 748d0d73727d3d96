//! Compressing the complete files of a bag as a whole, which takes long: work for another thread.

use std::fs;
use std::path::{Path, PathBuf};

use super::compression::Progress;
use super::{Compression, Error, new_file, open_file, with_suffix};

/// Work for another thread: one complete file to compress.
#[derive(Clone, Debug)]
pub struct FileCompression {
    pub(super) path: PathBuf,
    pub(super) compression: Compression,
    pub(super) index: usize,
}

/// That work, done; for [`super::Writer::compressed`].
#[derive(Debug)]
pub struct Compressed {
    pub(super) index: usize,
    pub(super) compression: Compression,
    pub(super) bytes: u64,
}

impl FileCompression {
    /// For a file that is complete already.
    pub(super) fn of(path: &Path, compression: Compression) -> Self {
        Self {
            path: path.to_owned(),
            compression,
            index: 0,
        }
    }

    /// Bytes of the file.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        fs::metadata(&self.path).map_or(0, |metadata| metadata.len())
    }

    /// Compresses the file beside itself, then removes it. Takes long; needs room for both.
    pub fn run(&self) -> Result<Compressed, Error> {
        self.run_watched(&Progress::default())
    }

    /// As [`Self::run`]. Fails where `progress` is given up; the file then stays as it was.
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
