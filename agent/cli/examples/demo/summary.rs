//! The demo's table: one line per topic that has sent anything.

use std::collections::BTreeMap;

use crate::{API, Relays};
use ros2probe_testing::harness::agent::Scrape;
use ros2probe_testing::harness::network::Link;

pub(crate) struct Summary {
    /// Whether the table may overwrite the previous one.
    redraws: bool,
    /// The program `rp`, as a user types it.
    command: String,
    /// Sum and count of each topic's latency at the previous scrape.
    latencies: BTreeMap<String, (f64, f64)>,
}

impl Summary {
    pub(crate) fn new(redraws: bool, command: String) -> Summary {
        Summary {
            redraws,
            command,
            latencies: BTreeMap::new(),
        }
    }

    pub(crate) fn show(&mut self, scrape: &Scrape, relays: &Relays, link: &Link) {
        if self.redraws {
            print!("\x1b[H\x1b[J");
        }
        let count = |name| scrape.sum(name, &[]);
        println!(
            "{} participants, {} nodes, {} topics measured\n",
            count("ros2_participants"),
            count("ros2_nodes"),
            count("ros2probe_tracked_topics"),
        );
        println!(
            "{:<16} {:>8} {:>14} {:>9} {:>6} {:>11}",
            "topic", "rate", "bandwidth", "messages", "lost", "latency"
        );
        for topic in scrape.labels_of("ros2_topic_messages_total", "topic") {
            let value = |name| scrape.sum(name, &[("topic", &topic)]);
            let messages = value("ros2_topic_messages_total");
            if messages == 0.0 {
                continue;
            }
            println!(
                "{topic:<16} {:>5.1} Hz {:>9.3} MB/s {messages:>9} {:>6} {:>11}",
                value("ros2_topic_rate_hertz"),
                value("ros2_topic_bandwidth_bytes_per_second") / 1e6,
                value("ros2_topic_lost_messages_total"),
                self.latency(scrape, &topic),
            );
        }
        let (api, options) = (relays.api.address(), relays.options(API));
        let rp = &self.command;
        println!("\n{rp} topic list{options}");
        println!("{rp} top{options}");
        println!("curl http://{}/metrics", relays.metrics.address());
        println!("curl -X POST http://{api}/watch/points");
        println!(
            "ip netns exec {} tcpdump -ni eth0   (Ctrl-C ends the demo)",
            link.robot.name()
        );
        println!("the page: http://localhost:{}/", api.port());
        let viewers = relays.viewers.address().port();
        println!("Foxglove: ws://localhost:{viewers}");
    }

    /// Returns the mean time from the writer's timestamp to the wire since the previous scrape.
    fn latency(&mut self, scrape: &Scrape, topic: &str) -> String {
        let value = |name| scrape.sum(name, &[("topic", topic)]);
        let sum = value("ros2_topic_latency_seconds_sum");
        let count = value("ros2_topic_latency_seconds_count");
        let earlier = self.latencies.insert(topic.to_owned(), (sum, count));
        let (earlier_sum, earlier_count) = earlier.unwrap_or_default();
        match count > earlier_count {
            true => format!(
                "{:.3} ms",
                (sum - earlier_sum) / (count - earlier_count) * 1e3
            ),
            false => "-".to_owned(),
        }
    }
}
