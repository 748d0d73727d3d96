//! Polls the agent's API on its own threads, so that a slow agent never delays a key. Polling
//! continues while the agent is unreachable. Facts go into a channel.

use std::io;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, SyncSender};
use std::thread;
use std::time::{Duration, Instant};

use serde_json::Value;

use super::app::{Command, Fact};
use super::measure_requests::MeasureRequests;
use super::row::Key;
use super::server_sent::Messages;
use super::text::escaped;
use crate::client::{Agent, ClientError};
use ros2probe_api::events::{Event, Lagged};
use ros2probe_api::health::Health;
use ros2probe_api::path::encoded;
use ros2probe_api::topics::{TopicDetails, TopicList};

/// Pause before a broken stream of events is reopened.
const RETRY: Duration = Duration::from_secs(2);

/// Input of the program.
#[derive(Debug)]
pub enum Input {
    /// An answer of the agent.
    Fact(Fact),
    /// A key.
    Key(ratatui::crossterm::event::KeyEvent),
    /// A new terminal size.
    Resized,
    /// The end of the program with this code.
    End(u8),
}

/// Request to the polling thread.
#[derive(Debug)]
pub(super) enum Request {
    Command(Command),
    /// Measuring a topic failed, for this reason.
    Lost(Key, String),
}

/// The polling threads.
#[derive(Debug)]
pub struct Poller {
    requests: Sender<Request>,
}

/// State of the polling thread.
#[derive(Debug)]
struct Poll {
    agent: Arc<Agent>,
    domain_id: Option<u32>,
    interval: Duration,
    hidden: bool,
    selected: Option<Key>,
    measure_requests: MeasureRequests,
    inputs: SyncSender<Input>,
}

impl Poller {
    /// Starts to poll every `interval`, for one domain or all of them.
    ///
    /// # Errors
    ///
    /// Fails if a thread cannot be started.
    pub fn start(
        agent: Agent,
        domain_id: Option<u32>,
        interval: Duration,
        inputs: &SyncSender<Input>,
    ) -> io::Result<Self> {
        let agent = Arc::new(agent);
        let (requests, asked) = std::sync::mpsc::channel();
        let poll = Poll {
            agent: Arc::clone(&agent),
            domain_id,
            interval,
            hidden: false,
            selected: None,
            measure_requests: MeasureRequests::new(Arc::clone(&agent), requests.clone()),
            inputs: inputs.clone(),
        };
        let thread = thread::Builder::new().name("poll".to_owned());
        thread.spawn(move || poll.run(&asked))?;
        let inputs = inputs.clone();
        let thread = thread::Builder::new().name("events".to_owned());
        thread.spawn(move || follow_events(&agent, &inputs))?;
        Ok(Self { requests })
    }

    /// Executes a command.
    pub fn command(&self, command: Command) {
        // The thread lives as long as the program, because a panic of the thread ends the program.
        let _ = self.requests.send(Request::Command(command));
    }
}

/// Requests all topics and the agent's state once.
///
/// # Errors
///
/// Fails if the agent is unreachable or refuses.
pub fn request(
    agent: &Agent,
    domain_id: Option<u32>,
    hidden: bool,
) -> Result<(Health, TopicList<'static>), ClientError> {
    let mut query = format!("?hidden={hidden}");
    if let Some(domain_id) = domain_id {
        query.push_str(&format!("&domain_id={domain_id}"));
    }
    let topics = agent.get(&format!("/topics{query}"))?;
    Ok((agent.get("/health")?, topics))
}

impl Poll {
    fn run(mut self, asked: &Receiver<Request>) {
        loop {
            let begun = Instant::now();
            self.all();
            loop {
                let left = self.interval.saturating_sub(begun.elapsed());
                match asked.recv_timeout(left) {
                    Ok(Request::Command(command)) => self.execute(command),
                    Ok(Request::Lost(key, why)) => {
                        let status = self.measure_requests.remove_failed(&key, why);
                        self.send_measured(status);
                    }
                    Err(RecvTimeoutError::Timeout) => break,
                    Err(RecvTimeoutError::Disconnected) => return,
                }
            }
        }
    }

    fn all(&mut self) {
        match request(&self.agent, self.domain_id, self.hidden) {
            Ok((health, topics)) => {
                self.send(Fact::Health(Box::new(health)));
                self.send(Fact::Topics(Box::new(topics)));
                self.details();
            }
            Err(error) => self.send(Fact::Gone(error.to_string())),
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
        match self.agent.get::<TopicDetails<'_>>(&path) {
            Ok(topic) => self.send(Fact::Details(key, Some(Box::new(topic)))),
            Err(ClientError::Refused(_)) => self.send(Fact::Details(key, None)),
            // The next poll detects that the agent is unreachable.
            Err(_) => {}
        }
    }

    fn execute(&mut self, command: Command) {
        match command {
            Command::Quit => {}
            Command::Select(key) => {
                self.selected = key;
                self.details();
            }
            Command::Hidden(hidden) => {
                self.hidden = hidden;
                self.all();
            }
            Command::Toggle(key, name) => {
                let status = self.measure_requests.toggle(&key, &name);
                self.send_measured(status);
            }
            Command::Keep(key, name) => {
                let status = self.measure_requests.keep(&key, &name);
                self.send_measured(status);
            }
        }
    }

    fn send_measured(&self, status: String) {
        self.send(Fact::Measured(self.measure_requests.shown()));
        self.send(Fact::Status(status));
    }

    fn send(&self, fact: Fact) {
        // The main thread reads the channel, so sending fails only while the program ends.
        let _ = self.inputs.send(Input::Fact(fact));
    }
}

/// Follows the agent's events from the oldest available one, and reconnects after each break.
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
                let status = Fact::Status(format!("no events: {refusal}"));
                let _ = inputs.send(Input::Fact(status));
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
    let read = serde_json::from_str::<Event<'_>>(data).or_else(|_| {
        // Unknown events are shown rather than dropped.
        serde_json::from_str::<Value>(data).map(|_| Event {
            name: escaped(event).into(),
            ..Event::default()
        })
    });
    read.ok().map(|event| Fact::Event(Box::new(event)))
}
