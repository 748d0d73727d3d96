//! The functions of ros2cli's daemons of all distributions. A client calls only the functions of
//! its own distribution, so additional functions do no harm.

use std::fmt::Write as _;

use ros2probe_message::Dialect;
use ros2probe_wire::DomainId;

use super::call::{Argument, Call};
use super::endpoint_info::{Classes, EndpointType};
use super::graph::{ActionEnds, Endpoints, Graph, Names, NodeEnds, ServiceEnds, Side, parts};
use super::value::{Fault, Value};

/// Maximum number of endpoints in one answer; each endpoint takes 3 KB.
pub(super) const MAX_ENDPOINTS: usize = 1024;
/// Number of functions.
pub(super) const FUNCTION_COUNT: usize = 30;
/// Label of requests for other functions.
pub(super) const UNKNOWN_LABEL: &str = "unknown";

/// Facts about a client, determined only if an answer depends on them.
pub(super) trait Caller {
    /// Returns the distribution whose classes the client knows.
    fn dialect(&self) -> Dialect;

    /// Returns the RMW implementation of the client.
    fn rmw_implementation(&self) -> String;
}

/// A request with the facts that its answer needs.
pub(super) struct Query<'a> {
    /// Graph of the domain.
    pub(super) graph: Graph<'a>,
    /// The domain.
    pub(super) domain_id: DomainId,
    /// Name of the node that the daemon would have.
    pub(super) name: &'a str,
    /// The client.
    pub(super) caller: &'a dyn Caller,
}

/// A function.
pub(super) struct Function {
    /// Name of the function.
    pub(super) name: &'static str,
    /// Names of the function's parameters.
    parameters: &'static [&'static str],
    /// Name of an additional parameter, a boolean that `ros2` never sends.
    flag: Option<&'static str>,
    help: &'static str,
    answer: Answer,
}

/// Computes an answer from the arguments, one for each parameter.
type Answer = fn(&Query<'_>, &[&str]) -> Result<Value, Fault>;

/// Creates a function without a flag.
const fn function(
    name: &'static str,
    parameters: &'static [&'static str],
    help: &'static str,
    answer: Answer,
) -> Function {
    Function {
        name,
        parameters,
        flag: None,
        help,
        answer,
    }
}

impl Function {
    const fn flag(mut self, name: &'static str) -> Self {
        self.flag = Some(name);
        self
    }

    /// Returns the function with this name.
    pub(super) fn find(name: &str) -> Option<&'static Self> {
        ALL.iter().find(|function| function.name == name)
    }

    /// Returns the index of the function in [`ALL`], for counters.
    pub(super) fn index(name: &str) -> Option<usize> {
        ALL.iter().position(|function| function.name == name)
    }

    fn arguments<'a>(&self, call: &'a Call) -> Result<Vec<&'a str>, Fault> {
        let (least, given) = (self.parameters.len(), call.arguments.len());
        let most = least + usize::from(self.flag.is_some());
        if given < least {
            return Err(self.missing(self.parameters.get(given..).unwrap_or_default()));
        }
        if given > most {
            return Err(self.too_many_arguments(least, most, given));
        }
        if let Some(Argument::Boolean(true)) = call.arguments.get(least) {
            let flag = self.flag.unwrap_or_default();
            return Err(Fault::new("NotImplementedError", format!("{flag}=True")));
        }
        let texts = call
            .arguments
            .iter()
            .take(least)
            .map(|argument| match argument {
                Argument::Text(text) => Ok(text.as_str()),
                _ => Err(Fault::new("TypeError", "an argument is not a string")),
            });
        texts.collect()
    }

    /// Returns Python's exception for missing arguments.
    fn missing(&self, parameters: &[&str]) -> Fault {
        let quoted: Vec<_> = parameters.iter().map(|name| format!("'{name}'")).collect();
        let plural = if quoted.len() == 1 { "" } else { "s" };
        let (name, count, names) = (self.name, quoted.len(), quoted.join(" and "));
        Fault::new(
            "TypeError",
            format!("Node.{name}() missing {count} required positional argument{plural}: {names}"),
        )
    }

    /// Returns Python's exception for too many arguments, which counts `self`.
    fn too_many_arguments(&self, least: usize, most: usize, given: usize) -> Fault {
        let mut takes = String::new();
        let _ = match least == most {
            true => write!(takes, "{}", most + 1),
            false => write!(takes, "from {} to {}", least + 1, most + 1),
        };
        let (name, given) = (self.name, given + 1);
        let plural = if most == 0 { "" } else { "s" };
        Fault::new(
            "TypeError",
            format!(
                "Node.{name}() takes {takes} positional argument{plural} but {given} were given"
            ),
        )
    }
}

/// Answers a call.
///
/// # Errors
///
/// Returns the fault of ros2cli's daemon if the function, a node or an argument does not exist.
pub(super) fn answer(call: &Call, query: &Query<'_>) -> Result<Value, Fault> {
    let Some(function) = Function::find(&call.method) else {
        let text = format!("method \"{}\" is not supported", call.method);
        return Err(Fault::new("Exception", text));
    };
    let arguments = function.arguments(call)?;
    (function.answer)(query, &arguments)
}

const NODE_ARGUMENTS: &[&str] = &["node_name", "node_namespace"];
const TOPIC_ARGUMENTS: &[&str] = &["topic_name"];
const SERVICE_ARGUMENTS: &[&str] = &["service_name"];
const ACTION_ARGUMENTS: &[&str] = &["action_name"];

/// All functions, sorted by name as `system.listMethods` returns them.
pub(super) const ALL: [Function; FUNCTION_COUNT] = [
    function(
        "count_action_clients",
        ACTION_ARGUMENTS,
        "Return the number of clients of an action.",
        |query, arguments| Ok(Value::count(query.action(arguments, Side::Client)?.len())),
    ),
    function(
        "count_action_servers",
        ACTION_ARGUMENTS,
        "Return the number of servers of an action.",
        |query, arguments| Ok(Value::count(query.action(arguments, Side::Server)?.len())),
    ),
    function(
        "count_clients",
        SERVICE_ARGUMENTS,
        "Return the number of clients of a service.",
        |query, arguments| {
            let name = full_name(arguments, "service")?;
            Ok(Value::count(query.graph.count_clients(&name)))
        },
    ),
    function(
        "count_publishers",
        TOPIC_ARGUMENTS,
        "Return the number of publishers on a topic.",
        |query, arguments| {
            Ok(Value::count(
                query.ends(arguments, Endpoints::Writers)?.len(),
            ))
        },
    ),
    function(
        "count_services",
        SERVICE_ARGUMENTS,
        "Return the number of servers of a service.",
        |query, arguments| {
            let (name, dialect) = (full_name(arguments, "service")?, query.caller.dialect());
            Ok(Value::count(query.graph.count_servers(&name, dialect)))
        },
    ),
    function(
        "count_subscribers",
        TOPIC_ARGUMENTS,
        "Return the number of subscriptions on a topic.",
        |query, arguments| {
            Ok(Value::count(
                query.ends(arguments, Endpoints::Readers)?.len(),
            ))
        },
    ),
    function(
        "get_action_client_names_and_types_by_node",
        NODE_ARGUMENTS,
        "Get the actions that a node calls.",
        |query, arguments| {
            let node = query.node(arguments, "action client");
            Ok(names(&node?.actions(Side::Client)))
        },
    ),
    function(
        "get_action_clients_info_by_action",
        ACTION_ARGUMENTS,
        "Return the clients of an action.",
        |query, arguments| query.action_info(arguments, Side::Client),
    ),
    function(
        "get_action_names_and_types",
        &[],
        "Get the names and types of all actions.",
        |query, _| Ok(names(&query.graph.actions())),
    ),
    function(
        "get_action_server_names_and_types_by_node",
        NODE_ARGUMENTS,
        "Get the actions that a node offers.",
        |query, arguments| {
            let node = query.node(arguments, "action server");
            Ok(names(&node?.actions(Side::Server)))
        },
    ),
    function(
        "get_action_servers_info_by_action",
        ACTION_ARGUMENTS,
        "Return the servers of an action.",
        |query, arguments| query.action_info(arguments, Side::Server),
    ),
    function(
        "get_client_names_and_types_by_node",
        NODE_ARGUMENTS,
        "Get the services that a node calls.",
        |query, arguments| {
            let node = query.node(arguments, "client");
            Ok(names(&node?.services(Side::Client)))
        },
    ),
    function(
        "get_clients_info_by_service",
        SERVICE_ARGUMENTS,
        "Return the clients of a service.",
        |query, arguments| query.service_info(arguments, Side::Client),
    ),
    function(
        "get_daemon_configuration",
        &[],
        "Return the domain and the RMW implementation of the answers.",
        |query, _| {
            let domain_id = i32::try_from(query.domain_id.0).unwrap_or(i32::MAX);
            let rmw = query.caller.rmw_implementation();
            Ok(Value::Struct(vec![
                ("ros_domain_id", Value::Integer(domain_id)),
                ("rmw_implementation", Value::Text(rmw)),
            ]))
        },
    ),
    function("get_name", &[], "Get the name of the node.", |query, _| {
        Ok(Value::text(query.name))
    }),
    function(
        "get_namespace",
        &[],
        "Get the namespace of the node.",
        |_, _| Ok(Value::text("/")),
    ),
    function(
        "get_node_names_and_namespaces",
        &[],
        "Get the names and namespaces of all nodes.",
        |query, _| {
            let nodes = query.graph.nodes().map(|node| {
                let (namespace, name) = parts(&node.name);
                Value::array([name, namespace].map(Value::text))
            });
            Ok(Value::array(nodes))
        },
    ),
    function(
        "get_node_names_and_namespaces_with_enclaves",
        &[],
        "Get the names, namespaces and enclaves of all nodes.",
        |query, _| {
            let nodes = query.graph.nodes().map(|node| {
                let (namespace, name) = parts(&node.name);
                let enclave = query.graph.enclave(node.participant.prefix);
                Value::array([name, namespace, enclave.unwrap_or_default()].map(Value::text))
            });
            Ok(Value::array(nodes))
        },
    ),
    function(
        "get_publisher_names_and_types_by_node",
        NODE_ARGUMENTS,
        "Get the topics that a node publishes.",
        |query, arguments| {
            let node = query.node(arguments, "publisher");
            Ok(names(&node?.topics(Endpoints::Writers)))
        },
    )
    .flag("no_demangle"),
    function(
        "get_publishers_info_by_topic",
        TOPIC_ARGUMENTS,
        "Return the publishers on a topic.",
        |query, arguments| query.topic_info(arguments, Endpoints::Writers),
    )
    .flag("no_mangle"),
    function(
        "get_servers_info_by_service",
        SERVICE_ARGUMENTS,
        "Return the servers of a service.",
        |query, arguments| query.service_info(arguments, Side::Server),
    ),
    function(
        "get_service_names_and_types",
        &[],
        "Get the names and types of all services.",
        |query, _| Ok(names(&query.graph.services())),
    ),
    function(
        "get_service_names_and_types_by_node",
        NODE_ARGUMENTS,
        "Get the services that a node offers.",
        |query, arguments| {
            let node = query.node(arguments, "service");
            Ok(names(&node?.services(Side::Server)))
        },
    ),
    function(
        "get_subscriber_names_and_types_by_node",
        NODE_ARGUMENTS,
        "Get the topics that a node subscribes to.",
        |query, arguments| {
            let node = query.node(arguments, "subscriber");
            Ok(names(&node?.topics(Endpoints::Readers)))
        },
    )
    .flag("no_demangle"),
    function(
        "get_subscriptions_info_by_topic",
        TOPIC_ARGUMENTS,
        "Return the subscriptions on a topic.",
        |query, arguments| query.topic_info(arguments, Endpoints::Readers),
    )
    .flag("no_mangle"),
    function(
        "get_topic_names_and_types",
        &[],
        "Get the names and types of all topics.",
        |query, _| Ok(names(&query.graph.topics())),
    )
    .flag("no_demangle"),
    function(
        "system.listMethods",
        &[],
        "Return the names of all functions.",
        |_, _| {
            let names = ALL.iter().map(|function| Value::text(function.name));
            Ok(Value::array(names))
        },
    ),
    function(
        "system.methodHelp",
        &["method_name"],
        "Return the description of a function.",
        |_, arguments| {
            let function = arguments.first().and_then(|name| Function::find(name));
            Ok(Value::text(function.map_or("", |function| function.help)))
        },
    ),
    function(
        "system.methodSignature",
        &["method_name"],
        "Return the signature of a function.",
        |_, _| Ok(Value::text("signatures not supported")),
    ),
    // The listener releases its port after this call.
    function(SHUTDOWN, &[], "Release the port.", |_, _| Ok(Value::Nil)),
];

/// The function that releases the port.
pub(super) const SHUTDOWN: &str = "system.shutdown";

impl<'a> Query<'a> {
    fn node(&self, arguments: &[&str], what: &str) -> Result<NodeEnds<'a>, Fault> {
        let [name, namespace] = arguments else {
            return Err(Fault::new("TypeError", "two arguments are needed"));
        };
        self.graph.node(name, namespace).ok_or_else(|| {
            if what.starts_with("action") {
                let text = format!("Failed to get {what} names and type: error not set");
                return Fault::new("rclpy._rclpy_pybind11.RCLError", text);
            }
            let text =
                format!("cannot get {what} names and types for nonexistent node: error not set");
            Fault::new("rclpy._rclpy_pybind11.NodeNameNonExistentError", text)
        })
    }

    fn ends(
        &self,
        arguments: &[&str],
        ends: Endpoints,
    ) -> Result<Vec<&'a ros2probe_model::report::snapshot::EndpointFacts>, Fault> {
        Ok(self.graph.endpoints(&full_name(arguments, "topic")?, ends))
    }

    fn topic_info(&self, arguments: &[&str], ends: Endpoints) -> Result<Value, Fault> {
        let kind = match ends {
            Endpoints::Writers => EndpointType::Publisher,
            Endpoints::Readers => EndpointType::Subscription,
        };
        let endpoints = bounded(self.ends(arguments, ends)?)?;
        let classes = self.classes();
        let endpoints = endpoints.into_iter();
        Ok(Value::array(
            endpoints.map(|endpoint| classes.topic(endpoint, kind)),
        ))
    }

    fn service_info(&self, arguments: &[&str], side: Side) -> Result<Value, Fault> {
        let name = full_name(arguments, "service")?;
        let found: Vec<ServiceEnds<'_>> = bounded(self.graph.service(&name, side))?;
        let classes = self.classes();
        let found = found.into_iter();
        Ok(Value::array(found.map(|ends| classes.service(ends, side))))
    }

    fn action(&self, arguments: &[&str], side: Side) -> Result<Vec<ActionEnds<'a>>, Fault> {
        Ok(self.graph.action(&full_name(arguments, "action")?, side))
    }

    fn action_info(&self, arguments: &[&str], side: Side) -> Result<Value, Fault> {
        let found = bounded(self.action(arguments, side)?)?;
        let classes = self.classes();
        let found = found.into_iter();
        Ok(Value::array(found.map(|ends| classes.action(ends, side))))
    }

    fn classes(&self) -> Classes<'a> {
        Classes {
            graph: self.graph,
            dialect: self.caller.dialect(),
        }
    }
}

/// Returns the endpoints, or a fault if they exceed [`MAX_ENDPOINTS`].
fn bounded<T>(endpoints: Vec<T>) -> Result<Vec<T>, Fault> {
    let count = endpoints.len();
    if count <= MAX_ENDPOINTS {
        return Ok(endpoints);
    }
    let text = format!("{count} endpoints; an answer has room for {MAX_ENDPOINTS}");
    Err(Fault::new("MemoryError", text))
}

/// Returns the full name of a topic, service or action. The daemon's node is in the root namespace.
fn full_name(arguments: &[&str], what: &str) -> Result<String, Fault> {
    let name = arguments.first().copied().unwrap_or_default();
    let is_allowed =
        |character: char| character.is_ascii_alphanumeric() || "_/".contains(character);
    let starts_with_digit = |token: &str| token.starts_with(|first: char| first.is_ascii_digit());
    let relative = name.strip_prefix('/').unwrap_or(name);
    let mut tokens = relative.split('/');
    if !name.chars().all(is_allowed)
        || tokens.any(|token| token.is_empty() || starts_with_digit(token))
    {
        let text = format!("{what} name '{name}' is invalid: {what} name is invalid");
        return Err(Fault::new("ValueError", text));
    }
    Ok(format!("/{relative}"))
}

fn names(names: &Names<'_>) -> Value {
    let entries = names.iter().map(|(name, types)| {
        let types = types.iter().map(|each| Value::text(each));
        Value::array([Value::text(name), Value::array(types)])
    });
    Value::array(entries)
}
