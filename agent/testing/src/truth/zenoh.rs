//! Reference facts about captures of Zenoh.

use std::path::{Path, PathBuf};

use serde::Deserialize;

use super::{GraphLine, Received, children, graph_lines, received, text};

/// A directory with captures of one run.
#[derive(Debug)]
pub struct Scenario {
    /// Path of the directory.
    pub directory: PathBuf,
}

/// Results of the independent decoder.
#[derive(Debug, Deserialize)]
pub struct Facts {
    pub sessions: Vec<FactsSession>,
    pub tokens: Vec<FactsToken>,
    pub publications: Vec<FactsPublication>,
}

/// A connection.
#[derive(Debug, Deserialize)]
pub struct FactsSession {
    pub a: String,
    pub b: String,
    pub init: Vec<Option<FactsInit>>,
}

#[derive(Debug, Deserialize)]
pub struct FactsInit {
    pub whatami: String,
}

/// A liveliness token.
#[derive(Debug, Deserialize)]
pub struct FactsToken {
    /// `None` for the end of a token whose beginning is not in the capture.
    pub token: Option<String>,
    /// `None` for tokens that are not of ROS.
    pub kind: Option<String>,
}

/// Publications of one publisher on one connection.
#[derive(Debug, Deserialize)]
pub struct FactsPublication {
    pub sender: String,
    pub receiver: String,
    pub gid: Option<String>,
    pub token: Option<String>,
    pub messages: u64,
    pub payload_bytes: u64,
    pub seq_range: Option<(u64, u64)>,
    pub missing: Vec<u64>,
}

/// Returns the scenarios of Zenoh below `root`; none if it does not exist.
pub fn scenarios(root: &Path) -> Vec<Scenario> {
    let directories = children(&root.join("zenoh"));
    let scenarios = directories.into_iter();
    scenarios.map(|directory| Scenario { directory }).collect()
}

impl Scenario {
    /// Returns the captures and their facts.
    pub fn captures(&self) -> Vec<(PathBuf, Facts)> {
        let mut captures = Vec::new();
        for facts in children(&self.directory) {
            let name = facts.file_name().unwrap().to_string_lossy().into_owned();
            if let Some((capture, _)) = name.split_once(".facts.json") {
                let capture = self.directory.join(format!("{capture}.gz"));
                captures.push((capture, serde_json::from_str(&text(&facts)).unwrap()));
            }
        }
        captures
    }

    /// Returns the graph lines by role of the logging node.
    pub fn graphs(&self) -> Vec<(String, Vec<GraphLine>)> {
        graph_lines(&self.directory)
    }

    /// Returns the logs of the subscribers.
    pub fn received(&self) -> Vec<Received> {
        received(&self.directory)
    }
}

impl Facts {
    /// Returns whether a router receives on this connection.
    pub fn is_relayed(&self, publication: &FactsPublication) -> bool {
        let ends = |session: &&FactsSession| {
            let ends = [&session.a, &session.b];
            ends.contains(&&publication.sender) && ends.contains(&&publication.receiver)
        };
        let session = self.sessions.iter().find(ends).unwrap();
        let place = usize::from(session.b == publication.receiver);
        let init = session.init.get(place).and_then(Option::as_ref);
        init.is_some_and(|init| init.whatami == "router")
    }
}
