//! `rp discover --router` on the terminal: prints the planned messages, sends them and reports the
//! graph that the router announces.

use std::io::{Write, stdout};
use std::path::Path;

use anyhow::{Result, bail};
use ros2probe::discover::zenoh::address::RouterAddress;
use ros2probe::discover::zenoh::graph::{DomainGraph, EndpointKind};
use ros2probe::discover::zenoh::session::Step;
use ros2probe::discover::zenoh::{Answer, connect, plan, run_conversation};
use ros2probe_daemon::agent::configuration;
use ros2probe_daemon::privilege::{Role, drop_capabilities};

use crate::cli::Discover;

/// Mount point of the control groups of version 2.
const CGROUP_ROOT: &str = "/sys/fs/cgroup";
/// Kinds of endpoints in the order of the report: one, several.
const ENDPOINT_KINDS: [(EndpointKind, &str, &str); 4] = [
    (EndpointKind::Publisher, "publisher", "publishers"),
    (EndpointKind::Subscription, "subscription", "subscriptions"),
    (EndpointKind::Server, "service", "services"),
    (EndpointKind::Client, "client", "clients"),
];

/// Requests the graph from the router at this address.
pub(super) fn discover(address: &RouterAddress, options: &Discover) -> Result<()> {
    let unseen = unobserved_reason();
    // A connection needs no capability.
    drop_capabilities(Role::Export)?;
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
    if let Some(note) = unseen {
        writeln!(out, "{note}")?;
    }
    if options.dry_run {
        return Ok(());
    }
    // The plan is printed before anything is sent.
    out.flush()?;
    let (stream, peer) = connect(address)?;
    let answer = run_conversation(stream, peer, options.domain)?;
    report(&answer, &mut out)
}

/// Returns why an agent with the configuration of this host does not see the answer. `None` if it
/// does, or if the configuration cannot be read.
fn unobserved_reason() -> Option<String> {
    let (config, _) = configuration(None).ok()?;
    let own = std::fs::read_to_string("/proc/self/cgroup").ok()?;
    outside_cgroup_note(config.capture.cgroup.as_deref()?, &own)
}

/// Returns the note if `own`, the text of `/proc/self/cgroup`, names no group within `observed`.
fn outside_cgroup_note(observed: &Path, own: &str) -> Option<String> {
    let own = own.lines().find_map(|line| line.strip_prefix("0::/"))?;
    let root = Path::new(CGROUP_ROOT);
    if root.join(own).starts_with(observed) {
        return None;
    }
    let name = observed.file_name().unwrap_or_default().to_string_lossy();
    let remedy = match name.ends_with(".slice") {
        true => format!("`sudo systemd-run --slice={name} --pipe --wait rp discover --router`"),
        false => "start this command in that control group".to_owned(),
    };
    Some(format!(
        "the agent observes only {} (capture.cgroup), and this command runs in /{own}: the agent \
         may keep nothing of the answer; {remedy}",
        observed.display()
    ))
}

fn report(answer: &Answer, out: &mut impl Write) -> Result<()> {
    let session = &answer.session;
    if let Some(router) = session.router() {
        writeln!(out, "  router {router}")?;
    }
    let graphs = session.graphs();
    for (domain, graph) in &graphs {
        writeln!(out, "  domain {}: learned {}", domain.0, counts_text(graph))?;
        for node in &graph.nodes {
            writeln!(out, "    node   {node}")?;
        }
        for (kind, one, _) in ENDPOINT_KINDS {
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
            "  {} tokens have an unknown format",
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

fn counts_text(graph: &DomainGraph) -> String {
    let nodes = number(graph.nodes.len(), "node", "nodes");
    let endpoints =
        ENDPOINT_KINDS.map(|(kind, one, several)| number(graph.count(kind), one, several));
    let (others, last) = endpoints.split_at(endpoints.len() - 1);
    format!("{nodes}, {} and {}", others.join(", "), last.concat())
}

fn number(count: usize, one: &str, several: &str) -> String {
    match count {
        1 => format!("1 {one}"),
        _ => format!("{count} {several}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_answer_outside_the_observed_control_group_is_reported_with_the_remedy() {
        let observed = Path::new("/sys/fs/cgroup/robot.slice");
        for inside in [
            "0::/robot.slice\n",
            "1:name=x:/\n0::/robot.slice/nav.service\n",
        ] {
            assert_eq!(outside_cgroup_note(observed, inside), None, "{inside}");
        }
        let note =
            outside_cgroup_note(observed, "0::/user.slice/user-0.slice/session-1.scope\n").unwrap();
        assert!(
            note.contains("/sys/fs/cgroup/robot.slice (capture.cgroup)"),
            "{note}"
        );
        assert!(
            note.contains("runs in /user.slice/user-0.slice/session-1.scope:"),
            "{note}"
        );
        let remedy = "`sudo systemd-run --slice=robot.slice --pipe --wait rp discover --router`";
        assert!(note.ends_with(remedy), "{note}");
        // A group whose name has the same prefix is another group.
        assert!(outside_cgroup_note(observed, "0::/robot.slice2\n").is_some());
        let container = Path::new("/sys/fs/cgroup/docker/0123");
        let note = outside_cgroup_note(container, "0::/\n").unwrap();
        assert!(
            note.ends_with("start this command in that control group"),
            "{note}"
        );
    }
}
