//! Packet loss at a host's outgoing interface, before any packet tap: both ends of the link miss
//! the same frames. Stateless, so nothing but the chosen datagrams is touched.

use std::io::Write;
use std::process::{Command, Stdio};

use anyhow::{Context as _, Result, bail};

use super::network::{INTERFACE, Namespace};
use super::peer::Stream;
use super::run;

/// Bytes that UDP and RTPS put around a small serialized sample: 8 + 20 + INFO_TS 12 + DATA 24, and
/// up to INFO_DST 16 + HEARTBEAT 32 + the 60 of Fast DDS's statistics submessage (0x80).
const LEAST_OVERHEAD: usize = 60;
const MOST_OVERHEAD: usize = 180;

pub(crate) struct Loss<'a> {
    host: &'a Namespace,
}

/// What the rule has met so far.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Counts {
    pub(crate) matched: u64,
    pub(crate) dropped: u64,
}

impl<'a> Loss<'a> {
    /// Drops `per_mille` of the datagrams from `host` to `receiver` that carry one unfragmented
    /// sample of `stream`. They are known by their length and by what they are not: sent to a
    /// port of discovery. RustDDS multicasts samples, the others send them to each reader.
    pub(crate) fn of_samples(
        host: &'a Namespace,
        receiver: &Namespace,
        stream: &Stream,
        per_mille: u16,
    ) -> Result<Loss<'a>> {
        let base = 7400 + 250 * u32::from(stream.domain);
        let datagrams = format!(
            "ip daddr {{ {}, 239.255.0.1 }} udp dport != {{ {base}, {}, {}, {}, {} }} udp length {}-{}",
            receiver.address(),
            base + 10,
            base + 12,
            base + 14,
            base + 16,
            stream.size + LEAST_OVERHEAD,
            stream.size + MOST_OVERHEAD
        );
        Loss::of(host, &datagrams, per_mille)
    }

    /// Drops `per_mille` of what an nftables expression such as `meta l4proto udp` matches.
    pub(crate) fn of(host: &'a Namespace, matches: &str, per_mille: u16) -> Result<Loss<'a>> {
        let rules = format!(
            "table netdev loss {{
                counter matched {{ }}
                counter dropped {{ }}
                chain egress {{
                    type filter hook egress device {INTERFACE} priority 0;
                    {matches} counter name matched
                    {matches} numgen random mod 1000 < {per_mille} counter name dropped drop
                }}
            }}"
        );
        let [program, arguments @ ..] = &host.inside()[..] else {
            bail!("no command to enter the host");
        };
        let mut nft = Command::new(program)
            .args(arguments)
            .args(["nft", "-f", "-"])
            .stdin(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .context("cannot run nft")?;
        nft.stdin
            .take()
            .context("nft has no input")?
            .write_all(rules.as_bytes())?;
        let output = nft.wait_with_output()?;
        if !output.status.success() {
            bail!(
                "nft refused the egress hook (it needs Linux 5.16): {}",
                String::from_utf8_lossy(&output.stderr)
            );
        }
        Ok(Loss { host })
    }

    pub(crate) fn counts(&self) -> Result<Counts> {
        Ok(Counts {
            matched: self.counter("matched")?,
            dropped: self.counter("dropped")?,
        })
    }

    fn counter(&self, name: &str) -> Result<u64> {
        let listing = run(&format!(
            "ip netns exec {} nft list counter netdev loss {name}",
            self.host.name()
        ))?;
        let mut words = listing
            .split_whitespace()
            .skip_while(|word| *word != "packets");
        words
            .nth(1)
            .and_then(|count| count.parse().ok())
            .with_context(|| format!("no packet count in {listing}"))
    }
}

impl Drop for Loss<'_> {
    fn drop(&mut self) {
        let _ = run(&format!(
            "ip netns exec {} nft delete table netdev loss",
            self.host.name()
        ));
    }
}
