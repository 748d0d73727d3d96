//! `rp discover --router` with a real router and real nodes of rmw_zenoh. It prints the same as
//! `ros2`, sends the packets of its dry run, and leaves no trace.
//!
//! Needs root and ROS 2: `make test-ros2`.

use std::collections::BTreeSet;
use std::fs;
use std::process::{Command, Output, Stdio};
use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::harness::network::Namespace;
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::harness::wait_until;

use crate::host::{Host, Middleware, RP};
use crate::installed;
use crate::installed::in_environment;

const PATIENCE: Duration = Duration::from_secs(30);
const PORT: &str = "7447";
/// Nodes of domain 0.
const NODES: &[&str] = &[
    "/add_two_ints_server",
    "/client",
    "/listener",
    "/robot1/server",
    "/talker",
];
/// Topics of each node. The node of the `ros2` command has these topics too, so their counts
/// differ.
const OF_ALL: [&str; 2] = ["/rosout", "/parameter_events"];

#[test]
#[ignore = "needs ROS 2 with rmw_zenoh_cpp: make test-ros2"]
fn a_router_lists_the_graph_that_ros2_prints_and_no_node_appears() -> Result<()> {
    let network = Namespace::isolated()?;
    let host = Host::new(&network, Middleware::Zenoh)?;
    let refused = rp(&host, &[])?;
    let output_text = String::from_utf8_lossy(&refused.stderr).into_owned();
    ensure!(refused.status.code() == Some(1), "{output_text}");
    ensure!(
        output_text.contains("no Zenoh router at localhost:7447"),
        "{output_text}"
    );

    let router = host.router("")?;
    let nodes = start(&host)?;
    wait_until("all nodes are known", || {
        Ok(ros2(&host, "node list")? == lines(NODES))
    })?;
    let planned = printed(&rp(&host, &["--dry-run"])?)?;
    let sniffer = Sniffer::start(&host)?;
    let answer = printed(&rp(&host, &[])?)?;
    let segments = sniffer.finish()?;
    ensure!(
        answer
            .replace("will open", "would open")
            .starts_with(&planned),
        "{planned}{answer}"
    );
    sends_only_this(&planned, &segments)?;

    let announced = Announced::of(&answer, "0")?;
    ensure!(announced.nodes == lines(NODES), "{announced:?}");
    agrees("topics", &counted(&announced.topics()), || {
        let topics = ros2(&host, "topic list -v --include-hidden-topics")?;
        let topics = topics.into_iter().filter(|it| it.starts_with(" * "));
        Ok(counted(&topics.collect()))
    })?;
    agrees("services", &announced.services(), || {
        let mut services = ros2(&host, "service list -t --include-hidden-services")?;
        services.retain(|it| !it.starts_with("/_ros2cli"));
        Ok(services)
    })?;
    ensure!(Announced::of(&answer, "7")?.nodes == lines(&["/robot2/listener"]));
    // The command prints only one domain.
    let other = printed(&rp(&host, &["--domain", "7"])?)?;
    ensure!(Announced::of(&other, "0").is_err() && Announced::of(&other, "7")?.nodes.len() == 1);
    // No node has appeared or vanished.
    agrees("nodes", &lines(NODES), || {
        let mut named = ros2(&host, "node list -a")?;
        named.retain(|it| !it.starts_with("/_ros2cli"));
        ensure!(named.is_subset(&lines(NODES)), "{named:?}");
        Ok(named)
    })?;
    drop((nodes, router));
    Ok(())
}

#[test]
#[ignore = "needs ROS 2 with rmw_zenoh_cpp: make test-ros2"]
fn routers_of_other_configurations_answer_or_are_refused_by_name() -> Result<()> {
    let network = Namespace::isolated()?;
    let host = Host::new(&network, Middleware::Zenoh)?;
    let users = host.path("users.txt");
    fs::write(&users, "user:password")?;
    let password = format!(
        "transport/auth/usrpwd/dictionary_file=\"{users}\";\
         transport/auth/usrpwd/user=\"user\";transport/auth/usrpwd/password=\"password\""
    );
    let refusal = "no user and password, and room for a session";
    // Batches of 100 bytes carry tokens in FRAGMENTs.
    for (settings, expected) in [
        ("transport/unicast/compression/enabled=true", Ok(107)),
        ("transport/unicast/qos/enabled=false", Ok(105)),
        (
            "transport/unicast/qos/enabled=false;transport/unicast/lowlatency=true",
            Ok(105),
        ),
        ("transport/link/tx/batch_size=100", Ok(107)),
        (&password, Err(refusal)),
        ("transport/unicast/max_sessions=0", Err(refusal)),
        (
            "listen/endpoints=[\"tcp/[::]:7448\"]",
            Err("no Zenoh router at"),
        ),
    ] {
        let router = host.router(settings)?;
        let output = rp(&host, &[])?;
        let errors = String::from_utf8_lossy(&output.stderr).into_owned();
        match expected {
            Ok(bytes) => {
                let answer = printed(&output).context(settings.to_owned())?;
                ensure!(answer.contains("knows no node"), "{settings}: {answer}");
                let talker = talker(&host)?;
                wait_until(settings, || {
                    Ok(printed(&rp(&host, &[])?)?.contains(&of_talker()))
                })?;
                drop(talker);
                let sent = format!("sent 4 batches, {bytes} bytes;");
                ensure!(answer.contains(&sent), "{settings}: {answer}");
            }
            Err(words) => {
                ensure!(output.status.code() == Some(1), "{settings}: {errors}");
                ensure!(errors.contains(words), "{settings}: {errors}");
            }
        }
        drop(router);
    }
    Ok(())
}

/// Returns the output for the router's knowledge of a talker.
fn of_talker() -> String {
    // Six services are for parameters. Since Jazzy, another one describes types.
    let services = match installed::distro() {
        "humble" | "iron" => 6,
        _ => 7,
    };
    format!(
        "domain 0: learned 1 node, 3 publishers, 1 subscription, {services} services and 0 clients"
    )
}

/// Returns the shell line that executes a demo.
fn program(name: &str) -> String {
    let prefix = installed::prefix();
    format!("exec {}/lib/demo_nodes_cpp/{name}", prefix.display())
}

fn talker(host: &Host<'_>) -> Result<Process> {
    host.run(&program("talker"), &[], Stdio::null())
}

fn start(host: &Host<'_>) -> Result<Vec<Process>> {
    let mut nodes = Vec::new();
    for name in ["talker", "listener", "add_two_ints_server"] {
        nodes.push(host.run(&program(name), &[], Stdio::inherit())?);
    }
    let other = format!(
        "export ROS_DOMAIN_ID=7; {} --ros-args -r __ns:=/robot2",
        program("listener")
    );
    nodes.push(host.run(&other, &[], Stdio::inherit())?);
    let mut graph = host.python("graph.py", &[])?;
    graph.wait_for("ready", PATIENCE)?;
    nodes.push(graph);
    Ok(nodes)
}

/// Runs `rp discover --router` on the host.
fn rp(host: &Host<'_>, more: &[&str]) -> Result<Output> {
    let enter = host.network.on_network();
    let (program, arguments) = enter.split_first().context("no prefix")?;
    let mut command = Command::new(program);
    command.args(arguments).args([RP, "discover", "--router"]);
    Ok(command.args(more).output()?)
}

fn printed(output: &Output) -> Result<String> {
    let errors = String::from_utf8_lossy(&output.stderr);
    ensure!(output.status.success(), "{errors}");
    Ok(String::from_utf8(output.stdout.clone())?)
}

/// Returns the lines that `ros2` prints with these words, by its own discovery.
fn ros2(host: &Host<'_>, words: &str) -> Result<BTreeSet<String>> {
    let enter = host.enter();
    let (program, arguments) = enter.split_first().context("no prefix")?;
    let line = in_environment(&format!("exec ros2 {words} --no-daemon"));
    let mut command = Command::new(program);
    let output = command
        .args(arguments)
        .args(["bash", "-c", &line])
        .output()?;
    let text = String::from_utf8(output.stdout)?;
    Ok(text.lines().map(str::to_owned).collect())
}

/// Waits until `ros2` prints these lines, since a command that does not wait for all nodes prints a
/// part.
fn agrees(
    what: &str,
    announced: &BTreeSet<String>,
    ros2: impl Fn() -> Result<BTreeSet<String>>,
) -> Result<()> {
    wait_until(what, || Ok(ros2()? == *announced)).with_context(|| format!("{announced:#?}"))
}

fn lines(of: &[&str]) -> BTreeSet<String> {
    of.iter().map(|it| (*it).to_owned()).collect()
}

/// Returns the lines of `ros2 topic list -v` without the counts of topics of all nodes.
fn counted(lines: &BTreeSet<String>) -> BTreeSet<String> {
    let without_count = |line: &String| {
        let name = line.trim_start_matches(" * ").split(' ').next();
        match line.rsplit_once("] ") {
            Some((topic, _)) if name.is_some_and(|it| OF_ALL.contains(&it)) => topic.to_owned(),
            _ => line.clone(),
        }
    };
    lines.iter().map(without_count).collect()
}

/// The output of `rp` about one domain.
#[derive(Debug)]
struct Announced {
    nodes: BTreeSet<String>,
    /// Kind, name and type of each endpoint.
    endpoints: Vec<[String; 3]>,
}

impl Announced {
    /// Reads the part of the output and compares its counts with its lines.
    fn of(answer: &str, domain: &str) -> Result<Self> {
        let head = format!("  domain {domain}: learned ");
        let mut lines = answer.lines().skip_while(|line| !line.starts_with(&head));
        let counts = lines.next().context("no such domain")?[head.len()..].to_owned();
        let mut announced = Self {
            nodes: BTreeSet::new(),
            endpoints: Vec::new(),
        };
        for line in lines.take_while(|line| line.starts_with("    ")) {
            match line.split_whitespace().collect::<Vec<_>>()[..] {
                ["node", name] => drop(announced.nodes.insert(name.to_owned())),
                [kind, name, ros_type] => {
                    announced
                        .endpoints
                        .push([kind, name, ros_type].map(str::to_owned));
                }
                _ => anyhow::bail!("{line}"),
            }
        }
        let count = |kind: &str| {
            announced
                .endpoints
                .iter()
                .filter(|it| it[0] == kind)
                .count()
        };
        let expected = [
            announced.nodes.len(),
            count("publisher"),
            count("subscription"),
            count("service"),
            count("client"),
        ];
        let printed: Vec<usize> = counts.split(' ').filter_map(|it| it.parse().ok()).collect();
        ensure!(printed == expected, "{counts}: {expected:?}");
        Ok(announced)
    }

    /// Returns the topics as `ros2 topic list -v` prints them.
    fn topics(&self) -> BTreeSet<String> {
        let mut lines = BTreeSet::new();
        for [kind, name, ros_type] in &self.endpoints {
            let (word, words) = match &**kind {
                "publisher" => ("publisher", "publishers"),
                "subscription" => ("subscriber", "subscribers"),
                _ => continue,
            };
            let same = |it: &&[String; 3]| &it[0] == kind && &it[1] == name;
            let count = self.endpoints.iter().filter(same).count();
            let word = if count == 1 { word } else { words };
            lines.insert(format!(" * {name} [{ros_type}] {count} {word}"));
        }
        lines
    }

    /// Returns the services as `ros2 service list -t` prints them: those with a server or client.
    fn services(&self) -> BTreeSet<String> {
        let services = self.endpoints.iter();
        let services = services.filter(|it| it[0] == "service" || it[0] == "client");
        services
            .map(|[_, name, ros_type]| format!("{name} [{ros_type}]"))
            .collect()
    }
}

/// A segment with payload, or the first segment of a connection.
#[derive(Debug)]
struct Segment {
    source: String,
    destination: String,
    is_first: bool,
    length: usize,
}

/// Checks that the client sends the planned messages and nothing else. While it sends, the router
/// sends nothing to others.
fn sends_only_this(planned: &str, segments: &[Segment]) -> Result<()> {
    let first = segments
        .iter()
        .position(|it| it.is_first)
        .context("no connection")?;
    let client = &segments[first].source;
    let connections = segments.iter().filter(|it| it.is_first).count();
    ensure!(connections == 1, "{segments:?}");
    let from = segments
        .iter()
        .filter(|it| it.source == *client && it.length > 0);
    let sent: Vec<usize> = from.map(|it| it.length).collect();
    let numbers = planned.lines().skip(1).map(|line| {
        let number = line.split(' ').find_map(|word| word.parse::<usize>().ok());
        number.context("no number of bytes")
    });
    let mut numbers = numbers.collect::<Result<Vec<_>>>()?;
    // The router's first answer has the cookie, of 49 bytes in Zenoh 1.8.
    *numbers.get_mut(1).context("no opening")? += 49;
    ensure!(sent == numbers, "{sent:?} of {planned}");
    let is_own = |it: &Segment| it.source == *client || it.destination == *client;
    let last = segments.iter().rposition(is_own).context("no end")?;
    let others: Vec<_> = segments[first..=last]
        .iter()
        .filter(|it| !is_own(it))
        .collect();
    ensure!(others.is_empty(), "{others:?}");
    Ok(())
}

/// A tcpdump of the router's connections.
struct Sniffer<'h> {
    process: Process,
    host: &'h Host<'h>,
}

impl<'h> Sniffer<'h> {
    fn start(host: &'h Host<'h>) -> Result<Self> {
        let (file, errors) = (host.path("router.pcap"), host.file("tcpdump.txt"));
        let words = [
            "-i", "lo", "-n", "-U", "-Z", "root", "-w", &file, "tcp", "port", PORT,
        ];
        let output_text = fs::File::create(&errors)?.into();
        let process = Process::start_with(&host.network.inside(), "tcpdump", words, output_text)?;
        wait_until("tcpdump listens", || {
            Ok(fs::read_to_string(&errors)?.contains("listening on"))
        })?;
        Ok(Self { process, host })
    }

    fn finish(mut self) -> Result<Vec<Segment>> {
        // tcpdump reads the kernel's buffer each second.
        std::thread::sleep(Duration::from_millis(1_500));
        self.process.signal("INT")?;
        self.process.wait(PATIENCE)?;
        let file = self.host.file("router.pcap");
        let output = Command::new("tcpdump")
            .args(["-n", "-r"])
            .arg(file)
            .output()?;
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        // TIME IP SOURCE > DESTINATION: Flags [P.], seq 1:28, …, length 27
        let segments = text.lines().filter_map(|line| {
            let (addresses, rest) = line.split_once(": Flags ")?;
            let (source, destination) = addresses.split_once(" > ")?;
            let length = rest.rsplit_once("length ")?.1.split([':', ' ']).next()?;
            Some(Segment {
                source: source.rsplit(' ').next()?.to_owned(),
                destination: destination.to_owned(),
                is_first: rest.starts_with("[S]"),
                length: length.parse().ok()?,
            })
        });
        Ok(segments.filter(|it| it.is_first || it.length > 0).collect())
    }
}
