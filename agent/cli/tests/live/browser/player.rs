//! Plays a scenario of `agent/cli/tests/page`: Node drives a real Chromium that shows the page of
//! an agent which the test has started. A scenario may send requests to the test, such as to
//! restart the agent. A request is a line that begins with `@`, and its answer is a line of JSON.

use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, bail, ensure};
use serde_json::Value;

/// Maximum time for a scenario.
const PATIENCE: Duration = Duration::from_secs(280);

/// Actions that a scenario can request.
pub(crate) type Answers<'a> = &'a mut dyn FnMut(&str) -> Result<Value>;

/// Plays a scenario after the words `enter`, which enter a host; without words in this network.
///
/// # Errors
/// Fails with the scenario's output if the scenario fails, or if a tool is missing or an answer
/// fails.
pub(crate) fn play(
    enter: &[String],
    name: &str,
    arguments: &[&str],
    answers: Answers<'_>,
) -> Result<()> {
    play_for(PATIENCE, enter, name, arguments, answers)
}

/// Plays a scenario as [`play`] does, with another time limit.
pub(crate) fn play_for(
    patience: Duration,
    enter: &[String],
    name: &str,
    arguments: &[&str],
    answers: Answers<'_>,
) -> Result<()> {
    let script = scenarios().join(name).with_extension("mjs");
    ensure!(script.exists(), "there is no {}", script.display());
    let mut words = enter.to_vec();
    words.extend(["setpriv", "--pdeathsig", "KILL"].map(str::to_owned));
    let (program, rest) = words.split_first().context("no words")?;
    let child = Command::new(program)
        .args(rest)
        .arg(node()?)
        .arg(&script)
        .args(arguments)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .with_context(|| format!("cannot run {program}"))?;
    let mut child = Ended(child);
    let mut input = child.0.stdin.take().context("no input")?;
    let output = child.0.stdout.take().context("no output")?;
    let mut errors = child.0.stderr.take().context("no errors")?;
    let mistakes = std::thread::spawn(move || {
        let mut text = Vec::new();
        let _ = errors.read_to_end(&mut text);
        String::from_utf8_lossy(&text).into_owned()
    });
    let (printed, lines) = channel();
    std::thread::spawn(move || {
        let lines = BufReader::new(output).lines().map_while(Result::ok);
        let _ = lines
            .map(|line| printed.send(line))
            .all(|sent| sent.is_ok());
    });
    let deadline = Instant::now() + patience;
    let mut text = String::new();
    loop {
        let left = deadline.saturating_duration_since(Instant::now());
        match lines.recv_timeout(left) {
            Ok(line) => match line.strip_prefix('@') {
                Some(question) => {
                    let answer = answers(question)
                        .with_context(|| format!("{name} asks for: {question}\n{text}"))?;
                    writeln!(input, "{answer}")?;
                }
                None => text.push_str(&format!("{line}\n")),
            },
            Err(RecvTimeoutError::Disconnected) => break,
            Err(RecvTimeoutError::Timeout) => {
                bail!("{name} takes longer than {patience:?}\n{text}")
            }
        }
    }
    let status = child.0.wait()?;
    let mistakes = mistakes.join().unwrap_or_default();
    println!("{text}");
    ensure!(status.success(), "{name}: {status}\n{text}{mistakes}");
    Ok(())
}

/// Plays a scenario without requests.
pub(crate) fn watch(enter: &[String], name: &str, arguments: &[&str]) -> Result<()> {
    let mut nothing = |question: &str| bail!("no answer to {question}");
    play(enter, name, arguments, &mut nothing)
}

/// A process that ends when this value is dropped.
struct Ended(Child);

impl Drop for Ended {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn scenarios() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/page")
}

/// Returns the Node that `.ci/prerequisites.sh page` unpacked, or else the system's.
fn node() -> Result<PathBuf> {
    let own = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../target/tools/node/bin/node");
    if own.exists() {
        return Ok(own);
    }
    let path = std::env::var_os("PATH").unwrap_or_default();
    let found = std::env::split_paths(&path).map(|directory| directory.join("node"));
    found
        .into_iter()
        .find(|node| node.exists())
        .context("`node` is missing: run `.ci/prerequisites.sh page`")
}
