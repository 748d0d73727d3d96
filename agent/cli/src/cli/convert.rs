//! `rp bag convert`: writes a bag from a capture, offline.

use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Result;
use clap::Args;

use super::record::Record;

/// `rp bag convert`.
#[derive(Args, Debug)]
#[command(
    after_help = "\
Converts the whole capture at the speed of this machine and drops nothing. For a part of a capture,
use `rp bag record --replay FILE --from T --until T`. Messages keep their capture times. Messages that
were incomplete on the wire are missing in the bag; they are reported at the end and in its metadata.
Needs neither privileges nor an agent.
Exit code: 0 if everything is in the bag; 3 if something is missing in it: fragments, messages before
their writer's announcement, unknown writers, topics in memory, other domains, the end of a truncated
capture; 1 if the capture cannot be read or the bag cannot be written.

Examples:
  rp bag convert robot.pcap.gz drive                     every topic
  rp bag convert robot.pcap drive /tf /tf_static         some topics
  rp bag convert robot.pcap drive -e '^/camera/' --storage-preset-profile zstd_fast",
    mut_arg("output", |it| it.hide(true)),
    mut_arg("replay", |it| it.hide(true)),
    mut_arg("host", |it| it.hide(true)),
    mut_arg("socket", |it| it.hide(true)),
    mut_arg("token_file", |it| it.hide(true)),
    mut_arg("from", |it| it.hide(true)),
    mut_arg("until", |it| it.hide(true)),
    mut_arg("start_paused", |it| it.hide(true)),
    mut_arg("snapshot_mode", |it| it.hide(true))
)]
pub(crate) struct Convert {
    /// The capture: pcap or pcapng, may be gzipped
    capture: PathBuf,
    /// Directory to create
    bag: PathBuf,
    #[command(flatten)]
    record: Record,
}

impl Convert {
    pub(crate) fn run(self) -> Result<ExitCode> {
        self.record.of_capture(self.capture, self.bag).run()
    }
}
