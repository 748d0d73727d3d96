//! How this program was installed, and the commands that install another version the same way.

use std::env::consts::ARCH;
use std::ffi::OsStr;
use std::fmt;
use std::fs;
use std::path::{Path, PathBuf};

use serde::Serialize;

use super::{Feed, Location, Version};

/// Places of Python packages below a prefix, and of distributions of Debian.
const PYTHON_PACKAGES: [&str; 2] = ["site-packages", "dist-packages"];
/// Start of the names of directories in which uv caches the environments of `uvx`.
const UVX_CACHE: &str = "archive-v";

/// How this program was installed.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case", tag = "by")]
pub enum Installation {
    /// By a Debian package.
    Package {
        /// Whether a source of apt has it.
        has_repository: bool,
    },
    /// By a Python wheel.
    Wheel {
        /// Directory of the environment.
        prefix: PathBuf,
        /// Program that manages the environment.
        installer: Installer,
    },
    /// In the image, which has no shell.
    Image,
    /// By `cargo install`.
    Crate,
    /// As a single file.
    Binary {
        /// Path of the file.
        path: PathBuf,
    },
}

/// Program that manages the Python environment of a wheel.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Installer {
    /// `pip install`.
    Pip,
    /// `uv pip install` in an environment of `uv venv`, which has no pip.
    Uv,
    /// `uv tool install`.
    UvTool,
    /// `uvx`, which keeps the environment in its cache.
    Uvx,
    /// `pipx install`.
    Pipx,
}

impl Installation {
    /// Finds how `program` was installed below the directory `root`, which is `/` except in tests.
    #[must_use]
    pub fn find(program: &Path, root: &Path) -> Self {
        let listed = fs::read_to_string(root.join("var/lib/dpkg/info/ros2probe.list"));
        let is_listed = |list: String| list.lines().any(|line| Path::new(line) == program);
        if listed.is_ok_and(is_listed) {
            return Self::Package {
                has_repository: has_file(&root.join("etc/apt/sources.list.d"), |name| {
                    name.starts_with("ros2probe.")
                }),
            };
        }
        let prefix = program.parent().and_then(Path::parent);
        let prefix = prefix.unwrap_or(Path::new("/"));
        if has_wheel(prefix) {
            return Self::Wheel {
                prefix: prefix.to_owned(),
                installer: Installer::of(prefix),
            };
        }
        let crates = fs::read_to_string(prefix.join(".crates.toml"));
        if crates.is_ok_and(|crates| crates.contains("\"ros2probe ")) {
            return Self::Crate;
        }
        if !root.join("bin/sh").exists() {
            return Self::Image;
        }
        let path = program.to_owned();
        Self::Binary { path }
    }

    /// Returns name and checksum of the release's file for this installation.
    pub(super) fn file<'a>(&self, feed: &'a Feed) -> Option<(&'a str, &'a str)> {
        let version = feed.version;
        let debian = match ARCH {
            "x86_64" => "amd64",
            "aarch64" => "arm64",
            other => other,
        };
        let is_it = |name: &str| match self {
            Self::Package { .. } => name == format!("ros2probe_{version}_{debian}.deb"),
            Self::Wheel { .. } => {
                name.starts_with(&format!("ros2probe-{version}-"))
                    && name.ends_with(&format!("_{ARCH}.whl"))
            }
            Self::Image => name == format!("ros2probe-{version}-image.tar"),
            Self::Crate => name == format!("ros2probe-{version}.crate"),
            Self::Binary { .. } => name == format!("rp-{version}-{ARCH}"),
        };
        let found = feed.files.iter().find(|(name, _)| is_it(name));
        found.map(|(name, sum)| (name.as_str(), sum.as_str()))
    }

    /// Returns the commands that install this version. `file` is the release's file for it.
    pub(super) fn commands(&self, version: Version, file: Option<&Location>) -> Vec<String> {
        let local = |name: &str| match file {
            Some(Location::Path(path)) => (None, quoted(path)),
            Some(Location::Address(address)) => (
                Some(format!("curl --fail --location --output {name} {address}")),
                format!("./{name}"),
            ),
            None => (None, name.to_owned()),
        };
        match self {
            Self::Package {
                has_repository: true,
            } => vec![
                "sudo apt update".to_owned(),
                "sudo apt install ros2probe".to_owned(),
            ],
            Self::Package { .. } => {
                let (download, file) = local("ros2probe.deb");
                download
                    .into_iter()
                    .chain([format!("sudo apt install {file}")])
                    .collect()
            }
            Self::Wheel { prefix, installer } => {
                let file = match file {
                    Some(Location::Path(path)) => quoted(path),
                    Some(Location::Address(address)) => address.to_string(),
                    None => format!("ros2probe=={version}"),
                };
                vec![installer.command(prefix, &file)]
            }
            Self::Image => {
                let (download, file) = local("ros2probe-image.tar");
                download
                    .into_iter()
                    .chain([
                        format!("podman load --input {file}"),
                        format!("# then run the container with the image ros2probe:{version}"),
                    ])
                    .collect()
            }
            Self::Crate => vec![format!("cargo install --locked ros2probe@{version}")],
            Self::Binary { path } => {
                let (download, file) = local("rp");
                let place = quoted(path);
                download
                    .into_iter()
                    .chain([format!("sudo install -m 755 {file} {place}")])
                    .collect()
            }
        }
    }
}

impl fmt::Display for Installation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Package { .. } => f.write_str("by the Debian package"),
            Self::Wheel { prefix, installer } => {
                let (installer, prefix) = (installer.name(), prefix.display());
                write!(f, "by a Python wheel in {prefix} ({installer})")
            }
            Self::Image => f.write_str("in the image of a container"),
            Self::Crate => f.write_str("by cargo"),
            Self::Binary { path } => write!(f, "as the file {}", path.display()),
        }
    }
}

impl Installer {
    /// Finds the program that manages the environment in this directory by the files that it keeps
    /// there.
    fn of(prefix: &Path) -> Self {
        if prefix.join("uv-receipt.toml").exists() {
            return Self::UvTool;
        }
        if prefix.join("pipx_metadata.json").exists() {
            return Self::Pipx;
        }
        let settings = fs::read_to_string(prefix.join("pyvenv.cfg")).unwrap_or_default();
        if !settings.lines().any(|line| line.starts_with("uv = ")) {
            return Self::Pip;
        }
        let above = prefix.parent().and_then(Path::file_name);
        match above.and_then(OsStr::to_str) {
            Some(name) if name.starts_with(UVX_CACHE) => Self::Uvx,
            _ => Self::Uv,
        }
    }

    const fn name(self) -> &'static str {
        match self {
            Self::Pip => "pip",
            Self::Uv => "uv",
            Self::UvTool => "uv tool",
            Self::Uvx => "uvx",
            Self::Pipx => "pipx",
        }
    }

    /// Returns the command that installs a wheel or a requirement, which is one word of a shell.
    fn command(self, prefix: &Path, file: &str) -> String {
        let python = prefix.join("bin/python3");
        match self {
            // `pip install --user` and Debian's pip use a Python of another prefix.
            Self::Pip if !python.exists() => format!("python3 -m pip install {file}"),
            Self::Pip => format!("{} -m pip install {file}", quoted(&python)),
            Self::Uv => format!("uv pip install --python {} {file}", quoted(&python)),
            Self::UvTool => format!("uv tool install {file}"),
            Self::Uvx => format!("uvx --from {file} rp --version"),
            Self::Pipx => format!("pipx install --force {file}"),
        }
    }
}

/// Returns whether a wheel has installed ros2probe below this prefix.
fn has_wheel(prefix: &Path) -> bool {
    let Ok(versions) = fs::read_dir(prefix.join("lib")) else {
        return false;
    };
    versions.flatten().any(|version| {
        PYTHON_PACKAGES.iter().any(|packages| {
            has_file(&version.path().join(packages), |name| {
                name.starts_with("ros2probe-") && name.ends_with(".dist-info")
            })
        })
    })
}

fn has_file(directory: &Path, is_it: impl Fn(&str) -> bool) -> bool {
    let Ok(entries) = fs::read_dir(directory) else {
        return false;
    };
    entries
        .flatten()
        .any(|entry| entry.file_name().to_str().is_some_and(&is_it))
}

/// Returns a path as one word of a shell.
fn quoted(path: &Path) -> String {
    let path = path.display().to_string();
    let is_plain = |c: char| c.is_alphanumeric() || "/._+-~".contains(c);
    if path.chars().all(is_plain) {
        return path;
    }
    format!("'{}'", path.replace('\'', r"'\''"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn write(root: &Path, path: &str, text: &str) {
        let path = root.join(path);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, text).unwrap();
    }

    #[test]
    fn an_installation_is_recognized_by_what_its_installer_wrote() {
        let root = tempfile::tempdir().unwrap();
        let root = root.path();
        let find = |program: &Path| Installation::find(program, root);
        let usual = Path::new("/usr/bin/rp");
        assert_eq!(find(usual), Installation::Image);
        write(root, "bin/sh", "");
        let path = usual.to_owned();
        assert_eq!(find(usual), Installation::Binary { path });

        write(
            root,
            "var/lib/dpkg/info/ros2probe.list",
            "/.\n/usr/bin/rp\n",
        );
        let package = |has_repository| Installation::Package { has_repository };
        assert_eq!(find(usual), package(false));
        write(root, "etc/apt/sources.list.d/ros2probe.list", "deb ...");
        assert_eq!(find(usual), package(true));

        // Another program on the same host.
        let path = root.join("home/bin/rp");
        assert_eq!(find(&path), Installation::Binary { path: path.clone() });
        write(root, "home/.crates.toml", "\"ros2probe 0.1.0 (x)\" = []");
        assert_eq!(find(&path), Installation::Crate);

        let prefix = root.join("venv");
        let info = "venv/lib/python3.12/site-packages/ros2probe-0.1.0.dist-info/RECORD";
        write(root, info, "");
        let program = prefix.join("bin/rp");
        let installer = Installer::Pip;
        assert_eq!(find(&program), Installation::Wheel { prefix, installer });
    }

    #[test]
    fn the_command_for_a_wheel_is_of_the_program_that_manages_its_environment() {
        let root = tempfile::tempdir().unwrap();
        let root = root.path();
        let own = "home = /usr/bin\nuv = 0.13.9\n";
        for (place, file, text, installer, command) in [
            (
                "venv",
                "bin/python3",
                "",
                "pip",
                "PREFIX/bin/python3 -m pip install ./new.whl",
            ),
            (
                ".local",
                "bin/rp",
                "",
                "pip",
                "python3 -m pip install ./new.whl",
            ),
            (
                "uv/venv",
                "pyvenv.cfg",
                own,
                "uv",
                "uv pip install --python PREFIX/bin/python3 ./new.whl",
            ),
            (
                "share/uv/tools/ros2probe",
                "uv-receipt.toml",
                "[tool]\nrequirements = [{ name = \"ros2probe\" }]\n",
                "uv tool",
                "uv tool install ./new.whl",
            ),
            (
                "cache/uv/archive-v0/hY2NIJPeE_XUuAYg",
                "pyvenv.cfg",
                own,
                "uvx",
                "uvx --from ./new.whl rp --version",
            ),
            (
                "share/pipx/venvs/ros2probe",
                "pipx_metadata.json",
                "{\"environment\": \"ros2probe\"}",
                "pipx",
                "pipx install --force ./new.whl",
            ),
        ] {
            let prefix = root.join(place);
            let record = "lib/python3.11/site-packages/ros2probe-0.1.0.dist-info/RECORD";
            write(&prefix, record, "");
            write(&prefix, file, text);
            let found = Installation::find(&prefix.join("bin/rp"), root);
            let shown = format!("by a Python wheel in {} ({installer})", prefix.display());
            assert_eq!(found.to_string(), shown);
            let Installation::Wheel { prefix, installer } = found else {
                panic!("not a wheel: {place}");
            };
            let prefix_shown = prefix.display().to_string();
            let expected = command.replace("PREFIX", &prefix_shown);
            assert_eq!(installer.command(&prefix, "./new.whl"), expected);
        }
        // Both managers may have made the environment with uv.
        write(root, "share/pipx/venvs/ros2probe/pyvenv.cfg", own);
        let prefix = root.join("share/pipx/venvs/ros2probe");
        assert_eq!(Installer::of(&prefix), Installer::Pipx);
    }

    #[test]
    fn paths_are_one_word_of_a_shell() {
        assert_eq!(quoted(Path::new("/a/b-1.deb")), "/a/b-1.deb");
        assert_eq!(quoted(Path::new("/a b/it's")), r"'/a b/it'\''s'");
    }
}
