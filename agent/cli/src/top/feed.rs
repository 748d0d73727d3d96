//! Reads the agent's API on threads of its own, so that a slow agent never holds up a key, and goes
//! on asking when the agent is gone. Facts go into a channel; it shows nothing.

use std::io;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, SyncSender};
use std::thread;
use std::time::{Duration, Instant};

use serde_json::Value;

use super::app::{Fact, Wish};
use super::facts::{Event, Health, Lagged, Topic, Topics};
use super::holds::Holds;
use super::row::Key;
use super::server_sent::Messages;
use super::text::safe;
use crate::client::{Agent, ClientError};
use ros2probe_api::path::encoded;

/// Pause before a stream of events that broke is opened again.
const RETRY: Duration = Duration::from_secs(2);

/// What the program waits for.
#[derive(Debug)]
pub enum Input {
    /// The agent said something.
    Fact(Fact),
    /// A key was pressed.
    Key(ratatui::crossterm::event::KeyEvent),
    /// The terminal has another size.
    Resized,
    /// The program is to end with this code.
    End(u8),
}

/// What the polling thread is told.
#[derive(Debug)]
pub(super) enum Ask {
    Wish(Wish),
    /// A topic is measured no longer, and why.
    Lost(Key, String),
}

/// The threads that read.
#[derive(Debug)]
pub struct Feed {
    asks: Sender<Ask>,
}

/// What is asked for again and again.
#[derive(Debug)]
struct Poll {
    agent: Arc<Agent>,
    domain_id: Option<u32>,
    interval: Duration,
    hidden: bool,
    selected: Option<Key>,
    holds: Holds,
    inputs: SyncSender<Input>,
}

impl Feed {
    /// Begins to ask, every `interval`, about one domain or all of them.
    ///
    /// # Errors
    /// No thread can be started.
    pub fn start(
        agent: Agent,
        domain_id: Option<u32>,
        interval: Duration,
        inputs: &SyncSender<Input>,
    ) -> io::Result<Self> {
        let agent = Arc::new(agent);
        let (asks, asked) = std::sync::mpsc::channel();
        let poll = Poll {
            agent: Arc::clone(&agent),
            domain_id,
            interval,
            hidden: false,
            selected: None,
            holds: Holds::new(Arc::clone(&agent), asks.clone()),
            inputs: inputs.clone(),
        };
        let thread = thread::Builder::new().name("poll".to_owned());
        thread.spawn(move || poll.run(&asked))?;
        let inputs = inputs.clone();
        let thread = thread::Builder::new().name("events".to_owned());
        thread.spawn(move || follow_events(&agent, &inputs))?;
        Ok(Self { asks })
    }

    /// Has a wish fulfilled.
    pub fn wish(&self, wish: Wish) {
        // The thread lives as long as the program: a panic of it ends both.
        let _ = self.asks.send(Ask::Wish(wish));
    }
}

/// All topics and the agent's state, once.
///
/// # Errors
/// The agent is gone or refuses.
pub fn ask(
    agent: &Agent,
    domain_id: Option<u32>,
    hidden: bool,
) -> Result<(Health, Topics), ClientError> {
    let mut query = format!("?hidden={hidden}");
    if let Some(domain_id) = domain_id {
        query.push_str(&format!("&domain_id={domain_id}"));
    }
    let topics = agent.get(&format!("/topics{query}"))?;
    Ok((agent.get("/health")?, topics))
}

impl Poll {
    fn run(mut self, asked: &Receiver<Ask>) {
        loop {
            let begun = Instant::now();
            self.all();
            loop {
                let left = self.interval.saturating_sub(begun.elapsed());
                match asked.recv_timeout(left) {
                    Ok(Ask::Wish(wish)) => self.fulfil(wish),
                    Ok(Ask::Lost(key, why)) => {
                        let said = self.holds.lost(&key, why);
                        self.tell_holds(said);
                    }
                    Err(RecvTimeoutError::Timeout) => break,
                    Err(RecvTimeoutError::Disconnected) => return,
                }
            }
        }
    }

    fn all(&mut self) {
        match ask(&self.agent, self.domain_id, self.hidden) {
            Ok((health, topics)) => {
                self.tell(Fact::Health(Box::new(health)));
                self.tell(Fact::Topics(Box::new(topics)));
                self.details();
            }
            Err(error) => self.tell(Fact::Gone(error.to_string())),
        }
    }

    fn details(&self) {
        let Some(key) = self.selected.clone() else {
            return;
        };
        let path = format!(
            "/topics/{}?domain_id={}",
            encoded(&key.dds_name),
            key.domain_id
        );
        match self.agent.get::<Topic>(&path) {
            Ok(topic) => self.tell(Fact::Details(key, Some(Box::new(topic)))),
            Err(ClientError::Refused(_)) => self.tell(Fact::Details(key, None)),
            // The next round tells that the agent is gone.
            Err(_) => {}
        }
    }

    fn fulfil(&mut self, wish: Wish) {
        match wish {
            Wish::Quit => {}
            Wish::Select(key) => {
                self.selected = key;
                self.details();
            }
            Wish::Hidden(hidden) => {
                self.hidden = hidden;
                self.all();
            }
            Wish::Toggle(key, name) => {
                let said = self.holds.toggle(&key, &name);
                self.tell_holds(said);
            }
            Wish::Keep(key, name) => {
                let said = self.holds.keep(&key, &name);
                self.tell_holds(said);
            }
        }
    }

    fn tell_holds(&self, said: String) {
        self.tell(Fact::Measured(self.holds.shown()));
        self.tell(Fact::Said(said));
    }

    fn tell(&self, fact: Fact) {
        // Whoever reads it ends the process when it ends.
        let _ = self.inputs.send(Input::Fact(fact));
    }
}

/// Follows the agent's events from the oldest it has, through every break.
fn follow_events(agent: &Agent, inputs: &SyncSender<Input>) {
    let mut messages = Messages::default();
    let mut is_refused = false;
    loop {
        let after = messages.last_id.clone().unwrap_or_else(|| "0".to_owned());
        match agent.stream(&format!("/events?after={}", encoded(&after))) {
            Ok(mut lines) => {
                while let Ok(Some(line)) = lines.line() {
                    let message = messages.line(&line);
                    let fact = message.and_then(|message| fact(&message.event, &message.data));
                    if let Some(fact) = fact
                        && inputs.send(Input::Fact(fact)).is_err()
                    {
                        return;
                    }
                }
                is_refused = false;
            }
            Err(ClientError::Refused(refusal)) if !is_refused => {
                let said = Fact::Said(format!("no events: {refusal}"));
                let _ = inputs.send(Input::Fact(said));
                is_refused = true;
            }
            Err(_) => {}
        }
        messages.cut();
        thread::sleep(RETRY);
    }
}

fn fact(event: &str, data: &str) -> Option<Fact> {
    if event == "lagged" {
        let lagged: Lagged = serde_json::from_str(data).ok()?;
        return Some(Fact::Lagged(lagged));
    }
    let read = serde_json::from_str::<Event>(data).or_else(|_| {
        // Shown rather than dropped.
        serde_json::from_str::<Value>(data).map(|_| Event {
            name: safe(event),
            ..Event::default()
        })
    });
    read.ok().map(|event| Fact::Event(Box::new(event)))
}
