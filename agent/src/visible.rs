//! Text from outside on its way to a terminal: names and messages are anybody's, and a terminal
//! obeys what it is shown.

use std::borrow::Cow;

/// Control characters, and those that turn the direction of what follows, as escapes.
#[must_use]
pub fn visible(text: &str) -> Cow<'_, str> {
    escaped(text, commands)
}

/// Likewise of text that has lines: their ends and tabs stay.
#[must_use]
pub fn visible_lines(text: &str) -> Cow<'_, str> {
    escaped(text, |each| commands(each) && !matches!(each, '\n' | '\t'))
}

fn escaped(text: &str, hides: impl Fn(char) -> bool) -> Cow<'_, str> {
    if !text.contains(&hides) {
        return Cow::Borrowed(text);
    }
    let mut visible = String::with_capacity(text.len() + 8);
    for each in text.chars() {
        if hides(each) {
            match each {
                '\n' => visible.push_str("\\n"),
                '\r' => visible.push_str("\\r"),
                '\t' => visible.push_str("\\t"),
                each => visible.extend(each.escape_unicode()),
            }
        } else {
            visible.push(each);
        }
    }
    Cow::Owned(visible)
}

fn commands(each: char) -> bool {
    let turns =
        matches!(each, '\u{200e}' | '\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}');
    each.is_control() || turns
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_that_a_terminal_would_obey_is_left() {
        assert_eq!(
            visible("/a\u{1b}[2J\r\nb\u{202e}c"),
            r"/a\u{1b}[2J\r\nb\u{202e}c"
        );
        assert_eq!(visible_lines("a: \u{9b}1m\n\tb\r"), "a: \\u{9b}1m\n\tb\\r");
        for plain in ["", "/points", "Grüße 世界"] {
            assert!(matches!(visible(plain), Cow::Borrowed(same) if same == plain));
        }
    }
}
