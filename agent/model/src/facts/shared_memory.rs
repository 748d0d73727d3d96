//! The use of directories of shared memory, and what is wrong with it.

/// Files of Fast DDS in the directories of shared memory.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct MemoryUse {
    /// Share of the fullest directory that is in use, in thousandths.
    pub used_permille: u64,
    /// Space of the files whose processes have ended, in bytes.
    pub stale_bytes: u64,
    /// The largest share of such files in one directory, in thousandths.
    pub stale_permille: u64,
    /// Directories with nodes of one domain and one network, if there are several.
    pub split_directories: u64,
}

/// What is wrong with shared memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum MemoryFault {
    /// A directory is nearly full.
    Full,
    /// Files of ended processes take much space.
    Stale,
    /// Nodes that consider each other to be on one host have different directories.
    Split,
}

impl MemoryFault {
    /// All faults, in the order of their values.
    pub const ALL: [Self; 3] = [Self::Full, Self::Stale, Self::Split];

    /// Returns the label value.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Full => "full",
            Self::Stale => "stale",
            Self::Split => "split",
        }
    }

    /// Returns the figure of the fault: thousandths in use, bytes, or directories.
    #[must_use]
    pub const fn figure(self, memory: &MemoryUse) -> u64 {
        match self {
            Self::Full => memory.used_permille,
            Self::Stale => memory.stale_bytes,
            Self::Split => memory.split_directories,
        }
    }

    /// Returns whether the fault exists. A fault that exists `already` ends at a lower figure than
    /// it begins.
    #[must_use]
    pub const fn exists(self, memory: &MemoryUse, already: bool) -> bool {
        match self {
            Self::Full => memory.used_permille >= if already { 850 } else { 900 },
            Self::Stale => {
                let half = if already { 2 } else { 1 };
                memory.stale_bytes >= (64 << 20) / half || memory.stale_permille >= 100 / half
            }
            Self::Split => memory.split_directories > 1,
        }
    }
}
