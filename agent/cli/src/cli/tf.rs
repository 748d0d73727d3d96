//! `rp tf`: prints the trees of frames, or the transform between two of them.

use std::process::ExitCode;
use std::time::{Duration, Instant};

use anyhow::Result;
use clap::Args;
use ros2probe::client::{Agent, Samples, Target};
use ros2probe::frames::{Frames, History, NoTransform};
use ros2probe_api::path::encoded;
use ros2probe_api::transforms::{TransformTree, Transforms};
use ros2probe_daemon::escape::visible;
use ros2probe_daemon::subscriptions::{Item, NextItem};

use super::follow::AGENT_ENDED;
use super::notes::Notes;
use super::shared::names_of;
use super::{Output, UserError};

/// `rp tf`.
#[derive(Args, Debug)]
#[command(after_help = "\
With two frames, it prints the pose of TARGET in SOURCE once a second, as `tf2_echo` does. Meanwhile
it reads the moving transforms, and interpolates them to the latest time that all edges have.
Ctrl-C ends it.")]
pub(crate) struct Tf {
    /// Frame in which the pose is printed, e.g. map
    #[arg(requires = "target_frame")]
    source_frame: Option<String>,
    /// Frame whose pose is printed, e.g. base_link
    target_frame: Option<String>,
    /// Namespace of the topics, e.g. /robot1 [default: all; with two frames, the only one]
    #[arg(long, value_name = "NAMESPACE")]
    namespace: Option<String>,
    /// Print the trees in the language of Graphviz
    #[arg(long, conflicts_with = "source_frame")]
    dot: bool,
    /// Print the pose once
    #[arg(long, requires = "source_frame")]
    once: bool,
    /// Poses per second
    #[arg(long, short = 'r', value_name = "HZ", default_value_t = 1.0, value_parser = rate)]
    rate: f64,
    #[command(flatten)]
    target: Target,
}

/// Time within which each edge should have a transform, before the last ones are used instead.
const POSE_TIMEOUT: Duration = Duration::from_secs(3);
/// Consequence of sampling.
const NOT_ALL_READ: &str = "not every transform is read";
/// Interval at which poses are looked for within that time.
const POSE_RETRY_INTERVAL: Duration = Duration::from_millis(100);

/// The moving transforms since the start of the command.
struct Recent<'a> {
    samples: Option<Samples<'a>>,
    history: History,
    start: Instant,
}

impl<'a> Recent<'a> {
    /// Begins to read the topic of moving transforms. Without an agent nothing is read.
    fn open(agent: Option<&'a Agent>, domain_id: u32, topic: &str) -> Self {
        let query = format!("topic={}&domain_id={domain_id}", encoded(topic));
        let samples = agent.map(|agent| Samples::open(agent, &query)).transpose();
        let samples = samples.unwrap_or_else(|error| {
            eprintln!("rp: the last transform of each edge is used: {error}");
            None
        });
        Self {
            samples,
            history: History::default(),
            start: Instant::now(),
        }
    }

    /// Returns whether missing transforms may still arrive.
    fn is_expected(&self) -> bool {
        self.samples.is_some() && self.start.elapsed() < POSE_TIMEOUT
    }

    /// Reads transforms for this time.
    fn follow(&mut self, time: Duration) -> Result<()> {
        let end = Instant::now() + time;
        loop {
            let left = end.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Ok(());
            }
            let Some(samples) = &mut self.samples else {
                std::thread::sleep(left);
                return Ok(());
            };
            match samples.next_within(left)? {
                NextItem::Item(Item::Sample(sample)) => {
                    self.history
                        .read(sample.payload.as_deref().unwrap_or_default());
                }
                NextItem::Item(Item::End(_)) | NextItem::Closed => {
                    return Err(UserError(AGENT_ENDED.to_owned()).into());
                }
                NextItem::Item(Item::Clock(_) | Item::Missed(_)) | NextItem::Pending => {}
            }
        }
    }
}

/// A rate that is not supported.
#[derive(Debug, thiserror::Error)]
#[error("not a number from 0.01 to 100")]
struct UnsupportedRate;

fn rate(text: &str) -> Result<f64, UnsupportedRate> {
    let rate: Option<f64> = text.parse().ok();
    rate.filter(|rate| (0.01..=100.0).contains(rate))
        .ok_or(UnsupportedRate)
}

impl Tf {
    pub(crate) fn run(self) -> Result<ExitCode> {
        let domain_id = self.target.domain()?;
        let path = format!("/transforms?domain_id={domain_id}");
        let agent = Agent::reach(&self.target)?;
        let mut output = Output::new();
        let frames = self
            .source_frame
            .as_deref()
            .zip(self.target_frame.as_deref());
        let answer: Transforms<'_> = agent.get(&path)?;
        if !answer.is_on {
            eprintln!("rp: the agent reads no transforms: `robot.transforms` is `off`");
        }
        let topics: Vec<_> = self.trees(&answer).map(topic_of).collect();
        let is_replay = self.target.replay.is_some();
        if !topics.is_empty() {
            Notes::begin(&agent, domain_id, is_replay, &topics, NOT_ALL_READ);
        }
        let Some((source, target)) = frames else {
            self.print(&answer, &mut output)?;
            if answer.trees.is_empty() {
                names_of(&agent, domain_id)?;
            }
            return Ok(ExitCode::SUCCESS);
        };
        if answer.trees.is_empty() {
            names_of(&agent, domain_id)?;
        }
        let topic = topic_of(self.only_tree(&answer)?);
        let mut recent = Recent::open((!is_replay).then_some(&agent), domain_id, &topic);
        let mut answer = answer;
        loop {
            let tree = self.only_tree(&answer)?;
            recent.history.add_last(tree);
            let explained = |error: NoTransform| {
                let note = unread_static_note(tree).unwrap_or_default();
                UserError(format!("{error}{note}"))
            };
            let frames = Frames::new(tree);
            let has_poses = frames.has_poses(source, target, &recent.history);
            if has_poses.map_err(explained)? || !recent.is_expected() {
                let between = frames.between(source, target, &recent.history);
                output.write(&between.map_err(explained)?.text())?;
                if self.once || is_replay {
                    return Ok(ExitCode::SUCCESS);
                }
                recent.follow(Duration::from_secs_f64(1.0 / self.rate))?;
            } else {
                recent.follow(POSE_RETRY_INTERVAL)?;
            }
            answer = agent.get(&path)?;
        }
    }

    /// Prints all trees.
    fn print(&self, answer: &Transforms<'_>, output: &mut Output) -> Result<()> {
        let trees: Vec<_> = self.trees(answer).collect();
        if trees.is_empty() {
            eprintln!("rp: no transforms were seen");
        }
        for tree in &trees {
            let frames = Frames::new(tree);
            if self.dot {
                output.write(&frames.dot(answer.timestamp_seconds))?;
                continue;
            }
            if trees.len() > 1 {
                output.write(&format!("{}/tf:\n", visible(&tree.namespace)))?;
            }
            output.write(&frames.tree(answer.timestamp_seconds))?;
            if let Some(note) = unread_static_note(tree) {
                eprintln!("rp: {}", note.trim_start_matches("; "));
            }
        }
        Ok(())
    }

    /// Returns the trees that are selected.
    fn trees<'a>(&self, answer: &'a Transforms<'a>) -> impl Iterator<Item = &'a TransformTree<'a>> {
        answer.trees.iter().filter(|tree| self.selects(tree))
    }

    fn selects(&self, tree: &TransformTree<'_>) -> bool {
        let wanted = self
            .namespace
            .as_deref()
            .map(|name| name.trim_end_matches('/'));
        wanted.is_none_or(|wanted| wanted == tree.namespace)
    }

    /// Returns the only tree that is selected.
    fn only_tree<'a>(&self, answer: &'a Transforms<'a>) -> Result<&'a TransformTree<'a>> {
        let trees: Vec<_> = self.trees(answer).collect();
        match trees[..] {
            [tree] => Ok(tree),
            [] => Err(UserError("no transforms were seen".to_owned()).into()),
            [..] => {
                let names = trees
                    .iter()
                    .map(|tree| format!("`{}/tf`", visible(&tree.namespace)));
                let names: Vec<_> = names.collect();
                let text = format!(
                    "there are several trees: {}; name one by --namespace",
                    names.join(", ")
                );
                Err(UserError(text).into())
            }
        }
    }
}

/// Returns the name of the topic with the moving transforms of a tree.
fn topic_of(tree: &TransformTree<'_>) -> String {
    format!("{}/tf", tree.namespace)
}

/// Returns a note if static transforms are missing because the agent came later.
fn unread_static_note(tree: &TransformTree<'_>) -> Option<String> {
    let count = tree.unread_static_publishers;
    let publishers = if count == 1 {
        "publisher"
    } else {
        "publishers"
    };
    (count > 0).then(|| {
        format!(
            "; the static transforms of {count} {publishers} are missing: they were sent before \
             the agent started, and are sent again to the next subscription, \
             e.g. `ros2 topic echo {}/tf_static`",
            visible(&tree.namespace)
        )
    })
}
