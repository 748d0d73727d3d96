//! How topics stood with the entries of a watchlist that is replaced. What is still wanted as before
//! is not judged afresh: adding one topic must not make another one's violation look new.

use std::collections::HashMap;

use super::expectation::Judgement;
use super::topic::{TopicId, Topics};
use crate::config::{Expectations, Watchlist};

/// How each topic stood with each entry.
pub(super) struct Standing {
    watches: HashMap<(String, Option<u32>), (usize, Expectations)>,
    judgements: HashMap<TopicId, Vec<(usize, Judgement)>>,
}

impl Standing {
    /// How topics stand with this list.
    pub(super) fn new(topics: &Topics, watchlist: &Watchlist) -> Self {
        let watches = watchlist.watches().iter().enumerate();
        let judged = topics
            .iter()
            .filter(|(_, topic)| !topic.judgements.is_empty());
        Self {
            watches: watches
                .map(|(index, watch)| {
                    let key = (watch.pattern.clone(), watch.domain_id);
                    (key, (index, watch.expectations))
                })
                .collect(),
            judgements: judged
                .map(|(id, topic)| (id, topic.judgements.clone()))
                .collect(),
        }
    }

    /// Gives topics back how they stood with what the new list still wants.
    pub(super) fn restore(self, topics: &mut Topics, watchlist: &Watchlist) {
        for (id, judgements) in self.judgements {
            let Some(topic) = topics.get_mut(id) else {
                continue;
            };
            for (index, judgement) in &mut topic.judgements {
                let watch = watchlist.watches().get(*index);
                let same = watch.and_then(|watch| {
                    let key = (watch.pattern.clone(), watch.domain_id);
                    let (before, expectations) = self.watches.get(&key)?;
                    (*expectations == watch.expectations).then_some(*before)
                });
                let stood = judgements.iter().find(|(before, _)| Some(*before) == same);
                if let Some((_, stood)) = stood {
                    *judgement = *stood;
                }
            }
        }
    }
}
