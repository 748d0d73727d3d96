//! Reports of lost messages. ros2cli learns of losses from its middleware; here the agent's stream
//! reports them.

use ros2probe_api::samples::{Missed, MissedReason};

/// Counts lost messages.
#[derive(Debug, Default)]
pub struct Lost {
    total: u64,
}

impl Lost {
    /// Records messages that will not arrive. Returns ros2cli's text, or nothing if the messages
    /// were on the wire. As in ros2cli, no line break precedes `---`.
    pub fn missed(&mut self, missed: &Missed) -> String {
        match missed.known_reason() {
            MissedReason::Incomplete | MissedReason::Lost => {}
            // These messages were on the wire.
            MissedReason::Unannounced | MissedReason::NotCaptured | MissedReason::QueueFull => {
                return String::new();
            }
        }
        self.total += missed.samples;
        format!(
            "A message was lost!!!\n\ttotal count change:{}\n\ttotal count: {}---\n",
            missed.samples, self.total
        )
    }
}

#[cfg(test)]
mod tests {
    use ros2probe_api::Open;

    use super::*;

    fn missed(first: u64, last: u64, reason: MissedReason) -> Missed {
        Missed {
            topic: "/a".to_owned(),
            domain_id: 0,
            writer: "01".to_owned(),
            samples: last - first + 1,
            first_sequence_number: first,
            last_sequence_number: last,
            reason: reason.into(),
        }
    }

    #[test]
    fn only_lost_and_incomplete_messages_add_to_the_reported_count() {
        let mut lost = Lost::default();
        let text = "A message was lost!!!\n\ttotal count change:2\n\ttotal count: 2---\n";
        assert_eq!(lost.missed(&missed(2, 3, MissedReason::Lost)), text);
        assert_eq!(lost.missed(&missed(4, 4, MissedReason::QueueFull)), "");
        assert_eq!(lost.missed(&missed(5, 5, MissedReason::NotCaptured)), "");
        let mut unknown = missed(5, 5, MissedReason::Lost);
        unknown.reason = Open::Unknown("reset".to_owned());
        assert_eq!(lost.missed(&unknown), "");
        let text = "A message was lost!!!\n\ttotal count change:1\n\ttotal count: 3---\n";
        assert_eq!(lost.missed(&missed(6, 6, MissedReason::Incomplete)), text);
    }
}
