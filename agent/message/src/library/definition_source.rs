//! A source of definitions: a directory, an installed ROS, or the program itself.

use std::fs::{File, OpenOptions};
use std::io::{self, Read as _};
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::definition::parse::{MAX_TEXT, ParseError, Problem};
use crate::definition::{Definition, TypeName};
use crate::dialect::Dialect;
use crate::embedded;
use crate::library::NotFound;

/// Extension of the file that defines a type without a `.msg`, `.srv` or `.action` file.
const IDL_EXTENSION: &str = "idl";

/// A source.
#[derive(Debug)]
pub(crate) enum DefinitionSource {
    /// A directory named by the user.
    Directory(PathBuf),
    /// The prefix of an installed ROS.
    Prefix(PathBuf),
    /// Definitions embedded in the program.
    Embedded(Dialect),
}

impl DefinitionSource {
    pub(crate) fn describe(&self) -> String {
        match self {
            Self::Directory(path) | Self::Prefix(path) => format!("in {}", path.display()),
            Self::Embedded(_) => "built into ros2probe".to_owned(),
        }
    }

    pub(crate) fn has(&self, name: &TypeName) -> bool {
        match self {
            Self::Embedded(dialect) => embedded::find(name, *dialect).is_some(),
            Self::Directory(_) | Self::Prefix(_) => self.file(name).is_some(),
        }
    }

    /// Returns the file that defines a type, even if it is unreadable, so that the error can be
    /// reported. An installed package also has an `.idl` file for every `.msg`, `.srv` and
    /// `.action` file. It is used only without such a file.
    fn file(&self, name: &TypeName) -> Option<PathBuf> {
        let kind = name.kind().as_str();
        let directories = match self {
            Self::Embedded(_) => Vec::new(),
            Self::Directory(path) => vec![path.clone(), path.join("share")],
            Self::Prefix(path) => vec![path.join("share")],
        };
        directories.iter().find_map(|directory| {
            let directory = directory.join(name.package()).join(kind);
            [kind, IDL_EXTENSION].into_iter().find_map(|extension| {
                let path = directory.join(format!("{}.{extension}", name.name()));
                match std::fs::metadata(&path) {
                    Err(error) if is_absent(&error) => None,
                    _ => Some(path),
                }
            })
        })
    }

    pub(crate) fn read(&self, name: &TypeName) -> Result<Option<Definition>, NotFound> {
        let (path, text) = match self {
            Self::Embedded(dialect) => match embedded::find(name, *dialect) {
                Some(text) => (PathBuf::from(name.to_string()), text.to_owned()),
                None => return Ok(None),
            },
            Self::Directory(_) | Self::Prefix(_) => {
                let Some(path) = self.file(name) else {
                    return Ok(None);
                };
                let Some(text) = read(&path)? else {
                    return Ok(None);
                };
                (path, text)
            }
        };
        let definition = if path
            .extension()
            .is_some_and(|extension| extension == IDL_EXTENSION)
        {
            Definition::parse_idl(name.clone(), &text)
        } else {
            Definition::parse(name.clone(), &text)
        };
        definition
            .map(Some)
            .map_err(|mistake| NotFound::Mistake { path, mistake })
    }
}

fn is_absent(error: &io::Error) -> bool {
    matches!(
        error.kind(),
        io::ErrorKind::NotFound | io::ErrorKind::NotADirectory
    )
}

/// Opens a regular file for reading. The open never blocks, as it would on a pipe without a writer.
/// The check is made on the open file, so the path cannot be swapped in between.
fn open(path: &Path) -> io::Result<File> {
    let flags = libc::O_NONBLOCK | libc::O_NOCTTY;
    let mut options = OpenOptions::new();
    let file = options.read(true).custom_flags(flags).open(path)?;
    match file.metadata()?.is_file() {
        true => Ok(file),
        false => Err(io::Error::new(
            io::ErrorKind::InvalidInput,
            "not a regular file",
        )),
    }
}

/// Reads a file, but at most one byte more than [`MAX_TEXT`].
fn read_bytes(path: &Path) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    open(path)?
        .take(MAX_TEXT as u64 + 1)
        .read_to_end(&mut bytes)?;
    Ok(bytes)
}

/// Returns a file's text if the file exists. Fails if it is not a regular file.
fn read(path: &Path) -> Result<Option<String>, NotFound> {
    let unreadable = |source: io::Error| NotFound::Unreadable {
        path: path.to_owned(),
        source: Arc::new(source),
    };
    let mistake = |line, problem| NotFound::Mistake {
        path: path.to_owned(),
        mistake: ParseError { line, problem },
    };
    let bytes = match read_bytes(path) {
        Ok(bytes) => bytes,
        Err(error) if is_absent(&error) => return Ok(None),
        Err(error) => return Err(unreadable(error)),
    };
    if bytes.len() > MAX_TEXT {
        return Err(mistake(1, Problem::TooLong));
    }
    String::from_utf8(bytes).map(Some).map_err(|error| {
        let good = error.utf8_error().valid_up_to();
        let lines = error
            .as_bytes()
            .iter()
            .take(good)
            .filter(|byte| **byte == b'\n')
            .count();
        mistake(lines + 1, Problem::NotText)
    })
}
