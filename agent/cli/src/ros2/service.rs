//! `ros2 service`: `list` and `info`; `type` and `find` are those of topics.

use std::fmt::Write as _;

use ros2probe_api::names::ServiceName;

use super::{Dialect, Refused};

/// Options of `service list`.
#[derive(Clone, Copy, Debug, Default)]
pub struct List {
    /// Print types.
    pub show_types: bool,
    /// Print only the number of services.
    pub count: bool,
}

/// Text of `service list` for these services.
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

/// Text of `service info`. A server is counted by its reply writer, in later distributions by its
/// request reader.
///
/// # Errors
///
/// The service does not exist.
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

#[cfg(test)]
mod tests {
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
    fn a_list_is_names_or_their_number() {
        let said = |show_types, count| list(services().iter(), List { show_types, count });
        assert_eq!(said(false, false), "/add\n/fib/_action/send_goal\n");
        assert_eq!(
            said(true, false),
            "/add [a/srv/Add]\n/fib/_action/send_goal [a/srv/Add]\n"
        );
        assert_eq!(said(true, true), "2\n");
    }

    #[test]
    fn servers_are_counted_by_their_replies_and_later_by_requests() {
        let said = |dialect| info("/add", services().iter(), dialect).unwrap();
        for dialect in [Dialect::Jazzy, Dialect::Kilted] {
            let text = "Type: a/srv/Add\nClients count: 3\nServices count: 1\n";
            assert_eq!(said(dialect), text);
        }
        assert!(said(Dialect::Rolling).ends_with("Services count: 2\n"));
        let refused = info("/x", services().iter(), Dialect::Jazzy).unwrap_err();
        assert_eq!(refused.0, "Unknown service '/x'");
    }
}
