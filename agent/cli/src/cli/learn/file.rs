//! The file of a watchlist. It is created before the robot is watched, so that a wrong path fails
//! at once.

use std::convert::Infallible;
use std::fs::{self, File};
use std::io::{ErrorKind, Write as _};
use std::path::{Path, PathBuf};
use std::str::FromStr;

use anyhow::{Context as _, Result};

use super::UserError;

/// Where a watchlist is written.
#[derive(Clone, Debug)]
pub(super) enum Destination {
    StandardOutput,
    File(PathBuf),
}

/// An open file. Dropping it before [`Self::write`] removes it if it is new.
#[derive(Debug)]
pub(super) struct Reserved {
    file: File,
    path: PathBuf,
    is_new: bool,
}

impl FromStr for Destination {
    type Err = Infallible;

    fn from_str(text: &str) -> Result<Self, Infallible> {
        Ok(match text {
            "-" => Self::StandardOutput,
            path => Self::File(path.into()),
        })
    }
}

impl Destination {
    /// Opens the file and leaves its content as it is. `None` for standard output.
    ///
    /// # Errors
    ///
    /// The file exists and `force` is not set, or it cannot be written.
    pub(super) fn open(&self, force: bool) -> Result<Option<Reserved>> {
        let Self::File(path) = self else {
            return Ok(None);
        };
        let new = File::options().write(true).create_new(true).open(path);
        let (file, is_new) = match new {
            Ok(file) => (file, true),
            Err(error) if error.kind() == ErrorKind::AlreadyExists && force => {
                let file = File::options().write(true).open(path);
                (file.with_context(|| unwritable(path))?, false)
            }
            Err(error) if error.kind() == ErrorKind::AlreadyExists => {
                let path = path.display();
                let text = format!("rp: {path} exists; pass --force to replace it");
                return Err(UserError(text).into());
            }
            Err(error) => return Err(error).with_context(|| unwritable(path)),
        };
        let path = path.clone();
        Ok(Some(Reserved { file, path, is_new }))
    }

    /// End of a sentence about the result.
    pub(super) fn phrase(&self) -> String {
        match self {
            Self::StandardOutput => String::new(),
            Self::File(path) => format!(", are in {}", path.display()),
        }
    }
}

impl Reserved {
    /// Replaces the content.
    ///
    /// # Errors
    ///
    /// The disk is full, or fails.
    pub(super) fn write(mut self, text: &str) -> Result<()> {
        let mut write = || {
            self.file.set_len(0)?;
            self.file.write_all(text.as_bytes())?;
            self.file.sync_all()
        };
        write().with_context(|| unwritable(&self.path))?;
        self.is_new = false;
        Ok(())
    }
}

impl Drop for Reserved {
    fn drop(&mut self) {
        if self.is_new {
            // An error is reported already; an empty file remains.
            let _ = fs::remove_file(&self.path);
        }
    }
}

fn unwritable(path: &Path) -> String {
    format!("cannot write {}", path.display())
}
