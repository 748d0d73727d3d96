//! `rp service`.

use std::borrow::Cow;
use std::process::ExitCode;

use anyhow::Result;
use clap::{Args, Subcommand};
use ros2probe::client::Target;
use ros2probe::ros2::{service, topic};
use ros2probe_api::names::{Names, ServiceName};

use super::events::ServiceEcho;
use super::shared::{Graph, Spinning, answer, print_names, print_or_fail, print_text};

/// `rp service VERB`.
#[derive(Args, Debug)]
pub(crate) struct Service {
    /// Consider hidden services as well
    #[arg(long)]
    include_hidden_services: bool,
    #[command(subcommand)]
    verb: Option<Verb>,
}

#[derive(Debug, Subcommand)]
enum Verb {
    /// Print a list of services
    List(List),
    /// Print a service's type
    Type(Type),
    /// Print services of a type
    Find(Find),
    /// Print a service's type and the number of its servers and clients
    Info(Info),
    /// Print a service's requests and responses from its introspection
    Echo(Box<ServiceEcho>),
}

#[derive(Args, Debug)]
struct List {
    /// Also print the services' types
    #[arg(short = 't', long)]
    show_types: bool,
    /// Only print the number of services
    #[arg(short = 'c', long)]
    count_services: bool,
    /// Consider hidden services as well
    #[arg(long)]
    include_hidden_services: bool,
    #[command(flatten)]
    spinning: Spinning,
    #[command(flatten)]
    target: Target,
}

#[derive(Args, Debug)]
struct Type {
    /// Name of the service, e.g. /talker/list_parameters
    service_name: String,
    #[command(flatten)]
    target: Target,
}

#[derive(Args, Debug)]
struct Find {
    /// The type, e.g. rcl_interfaces/srv/ListParameters
    service_type: String,
    /// Only print the number of services
    #[arg(short = 'c', long)]
    count_services: bool,
    /// Consider hidden services as well
    #[arg(long)]
    include_hidden_services: bool,
    #[command(flatten)]
    target: Target,
}

#[derive(Args, Debug)]
struct Info {
    /// Name of the service, e.g. /talker/list_parameters
    service_name: String,
    /// Also print the number of calls and the time until their replies
    #[arg(short = 'v', long)]
    verbose: bool,
    #[command(flatten)]
    spinning: Spinning,
    #[command(flatten)]
    target: Target,
}

impl Service {
    pub(crate) fn run(self) -> Result<ExitCode> {
        let hidden = self.include_hidden_services;
        match self.verb {
            None => super::help(&["service"]),
            Some(Verb::List(list)) => list.ask(hidden),
            Some(Verb::Type(kind)) => kind.ask(hidden),
            Some(Verb::Find(find)) => find.ask(hidden),
            Some(Verb::Info(info)) => info.ask(hidden),
            Some(Verb::Echo(echo)) => echo.run(),
        }
    }
}

impl List {
    fn ask(self, hidden: bool) -> Result<ExitCode> {
        let names = Graph::reach(&self.target)?.names()?;
        let options = service::List {
            show_types: self.show_types,
            count: self.count_services,
        };
        let services = shown(&names, hidden || self.include_hidden_services);
        print_text(&service::list(services, options))
    }
}

impl Type {
    fn ask(self, hidden: bool) -> Result<ExitCode> {
        let found = Graph::reach(&self.target)?
            .find(|names| topic::type_of(&self.service_name, shown(names, hidden).map(typed)))?;
        print_or_fail(found.as_deref())
    }
}

impl Find {
    fn ask(self, hidden: bool) -> Result<ExitCode> {
        let hidden = hidden || self.include_hidden_services;
        let graph = Graph::reach(&self.target)?;
        let found = |names: &Names<'_>, count| {
            topic::find(&self.service_type, shown(names, hidden).map(typed), count)
        };
        print_names(&graph, self.count_services, found)
    }
}

impl Info {
    fn ask(self, hidden: bool) -> Result<ExitCode> {
        let graph = Graph::reach(&self.target)?;
        let dialect = self.target.dialect();
        let info =
            |names: &Names<'_>| service::info(&self.service_name, shown(names, hidden), dialect);
        let found = graph.find(|names| info(names).ok())?;
        let mut text = found.map_or_else(|| info(&Names::default()), Ok);
        if self.verbose
            && let Ok(text) = &mut text
        {
            let services = graph.services()?.services;
            let mut services = services.iter();
            if let Some(found) = services.find(|service| service.name == self.service_name) {
                text.push_str(&service::calls(found));
            }
        }
        answer(text)
    }
}

fn shown<'a>(names: &'a Names<'a>, hidden: bool) -> impl Iterator<Item = &'a ServiceName<'a>> {
    let services = names.services.iter();
    services.filter(move |service| hidden || !service.hidden)
}

fn typed<'a>(service: &'a ServiceName<'a>) -> (&'a str, &'a [Cow<'a, str>]) {
    (&service.name, &service.types)
}
