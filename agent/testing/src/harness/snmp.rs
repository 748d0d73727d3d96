//! The kernel's own counters of a host: the reference for where datagrams were lost.

use anyhow::{Context as _, Result};

/// The counters of `/proc/net/snmp` in the network of a process.
pub struct Snmp(String);

impl Snmp {
    pub fn of(process: u32) -> Result<Snmp> {
        let path = format!("/proc/{process}/net/snmp");
        let text = std::fs::read_to_string(&path).with_context(|| format!("cannot read {path}"))?;
        Ok(Snmp(text))
    }

    /// Returns the number of datagrams dropped at a full socket buffer.
    pub fn receive_buffer_errors(&self) -> Result<u64> {
        self.value("Udp:", "RcvbufErrors")
    }

    /// Returns the number of datagrams that reached a socket but were not delivered, for any
    /// reason.
    pub fn receive_errors(&self) -> Result<u64> {
        self.value("Udp:", "InErrors")
    }

    /// Returns the number of IP datagrams of which fragments were missing.
    pub fn reassembly_failures(&self) -> Result<u64> {
        self.value("Ip:", "ReasmFails")
    }

    /// Returns the number of datagrams sent.
    pub fn sent(&self) -> Result<u64> {
        self.value("Udp:", "OutDatagrams")
    }

    /// Returns the number of segments of TCP that were sent again.
    pub fn retransmitted(&self) -> Result<u64> {
        self.value("Tcp:", "RetransSegs")
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
