//! Keys of the terminal: the space bar pauses and resumes.

use std::io::{self, IsTerminal as _, Read as _};
use std::sync::mpsc::Sender;

use ros2probe_daemon::recording::Command;
use rustix::termios::{LocalModes, OptionalActions, Termios, tcgetattr, tcsetattr};

const SPACE_KEY: u8 = b' ';

/// Standard input without line mode and echo. Dropping it restores the settings.
pub(super) struct Keys(Termios);

impl Keys {
    pub(super) fn take() -> Option<Self> {
        let stdin = io::stdin();
        if !stdin.is_terminal() {
            return None;
        }
        let before = tcgetattr(&stdin).ok()?;
        let mut now = before.clone();
        now.local_modes
            .remove(LocalModes::ICANON | LocalModes::ECHO);
        tcsetattr(&stdin, OptionalActions::Now, &now).ok()?;
        Some(Self(before))
    }
}

impl Drop for Keys {
    fn drop(&mut self) {
        // A failure here cannot be reported.
        let _ = tcsetattr(io::stdin(), OptionalActions::Now, &self.0);
    }
}

pub(super) fn read_keys(give: Sender<Command>) {
    let read = move || {
        for byte in io::stdin().lock().bytes() {
            match byte {
                Ok(SPACE_KEY) => {
                    let _ = give.send(Command::Toggle);
                }
                Ok(_) => {}
                Err(_) => return,
            }
        }
    };
    let thread = std::thread::Builder::new().name("keys".to_owned());
    // Without this thread, only the keys have no effect.
    let _ = thread.spawn(read);
}
