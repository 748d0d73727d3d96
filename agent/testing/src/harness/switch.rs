//! A switch between two hosts. The sender's packet sockets see the datagrams that it drops, the
//! receiver's do not. `Loss::of_samples` on the switch therefore creates loss between two agents.

use anyhow::Result;

use super::network::{INTERFACE, Link, Namespace};
use super::run;

/// The switch's port to the robot; the port to the monitor is called [`INTERFACE`].
const ROBOT_PORT: &str = "robot";

pub struct Switched {
    pub link: Link,
    pub switch: Namespace,
}

impl Switched {
    /// Connects the two ends of a new link to a switch.
    pub fn new() -> Result<Switched> {
        let link = Link::new()?;
        let switch = Namespace::isolated()?;
        let name = switch.name();
        for host in [&link.robot, &switch] {
            run(&format!("ip -n {} link delete {INTERFACE}", host.name()))?;
        }
        run(&format!(
            "ip -n {name} link add bridge type bridge mcast_snooping 0"
        ))?;
        for (host, port) in [(&link.robot, ROBOT_PORT), (&link.monitor, INTERFACE)] {
            run(&format!(
                "ip link add {port} netns {name} mtu 1500 type veth peer name {INTERFACE} mtu 1500 netns {}",
                host.name()
            ))?;
            run(&format!("ip -n {name} link set {port} master bridge up"))?;
            host.configure(INTERFACE)?;
        }
        run(&format!("ip -n {name} link set bridge up"))?;
        Ok(Switched { link, switch })
    }
}
