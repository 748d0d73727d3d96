//! What an entry is worth when its table is full.
//!
//! An announcement costs a forger one packet, so a full table is no reason to miss a real newcomer:
//! who is worth more displaces who is worth less.

/// What is known in favour of a participant or an endpoint; the first field counts most.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct Priority {
    /// Its topic is watched by its exact name; of a participant, that of one of its endpoints.
    pub watched: bool,
    /// A socket of this host sends for its participant: no forger elsewhere has one.
    pub local: bool,
    /// Its participant has sent user data.
    pub sends: bool,
}

impl Priority {
    /// An announcement and nothing else.
    pub const NOTHING: Self = Self {
        watched: false,
        local: false,
        sends: false,
    };

    /// What either of both has.
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
    fn a_watched_name_counts_more_than_a_local_socket_and_that_more_than_user_data() {
        let priority = |watched, local, sends| Priority {
            watched,
            local,
            sends,
        };
        let ascending = [
            Priority::NOTHING,
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
