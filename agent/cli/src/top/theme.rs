//! How things look on this terminal: with or without colours, in UTF-8 or ASCII. What matters is said
//! in words; attributes and colours only repeat it.

use ratatui::style::{Color, Modifier, Style};

/// What the terminal can show.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Theme {
    /// Characters beyond ASCII.
    pub unicode: bool,
    /// Colours.
    pub colours: bool,
}

/// What a piece of text is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Kind {
    /// As it is.
    #[default]
    Plain,
    /// Names what is below.
    Heading,
    /// Deserves attention.
    Problem,
    /// Of less interest.
    Faint,
    /// Where the keys go.
    Selected,
}

impl Theme {
    /// By the environment, given as a function: locale as libc finds it, and <https://no-color.org>.
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

    /// Stands for text that is cut off.
    #[must_use]
    pub const fn cut(self) -> char {
        if self.unicode { '…' } else { '~' }
    }

    /// A line over a pane.
    #[must_use]
    pub const fn rule(self, is_focused: bool) -> char {
        match (self.unicode, is_focused) {
            (true, true) => '═',
            (true, false) => '─',
            (false, true) => '=',
            (false, false) => '-',
        }
    }

    /// A bar of `part` of `width` columns: at least a sign of what is more than nothing.
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

    /// How text of this kind is drawn.
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
    fn the_locale_decides_about_characters_and_no_color_about_colours() {
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
    fn a_bar_shows_that_there_is_something() {
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
