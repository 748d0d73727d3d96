//! `rp bag`.

use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Result;
use clap::error::ErrorKind;
use clap::{Args, CommandFactory as _, Subcommand, ValueEnum};
use ros2probe::client::Compressed;
use ros2probe::ros2::bag::{self, Sort};
use ros2probe::ros2::{Dialect, dialect};
use ros2probe_bag::info;
use ros2probe_bag::reindex::{self, Found};
use ros2probe_daemon::escape::visible;

use super::convert::Convert;
use super::interrupt::EXIT_INTERRUPTED;
use super::record::Record;
use super::{Arguments, Output, UserError};

/// `rp bag VERB`.
#[derive(Args, Debug)]
pub(crate) struct Bag {
    #[command(subcommand)]
    verb: Option<Verb>,
}

#[derive(Debug, Subcommand)]
enum Verb {
    /// Record messages into a bag
    Record(Box<Record>),
    /// Convert a capture to a bag
    Convert(Box<Convert>),
    /// Print information about a bag
    Info(Info),
    /// Complete a bag: unfinished files and metadata.yaml
    #[command(after_help = "\
Complete files are not changed. An unfinished file is rewritten beside itself and replaced; bytes of
an incomplete record are kept in FILE.mcap.rest.
Exit code: 0 if everything is in the bag, 1 otherwise.")]
    Reindex(Reindex),
}

#[derive(Args, Debug)]
struct Info {
    /// Bag to open: a directory, or one MCAP file
    bag_path: PathBuf,
    /// Accepted without effect: the storage is detected
    #[arg(short, long, value_enum)]
    storage: Option<Storage>,
    /// Only display topic names
    #[arg(short, long)]
    topic_name: bool,
    /// Read all messages and print the size of topics, services and actions
    #[arg(short, long)]
    verbose: bool,
    /// Sort order of topics, services and actions
    #[arg(long, value_enum, default_value_t)]
    sort: Sort,
    /// Distribution whose output to print [default: ROS_DISTRO, else jazzy]
    #[arg(long, value_parser = dialect::parser())]
    distro: Option<Dialect>,
    #[command(flatten)]
    compressed: Compressed,
}

#[derive(Args, Debug)]
struct Reindex {
    /// The bag's directory
    bag_path: PathBuf,
    /// Accepted without effect: the storage is detected
    #[arg(short, long, value_enum)]
    storage: Option<Storage>,
    #[command(flatten)]
    compressed: Compressed,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum Storage {
    Mcap,
    Sqlite3,
}

impl Bag {
    /// Exit code if Ctrl-C ends the command immediately. `None` for a recording, which is
    /// completed.
    pub(crate) const fn interrupted(&self) -> Option<u8> {
        match self.verb {
            Some(Verb::Record(_) | Verb::Convert(_)) => None,
            _ => Some(EXIT_INTERRUPTED),
        }
    }

    pub(crate) fn run(self) -> Result<ExitCode> {
        match self.verb {
            None => super::help(&["bag"]),
            Some(Verb::Record(record)) => record.run(),
            Some(Verb::Convert(convert)) => convert.run(),
            Some(Verb::Info(info)) => info.ask(),
            Some(Verb::Reindex(reindex)) => reindex.ask(),
        }
    }
}

impl Info {
    fn ask(self) -> Result<ExitCode> {
        require(&self.bag_path, "info");
        let dialect = self.distro.or_else(|| {
            let distro = std::env::var("ROS_DISTRO").ok()?;
            Dialect::of_distro(&distro)
        });
        let dialect = dialect.unwrap_or_default();
        let mut output = Output::new();
        if self.topic_name && self.verbose {
            output.write(
                "Warning! You have set both the '-t' and '-v' parameters. The '-t' parameter will be \
                ignored.\n",
            )?;
        }
        let opened = info::Bag::open(&self.bag_path, self.compressed.into())?;
        let details = self.verbose.then(|| opened.details()).transpose()?;
        let text = match self.topic_name && !self.verbose {
            true => bag::names(&opened, dialect, self.sort),
            false => bag::info(&opened, dialect, self.sort, details.as_ref()),
        };
        output.write(&text)?;
        Ok(ExitCode::SUCCESS)
    }
}

impl Reindex {
    fn ask(self) -> Result<ExitCode> {
        require(&self.bag_path, "reindex");
        if !self.bag_path.is_dir() {
            let path = self.bag_path.display();
            return Err(UserError(format!("{path} is a file: pass the bag's directory")).into());
        }
        let report = reindex::reindex(&self.bag_path, self.compressed.into())?;
        let mut output = Output::new();
        for file in &report.files {
            // A file name can contain control characters.
            output.write(&format!("{}\n", visible(&file.to_string())))?;
        }
        let metadata = &report.metadata;
        output.write(&format!(
            "metadata.yaml: written, {} messages of {} topics in {} files\n",
            metadata.message_count,
            metadata.topics.len(),
            metadata.files.len()
        ))?;
        let left_out = |file: &reindex::FileReport| match &file.found {
            Found::NotMcap => true,
            Found::Unfinished {
                unreadable_chunks, ..
            } => *unreadable_chunks > 0,
            Found::Complete => false,
        };
        Ok(ExitCode::from(u8::from(report.files.iter().any(left_out))))
    }
}

/// Ends with a usage error if the path does not exist, as `ros2 bag` does.
fn require(path: &std::path::Path, verb: &str) {
    if path.exists() {
        return;
    }
    let mut command = Arguments::command();
    command.build();
    let verb = ["bag", verb]
        .iter()
        .try_fold(&command, |command, name| command.find_subcommand(name));
    let what = format!(
        "argument bag_path: Bag path '{}' does not exist!",
        path.display()
    );
    let mut command = verb.cloned().unwrap_or(command);
    command.error(ErrorKind::ValueValidation, what).exit()
}
