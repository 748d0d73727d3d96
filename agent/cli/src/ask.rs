//! `rp discover` at the terminal: listen, say what will be sent, ask, say what came of it.

use std::io::{Write, stdout};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, bail};
use ros2probe_capture::live::LiveSource;
use ros2probe_capture::reassembly::Limits;
use ros2probe_daemon::agent::configuration;
use ros2probe_daemon::config::{CaptureSettings, ShmMode, SourceChoice};
use ros2probe_daemon::discover::session::{MOST_PACKETS, Session, Target};
use ros2probe_daemon::discover::{converse, local_participant};
use ros2probe_daemon::privilege;
use ros2probe_model::input::Input;
use ros2probe_model::naming::Naming;
use ros2probe_model::observer::{Observer, Settings};
use ros2probe_model::snapshot::ParticipantFacts;
use ros2probe_wire::discovery::Role;

use crate::cli::Discover;

/// How often the clock is looked at while listening.
const SLICE: Duration = Duration::from_millis(250);

/// The command.
pub(crate) fn discover(options: &Discover) -> Result<()> {
    let mut out = stdout().lock();
    let (config, _) = configuration(options.config.as_deref())?;
    let capture = capture(config.capture, options.interface.as_deref());
    privilege::check(&capture)?;
    let live = LiveSource::open(&capture, Limits::default())?;
    privilege::give_up(privilege::Role::capture())?;
    let participants = listen(live, options)?;
    let seconds = options.listen;
    let heard = match participants.len() {
        1 => "1 participant".to_owned(),
        count => format!("{count} participants"),
    };
    writeln!(out, "{heard} heard within {seconds} s; nothing was sent")?;
    let mut targets = Vec::new();
    for participant in &participants {
        let described = describe(participant);
        match Target::of(participant) {
            Ok(target) => {
                writeln!(out, "{described}, at {}", target.metatraffic)?;
                targets.push((target, participant.domain_id));
            }
            Err(refusal) => writeln!(out, "{described}: {}", refusal.reason())?,
        }
    }
    if options.participant.is_some() && targets.is_empty() {
        bail!("this participant was not heard or cannot be asked");
    }
    if !options.all && options.participant.is_none() {
        writeln!(out, "to ask, name one with --participant, or --all")?;
        return Ok(());
    }
    let mut failed = 0;
    for (target, domain_id) in &targets {
        let answered = ask(target, domain_id.0, options, &mut out)?;
        failed += usize::from(!answered);
    }
    if failed > 0 {
        bail!(
            "{failed} of {} participants answered only in part",
            targets.len()
        );
    }
    Ok(())
}

/// The configured capture, or the wire of one interface.
fn capture(mut configured: CaptureSettings, interface: Option<&str>) -> CaptureSettings {
    // Participants announce themselves on the network.
    configured.shm.mode = ShmMode::Off;
    let Some(interface) = interface else {
        return configured;
    };
    CaptureSettings {
        source: SourceChoice::Wire,
        cgroup: None,
        mirror_interfaces: Vec::new(),
        include_interfaces: vec![interface.to_owned()],
        exclude_interfaces: Vec::new(),
        ..configured
    }
}

/// Who announces itself, or the one that is looked for.
fn listen(mut live: LiveSource, options: &Discover) -> Result<Vec<ParticipantFacts>> {
    let mut observer = Observer::new(Settings::default());
    let end = Instant::now() + Duration::from_secs(options.listen);
    let is_meant = |participant: &ParticipantFacts| {
        options
            .domain
            .is_none_or(|it| it == participant.domain_id.0)
            && options
                .participant
                .is_none_or(|it| it == participant.guid.prefix)
    };
    loop {
        let left = end.saturating_duration_since(Instant::now());
        live.poll(left.min(SLICE), None, &mut observer)?;
        observer.input(Input::Time(live.clock()));
        live.apply(&observer.drain().interest);
        let mut heard = observer.snapshot(live.clock()).participants;
        heard.retain(is_meant);
        let is_found = options.participant.is_some() && !heard.is_empty();
        if left.is_zero() || is_found {
            return Ok(heard);
        }
    }
}

fn describe(participant: &ParticipantFacts) -> String {
    let mut words = format!(
        "{}  domain {}, {}",
        participant.guid.prefix, participant.domain_id, participant.vendor
    );
    let process = &participant.process;
    if let Some(name) = &process.name {
        words += &format!(", {name}");
    }
    if let Some(id) = process.id {
        words += &format!(", process {id}");
    }
    if let Some(host) = &process.host {
        words += &format!(" on {host}");
    }
    words
}

/// Asks one; whether it told everything.
fn ask(target: &Target, domain_id: u32, options: &Discover, out: &mut impl Write) -> Result<bool> {
    let (local_participant, socket) = local_participant(target, domain_id)?;
    let mut session = Session::new(local_participant, *target, !options.no_nodes);
    let will = if options.dry_run { "would" } else { "will" };
    writeln!(
        out,
        "\n{}: {will} send at most {MOST_PACKETS} packets, from {}, normally these:",
        target.prefix, local_participant.address
    )?;
    for packet in session.plan() {
        let (what, bytes) = (packet.what, packet.bytes.len());
        writeln!(out, "  {what}, at most {bytes} bytes, to {}", packet.to)?;
    }
    if options.dry_run {
        return Ok(true);
    }
    // What will be sent is said before it is sent.
    out.flush()?;
    let took = converse(&mut session, &socket).context("the goodbye may not have been sent")?;
    report(&session, took, out)
}

fn report(session: &Session, took: Duration, out: &mut impl Write) -> Result<bool> {
    let endpoints = session.endpoints();
    let with = |role| endpoints.values().filter(move |it| it.role == role);
    writeln!(
        out,
        "  learned {} writers and {} readers",
        with(Role::Writer).count(),
        with(Role::Reader).count()
    )?;
    for node in session.nodes().unwrap_or_default() {
        writeln!(out, "    node   {}", node.fully_qualified_name())?;
    }
    for (role, word) in [(Role::Writer, "writer"), (Role::Reader, "reader")] {
        for endpoint in with(role) {
            let topic = Naming::of(&endpoint.topic).name;
            let message_type = endpoint.type_name.message();
            writeln!(out, "    {word} {topic} {message_type}")?;
        }
    }
    let (sent, received) = session.cost();
    writeln!(
        out,
        "  sent {} packets, {} bytes; received {} packets, {} bytes; {:.1} ms",
        sent.packets,
        sent.bytes,
        received.packets,
        received.bytes,
        took.as_secs_f64() * 1e3
    )?;
    let has_nodes = !session.expects_nodes() || session.nodes().is_some();
    if !session.was_answered() {
        writeln!(out, "  it did not answer")?;
    } else if session.missing() > 0 {
        writeln!(out, "  {} announcements did not come", session.missing())?;
    } else if !has_nodes {
        writeln!(out, "  its list of nodes did not come")?;
    }
    Ok(session.was_answered() && session.missing() == 0 && has_nodes)
}
