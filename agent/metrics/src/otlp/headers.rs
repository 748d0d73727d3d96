//! Headers of requests from the configuration. Those of a file are read again for each request, so
//! that a replaced token applies without a restart.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use tonic::codegen::http::{HeaderMap, HeaderName, HeaderValue};

use super::settings::{OtlpSettings, ReadText, SettingsError};

/// Maximum size of a file with headers, in bytes.
const HEADERS_BYTES: u64 = 1 << 20;

/// Headers of the configuration, and of its file.
#[derive(Clone, Debug)]
pub(super) struct Headers {
    /// Headers without those of the file.
    fixed: HeaderMap,
    file: Option<PathBuf>,
    read: ReadText,
    last: Arc<Mutex<Last>>,
}

/// Headers of the last content that was usable.
#[derive(Debug)]
struct Last {
    headers: HeaderMap,
    /// Whether the file was usable when it was last read.
    is_usable: bool,
}

impl Headers {
    /// Reads the headers of the settings.
    ///
    /// Fails if the file cannot be read, or if a header is invalid.
    pub(super) fn resolve(settings: &OtlpSettings, read: ReadText) -> Result<Self, SettingsError> {
        let mut fixed = HeaderMap::new();
        for (name, value) in &settings.headers {
            add(&mut fixed, "otlp.headers", name, value)?;
        }
        let mut headers = fixed.clone();
        if let Some(path) = &settings.headers_file {
            add_file(&mut headers, path, read)?;
        }
        let last = Last {
            headers,
            is_usable: true,
        };
        Ok(Self {
            fixed,
            file: settings.headers_file.clone(),
            read,
            last: Arc::new(Mutex::new(last)),
        })
    }

    /// Returns the headers of the next request. If the file cannot be used, the previous headers
    /// remain in use, and the first failure is logged.
    pub(super) fn current(&self) -> HeaderMap {
        let mut last = self.last.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(path) = &self.file {
            let mut headers = self.fixed.clone();
            let is_usable = add_file(&mut headers, path, self.read).is_ok();
            let was_usable = std::mem::replace(&mut last.is_usable, is_usable);
            if is_usable {
                last.headers = headers;
            } else if was_usable {
                // The error could contain a part of the file.
                let path = path.display();
                tracing::warn!(%path, "a replaced file of OTLP headers cannot be used: the previous headers remain in use");
            }
        }
        last.headers.clone()
    }
}

/// Adds the lines `name: value` of a file.
fn add_file(headers: &mut HeaderMap, path: &Path, read: ReadText) -> Result<(), SettingsError> {
    let text = read(path, HEADERS_BYTES).map_err(|source| SettingsError::HeadersFile {
        path: path.to_owned(),
        source,
    })?;
    let place = path.display().to_string();
    for line in text.lines().map(str::trim) {
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        let (name, value) = line.split_once(':').unwrap_or((line, ""));
        add(headers, &place, name, value)?;
    }
    Ok(())
}

fn add(headers: &mut HeaderMap, place: &str, name: &str, value: &str) -> Result<(), SettingsError> {
    let pair = HeaderName::from_bytes(name.trim().as_bytes())
        .ok()
        .zip(HeaderValue::from_str(value.trim()).ok());
    let (key, mut value) = pair.ok_or_else(|| SettingsError::Header {
        place: place.to_owned(),
        name: name.to_owned(),
    })?;
    value.set_sensitive(true);
    headers.insert(key, value);
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_replaced_file_applies_to_the_next_request_and_a_damaged_one_does_not() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let write = |text: &str| std::fs::write(file.path(), text).unwrap();
        write("authorization: Bearer one\nx-site: a\n");
        let fixed = [("x-scope".to_owned(), "hall 2".to_owned())];
        let settings = OtlpSettings {
            headers: fixed.into(),
            headers_file: Some(file.path().to_owned()),
            ..OtlpSettings::default()
        };
        let headers = Headers::resolve(&settings, |path, _| std::fs::read_to_string(path)).unwrap();
        let now = || {
            let headers = headers.current();
            let value = |name: &str| {
                let value = headers.get(name).map(|value: &HeaderValue| value.to_str());
                value.map(|value| value.unwrap().to_owned())
            };
            [value("authorization"), value("x-site"), value("x-scope")]
        };
        let scope = Some("hall 2".to_owned());
        let bearer = |token: &str| Some(format!("Bearer {token}"));
        let first = [bearer("one"), Some("a".to_owned()), scope.clone()];
        assert_eq!(now(), first);
        write("no header\n");
        assert_eq!(now(), first);
        write("authorization: Bearer two\n");
        assert_eq!(now(), [bearer("two"), None, scope.clone()]);
        std::fs::remove_file(file.path()).unwrap();
        assert_eq!(now(), [bearer("two"), None, scope]);
    }
}
