//! Help about keys, on a screen of 80x24.

use super::details::Styled;
use super::theme::Kind;

const HELP: &str = "\
rp top: a robot's topics as its agent sees them     any key: back

 up down k j       select a topic         PgUp PgDn Home End g G   by pages
 / text            only names, types or states with this text; Esc: as before
 p                 only topics with problems (! in STATE)
 m                 only topics that are measured
 h                 also hidden topics and those of services
 s < >  or 1 to 9  sort by the next column, or by this one      r   reverse
 Enter d           details of the selected topic
 e                 events                 v   warnings only
 Tab               next pane: arrows scroll it      z   give it the screen
 w                 measure the selected topic while rp top runs (+); again: stop
 W                 keep measuring it after rp top ends (=)
 Esc               one step back          q Ctrl-C   quit

 HZ B/S     of the last seconds          WANTED   what a watch expects of HZ
 LOSS       of 30 s, of the subscriber that lost most
 MED P99    from the writer's timestamp to the capture; the known offset
            of clocks is added           P/S      publishers/subscribers
 LATE       late calls of callbacks in the last minute: rp why
 STATE      ok, quiet (no message), no pub, no sub, unwatched (not measured),
            gone; with !: slow fast late loss silent against what is expected,
            qos type hash: endpoints do not match; unseen: agent is blind here";

/// Returns the lines of the help.
#[must_use]
pub fn lines() -> Vec<Styled> {
    let kind = |at: usize| if at == 0 { Kind::Heading } else { Kind::Plain };
    let lines = HELP.lines().enumerate();
    lines
        .map(|(at, line)| (line.to_owned(), kind(at)))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_help_fits_a_screen_of_80_by_24() {
        let lines = lines();
        assert!(lines.len() <= 24, "{}", lines.len());
        for (line, _) in lines {
            assert!(
                line.is_ascii() && line.len() <= 80,
                "{}: {line}",
                line.len()
            );
        }
    }
}
