//! The identity of a library's file as maps of processes show it.
//!
//! On btrfs and on some overlays, stat(2) returns another device or inode than maps. With that
//! identity, a library in use would count as another one than the installed library, and each of
//! its calls would count twice.

use std::fs::{self, File};
use std::io;
use std::os::fd::AsRawFd as _;
use std::path::Path;
use std::ptr;

use ros2probe_attach::mapped::LibraryId;

/// Number of bytes that are mapped: the kernel maps the whole page, and none of it is read.
const LENGTH: usize = 1;

/// Returns the identity of a file, which this process maps for a moment.
///
/// # Errors
/// Fails if the file cannot be opened or mapped.
pub fn id_as_mapped(path: &Path) -> io::Result<LibraryId> {
    let file = File::open(path)?;
    // SAFETY: a new mapping at an address of the kernel's choice touches no memory in use.
    let start = unsafe {
        libc::mmap(
            ptr::null_mut(),
            LENGTH,
            libc::PROT_READ,
            libc::MAP_PRIVATE,
            file.as_raw_fd(),
            0,
        )
    };
    if start == libc::MAP_FAILED {
        return Err(io::Error::last_os_error());
    }
    let maps = fs::read_to_string("/proc/self/maps");
    // SAFETY: the mapping of this length was created above, and nothing refers to it.
    unsafe { libc::munmap(start, LENGTH) };
    let found = mapped_at(&maps?, start.addr());
    found.ok_or_else(|| io::ErrorKind::NotFound.into())
}

/// Returns the identity of the file that is mapped at an address, from the lines of a map
/// (proc_pid_maps(5)).
fn mapped_at(maps: &str, address: usize) -> Option<LibraryId> {
    let start = format!("{address:08x}-");
    let line = maps.lines().find(|line| line.starts_with(&start))?;
    LibraryId::of_mapping(line).map(|(_, id)| id)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_file_at_an_address_is_found() {
        let maps = "00400000-00401000 r--p 00000000 fe:00 11 /usr/bin/talker\n\
            7f3da9800000-7f3da9a00000 r--p 00000000 00:2b 77 /opt/my robot/libfastdds.so\n";
        let found = |address| mapped_at(maps, address).map(|id| (id.device, id.inode));
        assert_eq!(found(0x40_0000), Some(("fe:00".to_owned(), 11)));
        assert_eq!(found(0x7f3d_a980_0000), Some(("00:2b".to_owned(), 77)));
        assert_eq!(found(0x7f3d), None);
    }

    #[test]
    fn a_file_has_the_inode_that_maps_show() {
        let own = fs::read_link("/proc/self/exe").unwrap();
        let id = id_as_mapped(&own).unwrap();
        let maps = fs::read_to_string("/proc/self/maps").unwrap();
        let of_it = format!(" {} {} ", id.device, id.inode);
        assert!(maps.lines().any(|line| line.contains(&of_it)), "{id:?}");
        assert!(id_as_mapped(Path::new("/nonexistent")).is_err());
    }
}
