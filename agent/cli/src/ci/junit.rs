//! JUnit XML, as GitHub, GitLab and Jenkins read it: a suite for each group, a case for each
//! condition.

use std::io;

use quick_xml::Writer;
use quick_xml::events::{BytesDecl, BytesText, Event};
use ros2probe_daemon::escape::visible_lines;

use super::{Condition, Group, Run, Verdict};

/// Returns the file.
///
/// # Errors
///
/// Never fails in practice: the text is written to memory.
pub fn text(run: &Run, conditions: &[Condition]) -> io::Result<Vec<u8>> {
    let mut writer = Writer::new_with_indent(Vec::new(), b' ', 2);
    writer.write_event(Event::Decl(BytesDecl::new("1.0", Some("UTF-8"), None)))?;
    let all: Vec<&Condition> = conditions.iter().collect();
    let counts = Counts::of(&all);
    let seconds = format!("{:.3}", run.seconds);
    writer
        .create_element("testsuites")
        .with_attribute(("name", "rp ci"))
        .with_attributes(counts.attributes())
        .with_attribute(("time", seconds.as_str()))
        .write_inner_content(|writer| {
            for group in Group::ALL {
                suite(writer, run, group, &all)?;
            }
            Ok(())
        })?;
    let mut text = writer.into_inner();
    text.push(b'\n');
    Ok(text)
}

/// Numbers of conditions as texts.
struct Counts([(&'static str, String); 4]);

impl Counts {
    fn of(conditions: &[&Condition]) -> Self {
        let count = |verdict| {
            let same = conditions.iter().filter(|it| it.verdict == verdict);
            same.count().to_string()
        };
        Self([
            ("tests", conditions.len().to_string()),
            ("failures", count(Verdict::Failed)),
            ("errors", "0".to_owned()),
            ("skipped", count(Verdict::Skipped)),
        ])
    }

    fn attributes(&self) -> impl Iterator<Item = (&str, &str)> {
        self.0.iter().map(|(name, value)| (*name, value.as_str()))
    }
}

fn suite(
    writer: &mut Writer<Vec<u8>>,
    run: &Run,
    group: Group,
    all: &[&Condition],
) -> io::Result<()> {
    let members = all.iter().filter(|it| it.group == group).copied();
    let members: Vec<&Condition> = members.collect();
    if members.is_empty() {
        return Ok(());
    }
    let seconds = members.iter().map(|it| it.seconds).fold(0.0, f64::max);
    let seconds = format!("{seconds:.3}");
    let began = super::report::time(run.began);
    writer
        .create_element("testsuite")
        .with_attribute(("name", group.name()))
        .with_attributes(Counts::of(&members).attributes())
        .with_attribute(("time", seconds.as_str()))
        .with_attribute(("timestamp", began.trim_end_matches('Z')))
        .write_inner_content(|writer| members.iter().try_for_each(|each| case(writer, each)))?;
    Ok(())
}

fn case(writer: &mut Writer<Vec<u8>>, condition: &Condition) -> io::Result<()> {
    let class = format!("rp.ci.{}", condition.group.name());
    let seconds = format!("{:.3}", condition.seconds);
    let name = valid(&condition.name);
    let detail = valid(&condition.detail);
    let first = detail.lines().next().unwrap_or_default();
    writer
        .create_element("testcase")
        .with_attribute(("classname", class.as_str()))
        .with_attribute(("name", name.as_str()))
        .with_attribute(("time", seconds.as_str()))
        .write_inner_content(|writer| {
            match condition.verdict {
                Verdict::Failed => writer
                    .create_element("failure")
                    .with_attribute(("message", first))
                    .with_attribute(("type", condition.group.name()))
                    .write_text_content(BytesText::new(&detail))?,
                Verdict::Skipped => writer
                    .create_element("skipped")
                    .with_attribute(("message", first))
                    .write_empty()?,
                Verdict::Warned => writer
                    .create_element("system-out")
                    .write_text_content(BytesText::new(&format!("warning: {detail}")))?,
                Verdict::Passed => writer
                    .create_element("system-out")
                    .write_text_content(BytesText::new(&detail))?,
            };
            Ok(())
        })?;
    Ok(())
}

/// Returns the text without characters that XML 1.0 forbids. Control characters are escaped.
fn valid(text: &str) -> String {
    let text = visible_lines(text);
    let forbidden = |each: char| matches!(each, '\u{fffe}' | '\u{ffff}');
    text.chars()
        .map(|each| if forbidden(each) { '\u{fffd}' } else { each })
        .collect()
}

#[cfg(test)]
mod tests {
    use quick_xml::Reader;

    use super::*;

    #[test]
    fn hostile_names_are_escaped_and_read_back() {
        let condition = |group, name: &str, verdict| Condition {
            group,
            name: name.to_owned(),
            verdict,
            detail: "</failure>\u{1b}[2J \u{ffff} & \"<\"\nsecond ]]> line".to_owned(),
            seconds: 1.5,
        };
        let hostile = "/a\"><script>alert('1')</script>\u{0}&amp;";
        let conditions = [
            condition(Group::Command, "sh -c 'a < b'", Verdict::Passed),
            condition(Group::Observation, "completeness", Verdict::Warned),
            condition(Group::Expectations, hostile, Verdict::Skipped),
            condition(Group::Loss, hostile, Verdict::Failed),
        ];
        let run = Run {
            seconds: 12.0,
            ..Run::default()
        };
        let text = String::from_utf8(text(&run, &conditions).unwrap()).unwrap();
        let mut reader = Reader::from_str(&text);
        let (mut names, mut counts) = (Vec::new(), Vec::new());
        loop {
            match reader.read_event().unwrap() {
                Event::Start(tag) | Event::Empty(tag) => {
                    for attribute in tag.attributes() {
                        let attribute = attribute.unwrap();
                        let value = quick_xml::escape::unescape(&attribute.value).unwrap();
                        let value = value.into_owned();
                        match (tag.name().as_ref(), attribute.key.as_ref()) {
                            ("testcase", "name") => names.push(value),
                            ("testsuites", "tests" | "failures" | "skipped") => {
                                counts.push(value);
                            }
                            _ => {}
                        }
                    }
                }
                Event::Eof => break,
                _ => {}
            }
        }
        let shown = hostile.replace('\u{0}', "\\u{0}");
        assert_eq!(names, ["sh -c 'a < b'", "completeness", &shown, &shown]);
        assert_eq!(counts, ["4", "1", "1"]);
        // Readers of JUnit have no warnings: it is the output of a case that passed.
        assert!(text.contains("<system-out>warning: &lt;/failure"), "{text}");
        assert!(
            !text.contains("<script>") && !text.contains('\u{1b}'),
            "{text}"
        );
    }
}
