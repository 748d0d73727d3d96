//! Distributions of ROS 2 that differ in definitions and command-line output.

/// A group of distributions with the same definitions and the same output, oldest first.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub enum Dialect {
    /// Humble and older.
    Humble,
    /// Iron and Jazzy.
    #[default]
    Jazzy,
    /// Kilted.
    Kilted,
    /// Lyrical and rolling.
    Rolling,
}

impl Dialect {
    /// Returns the distribution's name as in `ROS_DISTRO`.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Humble => "humble",
            Self::Jazzy => "jazzy",
            Self::Kilted => "kilted",
            Self::Rolling => "rolling",
        }
    }

    /// Parses `ROS_DISTRO`; returns `None` for an unknown distribution.
    #[must_use]
    pub fn of_distro(name: &str) -> Option<Self> {
        Some(match name {
            "dashing" | "eloquent" | "foxy" | "galactic" | "humble" => Self::Humble,
            "iron" | "jazzy" => Self::Jazzy,
            "kilted" => Self::Kilted,
            "lyrical" | "rolling" => Self::Rolling,
            _ => return None,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_distribution_has_a_dialect_and_dialects_are_ordered_by_age() {
        assert_eq!(Dialect::of_distro("lyrical"), Some(Dialect::Rolling));
        assert_eq!(Dialect::of_distro("galactic"), Some(Dialect::Humble));
        assert_eq!(Dialect::of_distro("noetic"), None);
        assert!(Dialect::Humble < Dialect::default() && Dialect::Kilted < Dialect::Rolling);
    }
}
