//! TCP connections to other hosts that carry RTPS or Zenoh: round trip times, retransmissions and
//! send queues, as the kernel of the sender counts them. The connections between two addresses are one link.

use std::collections::{BTreeMap, HashMap};
use std::time::Duration;

use ros2probe_wire::host;

use crate::facts::bounded::{Bounded, Counted, TableFacts};
use crate::facts::diagnosis::Diagnosis;
use crate::facts::link::{LinkKey, LinkProtocol};
use crate::facts::model_time::ModelTime;
use crate::facts::tables::{LinkConnections, TcpLinks};
use crate::graph::zenoh::{Flow, StreamId};

/// Number of seconds over which the share of retransmitted segments is measured.
const WINDOW_SECONDS: usize = 10;
/// Time without a report after which a connection is forgotten whose end was not seen. It is longer
/// than the pause between two retransmissions, at most 120 s on Linux, and than that between two
/// KEEP_ALIVEs.
const MAX_SILENCE: Duration = Duration::from_secs(130);
/// Time without a report after which a link is forgotten.
const LINK_TIMEOUT: Duration = Duration::from_secs(600);
/// Retransmitted segments per 1000: a link becomes a finding at the first number, and the finding
/// ends below the second.
const LOSSY_PERMILLE: u64 = 20;
const RECOVERED_PERMILLE: u64 = 10;
/// Minimum number of retransmitted segments of a finding.
const MIN_RETRANSMITTED: u64 = 5;
/// Number of seconds in which a link of a finding has sent new segments.
const PROGRESS_SECONDS: usize = 3;

/// A report about one connection.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct LinkReport {
    /// Cookie of the sending socket.
    pub socket: u64,
    /// The direction in which this host sends.
    pub flow: Flow,
    /// The protocol.
    pub protocol: LinkProtocol,
    /// The sender's state.
    pub state: host::Link,
}

/// Figures of a link.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct LinkFacts {
    /// The link.
    pub key: LinkKey,
    /// Current connections.
    pub connections: u64,
    /// Segments with data since the agent saw the link, retransmitted ones included.
    pub sent: u64,
    /// Retransmitted segments.
    pub retransmitted: u64,
    /// Smoothed round trip time, the longest of the current connections; `None` without one.
    pub round_trip: Option<Duration>,
    /// Bytes of the current connections that were sent and are not acknowledged.
    pub unacknowledged: u64,
    /// Bytes that the applications wrote to the current connections and the kernel has not sent
    /// yet; `None` if no connection reports them.
    pub unsent: Option<u64>,
}

/// All links.
#[derive(Debug, Default)]
pub struct Links {
    connections: Bounded<LinkConnections, HashMap<(u64, Flow), Connection>>,
    links: Bounded<Counted<TcpLinks>, BTreeMap<LinkKey, Link>>,
    revision: u64,
}

#[derive(Debug)]
struct Connection {
    key: LinkKey,
    at: ModelTime,
    state: host::Link,
}

#[derive(Debug, Default)]
struct Link {
    at: ModelTime,
    sent: u64,
    retransmitted: u64,
    /// Sent and retransmitted segments of the last seconds; the last slot is the current second.
    recent: [(u64, u64); WINDOW_SECONDS],
    is_lossy: bool,
}

impl Link {
    /// Returns how many of 1000 segments were retransmitted lately.
    fn permille(&self) -> u64 {
        let sent: u64 = self.recent.iter().map(|(sent, _)| sent).sum();
        (self.recent_retransmissions() * 1000)
            .checked_div(sent)
            .unwrap_or(0)
    }

    /// Returns whether new segments were sent in the last seconds. A peer that is gone acknowledges
    /// nothing, and then TCP only retransmits.
    fn makes_progress(&self) -> bool {
        let last = self.recent.iter().rev().take(PROGRESS_SECONDS);
        last.fold(0, |new, (sent, again)| new + sent.saturating_sub(*again)) > 0
    }

    /// Returns the number of segments that were retransmitted lately.
    fn recent_retransmissions(&self) -> u64 {
        self.recent.iter().map(|(_, again)| again).sum()
    }
}

impl Links {
    /// Records the state of a connection. What it sent before its first report does not count.
    pub fn report(&mut self, report: &LinkReport, now: ModelTime) {
        let Flow {
            source,
            destination,
        } = report.flow;
        let key = LinkKey {
            protocol: report.protocol,
            source: source.socket_address().ip(),
            destination: destination.socket_address().ip(),
        };
        let id = (report.socket, report.flow);
        let before = self.connections.get(&id).map(|known| known.state);
        if before.is_none() && self.connections.is_full() {
            // The table of links reports it.
            self.links.refuse();
            return;
        }
        let Some(link) = self.links.get_or_insert_with(key, Link::default) else {
            return;
        };
        link.at = now;
        if let Some(before) = before {
            let since = |now: u32, before: u32| u64::from(now.wrapping_sub(before));
            let sent = since(report.state.sent, before.sent);
            let again = since(report.state.retransmitted, before.retransmitted);
            link.sent += sent;
            link.retransmitted += again;
            if let Some(current) = link.recent.last_mut() {
                *current = (current.0 + sent, current.1 + again);
            }
        }
        let state = report.state;
        let connection = Connection {
            key,
            at: now,
            state,
        };
        self.connections.insert(id, connection);
    }

    /// Forgets the connection of a socket that was closed.
    pub fn forget(&mut self, socket: u64) {
        self.connections.retain(|(known, _), _| *known != socket);
    }

    /// Forgets the connection of a stream whose sender, this host or the other, has closed it.
    pub fn end(&mut self, stream: &StreamId) {
        for flow in [stream.flow, stream.flow.reversed()] {
            self.connections.remove(&(stream.socket, flow));
        }
    }

    /// Ends a second: determines which links are lossy, and forgets what is gone.
    pub fn end_second(&mut self, now: ModelTime) {
        self.connections
            .retain(|_, each| each.at + MAX_SILENCE > now);
        self.links.retain(|_, each| each.at + LINK_TIMEOUT > now);
        for link in self.links.values_mut() {
            let share = link.permille();
            let is_lossy = match link.is_lossy {
                true => share >= RECOVERED_PERMILLE,
                false => {
                    share >= LOSSY_PERMILLE
                        && link.recent_retransmissions() >= MIN_RETRANSMITTED
                        && link.makes_progress()
                }
            };
            self.revision += u64::from(is_lossy != link.is_lossy);
            link.is_lossy = is_lossy;
            link.recent.rotate_left(1);
            if let Some(current) = link.recent.last_mut() {
                *current = (0, 0);
            }
        }
    }

    /// Returns the number of changes of [`Self::findings`].
    #[must_use]
    pub const fn revision(&self) -> u64 {
        self.revision
    }

    /// Returns the links that retransmit too much.
    pub fn findings(&self) -> impl Iterator<Item = Diagnosis> {
        let lossy = self.links.iter().filter(|(_, link)| link.is_lossy);
        lossy.map(|(key, link)| Diagnosis::LossyLink {
            link: *key,
            retransmitted_permille: link.permille(),
            unsent: self.unsent(key),
        })
    }

    /// Returns the bytes that wait to be sent on a link; `None` if no connection reports them.
    fn unsent(&self, key: &LinkKey) -> Option<u64> {
        let own = self.connections.values().filter(|each| each.key == *key);
        let reported = own.filter(|each| each.state.unsent_known != 0);
        let waiting = reported.map(|each| u64::from(each.state.unsent));
        waiting.reduce(|sum, each| sum + each)
    }

    /// Returns the figures of all links.
    #[must_use]
    pub fn facts(&self) -> Vec<LinkFacts> {
        let mut facts: BTreeMap<LinkKey, LinkFacts> = BTreeMap::new();
        for (key, link) in self.links.iter() {
            let known = LinkFacts {
                key: *key,
                connections: 0,
                sent: link.sent,
                retransmitted: link.retransmitted,
                round_trip: None,
                unacknowledged: 0,
                unsent: None,
            };
            facts.insert(*key, known);
        }
        for connection in self.connections.values() {
            if let Some(link) = facts.get_mut(&connection.key) {
                let time = Duration::from_micros(connection.state.smoothed_rtt.into());
                link.connections += 1;
                link.round_trip = link.round_trip.max(Some(time));
                link.unacknowledged += u64::from(connection.state.unacknowledged);
                if connection.state.unsent_known != 0 {
                    let others = link.unsent.unwrap_or(0);
                    link.unsent = Some(others + u64::from(connection.state.unsent));
                }
            }
        }
        facts.into_values().collect()
    }

    /// Returns the table for the snapshot.
    #[must_use]
    pub fn tables(&self) -> TableFacts {
        self.links.facts()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn report(port: u16, peer: u8, sent: u32, retransmitted: u32) -> LinkReport {
        let place = |text: String| text.parse::<std::net::SocketAddr>().unwrap().into();
        LinkReport {
            socket: port.into(),
            flow: Flow {
                source: place(format!("10.0.0.1:{port}")),
                destination: place(format!("10.0.0.{peer}:7447")),
            },
            protocol: LinkProtocol::Zenoh,
            state: host::Link {
                smoothed_rtt: 2_000 + u32::from(port),
                retransmitted,
                sent,
                unacknowledged: 100,
                unsent: 1000,
                unsent_known: u32::from(peer != 9),
            },
        }
    }

    fn at(second: u64) -> ModelTime {
        ModelTime::from_nanoseconds(1_000_000_000 * (1000 + second))
    }

    #[test]
    fn connections_between_two_addresses_are_one_link_and_their_past_does_not_count() {
        let mut links = Links::default();
        links.report(&report(1, 2, 5000, 400), at(0));
        links.report(&report(2, 2, 10, 0), at(0));
        links.report(&report(1, 2, 5100, 401), at(1));
        links.report(&report(2, 2, 40, 2), at(1));
        let [facts] = links.facts()[..] else {
            panic!("{:?}", links.facts());
        };
        assert_eq!(
            (facts.connections, facts.sent, facts.retransmitted),
            (2, 130, 3)
        );
        assert_eq!(facts.round_trip, Some(Duration::from_micros(2002)));
        assert_eq!((facts.unacknowledged, facts.unsent), (200, Some(2000)));
        // The kernel's counters have 32 bits.
        links.report(&report(3, 3, u32::MAX, u32::MAX), at(1));
        links.report(&report(3, 3, 9, 0), at(2));
        assert_eq!(
            (links.facts()[1].sent, links.facts()[1].retransmitted),
            (10, 1)
        );
    }

    #[test]
    fn bytes_that_wait_to_be_sent_are_unknown_without_a_report_of_them() {
        let mut links = Links::default();
        links.report(&report(1, 9, 10, 0), at(0));
        assert_eq!(links.facts()[0].unsent, None);
        // One connection of the link reports them.
        let mut other = report(2, 9, 10, 0);
        other.state.unsent_known = 1;
        links.report(&other, at(0));
        assert_eq!(links.facts()[0].unsent, Some(1000));
        links.forget(2);
        assert_eq!(links.facts()[0].unsent, None);
    }

    #[test]
    fn a_connection_that_either_end_closes_is_forgotten_at_once() {
        let mut links = Links::default();
        (1..=4).for_each(|port| links.report(&report(port, 2, 1, 0), at(0)));
        let connections = |links: &Links| links.facts()[0].connections;
        links.forget(1);
        assert_eq!(connections(&links), 3);
        let stream = |socket, flow| StreamId {
            flow,
            socket,
            ..StreamId::default()
        };
        links.end(&stream(2, report(2, 2, 1, 0).flow));
        links.end(&stream(3, report(3, 2, 1, 0).flow.reversed()));
        assert_eq!(connections(&links), 1);
        // Another socket does not end the connection.
        links.end(&stream(9, report(4, 2, 1, 0).flow));
        assert_eq!(connections(&links), 1);
    }

    #[test]
    fn a_link_that_retransmits_is_a_finding_until_it_is_sound_again() {
        let mut links = Links::default();
        let (mut sent, mut again) = (0, 0);
        let mut states = Vec::new();
        for second in 0..60 {
            sent += 100;
            again += if (10..20).contains(&second) { 4 } else { 0 };
            links.report(&report(1, 2, sent, again), at(second));
            links.end_second(at(second));
            states.push(links.findings().count());
        }
        let first = states.iter().position(|count| *count == 1).unwrap();
        let last = states.iter().rposition(|count| *count == 1).unwrap();
        assert!(
            (12..16).contains(&first) && (24..32).contains(&last),
            "{first} {last}"
        );
        assert_eq!(links.revision(), 2);
    }

    #[test]
    fn a_removed_peer_is_not_a_lossy_link() {
        let mut links = Links::default();
        let (mut sent, mut again) = (0, 0);
        for second in 0..60 {
            match second {
                0..10 => sent += 30,
                // TCP only retransmits, at growing intervals.
                10..13 => (sent, again) = (sent + 2, again + 2),
                _ => (sent, again) = (sent + second % 2, again + second % 2),
            }
            links.report(&report(1, 2, sent, again), at(second.into()));
            links.end_second(at(second.into()));
            assert_eq!(links.findings().count(), 0, "{second}");
        }
    }

    #[test]
    fn silent_connections_and_links_are_forgotten_and_both_tables_are_bounded() {
        let mut links = Links::default();
        links.report(&report(1, 2, 1, 0), at(0));
        links.end_second(at(131));
        assert_eq!(
            (links.facts()[0].connections, links.facts()[0].round_trip),
            (0, None)
        );
        links.end_second(at(601));
        assert!(links.facts().is_empty());
        for number in 0..=u16::MAX {
            links.report(&report(number, 2, 1, 0), at(700));
        }
        assert_eq!(links.facts()[0].connections, LinkConnections::CAP as u64);
        let beyond = u64::from(u16::MAX) + 1 - LinkConnections::CAP as u64;
        assert_eq!(links.tables().evictions, beyond);
        let mut links = Links::default();
        for peer in 0..=u8::MAX {
            let mut each = report(1, peer, 1, 0);
            for protocol in [LinkProtocol::Rtps, LinkProtocol::Zenoh] {
                each.protocol = protocol;
                each.socket += 1;
                links.report(&each, at(700));
            }
        }
        assert_eq!(links.facts().len(), TcpLinks::CAP);
        assert!(links.tables().evictions > 0);
    }
}
