//! `rp completions` and `rp man`: the command table for shells and for `man`.

use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::{Context as _, Result};
use clap::{Args, CommandFactory as _};
use clap_complete::Shell;

use super::{Arguments, Output};

/// `rp completions SHELL`.
#[derive(Args, Debug)]
#[command(after_help = "\
Examples:
  rp completions bash > /etc/bash_completion.d/rp
  rp completions zsh > /usr/local/share/zsh/site-functions/_rp
  rp completions fish > ~/.config/fish/completions/rp.fish")]
pub(crate) struct Completions {
    /// Shell
    #[arg(value_enum)]
    shell: Shell,
}

/// `rp man [DIR]`.
#[derive(Args, Debug)]
#[command(after_help = "\
Examples:
  rp man | man -l -
  rp man /usr/local/share/man/man1")]
pub(crate) struct Manual {
    /// Directory for one page per command: rp.1, rp-topic.1, rp-topic-list.1, ... [default: print
    /// the page of `rp` to stdout]
    #[arg(value_name = "DIR")]
    directory: Option<PathBuf>,
}

impl Completions {
    pub(crate) fn print(&self) -> Result<ExitCode> {
        let mut script = Vec::new();
        clap_complete::generate(self.shell, &mut Arguments::command(), "rp", &mut script);
        Output::new().write_bytes(&script)?;
        Ok(ExitCode::SUCCESS)
    }
}

impl Manual {
    pub(crate) fn print(&self) -> Result<ExitCode> {
        // `help` would add a second page for each command.
        let command = Arguments::command().disable_help_subcommand(true);
        match &self.directory {
            Some(directory) => clap_mangen::generate_to(command, directory)
                .with_context(|| format!("cannot write pages to {}", directory.display()))?,
            None => {
                let mut page = Vec::new();
                clap_mangen::Man::new(command).render(&mut page)?;
                Output::new().write_bytes(&page)?;
            }
        }
        Ok(ExitCode::SUCCESS)
    }
}
