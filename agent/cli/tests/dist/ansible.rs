//! The Ansible role: real Ansible applies it to a fresh Debian with systemd.
//!
//! Ansible reaches the container through a program in the place of `ssh`, which enters the
//! container's namespaces.

use std::fs;
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::harness::wait_until;
use ros2probe_testing::repository;
use serde_json::{Value, json};

use crate::package::installation::debian::{Debian, Start};
use crate::package::installation::{all, installable};

const CONFIG: &str = "/etc/ros2probe/ros2probe.yaml";

/// Ansible with an inventory of one host.
pub(crate) struct Ansible {
    playbook: PathBuf,
    inventory: PathBuf,
    directory: PathBuf,
}

impl Ansible {
    /// Writes the inventory into a directory.
    pub(crate) fn over(host: &Debian, directory: &Path, playbook: PathBuf) -> Result<Self> {
        let enter = directory.join("enter");
        // Ansible's last argument is the command for the host's shell.
        let script = format!(
            "#!/bin/sh\nfor command; do :; done\nexec nsenter --target {} --all env --ignore-environment \
             PATH=/usr/sbin:/usr/bin:/sbin:/bin LC_ALL=C.UTF-8 HOME=/root sh -c \"$command\"\n",
            host.first()
        );
        fs::write(&enter, script)?;
        fs::set_permissions(&enter, fs::Permissions::from_mode(0o755))?;
        let inventory = directory.join("robots.ini");
        fs::write(
            &inventory,
            format!(
                "robot ansible_ssh_executable={} ansible_ssh_args='' ansible_ssh_transfer_method=piped \
                 ansible_python_interpreter=/usr/bin/python3 ansible_remote_tmp=/tmp/ansible\n",
                enter.display()
            ),
        )?;
        Ok(Self {
            playbook,
            inventory,
            directory: directory.to_owned(),
        })
    }

    /// Applies the role with these variables.
    pub(crate) fn apply(&self, variables: &Value) -> Result<Output> {
        let mut playbook = Command::new("ansible-playbook");
        playbook.arg("--inventory").arg(&self.inventory);
        playbook.arg("--extra-vars").arg(variables.to_string());
        playbook.arg(&self.playbook);
        playbook.envs([("ANSIBLE_PIPELINING", "1"), ("ANSIBLE_NOCOLOR", "1")]);
        playbook.env("ANSIBLE_HOME", self.directory.join("ansible"));
        playbook.env("ANSIBLE_LOCAL_TEMP", self.directory.join("ansible/tmp"));
        let output = playbook.output();
        output.context("ansible-playbook; `apt-get install ansible-core`")
    }
}

/// A host to which Ansible applies the role.
pub(crate) struct Managed {
    pub(crate) host: Debian,
    ansible: Ansible,
}

impl Managed {
    /// Starts a host with systemd whose `/packages` is `directory`.
    pub(crate) fn start(directory: &Path) -> Result<Self> {
        let host = Debian::start(Start::Systemd, directory)?;
        let ansible = Ansible::over(&host, directory, repository("deploy/ansible/site.yaml"))?;
        Ok(Self { host, ansible })
    }

    /// Applies the role with these variables.
    fn apply(&self, variables: &Value) -> Result<Output> {
        self.ansible.apply(variables)
    }

    /// Applies the role, which must succeed, and returns whether it changed the host.
    pub(crate) fn changed(&self, variables: &Value) -> Result<bool> {
        let output = self.apply(variables)?;
        let text = all(&output);
        ensure!(
            output.status.success() && text.contains("failed=0"),
            "{text}{}",
            self.host.text("journalctl --unit ros2probe --output cat")?
        );
        Ok(!text.contains("changed=0"))
    }
}

fn with(variables: &Value, key: &str, value: Value) -> Value {
    let mut variables = variables.clone();
    variables[key] = value;
    variables
}

/// Returns the configuration that the role has written.
fn written(host: &Debian) -> Result<Value> {
    Ok(serde_yaml::from_str(&host.run(&format!("cat {CONFIG}"))?)?)
}

#[test]
fn the_role_installs_configures_and_reloads_the_agent() -> Result<()> {
    let directory = tempfile::tempdir()?;
    let package = installable(directory.path())?;
    let robot = Managed::start(directory.path())?;
    let host = &robot.host;
    host.run("useradd pilot")?;
    let variables = json!({
        "ros2probe_package": package,
        "ros2probe_configuration": {"watch": ["/scan"]},
        "ros2probe_members": ["pilot"],
    });
    ensure!(robot.changed(&variables)?, "nothing was installed");
    let active = || host.text("systemctl is-active ros2probe.service");
    ensure!(active()?.trim() == "active", "{}", active()?);
    ensure!(host.run("id -nG pilot")?.contains("ros2probe"));
    ensure!(written(host)? == json!({"watch": ["/scan"]}));
    ensure!(!robot.changed(&variables)?, "a second run changed the host");

    // The same process applies another configuration.
    let process = || host.run("systemctl show --property MainPID --value ros2probe");
    let before = process()?;
    let other = json!({"watch": ["/scan", "/imu"]});
    ensure!(robot.changed(&with(&variables, "ros2probe_configuration", other.clone()))?);
    ensure!(process()? == before, "the agent was restarted");
    wait_until("a reload", || {
        let log = host.run("journalctl --unit ros2probe --output cat")?;
        Ok(log.contains("the configuration was reloaded"))
    })?;

    // An invalid one changes nothing.
    let wrong = json!({"wach": []});
    let output = robot.apply(&with(&variables, "ros2probe_configuration", wrong))?;
    ensure!(
        !output.status.success() && all(&output).contains("wach: unknown key"),
        "{}",
        all(&output)
    );
    ensure!(written(host)? == other);
    ensure!(active()?.trim() == "active", "{}", active()?);

    robot.changed(&with(&variables, "ros2probe_enabled", json!(false)))?;
    ensure!(active()?.trim() == "inactive", "{}", active()?);

    // The user of the host stays, outside the group that is gone.
    let absent = json!({"ros2probe_state": "absent"});
    ensure!(robot.changed(&absent)?, "nothing was removed");
    host.run(
        "for path in /usr/bin/rp /etc/ros2probe /var/lib/ros2probe /var/cache/ros2probe_*; do \
         ! test -e $path || exit 1; done; \
         ! getent passwd ros2probe && ! getent group ros2probe && id pilot",
    )?;
    ensure!(!robot.changed(&absent)?, "a second run changed the host");
    let misspelled = robot.apply(&json!({"ros2probe_state": "gone"}))?;
    ensure!(
        !misspelled.status.success() && all(&misspelled).contains("to present or absent"),
        "{}",
        all(&misspelled)
    );
    Ok(())
}

#[test]
fn the_role_requires_one_source_of_the_package() -> Result<()> {
    for (variables, enough) in [
        (json!({}), false),
        (
            json!({"ros2probe_package": "a", "ros2probe_repository": "b"}),
            false,
        ),
        (json!({"ros2probe_repository": "b"}), false),
        (json!({"ros2probe_package": "a"}), true),
    ] {
        let directory = tempfile::tempdir()?;
        let mut playbook = Command::new("ansible-playbook");
        playbook.args(["--inventory", "localhost,", "--connection", "local"]);
        // Only the check of the variables runs.
        playbook.args([
            "--start-at-task",
            "Check that one source of the package is set",
            "--check",
        ]);
        playbook.args(["--extra-vars", &variables.to_string()]);
        playbook.arg(repository("deploy/ansible/site.yaml"));
        playbook.env("ANSIBLE_HOME", directory.path());
        let output = playbook.output().context("ansible-playbook")?;
        let refused = all(&output).contains("Set either ros2probe_package");
        ensure!(refused != enough, "{variables}: {}", all(&output));
    }
    Ok(())
}
