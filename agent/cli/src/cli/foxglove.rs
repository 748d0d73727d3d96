//! `rp foxglove`: the address for viewers, with a token that grants all rights.

use std::process::ExitCode;

use anyhow::Result;
use clap::Args;
use ros2probe::client::{Agent, Target};
use ros2probe_api::health::{Health, PageToken};
use serde_json::json;

use super::page::{is_near, parts};
use super::{Output, UserError};

/// Default port of the listener for viewers.
const PORT: u16 = 8765;

/// `rp foxglove`.
#[derive(Args, Debug)]
#[command(after_help = "\
Open the printed address in Foxglove (Foxglove WebSocket), Lichtblick or PlotJuggler (Foxglove
Bridge). It contains a token, without which viewers receive no messages unless `api.loopback` is
`all`. The agent issues tokens over its unix socket, or to holders of its token file.

With --host of another robot it prints the command that brings its port to this computer.

Examples:
  rp foxglove
  rp foxglove --host robot1")]
pub(crate) struct Foxglove {
    #[command(flatten)]
    target: Target,
}

impl Foxglove {
    pub(crate) fn run(self) -> Result<ExitCode> {
        let mut output = Output::new();
        if let Some((name, _)) = self.target.host.as_deref().map(parts)
            && !is_near(name)
        {
            output.write(&tunnel_command(name))?;
            return Ok(ExitCode::SUCCESS);
        }
        if self.target.replay.is_some() {
            let way = "rp run --replay FILE serves viewers of a capture".to_owned();
            return Err(UserError(way).into());
        }
        let agent = Agent::reach(&self.target)?;
        let health: Health = agent.get("/health")?;
        let Some(listener) = health.foxglove else {
            let reason = "the agent serves no viewers: foxglove.listen is off".to_owned();
            return Err(UserError(reason).into());
        };
        if let Some(reason) = listener.reason {
            let reason = format!(
                "the agent serves no viewers on {}: {reason}",
                listener.address
            );
            return Err(UserError(reason).into());
        }
        let PageToken { token, .. } = agent.post("/page/token", &json!({}))?;
        output.write(&format!("{}?token={token}\n", listener.address))?;
        Ok(ExitCode::SUCCESS)
    }
}

/// Returns the SSH command that forwards the port of another host to this one.
fn tunnel_command(name: &str) -> String {
    format!(
        "ssh -L {PORT}:127.0.0.1:{PORT} {name}\n\
         # then open ws://localhost:{PORT}/ here; `rp foxglove` on {name} prints it with a token\n"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_ssh_command_forwards_the_port_for_viewers() {
        let shown = tunnel_command("pi@robot1");
        assert!(
            shown.starts_with("ssh -L 8765:127.0.0.1:8765 pi@robot1\n"),
            "{shown}"
        );
        assert!(shown.contains("ws://localhost:8765/"));
    }
}
