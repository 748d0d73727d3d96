//! `rp tf`: prints the trees of frames, or the transform between two of them.

use std::process::ExitCode;
use std::time::Duration;

use anyhow::Result;
use clap::Args;
use ros2probe::client::{Agent, Target};
use ros2probe::frames::Frames;
use ros2probe_api::transforms::{TransformTree, Transforms};
use ros2probe_daemon::escape::visible;

use super::shared::names_of;
use super::{Output, UserError};

/// `rp tf`.
#[derive(Args, Debug)]
#[command(after_help = "\
With two frames, it prints the pose of TARGET in SOURCE once a second, as `tf2_echo` does.
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
    pub(crate) fn ask(self) -> Result<ExitCode> {
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
        let Some((source, target)) = frames else {
            self.print(&answer, &mut output)?;
            if answer.trees.is_empty() {
                names_of(&agent, domain_id)?;
            }
            return Ok(ExitCode::SUCCESS);
        };
        let mut answer = answer;
        loop {
            if answer.trees.is_empty() {
                names_of(&agent, domain_id)?;
            }
            let tree = self.only(&answer)?;
            let between = Frames::new(tree).between(source, target).map_err(|error| {
                let note = unread(tree).unwrap_or_default();
                UserError(format!("{error}{note}"))
            })?;
            output.write(&between.text())?;
            if self.once || self.target.replay.is_some() {
                return Ok(ExitCode::SUCCESS);
            }
            std::thread::sleep(Duration::from_secs_f64(1.0 / self.rate));
            answer = agent.get(&path)?;
        }
    }

    /// Prints all trees.
    fn print(&self, answer: &Transforms<'_>, output: &mut Output) -> Result<()> {
        let trees: Vec<_> = answer
            .trees
            .iter()
            .filter(|tree| self.selects(tree))
            .collect();
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
            if let Some(note) = unread(tree) {
                eprintln!("rp: {}", note.trim_start_matches("; "));
            }
        }
        Ok(())
    }

    fn selects(&self, tree: &TransformTree<'_>) -> bool {
        let wanted = self
            .namespace
            .as_deref()
            .map(|name| name.trim_end_matches('/'));
        wanted.is_none_or(|wanted| wanted == tree.namespace)
    }

    /// Returns the only tree that is selected.
    fn only<'a>(&self, answer: &'a Transforms<'a>) -> Result<&'a TransformTree<'a>> {
        let trees: Vec<_> = answer
            .trees
            .iter()
            .filter(|tree| self.selects(tree))
            .collect();
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

/// Returns a note if static transforms are missing because the agent came later.
fn unread(tree: &TransformTree<'_>) -> Option<String> {
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
