//! A program that runs on a host and is killed when its value is dropped. It also dies with the
//! thread that started it, so a killed test leaves no program behind. Start it on the thread that
//! keeps the value.

use std::collections::BTreeSet;
use std::ffi::OsStr;
use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::process::{Child, ChildStdin, Command, ExitStatus, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, bail};

pub struct Process {
    name: String,
    child: Child,
    input: Option<ChildStdin>,
    output: Receiver<String>,
}

impl Process {
    /// Runs `program` behind the command prefix of `host` (`Namespace::inside` or `on_network`).
    pub fn start<A: AsRef<OsStr>>(
        host: &[String],
        program: impl AsRef<OsStr>,
        arguments: impl IntoIterator<Item = A>,
    ) -> Result<Process> {
        Process::start_with(host, program, arguments, Stdio::inherit())
    }

    /// Runs a program as [`Process::start`] does, with standard error redirected.
    pub fn start_with<A: AsRef<OsStr>>(
        host: &[String],
        program: impl AsRef<OsStr>,
        arguments: impl IntoIterator<Item = A>,
        errors: Stdio,
    ) -> Result<Process> {
        let name = program.as_ref().to_string_lossy().into_owned();
        let [enter, words @ ..] = host else {
            bail!("no host to run {name} on");
        };
        let mut child = Command::new(enter)
            .args(words)
            .args(["setpriv", "--pdeathsig", "KILL"])
            .arg(program)
            .args(arguments)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(errors)
            .spawn()
            .with_context(|| format!("cannot start {name}"))?;
        let stdout = child
            .stdout
            .take()
            .with_context(|| format!("{name} has no output"))?;
        let (lines, output) = channel();
        std::thread::spawn(move || {
            for line in BufReader::new(stdout).lines().map_while(Result::ok) {
                if lines.send(line).is_err() {
                    return;
                }
            }
        });
        let input = child.stdin.take();
        Ok(Process {
            name,
            child,
            input,
            output,
        })
    }

    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Returns the UDP ports that it has bound.
    pub fn udp_ports(&self) -> Result<BTreeSet<u16>> {
        let of_process = |name: &str| format!("/proc/{}/{name}", self.pid());
        let mut sockets = BTreeSet::new();
        for entry in fs::read_dir(of_process("fd"))? {
            if let Ok(target) = fs::read_link(entry?.path()) {
                sockets.insert(target.to_string_lossy().into_owned());
            }
        }
        let table = fs::read_to_string(of_process("net/udp"))?;
        let rows = table.lines().map(|row| row.split_whitespace().collect());
        let own = rows.filter(|row: &Vec<&str>| {
            let inode = row.get(9).map(|inode| format!("socket:[{inode}]"));
            inode.is_some_and(|inode| sockets.contains(&inode))
        });
        let ports = own.map(|row| {
            let port = row.get(1).and_then(|local| local.split_once(':'));
            let (_, port) = port.context("not an address")?;
            Ok(u16::from_str_radix(port, 16)?)
        });
        ports.collect()
    }

    /// Waits until the program prints this line.
    pub fn wait_for(&mut self, line: &str, limit: Duration) -> Result<()> {
        self.line(line, |printed| printed == line, limit).map(drop)
    }

    /// Returns the next line that ends with these words.
    pub fn line_with_end(&mut self, end: &str, limit: Duration) -> Result<String> {
        self.line(end, |printed| printed.ends_with(end), limit)
    }

    fn line(&mut self, what: &str, is: impl Fn(&str) -> bool, limit: Duration) -> Result<String> {
        let deadline = Instant::now() + limit;
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            match self.output.recv_timeout(left) {
                Ok(printed) if is(&printed) => return Ok(printed),
                Ok(_) => {}
                Err(RecvTimeoutError::Timeout) => {
                    bail!("{} did not print `{what}` within {limit:?}", self.name)
                }
                Err(RecvTimeoutError::Disconnected) => {
                    bail!("{} ended before it printed `{what}`", self.name)
                }
            }
        }
    }

    pub fn write_line(&mut self, line: &str) -> Result<()> {
        let input = self
            .input
            .as_mut()
            .with_context(|| format!("{} has no input", self.name))?;
        writeln!(input, "{line}").with_context(|| format!("cannot write to {}", self.name))
    }

    /// Sends a signal by its name (`TERM`, `INT`, `HUP`, `STOP`, `KILL`).
    pub fn signal(&self, name: &str) -> Result<()> {
        super::run(&format!("kill -{name} {}", self.pid()))?;
        Ok(())
    }

    pub fn wait(&mut self, limit: Duration) -> Result<ExitStatus> {
        let deadline = Instant::now() + limit;
        loop {
            if let Some(status) = self.child.try_wait()? {
                return Ok(status);
            }
            if Instant::now() > deadline {
                bail!("{} still runs after {limit:?}", self.name);
            }
            std::thread::sleep(Duration::from_millis(10));
        }
    }

    /// Sends SIGTERM to the program, and fails if it does not end in time.
    pub fn terminate(&mut self) -> Result<ExitStatus> {
        if let Some(status) = self.child.try_wait()? {
            return Ok(status);
        }
        self.signal("TERM")?;
        self.wait(Duration::from_secs(70))
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
