//! `rp discover --router` on the terminal: prints the planned messages, sends them and reports the
//! graph that the router announces.

use std::io::{Write, stdout};

use anyhow::{Result, bail};
use ros2probe_daemon::discover::zenoh::address::RouterAddress;
use ros2probe_daemon::discover::zenoh::graph::{DomainGraph, EndpointKind};
use ros2probe_daemon::discover::zenoh::session::Step;
use ros2probe_daemon::discover::zenoh::{Answer, connect, converse, plan};
use ros2probe_daemon::privilege::{Role, give_up};

use crate::cli::Discover;

/// Kinds of endpoints in the order of the report: one, several.
const KINDS: [(EndpointKind, &str, &str); 4] = [
    (EndpointKind::Publisher, "publisher", "publishers"),
    (EndpointKind::Subscription, "subscription", "subscriptions"),
    (EndpointKind::Server, "service", "services"),
    (EndpointKind::Client, "client", "clients"),
];

/// Requests the graph from the router at this address.
pub(super) fn discover(address: &RouterAddress, options: &Discover) -> Result<()> {
    // A connection needs no capability.
    give_up(Role::Export)?;
    let mut out = stdout().lock();
    let will = if options.dry_run { "would" } else { "will" };
    writeln!(
        out,
        "Zenoh router {address}: {will} open one TCP connection and send these messages:"
    )?;
    for message in plan(options.domain) {
        let (what, bytes, note) = (message.what, message.bytes, message.note);
        writeln!(out, "  {what}, {bytes} bytes{note}")?;
    }
    if options.dry_run {
        return Ok(());
    }
    // The plan is printed before anything is sent.
    out.flush()?;
    let (stream, peer) = connect(address)?;
    let answer = converse(stream, peer, options.domain)?;
    report(&answer, &mut out)
}

fn report(answer: &Answer, out: &mut impl Write) -> Result<()> {
    let session = &answer.session;
    if let Some(router) = session.router() {
        writeln!(out, "  router {router}")?;
    }
    let graphs = session.graphs();
    for (domain, graph) in &graphs {
        writeln!(out, "  domain {}: learned {}", domain.0, counts(graph))?;
        for node in &graph.nodes {
            writeln!(out, "    node   {node}")?;
        }
        for (kind, one, _) in KINDS {
            for (name, ros_type) in graph.endpoints.get(&kind).into_iter().flatten() {
                writeln!(out, "    {one} {name} {ros_type}")?;
            }
        }
    }
    if graphs.is_empty() {
        writeln!(out, "  the router knows no node")?;
    }
    if session.unreadable() > 0 {
        writeln!(
            out,
            "  {} tokens have an unknown form",
            session.unreadable()
        )?;
    }
    writeln!(
        out,
        "  sent {} batches, {} bytes; received {} batches, {} bytes; {:.1} ms",
        answer.sent.batches,
        answer.sent.bytes,
        answer.received.batches,
        answer.received.bytes,
        answer.took.as_secs_f64() * 1e3
    )?;
    if session.step() == Step::Full {
        bail!(
            "the router announces more than rp takes: pass --domain N for the tokens of one domain"
        );
    }
    Ok(())
}

fn counts(graph: &DomainGraph) -> String {
    let nodes = number(graph.nodes.len(), "node", "nodes");
    let endpoints = KINDS.map(|(kind, one, several)| number(graph.count(kind), one, several));
    let (others, last) = endpoints.split_at(endpoints.len() - 1);
    format!("{nodes}, {} and {}", others.join(", "), last.concat())
}

fn number(count: usize, one: &str, several: &str) -> String {
    match count {
        1 => format!("1 {one}"),
        _ => format!("{count} {several}"),
    }
}
