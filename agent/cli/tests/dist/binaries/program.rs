//! The tested binaries, and how they run on this machine.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// A released binary, or a substitute for one.
pub struct Binary {
    pub architecture: &'static str,
    pub path: PathBuf,
}

/// Returns the static binaries: both of `ROS2PROBE_DIST`, else the one that `make arm` has built.
pub fn shipped() -> Vec<Binary> {
    let binary = |architecture| Binary {
        architecture,
        path: released(architecture).unwrap_or_else(unoptimized),
    };
    match directory() {
        Some(_) => vec![binary("x86_64"), binary("aarch64")],
        None => vec![binary("aarch64")],
    }
}

/// Returns the shipped binaries and the tests' own.
pub fn all() -> Vec<PathBuf> {
    let own = PathBuf::from(env!("CARGO_BIN_EXE_rp"));
    let shipped = shipped().into_iter().map(|binary| binary.path);
    shipped.chain([own]).collect()
}

/// Returns the directory of the release binaries, if the tests cover them.
pub fn directory() -> Option<PathBuf> {
    std::env::var_os("ROS2PROBE_DIST").map(PathBuf::from)
}

fn released(architecture: &str) -> Option<PathBuf> {
    let version = env!("CARGO_PKG_VERSION");
    Some(directory()?.join(format!("rp-{version}-{architecture}")))
}

/// Returns the unoptimized binary below the directory of all builds.
fn unoptimized() -> PathBuf {
    let target = Path::new(env!("CARGO_TARGET_TMPDIR")).parent().unwrap();
    let path = target.join("aarch64-unknown-linux-musl/debug/rp");
    assert!(path.exists(), "no {}: `make arm` builds it", path.display());
    path
}

/// A program that can be run here.
pub struct Program {
    architecture: &'static str,
    path: PathBuf,
}

impl Program {
    /// Returns the program for this machine.
    pub fn native() -> Self {
        let architecture = std::env::consts::ARCH;
        let own = || PathBuf::from(env!("CARGO_BIN_EXE_rp"));
        Self {
            architecture,
            path: released(architecture).unwrap_or_else(own),
        }
    }

    /// Returns the program for aarch64, such as Jetsons and Raspberry Pis.
    pub fn arm() -> Self {
        Self {
            architecture: "aarch64",
            path: released("aarch64").unwrap_or_else(unoptimized),
        }
    }

    pub fn architecture(&self) -> &'static str {
        self.architecture
    }

    pub fn file_name(&self) -> String {
        let name = self.path.file_name().unwrap();
        name.to_string_lossy().into_owned()
    }

    /// Returns a name that differs even if both programs are for one architecture.
    pub fn name(&self) -> String {
        let kind = self
            .path
            .parent()
            .and_then(Path::parent)
            .and_then(Path::file_name);
        let kind = kind.map(|name| name.to_string_lossy().into_owned());
        format!("{}-{}", self.architecture, kind.unwrap_or_default())
    }

    /// Returns a command that uses qemu on a machine of another architecture.
    pub fn command(&self) -> Command {
        command(self.architecture, &self.path)
    }

    pub fn run(&self, arguments: &[&str]) -> Output {
        let mut command = self.command();
        let output = command.args(arguments).output();
        output.unwrap_or_else(|error| panic!("{command:?}: {error}"))
    }
}

/// Returns a command for a binary, which uses qemu on a machine of another architecture.
pub fn command(architecture: &str, binary: &Path) -> Command {
    let mut command = if architecture == std::env::consts::ARCH {
        Command::new(binary)
    } else {
        let mut qemu = Command::new(emulator(architecture));
        qemu.arg(binary);
        qemu
    };
    for variable in [
        "RUST_LOG",
        "NOTIFY_SOCKET",
        "RUNTIME_DIRECTORY",
        "ROS_DISTRO",
    ] {
        command.env_remove(variable);
    }
    command
        .env_remove("ROS_DOMAIN_ID")
        .env_remove("AMENT_PREFIX_PATH");
    command
}

/// Returns the emulator unpacked by `.ci/prerequisites.sh`, else the installed one.
fn emulator(architecture: &str) -> PathBuf {
    let name = format!("qemu-{architecture}-static");
    let unpacked = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../../target/tools/usr/bin")
        .join(&name);
    if unpacked.exists() {
        unpacked
    } else {
        name.into()
    }
}
