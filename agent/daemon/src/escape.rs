//! Escapes untrusted text for a terminal. Names and messages come from the network, and a terminal
//! interprets control sequences.

use std::borrow::Cow;

/// Escapes control characters and invisible characters.
#[must_use]
pub fn visible(text: &str) -> Cow<'_, str> {
    escaped(text, commands)
}

/// Does the same as [`visible`], but keeps line ends and tabs.
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
    each.is_control() || is_invisible(each)
}

/// Returns whether the character is invisible, changes the text direction or ends a line. These are
/// the categories Cf, Zl and Zp, and the default ignorable characters (Unicode 16,
/// DerivedCoreProperties.txt). The variation selectors U+FE00 to U+FE0F are excluded, since they
/// belong to emoji.
const fn is_invisible(each: char) -> bool {
    matches!(
        each,
        '\u{ad}'
            | '\u{34f}'
            | '\u{600}'..='\u{605}'
            | '\u{61c}'
            | '\u{6dd}'
            | '\u{70f}'
            | '\u{890}'..='\u{891}'
            | '\u{8e2}'
            | '\u{115f}'..='\u{1160}'
            | '\u{17b4}'..='\u{17b5}'
            | '\u{180b}'..='\u{180f}'
            | '\u{200b}'..='\u{200f}'
            | '\u{2028}'..='\u{202e}'
            | '\u{2060}'..='\u{206f}'
            | '\u{3164}'
            | '\u{feff}'
            | '\u{ffa0}'
            | '\u{fff0}'..='\u{fffb}'
            | '\u{110bd}'
            | '\u{110cd}'
            | '\u{13430}'..='\u{1343f}'
            | '\u{1bca0}'..='\u{1bca3}'
            | '\u{1d173}'..='\u{1d17a}'
            | '\u{e0000}'..='\u{e0fff}'
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_control_character_is_escaped() {
        assert_eq!(
            visible("/a\u{1b}[2J\r\nb\u{202e}c"),
            r"/a\u{1b}[2J\r\nb\u{202e}c"
        );
        assert_eq!(visible_lines("a: \u{9b}1m\n\tb\r"), "a: \\u{9b}1m\n\tb\\r");
        for hidden in [
            '\u{ad}',
            '\u{200b}',
            '\u{200d}',
            '\u{2028}',
            '\u{2060}',
            '\u{2064}',
            '\u{206f}',
            '\u{feff}',
            '\u{3164}',
            '\u{e0041}',
            '\u{e0100}',
        ] {
            let name = format!("/po{hidden}ints");
            let shown = format!("/po{}ints", hidden.escape_unicode());
            assert_eq!(visible(&name), shown);
            assert_eq!(visible_lines(&name), shown);
        }
        for plain in ["", "/points", "Grüße 世界", "\u{2600}\u{fe0f}", "e\u{301}"] {
            assert!(matches!(visible(plain), Cow::Borrowed(same) if same == plain));
        }
    }
}
