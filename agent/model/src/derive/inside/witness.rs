//! Publications of which only receptions are observed.
//!
//! A reception may show a publication whose publisher is not observed: one on another host, or on
//! Humble one within a process. Most receptions belong to observed publications, and are read some
//! milliseconds earlier or later. The receptions of a report are therefore compared with the
//! publications up to the next report.

/// The balance of publications and receptions of one subscription.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Witness {
    /// Publications minus receptions, without those of the last report. It is at most the
    /// publications of the last two reports, because a subscription need not receive all.
    lead: i64,
    /// Publications and receptions of the last report.
    last: (i64, i64),
    /// Publications and receptions of the current report.
    published: i64,
    received: i64,
}

impl Witness {
    /// Adds the counts of one report.
    pub(super) fn take(&mut self, published: u64, received: u64) {
        let signed = |count: u64| i64::try_from(count).unwrap_or(i64::MAX);
        self.published = self.published.saturating_add(signed(published));
        self.received = self.received.saturating_add(signed(received));
    }

    /// Ends a report. Returns the number of publications that only receptions show. After the last
    /// report, this includes publications that no later report can confirm.
    pub(super) fn turn(&mut self, is_last: bool) -> u64 {
        let published = std::mem::take(&mut self.published);
        let received = std::mem::take(&mut self.received);
        let (before, due) = self.last;
        let due = if is_last {
            due.saturating_add(received)
        } else {
            due
        };
        let lead = self.lead.saturating_add(published).saturating_sub(due);
        self.lead = lead.clamp(0, before.saturating_add(published));
        self.last = (published, if is_last { 0 } else { received });
        u64::try_from(lead.saturating_neg()).unwrap_or(0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn add(witness: &mut Witness, published: u64, received: u64) -> u64 {
        witness.take(published, received);
        witness.turn(false)
    }

    #[test]
    fn receptions_read_earlier_than_their_publications_add_nothing() {
        let mut witness = Witness::default();
        for (published, received) in [(900, 979), (1000, 950), (1000, 1021), (100, 50), (0, 0)] {
            assert_eq!(add(&mut witness, published, received), 0);
        }
        assert_eq!(witness.turn(true), 0);
    }

    #[test]
    fn receptions_without_publications_count_one_report_later() {
        let mut witness = Witness::default();
        let counted = [10, 10, 10, 0, 0].map(|received| add(&mut witness, 0, received));
        assert_eq!(counted, [0, 10, 10, 10, 0]);
        // Publications that were not received do not hide later receptions for long.
        let counted = [500, 500, 0, 0].map(|published| add(&mut witness, published, 0));
        assert_eq!(counted, [0; 4]);
        let counted = [7, 7, 0].map(|received| add(&mut witness, 0, received));
        assert_eq!(counted, [0, 7, 7]);
    }

    #[test]
    fn the_last_report_of_a_process_needs_no_confirmation() {
        let mut witness = Witness::default();
        witness.take(3, 12);
        assert_eq!((witness.turn(true), witness.turn(true)), (9, 0));
    }
}
