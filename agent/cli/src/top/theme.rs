//! Appearance on this terminal: with or without colours, in UTF-8 or ASCII. The text carries all
//! information; colours and attributes only emphasize it.

use ratatui::style::{Color, Modifier, Style};

/// Abilities of the terminal.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Theme {
    /// Whether characters beyond ASCII are shown.
    pub unicode: bool,
    /// Whether colours are shown.
    pub colours: bool,
}

/// Style of a piece of text.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Kind {
    /// Plain text.
    #[default]
    Plain,
    /// Heading of the lines below.
    Heading,
    /// Problem that needs attention.
    Problem,
    /// Text of lesser interest.
    Faint,
    /// Selected line.
    Selected,
}

impl Theme {
    /// Reads the theme from environment variables: the locale as in libc, and
    /// <https://no-color.org>.
    #[must_use]
    pub fn of(variable: impl Fn(&str) -> Option<String>) -> Self {
        let set = |name: &&str| variable(name).is_some_and(|value| !value.is_empty());
        let locale = ["LC_ALL", "LC_CTYPE", "LANG"]
            .into_iter()
            .find(|it| set(it));
        let locale = locale.and_then(&variable).unwrap_or_default();
        let locale = locale.to_ascii_lowercase().replace('-', "");
        let terminal = variable("TERM").unwrap_or_default();
        Self {
            unicode: locale.contains("utf8") && terminal != "linux",
            colours: !set(&"NO_COLOR") && !matches!(terminal.as_str(), "" | "dumb" | "vt100"),
        }
    }

    /// Returns the character that replaces cut text.
    #[must_use]
    pub const fn cut(self) -> char {
        if self.unicode { '…' } else { '~' }
    }

    /// Returns the character of the line above a pane.
    #[must_use]
    pub const fn rule(self, is_focused: bool) -> char {
        match (self.unicode, is_focused) {
            (true, true) => '═',
            (true, false) => '─',
            (false, true) => '=',
            (false, false) => '-',
        }
    }

    /// Returns a bar for `part` of `width` columns, with at least one character unless `part` is 0.
    #[must_use]
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        clippy::cast_precision_loss,
        reason = "columns of a terminal"
    )]
    pub fn bar(self, part: f64, width: usize) -> String {
        const EIGHTHS: [&str; 8] = ["", "▏", "▎", "▍", "▌", "▋", "▊", "▉"];
        let part = part.clamp(0.0, 1.0);
        if !self.unicode {
            let length = (part * width as f64).round() as usize;
            return "#".repeat(length.max(usize::from(part > 0.0)));
        }
        let eighths = (part * width as f64 * 8.0).round() as usize;
        let eighths = eighths.max(usize::from(part > 0.0));
        let rest = EIGHTHS.get(eighths % 8).copied().unwrap_or_default();
        "█".repeat(eighths / 8) + rest
    }

    /// Returns the style of this kind of text.
    #[must_use]
    pub const fn style(self, kind: Kind) -> Style {
        let style = Style::new();
        match kind {
            Kind::Plain => style,
            Kind::Heading => style.add_modifier(Modifier::BOLD),
            Kind::Problem if self.colours => style.fg(Color::Red).add_modifier(Modifier::BOLD),
            Kind::Problem => style.add_modifier(Modifier::BOLD),
            Kind::Faint => style.add_modifier(Modifier::DIM),
            Kind::Selected => style.add_modifier(Modifier::REVERSED),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn theme(variables: &[(&str, &str)]) -> Theme {
        Theme::of(|name| {
            let mut all = variables.iter();
            let (_, value) = all.find(|(key, _)| *key == name)?;
            Some((*value).to_owned())
        })
    }

    #[test]
    fn the_locale_enables_unicode_and_no_color_disables_colours() {
        let xterm = ("TERM", "xterm-256color");
        let utf = theme(&[xterm, ("LANG", "en_US.UTF-8")]);
        assert_eq!((utf.unicode, utf.colours), (true, true));
        assert!(theme(&[xterm, ("LC_ALL", "C.utf8"), ("LANG", "C")]).unicode);
        assert!(!theme(&[xterm, ("LC_ALL", "C"), ("LANG", "en_US.UTF-8")]).unicode);
        assert!(!theme(&[xterm]).unicode);
        assert!(!theme(&[xterm, ("NO_COLOR", "1")]).colours);
        assert!(theme(&[xterm, ("NO_COLOR", "")]).colours);
        assert!(!theme(&[("TERM", "dumb")]).colours);
        let plain = theme(&[xterm, ("NO_COLOR", "1")]).style(Kind::Problem);
        assert_eq!((plain.fg, plain.bg), (None, None));
    }

    #[test]
    fn a_bar_of_a_tiny_part_has_one_character() {
        let ascii = Theme::default();
        let bars = [0.0, 1e-9, 0.5, 1.0].map(|part| ascii.bar(part, 4));
        assert_eq!(bars, ["", "#", "##", "####"]);
        let unicode = Theme {
            unicode: true,
            ..ascii
        };
        let bars = [0.0, 1e-9, 0.4, 1.0].map(|part| unicode.bar(part, 4));
        assert_eq!(bars, ["", "▏", "█▋", "████"]);
    }
}
