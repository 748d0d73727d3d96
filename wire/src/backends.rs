//! Backends of `rosidl::Buffer`, which endpoints of types with an unbounded `uint8[]` announce from
//! Lyrical on.
//!
//! A publisher sends such a message as CDR to subscriptions that accept `cpu` only. To the others it
//! sends references to buffers of a backend, for example in the memory of a GPU.

use alloc::boxed::Box;
use alloc::string::String;
use alloc::vec::Vec;

use crate::discovery::UserData;

/// Maximum number of backends that are kept of an endpoint.
const MAX_BACKENDS: usize = 4;
/// Maximum length of a name in bytes.
const MAX_NAME: usize = 32;
/// The backend of plain memory, which each endpoint with buffers supports.
const CPU: &str = "cpu";
/// Key in user data for one backend (`rmw_fastrtps` 9.4.8 and later).
const KEY: &str = "bufbe.";
/// Start of the list in user data until `rmw_fastrtps` 9.4.7.
const LIST: &str = "BUFBE:";
/// Start of the list in a token of `rmw_zenoh`.
const TOKEN: &str = "backends:";

/// The backends that an endpoint accepts, sorted, with `cpu`.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Backends(Box<[Box<str>]>);

impl Backends {
    /// Returns the backends of these names, the first [`MAX_BACKENDS`] of them. Names that are too
    /// long or not plain text are left out.
    #[must_use]
    pub fn of<'a>(names: impl Iterator<Item = &'a str>) -> Self {
        let is_name = |name: &&str| {
            !name.is_empty()
                && name.len() <= MAX_NAME
                && crate::text::is_plain(name)
                && *name != CPU
        };
        let mut names: Vec<Box<str>> = names
            .filter(is_name)
            .take(MAX_BACKENDS)
            .map(Into::into)
            .collect();
        names.push(CPU.into());
        names.sort_unstable();
        names.dedup();
        Self(names.into())
    }

    /// Parses the user data of an endpoint of Fast DDS: pairs `bufbe.<name>=<data>;`, or until 9.4.7
    /// a list `BUFBE:<name>=<data>;..`. Returns `None` without either.
    #[must_use]
    pub fn of_user_data(user_data: UserData<'_>) -> Option<Self> {
        let mut keys = user_data.keys_after(KEY).peekable();
        if keys.peek().is_some() {
            return Some(Self::of(keys));
        }
        let entries = user_data.after(LIST)?.split(';');
        Some(Self::of(
            entries.filter_map(|entry| Some(entry.split_once('=')?.0)),
        ))
    }

    /// Parses the last chunk of a liveliness token: `backends:<name>:<data>;..`, in which `%`, `:`,
    /// `;` and `/` of a name are written as `%25` and so on. Returns `None` for other chunks.
    #[must_use]
    pub fn of_token(chunk: &str) -> Option<Self> {
        let entries = chunk.strip_prefix(TOKEN)?.split(';');
        let names: Vec<String> = entries
            .take(2 * MAX_BACKENDS)
            .map(|entry| unescaped(entry.split(':').next().unwrap_or_default()))
            .collect();
        Some(Self::of(names.iter().map(String::as_str)))
    }

    /// Returns the names, sorted.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.0.iter().map(|name| &**name)
    }

    /// Returns whether it accepts a backend other than `cpu`.
    #[must_use]
    pub fn is_accelerated(&self) -> bool {
        self.0.len() > 1
    }

    /// Returns the backends other than `cpu` that both sides accept.
    pub fn shared<'a>(&'a self, other: &'a Self) -> impl Iterator<Item = &'a str> {
        self.names()
            .filter(|name| *name != CPU && other.names().any(|each| each == *name))
    }
}

/// Replaces `%` and two hexadecimal digits by their character.
fn unescaped(text: &str) -> String {
    let mut plain = String::with_capacity(text.len());
    let mut rest = text;
    while let Some((before, after)) = rest.split_once('%') {
        plain.push_str(before);
        let escaped = after
            .get(..2)
            .and_then(|digits| u8::from_str_radix(digits, 16).ok())
            .filter(u8::is_ascii);
        rest = match escaped {
            Some(byte) => {
                plain.push(char::from(byte));
                after.get(2..).unwrap_or_default()
            }
            None => after,
        };
    }
    plain.push_str(rest);
    plain
}

#[cfg(test)]
mod tests {
    use std::vec::Vec;

    use super::*;

    fn names(backends: Option<Backends>) -> Vec<std::string::String> {
        let backends = backends.map(|backends| backends.names().map(Into::into).collect());
        backends.unwrap_or_default()
    }

    fn user_data(text: &str) -> Vec<std::string::String> {
        names(Backends::of_user_data(UserData::new(text.as_bytes())))
    }

    #[test]
    fn backends_in_user_data_are_read_in_both_spellings() {
        assert_eq!(user_data("typehash=x;bufbe.cpu=;"), ["cpu"]);
        assert_eq!(
            user_data("typehash=x;bufbe.cuda=a:b;bufbe.cpu=;\0"),
            ["cpu", "cuda"]
        );
        assert_eq!(user_data("typehash=x;BUFBE:cpu="), ["cpu"]);
        assert_eq!(
            user_data("typehash=x;BUFBE:torch=t;cuda=;cpu="),
            ["cpu", "cuda", "torch"]
        );
        let with_publisher = "typehash=x;BUFBE:cpu=PGID:010f0a";
        assert_eq!(user_data(with_publisher), ["cpu"]);
        assert_eq!(user_data("typehash=x;"), Vec::<&str>::new());
    }

    #[test]
    fn backends_in_a_token_are_read() {
        let token = |text| names(Backends::of_token(text));
        assert_eq!(token("backends:cpu:"), ["cpu"]);
        assert_eq!(token("backends:cuda:v=1;cpu:"), ["cpu", "cuda"]);
        assert_eq!(token("backends:a%3ab:;cpu:"), ["a:b", "cpu"]);
        assert_eq!(token("backends:%zz:%"), ["cpu", "zz"]);
        assert_eq!(token("backends:"), ["cpu"]);
        assert_eq!(token("other"), Vec::<&str>::new());
    }

    #[test]
    fn many_and_long_names_are_bounded() {
        let many = (0..100).map(|number| std::format!("bufbe.b{number}=;"));
        assert_eq!(
            user_data(&many.collect::<std::string::String>()).len(),
            MAX_BACKENDS + 1
        );
        assert_eq!(
            user_data(&std::format!("bufbe.{}=;", "x".repeat(33))),
            ["cpu"]
        );
    }

    #[test]
    fn two_sides_share_backends_other_than_cpu() {
        let of = |list: &[&str]| Backends::of(list.iter().copied());
        let (one, other) = (of(&["cuda", "torch"]), of(&["cpu", "cuda"]));
        assert_eq!(one.shared(&other).collect::<Vec<_>>(), ["cuda"]);
        assert!(one.is_accelerated() && !of(&["cpu"]).is_accelerated());
        assert_eq!(one.shared(&of(&[])).count(), 0);
    }
}
