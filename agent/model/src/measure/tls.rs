//! TCP connections of RTPS that are encrypted with TLS: they are counted, because nothing in them can
//! be read.
//!
//! A connection is one of RTPS if it leads to an address that a participant announces. The
//! announcement may come after the connection.

use std::collections::BTreeMap;
use std::time::Duration;

use crate::facts::bounded::{Bounded, Counted, TableFacts};
use crate::facts::model_time::ModelTime;
use crate::facts::tables::ClientHellos;
use crate::graph::discovery::Discovery;
use crate::graph::zenoh::Flow;

/// Time in which an announcement may follow, and in which both ends of a connection may report it.
/// By default, Fast DDS repeats an announcement every 3 s.
const MEMORY: Duration = Duration::from_secs(60);

/// Connections that begin with a handshake of TLS.
#[derive(Debug, Default)]
pub struct TlsConnections {
    recent: Bounded<Counted<ClientHellos>, BTreeMap<Flow, Hello>>,
    counted: u64,
}

#[derive(Debug)]
struct Hello {
    at: ModelTime,
    is_counted: bool,
}

impl TlsConnections {
    /// Records that a client begins a handshake in this direction. Further reports of the same
    /// connection have no effect.
    pub fn hello(&mut self, flow: Flow, now: ModelTime) {
        self.recent.get_or_insert_with(flow, || Hello {
            at: now,
            is_counted: false,
        });
    }

    /// Counts the connections to addresses that participants announce.
    pub fn end_second(&mut self, now: ModelTime, discovery: &Discovery) {
        for (flow, hello) in self.recent.iter_mut() {
            let to = flow.destination.socket_address();
            let mut participants = discovery.participants().values();
            if !hello.is_counted && participants.any(|each| each.addresses.accepts_tcp(to)) {
                hello.is_counted = true;
                self.counted += 1;
            }
        }
        self.recent.retain(|_, hello| hello.at + MEMORY > now);
    }

    /// Returns the number of connections of RTPS since the start.
    #[must_use]
    pub const fn counted(&self) -> u64 {
        self.counted
    }

    /// Returns the table for the snapshot.
    #[must_use]
    pub fn tables(&self) -> TableFacts {
        self.recent.facts()
    }
}
