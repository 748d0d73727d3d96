//! The course of a peer: it opens its endpoint, waits for the other peers, and sends or receives.

use std::io::BufRead as _;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, TryRecvError, channel};
use std::thread::{sleep, spawn};
use std::time::{Duration, Instant};

use serde_json::json;
use signal_hook::consts::{SIGINT, SIGTERM};
use signal_hook::flag;

use crate::{Capability, Failure, Guid, Log, Options, Result, Role};

const POLL_INTERVAL: Duration = Duration::from_millis(2);
/// The time between the match and the first sample, unless a line on standard input starts it.
const SETTLE_TIME: Duration = Duration::from_millis(500);

pub enum Event {
    /// The number of matched endpoints, whether changed or not.
    Matched(i32),
    /// An endpoint is not matched because of the policy with this standard name.
    Incompatible(&'static str),
    Sample {
        number: i32,
        color: String,
        length: usize,
    },
}

/// One participant with one endpoint.
pub trait Peer: Sized {
    const STACK: &str;
    /// The additional payload of the largest sample that is not fragmented.
    const LARGEST_SIZE: usize = 65_000;

    fn supports(role: Role, capability: Capability) -> bool;
    /// Returns whether the library announces a policy, even if it judges it otherwise than the
    /// standard.
    fn announces(role: Role, capability: Capability) -> bool {
        Self::supports(role, capability)
    }
    fn open(options: &Options) -> Result<Self>;
    fn guid(&self) -> Option<Guid>;
    fn write(&mut self, number: i32) -> Result<()>;
    fn poll(&mut self) -> Result<Vec<Event>>;
    fn close(self) -> Result<()>;
}

pub fn run<P: Peer>() -> ExitCode {
    let options = Options::parse(P::LARGEST_SIZE, P::supports, P::announces);
    match Course::<P>::run(&options) {
        Ok(()) => ExitCode::SUCCESS,
        Err(Failure(reason)) => {
            eprintln!("{}: {reason}", P::STACK);
            ExitCode::FAILURE
        }
    }
}

struct Course<'a, P> {
    options: &'a Options,
    peer: P,
    log: Log,
    stopped: Arc<AtomicBool>,
    matched: i32,
    received: u64,
}

impl<P: Peer> Course<'_, P> {
    fn run(options: &Options) -> Result<()> {
        let stopped = Arc::new(AtomicBool::new(false));
        for signal in [SIGINT, SIGTERM] {
            flag::register(signal, Arc::clone(&stopped))?;
        }
        let mut log = Log::create(options.log.as_deref())?;
        let peer = P::open(options)?;
        let mut fields = json!({"stack": P::STACK, "pid": std::process::id()});
        if let Some(guid) = peer.guid() {
            let guid: String = guid.iter().map(|byte| format!("{byte:02x}")).collect();
            fields["guid"] = guid.into();
        }
        log.write("start", fields)?;
        println!("ready");
        let mut course = Course {
            options,
            peer,
            log,
            stopped,
            matched: 0,
            received: 0,
        };
        course.wait_matched()?;
        match options.role {
            Role::Publisher => course.publish()?,
            Role::Subscriber => course.pump(|course| !course.is_complete())?,
        }
        course.log.write("stop", json!({}))?;
        course.peer.close()
    }

    fn publish(&mut self) -> Result<()> {
        if self.options.hold {
            self.wait_for_line()?;
        } else {
            self.pump_until(Instant::now() + SETTLE_TIME)?;
        }
        let (mut start, mut first) = (Instant::now(), 0);
        for number in 0.. {
            if self.options.count != 0 && number == self.options.count {
                break;
            }
            if self.options.stretch != 0 && number == first + self.options.stretch {
                self.wait_for_line()?;
                (start, first) = (Instant::now(), number);
            }
            let due = Duration::from_secs_f64((number - first) as f64 / self.options.rate);
            self.pump_until(start + due)?;
            if self.is_stopped() {
                break;
            }
            self.peer.write(i32::try_from(number)?)?;
            let fields = json!({"seq": number, "len": self.options.size});
            self.log.write("pub", fields)?;
        }
        println!("done");
        self.pump_until(Instant::now() + self.options.linger)
    }

    fn wait_matched(&mut self) -> Result<()> {
        self.pump(|course| course.matched < course.options.peers && !course.is_complete())?;
        if !self.is_stopped() {
            println!("matched");
        }
        Ok(())
    }

    fn wait_for_line(&mut self) -> Result<()> {
        let line = line_of_standard_input();
        while !self.is_stopped() {
            match line.try_recv() {
                Ok(()) => break,
                Err(TryRecvError::Disconnected) => {
                    return Err("standard input ended before the line".into());
                }
                Err(TryRecvError::Empty) => self.pump_until(Instant::now() + POLL_INTERVAL)?,
            }
        }
        Ok(())
    }

    fn pump_until(&mut self, due: Instant) -> Result<()> {
        self.pump(|_| Instant::now() < due)
    }

    /// Logs what happens while the condition holds, at least once.
    fn pump(&mut self, condition: impl Fn(&Self) -> bool) -> Result<()> {
        loop {
            for event in self.peer.poll()? {
                self.note(event)?;
            }
            if self.is_stopped() || !condition(self) {
                return Ok(());
            }
            sleep(POLL_INTERVAL);
        }
    }

    fn note(&mut self, event: Event) -> Result<()> {
        match event {
            Event::Matched(total) => {
                if total != self.matched {
                    self.matched = total;
                    self.log.write("matched", json!({"total": total}))?;
                }
                Ok(())
            }
            Event::Incompatible(policy) => {
                self.log.write("incompatible", json!({"policy": policy}))
            }
            Event::Sample {
                number,
                color,
                length,
            } => {
                self.received += 1;
                let fields = json!({"seq": number, "color": color, "len": length});
                self.log.write("sub", fields)
            }
        }
    }

    fn is_complete(&self) -> bool {
        self.options.count != 0 && self.received >= self.options.count
    }

    fn is_stopped(&self) -> bool {
        self.stopped.load(Ordering::Relaxed)
    }
}

fn line_of_standard_input() -> Receiver<()> {
    let (sender, receiver) = channel();
    spawn(move || {
        let mut line = String::new();
        if matches!(std::io::stdin().lock().read_line(&mut line), Ok(1..)) {
            let _ = sender.send(());
        }
    });
    receiver
}
