//! `rp top`: a live table of topics in a terminal, or one table as text.
//!
//! `rp top` shows the answers of the agent's API. Names from the network are escaped (`text`), and
//! the terminal is restored on every exit (`terminal`). Topics that it measures are released at its
//! end, unless `W` keeps them.

mod app;
mod details;
mod event_pane;
mod header;
mod help;
mod inside;
mod measure_requests;
mod poller;
mod row;
mod server_sent;
mod table;
mod terminal;
pub(crate) mod text;
mod theme;
mod view;

use std::io;
use std::sync::mpsc::{Receiver, RecvTimeoutError, sync_channel};
use std::time::{Duration, Instant};

use crate::client::{Agent, ClientError};
use app::{App, Command, Fact};
use poller::{Input, Poller};
pub use row::Column;
use table::Table;
use terminal::Screen;
use theme::Theme;

/// Maximum time between two drawings, which update the shown age.
const MAX_REDRAW_INTERVAL: Duration = Duration::from_millis(500);
/// Minimum time between two drawings caused by facts. Keys redraw immediately.
const MIN_REDRAW_INTERVAL: Duration = Duration::from_millis(100);
/// Maximum number of keys and facts that wait for a slow terminal. Senders block beyond it.
const MAX_WAITING: usize = 64;
/// Maximum number of header lines in text without scrolling.
const MAX_HEADER: usize = 16;

/// Initial view.
#[derive(Clone, Debug, Default)]
pub struct Options {
    /// Domain to show; `None` for all.
    pub domain_id: Option<u32>,
    /// Column by which the table is sorted.
    pub sort: Column,
    /// Whether the order is reversed.
    pub reverse: bool,
    /// Text in the name, type or state of shown topics.
    pub filter: String,
    /// Whether only topics with problems are shown.
    pub problems: bool,
    /// Whether hidden topics are shown as well.
    pub hidden: bool,
}

/// Returns the current table as text, with all columns in full width.
///
/// # Errors
///
/// Fails if the agent is unreachable or refuses.
pub fn once(agent: &Agent, options: &Options) -> Result<String, ClientError> {
    let (health, topics) = poller::request(agent, options.domain_id, options.hidden)?;
    let (mut app, now) = (App::new(options, agent.place()), Instant::now());
    app.take(Fact::Health(Box::new(health)), now);
    app.take(Fact::Topics(Box::new(topics)), now);
    let theme = Theme::default();
    let rows: Vec<_> = app.shown().collect();
    let table = Table::whole(&rows, theme.cut());
    let (heading, _) = table.heading(app.sort);
    let mut text = String::new();
    let header = header::lines(&app, 0, MAX_HEADER, theme, now);
    let header = header.into_iter().map(|(line, _)| line);
    let rows = rows.iter().map(|row| table.line(row));
    for line in header.chain([heading]).chain(rows) {
        text.push_str(line.trim_end());
        text.push('\n');
    }
    Ok(text)
}

/// Shows the table in the terminal and requests it every `interval`, until a key ends it. Returns
/// the exit code.
///
/// # Errors
///
/// Fails if standard output is not a terminal, or if a thread cannot be started.
pub fn live(agent: Agent, options: &Options, interval: Duration) -> io::Result<u8> {
    let theme = Theme::of(|name| std::env::var(name).ok());
    let mut app = App::new(options, agent.place());
    let mut screen = Screen::open()?;
    let (inputs, input) = sync_channel(MAX_WAITING);
    terminal::listen_to_signals(inputs.clone())?;
    terminal::listen(inputs.clone())?;
    let poller = Poller::start(agent, options.domain_id, interval, &inputs)?;
    if options.hidden {
        poller.command(Command::Hidden(true));
    }
    loop {
        let draw =
            |frame: &mut ratatui::Frame<'_>| view::draw(&mut app, frame, theme, Instant::now());
        screen.terminal().draw(draw)?;
        if let Some(code) = handle_input(&mut app, &poller, &input) {
            return Ok(code);
        }
    }
}

/// Waits for input and processes it. Returns the exit code if it ends the program.
fn handle_input(app: &mut App, poller: &Poller, input: &Receiver<Input>) -> Option<u8> {
    let begun = Instant::now();
    let mut is_changed = false;
    loop {
        let timeout = if is_changed {
            MIN_REDRAW_INTERVAL
        } else {
            MAX_REDRAW_INTERVAL
        };
        let next = match input.recv_timeout(timeout.saturating_sub(begun.elapsed())) {
            Ok(next) => next,
            Err(RecvTimeoutError::Timeout) => return None,
            Err(RecvTimeoutError::Disconnected) => return Some(1),
        };
        let (commands, is_urgent) = match next {
            Input::End(code) => return Some(code),
            Input::Key(key) => (app.key(key), true),
            Input::Resized => (Vec::new(), true),
            Input::Fact(fact) => (app.take(fact, Instant::now()), false),
        };
        for command in commands {
            if command == Command::Quit {
                return Some(0);
            }
            poller.command(command);
        }
        if is_urgent {
            return None;
        }
        is_changed = true;
    }
}
