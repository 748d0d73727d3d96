//! When space is needed for new bags.

use std::fs;
use std::io;
use std::path::Path;

use crate::settings::SpaceLimits;

/// Space of a file system, in bytes.
#[derive(Clone, Copy, Debug)]
struct Space {
    size: u64,
    free: u64,
}

/// Returns whether delivered bags should be deleted: less than twice the reserve of recordings is
/// free, or all bags together take nine tenths of their limit.
pub(crate) fn is_needed(directory: &Path, limits: SpaceLimits) -> bool {
    let space = space(directory);
    space.is_ok_and(|space| is_space_low(space, limits))
        || limits
            .max_total_bytes
            .is_some_and(|limit| used(directory) >= limit - limit / 10)
}

fn is_space_low(space: Space, limits: SpaceLimits) -> bool {
    let part = space.size / 100 * u64::from(limits.reserve_percent);
    let reserve = part.max(limits.reserve_bytes);
    reserve > 0 && space.free < reserve.saturating_mul(2)
}

fn space(directory: &Path) -> io::Result<Space> {
    let statistics = rustix::fs::statvfs(directory)?;
    let bytes = |blocks: u64| blocks.saturating_mul(statistics.f_frsize);
    Ok(Space {
        size: bytes(statistics.f_blocks),
        free: bytes(statistics.f_bavail),
    })
}

/// Returns the size of all files in the subdirectories, in bytes.
fn used(directory: &Path) -> u64 {
    let entries = |path: &Path| fs::read_dir(path).into_iter().flatten().flatten();
    let files = entries(directory).flat_map(|bag| entries(&bag.path()).collect::<Vec<_>>());
    let sizes = files.filter_map(|file| Some(file.metadata().ok()?.len()));
    sizes.fold(0, u64::saturating_add)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn space_is_needed_below_twice_the_reserve() {
        let limits = SpaceLimits {
            reserve_percent: 5,
            reserve_bytes: 60,
            max_total_bytes: None,
        };
        let lacks = |size, free, limits| is_space_low(Space { size, free }, limits);
        assert!(lacks(1_000, 119, limits));
        assert!(!lacks(1_000, 120, limits));
        assert!(lacks(10_000, 999, limits), "5 % are more than 60 bytes");
        assert!(!lacks(10_000, 1_000, limits));
        assert!(
            !lacks(1_000, 0, SpaceLimits::default()),
            "without a reserve"
        );
    }

    #[test]
    fn space_is_needed_at_nine_tenths_of_the_limit_of_all_bags() {
        let directory = tempfile::tempdir().unwrap();
        fs::create_dir(directory.path().join("lap")).unwrap();
        fs::write(directory.path().join("lap/0.mcap"), [0; 90]).unwrap();
        let limits = |limit| SpaceLimits {
            max_total_bytes: Some(limit),
            ..SpaceLimits::default()
        };
        assert!(is_needed(directory.path(), limits(100)));
        assert!(!is_needed(directory.path(), limits(101)));
    }
}
