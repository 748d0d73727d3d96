//! Whether a newer version is released, where it is, and the commands that install it here.
//!
//! The feed is a file of a release. Nothing here reads it unless a person runs the command. It is
//! not trusted: names and numbers that could be part of another command are refused. A checksum in
//! it proves only that a file belongs to the feed; the signature of the release proves its origin.

mod feed;
mod fetch;
mod installation;

use std::fmt;

use ros2probe_daemon::escape::visible;
use serde::Serialize;

pub use feed::{ContentError, Feed, FeedError, InvalidLocation, InvalidVersion, Location, Version};
pub use fetch::FetchError;
pub use installation::{Installation, Installer};

/// A comparison of this program with a feed.
#[derive(Debug, Serialize)]
pub struct Comparison {
    installed: Version,
    newest: Version,
    is_newer: bool,
    feed: String,
    installation: Installation,
    /// Path or address of the newer file for this installation, if the release has one.
    file: Option<String>,
    sha256: Option<String>,
    notes: String,
    /// Commands that install the newer version.
    commands: Vec<String>,
}

impl Comparison {
    /// Compares the version of this program with that of the feed.
    #[must_use]
    pub fn new(installed: Version, feed: &Feed, at: &Location, installation: Installation) -> Self {
        let newest = feed.version;
        let is_newer = newest > installed;
        let found = installation.file(feed).filter(|_| is_newer);
        let file = found.map(|(name, _)| at.sibling(name));
        Self {
            installed,
            newest,
            is_newer,
            feed: at.to_string(),
            sha256: found.map(|(_, sum)| sum.to_owned()),
            notes: feed.notes.clone(),
            commands: match is_newer {
                true => installation.commands(newest, file.as_ref()),
                false => Vec::new(),
            },
            file: file.map(|file| file.to_string()),
            installation,
        }
    }

    /// Returns whether the feed has a newer version.
    #[must_use]
    pub const fn is_newer(&self) -> bool {
        self.is_newer
    }
}

impl fmt::Display for Comparison {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            installed, newest, ..
        } = self;
        if !self.is_newer {
            return writeln!(
                f,
                "rp {installed} is the newest version: {} has {newest}.",
                visible(&self.feed)
            );
        }
        writeln!(
            f,
            "ros2probe {newest} is available. This is {installed}, installed {}.",
            self.installation
        )?;
        if let (Some(file), Some(sum)) = (&self.file, &self.sha256) {
            writeln!(f, "  file    {}", visible(file))?;
            writeln!(f, "  sha256  {sum}")?;
        }
        writeln!(f, "  notes   {}", visible(&self.notes))?;
        writeln!(f, "To upgrade:")?;
        for command in &self.commands {
            writeln!(f, "  {}", visible(command))?;
        }
        Ok(())
    }
}
