//! Globs over topic names: `*` matches any characters within a token, `**` matches whole tokens.
//!
//! Matching allocates nothing. Within a token it takes time proportional to the product of both
//! lengths. The tokens between two `**` are tried at each token of the name. A pattern needs no
//! more memory than its text, even if it is hostile.

/// Separates two groups of tokens.
const ANY_TOKENS: &str = "/**";

/// Returns whether `pattern` covers `name`. Both are absolute, or begin with the same prefix before
/// the first slash, as DDS names do (`rq/**`). The result is unspecified for patterns that
/// [`crate::facts::watch::check_pattern`] rejects.
///
/// A final `**` covers at least one token; elsewhere it also covers none. `/a/**` does not cover
/// `/a`, and `/a/**/b` covers `/a/b`.
#[must_use]
pub fn covers(pattern: &str, name: &str) -> bool {
    let beginning = |text: &str| text.find('/').unwrap_or(text.len());
    let (prefix, pattern) = pattern.split_at(beginning(pattern));
    let (head, name) = name.split_at(beginning(name));
    covers_token(prefix, head) && covers_tokens(pattern, name)
}

/// Returns whether `pattern` covers the whole `text`: `*` matches any characters, slashes included.
#[must_use]
pub fn covers_text(pattern: &str, text: &str) -> bool {
    covers_token(pattern, text)
}

fn covers_tokens(pattern: &str, name: &str) -> bool {
    let Some((first, others)) = pattern.split_once(ANY_TOKENS) else {
        return strip_tokens(name, pattern) == Some("");
    };
    let Some(mut rest) = strip_tokens(name, first) else {
        return false;
    };
    let (between, last) = others.rsplit_once(ANY_TOKENS).unwrap_or(("", others));
    if last.is_empty() {
        // The final `**` covers the last tokens; the groups before it match the others.
        let Some(end) = rest.rfind('/') else {
            return false;
        };
        let (before, _) = rest.split_at(end);
        return strip_runs(before, between).is_some();
    }
    let Some(end) = last_tokens(rest, last.matches('/').count()) else {
        return false;
    };
    let (before, after) = rest.split_at(end);
    rest = before;
    strip_tokens(after, last) == Some("") && strip_runs(rest, between).is_some()
}

/// Returns the rest of `name` after the first positions at which the groups of `runs` match in
/// order.
fn strip_runs<'a>(name: &'a str, runs: &str) -> Option<&'a str> {
    let mut rest = name;
    for run in runs.split(ANY_TOKENS).filter(|run| !run.is_empty()) {
        loop {
            if let Some(after) = strip_tokens(rest, run) {
                rest = after;
                break;
            }
            let (_, after) = strip_token(rest)?;
            rest = after;
        }
    }
    Some(rest)
}

/// Returns the rest of `name` if its first tokens match those of `run`.
fn strip_tokens<'a>(name: &'a str, run: &str) -> Option<&'a str> {
    let mut rest = name;
    for pattern in run.split('/').skip(1) {
        let (token, after) = strip_token(rest)?;
        if !covers_token(pattern, token) {
            return None;
        }
        rest = after;
    }
    Some(rest)
}

/// Returns the first token of `name` without its slash, and the rest.
fn strip_token(name: &str) -> Option<(&str, &str)> {
    let name = name.strip_prefix('/')?;
    let end = name.find('/').unwrap_or(name.len());
    Some(name.split_at(end))
}

/// Returns the offset of the last `count` tokens of `name`.
fn last_tokens(name: &str, count: usize) -> Option<usize> {
    let mut slashes = name.rmatch_indices('/').map(|(at, _)| at);
    slashes.nth(count.checked_sub(1)?)
}

/// Returns whether `pattern`, in which `*` matches any characters, covers the whole `token`.
fn covers_token(pattern: &str, token: &str) -> bool {
    let Some((first, others)) = pattern.split_once('*') else {
        return pattern == token;
    };
    let (between, last) = others.rsplit_once('*').unwrap_or(("", others));
    let Some(mut rest) = token
        .strip_prefix(first)
        .and_then(|rest| rest.strip_suffix(last))
    else {
        return false;
    };
    for part in between.split('*').filter(|part| !part.is_empty()) {
        let Some((_, after)) = rest.split_once(part) else {
            return false;
        };
        rest = after;
    }
    true
}

#[cfg(test)]
mod tests {
    use globset::GlobBuilder;
    use proptest::prelude::*;

    use super::*;
    use crate::facts::watch::check_pattern;

    /// Matches with an independent implementation, which builds an automaton.
    fn reference(pattern: &str, name: &str) -> bool {
        let glob = GlobBuilder::new(pattern).literal_separator(true).build();
        glob.unwrap().compile_matcher().is_match(name)
    }

    #[test]
    fn a_star_matches_characters_and_a_double_star_matches_tokens() {
        for (pattern, name, expected) in [
            ("/points", "/points", true),
            ("/points", "/points2", false),
            ("/*", "/points", true),
            ("/*", "/a/points", false),
            ("/cam*/raw", "/camera/raw", true),
            ("/*a*b*", "/xxaxxbxx", true),
            ("/*a*b*", "/xxbxxaxx", false),
            ("/a*a", "/a", false),
            ("/a*a", "/aa", true),
            ("/**", "/a", true),
            ("/**", "/a/b/c", true),
            ("/**", "rq/addRequest", false),
            ("rq/**", "rq/addRequest", true),
            ("rq/**", "/addRequest", false),
            ("/a/**", "/a", false),
            ("/a/**", "/a/b", true),
            ("/a/**/b", "/a/b", true),
            ("/a/**/b", "/a/x/y/b", true),
            ("/a/**/b", "/a/x/y/c", false),
            ("/a/**/b/c", "/a/b/c/b/c", true),
            ("/**/b/**/b", "/b", false),
            ("/**/b/**/b", "/b/b", true),
            ("/**/x/*/**", "/a/x/b", false),
            ("/**/x/*/**", "/a/x/b/c", true),
        ] {
            assert_eq!(covers(pattern, name), expected, "{pattern} {name}");
            assert_eq!(reference(pattern, name), expected, "{pattern} {name}");
        }
    }

    #[test]
    fn a_pattern_full_of_stars_is_matched_in_a_short_time() {
        let pattern = format!("/{}", "*a".repeat(127));
        let name = format!("/{}b", "a".repeat(253));
        // A backtracking matcher would not finish here, and an automaton would take megabytes.
        assert!(!covers(&pattern, &name));
    }

    proptest! {
        #[test]
        fn any_pattern_matches_the_same_names_as_an_automaton(
            pattern in "(/(\\*\\*|[ab*]{1,4})){1,6}",
            name in "[ab]{0,2}(/[ab]{0,4}){0,7}",
        ) {
            prop_assume!(check_pattern(&pattern).is_ok());
            // Two adjacent `**` mean the same as one.
            prop_assume!(!pattern.contains("/**/**"));
            prop_assert_eq!(covers(&pattern, &name), reference(&pattern, &name));
        }

        #[test]
        fn arbitrary_names_and_patterns_do_not_panic(pattern in ".{0,40}", name in ".{0,40}") {
            let _ = covers(&pattern, &name);
        }
    }
}
