//! The file with credentials: lines `NAME=value`, with the names of environment variables.

use std::fs::File;
use std::io::{self, Read as _};
use std::path::Path;

use crate::settings::SettingsError;

/// Maximum size of a file with credentials or certificates, in bytes.
const FILE_BYTES: u64 = 1 << 20;

/// Names and values of a file, in its order. The values are secrets: the type has no `Debug`.
#[derive(Default, PartialEq, Eq)]
pub(crate) struct Credentials(pub(crate) Vec<Entry>);

#[derive(PartialEq, Eq)]
pub(crate) struct Entry {
    /// Number of its line, from 1.
    pub(crate) line: usize,
    /// Name in lower case.
    pub(crate) name: String,
    pub(crate) value: String,
}

impl Credentials {
    /// Reads a file as systemd reads one of `EnvironmentFile=`: empty lines and comments are
    /// skipped, and a value may have quotes.
    pub(crate) fn read(path: &Path) -> Result<Self, SettingsError> {
        let text = read_text("credentials_file", path)?;
        let lines = text.lines().map(str::trim).enumerate();
        let is_entry =
            |(_, line): &(usize, &str)| !line.is_empty() && !line.starts_with(['#', ';']);
        let entries = lines.filter(is_entry).map(|(index, text)| {
            let line = index + 1;
            let wrong = || SettingsError::Credentials {
                path: path.to_owned(),
                line,
            };
            let (name, value) = text.split_once('=').ok_or_else(wrong)?;
            let name = name.trim().to_ascii_lowercase();
            let value = value.trim();
            let quoted = ['"', '\'']
                .into_iter()
                .find_map(|quote| value.strip_prefix(quote)?.strip_suffix(quote));
            let value = quoted.unwrap_or(value).to_owned();
            Ok(Entry { line, name, value })
        });
        Ok(Self(entries.collect::<Result<_, _>>()?))
    }
}

/// Reads the text file at `path`, the value of the configuration key `key`.
pub(crate) fn read_text(key: &'static str, path: &Path) -> Result<String, SettingsError> {
    let read = || {
        let mut text = String::new();
        let file = File::open(path)?;
        if !file.metadata()?.is_file() {
            return Err(io::Error::new(
                io::ErrorKind::InvalidInput,
                "not a regular file",
            ));
        }
        file.take(FILE_BYTES + 1).read_to_string(&mut text)?;
        match text.len() as u64 > FILE_BYTES {
            true => Err(io::ErrorKind::FileTooLarge.into()),
            false => Ok(text),
        }
    };
    read().map_err(|source| SettingsError::File {
        key,
        path: path.to_owned(),
        source,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<Credentials, SettingsError> {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), text).unwrap();
        Credentials::read(file.path())
    }

    #[test]
    fn a_file_is_read_like_an_environment_file_of_systemd() {
        let text =
            "# of robot-17\n\nAWS_ACCESS_KEY_ID=AK\n AWS_SECRET_ACCESS_KEY = \"a=b \"\n;x\nT='t'\n";
        let credentials = read(text).unwrap_or_default();
        let entries = credentials.0.iter();
        let entries: Vec<_> = entries
            .map(|entry| (entry.line, &*entry.name, &*entry.value))
            .collect();
        let expected = [
            (3, "aws_access_key_id", "AK"),
            (4, "aws_secret_access_key", "a=b "),
            (6, "t", "t"),
        ];
        assert_eq!(entries, expected);
    }

    #[test]
    fn an_error_names_the_line_and_not_its_text() {
        let error = read("A=1\nhunter2\n").err().unwrap().to_string();
        assert!(error.contains("line 2 of"), "{error}");
        assert!(!error.contains("hunter2"), "{error}");
        let error = Credentials::read(Path::new("/dev/zero")).err().unwrap();
        assert!(matches!(error, SettingsError::File { .. }), "{error}");
    }

    #[test]
    fn a_file_beyond_the_cap_is_refused() {
        let text = "A=1\n".repeat(usize::try_from(FILE_BYTES).unwrap() / 4);
        assert!(read(&text).is_ok());
        let error = read(&format!("{text}\n")).err().unwrap();
        let SettingsError::File { source, .. } = error else {
            panic!("{error}");
        };
        assert_eq!(source.kind(), io::ErrorKind::FileTooLarge);
    }
}
