//! The lock of a bag that is being written: `flock` on its directory. The kernel releases it when the
//! writer ends, also if it is killed. A paused recording and one between two files hold it.

use std::fs::File;
use std::path::Path;

use rustix::fs::{FlockOperation, flock};
use rustix::io::Errno;

/// Locks a bag until the file is dropped; `None` if the file system supports no locks.
pub(crate) fn hold(directory: &Path) -> Option<File> {
    let file = File::open(directory).ok()?;
    // Only `is_held` takes the lock as well, and releases it at once.
    flock(&file, FlockOperation::LockExclusive).ok()?;
    Some(file)
}

/// Returns whether a writer holds the lock of a bag. Bags of other programs are never locked.
#[must_use]
pub fn is_held(directory: &Path) -> bool {
    let Ok(file) = File::open(directory) else {
        return false;
    };
    let locked = flock(&file, FlockOperation::NonBlockingLockShared);
    locked == Err(Errno::WOULDBLOCK)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Options, Writer};
    use std::collections::BTreeMap;

    #[test]
    fn a_bag_is_locked_until_its_writer_ends() {
        let directory = tempfile::tempdir().unwrap();
        let paths = ["closed", "dropped"].map(|name| directory.path().join(name));
        let writers = paths
            .each_ref()
            .map(|path| Writer::create(path, Options::default()).unwrap());
        assert!(paths.iter().all(|path| is_held(path)));
        let [closed, dropped] = writers;
        closed.close(BTreeMap::new()).unwrap();
        assert!(!is_held(&paths[0]));
        assert!(is_held(&paths[1]));
        drop(dropped);
        assert!(!is_held(&paths[1]));
        assert!(!is_held(&directory.path().join("missing")));
    }
}
