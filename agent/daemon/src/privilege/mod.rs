//! What the agent may do. It begins with what attaching needs; once sockets and kernel programs are
//! open, every thread gives up the capabilities that it does not go on needing and every system call
//! that it does not make.
//!
//! Both belong to threads, and a new thread has those of its creator: one that needs more than the
//! rest is started by [`spawn`] before the creator is confined. Nothing here ever asks for more than
//! the process was started with.

mod calls;
mod capabilities;
mod confinement;
mod probe;
mod threads;
mod user;

pub use capabilities::{
    CapabilitiesRemain, DropError, Missing, Unprivileged, capability_names, check, missing,
};
pub use confinement::{
    ConfineError, Role, Sandbox, SpawnError, confine, give_up, sandbox, spawn, spawn_source,
};
pub use threads::{ThreadCapabilities, threads};
pub use user::{Identity, become_own_user};
