//! Who may scrape, and how it is encrypted: the file `metrics.web_config`, of the form that the
//! exporters of Prometheus share (exporter-toolkit's `web.yml`).
//!
//! Of that form it knows `basic_auth_users` and of `tls_server_config` the keys below; what it does
//! not know it refuses rather than leave a listener open that was meant to be closed. The file is
//! read once, at the start.

use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};

use serde::Deserialize;

/// A larger file is none of these.
const MAX_BYTES: u64 = 1 << 20;
/// Each step doubles the time that a password takes: 16 is seconds on a robot.
const COSTS: std::ops::RangeInclusive<u8> = 4..=16;

/// What the file says, checked.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct WebConfig {
    /// Names and the bcrypt hashes of their passwords; everybody may scrape when it is empty.
    pub(super) users: BTreeMap<String, String>,
    /// Where certificates are.
    pub(super) tls: Option<TlsFiles>,
}

/// What TLS needs.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct TlsFiles {
    /// The chain, PEM.
    pub(super) certificates: PathBuf,
    /// The private key, PEM.
    pub(super) key: PathBuf,
    /// Clients must have a certificate of one of these, PEM.
    pub(super) client_authorities: Option<PathBuf>,
    /// TLS 1.2 is not spoken.
    pub(super) only_tls13: bool,
}

/// Why the listener cannot be protected as asked for.
#[derive(Debug, thiserror::Error)]
pub enum WebConfigError {
    /// A file cannot be read.
    #[error("cannot read {} (`metrics.web_config`)", path.display())]
    Read {
        /// Which.
        path: PathBuf,
        /// Why not.
        source: io::Error,
    },
    /// It says what is not possible.
    #[error("{} (`metrics.web_config`): {reason}", path.display())]
    Invalid {
        /// Which.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// Encryption is no part of this program.
    #[error(
        "{} (`metrics.web_config`) requires TLS, which this build lacks: build `rp` with \
         `--features tls`, or encrypt with a proxy", path.display()
    )]
    WithoutTls {
        /// Which.
        path: PathBuf,
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
    /// Reads and checks the file; paths in it are relative to it.
    ///
    /// # Errors
    /// It cannot be read, says what is not known, or asks for what this program cannot do.
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
        if config.tls.is_some() && !cfg!(feature = "tls") {
            let path = path.to_path_buf();
            return Err(WebConfigError::WithoutTls { path });
        }
        Ok(config)
    }

    fn parse(text: &str, directory: &Path) -> Result<Self, String> {
        if text.trim().is_empty() {
            return Ok(Self::default());
        }
        let shape: Shape = serde_yaml::from_str(text).map_err(|error| error.to_string())?;
        let users = shape.basic_auth_users.unwrap_or_default();
        for (name, hash) in &users {
            check_hash(hash)
                .map_err(|what| format!("basic_auth_users: the hash of `{name}` {what}"))?;
        }
        let tls = shape.tls_server_config.map(|shape| shape.check(directory));
        Ok(Self {
            users,
            tls: tls.transpose()?,
        })
    }
}

impl TlsShape {
    fn check(self, directory: &Path) -> Result<TlsFiles, String> {
        let authorities = self.client_ca_file.map(|path| directory.join(path));
        let client_authorities = match (self.client_auth_type.as_deref(), authorities) {
            (None | Some("NoClientCert" | ""), None) => None,
            (Some("RequireAndVerifyClientCert"), Some(path)) => Some(path),
            (Some("RequireAndVerifyClientCert"), None) => {
                return Err("tls_server_config: client_auth_type needs client_ca_file".to_owned());
            }
            (None | Some("NoClientCert" | ""), Some(_)) => {
                return Err("tls_server_config: client_ca_file has no meaning without \
                            `client_auth_type: RequireAndVerifyClientCert`"
                    .to_owned());
            }
            (Some(other), _) => {
                return Err(format!(
                    "tls_server_config: client_auth_type is {other}, must be NoClientCert or \
                     RequireAndVerifyClientCert"
                ));
            }
        };
        let only_tls13 = match self.min_version.as_deref() {
            None | Some("TLS12") => false,
            Some("TLS13") => true,
            Some(other) => {
                return Err(format!(
                    "tls_server_config: min_version is {other}, must be TLS12 or TLS13"
                ));
            }
        };
        Ok(TlsFiles {
            certificates: directory.join(self.cert_file),
            key: directory.join(self.key_file),
            client_authorities,
            only_tls13,
        })
    }
}

/// `$2y$10$` and 53 letters; the cost is bounded, since every client can cause it.
fn check_hash(hash: &str) -> Result<(), String> {
    let unfit = "is not a bcrypt hash, as printed by `htpasswd -nBC 10 NAME`";
    let mut parts = hash.split('$');
    let (none, version, cost) = (parts.next(), parts.next(), parts.next());
    let letters = parts.next().unwrap_or_default();
    let is_known = none == Some("") && matches!(version, Some("2a" | "2b" | "2y"));
    if !is_known || letters.len() != 53 || parts.next().is_some() {
        return Err(unfit.to_owned());
    }
    let cost: u8 = cost
        .and_then(|cost| cost.parse().ok())
        .ok_or_else(|| unfit.to_owned())?;
    if !COSTS.contains(&cost) {
        let (low, high) = (COSTS.start(), COSTS.end());
        return Err(format!("has cost {cost}, must be {low} to {high}"));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The example of exporter-toolkit's documentation.
    const ALICE: &str = "$2y$10$mDwo.lAisC94iLAyP81MCesa29IzH37oigHC/42V2pdJlUprsJPze";

    fn parse(text: &str) -> Result<WebConfig, String> {
        WebConfig::parse(text, Path::new("/etc/ros2probe"))
    }

    #[test]
    fn the_form_of_exporter_toolkit_is_read() {
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
    fn what_would_leave_the_listener_open_is_refused() {
        for (text, says) in [
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
            let error = parse(text).unwrap_err();
            assert!(error.contains(says), "{text}: {error}");
        }
        let slow = ALICE.replace("$10$", "$31$");
        let error = parse(&format!("basic_auth_users: {{a: {slow}}}")).unwrap_err();
        assert!(error.contains("cost 31"), "{error}");
    }
}
