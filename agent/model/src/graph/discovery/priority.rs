//! Priorities of entries in a full table.
//!
//! An announcement costs a forger one packet, but a full table must not keep out real participants.
//! Therefore entries of higher priority displace those of lower priority.

/// Evidence that a participant or endpoint is real; the first field has the most weight.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct Priority {
    /// Whether its topic, or that of an endpoint of the participant, is watched by exact name.
    pub watched: bool,
    /// Whether a socket on this host sends for its participant, which a remote forger cannot fake.
    pub local: bool,
    /// Whether its participant has sent user data.
    pub sends: bool,
}

impl Priority {
    /// No evidence but an announcement.
    pub const NO_EVIDENCE: Self = Self {
        watched: false,
        local: false,
        sends: false,
    };

    /// Returns the combined evidence.
    #[must_use]
    pub const fn or(self, other: Self) -> Self {
        Self {
            watched: self.watched || other.watched,
            local: self.local || other.local,
            sends: self.sends || other.sends,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_watched_name_outranks_a_local_socket_which_outranks_user_data() {
        let priority = |watched, local, sends| Priority {
            watched,
            local,
            sends,
        };
        let ascending = [
            Priority::NO_EVIDENCE,
            priority(false, false, true),
            priority(false, true, false),
            priority(false, true, true),
            priority(true, false, false),
            priority(true, false, true),
            priority(true, true, false),
        ];
        assert!(ascending.is_sorted());
        assert_eq!(ascending[1].or(ascending[4]), ascending[5]);
    }
}
