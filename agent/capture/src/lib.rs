//! Sources of the model: datagrams, records of the kernel programs, facts about sockets.
//!
//! - [`live::LiveSource`] observes this host: at the sockets of a control group ([`host`]), on
//!   interfaces ([`wire`]), in shared memory of Fast DDS ([`shm`], or with uprobes [`exact`]).
//! - [`pcap::PcapReader`] reads a capture, and [`feed::Feed`] brings its packets to the model.
//!
//! All `unsafe` code of user space is here: rings, maps, `ptrace`-like reads of other processes. A
//! source changes, delays and drops nothing of what it observes, and sends nothing. It is given how
//! to start threads ([`threads::Spawn`]), so that it knows nothing of privileges.
//!
//! ```no_run
//! use std::path::Path;
//!
//! use ros2probe_capture::feed::Feed;
//! use ros2probe_capture::pcap::PcapReader;
//! use ros2probe_capture::reassembly::Limits;
//! use ros2probe_model::observer::{Observer, Settings};
//!
//! let mut reader = PcapReader::open(Path::new("robot.pcap.gz"))?;
//! let mut observer = Observer::new(Settings::default());
//! Feed::new(Limits::default()).run(&mut reader, &mut observer)?;
//! # Ok::<_, ros2probe_capture::pcap::PcapError>(())
//! ```

pub mod ahead;
pub mod bell;
pub mod control_groups;
pub mod exact;
pub mod feed;
pub mod filter;
pub mod hierarchy;
pub mod host;
pub mod inside;
pub mod intake;
pub mod interfaces;
pub mod kernel_types;
pub mod live;
pub mod netns;
pub mod order;
pub mod owners;
pub mod pcap;
pub mod reassembly;
pub mod reattach;
pub mod ring;
pub mod set_clock;
pub mod settings;
pub mod shm;
pub mod sockets;
pub mod system;
pub mod threads;
pub mod whole;
pub mod wire;
