//! Packet loss at a host's outgoing interface, before any packet tap: both ends of the link miss
//! the same frames, while the sender's socket hooks have seen the datagram. Other datagrams are not
//! affected.

use std::io::Write;
use std::process::{Command, Stdio};

use anyhow::{Context as _, Result, bail};

use super::network::{INTERFACE, Namespace};
use super::peer::Stream;
use super::run;

/// Bytes that UDP and RTPS add to a small serialized sample: 8 + 20 + INFO_TS 12 + DATA 24, and up
/// to INFO_DST 16 + HEARTBEAT 32 + the 60 of Fast DDS's statistics submessage (0x80).
const LEAST_OVERHEAD: usize = 60;
const MOST_OVERHEAD: usize = 180;

/// Excludes built-in writers by the entity kind in the DATA (RTPS 2.5, 9.3.1.2). The DATA follows
/// the UDP header, the RTPS header and INFO_TS, or these and INFO_DST.
const NO_BUILT_IN_WRITER: &str = "@th,440,8 != 0xc2 @th,568,8 != 0xc2";

/// Mark of selected datagrams between the socket and the interface.
const PACKET_MARK: u32 = 0x7232;

pub struct Loss<'a> {
    host: &'a Namespace,
    /// Family of the nftables table that selects datagrams.
    chosen_in: &'static str,
}

/// The dropped part of a selected datagram.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// The whole datagram.
    Whole,
    /// Every IP fragment but the first: the receiver's reassembly times out.
    Trailing,
}

/// Counters of the rule.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Counts {
    pub matched: u64,
    pub dropped: u64,
}

impl<'a> Loss<'a> {
    /// Drops `per_mille` of the datagrams from `host` to `receiver` that carry one unfragmented
    /// sample of `stream`. Selects them by length, excluding discovery by port and by writer:
    /// Cyclone DDS announces its participant on the port of samples, too. RustDDS multicasts
    /// samples, the other stacks send them to each reader.
    pub fn of_samples(
        host: &'a Namespace,
        receiver: &Namespace,
        stream: &Stream,
        per_mille: u16,
    ) -> Result<Loss<'a>> {
        let base = 7400 + 250 * u32::from(stream.domain);
        let datagrams = format!(
            "ip daddr {{ {}, 239.255.0.1 }} udp dport != {{ {base}, {}, {}, {}, {} }} udp length {}-{} \
             {NO_BUILT_IN_WRITER}",
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

    /// Drops `per_mille` of the packets that an nftables expression such as `meta l4proto udp`
    /// matches.
    pub fn of(host: &'a Namespace, matches: &str, per_mille: u16) -> Result<Loss<'a>> {
        Loss::at("egress", host, matches, per_mille)
    }

    /// Drops packets that arrive at `host`. TCP does not count packets as lost that its own host
    /// drops.
    pub fn of_arriving(host: &'a Namespace, matches: &str, per_mille: u16) -> Result<Loss<'a>> {
        Loss::at("ingress", host, matches, per_mille)
    }

    fn at(hook: &str, host: &'a Namespace, matches: &str, per_mille: u16) -> Result<Loss<'a>> {
        // nftables rejects a limit that is never reached.
        let chance = if per_mille < 1000 {
            format!("numgen random mod 1000 < {per_mille}")
        } else {
            String::new()
        };
        let rules = format!(
            "table netdev loss {{
                counter matched {{ }}
                counter dropped {{ }}
                chain lossy {{
                    type filter hook {hook} device {INTERFACE} priority 0;
                    {matches} counter name matched
                    {matches} {chance} counter name dropped drop
                }}
            }}"
        );
        Loss::load(host, &rules)?;
        Ok(Loss {
            host,
            chosen_in: "netdev",
        })
    }

    /// Drops every `nth` datagram that an nftables expression such as `udp length > 1000` matches.
    /// The expression is tested before IP fragmentation. The sender's socket sees a success; the
    /// kernel itself does not send the fragments that follow a dropped one.
    pub fn of_datagrams(
        host: &'a Namespace,
        matches: &str,
        nth: u64,
        part: Part,
    ) -> Result<Loss<'a>> {
        let kept_back = match part {
            Part::Whole => "",
            Part::Trailing => "ip frag-off & 0x1fff != 0",
        };
        let last = nth.saturating_sub(1);
        let rules = format!(
            "table ip loss {{
                counter matched {{ }}
                chain output {{
                    type filter hook output priority 0;
                    {matches} counter name matched numgen inc mod {nth} == {last} meta mark set {PACKET_MARK}
                }}
            }}
            table netdev loss {{
                counter dropped {{ }}
                chain egress {{
                    type filter hook egress device {INTERFACE} priority 0;
                    meta mark {PACKET_MARK} {kept_back} counter name dropped drop
                }}
            }}"
        );
        Loss::load(host, &rules)?;
        Ok(Loss {
            host,
            chosen_in: "ip",
        })
    }

    fn load(host: &Namespace, rules: &str) -> Result<()> {
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
        Ok(())
    }

    pub fn counts(&self) -> Result<Counts> {
        Ok(Counts {
            matched: self.counter(self.chosen_in, "matched")?,
            dropped: self.counter("netdev", "dropped")?,
        })
    }

    fn counter(&self, family: &str, name: &str) -> Result<u64> {
        let listing = run(&format!(
            "ip netns exec {} nft list counter {family} loss {name}",
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
        for family in ["netdev", self.chosen_in] {
            let _ = run(&format!(
                "ip netns exec {} nft delete table {family} loss",
                self.host.name()
            ));
        }
    }
}
