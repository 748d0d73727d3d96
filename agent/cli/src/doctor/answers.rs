//! Answers of a running agent.

use ros2probe_api::clocks::Clocks;
use ros2probe_api::health::Health;
use ros2probe_api::participants::ParticipantList;
use ros2probe_api::topics::TopicList;
use ros2probe_api::watches::WatchList;

use crate::client::{Agent, ClientError};
use ros2probe_daemon::surface::api::OwnAnswers;

/// All answers that the checks need.
#[derive(Clone, Debug, Default)]
pub struct Answers {
    /// `GET /health`.
    pub health: Health,
    /// `GET /participants`.
    pub participants: ParticipantList<'static>,
    /// `GET /topics`.
    pub topics: TopicList<'static>,
    /// `GET /watch`.
    pub watches: WatchList,
    /// `GET /clocks`; empty from an agent that does not compare clocks yet.
    pub clocks: Clocks<'static>,
}

impl Answers {
    /// Reads an agent's own answers.
    ///
    /// # Errors
    ///
    /// Fails if an answer has another format, such as that of a problem.
    pub fn of(own: &OwnAnswers) -> Result<Self, serde_json::Error> {
        Ok(Self {
            health: serde_json::from_slice(&own.health)?,
            participants: serde_json::from_slice(&own.participants)?,
            topics: serde_json::from_slice(&own.topics)?,
            watches: serde_json::from_slice(&own.watches)?,
            clocks: serde_json::from_slice(&own.clocks)?,
        })
    }

    /// Requests the answers for one domain, or for all of them.
    ///
    /// # Errors
    ///
    /// Fails if the agent is unreachable or sends an unexpected answer.
    pub fn request(agent: &Agent, domain_id: Option<u32>) -> Result<Self, ClientError> {
        let within = domain_id.map_or_else(String::new, |domain| format!("?domain_id={domain}"));
        Ok(Self {
            health: agent.get("/health")?,
            participants: agent.get(&format!("/participants{within}"))?,
            topics: agent.get(&format!("/topics{within}"))?,
            watches: agent.get("/watch")?,
            clocks: match agent.get("/clocks") {
                Err(ClientError::OlderAgent { .. }) => Clocks::default(),
                answer => answer?,
            },
        })
    }
}
