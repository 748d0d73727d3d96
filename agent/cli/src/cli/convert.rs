//! `rp bag convert`: a bag out of a capture, offline.

use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Result;
use clap::Args;

use super::record::Record;

/// `rp bag convert`.
#[derive(Args, Debug)]
#[command(
    after_help = "\
The whole capture (`rp bag record --replay FILE --from T --until T` takes a part), at the speed of this
machine: nothing is dropped. Messages have the times at which they were captured. What was never whole on the wire is not
in the bag and is named at the end, and in the bag's metadata. No privilege and no agent is needed.
Exit code: 0 when everything is in the bag; 3 when the bag is written and something is missing:
fragments, messages before the announcement of their writer, unknown writers, topics that pass
through memory, other domains, the end of a cut capture; 1 when there is nothing to read or to write.

Examples:
  rp bag convert robot.pcap.gz drive                     every topic
  rp bag convert robot.pcap drive /tf /tf_static         some
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
    /// Directory to make
    bag: PathBuf,
    #[command(flatten)]
    record: Record,
}

impl Convert {
    pub(crate) fn ask(self) -> Result<ExitCode> {
        self.record.of_capture(self.capture, self.bag).ask()
    }
}
