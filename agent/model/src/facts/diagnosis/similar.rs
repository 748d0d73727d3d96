//! Names of topics that differ so little that one of them is probably a mistake.

/// How two names differ.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Difference {
    /// Upper and lower case.
    Case,
    /// A slash is missing, or an underscore stands for it.
    Slash,
    /// The namespace.
    Namespace,
    /// One character, or two characters in the wrong order.
    Letter,
    /// Only the domains differ.
    Domain,
}

/// Minimum lengths of a part of a name between slashes, and of a word between underscores, in which
/// one letter may be a mistake.
const MIN_PART_LEN: usize = 4;
const MIN_WORD_LEN: usize = 3;

impl Difference {
    /// Returns the label value.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Case => "case",
            Self::Slash => "slash",
            Self::Namespace => "namespace",
            Self::Letter => "letter",
            Self::Domain => "domain",
        }
    }

    /// Returns the small difference of two fully qualified names, or `None` if they are equal or
    /// differ more. Names with other numbers, such as `/camera1` and `/camera2`, differ on purpose.
    #[must_use]
    pub fn of(one: &str, other: &str) -> Option<Self> {
        if one == other {
            return None;
        }
        if one.eq_ignore_ascii_case(other) {
            return Some(Self::Case);
        }
        if separators(one, other) {
            return Some(Self::Slash);
        }
        if is_within(one, other) || is_within(other, one) {
            return Some(Self::Namespace);
        }
        let (begin, left, right) = apart(one, other);
        let has_digit = |part: &str| part.bytes().any(|byte| byte.is_ascii_digit());
        if has_digit(left) || has_digit(right) {
            return None;
        }
        if is_one_letter(one.split_at(begin), (left, right)) {
            return Some(Self::Letter);
        }
        let base = |name: &str| name.rsplit_once('/').map(|(_, base)| base.to_owned());
        (base(one) == base(other)).then_some(Self::Namespace)
    }
}

/// Returns whether the names are equal without slashes, or with underscores in their place.
fn separators(one: &str, other: &str) -> bool {
    let joined = |name: &str| name.replace('/', "");
    let underscored = |name: &str| name.trim_start_matches('/').replace('/', "_");
    joined(one) == joined(other) || underscored(one) == underscored(other)
}

/// Returns whether `long` is `short` within a namespace.
fn is_within(short: &str, long: &str) -> bool {
    short.starts_with('/') && short.len() > 1 && long.ends_with(short)
}

/// Returns the length of the common beginning of both names, and their parts between it and their
/// common end.
fn apart<'a>(one: &'a str, other: &'a str) -> (usize, &'a str, &'a str) {
    let pairs = one.chars().zip(other.chars());
    let begin: usize = pairs
        .take_while(|(left, right)| left == right)
        .map(|(left, _)| left.len_utf8())
        .sum();
    let (one, other) = (
        one.get(begin..).unwrap_or_default(),
        other.get(begin..).unwrap_or_default(),
    );
    let pairs = one.chars().rev().zip(other.chars().rev());
    let end: usize = pairs
        .take_while(|(left, right)| left == right)
        .map(|(left, _)| left.len_utf8())
        .sum();
    let inner = |name: &'a str| name.get(..name.len() - end).unwrap_or_default();
    (begin, inner(one), inner(other))
}

/// Returns whether two names differ in one character, or in the order of two, within a part that is
/// long enough. `before` and `after` are the halves of one name, `left` and `right` what differs.
/// Single letters, as in `/goal_x` and `/goal_y`, differ on purpose.
fn is_one_letter((before, after): (&str, &str), (left, right): (&str, &str)) -> bool {
    let is_swapped = || {
        let mut swapped: Vec<char> = left.chars().collect();
        swapped.reverse();
        swapped.len() == 2 && swapped.into_iter().eq(right.chars())
    };
    let (count, others) = (left.chars().count(), right.chars().count());
    if count.max(others) != 1 && !is_swapped() {
        return false;
    }
    let length = |separators: &[char]| {
        let begin = before.rsplit(separators).next().map_or(0, str::len);
        begin + after.split(separators).next().map_or(0, str::len)
    };
    let is_separator = |part: &str| part.contains(['/', '_']);
    length(&['/']) >= MIN_PART_LEN
        && length(&['/', '_']) >= MIN_WORD_LEN
        && !is_separator(left)
        && !is_separator(right)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_small_difference_of_two_names_is_named() {
        for (one, other, expected) in [
            ("/scan", "/scan", None),
            ("/Scan", "/scan", Some(Difference::Case)),
            (
                "/camera/image_raw",
                "/camera_image_raw",
                Some(Difference::Slash),
            ),
            ("/robot/scan", "/robotscan", Some(Difference::Slash)),
            ("/scan", "/robot1/scan", Some(Difference::Namespace)),
            ("/front/scan", "/base/scan", Some(Difference::Namespace)),
            ("/cmd_vel", "/cmd_val", Some(Difference::Letter)),
            ("/odometry", "/odometery", Some(Difference::Letter)),
            ("/joint_states", "/joint_state", Some(Difference::Letter)),
            ("/robot/points", "/robto/points", Some(Difference::Letter)),
            ("/initialpose", "/start_pose", None),
            ("/camera1/image", "/camera2/image", None),
            ("/cmd_vel", "/cmd_vel2", None),
            ("/goal_x", "/goal_y", None),
            ("/tf", "/tg", None),
            ("/points", "/image", None),
            ("/größe", "/grösse", None),
            ("/größen", "/grüßen", Some(Difference::Letter)),
        ] {
            assert_eq!(Difference::of(one, other), expected, "{one} {other}");
            assert_eq!(Difference::of(other, one), expected, "{other} {one}");
        }
    }
}
