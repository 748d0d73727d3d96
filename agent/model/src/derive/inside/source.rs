//! Decides whether a topic's counts come from the network or from inside processes.
//!
//! The counts come from the network as long as it shows the messages that processes publish. If a
//! process has published for two seconds without a message on the network, the counts come from
//! inside. The two counts are never added: at a change, the total continues with the further
//! messages of the new source.

use std::time::Duration;

use crate::facts::model_time::ModelTime;
/// Maximum time by which publications may be ahead of the network's messages.
const MAX_LEAD: Duration = Duration::from_secs(2);

/// Where a topic's counts come from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Source {
    /// Datagrams and shared memory.
    #[default]
    Wire,
    /// Calls inside processes.
    Inside,
}

/// Messages of a topic as one source counts them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Seen {
    /// Messages.
    pub messages: u64,
    /// Time of the last message.
    pub last: Option<ModelTime>,
}

/// A topic's source, and its total over changes of the source.
#[derive(Clone, Copy, Debug, Default)]
pub struct Choice {
    source: Source,
    /// The total minus the messages of the present source; may be negative.
    offset: i64,
    /// The largest total so far.
    total: u64,
}

impl Source {
    /// Both sources.
    pub const ALL: [Self; 2] = [Self::Wire, Self::Inside];

    /// Returns the label value.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Wire => "wire",
            Self::Inside => "inside",
        }
    }
}

impl Choice {
    /// Returns the present source.
    #[must_use]
    pub const fn source(&self) -> Source {
        self.source
    }

    /// Chooses the source. `wire` is `None` while the network does not measure the topic.
    pub fn choose(&mut self, wire: Option<Seen>, inside: Seen) {
        let Some(wire) = wire else {
            *self = Self {
                source: Source::Inside,
                offset: 0,
                total: inside.messages,
            };
            return;
        };
        let source = match (wire.last, inside.last) {
            (_, None) => Source::Wire,
            (None, Some(_)) => Source::Inside,
            (Some(wire), Some(inside)) if inside - wire > MAX_LEAD => Source::Inside,
            (Some(_), Some(_)) => Source::Wire,
        };
        if source != self.source {
            let now = self.messages(wire.messages, inside.messages);
            self.source = source;
            let own = self.own(wire.messages, inside.messages);
            self.offset = match now {
                0 => 0,
                _ => signed(now).saturating_sub(signed(own)),
            };
        }
        self.total = self.messages(wire.messages, inside.messages);
    }

    /// Returns the topic's total for these counts of the sources.
    #[must_use]
    pub fn messages(&self, wire: u64, inside: u64) -> u64 {
        let sum = signed(self.own(wire, inside)).saturating_add(self.offset);
        u64::try_from(sum).unwrap_or(0).max(self.total)
    }

    const fn own(&self, wire: u64, inside: u64) -> u64 {
        match self.source {
            Source::Wire => wire,
            Source::Inside => inside,
        }
    }
}

fn signed(count: u64) -> i64 {
    i64::try_from(count).unwrap_or(i64::MAX)
}

#[cfg(test)]
mod tests {
    use ros2probe_wire::time::SECOND;

    use super::*;

    fn seen(messages: u64, second: u64) -> Seen {
        Seen {
            messages,
            last: (messages > 0).then_some(ModelTime::from_nanoseconds(second * SECOND)),
        }
    }

    #[test]
    fn the_network_is_the_source_as_long_as_it_shows_messages() {
        let mut choice = Choice::default();
        for second in 1..20 {
            choice.choose(Some(seen(10 * second, second)), seen(12 * second, second));
            assert_eq!(choice.source(), Source::Wire);
            assert_eq!(choice.messages(10 * second, 12 * second), 10 * second);
        }
    }

    #[test]
    fn the_total_continues_when_the_network_falls_silent_and_recovers() {
        let mut choice = Choice::default();
        choice.choose(Some(seen(100, 10)), seen(150, 10));
        choice.choose(Some(seen(100, 10)), seen(170, 12));
        assert_eq!(choice.source(), Source::Wire, "two seconds may pass");
        choice.choose(Some(seen(100, 10)), seen(180, 13));
        assert_eq!(choice.source(), Source::Inside);
        assert_eq!(choice.messages(100, 190), 110);
        choice.choose(Some(seen(101, 14)), seen(190, 14));
        assert_eq!(choice.source(), Source::Wire);
        assert_eq!(choice.messages(101, 190), 110);
        assert_eq!(choice.messages(105, 230), 114);
    }

    #[test]
    fn a_topic_that_the_network_does_not_measure_is_counted_inside() {
        let mut choice = Choice::default();
        choice.choose(None, seen(7, 1));
        assert_eq!(
            (choice.source(), choice.messages(0, 9)),
            (Source::Inside, 9)
        );
        choice.choose(Some(seen(0, 0)), seen(9, 2));
        assert_eq!(
            (choice.source(), choice.messages(0, 11)),
            (Source::Inside, 11)
        );
    }
}
