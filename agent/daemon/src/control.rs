//! Selects the listeners of the control API from the configuration, the command line and the
//! service manager.

use std::fs;
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};

use crate::config::{Access, ApiSettings, SocketChoice};
use crate::surface::api::Server;
use anyhow::Result;
use ros2probe_capture::container::add;

use crate::agent::Listen;

/// Runtime directory of the package and of the service manager.
const DEFAULT_DIRECTORY: &str = "/run/ros2probe";
/// Variable of the service manager: directories, separated by colons.
const RUNTIME_DIRECTORY_VARIABLE: &str = "RUNTIME_DIRECTORY";
const SOCKET_NAME: &str = "api.sock";

/// Applies the command line to the configuration. By default, a report has no listener, since it
/// ends before a client could connect.
pub(crate) fn apply_options(
    settings: &mut ApiSettings,
    asked: Option<Listen>,
    loopback: Option<Access>,
    is_report: bool,
) {
    settings.loopback = loopback.unwrap_or(settings.loopback);
    match asked {
        Some(Listen(Some(address))) => settings.listen = Some(address),
        None if !is_report => {}
        Some(Listen(None)) | None => {
            settings.listen = None;
            settings.socket = SocketChoice::Off;
        }
    }
}

/// Binds the configured address, and reads the token.
pub(crate) fn open(settings: &ApiSettings) -> Result<Server> {
    let token = settings.token_file.as_deref();
    let mut server = Server::new(token, settings.loopback)?;
    if let Some(path) = token
        && fs::metadata(path).is_ok_and(|file| file.permissions().mode() & 0o004 != 0)
    {
        tracing::warn!(path = %path.display(), "every user of this host can read the token file");
    }
    if let Some(address) = settings.listen {
        server.bind(address)?;
    }
    Ok(server)
}

/// Binds the configured unix socket, which creates files.
pub(crate) fn open_socket(server: &mut Server, settings: &ApiSettings) -> Result<()> {
    match &settings.socket {
        SocketChoice::Off => {}
        SocketChoice::At(path) => server.bind_socket(path)?,
        SocketChoice::Auto => {
            if let Some(path) = socket()
                && let Err(error) = server.bind_socket(&path)
            {
                let reason = format!("{:#}", anyhow::anyhow!(error));
                let remedy = add("--volume ros2probe-run:/run/ros2probe");
                tracing::warn!(reason, "the control API has no unix socket{remedy}");
            }
        }
    }
    Ok(())
}

/// Returns the path of the agent's socket; `None` without a directory for it.
fn socket() -> Option<PathBuf> {
    let named = std::env::var_os(RUNTIME_DIRECTORY_VARIABLE).filter(|paths| !paths.is_empty());
    if let Some(paths) = named {
        return Some(std::env::split_paths(&paths).next()?.join(SOCKET_NAME));
    }
    let default = Path::new(DEFAULT_DIRECTORY);
    default.is_dir().then(|| default.join(SOCKET_NAME))
}
