//! The command line, which equals that of the other peers (see README.md).

use std::process::exit;
use std::str::FromStr;
use std::time::Duration;

use serde_json::{Map, Value};

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    Publisher,
    Subscriber,
}

/// What a library does or does not do. A policy counts if it is announced, and judged as the
/// standard says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Capability {
    Reliability,
    Durability,
    /// Samples written before the match arrive.
    LateJoiner,
    Ownership,
    /// The strongest writer of an instance is the only one heard.
    Arbitration,
    Deadline,
    Lifespan,
    Liveliness,
    Partition,
    Filter,
    Fragments,
    IncompatibleQos,
    Matched,
}

impl Capability {
    const ALL: [(Capability, &str); 13] = [
        (Capability::Reliability, "reliability"),
        (Capability::Durability, "durability"),
        (Capability::LateJoiner, "late_joiner"),
        (Capability::Ownership, "ownership"),
        (Capability::Arbitration, "arbitration"),
        (Capability::Deadline, "deadline"),
        (Capability::Lifespan, "lifespan"),
        (Capability::Liveliness, "liveliness"),
        (Capability::Partition, "partition"),
        (Capability::Filter, "filter"),
        (Capability::Fragments, "fragments"),
        (Capability::IncompatibleQos, "incompatible_qos"),
        (Capability::Matched, "matched"),
    ];
}

#[derive(Clone, Debug)]
pub struct Options {
    pub role: Role,
    pub domain: u16,
    pub topic: String,
    pub color: String,
    pub best_effort: bool,
    pub transient_local: bool,
    /// The number of samples that the history keeps, or all.
    pub depth: Option<u32>,
    pub exclusive: bool,
    pub strength: i32,
    pub deadline: Option<Duration>,
    pub lifespan: Option<Duration>,
    pub lease: Option<Duration>,
    pub partitions: Vec<String>,
    pub filter: Option<String>,
    pub size: usize,
    pub rate: f64,
    /// The number of samples to send, or to receive before the end; 0 means no limit.
    pub count: u64,
    pub peers: i32,
    pub hold: bool,
    /// A publisher waits for a line on standard input each time it has sent this many samples; 0
    /// means that it does not wait.
    pub stretch: u64,
    pub linger: Duration,
    pub log: Option<String>,
}

impl Options {
    /// Parses the command line. `supports` returns whether the library has a capability in a
    /// role, and `announces` whether it takes the option. Larger payloads than `largest` make
    /// fragments.
    pub fn parse(
        largest: usize,
        supports: fn(Role, Capability) -> bool,
        announces: fn(Role, Capability) -> bool,
    ) -> Options {
        let mut options = Options {
            role: Role::Publisher,
            domain: 0,
            topic: "Square".to_owned(),
            color: "BLUE".to_owned(),
            best_effort: false,
            transient_local: false,
            depth: Some(100),
            exclusive: false,
            strength: 0,
            deadline: None,
            lifespan: None,
            lease: None,
            partitions: Vec::new(),
            filter: None,
            size: 0,
            rate: 20.0,
            count: 0,
            peers: 1,
            hold: false,
            stretch: 0,
            linger: Duration::from_secs(1),
            log: None,
        };
        let mut role = None;
        let mut lists_capabilities = false;
        let mut needs = Vec::new();
        let mut words = std::env::args().skip(1);
        while let Some(name) = words.next() {
            let mut need = |capability| needs.push((name.clone(), capability));
            let mut text = || words.next().unwrap_or_else(|| usage(&name, "has no value"));
            match name.as_str() {
                "--role" => role = Some(role_of(&text())),
                "--domain" => options.domain = number(&name, &text()),
                "--topic" => options.topic = text(),
                "--color" => options.color = text(),
                "--reliable" => options.best_effort = false,
                "--best-effort" => {
                    options.best_effort = true;
                    need(Capability::Reliability);
                }
                "--durability" => {
                    options.transient_local = is_transient_local(&text());
                    if options.transient_local {
                        need(Capability::Durability);
                    }
                }
                "--depth" => options.depth = Some(number(&name, &text())),
                "--keep-all" => options.depth = None,
                "--ownership-strength" => {
                    options.exclusive = true;
                    options.strength = number(&name, &text());
                    need(Capability::Ownership);
                }
                "--exclusive" => {
                    options.exclusive = true;
                    need(Capability::Ownership);
                }
                "--deadline" => {
                    options.deadline = Some(milliseconds(&name, &text()));
                    need(Capability::Deadline);
                }
                "--lifespan" => {
                    options.lifespan = Some(milliseconds(&name, &text()));
                    need(Capability::Lifespan);
                }
                "--liveliness-lease" => {
                    options.lease = Some(milliseconds(&name, &text()));
                    need(Capability::Liveliness);
                }
                "--partition" => {
                    options.partitions.push(text());
                    need(Capability::Partition);
                }
                "--filter" => {
                    options.filter = Some(text());
                    need(Capability::Filter);
                }
                "--size" => {
                    options.size = number(&name, &text());
                    if options.size > largest {
                        need(Capability::Fragments);
                    }
                }
                "--rate" => options.rate = number(&name, &text()),
                "--count" => options.count = number(&name, &text()),
                "--peers" => options.peers = number(&name, &text()),
                "--hold" => options.hold = true,
                "--stretch" => options.stretch = number(&name, &text()),
                "--linger" => options.linger = Duration::from_secs_f64(number(&name, &text())),
                "--log" => options.log = Some(text()),
                "--capabilities" => lists_capabilities = true,
                _ => usage(&name, "is unknown"),
            }
        }
        if lists_capabilities {
            println!("{}", Value::Object(list(supports, role)));
            exit(0);
        }
        options.role = role.unwrap_or_else(|| usage("--role", "is missing"));
        if let Some((name, _)) = needs
            .iter()
            .find(|(_, capability)| !announces(options.role, *capability))
        {
            usage(name, "is not supported by this library");
        }
        options
    }
}

/// Lists the capabilities of a role, or those that both roles have.
fn list(supports: fn(Role, Capability) -> bool, role: Option<Role>) -> Map<String, Value> {
    let roles = role.map_or(vec![Role::Publisher, Role::Subscriber], |role| vec![role]);
    Capability::ALL
        .into_iter()
        .map(|(capability, name)| {
            let all = roles.iter().all(|role| supports(*role, capability));
            (name.to_owned(), Value::Bool(all))
        })
        .collect()
}

fn role_of(text: &str) -> Role {
    match text {
        "pub" => Role::Publisher,
        "sub" => Role::Subscriber,
        _ => usage("--role", "is pub or sub"),
    }
}

fn is_transient_local(text: &str) -> bool {
    match text {
        "volatile" => false,
        "transient-local" => true,
        _ => usage("--durability", "is volatile or transient-local"),
    }
}

fn number<N: FromStr>(name: &str, text: &str) -> N {
    text.parse()
        .unwrap_or_else(|_| usage(name, "is not a number"))
}

fn milliseconds(name: &str, text: &str) -> Duration {
    Duration::from_millis(number(name, text))
}

fn usage(name: &str, problem: &str) -> ! {
    eprintln!("{name} {problem}");
    exit(2);
}
