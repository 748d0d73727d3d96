//! A package unpacked with Debian's own tools.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context as _, Result, ensure};

use super::succeed;

pub(crate) struct Archive {
    /// Files by path, without directories.
    pub(crate) files: BTreeMap<String, Entry>,
    /// Fields of the control file.
    pub(crate) control: BTreeMap<String, String>,
    /// Modes of the other control files.
    pub(crate) scripts: BTreeMap<String, u32>,
    pub(crate) conffiles: String,
    /// Members of the `ar` archive.
    pub(crate) members: Vec<String>,
    unpacked: tempfile::TempDir,
}

#[derive(Debug)]
pub(crate) struct Entry {
    pub(crate) mode: u32,
    /// Ids of user and group.
    pub(crate) owner: String,
}

impl Archive {
    pub(crate) fn open(package: &Path) -> Result<Self> {
        let unpacked = tempfile::tempdir()?;
        let of = |option: &str| {
            let mut command = Command::new("dpkg-deb");
            command.arg(option).arg(package);
            command
        };
        succeed(of("--raw-extract").arg(unpacked.path()))?;
        let fields = succeed(&mut of("--field"))?;
        let control = unpacked.path().join("DEBIAN");
        let members = succeed(Command::new("ar").arg("t").arg(package))?;
        Ok(Self {
            files: listed(package, "--fsys-tarfile")?,
            control: fields
                .lines()
                .filter_map(|line| line.split_once(": "))
                .map(|(name, value)| (name.to_owned(), value.to_owned()))
                .collect(),
            scripts: listed(package, "--ctrl-tarfile")?
                .into_iter()
                .map(|(path, entry)| (path, entry.mode))
                .collect(),
            conffiles: std::fs::read_to_string(control.join("conffiles"))?,
            members: members.lines().map(str::to_owned).collect(),
            unpacked,
        })
    }

    pub(crate) fn path(&self, path: &str) -> PathBuf {
        self.unpacked.path().join(path)
    }

    /// Runs `man` as lintian does.
    pub(crate) fn manual_is_readable(&self, page: &str) -> Result<()> {
        let mut man = Command::new("man");
        man.args(["--warnings", "-E", "UTF-8", "-l"]);
        man.arg(self.path(page))
            .envs([("MANWIDTH", "80"), ("LC_ALL", "C.UTF-8")]);
        let output = man.output().context("man; `apt-get install man-db`")?;
        let printed = String::from_utf8_lossy(&output.stdout);
        let complaints = String::from_utf8_lossy(&output.stderr);
        ensure!(
            output.status.success() && complaints.is_empty(),
            "{page}: {complaints}"
        );
        ensure!(printed.contains("SYNOPSIS"), "{page}:\n{printed}");
        Ok(())
    }

    /// Checks for dates, which would differ from build to build.
    pub(crate) fn compressed_without_dates(&self) -> Result<()> {
        for path in self.files.keys().filter(|path| path.ends_with(".gz")) {
            let bytes = std::fs::read(self.path(path))?;
            ensure!(bytes.get(4..8) == Some(&[0; 4][..]), "{path} has a date");
        }
        Ok(())
    }
}

/// Returns the files of one of the package's two archives.
fn listed(package: &Path, which: &str) -> Result<BTreeMap<String, Entry>> {
    let mut list = Command::new("sh");
    list.args([
        "-c",
        "dpkg-deb $1 \"$2\" | tar --numeric-owner -tv",
        "sh",
        which,
    ])
    .arg(package);
    let mut entries = BTreeMap::new();
    for line in succeed(&mut list)?.lines() {
        let mut words = line.split_whitespace();
        let (mode, owner) = (
            words.next().unwrap_or_default(),
            words.next().unwrap_or_default(),
        );
        let path = words.nth(3).with_context(|| line.to_owned())?;
        if !mode.starts_with('d') {
            let entry = Entry {
                mode: bits(mode),
                owner: owner.to_owned(),
            };
            entries.insert(path.trim_start_matches("./").to_owned(), entry);
        }
    }
    Ok(entries)
}

/// Parses `-rwxr-xr-x` as a number.
fn bits(mode: &str) -> u32 {
    mode.chars()
        .skip(1)
        .fold(0, |bits, one| (bits << 1) | u32::from(one != '-'))
}
