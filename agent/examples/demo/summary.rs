//! The demo's table: one line per measured topic, from the differences between two scrapes.

use std::collections::BTreeMap;
use std::time::Instant;

use crate::harness::agent::Scrape;
use crate::harness::network::Link;
use crate::relay::Relay;

pub(crate) struct Summary {
    /// Whether the table may replace the one before.
    redraws: bool,
    earlier: Option<(Instant, BTreeMap<String, Counters>)>,
}

#[derive(Clone, Copy, Default)]
struct Counters {
    messages: f64,
    bytes: f64,
    lost: f64,
    latency_sum: f64,
    latency_count: f64,
}

impl Summary {
    pub(crate) fn new(redraws: bool) -> Summary {
        Summary {
            redraws,
            earlier: None,
        }
    }

    pub(crate) fn show(&mut self, scrape: &Scrape, now: Instant, relay: &Relay, link: &Link) {
        let topics: BTreeMap<String, Counters> = scrape
            .labels_of("ros2_topic_messages_total", "topic")
            .into_iter()
            .map(|topic| {
                let counters = Counters::read(scrape, &topic);
                (topic, counters)
            })
            .collect();
        if self.redraws {
            print!("\x1b[H\x1b[J");
        }
        let count = |name| scrape.sum(name, &[]);
        println!(
            "{} participants, {} topics measured",
            count("ros2_participants"),
            topics.len()
        );
        println!(
            "{:<32} {:>9} {:>12} {:>7} {:>11}",
            "topic", "rate", "bandwidth", "lost", "latency"
        );
        if let Some((then, earlier)) = &self.earlier {
            let seconds = now.saturating_duration_since(*then).as_secs_f64();
            for (topic, counters) in &topics {
                println!(
                    "{topic:<32} {}",
                    counters.since(earlier.get(topic), seconds)
                );
            }
        }
        println!("\ncurl http://{}/metrics", relay.address());
        println!(
            "ip netns exec {} tcpdump -ni eth0   (Ctrl-C ends the demo)",
            link.robot.name()
        );
        self.earlier = Some((now, topics));
    }
}

impl Counters {
    fn read(scrape: &Scrape, topic: &str) -> Counters {
        let sum = |name| scrape.sum(name, &[("topic", topic)]);
        Counters {
            messages: sum("ros2_topic_messages_total"),
            bytes: sum("ros2_topic_bytes_total"),
            lost: sum("ros2_topic_lost_messages_total"),
            latency_sum: sum("ros2_topic_latency_seconds_sum"),
            latency_count: sum("ros2_topic_latency_seconds_count"),
        }
    }

    fn since(&self, earlier: Option<&Counters>, seconds: f64) -> String {
        let earlier = earlier.copied().unwrap_or_default();
        let rate = (self.messages - earlier.messages) / seconds;
        let megabytes = (self.bytes - earlier.bytes) / seconds / 1e6;
        let measured = self.latency_count - earlier.latency_count;
        let latency = match measured > 0.0 {
            true => {
                let mean = (self.latency_sum - earlier.latency_sum) / measured;
                format!("{:.3} ms", mean * 1e3)
            }
            false => "-".to_owned(),
        };
        format!(
            "{rate:>6.1} Hz {megabytes:>7.3} MB/s {:>7} {latency:>11}",
            self.lost
        )
    }
}
