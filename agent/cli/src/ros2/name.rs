//! Names of topics and types on the command line.

use super::Refused;
use ros2probe_message::Kind;

/// Returns the full name of a topic. A relative name is in the root namespace, as in ros2cli.
///
/// # Errors
///
/// Fails if the name is invalid. The text marks the invalid character, as in ros2cli.
pub fn full_name(typed: &str) -> Result<String, Refused> {
    let name = if typed.is_empty() || typed.starts_with('/') {
        typed.to_owned()
    } else {
        format!("/{typed}")
    };
    match mistake(&name) {
        None => Ok(name),
        Some((why, at)) => Err(Refused(format!(
            "Invalid topic name: {why}:\n  '{name}'\n   {:at$}^",
            ""
        ))),
    }
}

/// Returns the full name of a type. As in ros2cli, a name of two parts has this kind:
/// `std_msgs/String` is `std_msgs/msg/String`. Other names are returned as they are.
#[must_use]
pub fn full_type(typed: &str, kind: Kind) -> String {
    match typed.split_once('/') {
        Some((package, name)) if !name.contains('/') => {
            format!("{package}/{}/{name}", kind.as_str())
        }
        _ => typed.to_owned(),
    }
}

/// Returns whether a part of the name begins with an underscore. Such names are shown only with an
/// option.
#[must_use]
pub fn is_hidden(name: &str) -> bool {
    name.split('/').any(|token| token.starts_with('_'))
}

/// Returns whether the node's own name begins with an underscore; its namespace does not matter.
#[must_use]
pub fn is_hidden_node(name: &str) -> bool {
    name.rsplit('/')
        .next()
        .is_some_and(|name| name.starts_with('_'))
}

/// Returns the first mistake of a name, with the index of its character; `None` for a valid name.
fn mistake(name: &str) -> Option<(&'static str, usize)> {
    if name.is_empty() {
        return Some(("topic name must not be empty", 0));
    }
    let length = name.chars().count();
    let allowed = |character: char| character.is_ascii_alphanumeric() || "_/".contains(character);
    if let Some(at) = name.chars().position(|character| !allowed(character)) {
        let why = "topic name must not contain characters other than alphanumerics, '_', or '/'";
        return Some((why, at));
    }
    if name.ends_with('/') {
        let why = "topic name must not end with a '/'";
        return Some((why, length.saturating_sub(1)));
    }
    if let Some(at) = name.find("//") {
        return Some(("topic name must not contain repeated '/'", at + 1));
    }
    let mut before = '/';
    for (at, character) in name.chars().enumerate() {
        if before == '/' && character.is_ascii_digit() {
            return Some(("topic name token must not start with a number", at));
        }
        before = character;
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_its_own_name_hides_a_node() {
        assert!(is_hidden("/fib/_action/status") && is_hidden("/_a/b") && !is_hidden("/a_/b"));
        assert!(is_hidden_node("/a/_ros2cli_1") && !is_hidden_node("/_a/b"));
    }

    #[test]
    fn a_relative_name_is_in_the_root_namespace() {
        for (typed, name) in [
            ("/robot1/imu", "/robot1/imu"),
            ("chatter", "/chatter"),
            ("robot1/imu_2", "/robot1/imu_2"),
            ("/_hidden", "/_hidden"),
        ] {
            assert_eq!(full_name(typed).as_deref(), Ok(name));
        }
    }

    #[test]
    fn a_type_of_two_parts_has_the_kind_of_the_command() {
        for (typed, kind, name) in [
            ("std_msgs/String", Kind::Message, "std_msgs/msg/String"),
            ("std_srvs/Empty", Kind::Service, "std_srvs/srv/Empty"),
            ("a/Fibonacci", Kind::Action, "a/action/Fibonacci"),
            ("a/srv/B", Kind::Message, "a/srv/B"),
            ("a/b/c/D", Kind::Message, "a/b/c/D"),
            ("String", Kind::Message, "String"),
        ] {
            assert_eq!(full_type(typed, kind), name);
        }
    }

    #[test]
    fn an_invalid_name_is_printed_with_the_position_of_the_mistake() {
        let refused = full_name("/foo bar").unwrap_err().0;
        let expected = "Invalid topic name: topic name must not contain characters other than \
            alphanumerics, '_', or '/':\n  '/foo bar'\n       ^";
        assert_eq!(refused, expected);
        for (typed, at) in [
            ("", 0),
            ("/", 0),
            ("/a/", 2),
            ("/a//b", 3),
            ("/a/2b", 3),
            ("é", 1),
        ] {
            let refused = full_name(typed).unwrap_err().0;
            assert!(refused.ends_with(&format!("\n   {:at$}^", "")), "{refused}");
        }
    }
}
