//! Every kind of link of a robot. The agent counts each sample once, whatever carries it, and no
//! sample that the configuration excludes.

use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::Result;
use ros2probe_testing::forged::frames::{Shuffle, Tun, Wire};
use ros2probe_testing::forged::{Carrier, Sender, Talker, introduce, send_sizes};
use ros2probe_testing::harness::agent::{Agent, Scrape};
use ros2probe_testing::harness::network::{Link, Namespace};
use ros2probe_testing::harness::peer::{Peer, Role, Stack, Stream};
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::harness::usage::Usage;
use ros2probe_testing::harness::{run, wait_until};
use tempfile::TempDir;

const WATCH_ALL: &str = "watch: [/**]\ncapture:\n  source: wire\n  inside: off\n";
/// Sizes of samples: whole frames, frames near the MTU, few and many IP fragments.
const SIZES: [usize; 6] = [320, 1300, 1440, 4000, 20_000, 60_000];
const ROUNDS: usize = 20;

// Coverage: UDP, IPv6 | Fast DDS 2.9 | - | exact
#[test]
fn samples_over_ipv6_count_once_in_fragments_for_an_mtu_of_1500_and_1280() -> Result<()> {
    for mtu in [1500, 1280] {
        let link = Link::new()?;
        for (host, address) in [(&link.robot, "fd99::1/64"), (&link.monitor, "fd99::2/64")] {
            ip(host, &format!("addr add {address} dev eth0 nodad"))?;
            ip(host, &format!("link set eth0 mtu {mtu}"))?;
        }
        let observed = Observed::start(&link.monitor, WATCH_ALL)?;
        let mut sender = Sender::new(&link.robot, "[fd99::1]:0", "[fd99::2]:7400")?;
        observed.counts_each_sample_once("/ula", &mut sender)?;

        let robot = link_local(&link.robot)?;
        let to = format!("[{}%{}]:7400", link_local(&link.monitor)?.0, robot.1);
        let mut sender = Sender::new(&link.robot, &format!("[{}%{}]:0", robot.0, robot.1), &to)?;
        observed.counts_each_sample_once("/link_local", &mut sender)?;
    }
    Ok(())
}

// Coverage: UDP, IPv6 | Cyclone DDS 0.10 | - | exact
#[test]
fn cyclone_dds_over_ipv6_is_counted_as_over_ipv4() -> Result<()> {
    let link = Link::new()?;
    for (host, address) in [(&link.robot, "fd99::1/64"), (&link.monitor, "fd99::2/64")] {
        ip(host, &format!("addr add {address} dev eth0 nodad"))?;
    }
    let observed = Observed::start(&link.monitor, WATCH_ALL)?;
    let ipv6 = "CYCLONEDDS_URI=<General><Transport>udp6</Transport></General>";
    let stream = Stream {
        rate: 50.0,
        // Both nodes stay until they have been seen.
        linger: 120.0,
        ..Stream::point_cloud(16_000, 100)
    };
    let on_ipv6 =
        |host: &Namespace| [host.inside(), vec!["env".to_owned(), ipv6.to_owned()]].concat();
    let start = |host: &Namespace, role, node| {
        Peer::launch_behind(&on_ipv6(host), Stack::Cyclone, role, &stream, &[node])
    };
    let mut subscriber = start(&link.monitor, Role::Subscriber, "/listener")?;
    let mut publisher = start(&link.robot, Role::Publisher, "/lidar_driver")?;
    publisher.wait_matched()?;
    subscriber.wait_matched()?;
    publisher.start_sending()?;
    publisher.wait_sent(Duration::from_secs(60))?;
    observed.agent.scrape_until("both nodes", |page| {
        let nodes = page.labels_of("ros2_node_info", "ros_node");
        nodes.contains("/listener") && nodes.contains("/lidar_driver")
    })?;
    let scrape = observed.agent.settled_scrape("/points", stream.count)?;
    assert_exact(&scrape, "/points", stream.count, stream.count * 16_000);
    Ok(())
}

#[test]
fn samples_behind_one_and_two_vlan_tags_count_once() -> Result<()> {
    let link = Link::new()?;
    let observed = Observed::start(&link.monitor, WATCH_ALL)?;
    let tags = [[0x88, 0xa8, 0, 7], [0x81, 0, 0, 100]];
    for (topic, tags) in [("/twice", &tags[..]), ("/once", &tags[1..])] {
        let mut wire = Wire::new(&link.robot, &link.monitor, "eth0")?;
        wire.tags = tags.to_vec();
        observed.counts_each_sample_once(topic, &mut wire)?;
    }
    Ok(())
}

#[test]
fn a_sample_that_passes_two_interfaces_of_one_host_counts_once() -> Result<()> {
    let link = Link::new()?;
    for (host, address) in [(&link.robot, "10.100.0.1"), (&link.monitor, "10.100.0.2")] {
        ip(
            host,
            "link add link eth0 name macvlan0 type macvlan mode bridge",
        )?;
        ip(host, &format!("addr add {address}/24 dev macvlan0"))?;
        ip(host, "link set macvlan0 up")?;
        wait_carrying_at(host, "macvlan0")?;
    }
    for host in [&link.monitor, &link.robot] {
        let observed = Observed::start(host, WATCH_ALL)?;
        let mut sender = Sender::new(&link.robot, "10.100.0.1:0", "10.100.0.2:7400")?;
        observed.counts_each_sample_once("/stacked", &mut sender)?;
    }
    Ok(())
}

#[test]
fn loopback_traffic_counts_once() -> Result<()> {
    let host = Namespace::isolated()?;
    let observed = Observed::start(&host, WATCH_ALL)?;
    let mut sender = Sender::new(&host, "127.0.0.1:0", "127.0.0.1:7400")?;
    observed.counts_each_sample_once("/v4", &mut sender)?;
    let mut sender = Sender::new(&host, "[::1]:0", "[::1]:7400")?;
    observed.counts_each_sample_once("/v6", &mut sender)
}

#[test]
fn a_tunnel_without_a_link_layer_is_seen() -> Result<()> {
    let host = Namespace::isolated()?;
    let observed = Observed::start(&host, WATCH_ALL)?;
    let mut tun = Tun::new(&host, "tun0", [10, 88, 0, 2], [10, 88, 0, 1])?;
    ip(&host, "addr add 10.88.0.1/24 dev tun0")?;
    ip(&host, "link set tun0 up")?;
    observed.counts_each_sample_once("/tunnelled", &mut tun)?;
    // The host also sends into the tunnel.
    let mut sender = Sender::new(&host, "10.88.0.1:0", "10.88.0.2:7400")?;
    observed.counts_each_sample_once("/into_the_tunnel", &mut sender)
}

#[test]
fn a_new_interface_is_seen_and_one_set_down_causes_no_busy_loop() -> Result<()> {
    let link = Link::new()?;
    let observed = Observed::start(&link.monitor, WATCH_ALL)?;
    add_cable(&link, "eth1", "10.102.0")?;
    let mut sender = Sender::new(&link.robot, "10.102.0.1:0", "10.102.0.2:7400")?;
    observed.counts_each_sample_once("/plugged_in", &mut sender)?;

    ip(&link.monitor, "link set eth1 down")?;
    let pid = observed.agent.process.pid();
    let (before, began) = (Usage::of(pid)?, Instant::now());
    std::thread::sleep(Duration::from_secs(3));
    let spent = Usage::of(pid)?.since(&before).cpu;
    let elapsed = began.elapsed();
    assert!(
        spent < elapsed / 10,
        "{spent:?} in {elapsed:?} with a link down"
    );

    ip(&link.monitor, "link set eth1 up")?;
    wait_carrying(&link, "eth1")?;
    observed.counts_each_sample_once("/up_again", &mut sender)?;
    ip(&link.monitor, "link del eth1")?;
    add_cable(&link, "eth2", "10.103.0")?;
    let mut sender = Sender::new(&link.robot, "10.103.0.1:0", "10.103.0.2:7400")?;
    observed.counts_each_sample_once("/replaced", &mut sender)
}

#[test]
fn an_excluded_interface_is_not_seen_even_if_it_appears_later() -> Result<()> {
    let link = Link::new()?;
    add_cable(&link, "wlan0", "10.104.0")?;
    let all_but_wlan =
        "watch: [/**]\ncapture:\n  source: wire\n  interfaces:\n    exclude: [wlan*]\n";
    let only_eth = "watch: [/**]\ncapture:\n  source: wire\n  interfaces:\n    include: [eth*]\n";
    for (round, configuration) in (0..).zip([all_but_wlan, only_eth]) {
        let observed = Observed::start(&link.monitor, configuration)?;
        let (wlan, eth) = (format!("wlan{}", 1 + round), format!("eth{}", 1 + round));
        add_cable(&link, &wlan, &format!("10.{}.0", 110 + round))?;
        add_cable(&link, &eth, &format!("10.{}.0", 120 + round))?;
        for third in [104, 110 + round] {
            let (from, to) = (format!("10.{third}.0.1:0"), format!("10.{third}.0.2:7400"));
            let mut sender = Sender::new(&link.robot, &from, &to)?;
            let mut talker = Talker::new(third, "/private");
            introduce(&talker, &mut sender)?;
            send_sizes(&mut talker, &mut sender, [320; 20])?;
        }
        let (from, to) = (
            format!("10.{}.0.1:0", 120 + round),
            format!("10.{}.0.2:7400", 120 + round),
        );
        let mut sender = Sender::new(&link.robot, &from, &to)?;
        observed.counts_each_sample_once("/public", &mut sender)?;
        let scrape = observed.agent.settled_scrape("/public", 0)?;
        assert!(!scrape.0.contains("/private"), "{}", scrape.0);
        // On a busy machine, the lease of the counted participant may have ended.
        assert!(scrape.sum("ros2_participants", &[]) <= 1.0);
        assert_eq!(scrape.sum("ros2_unknown_writers", &[]), 0.0);
        // At tcx no program is attached to an excluded interface.
        let event = [("event", "interface_excluded")];
        let excluded = scrape.sum("ros2probe_filter_events_total", &event);
        let hooks = scrape.labels_of("ros2probe_capture_wire_info", "hook");
        assert!(hooks.contains("tcx") || excluded >= 40.0, "{excluded}");
        let interfaces = scrape.labels_of("ros2probe_capture_packets_total", "interface");
        assert!(
            interfaces.iter().all(|name| !name.starts_with("wlan")),
            "{interfaces:?}"
        );
    }
    Ok(())
}

#[test]
fn a_renamed_interface_is_selected_by_its_new_name() -> Result<()> {
    let link = Link::new()?;
    let observed = Observed::start(
        &link.monitor,
        "watch: [/**]\ncapture:\n  source: wire\n  interfaces:\n    include: [eth*]\n",
    )?;
    // The interface is renamed as udev does it.
    add_cable(&link, "wlan0", "10.106.0")?;
    let rename = |from: &str, to: &str| -> Result<()> {
        ip(&link.monitor, &format!("link set {from} down"))?;
        ip(&link.monitor, &format!("link set {from} name {to}"))?;
        ip(&link.monitor, &format!("link set {to} up"))?;
        wait_carrying_at(&link.monitor, to)?;
        wait_carrying_at(&link.robot, "wlan0")
    };
    let mut sender = Sender::new(&link.robot, "10.106.0.1:0", "10.106.0.2:7400")?;
    rename("wlan0", "eth7")?;
    observed.counts_each_sample_once("/wanted", &mut sender)?;
    rename("eth7", "wlan7")?;
    // The agent follows changes of interfaces in their order, so it knows the new name afterwards.
    add_cable(&link, "eth8", "10.108.0")?;
    let mut later = Sender::new(&link.robot, "10.108.0.1:0", "10.108.0.2:7400")?;
    observed.counts_each_sample_once("/later", &mut later)?;
    let mut talker = Talker::new(1, "/unwanted");
    introduce(&talker, &mut sender)?;
    send_sizes(&mut talker, &mut sender, [320; 20])?;
    let scrape = observed.agent.settled_scrape("/wanted", 0)?;
    assert!(!scrape.0.contains("/unwanted"), "{}", scrape.0);
    assert_eq!(scrape.sum("ros2_unknown_writers", &[]), 0.0);
    Ok(())
}

#[test]
fn removed_interfaces_do_not_use_up_the_table_of_the_filter() -> Result<()> {
    let link = Link::new()?;
    let observed = Observed::start(
        &link.monitor,
        "watch: [/**]\ncapture:\n  source: wire\n  interfaces:\n    exclude: [veth*]\n",
    )?;
    // The table holds 1024 interfaces.
    for _ in 0..3 {
        let pair =
            |number| format!("link add veth{number} group 7 type veth peer name vethx{number}");
        batch(&link.monitor, (0..200).map(pair))?;
        ip(&link.monitor, "link delete group 7")?;
    }
    add_cable(&link, "eth1", "10.105.0")?;
    let mut sender = Sender::new(&link.robot, "10.105.0.1:0", "10.105.0.2:7400")?;
    observed.counts_each_sample_once("/after_the_churn", &mut sender)
}

#[test]
fn a_container_is_observed_by_the_path_of_its_network_namespace() -> Result<()> {
    let link = Link::new()?;
    let path = link.robot.network();
    let observed = Observed::start(
        &link.monitor,
        &format!(
            "watch: [/**]\ncapture:\n  source: wire\n  network_namespaces: [{}]\n",
            path.display()
        ),
    )?;
    // These samples stay in the container's network, which is invisible from outside.
    let mut sender = Sender::new(&link.robot, "127.0.0.1:0", "127.0.0.1:7400")?;
    observed.counts_each_sample_once("/inside", &mut sender)?;
    // These samples leave the container and are seen in both networks.
    let mut sender = Sender::between(&link.robot, &link.monitor)?;
    observed.counts_each_sample_once("/across", &mut sender)?;
    let scrape = observed.agent.scrape()?;
    let interfaces = scrape.labels_of("ros2probe_capture_packets_total", "interface");
    let inside = format!("{}:lo", path.display());
    assert!(interfaces.contains(&inside), "{interfaces:?}");
    Ok(())
}

#[test]
fn a_network_namespace_is_reported_while_its_path_is_missing() -> Result<()> {
    let link = Link::new()?;
    let path = link.robot.network();
    let place = path.display();
    let capture =
        format!("watch: [/**]\ncapture: {{source: wire, network_namespaces: [{place}]}}\n");
    let observed = Observed::start(&link.monitor, &capture)?;
    let is_ready = || observed.agent.request("/readyz").is_ok();
    // A process keeps the namespace while its name is gone.
    let words = ["-c", "echo inside && exec sleep 1000"];
    let mut keeper = Process::start(&link.robot.on_network(), "sh", words)?;
    keeper.wait_for("inside", Duration::from_secs(60))?;
    let reported = |name: &str, times: u32| {
        wait_until(name, || {
            let page = observed.agent.scrape()?;
            let reported = page.sum("ros2probe_events_total", &[("name", name)]);
            Ok(reported == f64::from(times))
        })
    };
    for round in 1..=2 {
        run(&format!("umount {place}"))?;
        wait_until("missed", || Ok(!is_ready()))?;
        let page = observed.agent.scrape()?;
        assert_eq!(page.value("ros2probe_ready", &[]), Some(0.0));
        // The agent checks for events once a second, so it does not report a shorter interruption.
        reported("ros2probe.capture.blind", round)?;
        run(&format!(
            "mount --bind /proc/{}/ns/net {place}",
            keeper.pid()
        ))?;
        wait_until("seen again", || Ok(is_ready()))?;
        reported("ros2probe.capture.blind", round)?;
        reported("ros2probe.capture.seeing", round)?;
    }
    let mut sender = Sender::new(&link.robot, "127.0.0.1:0", "127.0.0.1:7400")?;
    observed.counts_each_sample_once("/inside", &mut sender)
}

#[test]
fn the_namespace_of_a_process_is_reported_as_missing_only_after_its_end() -> Result<()> {
    let link = Link::new()?;
    let words = ["-c", "echo inside && exec sleep 1000"];
    let mut keeper = Process::start(&link.robot.on_network(), "sh", words)?;
    keeper.wait_for("inside", Duration::from_secs(60))?;
    let capture = format!(
        "watch: [/**]\ncapture: {{source: wire, network_namespaces: [/proc/{}/ns/net]}}\n",
        keeper.pid()
    );
    // The agent has dropped the right to read this path.
    let observed = Observed::start(&link.monitor, &capture)?;
    for _ in 0..30 {
        // A busy machine may be another reason to be unready.
        let reason = observed.agent.request("/readyz").err();
        let reason = reason.map_or_else(String::new, |error| format!("{error:#}"));
        assert!(!reason.contains("namespace"), "{reason}");
        std::thread::sleep(Duration::from_millis(100));
    }
    let mut sender = Sender::new(&link.robot, "127.0.0.1:0", "127.0.0.1:7400")?;
    observed.counts_each_sample_once("/inside", &mut sender)?;
    keeper.terminate()?;
    wait_until("missed", || Ok(observed.agent.request("/readyz").is_err()))
}

#[test]
fn an_interface_that_never_existed_is_reported_until_it_appears() -> Result<()> {
    let link = Link::new()?;
    // One namespace with the interface suffices.
    ip(&link.robot, "link add only0 type veth peer name far0")?;
    let directory = tempfile::tempdir()?;
    let file = directory.path().join("ros2probe.yaml");
    let configuration = format!(
        "watch: [/**]\ncapture:\n  source: wire\n  network_namespaces: [{}]\n  interfaces: \
         {{include: [eth0, only0, eth9, wlan*]}}\n",
        link.robot.network().display()
    );
    std::fs::write(&file, configuration)?;
    let arguments = ["run".as_ref(), "--config".as_ref(), file.as_os_str()];
    let program = env!("CARGO_BIN_EXE_rp");
    let mut agent = Agent {
        process: Process::start(&link.monitor.on_network(), program, arguments)?,
        host: &link.monitor,
    };
    let wait_for = |agent: &Agent<'_>, reason: &str| {
        wait_until(reason, || {
            let answer = agent.request("/readyz");
            Ok(answer.is_err_and(|error| format!("{error:#}").contains(reason)))
        })
    };
    wait_for(&agent, "the interface eth9 does not exist")?;
    add_cable(&link, "eth9", "10.107.0")?;
    agent.wait_ready(Duration::from_secs(60))?;
    ip(&link.monitor, "link del eth9")?;
    wait_for(&agent, "the interface eth9 is gone")
}

#[test]
fn fragments_in_any_order_make_one_sample() -> Result<()> {
    let link = Link::new()?;
    let observed = Observed::start(&link.monitor, WATCH_ALL)?;
    let orders: [(&str, Shuffle); 4] = [
        ("/backwards", |packets| packets.reverse()),
        ("/first_last", |packets| packets.rotate_left(1)),
        ("/last_first", |packets| packets.rotate_right(1)),
        ("/each_twice", |packets| {
            *packets = packets
                .iter()
                .flat_map(|packet| [packet.clone(), packet.clone()])
                .collect();
        }),
    ];
    for (topic, shuffle) in orders {
        let mut wire = Wire::new(&link.robot, &link.monitor, "eth0")?;
        wire.shuffle = shuffle;
        observed.counts_each_sample_once(topic, &mut wire)?;
    }
    Ok(())
}

#[test]
fn a_sample_with_a_missing_fragment_never_counts() -> Result<()> {
    let link = Link::new()?;
    let observed = Observed::start(&link.monitor, WATCH_ALL)?;
    let mut wire = Wire::new(&link.robot, &link.monitor, "eth0")?;
    let mut talker = Talker::new(1, "/torn");
    introduce(&talker, &mut wire)?;
    let whole = |_: &mut Vec<Vec<u8>>| {};
    for round in 0..30 {
        wire.shuffle = match round % 3 {
            0 => whole,
            1 => |packets| drop(packets.pop()),
            _ => |packets| drop(packets.remove(packets.len() / 2)),
        };
        send_sizes(&mut talker, &mut wire, [6000])?;
    }
    wire.shuffle = whole;
    send_sizes(&mut talker, &mut wire, [6000])?;
    let scrape = observed.agent.settled_scrape("/torn", 11)?;
    assert!(scrape.sum("ros2probe_records_dropped_total", &[]) == 0.0);
    let value = |name| value(&scrape, name, "/torn");
    assert_eq!(value("ros2_topic_messages_total"), 11);
    assert_eq!(value("ros2_topic_lost_messages_total"), 20);
    Ok(())
}

#[test]
fn a_bridge_and_its_port_show_a_sample_once() -> Result<()> {
    let link = Link::new()?;
    // The monitor's end of the cable becomes a port of its bridge, like that of a container.
    ip(&link.monitor, "link add br0 type bridge")?;
    let address = link.monitor.address();
    ip(&link.monitor, &format!("addr del {address}/24 dev eth0"))?;
    ip(&link.monitor, "link set eth0 master br0")?;
    ip(&link.monitor, &format!("addr add {address}/24 dev br0"))?;
    ip(&link.monitor, "link set br0 up")?;
    wait_carrying_at(&link.monitor, "br0")?;
    let observed = Observed::start(&link.monitor, WATCH_ALL)?;
    let mut sender = Sender::between(&link.robot, &link.monitor)?;
    observed.counts_each_sample_once("/bridged", &mut sender)?;
    let scrape = observed.agent.scrape()?;
    assert!(value(&scrape, "ros2_topic_duplicate_messages_total", "/bridged") > 0);
    // The monitor also sends through the bridge and its port.
    let mut sender = Sender::between(&link.monitor, &link.robot)?;
    observed.counts_each_sample_once("/bridged_out", &mut sender)
}

/// A host with the agent on it.
struct Observed<'a> {
    agent: Agent<'a>,
    _directory: TempDir,
}

impl<'a> Observed<'a> {
    fn start(host: &'a Namespace, configuration: &str) -> Result<Observed<'a>> {
        let directory = tempfile::tempdir()?;
        let file = directory.path().join("ros2probe.yaml");
        std::fs::write(&file, configuration)?;
        let agent = Agent::start(host, Path::new(env!("CARGO_BIN_EXE_rp")), &file)?;
        Ok(Observed {
            agent,
            _directory: directory,
        })
    }

    fn counts_each_sample_once(&self, topic: &str, carrier: &mut impl Carrier) -> Result<()> {
        let number = topic
            .bytes()
            .fold(0_u32, |sum, byte| sum.wrapping_mul(31) + u32::from(byte));
        let mut talker = Talker::new(number, topic);
        // Participants announce themselves repeatedly: the agent may not observe a new interface
        // yet.
        wait_until("the agent has seen the announcement", || {
            introduce(&talker, carrier)?;
            let page = self.agent.scrape()?;
            Ok(page.sum("ros2_topic_publishers", &[("topic", topic)]) > 0.0)
        })?;
        let sizes: Vec<usize> = SIZES
            .iter()
            .copied()
            .cycle()
            .take(SIZES.len() * ROUNDS)
            .collect();
        send_sizes(&mut talker, carrier, sizes.iter().copied())?;
        let count = sizes.len() as u64;
        let scrape = self.agent.settled_scrape(topic, count)?;
        assert_exact(&scrape, topic, count, sizes.iter().sum::<usize>() as u64);
        Ok(())
    }
}

fn assert_exact(scrape: &Scrape, topic: &str, messages: u64, bytes: u64) {
    let value = |name| value(scrape, name, topic);
    let found = (
        value("ros2_topic_messages_total"),
        value("ros2_topic_bytes_total"),
        value("ros2_topic_lost_messages_total"),
        scrape.sum("ros2probe_records_dropped_total", &[]),
    );
    assert_eq!(found, (messages, bytes, 0, 0.0), "{topic} in {}", scrape.0);
}

fn value(scrape: &Scrape, name: &str, topic: &str) -> u64 {
    scrape.value(name, &[("topic", topic)]).unwrap_or(0.0) as u64
}

/// Runs `ip` inside a host.
fn ip(host: &Namespace, arguments: &str) -> Result<String> {
    run(&format!("ip -n {} {arguments}", host.name()))
}

/// Runs many `ip` commands in one process.
fn batch(host: &Namespace, commands: impl Iterator<Item = String>) -> Result<()> {
    let directory = tempfile::tempdir()?;
    let file = directory.path().join("batch");
    std::fs::write(
        &file,
        commands.map(|command| command + "\n").collect::<String>(),
    )?;
    ip(host, &format!("-batch {}", file.display()))?;
    Ok(())
}

/// Connects the hosts by another veth pair, on which the robot is `.1` and the monitor `.2`.
fn add_cable(link: &Link, name: &str, network: &str) -> Result<()> {
    let (robot, monitor) = (link.robot.name(), link.monitor.name());
    run(&format!(
        "ip link add {name} netns {robot} type veth peer name {name} netns {monitor}"
    ))?;
    for (host, number) in [(&link.robot, 1), (&link.monitor, 2)] {
        ip(host, &format!("addr add {network}.{number}/24 dev {name}"))?;
        ip(host, &format!("link set {name} up"))?;
    }
    wait_carrying(link, name)
}

/// Waits until both ends of a cable carry frames: the kernel drops them silently for up to a
/// second.
fn wait_carrying(link: &Link, name: &str) -> Result<()> {
    wait_carrying_at(&link.robot, name)?;
    wait_carrying_at(&link.monitor, name)
}

fn wait_carrying_at(host: &Namespace, name: &str) -> Result<()> {
    let deadline = Instant::now() + Duration::from_secs(30);
    while !ip(host, &format!("-o link show dev {name}"))?.contains(" state UP ") {
        anyhow::ensure!(Instant::now() < deadline, "{name} does not come up");
        std::thread::sleep(Duration::from_millis(20));
    }
    Ok(())
}

/// Returns the address and interface index of the host's link-local address, once it is usable.
fn link_local(host: &Namespace) -> Result<(String, String)> {
    let deadline = Instant::now() + Duration::from_secs(30);
    loop {
        let listing = ip(host, "-o -6 addr show dev eth0 scope link -tentative")?;
        let words: Vec<_> = listing.split_whitespace().collect();
        if let [index, _, _, address, ..] = words[..] {
            let address = address.split('/').next().unwrap().to_owned();
            return Ok((address, index.trim_end_matches(':').to_owned()));
        }
        anyhow::ensure!(Instant::now() < deadline, "no link-local address");
        std::thread::sleep(Duration::from_millis(100));
    }
}
