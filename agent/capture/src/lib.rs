//! Capture: passes datagrams, records of the kernel programs, and facts about sockets to the model.
//!
//! - [`live::LiveSource`] observes this host: sockets of a control group ([`host_tap`]), interfaces
//!   ([`wire_tap`]), and shared memory of Fast DDS ([`shm`], or with uprobes [`uprobe`]).
//! - [`pcap::PcapReader`] reads a capture, and [`frame_decoder::FrameDecoder`] passes its packets
//!   to the model.
//!
//! This crate contains `unsafe` code for rings, maps and `ptrace`-like reads of other processes. A
//! source changes, delays and drops nothing that it observes, and sends nothing. The caller passes
//! a function that starts threads ([`threads::Spawn`]), so that sources do not depend on
//! privileges.
//!
//! ```no_run
//! use std::path::Path;
//!
//! use ros2probe_capture::frame_decoder::FrameDecoder;
//! use ros2probe_capture::pcap::PcapReader;
//! use ros2probe_wire::Expansion;
//! use ros2probe_capture::reassembly::Limits;
//! use ros2probe_model::observe::observer::{Observer, Settings};
//!
//! let mut reader = PcapReader::open(Path::new("robot.pcap.gz"), Expansion::Limited)?;
//! let mut observer = Observer::new(Settings::default());
//! FrameDecoder::new(Limits::default()).run(&mut reader, &mut observer)?;
//! # Ok::<_, ros2probe_capture::pcap::PcapError>(())
//! ```

pub mod ahead;
pub mod bell;
pub mod border;
pub mod bpf;
pub mod breakpoints;
pub mod cgroup;
pub mod cgroup_paths;
pub mod clock_step;
pub mod container;
pub mod error_chain;
pub mod filter;
pub mod filter_reader;
pub mod frame_decoder;
pub mod host_tap;
pub mod inside;
pub mod interfaces;
pub mod kernel_types;
pub mod live;
pub mod mappings;
pub mod netns;
pub mod owners;
pub mod pcap;
pub mod piece_assembler;
pub mod reassembly;
pub mod reattach;
pub mod reorder_buffer;
pub mod ring;
pub mod settings;
pub mod shm;
pub mod sockets;
pub mod streams;
pub mod system;
pub mod tables;
pub mod tcx;
pub mod threads;
pub mod tracepoints;
pub mod uprobe;
pub mod wire_tap;
