//! Privileges of the agent, which starts with those that attaching kernel programs requires. Once
//! sockets and kernel programs are open, every thread drops the capabilities and system calls that
//! it no longer needs.
//!
//! Capabilities and filters belong to threads, and a new thread inherits those of its creator. A
//! thread that needs more is started by [`spawn`] before its creator is confined. The agent never
//! gains privileges beyond those of its start.

mod calls;
mod capabilities;
mod confinement;
mod probe;
mod threads;
mod user;

pub use capabilities::{
    CapabilitiesRemain, DropError, Missing, Unprivileged, capability_names, check, missing, raise,
};
pub use confinement::{
    ConfineError, Role, Sandbox, SpawnError, confine, drop_capabilities, sandbox, spawn,
    spawn_export, spawn_source,
};
pub use threads::{ThreadCapabilities, threads};
pub use user::{Identity, become_own_user, user_id};
