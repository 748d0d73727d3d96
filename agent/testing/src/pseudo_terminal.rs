//! A program on a pseudo-terminal, and its screen.

use std::fs::File;
use std::io::{Read as _, Write as _};
use std::os::fd::{AsRawFd as _, FromRawFd as _, OwnedFd};
use std::os::unix::process::CommandExt as _;
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::time::{Duration, Instant};

/// Maximum wait for a text on the screen or for the end of the program.
const PATIENCE: Duration = Duration::from_secs(60);

/// A running program; dropping the value kills it.
pub struct Terminal {
    child: Child,
    master: File,
    /// Kept open: its settings are read after the program has ended.
    slave: OwnedFd,
    before: libc::termios,
    written: Receiver<Vec<u8>>,
    screen: Screen,
    all: Vec<u8>,
}

impl Terminal {
    /// Starts `command` on 80x24.
    pub fn start(command: &mut Command) -> Self {
        let (mut master, mut slave) = (-1, -1);
        let size = window(80, 24);
        // SAFETY: both descriptors are written to; name and settings are null.
        let opened = unsafe {
            libc::openpty(
                &raw mut master,
                &raw mut slave,
                std::ptr::null_mut(),
                std::ptr::null(),
                &raw const size,
            )
        };
        assert_eq!(opened, 0, "openpty: {}", std::io::Error::last_os_error());
        // SAFETY: openpty has just opened it, without another owner.
        let master = unsafe { File::from_raw_fd(master) };
        // SAFETY: as above.
        let slave = unsafe { OwnedFd::from_raw_fd(slave) };
        let end = || Stdio::from(slave.try_clone().unwrap());
        command.stdin(end()).stdout(end()).stderr(end());
        let lead = || {
            // SAFETY: a new child leads no group.
            let led = unsafe { libc::setsid() };
            // SAFETY: standard input is the terminal.
            let owned = unsafe { libc::ioctl(0, libc::TIOCSCTTY, 0) };
            if led < 0 || owned < 0 {
                return Err(std::io::Error::last_os_error());
            }
            Ok(())
        };
        // SAFETY: it makes two system calls and touches no memory.
        unsafe { command.pre_exec(lead) };
        let before = settings(&slave);
        let child = command.spawn().unwrap();
        let (sender, written) = channel();
        let mut reader = master.try_clone().unwrap();
        std::thread::spawn(move || {
            let mut buffer = [0; 4096];
            while let Ok(count) = reader.read(&mut buffer) {
                if count == 0 || sender.send(buffer[..count].to_vec()).is_err() {
                    break;
                }
            }
        });
        Self {
            child,
            master,
            slave,
            before,
            written,
            screen: Screen::new(80, 24),
            all: Vec::new(),
        }
    }

    pub fn press(&mut self, keys: &str) {
        self.master.write_all(keys.as_bytes()).unwrap();
    }

    pub fn resize(&mut self, width: u16, height: u16) {
        let size = window(width, height);
        let descriptor = self.master.as_raw_fd();
        // SAFETY: the descriptor is open and the size has the requested type.
        let resized = unsafe { libc::ioctl(descriptor, libc::TIOCSWINSZ, &raw const size) };
        assert_eq!(resized, 0);
        self.screen = Screen::new(width.into(), height.into());
    }

    /// Stops the terminal's output, as on a connection that hangs.
    pub fn stop_output(&self) {
        // SAFETY: the descriptor is open; nothing else is passed.
        let stopped = unsafe { libc::tcflow(self.slave.as_raw_fd(), libc::TCOOFF) };
        assert_eq!(stopped, 0, "tcflow: {}", std::io::Error::last_os_error());
    }

    pub fn signal(&self, name: &str) {
        let id = self.child.id().to_string();
        assert!(
            Command::new("kill")
                .args([name, &id])
                .status()
                .unwrap()
                .success()
        );
    }

    /// Waits until this text is on the screen.
    pub fn wait_for(&mut self, text: &str) {
        let deadline = Instant::now() + PATIENCE;
        while !self.screen().contains(text) {
            assert!(
                self.read(deadline),
                "no `{text}` on the screen:\n{}",
                self.screen()
            );
        }
    }

    pub fn screen(&self) -> String {
        self.screen.text()
    }

    /// Waits for the end; returns the exit code, `None` after a signal.
    pub fn ends(&mut self) -> Option<i32> {
        let deadline = Instant::now() + PATIENCE;
        loop {
            self.read(Instant::now() + Duration::from_millis(50));
            if let Some(status) = self.child.try_wait().unwrap() {
                while self.read(Instant::now() + Duration::from_millis(200)) {}
                return status.code();
            }
            assert!(Instant::now() < deadline, "it runs on:\n{}", self.screen());
        }
    }

    /// Returns all output so far.
    pub fn written(&self) -> String {
        String::from_utf8_lossy(&self.all).into_owned()
    }

    /// Asserts that the terminal's settings are restored.
    pub fn assert_settings_given_back(&self) {
        let now = settings(&self.slave);
        let flags = |it: &libc::termios| (it.c_iflag, it.c_oflag, it.c_cflag, it.c_lflag, it.c_cc);
        assert_eq!(flags(&now), flags(&self.before));
    }

    /// Asserts that the terminal's settings, screen and cursor are restored.
    pub fn assert_given_back(&self) {
        self.assert_settings_given_back();
        let text = self.written();
        for (taken, given_back) in [("\x1b[?1049h", "\x1b[?1049l"), ("\x1b[?25l", "\x1b[?25h")] {
            let (taken, given_back) = (text.rfind(taken), text.rfind(given_back));
            assert!(taken.is_some() && taken < given_back, "{text:?}");
        }
        let (_, after) = text.rsplit_once("\x1b[?1049l").unwrap();
        assert!(
            !after.contains("panicked") && !after.contains("error"),
            "{after:?}"
        );
    }

    /// Returns whether any output arrived before the deadline.
    fn read(&mut self, deadline: Instant) -> bool {
        let left = deadline.saturating_duration_since(Instant::now());
        match self.written.recv_timeout(left) {
            Ok(bytes) => {
                self.all.extend_from_slice(&bytes);
                self.screen.write(&bytes);
                true
            }
            Err(RecvTimeoutError::Timeout | RecvTimeoutError::Disconnected) => false,
        }
    }
}

impl Drop for Terminal {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

const fn window(width: u16, height: u16) -> libc::winsize {
    libc::winsize {
        ws_row: height,
        ws_col: width,
        ws_xpixel: 0,
        ws_ypixel: 0,
    }
}

fn settings(terminal: &OwnedFd) -> libc::termios {
    // SAFETY: plain integers, for which zero is valid.
    let mut settings = unsafe { std::mem::zeroed() };
    // SAFETY: the descriptor is open and the settings are written to.
    let read = unsafe { libc::tcgetattr(terminal.as_raw_fd(), &raw mut settings) };
    assert_eq!(read, 0, "tcgetattr: {}", std::io::Error::last_os_error());
    settings
}

/// The parts of a terminal that the program uses: text, cursor positions, clearing.
struct Screen {
    cells: Vec<Vec<char>>,
    row: usize,
    column: usize,
    /// The start of an incomplete sequence or character.
    rest: Vec<u8>,
}

impl Screen {
    fn new(width: usize, height: usize) -> Self {
        Self {
            cells: vec![vec![' '; width]; height],
            row: 0,
            column: 0,
            rest: Vec::new(),
        }
    }

    fn text(&self) -> String {
        let lines = self
            .cells
            .iter()
            .map(|line| line.iter().collect::<String>());
        lines
            .map(|line| line.trim_end().to_owned() + "\n")
            .collect()
    }

    fn write(&mut self, bytes: &[u8]) {
        self.rest.extend_from_slice(bytes);
        let bytes = std::mem::take(&mut self.rest);
        let mut at = 0;
        while at < bytes.len() {
            let rest = &bytes[at..];
            match rest {
                [] => break,
                [0x1b, b'[', ..] => {
                    let end = rest
                        .iter()
                        .skip(2)
                        .position(|byte| (0x40..0x7f).contains(byte));
                    let Some(end) = end else { break };
                    let parameters = String::from_utf8_lossy(&rest[2..end + 2]).into_owned();
                    self.control(rest[end + 2], &parameters);
                    at += end + 3;
                }
                [0x1b] => break,
                [0x1b, _, ..] => at += 2,
                [b'\r', ..] => {
                    self.column = 0;
                    at += 1;
                }
                [b'\n', ..] => {
                    self.row += 1;
                    at += 1;
                }
                [byte, ..] => {
                    let length = match byte {
                        0xf0.. => 4,
                        0xe0.. => 3,
                        0xc0.. => 2,
                        _ => 1,
                    };
                    let Some(character) = rest.get(..length) else {
                        break;
                    };
                    let character = String::from_utf8_lossy(character).chars().next();
                    self.put(character.unwrap());
                    at += length;
                }
            }
        }
        self.rest = bytes[at..].to_vec();
    }

    fn control(&mut self, command: u8, parameters: &str) {
        let mut numbers = parameters.split(';').map(|number| number.parse::<usize>());
        let mut next = || numbers.next().and_then(Result::ok).unwrap_or(1).max(1) - 1;
        match command {
            b'H' => (self.row, self.column) = (next(), next()),
            b'J' => self.cells.iter_mut().flatten().for_each(|cell| *cell = ' '),
            b'h' | b'l' if parameters == "?1049" => {
                self.cells.iter_mut().flatten().for_each(|cell| *cell = ' ');
            }
            _ => {}
        }
    }

    fn put(&mut self, character: char) {
        let line = self.cells.get_mut(self.row);
        if let Some(cell) = line.and_then(|line| line.get_mut(self.column)) {
            *cell = character;
        }
        self.column += 1;
    }
}
