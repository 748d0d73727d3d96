//! `rp discover` on the terminal: lists participants, prints the planned packets, sends them and
//! reports the answers.

mod router;

use std::io::{Write, stdout};
use std::time::Duration;

use anyhow::{Context as _, Result, bail};
use ros2probe::discover::announcements::Announcements;
use ros2probe::discover::participants::{FoundParticipant, Listening, listen};
use ros2probe::discover::session::{MAX_PACKETS, Session, Target};
use ros2probe::discover::{local_participant, run_session};
use ros2probe_daemon::agent::configuration;

use crate::cli::Discover;

/// Runs `rp discover`.
pub(crate) fn discover(options: &Discover) -> Result<()> {
    if let Some(address) = &options.router {
        return router::discover(address, options);
    }
    let mut out = stdout().lock();
    let (config, _) = configuration(options.config.as_deref())?;
    let listening = Listening {
        interface: options.interface.clone(),
        domain_id: options.domain,
        participant: options.participant,
        time: Duration::from_secs(options.listen),
    };
    let participants = listen(config.capture, &listening)?;
    let seconds = options.listen;
    let found = match participants.len() {
        1 => "1 participant".to_owned(),
        count => format!("{count} participants"),
    };
    writeln!(out, "{found} heard within {seconds} s; nothing was sent")?;
    let mut targets = Vec::new();
    for participant in &participants {
        let described = describe(participant);
        match participant.target {
            Ok(target) => {
                writeln!(out, "{described}, at {}", target.metatraffic)?;
                targets.push((target, participant.domain_id));
            }
            Err(refusal) => writeln!(out, "{described}: {}", refusal.reason())?,
        }
    }
    if options.participant.is_some() && targets.is_empty() {
        bail!("the participant was not heard, or cannot receive requests");
    }
    if !options.all && options.participant.is_none() {
        writeln!(out, "to send requests, pass --participant PREFIX or --all")?;
        return Ok(());
    }
    let mut failed = 0;
    for (target, domain_id) in &targets {
        let answered = request_announcements(target, *domain_id, options, &mut out)?;
        failed += usize::from(!answered);
    }
    if failed > 0 {
        bail!(
            "{failed} of {} participants gave no or incomplete answers",
            targets.len()
        );
    }
    Ok(())
}

fn describe(participant: &FoundParticipant) -> String {
    let mut words = format!(
        "{}  domain {}, {}",
        participant.prefix, participant.domain_id, participant.vendor
    );
    if let Some(name) = &participant.process {
        words += &format!(", {name}");
    }
    if let Some(id) = participant.process_id {
        words += &format!(", process {id}");
    }
    if let Some(host) = &participant.host {
        words += &format!(" on {host}");
    }
    words
}

/// Sends requests to one participant. Returns whether every request was answered.
fn request_announcements(
    target: &Target,
    domain_id: u32,
    options: &Discover,
    out: &mut impl Write,
) -> Result<bool> {
    let (local_participant, socket) = local_participant(target, domain_id)?;
    let mut session = Session::new(local_participant, *target, !options.no_nodes);
    let will = if options.dry_run { "would" } else { "will" };
    writeln!(
        out,
        "\n{}: {will} send at most {MAX_PACKETS} packets, from {}, normally these:",
        target.prefix, local_participant.address
    )?;
    for packet in session.plan() {
        let (what, bytes) = (packet.what, packet.bytes.len());
        writeln!(out, "  {what}, at most {bytes} bytes, to {}", packet.to)?;
    }
    if options.dry_run {
        return Ok(true);
    }
    // The plan is printed before anything is sent.
    out.flush()?;
    let took = run_session(&mut session, &socket)
        .context("the conversation failed, perhaps before the goodbye")?;
    report(&session, took, out)
}

fn report(session: &Session, took: Duration, out: &mut impl Write) -> Result<bool> {
    let Announcements {
        writers,
        readers,
        nodes,
    } = Announcements::of(session);
    writeln!(
        out,
        "  learned {} writers and {} readers",
        writers.len(),
        readers.len()
    )?;
    for node in nodes.iter().flatten() {
        writeln!(out, "    node   {node}")?;
    }
    for (endpoints, word) in [(writers, "writer"), (readers, "reader")] {
        for endpoint in endpoints {
            writeln!(
                out,
                "    {word} {} {}",
                endpoint.topic, endpoint.message_type
            )?;
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
    let has_nodes = !session.expects_nodes() || nodes.is_some();
    if !session.was_answered() {
        writeln!(out, "  no answer")?;
    } else if session.missing() > 0 {
        writeln!(out, "  {} announcements did not arrive", session.missing())?;
    } else if !has_nodes {
        writeln!(out, "  the list of nodes did not arrive")?;
    }
    Ok(session.was_answered() && session.missing() == 0 && has_nodes)
}
