//! Where datagrams come from: live interfaces and captures. All the I/O of observing is here.

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
