//! The guard: a process that runs the command in a process group of its own. If `rp ci` is killed,
//! the kernel signals the guard, and the guard ends the whole group.

use std::ffi::OsString;
use std::io::{ErrorKind, IsTerminal as _, stdin};
use std::os::unix::process::{CommandExt as _, ExitStatusExt as _};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitCode, ExitStatus, Stdio};
use std::time::Duration;

use anyhow::{Context as _, Result};
use ros2probe_daemon::private_agent::{end_with_parent, is_child_of};
use rustix::fs::{Access, access};
use rustix::process::{Pid, Signal, getpid, kill_process, kill_process_group};
use tokio::signal::unix::{SignalKind, signal};
use tokio::time::timeout;

/// Time between SIGTERM and SIGKILL to a command whose `rp ci` was killed.
const KILL_DELAY: Duration = Duration::from_secs(5);

/// The command cannot be started.
#[derive(Debug, thiserror::Error)]
#[error("cannot start `{program}`: {reason}")]
pub(crate) struct CannotStart {
    program: String,
    reason: String,
    /// Exit code: that of shells and of `env`.
    pub(crate) code: u8,
}

impl CannotStart {
    /// Exit code if the program is not found.
    const NOT_FOUND: u8 = 127;
    /// Exit code if it cannot be executed.
    const NOT_EXECUTABLE: u8 = 126;

    fn new(program: &OsString, kind: ErrorKind, reason: String) -> Self {
        Self {
            program: program.display().to_string(),
            reason,
            code: match kind {
                ErrorKind::NotFound => Self::NOT_FOUND,
                _ => Self::NOT_EXECUTABLE,
            },
        }
    }
}

/// Checks that the program exists and can be executed, before anything is started.
///
/// # Errors
///
/// Returns [`CannotStart`] otherwise.
pub(super) fn find(command: &[OsString]) -> Result<(), CannotStart> {
    let Some(program) = command.first() else {
        return Ok(());
    };
    let places: Vec<PathBuf> = match Path::new(program).components().count() {
        1 if !program.to_string_lossy().contains('/') => {
            let path = std::env::var_os("PATH").unwrap_or_default();
            std::env::split_paths(&path)
                .map(|directory| directory.join(program))
                .collect()
        }
        _ => vec![program.into()],
    };
    let files: Vec<_> = places.iter().filter(|place| place.is_file()).collect();
    if files.is_empty() {
        let reason = "no such program; the path is relative to this directory, or the environment \
                      of ROS is not sourced"
            .to_owned();
        return Err(CannotStart::new(program, ErrorKind::NotFound, reason));
    }
    let is_executable = |place: &&PathBuf| access(place.as_path(), Access::EXEC_OK).is_ok();
    if !files.iter().any(is_executable) {
        let reason = "it is not executable: `chmod +x` permits it".to_owned();
        return Err(CannotStart::new(
            program,
            ErrorKind::PermissionDenied,
            reason,
        ));
    }
    Ok(())
}

/// Starts the guard with the command. A terminal is not its input: a process group in the
/// background would be stopped when it reads.
pub(super) fn start(command: &[OsString]) -> Result<Child> {
    let program = std::env::current_exe().context("cannot find the program rp")?;
    let input = match stdin().is_terminal() {
        true => Stdio::null(),
        false => Stdio::inherit(),
    };
    Command::new(program)
        .args(["ci", "--guard"])
        .arg(getpid().as_raw_pid().to_string())
        .arg("--")
        .args(command)
        .stdin(input)
        .process_group(0)
        .spawn()
        .context("cannot start the guard of the command")
}

/// Sends a signal to the command.
pub(super) fn forward(guard: &Child, signal: Signal) {
    // A guard that has ended needs no signal.
    let _ = kill_process(Pid::from_child(guard), signal);
}

/// Returns the exit code of a process that ended with this status, as a shell does.
pub(super) fn code(status: ExitStatus) -> u8 {
    let code = status.code().or_else(|| Some(128 + status.signal()?));
    code.and_then(|code| u8::try_from(code).ok())
        .unwrap_or(u8::MAX)
}

/// Returns the exit code of a process that this signal ended.
pub(super) fn of_signal(signal: Signal) -> u8 {
    u8::try_from(128 + signal.as_raw()).unwrap_or(u8::MAX)
}

/// Runs the command for the process `parent`, and returns its exit code.
///
/// # Errors
///
/// Fails if the command cannot be started.
pub(super) fn run(parent: i32, command: &[OsString]) -> Result<ExitCode> {
    end_with_parent(parent, Signal::TERM)?;
    let [program, arguments @ ..] = command else {
        return Ok(ExitCode::SUCCESS);
    };
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()?;
    runtime.block_on(async {
        let mut ends = signal(SignalKind::terminate())?;
        let mut interrupts = signal(SignalKind::interrupt())?;
        let mut children = signal(SignalKind::child())?;
        let child = Command::new(program)
            .args(arguments)
            .process_group(0)
            .spawn();
        let mut child =
            child.map_err(|error| CannotStart::new(program, error.kind(), error.to_string()))?;
        let group = Pid::from_child(&child);
        let send = |signal| {
            // A group that has ended needs no signal.
            let _ = kill_process_group(group, signal);
        };
        loop {
            tokio::select! {
                _ = children.recv() => {
                    if let Some(status) = child.try_wait()? {
                        return Ok(ExitCode::from(code(status)));
                    }
                }
                _ = interrupts.recv() => send(Signal::INT),
                _ = ends.recv() => {
                    send(Signal::TERM);
                    if is_child_of(parent) {
                        continue;
                    }
                    // Members of the group may outlive the command.
                    let gone = async {
                        while child.try_wait()?.is_none() {
                            children.recv().await;
                        }
                        anyhow::Ok(())
                    };
                    let _ = timeout(KILL_DELAY, gone).await;
                    send(Signal::KILL);
                    return Ok(ExitCode::FAILURE);
                }
            }
        }
    })
}
