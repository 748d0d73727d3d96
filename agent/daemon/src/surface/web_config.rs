//! Access control and TLS of the metrics listener: the file `metrics.web_config`, in the format of
//! Prometheus exporters (exporter-toolkit's `web.yml`).
//!
//! The supported keys are `basic_auth_users` and a part of `tls_server_config`. Other keys are
//! rejected, because ignoring them could leave a listener open. The file is read once at startup.

use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};

use serde::Deserialize;

/// Maximum size of the file, in bytes.
const MAX_BYTES: u64 = 1 << 20;
/// Accepted bcrypt costs. Each step doubles the time of a check; 16 takes seconds on a robot.
const BCRYPT_COSTS: std::ops::RangeInclusive<u8> = 4..=16;

/// The validated content of the file.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct WebConfig {
    /// Bcrypt hashes by user name; if empty, no password is required.
    pub(super) users: BTreeMap<String, String>,
    /// Files for TLS, if enabled.
    pub(super) tls: Option<TlsFiles>,
}

/// Files and settings of TLS.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct TlsFiles {
    /// Certificate chain, PEM.
    pub(super) certificates: PathBuf,
    /// Private key, PEM.
    pub(super) key: PathBuf,
    /// Authorities of client certificates, PEM; if set, clients need a certificate.
    pub(super) client_authorities: Option<PathBuf>,
    /// Whether TLS 1.2 is disabled.
    pub(super) only_tls13: bool,
}

/// Why the listener cannot be protected as configured.
#[derive(Debug, thiserror::Error)]
pub enum WebConfigError {
    /// The file cannot be read.
    #[error("cannot read {} (`metrics.web_config`)", path.display())]
    Read {
        /// Path of the file.
        path: PathBuf,
        /// Error of the operating system.
        source: io::Error,
    },
    /// The file has an invalid setting.
    #[error("{} (`metrics.web_config`): {reason}", path.display())]
    Invalid {
        /// Path of the file.
        path: PathBuf,
        /// The setting's error.
        reason: InvalidSetting,
    },
}

/// Why a setting of the file is invalid.
#[derive(Debug, thiserror::Error)]
pub enum InvalidSetting {
    /// The file is not YAML, or has an unknown or missing key.
    #[error(transparent)]
    Yaml(#[from] serde_yaml::Error),
    /// A user's password hash cannot be used.
    #[error("basic_auth_users: the hash of `{name}` {fault}")]
    Hash {
        /// Name of the user.
        name: String,
        /// What is wrong with the hash.
        fault: InvalidHash,
    },
    /// Client certificates are required, but no authority is named.
    #[error("tls_server_config: client_auth_type needs client_ca_file")]
    NoAuthority,
    /// An authority is named, but client certificates are not required.
    #[error(
        "tls_server_config: client_ca_file has no effect without \
         `client_auth_type: RequireAndVerifyClientCert`"
    )]
    UnusedAuthority,
    /// The kind of client authentication is unknown or not supported.
    #[error(
        "tls_server_config: client_auth_type is {0}, must be NoClientCert or \
         RequireAndVerifyClientCert"
    )]
    AuthType(String),
    /// The TLS version is unknown or not supported.
    #[error("tls_server_config: min_version is {0}, must be TLS12 or TLS13")]
    MinVersion(String),
}

/// Why a password hash cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum InvalidHash {
    /// The hash does not consist of a prefix such as `$2y$10$` and 53 characters.
    #[error("is not a bcrypt hash, as printed by `htpasswd -nBC 10 NAME`")]
    NotBcrypt,
    /// The cost is outside of the accepted range.
    #[error("has cost {cost}, must be {} to {}", BCRYPT_COSTS.start(), BCRYPT_COSTS.end())]
    Cost {
        /// The cost.
        cost: u8,
    },
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Shape {
    tls_server_config: Option<TlsShape>,
    basic_auth_users: Option<BTreeMap<String, String>>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct TlsShape {
    cert_file: PathBuf,
    key_file: PathBuf,
    client_ca_file: Option<PathBuf>,
    client_auth_type: Option<String>,
    min_version: Option<String>,
}

impl WebConfig {
    /// Reads and validates the file. Paths in the file are relative to its directory.
    ///
    /// # Errors
    /// Fails if the file cannot be read, or has unknown or invalid settings.
    pub fn load(path: &Path) -> Result<Self, WebConfigError> {
        let text =
            crate::file::read_text(path, MAX_BYTES).map_err(|source| WebConfigError::Read {
                path: path.to_path_buf(),
                source,
            })?;
        let directory = path.parent().unwrap_or(Path::new("/"));
        let config = Self::parse(&text, directory).map_err(|reason| WebConfigError::Invalid {
            path: path.to_path_buf(),
            reason,
        })?;
        Ok(config)
    }

    fn parse(text: &str, directory: &Path) -> Result<Self, InvalidSetting> {
        if text.trim().is_empty() {
            return Ok(Self::default());
        }
        let shape: Shape = serde_yaml::from_str(text)?;
        let users = shape.basic_auth_users.unwrap_or_default();
        for (name, hash) in &users {
            check_hash(hash).map_err(|fault| InvalidSetting::Hash {
                name: name.clone(),
                fault,
            })?;
        }
        let tls = shape.tls_server_config.map(|shape| shape.check(directory));
        Ok(Self {
            users,
            tls: tls.transpose()?,
        })
    }
}

impl TlsShape {
    fn check(self, directory: &Path) -> Result<TlsFiles, InvalidSetting> {
        let authorities = self.client_ca_file.map(|path| directory.join(path));
        let client_authorities = match (self.client_auth_type.as_deref(), authorities) {
            (None | Some("NoClientCert" | ""), None) => None,
            (Some("RequireAndVerifyClientCert"), Some(path)) => Some(path),
            (Some("RequireAndVerifyClientCert"), None) => {
                return Err(InvalidSetting::NoAuthority);
            }
            (None | Some("NoClientCert" | ""), Some(_)) => {
                return Err(InvalidSetting::UnusedAuthority);
            }
            (Some(other), _) => return Err(InvalidSetting::AuthType(other.to_owned())),
        };
        let only_tls13 = match self.min_version.as_deref() {
            None | Some("TLS12") => false,
            Some("TLS13") => true,
            Some(other) => return Err(InvalidSetting::MinVersion(other.to_owned())),
        };
        Ok(TlsFiles {
            certificates: directory.join(self.cert_file),
            key: directory.join(self.key_file),
            client_authorities,
            only_tls13,
        })
    }
}

/// Checks that a hash consists of a prefix such as `$2y$10$` and 53 characters. The cost is
/// bounded, because every client can cause a check.
fn check_hash(hash: &str) -> Result<(), InvalidHash> {
    let mut parts = hash.split('$');
    let (none, version, cost) = (parts.next(), parts.next(), parts.next());
    let letters = parts.next().unwrap_or_default();
    let is_known = none == Some("") && matches!(version, Some("2a" | "2b" | "2y"));
    if !is_known || letters.len() != 53 || parts.next().is_some() {
        return Err(InvalidHash::NotBcrypt);
    }
    let cost: u8 = cost
        .and_then(|cost| cost.parse().ok())
        .ok_or(InvalidHash::NotBcrypt)?;
    if !BCRYPT_COSTS.contains(&cost) {
        return Err(InvalidHash::Cost { cost });
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The example in exporter-toolkit's documentation.
    const ALICE: &str = "$2y$10$mDwo.lAisC94iLAyP81MCesa29IzH37oigHC/42V2pdJlUprsJPze";

    fn parse(text: &str) -> Result<WebConfig, InvalidSetting> {
        WebConfig::parse(text, Path::new("/etc/ros2probe"))
    }

    #[test]
    fn a_file_in_the_format_of_exporter_toolkit_is_accepted() {
        let text = format!(
            "tls_server_config:\n  cert_file: server.crt\n  key_file: /keys/server.key\n  \
             min_version: TLS13\nbasic_auth_users:\n  alice: {ALICE}\n"
        );
        let config = parse(&text).unwrap();
        assert_eq!(config.users.get("alice").unwrap(), ALICE);
        let tls = config.tls.unwrap();
        assert_eq!(tls.certificates, Path::new("/etc/ros2probe/server.crt"));
        assert_eq!(tls.key, Path::new("/keys/server.key"));
        assert!(tls.only_tls13 && tls.client_authorities.is_none());
        assert_eq!(parse("").unwrap(), WebConfig::default());
    }

    #[test]
    fn a_setting_that_would_leave_the_listener_open_is_refused() {
        for (text, expected) in [
            ("basic_auth_user:\n  alice: x\n", "basic_auth_user"),
            ("basic_auth_users:\n  alice: secret\n", "not a bcrypt hash"),
            ("basic_auth_users: {a: $2y$10$short}", "not a bcrypt hash"),
            ("basic_auth_users: {a: $1$10$short}", "not a bcrypt hash"),
            ("http_server_config: {http2: true}", "http_server_config"),
            ("tls_server_config: {cert_file: a}", "key_file"),
            (
                "tls_server_config: {cert_file: a, key_file: b, cipher_suites: []}",
                "cipher_suites",
            ),
            (
                "tls_server_config: {cert_file: a, key_file: b, min_version: TLS10}",
                "TLS12",
            ),
            (
                "tls_server_config: {cert_file: a, key_file: b, client_ca_file: c}",
                "RequireAndVerifyClientCert",
            ),
            (
                "tls_server_config: {cert_file: a, key_file: b, client_auth_type: \
                 RequireAndVerifyClientCert}",
                "client_ca_file",
            ),
            (
                "tls_server_config: {cert_file: a, key_file: b, client_auth_type: \
                 RequestClientCert}",
                "NoClientCert",
            ),
        ] {
            let error = parse(text).unwrap_err().to_string();
            assert!(error.contains(expected), "{text}: {error}");
        }
        let slow = ALICE.replace("$10$", "$31$");
        let error = parse(&format!("basic_auth_users: {{a: {slow}}}"))
            .unwrap_err()
            .to_string();
        assert!(error.contains("cost 31"), "{error}");
    }
}
