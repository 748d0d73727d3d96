//! The file of a watchlist. A check before the robot is watched shows whether the file can be
//! written, so that a wrong path fails early. No file remains until the text is complete.

use std::convert::Infallible;
use std::fs::{self, File};
use std::io::{self, ErrorKind, Write as _};
use std::path::{Path, PathBuf};
use std::str::FromStr;

use anyhow::{Context as _, Result};

use super::{Output, UserError};

/// Where a watchlist is written.
#[derive(Clone, Debug)]
pub(super) enum Destination {
    StandardOutput,
    File(PathBuf),
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
    /// Checks that the file can be written, and leaves no trace.
    ///
    /// # Errors
    ///
    /// Fails if the file exists and `force` is not set, or if it cannot be written.
    pub(super) fn check(&self, force: bool) -> Result<()> {
        let Self::File(path) = self else {
            return Ok(());
        };
        let (_, is_new) = open(path, force)?;
        if is_new {
            fs::remove_file(path).with_context(|| unwritable(path))?;
        }
        Ok(())
    }

    /// Writes the text. If the file fails, standard output receives the text, which took minutes to
    /// learn.
    ///
    /// # Errors
    ///
    /// Fails as [`Self::check`] does, or if the disk is full.
    pub(super) fn write(&self, text: &str, force: bool) -> Result<()> {
        let path = match self {
            Self::StandardOutput => return Ok(Output::new().write(text)?),
            Self::File(path) => path,
        };
        let written = open(path, force).and_then(|(file, is_new)| {
            let replaced = replace(file, text).with_context(|| unwritable(path));
            if replaced.is_err() && is_new {
                // The error of the write is reported.
                let _ = fs::remove_file(path);
            }
            replaced
        });
        if written.is_err() {
            Output::new().write(text)?;
        }
        written
    }

    /// Returns the end of a sentence about the result.
    pub(super) fn result_text(&self) -> String {
        match self {
            Self::StandardOutput => String::new(),
            Self::File(path) => format!(", are in {}", path.display()),
        }
    }
}

/// Opens the file without changing its content. Returns whether it is new.
fn open(path: &Path, force: bool) -> Result<(File, bool)> {
    match File::options().write(true).create_new(true).open(path) {
        Ok(file) => Ok((file, true)),
        Err(error) if error.kind() == ErrorKind::AlreadyExists && force => {
            let file = File::options().write(true).open(path);
            Ok((file.with_context(|| unwritable(path))?, false))
        }
        Err(error) if error.kind() == ErrorKind::AlreadyExists => {
            let path = path.display();
            let text = format!("rp: {path} exists; pass --force to replace it");
            Err(UserError(text).into())
        }
        Err(error) => Err(error).with_context(|| unwritable(path)),
    }
}

fn replace(mut file: File, text: &str) -> io::Result<()> {
    // A device has no length.
    if file.metadata()?.is_file() {
        file.set_len(0)?;
    }
    file.write_all(text.as_bytes())
}

fn unwritable(path: &Path) -> String {
    format!("cannot write {}", path.display())
}
