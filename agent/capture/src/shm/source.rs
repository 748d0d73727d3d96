//! Byte source of the readers of Fast DDS's layout: a file of shared memory, or bytes in a test.
//!
//! Untrusted processes write during reads. Therefore everything is read in bounded pieces with
//! `pread`, and nothing is mapped. A truncated file gives a short read where a mapping would give
//! SIGBUS, and no reference into changing memory ever exists. A read costs 0.4 us, waking up costs
//! 20 us (measured on one machine), so a mapping would save little. Each `pread` takes and releases
//! the page with fully ordered atomics, so successive reads are ordered. Checks that read a word
//! before and after a copy rely on this order.

use std::fs::File;
use std::io;
use std::os::unix::fs::{FileExt as _, MetadataExt as _, OpenOptionsExt as _};
use std::path::Path;

/// Bytes that can be read at an offset.
pub trait Source {
    /// Fills `into` from `offset`; returns `false` if some of the bytes do not exist.
    fn read(&self, offset: u64, into: &mut [u8]) -> bool;

    /// Reads a little-endian 32-bit word; `None` if its bytes do not exist.
    fn word(&self, offset: u64) -> Option<u32> {
        let mut bytes = [0; 4];
        self.read(offset, &mut bytes)
            .then(|| u32::from_le_bytes(bytes))
    }

    /// Reads a little-endian 64-bit word; `None` if its bytes do not exist.
    fn u64_at(&self, offset: u64) -> Option<u64> {
        let mut bytes = [0; 8];
        self.read(offset, &mut bytes)
            .then(|| u64::from_le_bytes(bytes))
    }
}

impl Source for [u8] {
    fn read(&self, offset: u64, into: &mut [u8]) -> bool {
        let start = usize::try_from(offset).unwrap_or(usize::MAX);
        let piece = start
            .checked_add(into.len())
            .and_then(|end| self.get(start..end));
        if let Some(piece) = piece {
            into.copy_from_slice(piece);
        }
        piece.is_some()
    }
}

/// A file of shared memory, opened for reading only.
#[derive(Debug)]
pub struct SharedFile {
    file: File,
    inode: u64,
    user: u32,
}

impl SharedFile {
    /// Opens a regular file; follows no link and does not block.
    ///
    /// # Errors
    /// Fails if the file does not exist, is not a regular file, or is not readable.
    pub fn open(path: &Path) -> io::Result<Self> {
        let file = File::options()
            .read(true)
            .custom_flags(libc::O_NOFOLLOW | libc::O_NONBLOCK | libc::O_NOCTTY)
            .open(path)?;
        let metadata = file.metadata()?;
        if !metadata.is_file() {
            return Err(io::Error::from(io::ErrorKind::InvalidInput));
        }
        Ok(Self {
            file,
            inode: metadata.ino(),
            user: metadata.uid(),
        })
    }

    /// Returns the inode of the open file, whichever file its name refers to now.
    #[must_use]
    pub const fn inode(&self) -> u64 {
        self.inode
    }

    /// Returns the user id of the file's owner.
    #[must_use]
    pub const fn user(&self) -> u32 {
        self.user
    }

    /// Returns whether the file is unlinked: keeping it open keeps its memory allocated.
    #[must_use]
    pub fn is_unlinked(&self) -> bool {
        self.file
            .metadata()
            .is_ok_and(|metadata| metadata.nlink() == 0)
    }
}

impl Source for SharedFile {
    fn read(&self, offset: u64, into: &mut [u8]) -> bool {
        self.file.read_exact_at(into, offset).is_ok()
    }
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::os::unix::fs::symlink;

    use super::*;

    #[test]
    fn a_read_beyond_the_end_of_a_truncated_file_fails() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("f");
        fs::write(&path, vec![7; 10_000]).unwrap();
        let file = SharedFile::open(&path).unwrap();
        let mut into = [0; 100];
        assert!(file.read(9_900, &mut into));
        assert_eq!(into, [7; 100]);
        assert!(!file.read(9_901, &mut into));
        fs::File::options()
            .write(true)
            .open(&path)
            .unwrap()
            .set_len(50)
            .unwrap();
        assert!(!file.read(9_000, &mut into));
        assert!(!file.read(u64::MAX - 10, &mut into));
        assert_eq!(file.word(0), Some(0x0707_0707));
        assert_eq!(file.u64_at(46), None);
    }

    #[test]
    fn a_removed_file_counts_as_unlinked() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("f");
        fs::write(&path, "x").unwrap();
        let file = SharedFile::open(&path).unwrap();
        assert!(!file.is_unlinked());
        fs::remove_file(&path).unwrap();
        fs::write(&path, "y").unwrap();
        assert!(file.is_unlinked());
        assert_ne!(SharedFile::open(&path).unwrap().inode(), file.inode());
    }

    #[test]
    fn only_regular_files_are_opened_and_a_pipe_does_not_block() {
        let directory = tempfile::tempdir().unwrap();
        let (file, link) = (directory.path().join("f"), directory.path().join("l"));
        fs::write(&file, "x").unwrap();
        symlink(&file, &link).unwrap();
        assert!(SharedFile::open(&link).is_err());
        assert!(SharedFile::open(directory.path()).is_err());
        let pipe = directory.path().join("p");
        let made = std::process::Command::new("mkfifo").arg(&pipe).status();
        assert!(made.unwrap().success());
        // A blocking open of a pipe without a writer never returns.
        assert!(SharedFile::open(&pipe).is_err());
    }

    #[test]
    fn a_read_beyond_the_end_of_a_slice_fails() {
        let bytes = [1, 2, 3, 4, 5, 6, 7, 8, 9];
        assert_eq!(bytes.word(5), Some(0x0908_0706));
        assert_eq!(bytes.word(6), None);
        assert_eq!(bytes.u64_at(1), Some(0x0908_0706_0504_0302));
        assert_eq!(bytes.word(u64::MAX), None);
    }
}
