//! Terminal in raw mode on its alternate screen. The terminal is restored at the end, also after a
//! panic of any thread.

use std::io::{self, BufWriter, IsTerminal as _, Stdout, Write as _};
use std::panic;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::SyncSender;
use std::thread;
use std::time::Duration;

use ratatui::Terminal;
use ratatui::backend::CrosstermBackend;
use ratatui::crossterm::event::{self, Event};
use ratatui::crossterm::terminal::{
    EnterAlternateScreen, LeaveAlternateScreen, disable_raw_mode, enable_raw_mode,
};
use ratatui::crossterm::{cursor, execute};
use tokio::signal::unix::{SignalKind, signal};

use super::poller::Input;

/// Exit code of a panic.
const EXIT_PANIC: i32 = 101;
/// Offset that a shell adds to the number of a signal.
const SIGNAL_EXIT_OFFSET: u8 = 128;

/// Maximum duration of a drawing. A signal then ends the program without waiting for the drawing.
const DRAWING_TIMEOUT: Duration = Duration::from_secs(2);

/// Whether the terminal is in raw mode.
static IN_RAW_MODE: AtomicBool = AtomicBool::new(false);

/// The terminal in raw mode, until this value is dropped.
#[derive(Debug)]
pub struct Screen {
    terminal: Terminal<CrosstermBackend<BufWriter<Stdout>>>,
}

impl Screen {
    /// Puts the terminal into raw mode.
    ///
    /// # Errors
    ///
    /// Fails if the terminal is missing or cannot be configured.
    pub fn open() -> io::Result<Self> {
        if !io::stdout().is_terminal() {
            let reason = "rp top needs a terminal; `rp top --once` prints the table and ends";
            return Err(io::Error::new(io::ErrorKind::Unsupported, reason));
        }
        let before = panic::take_hook();
        panic::set_hook(Box::new(move |panic| {
            give_back();
            before(panic);
            // After a panic of a reading thread, the screen would never update again.
            std::process::exit(EXIT_PANIC);
        }));
        IN_RAW_MODE.store(true, Ordering::Relaxed);
        let taken = enable_raw_mode()
            .and_then(|()| execute!(io::stdout(), EnterAlternateScreen, cursor::Hide))
            .and_then(|()| Terminal::new(CrosstermBackend::new(BufWriter::new(io::stdout()))));
        match taken {
            Ok(terminal) => Ok(Self { terminal }),
            Err(error) => {
                give_back();
                Err(error)
            }
        }
    }

    /// Returns the terminal to draw on.
    pub const fn terminal(&mut self) -> &mut Terminal<CrosstermBackend<BufWriter<Stdout>>> {
        &mut self.terminal
    }
}

impl Drop for Screen {
    fn drop(&mut self) {
        give_back();
    }
}

/// Restores the terminal. Failures, for example after a hangup, are ignored.
fn give_back() {
    if IN_RAW_MODE.swap(false, Ordering::Relaxed) {
        let _ = disable_raw_mode();
        let _ = execute!(io::stdout(), LeaveAlternateScreen, cursor::Show);
        let _ = io::stdout().flush();
    }
}

/// Starts a thread that forwards keys and sizes.
///
/// # Errors
///
/// Fails if the thread cannot be started.
pub fn listen(inputs: SyncSender<Input>) -> io::Result<()> {
    let thread = thread::Builder::new().name("keys".to_owned());
    let read = move || {
        loop {
            let input = match event::read() {
                Ok(Event::Key(key)) => Input::Key(key),
                Ok(Event::Resize(..)) => Input::Resized,
                Ok(_) => continue,
                // The terminal is gone.
                Err(_) => Input::End(1),
            };
            let is_over = matches!(input, Input::End(_));
            if inputs.send(input).is_err() || is_over {
                return;
            }
        }
    };
    thread.spawn(read).map(drop)
}

/// Forwards signals that end a program.
///
/// # Errors
///
/// Fails if the signal handlers cannot be installed.
pub fn listen_to_signals(inputs: SyncSender<Input>) -> io::Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_io()
        .build()?;
    let kinds = [
        SignalKind::hangup(),
        SignalKind::interrupt(),
        SignalKind::terminate(),
    ];
    let [mut hangup, mut interrupt, mut terminate] = {
        let _entered = runtime.enter();
        let [hangup, interrupt, terminate] = kinds.map(signal);
        [hangup?, interrupt?, terminate?]
    };
    let wait = move || {
        let kind = runtime.block_on(async {
            tokio::select! {
                _ = hangup.recv() => SignalKind::hangup(),
                _ = interrupt.recv() => SignalKind::interrupt(),
                _ = terminate.recv() => SignalKind::terminate(),
            }
        });
        let number = u8::try_from(kind.as_raw_value()).unwrap_or_default();
        let code = SIGNAL_EXIT_OFFSET.saturating_add(number);
        let _ = inputs.try_send(Input::End(code));
        thread::sleep(DRAWING_TIMEOUT);
        // The terminal is blocked and drawing waits for it, so only its settings can be restored.
        let _ = disable_raw_mode();
        std::process::exit(code.into());
    };
    let thread = thread::Builder::new().name("signals".to_owned());
    thread.spawn(wait).map(drop)
}

#[cfg(test)]
mod tests {
    use std::process::Command;

    use ros2probe_testing::pseudo_terminal;

    use super::*;

    /// The test that [`a_panic_of_any_thread_restores_the_terminal`] starts as a process.
    const PANICS: &str = "top::terminal::tests::panics_on_a_screen";

    #[test]
    #[ignore = "started by another test, on a terminal of its own"]
    fn panics_on_a_screen() {
        // A plain test run has no terminal of this kind.
        if std::env::var_os("PANICS_ON_A_SCREEN").is_some() {
            let _screen = Screen::open().unwrap();
            let reader = thread::spawn(|| panic!("the reason"));
            let _ = reader.join();
            thread::sleep(DRAWING_TIMEOUT);
        }
    }

    #[test]
    fn a_panic_of_any_thread_restores_the_terminal() {
        let mut command = Command::new(std::env::current_exe().unwrap());
        command
            .args(["--exact", PANICS, "--ignored", "--nocapture"])
            .env("PANICS_ON_A_SCREEN", "1")
            .env("TERM", "xterm");
        let mut terminal = pseudo_terminal::Terminal::start(&mut command);
        assert_eq!(terminal.ends(), Some(EXIT_PANIC));
        terminal.assert_settings_given_back();
        let written = terminal.written();
        let (_, after) = written.rsplit_once("\x1b[?1049l").unwrap();
        assert!(after.contains("the reason"), "{written:?}");
        assert!(after.contains("\x1b[?25h"), "{written:?}");
    }
}
