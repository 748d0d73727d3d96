//! Publishers and subscribers of shapes on six implementations of DDS, with one command line and
//! one log (see `agent/cli/tests/peers/shapes/README.md`).

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;
use std::path::PathBuf;
use std::process::Command;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use anyhow::{Context as _, Result};
use serde_json::Value;
use tempfile::TempDir;

use super::event_log::{Event, EventLog};
use super::network::Namespace;
use super::peer::{self, Role};
use super::process::Process;

/// Maximum time of discovery between twelve peers on a busy machine.
const PATIENCE: Duration = Duration::from_secs(60);

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Library {
    Dust,
    RustDds,
    Hdds,
    Fast,
    /// Cyclone DDS of the distribution.
    Cyclone,
    Cyclone11,
}

/// A process with one endpoint.
pub struct Shape {
    pub library: Library,
    process: Process,
    directory: TempDir,
}

impl Library {
    pub const ALL: [Library; 6] = [
        Library::Dust,
        Library::RustDds,
        Library::Hdds,
        Library::Fast,
        Library::Cyclone,
        Library::Cyclone11,
    ];

    /// Returns the color of its publisher, which names it in the logs of subscribers.
    pub fn color(self) -> String {
        format!("{self:?}").to_uppercase()
    }

    /// Returns the name of its vendor as the agent prints it.
    pub fn vendor(self) -> &'static str {
        match self {
            Library::Dust => "S2E Dust DDS",
            Library::RustDds => "Atostek RustDDS",
            Library::Hdds => "HDDS",
            Library::Fast => "eProsima Fast DDS",
            Library::Cyclone | Library::Cyclone11 => "Eclipse Cyclone DDS",
        }
    }

    /// Returns the program and its first arguments.
    fn command(self) -> Result<(PathBuf, &'static [&'static str])> {
        const SCRIPT: &str = concat!(
            env!("CARGO_MANIFEST_DIR"),
            "/../cli/tests/peers/shapes/cyclonedds11.py"
        );
        let name = match self {
            Library::Dust => "dust",
            Library::RustDds => "rustdds",
            Library::Hdds => "hdds",
            Library::Fast => "fastdds",
            Library::Cyclone => "cyclonedds",
            Library::Cyclone11 => return Ok((peer::python("cyclonedds")?, &[SCRIPT])),
        };
        Ok((peer::built(&format!("shapes/{name}"))?, &[]))
    }

    /// Returns whether it supports a capability in a role. Its program runs once for each role.
    pub fn can(self, role: Role, capability: &str) -> Result<bool> {
        static KNOWN: Mutex<BTreeMap<(Library, &'static str), Value>> = Mutex::new(BTreeMap::new());
        let mut known = KNOWN.lock().unwrap_or_else(PoisonError::into_inner);
        let all = match known.entry((self, role.name())) {
            Entry::Occupied(entry) => entry.into_mut(),
            Entry::Vacant(entry) => entry.insert(self.capabilities(role)?),
        };
        let capability = all[capability].as_bool();
        capability.with_context(|| format!("{self:?}: {all}"))
    }

    fn capabilities(self, role: Role) -> Result<Value> {
        let (program, words) = self.command()?;
        let mut command = Command::new(program);
        command
            .args(words)
            .args(["--capabilities", "--role", role.name()]);
        let output = command.output().context("cannot run a peer")?;
        serde_json::from_slice(&output.stdout)
            .with_context(|| format!("{command:?} printed no capabilities"))
    }
}

impl Shape {
    /// Starts a peer and waits until its endpoint exists. A publisher waits for
    /// [`Self::start_sending`] before it sends.
    pub fn start(host: &Namespace, library: Library, role: Role, options: &str) -> Result<Shape> {
        let directory = tempfile::tempdir().context("cannot create a directory for the log")?;
        let (program, words) = library.command()?;
        let mut words: Vec<String> = words.iter().map(|word| (*word).to_owned()).collect();
        words.extend(["--role".to_owned(), role.name().to_owned()]);
        if role == Role::Publisher {
            words.extend(["--hold", "--color"].map(str::to_owned));
            words.push(library.color());
        }
        words.extend(options.split_ascii_whitespace().map(str::to_owned));
        let log = directory.path().join("log").display().to_string();
        words.extend(["--log".to_owned(), log]);
        let mut process = Process::start(&host.inside(), program, words)?;
        process
            .wait_for("ready", PATIENCE)
            .with_context(|| format!("{library:?} {role:?}"))?;
        Ok(Shape {
            library,
            process,
            directory,
        })
    }

    /// Waits until as many peers are matched as `--peers` requires.
    pub fn wait_matched(&mut self) -> Result<()> {
        let waited = self.process.wait_for("matched", PATIENCE);
        waited.with_context(|| format!("{:?}: {:?}", self.library, self.log().map(|log| log.0)))
    }

    /// Lets a publisher send its first samples, or the next `--stretch` of them.
    pub fn start_sending(&mut self) -> Result<()> {
        self.process.write_line("go")
    }

    /// Waits until a publisher has sent all its samples.
    pub fn wait_sent(&mut self) -> Result<()> {
        self.process.wait_for("done", PATIENCE)
    }

    pub fn log(&self) -> Result<EventLog> {
        EventLog::read(&self.directory.path().join("log"))
    }

    /// Returns the GUID of its endpoint as the agent prints it.
    pub fn guid(&self) -> Result<String> {
        let start = self.start_event()?;
        let guid = start.guid.context("the log has no GUID")?;
        let (prefix, entity) = guid.split_at_checked(24).context("a short GUID")?;
        Ok(format!("{prefix}.{entity}"))
    }

    /// Returns the number of its process.
    pub fn process(&self) -> Result<u64> {
        self.start_event()?.pid.context("the log has no process")
    }

    fn start_event(&self) -> Result<Event> {
        let mut log = self.log()?.0.into_iter();
        log.find(|event| event.ev == "start")
            .context("the log has no start")
    }

    /// Returns how many samples of a color a subscriber received.
    pub fn received(&self, color: &str) -> Result<u64> {
        let log = self.log()?;
        let samples = log.0.iter().filter(|event| event.ev == "sub");
        let own = samples.filter(|event| event.color.as_deref() == Some(color));
        Ok(own.count() as u64)
    }
}
