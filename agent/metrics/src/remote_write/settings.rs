//! Settings of remote write: the file's `remote_write` section.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use hyper::Uri;
use hyper::header::{HeaderName, HeaderValue};

use super::request::Labels;
use crate::otlp::{Host, NoHardware, ReadText};

/// Maximum size of a file with a token, certificates or a key, in bytes.
const FILE_BYTES: u64 = 1 << 20;
/// Value of the label `job`, as in the scrape configurations.
const JOB_LABEL: &str = "ros2probe";

/// Delivery to a receiver of Prometheus remote write.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RemoteWriteSettings {
    /// Address of the receiver; `None` = nothing is sent.
    pub url: Option<String>,
    /// Interval between collections.
    pub interval: Duration,
    /// Timeout for an answer.
    pub timeout: Duration,
    /// Name of the robot: the label `instance`. The name of the host by default.
    pub instance: Option<String>,
    /// Additional labels of all series.
    pub labels: BTreeMap<String, String>,
    /// Additional headers of each request.
    pub headers: BTreeMap<String, String>,
    /// File with a bearer token.
    pub token_file: Option<PathBuf>,
    /// File with certificate authorities; those of the system by default.
    pub ca_file: Option<PathBuf>,
    /// File with the certificate of this robot.
    pub certificate_file: Option<PathBuf>,
    /// File with the key of that certificate.
    pub key_file: Option<PathBuf>,
    /// Maximum size of the queue on disk, in bytes; zero = none.
    pub queue_bytes: u64,
    /// Maximum number of bytes sent per second; `None` = no limit.
    pub max_bytes_per_second: Option<u64>,
    /// Maximum number of series that begin in an hour; zero = no limit.
    pub max_new_series_per_hour: u64,
}

/// Checked settings.
#[derive(Clone, Debug)]
pub struct Settings {
    pub(super) url: Uri,
    pub(super) interval: Duration,
    pub(super) timeout: Duration,
    /// Labels of all series.
    pub(super) labels: Labels,
    pub(super) headers: Vec<(HeaderName, HeaderValue)>,
    pub(super) token_file: Option<PathBuf>,
    pub(super) ca_file: Option<PathBuf>,
    /// Files of certificate and key.
    pub(super) certificate: Option<(PathBuf, PathBuf)>,
    pub(super) queue_bytes: u64,
    pub(super) max_bytes_per_second: Option<u64>,
    pub(super) max_new_series: usize,
    read: ReadText,
}

/// Why nothing can be sent.
#[derive(Debug, thiserror::Error)]
pub enum SettingsError {
    /// The address is invalid.
    #[error(
        "remote_write.url is `{0}`; it must be the URL of a receiver, such as \
         `https://prometheus.example/api/v1/write`"
    )]
    Url(String),
    /// A header cannot be sent.
    #[error("remote_write.headers: `{0}` is not a valid header")]
    Header(String),
    /// The robot has no name.
    #[error("remote_write.instance")]
    Instance(#[source] NoHardware),
    /// Only one of the two files of a certificate is set.
    #[error("remote_write.certificate_file and remote_write.key_file must be set together")]
    HalfCertificate,
    /// A file cannot be read.
    #[error("remote_write.{key}: cannot read {}", path.display())]
    File {
        /// Key of the configuration.
        key: &'static str,
        /// Path of the file.
        path: PathBuf,
        /// Error of the operating system.
        source: io::Error,
    },
    /// A file has no valid content.
    #[error("remote_write.{key}: {} has no valid content ({expected})", path.display())]
    Content {
        /// Key of the configuration.
        key: &'static str,
        /// Path of the file.
        path: PathBuf,
        /// What the file should have.
        expected: &'static str,
    },
    /// The certificate authorities of the system cannot be read.
    #[error("the certificate authorities of this system cannot be read (remote_write.ca_file)")]
    Authorities(#[source] io::Error),
}

impl Default for RemoteWriteSettings {
    fn default() -> Self {
        Self {
            url: None,
            interval: Duration::from_secs(5),
            timeout: Duration::from_secs(30),
            instance: None,
            labels: BTreeMap::new(),
            headers: BTreeMap::new(),
            token_file: None,
            ca_file: None,
            certificate_file: None,
            key_file: None,
            queue_bytes: 256 << 20,
            max_bytes_per_second: None,
            max_new_series_per_hour: 50_000,
        }
    }
}

impl Settings {
    /// Checks the settings of `file`; returns `None` without a receiver. `read` reads the files.
    ///
    /// # Errors
    /// Fails if the address, a header or the name of the robot is invalid.
    pub fn resolve(
        file: &RemoteWriteSettings,
        read: ReadText,
        host: &Host,
    ) -> Result<Option<Self>, SettingsError> {
        let Some(text) = &file.url else {
            return Ok(None);
        };
        let url = receiver(text).ok_or_else(|| SettingsError::Url(text.clone()))?;
        let headers = file.headers.iter().map(|(name, value)| {
            let valid = HeaderName::try_from(name.as_str()).ok();
            let valid = valid.zip(HeaderValue::try_from(value.as_str()).ok());
            valid.ok_or_else(|| SettingsError::Header(name.clone()))
        });
        let certificate = match (&file.certificate_file, &file.key_file) {
            (None, None) => None,
            (Some(certificate), Some(key)) => Some((certificate.clone(), key.clone())),
            _ => return Err(SettingsError::HalfCertificate),
        };
        let instance = file.instance.as_deref().map(|name| host.named(name));
        let instance = instance.transpose().map_err(SettingsError::Instance)?;
        let instance = instance.or_else(|| host.name.clone());
        let mut labels = file.labels.clone();
        for (name, value) in [
            ("job", JOB_LABEL.to_owned()),
            ("instance", instance.unwrap_or_default()),
        ] {
            labels.entry(name.to_owned()).or_insert(value);
        }
        Ok(Some(Self {
            url,
            interval: file.interval,
            timeout: file.timeout,
            labels: labels.into_iter().collect(),
            headers: headers.collect::<Result<_, _>>()?,
            token_file: file.token_file.clone(),
            ca_file: file.ca_file.clone(),
            certificate,
            queue_bytes: file.queue_bytes,
            max_bytes_per_second: file.max_bytes_per_second,
            max_new_series: usize::try_from(file.max_new_series_per_hour).unwrap_or(usize::MAX),
            read,
        }))
    }

    /// Reads a file that the key names.
    pub(super) fn read(&self, key: &'static str, path: &Path) -> Result<String, SettingsError> {
        (self.read)(path, FILE_BYTES).map_err(|source| SettingsError::File {
            key,
            path: path.to_owned(),
            source,
        })
    }

    /// Returns when the files for TLS were changed.
    pub(super) fn changed(&self) -> Vec<Option<SystemTime>> {
        let certificate = self.certificate.iter().flat_map(|(own, key)| [own, key]);
        let files = self.ca_file.iter().chain(certificate);
        let changed = |path: &PathBuf| fs::metadata(path).ok()?.modified().ok();
        files.map(changed).collect()
    }
}

impl SettingsError {
    pub(super) fn content(key: &'static str, path: &Path) -> Self {
        Self::Content {
            key,
            path: path.to_owned(),
            expected: match key {
                "token_file" => "one line of ASCII",
                "key_file" => "a key in PEM that belongs to the certificate",
                _ => "certificates in PEM",
            },
        }
    }
}

/// Parses the URL of a receiver; returns `None` if the text is not such a URL.
#[must_use]
pub fn receiver(text: &str) -> Option<Uri> {
    let url: Uri = text.parse().ok()?;
    let has_host = url.host().is_some_and(|host| !host.is_empty());
    let scheme = url.scheme_str()?;
    let is_plain = url
        .authority()
        .is_none_or(|all| !all.as_str().contains('@'));
    (["http", "https"].contains(&scheme) && has_host && is_plain).then_some(url)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn resolve(file: &RemoteWriteSettings) -> Result<Option<Settings>, SettingsError> {
        let host = Host {
            name: Some("robot-7".to_owned()),
            ..Host::default()
        };
        Settings::resolve(file, |path, _| fs::read_to_string(path), &host)
    }

    fn to(url: &str) -> RemoteWriteSettings {
        RemoteWriteSettings {
            url: Some(url.to_owned()),
            ..RemoteWriteSettings::default()
        }
    }

    #[test]
    fn the_labels_of_a_robot_are_those_of_a_scrape() {
        assert!(resolve(&RemoteWriteSettings::default()).unwrap().is_none());
        let pair = |(name, value): (&str, &str)| (name.to_owned(), value.to_owned());
        let labels = |file| resolve(&file).unwrap().unwrap().labels;
        let host = [("instance", "robot-7"), ("job", "ros2probe")];
        assert_eq!(labels(to("http://a/api/v1/write")), host.map(pair));
        let named = RemoteWriteSettings {
            instance: Some("marvin".to_owned()),
            labels: [("site", "hall 2"), ("job", "robots")].map(pair).into(),
            ..to("http://a/api/v1/write")
        };
        let expected = [
            ("instance", "marvin"),
            ("job", "robots"),
            ("site", "hall 2"),
        ];
        assert_eq!(labels(named), expected.map(pair));
        let of_hardware = RemoteWriteSettings {
            instance: Some("robot-{serial}".to_owned()),
            ..to("http://a/api/v1/write")
        };
        let error = resolve(&of_hardware).unwrap_err();
        assert!(matches!(error, SettingsError::Instance(_)), "{error}");
        let read: ReadText = |path, _| fs::read_to_string(path);
        let host = Host {
            serial: Some("a1b2".to_owned()),
            ..Host::default()
        };
        let settings = Settings::resolve(&of_hardware, read, &host);
        let labels = settings.unwrap().unwrap().labels;
        assert_eq!(labels[0], pair(("instance", "robot-a1b2")));
    }

    #[test]
    fn a_file_beyond_the_cap_is_refused() {
        let mut settings = resolve(&to("https://a/b")).unwrap().unwrap();
        settings.read = |_, most| {
            assert_eq!(most, FILE_BYTES);
            Err(io::Error::from(io::ErrorKind::FileTooLarge))
        };
        let error = settings.read("ca_file", Path::new("/ca")).unwrap_err();
        assert_eq!(error.to_string(), "remote_write.ca_file: cannot read /ca");
    }

    #[test]
    fn invalid_settings_are_reported_at_the_start() {
        for url in [
            "",
            "prometheus",
            "/api/v1/write",
            "ftp://a/b",
            "http://user:secret@a/b",
        ] {
            assert!(
                resolve(&to(url))
                    .unwrap_err()
                    .to_string()
                    .starts_with("remote_write.url")
            );
        }
        let half = RemoteWriteSettings {
            key_file: Some("/key".into()),
            ..to("https://a/b")
        };
        assert!(matches!(
            resolve(&half),
            Err(SettingsError::HalfCertificate)
        ));
        let header = RemoteWriteSettings {
            headers: [("a b".to_owned(), "c".to_owned())].into(),
            ..to("https://a/b")
        };
        let error = resolve(&header).unwrap_err().to_string();
        assert_eq!(error, "remote_write.headers: `a b` is not a valid header");
    }
}
