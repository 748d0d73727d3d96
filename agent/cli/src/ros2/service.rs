//! `ros2 service`: `list` and `info`; `type` and `find` are those of topics.

use std::fmt::Write as _;

use ros2probe_api::names::ServiceName;
use ros2probe_api::services::Service;

use super::{Dialect, Refused};

/// Options of `service list`.
#[derive(Clone, Copy, Debug, Default)]
pub struct List {
    /// Whether types are printed.
    pub show_types: bool,
    /// Whether only the number of services is printed.
    pub count: bool,
}

/// Returns the text of `service list` for these services.
#[must_use]
pub fn list<'a>(services: impl Iterator<Item = &'a ServiceName<'a>>, options: List) -> String {
    if options.count {
        return format!("{}\n", services.count());
    }
    let mut text = String::new();
    for service in services {
        let _ = if options.show_types {
            writeln!(text, "{} [{}]", service.name, service.types.join(", "))
        } else {
            writeln!(text, "{}", service.name)
        };
    }
    text
}

/// Returns the text of `service info`. A server is counted by its reply writer, in later
/// distributions by its request reader.
///
/// # Errors
///
/// Fails if the service does not exist.
pub fn info<'a>(
    name: &str,
    mut services: impl Iterator<Item = &'a ServiceName<'a>>,
    dialect: Dialect,
) -> Result<String, Refused> {
    let service = services.find(|service| service.name == name);
    let service = service.ok_or_else(|| Refused(format!("Unknown service '{name}'")))?;
    let types = match service.types.as_slice() {
        [only] => only.to_string(),
        several => format!("['{}']", several.join("', '")),
    };
    let servers = if dialect < Dialect::Rolling {
        service.reply_writers
    } else {
        service.request_readers
    };
    let clients = service.reply_readers;
    Ok(format!(
        "Type: {types}\nClients count: {clients}\nServices count: {servers}\n"
    ))
}

/// Returns the text about the calls of a service, which `service info -v` appends.
#[must_use]
pub fn calls(service: &Service<'_>) -> String {
    let mut text = match &service.calls {
        None => "Calls: none seen\n".to_owned(),
        Some(calls) => {
            let mut text = format!(
                "Calls: {}\n  Answered: {}\n  Unanswered: {}\n  Hanging: {}\n",
                calls.requests, calls.answered, calls.unanswered, calls.hanging
            );
            let quantiles = [
                ("p50", calls.latency_p50_seconds),
                ("p99", calls.latency_p99_seconds),
            ];
            for (name, seconds) in quantiles {
                if let Some(seconds) = seconds {
                    let _ = writeln!(text, "  Latency {name}: {:.3} ms", seconds * 1e3);
                }
            }
            if calls.suspended {
                text.push_str("  Suspended: its messages exceed 4 MiB/s\n");
            }
            text
        }
    };
    if !service.unseen.is_empty() {
        let paths = service.unseen.join(", ").replace('_', " ");
        let _ = writeln!(text, "Calls not seen: through {paths}");
    }
    text
}

#[cfg(test)]
mod tests {
    use ros2probe_api::services::Calls;

    use super::*;

    fn services() -> [ServiceName<'static>; 2] {
        let service = |name: &'static str, hidden| ServiceName {
            name: name.into(),
            hidden,
            types: vec!["a/srv/Add".into()],
            request_readers: 2,
            reply_writers: 1,
            reply_readers: 3,
            ..ServiceName::default()
        };
        [
            service("/add", false),
            service("/fib/_action/send_goal", true),
        ]
    }

    #[test]
    fn a_list_prints_names_or_their_number() {
        let printed = |show_types, count| list(services().iter(), List { show_types, count });
        assert_eq!(printed(false, false), "/add\n/fib/_action/send_goal\n");
        assert_eq!(
            printed(true, false),
            "/add [a/srv/Add]\n/fib/_action/send_goal [a/srv/Add]\n"
        );
        assert_eq!(printed(true, true), "2\n");
    }

    #[test]
    fn calls_and_the_transports_of_unobserved_calls_are_printed() {
        let mut service = Service {
            unseen: vec!["shared_memory".into()],
            ..Service::default()
        };
        assert_eq!(
            calls(&service),
            "Calls: none seen\nCalls not seen: through shared memory\n"
        );
        service.unseen.clear();
        service.calls = Some(Calls {
            requests: 10,
            answered: 8,
            unanswered: 2,
            hanging: 1,
            latency_p50_seconds: Some(0.0042),
            latency_p99_seconds: Some(0.0101),
            ..Calls::default()
        });
        assert_eq!(
            calls(&service),
            "Calls: 10\n  Answered: 8\n  Unanswered: 2\n  Hanging: 1\n  Latency p50: 4.200 ms\n  \
             Latency p99: 10.100 ms\n"
        );
    }

    #[test]
    fn servers_are_counted_by_replies_and_in_rolling_by_requests() {
        let printed = |dialect| info("/add", services().iter(), dialect).unwrap();
        for dialect in [Dialect::Jazzy, Dialect::Kilted] {
            let text = "Type: a/srv/Add\nClients count: 3\nServices count: 1\n";
            assert_eq!(printed(dialect), text);
        }
        assert!(printed(Dialect::Rolling).ends_with("Services count: 2\n"));
        let refused = info("/x", services().iter(), Dialect::Jazzy).unwrap_err();
        assert_eq!(refused.0, "Unknown service '/x'");
    }
}
