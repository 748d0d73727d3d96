//! Table of several topics.
//!
//! Columns are three spaces apart. Headings are centred; cells are left-aligned and padded,
//! including the last one. An empty line follows.

use std::fmt::Write as _;

/// Returns the text of the table; empty without rows.
#[must_use]
pub fn table<const COLUMNS: usize>(
    headings: [&str; COLUMNS],
    rows: &[[String; COLUMNS]],
) -> String {
    let mut text = String::new();
    if rows.is_empty() {
        return text;
    }
    let mut widths = headings.map(length);
    for row in rows {
        for (width, cell) in widths.iter_mut().zip(row) {
            *width = length(cell).max(*width);
        }
    }
    let centred = headings.iter().zip(widths);
    let centred: Vec<String> = centred.map(|(cell, width)| centre(cell, width)).collect();
    let full = widths.iter().sum::<usize>() + 3 * (COLUMNS.saturating_sub(1));
    let _ = writeln!(text, "{}\n{}", centred.join("   "), "=".repeat(full));
    for row in rows {
        let cells = row.iter().zip(widths);
        let cells: Vec<String> = cells
            .map(|(cell, width)| format!("{cell:<width$}"))
            .collect();
        let _ = writeln!(text, "{}", cells.join("   "));
    }
    text.push('\n');
    text
}

fn length(text: &str) -> usize {
    text.chars().count()
}

/// Centres a text like Python's `str.center`. For an odd remainder, the larger half is on the left
/// if the width is odd, and on the right if it is even.
fn centre(text: &str, width: usize) -> String {
    let room = width.saturating_sub(length(text));
    let left = room / 2 + (room & width & 1);
    let right = room.saturating_sub(left);
    format!("{:left$}{text}{:right$}", "", "")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_heading_is_centred_as_in_python() {
        // Results of `"ab".center(5)` and others.
        for (text, width, expected) in [
            ("ab", 5, "  ab "),
            ("abc", 6, " abc  "),
            ("abc", 7, "  abc  "),
            ("a", 4, " a  "),
            ("abc", 2, "abc"),
        ] {
            assert_eq!(centre(text, width), expected);
        }
    }

    #[test]
    fn cells_are_padded_to_the_width_of_the_column() {
        let row = |name: &str, rate: &str| [name.to_owned(), rate.to_owned()];
        let found = table(
            ["topic", "rate"],
            &[row("/a", "10.001"), row("/topic2", "1.0")],
        );
        let expected = " topic     rate \n\
            ================\n\
            /a        10.001\n\
            /topic2   1.0   \n\
            \n";
        assert_eq!(found, expected);
        assert_eq!(table(["topic", "rate"], &[]), "");
    }
}
