//! `rp page`: the address of the page, with a token that grants all rights.

use std::net::IpAddr;
use std::process::{Command, ExitCode, Stdio};

use anyhow::Result;
use clap::Args;
use ros2probe::client::{Agent, Target};
use ros2probe_api::health::PageToken;
use serde_json::json;

use super::{Output, UserError};

/// Default port of the API.
const API_PORT: &str = "17401";
/// Program that opens an address in the browser of a desktop.
const BROWSER_OPENER: &str = "xdg-open";

/// `rp page`.
#[derive(Args, Debug)]
#[command(after_help = "\
The agent serves the page beside its API. The printed address contains a token behind the `#`, which
browsers never send; the page keeps it in its tab. Without the token the page has the rights of
`api.loopback`. The agent issues tokens over its unix socket, or to holders of its token file.

With --host of another robot it prints the command that brings its page to this computer.

Examples:
  rp page --open
  rp page --host robot1")]
pub(crate) struct Page {
    /// Open the page in the browser of this desktop; other local users may see the token in `ps`
    #[arg(long)]
    open: bool,
    #[command(flatten)]
    target: Target,
}

impl Page {
    pub(crate) fn run(self) -> Result<ExitCode> {
        let mut output = Output::new();
        let near = match self.target.host.as_deref().map(parts) {
            Some((name, port)) if !is_near(name) => {
                output.write(&tunnel(name, port))?;
                return Ok(ExitCode::SUCCESS);
            }
            Some((name, port)) => Some(format!("http://{name}:{port}/")),
            None => None,
        };
        if self.target.replay.is_some() {
            let way = "rp run --replay FILE serves the page of a capture".to_owned();
            return Err(UserError(way).into());
        }
        let agent = Agent::reach(&self.target)?;
        let PageToken { token, address } = agent.post("/page/token", &json!({}))?;
        let Some(address) = address else {
            let reason = "the agent serves no page: api.listen or api.page is off".to_owned();
            return Err(UserError(reason).into());
        };
        // Prefers the address at which this program has reached the agent.
        let address = near.unwrap_or(address);
        let address = format!("{address}#token={token}");
        output.write(&format!("{address}\n"))?;
        if self.open {
            open(&address)?;
        }
        Ok(ExitCode::SUCCESS)
    }
}

/// Returns host name and port of an address.
pub(super) fn parts(host: &str) -> (&str, &str) {
    match host.rsplit_once(':') {
        Some((name, port)) if !name.ends_with(':') && port.parse::<u16>().is_ok() => (name, port),
        _ => (host, API_PORT),
    }
}

/// Returns whether the name is that of this host.
pub(super) fn is_near(name: &str) -> bool {
    let address = name.trim_matches(['[', ']']).parse::<IpAddr>();
    name == "localhost" || address.is_ok_and(|address| address.is_loopback())
}

/// Returns the SSH command that forwards the page of another host to this one.
fn tunnel(name: &str, port: &str) -> String {
    format!(
        "ssh -L {port}:127.0.0.1:{port} {name}\n\
         # then http://localhost:{port}/ here; `rp page` on {name} prints it with a token\n"
    )
}

fn open(address: &str) -> Result<()> {
    let opened = Command::new(BROWSER_OPENER)
        .arg(address)
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .status();
    match opened {
        Ok(status) if status.success() => Ok(()),
        _ => {
            let reason =
                format!("{BROWSER_OPENER} does not open it: copy the address into a browser");
            Err(UserError(reason).into())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_ssh_command_forwards_the_port_of_the_agent() {
        let of = |host: &str| {
            let (name, port) = parts(host);
            tunnel(name, port)
        };
        assert!(of("robot1").starts_with("ssh -L 17401:127.0.0.1:17401 robot1\n"));
        let other = of("pi@robot1:9000");
        assert!(
            other.starts_with("ssh -L 9000:127.0.0.1:9000 pi@robot1\n"),
            "{other}"
        );
        assert!(other.contains("http://localhost:9000/"));
    }

    #[test]
    fn addresses_of_this_host_need_no_ssh_command() {
        for (host, expected) in [
            ("localhost", true),
            ("127.0.0.1:9000", true),
            ("[::1]:9000", true),
            ("robot1", false),
            ("10.0.0.1:9000", false),
        ] {
            assert_eq!(is_near(parts(host).0), expected, "{host}");
        }
    }
}
