//! Where datagrams come from: live interfaces and captures. All the I/O of observing is here.

pub mod bell;
pub mod cgroup;
pub mod cgroup_paths;
pub mod clock_step;
pub mod filter;
pub mod filter_reader;
pub mod frame_decoder;
pub mod host_tap;
pub mod interfaces;
pub mod kernel_types;
pub mod live;
pub mod netns;
pub mod owners;
pub mod pcap;
pub mod piece_assembler;
pub mod reattach;
pub mod reorder_buffer;
pub mod ring;
pub mod settings;
pub mod shm;
pub mod sockets;
pub mod system;
pub mod threads;
pub mod tracepoints;
pub mod uprobe;
pub mod wire_tap;
