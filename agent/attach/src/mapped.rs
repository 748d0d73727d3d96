//! Files of a library that a process maps, from `/proc/<pid>/maps` (proc_pid_maps(5)).

use std::fs::File;
use std::io::{self, Read as _};
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::functions::Library;

/// Files of Fast DDS's shared memory, which every sender and receiver maps, even if it is linked
/// statically.
const SHARED_MEMORY_PREFIXES: [&str; 2] = ["/dev/shm/fastrtps_", "/dev/shm/fastdds_"];
/// Suffix of a replaced or removed file.
const DELETED_SUFFIX: &str = " (deleted)";
/// Maximum number of bytes read of one process's map: some forty thousand mappings.
const MAX_TEXT: u64 = 4 << 20;
/// Maximum number of files of the library in one process; further ones are left out.
pub const MAX_LIBRARIES: usize = 65;

/// Device and inode of a library's file, as in the processes' maps.
#[derive(Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LibraryId {
    /// `major:minor`, as the kernel writes it.
    pub device: String,
    /// Inode of the file.
    pub inode: u64,
}

impl LibraryId {
    /// Parses a line of a map. Returns the address range, as the kernel writes it, and the file;
    /// `None` if the line is malformed.
    #[must_use]
    pub fn of_mapping(line: &str) -> Option<(&str, Self)> {
        // A line has range, permissions, offset, device and inode; the rest is the path.
        let mut fields = line.split_ascii_whitespace();
        let (range, device, inode) = (fields.next()?, fields.nth(2)?, fields.next()?);
        let (device, inode) = (device.to_owned(), inode.parse().ok()?);
        Some((range, Self { device, inode }))
    }
}

/// A library in a process.
#[derive(Clone, PartialEq, Eq, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Mapped {
    /// Identity of the file.
    pub id: LibraryId,
    /// Path of the file in the process's own file system.
    pub path: PathBuf,
    /// First address range of the file, as the kernel writes it.
    pub range: String,
}

/// Files of the library, and of Fast DDS's shared memory, that a process maps.
#[derive(Clone, Default, PartialEq, Eq, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Use {
    /// At most [`MAX_LIBRARIES`] files of the library.
    pub libraries: Vec<Mapped>,
    /// Whether the process maps files of Fast DDS's shared memory.
    pub shares: bool,
}

impl Use {
    /// Parses the text of `/proc/<pid>/maps`.
    #[must_use]
    pub fn parse(text: &str, library: Library) -> Self {
        let mut found = Self::default();
        for line in text.lines() {
            let Some(path) = line.find('/').and_then(|at| line.get(at..)) else {
                continue;
            };
            found.shares |= SHARED_MEMORY_PREFIXES
                .iter()
                .any(|start| path.starts_with(start));
            let name = path.rsplit('/').next().unwrap_or_default();
            let is_library = library.has_name(name.strip_suffix(DELETED_SUFFIX).unwrap_or(name));
            if is_library && let Some((range, id)) = LibraryId::of_mapping(line) {
                let is_known = found.libraries.iter().any(|known| known.id == id);
                if !is_known && found.libraries.len() < MAX_LIBRARIES {
                    let (path, range) = (PathBuf::from(path), range.to_owned());
                    found.libraries.push(Mapped { id, path, range });
                }
            }
        }
        found
    }

    /// Reads the map of a process.
    ///
    /// # Errors
    /// Fails if the process has ended, or if the right to inspect it is missing.
    pub fn read(process: u32, library: Library) -> io::Result<Self> {
        let mut bytes = Vec::new();
        let file = File::open(format!("/proc/{process}/maps"))?;
        file.take(MAX_TEXT).read_to_end(&mut bytes)?;
        Ok(Self::parse(&String::from_utf8_lossy(&bytes), library))
    }

    /// Returns whether the process uses the library at all. A process that links Fast DDS
    /// statically maps only its shared memory.
    #[must_use]
    pub fn is_any(&self) -> bool {
        self.shares || !self.libraries.is_empty()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn libraries_and_shared_memory_are_found_in_a_map() {
        let text = "\
563200000000-563200001000 r--p 00000000 fe:00 11   /usr/bin/talker
7f3da9800000-7f3da9a00000 r--p 00000000 fe:00 1234 /usr/lib/x86_64-linux-gnu/libfastrtps.so.2.9.1
7f3da9a00000-7f3da9f00000 r-xp 00200000 fe:00 1234 /usr/lib/x86_64-linux-gnu/libfastrtps.so.2.9.1
7f3daa000000-7f3daa100000 r-xp 00000000 00:2b 77   /opt/my robot/libfastdds.so
7f3daa200000-7f3daa300000 r-xp 00000000 fe:00 9    /usr/lib/libfastrtps.so.2.6 (deleted)
7f3dab000000-7f3dab100000 rw-s 00000000 00:1a 5    /dev/shm/fastrtps_0011aabbccddeeff
7f3dac000000-7f3dac100000 rw-p 00000000 00:00 0    [heap]
";
        let found = Use::parse(text, Library::FastDds);
        let libraries: Vec<_> = found
            .libraries
            .iter()
            .map(|library| {
                (
                    &library.range[..12],
                    library.id.inode,
                    library.path.to_str().unwrap(),
                )
            })
            .collect();
        assert_eq!(
            libraries,
            [
                (
                    "7f3da9800000",
                    1234,
                    "/usr/lib/x86_64-linux-gnu/libfastrtps.so.2.9.1"
                ),
                ("7f3daa000000", 77, "/opt/my robot/libfastdds.so"),
                ("7f3daa200000", 9, "/usr/lib/libfastrtps.so.2.6 (deleted)"),
            ]
        );
        assert!(found.shares && found.is_any());
    }

    #[test]
    fn files_with_similar_names_are_not_libraries() {
        for path in [
            "/usr/lib/libfastrtpsx.so.2",
            "/usr/lib/librmw_fastrtps_cpp.so",
            "/usr/lib/libfastrtps.sock",
            "/dev/shm/other",
            "[vdso]",
            "",
        ] {
            let line = format!("7f0000000000-7f0000001000 r-xp 00000000 fe:00 1 {path}\n");
            assert!(!Use::parse(&line, Library::FastDds).is_any(), "{path}");
        }
        let nonsense = "nonsense /usr/lib/libfastdds.so";
        assert!(!Use::parse(nonsense, Library::FastDds).is_any());
    }

    #[test]
    fn a_process_with_too_many_libraries_keeps_the_first_ones() {
        let line = |inode| {
            format!("7f0000000000-7f0000001000 r-xp 00000000 fe:00 {inode} /libfastdds.so\n")
        };
        let text: String = (1..=1000).map(line).collect();
        let found = Use::parse(&text, Library::FastDds);
        assert_eq!(found.libraries.len(), MAX_LIBRARIES);
        assert_eq!(
            found.libraries.last().unwrap().id.inode,
            MAX_LIBRARIES as u64
        );
    }
}
