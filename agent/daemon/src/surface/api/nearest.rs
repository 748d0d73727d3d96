//! Suggestions for names that do not exist.

/// Maximum number of suggestions.
const MAX_SUGGESTIONS: usize = 3;
/// Maximum number of names compared.
const MAX_COMPARED: usize = 2000;

/// Returns "; did you mean ...?", or an empty string without a similar name.
pub(super) fn hint<'a>(wanted: &str, names: impl Iterator<Item = &'a str>) -> String {
    let near = nearest(wanted, names);
    if near.is_empty() {
        return String::new();
    }
    format!("; did you mean {}?", near.join(" or "))
}

/// Returns the most similar names, the nearest first.
fn nearest<'a>(wanted: &str, names: impl Iterator<Item = &'a str>) -> Vec<&'a str> {
    let limit = (wanted.len() / 4).clamp(2, 6);
    let near = names.take(MAX_COMPARED).filter_map(|name| {
        // The wanted name lacks a namespace, or has one too many.
        let is_end = name.ends_with(wanted) || wanted.ends_with(name);
        let steps = distance(wanted.as_bytes(), name.as_bytes(), limit);
        let steps = if is_end && name.len() > 1 {
            Some(steps.unwrap_or(1).min(1))
        } else {
            steps
        };
        steps.map(|steps| (steps, name))
    });
    let mut near: Vec<_> = near.collect();
    near.sort_unstable();
    near.dedup();
    near.truncate(MAX_SUGGESTIONS);
    near.into_iter().map(|(_, name)| name).collect()
}

/// Returns the edit distance in bytes, or `None` if it exceeds `limit`.
fn distance(one: &[u8], other: &[u8], limit: usize) -> Option<usize> {
    if one.len().abs_diff(other.len()) > limit {
        return None;
    }
    let mut row: Vec<usize> = (0..=other.len()).collect();
    for (index, wanted) in one.iter().enumerate() {
        let mut diagonal = index;
        let mut left = index + 1;
        let mut least = left;
        let mut next = Vec::with_capacity(row.len());
        next.push(left);
        for (found, above) in other.iter().zip(row.iter().skip(1)) {
            let replaced = diagonal + usize::from(wanted != found);
            diagonal = *above;
            left = replaced.min(above + 1).min(left + 1);
            least = least.min(left);
            next.push(left);
        }
        if least > limit {
            return None;
        }
        row = next;
    }
    row.last().copied().filter(|steps| *steps <= limit)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_typing_error_or_a_missing_namespace_leads_to_a_suggestion() {
        let names = ["/points", "/robot1/lidar/points", "/point", "/tf", "/"];
        assert_eq!(nearest("/poinst", names.into_iter()), ["/point", "/points"]);
        assert_eq!(
            nearest("/points", names.into_iter()),
            ["/points", "/point", "/robot1/lidar/points"]
        );
        assert_eq!(nearest("/camera", names.into_iter()), [""; 0]);
        assert_eq!(hint("/ft", ["/tf"].into_iter()), "; did you mean /tf?");
    }

    #[test]
    fn the_distance_of_two_names_is_their_levenshtein_distance() {
        for (one, other, expected) in [
            ("kitten", "sitting", Some(3)),
            ("", "ab", Some(2)),
            ("flaw", "lawn", Some(2)),
            ("abc", "abc", Some(0)),
            ("abcdef", "uvwxyz", None),
        ] {
            let found = distance(one.as_bytes(), other.as_bytes(), 4);
            assert_eq!(found, expected, "{one} {other}");
            assert_eq!(distance(other.as_bytes(), one.as_bytes(), 4), expected);
        }
    }
}
