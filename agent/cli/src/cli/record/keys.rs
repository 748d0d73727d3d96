//! Keys of the terminal: the space bar pauses and resumes.

use std::io::{self, IsTerminal as _};
use std::sync::mpsc::Sender;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use ros2probe_daemon::recording::Command;
use rustix::event::{PollFd, PollFlags, poll};
use rustix::io::{Errno, retry_on_intr};
use rustix::process::getpgrp;
use rustix::termios::{LocalModes, OptionalActions, Termios, tcgetattr, tcgetpgrp, tcsetattr};

const SPACE_KEY: u8 = b' ';
/// Pause of the keys while another process group has the terminal.
const BACKGROUND_PAUSE: Duration = Duration::from_millis(500);

/// Settings of the terminal before [`Keys::take`]. The variable is global, because a signal may end
/// the process.
static SETTINGS_BEFORE: Mutex<Option<Termios>> = Mutex::new(None);

/// Standard input without line mode and echo. Dropping it restores the settings.
pub(super) struct Keys(());

impl Keys {
    /// Returns `None` if standard input is no terminal, or the terminal of another process group.
    pub(super) fn take() -> Option<Self> {
        let stdin = io::stdin();
        // A change of the settings would stop a process in the background.
        if !stdin.is_terminal() || !is_in_foreground() {
            return None;
        }
        let before = tcgetattr(&stdin).ok()?;
        let mut now = before.clone();
        now.local_modes
            .remove(LocalModes::ICANON | LocalModes::ECHO);
        *SETTINGS_BEFORE
            .lock()
            .unwrap_or_else(PoisonError::into_inner) = Some(before);
        tcsetattr(&stdin, OptionalActions::Now, &now).ok()?;
        Some(Self(()))
    }
}

impl Drop for Keys {
    fn drop(&mut self) {
        give_back();
    }
}

/// Restores the settings of the terminal, if they were changed.
pub(super) fn give_back() {
    let mut before = SETTINGS_BEFORE
        .lock()
        .unwrap_or_else(PoisonError::into_inner);
    if let Some(before) = before.take()
        && is_in_foreground()
    {
        // A failure here cannot be reported.
        let _ = tcsetattr(io::stdin(), OptionalActions::Now, &before);
    }
}

/// Returns whether the terminal at standard input belongs to the process group.
fn is_in_foreground() -> bool {
    tcgetpgrp(io::stdin()) == Ok(getpgrp())
}

pub(super) fn read_keys(give: Sender<Command>) {
    let read = move || while read_some(&give).is_ok() {};
    let thread = std::thread::Builder::new().name("keys".to_owned());
    // Without this thread, only the keys have no effect.
    let _ = thread.spawn(read);
}

/// Waits for keys, and reads them. Fails at the end of the terminal.
fn read_some(give: &Sender<Command>) -> rustix::io::Result<()> {
    let stdin = io::stdin();
    let mut source = [PollFd::new(&stdin, PollFlags::IN)];
    retry_on_intr(|| poll(&mut source, None))?;
    if !source[0].revents().contains(PollFlags::IN) {
        return Err(Errno::IO);
    }
    // A read would stop a process that a shell has put into the background.
    if !is_in_foreground() {
        std::thread::sleep(BACKGROUND_PAUSE);
        return Ok(());
    }
    let mut keys = [0; 64];
    let read = retry_on_intr(|| rustix::io::read(&stdin, &mut keys))?;
    if read == 0 {
        return Err(Errno::IO);
    }
    for _ in keys.iter().take(read).filter(|key| **key == SPACE_KEY) {
        let _ = give.send(Command::Toggle);
    }
    Ok(())
}
