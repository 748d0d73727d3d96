//! What the kernel itself counts on a host: the judge of where datagrams died.

use anyhow::{Context as _, Result};

/// The counters of `/proc/net/snmp` of the network that a process is in.
pub struct Snmp(String);

impl Snmp {
    pub fn of(process: u32) -> Result<Snmp> {
        let path = format!("/proc/{process}/net/snmp");
        let text = std::fs::read_to_string(&path).with_context(|| format!("cannot read {path}"))?;
        Ok(Snmp(text))
    }

    /// Datagrams that found no room in a socket's receive buffer.
    pub fn receive_buffer_errors(&self) -> Result<u64> {
        self.value("Udp:", "RcvbufErrors")
    }

    /// Datagrams that reached a socket and were not delivered, for whatever reason.
    pub fn receive_errors(&self) -> Result<u64> {
        self.value("Udp:", "InErrors")
    }

    /// Datagrams that were sent.
    pub fn sent(&self) -> Result<u64> {
        self.value("Udp:", "OutDatagrams")
    }

    fn value(&self, protocol: &str, name: &str) -> Result<u64> {
        let mut lines = self.0.lines().filter(|line| line.starts_with(protocol));
        let names = lines.next().unwrap_or_default().split_whitespace();
        let values = lines.next().unwrap_or_default().split_whitespace();
        let value = names.zip(values).find(|(each, _)| *each == name);
        value
            .and_then(|(_, value)| value.parse().ok())
            .with_context(|| format!("the kernel does not count {protocol} {name}"))
    }
}
