//! Text and numbers that are safe to print on a terminal.
//!
//! Names come from the network, so only printable ASCII passes. No name can move the cursor or
//! change colours, and every character is one column wide.

/// Maximum length of a name, in characters. Longer names are truncated.
const MAX_CHARACTERS: usize = 256;

/// Escapes all characters of `text` other than printable ASCII.
#[must_use]
pub fn escaped(text: &str) -> String {
    let mut shown = String::with_capacity(text.len().min(MAX_CHARACTERS));
    for (at, character) in text.chars().enumerate() {
        if at == MAX_CHARACTERS {
            shown.push_str("...");
            break;
        }
        match character {
            ' '..='~' => shown.push(character),
            _ => shown.extend(character.escape_default()),
        }
    }
    shown
}

/// Returns the beginning of `text` in at most `width` columns; `mark` replaces the cut part.
#[must_use]
pub fn beginning(text: &str, width: usize, mark: char) -> String {
    if text.chars().count() <= width {
        return text.to_owned();
    }
    let mut cut: String = text.chars().take(width.saturating_sub(1)).collect();
    if width > 0 {
        cut.push(mark);
    }
    cut
}

/// Returns the end of `text` in at most `width` columns, since names differ most at their ends.
#[must_use]
pub fn end(text: &str, width: usize, mark: char) -> String {
    let length = text.chars().count();
    if length <= width {
        return text.to_owned();
    }
    let kept = text
        .chars()
        .skip(length.saturating_sub(width.saturating_sub(1)));
    let marks = (width > 0).then_some(mark);
    marks.into_iter().chain(kept).take(width).collect()
}

/// Formats a rate in at most six columns.
#[must_use]
pub fn rate(hertz: f64) -> String {
    match hertz {
        0.0 => "0".to_owned(),
        hertz if hertz < 9.995 => format!("{hertz:.2}"),
        hertz if hertz < 9_999.95 => format!("{hertz:.1}"),
        hertz if hertz < 999_950.0 => format!("{:.1}k", hertz / 1e3),
        hertz => format!("{:.0}k", hertz / 1e3),
    }
}

/// Formats an expected rate without needless digits.
#[must_use]
pub fn bound(hertz: f64) -> String {
    let text = format!("{hertz:.2}");
    let text = text.trim_end_matches('0').trim_end_matches('.');
    text.to_owned()
}

/// Formats bytes, or bytes per second, in at most six columns and in the decimal units of `ros2
/// topic bw`.
#[must_use]
pub fn bytes(bytes: f64) -> String {
    if bytes < 999.5 {
        return format!("{bytes:.0}B");
    }
    let mut scaled = bytes;
    for unit in ['K', 'M', 'G'] {
        scaled /= 1e3;
        if scaled < 999.95 {
            return format!("{scaled:.1}{unit}");
        }
    }
    format!("{:.0}T", scaled / 1e3)
}

/// Formats a duration in at most five columns.
#[must_use]
pub fn seconds(seconds: f64) -> String {
    match seconds {
        0.0 => "0".to_owned(),
        seconds if seconds < 999.5e-6 => format!("{:.0}us", seconds * 1e6),
        seconds if seconds < 9.95e-3 => format!("{:.1}ms", seconds * 1e3),
        seconds if seconds < 0.9995 => format!("{:.0}ms", seconds * 1e3),
        seconds if seconds < 99.95 => format!("{seconds:.1}s"),
        seconds if seconds < 9_999.5 => format!("{seconds:.0}s"),
        seconds if seconds < 3_599_640.0 => format!("{:.0}h", seconds / 3_600.0),
        _ => ">999h".to_owned(),
    }
}

/// Formats a ratio in at most five columns. Only 0 is `0%`, and only 1 is `100%`.
#[must_use]
pub fn ratio(ratio: f64) -> String {
    match ratio {
        0.0 => "0%".to_owned(),
        ratio if ratio < 0.001 => "<0.1%".to_owned(),
        ratio if ratio >= 1.0 => "100%".to_owned(),
        ratio if ratio >= 0.9995 => ">99.9".to_owned(),
        ratio => format!("{:.1}%", ratio * 100.0),
    }
}

/// Returns a count with its noun.
#[must_use]
pub fn counted(count: u64, noun: &str) -> String {
    let plural = if count == 1 { "" } else { "s" };
    format!("{count} {noun}{plural}")
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn a_hostile_name_cannot_control_the_terminal() {
        let hostile = "/a\x1b[2J\x1b]0;title\x07\r\n\t\u{9b}31m\u{202e}gpj\u{200b}\u{7f}\u{fffd}";
        let shown = escaped(hostile);
        assert!(shown.chars().all(|each| (' '..='~').contains(&each)));
        assert!(
            shown.starts_with(r"/a\u{1b}[2J\u{1b}]0;title\u{7}\r\n\t\u{9b}31m"),
            "{shown}"
        );
        assert_eq!(escaped("/camera/front"), "/camera/front");
        assert_eq!(escaped(&"x".repeat(10_000)).len(), MAX_CHARACTERS + 3);
    }

    #[test]
    fn truncated_text_shows_a_mark() {
        assert_eq!(beginning("/camera/front", 7, '~'), "/camer~");
        assert_eq!(end("/camera/front", 7, '~'), "~/front");
        for width in [0, 1, 13, 20] {
            assert!(beginning("/camera/front", width, '~').len() <= width);
            assert!(end("/camera/front", width, '~').len() <= width);
        }
        assert_eq!(end("/imu", 4, '~'), "/imu");
    }

    #[test]
    fn numbers_are_short_and_have_a_unit() {
        let rates = [0.0, 0.5, 9.999, 200.04, 1_000.0, 54_321.0].map(rate);
        assert_eq!(rates, ["0", "0.50", "10.0", "200.0", "1000.0", "54.3k"]);
        let sizes = [0.0, 320.0, 999.6, 54.3e6, 2.7e9, 4e13].map(bytes);
        assert_eq!(sizes, ["0B", "320B", "1.0K", "54.3M", "2.7G", "40T"]);
        let times = [0.0, 15e-6, 1.2e-3, 0.0499, 0.9999, 61.0, 7_300.0, 1e5].map(seconds);
        assert_eq!(
            times,
            [
                "0", "15us", "1.2ms", "50ms", "1.0s", "61.0s", "7300s", "28h"
            ]
        );
        let ratios = [0.0, 1e-9, 0.123, 0.9999, 1.0].map(ratio);
        assert_eq!(ratios, ["0%", "<0.1%", "12.3%", ">99.9", "100%"]);
        assert_eq!([190.0, 0.5, 12.25].map(bound), ["190", "0.5", "12.25"]);
    }

    proptest! {
        #[test]
        fn numbers_are_no_wider_than_their_columns(value in 0.0_f64..1e12) {
            prop_assert!(rate(value.min(1e8)).len() <= 7, "{}", rate(value));
            prop_assert!(bytes(value).len() <= 6, "{}", bytes(value));
            prop_assert!(seconds(value).len() <= 5, "{}", seconds(value));
            prop_assert!(ratio(value.min(1.0)).len() <= 5);
            let small = value / 1e12;
            prop_assert!(seconds(small).len() <= 5 && ratio(small).len() <= 5);
            prop_assert!(rate(value % 1e5).len() <= 6);
        }
    }
}
