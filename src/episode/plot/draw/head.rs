//! The head: file, verdict and reasons, and what is known about the episode.

use rapid_core::text;
use rapid_core::time::rfc3339;
use rapid_status::session::{Label, Notes};

use super::{MARGIN, WIDTH};
use crate::plot::svg::{Anchor, Px, Svg};
use crate::record::inspect::{FileEnd, Inspection};

/// Lines of reasons; the report has all of them.
const REASONS: usize = 8;
/// Lines of one text: a hostile one is not the whole picture.
const LINES: usize = 3;
/// Columns of a line of text, and of the name of the file.
const COLUMNS: usize = 160;
const NAME: usize = 84;

/// Draws it from the top; returns where the rest begins.
pub(super) fn draw(page: &mut Svg, report: &Inspection, noted: Option<&Notes>) -> f64 {
    let name = report.file.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    page.text("title", MARGIN, 44.0, Anchor::Start, &text::cut(&text::plain(&name), NAME, "…"));
    let word = report.verdict.grade().map_or("no verdict", rapid_status::Grade::word);
    let class = report.verdict.grade().map_or("none", rapid_status::Grade::word);
    let width = 24.0 + 9.6 * text::width(word) as f64;
    let left = Px(WIDTH - MARGIN - width);
    page.raw(format_args!(
        "<rect class=\"{class}\" x=\"{left}\" y=\"25\" width=\"{}\" height=\"26\" rx=\"13\"/>\n",
        Px(width)
    ));
    page.text("word", WIDTH - MARGIN - width / 2.0, 42.5, Anchor::Middle, word);
    let mut y = 46.0;
    let mut line = |class: &str, words: &str| {
        for line in wrapped(words, COLUMNS) {
            y += 20.0;
            page.text(class, MARGIN, y, Anchor::Start, &line);
        }
    };
    line("", &subject(report));
    line("faint", &facts(report));
    if let Some(noted) = noted {
        line("", &notes(noted));
    }
    let reasons = report.verdict.reasons();
    for reason in reasons.iter().take(REASONS) {
        line(class, &format!("• {reason}"));
    }
    if reasons.len() > REASONS {
        line(class, &format!("• and {} more, see `rapid inspect`", reasons.len() - REASONS));
    }
    y + 22.0
}

/// What was recorded where.
fn subject(report: &Inspection) -> String {
    let named = [("task", &report.task), ("rig", &report.rig)].into_iter().filter(|(_, value)| !value.is_empty());
    let mut words: Vec<_> = named.map(|(key, value)| format!("{key} {value}")).collect();
    words.extend(report.tags.iter().map(|(key, value)| format!("{key}={value}")));
    words.extend(report.policy.as_ref().map(|policy| format!("policy {}", policy.name)));
    words.join("  ·  ")
}

/// How much there is, and since when.
fn facts(report: &Inspection) -> String {
    let seconds = if report.seconds < 1e9 { format!("{:.1} s", report.seconds) } else { "? s".to_owned() };
    let end = match report.end {
        FileEnd::Finished => None,
        FileEnd::Unfinished | FileEnd::Torn => Some("not finished"),
        FileEnd::Damaged => Some("damaged"),
    };
    let sensors = report.verdict.verdict().map(rapid_status::Verdict::remarks).filter(|words| !words.is_empty());
    let begun = (report.begin_ns > 0).then(|| rfc3339(report.begin_ns).replace('T', " "));
    let begun = begun.map(|begun| format!("{} UTC", begun.split('.').next().unwrap_or_default()));
    let messages = text::counted(report.messages, "message");
    let frames = text::counted(report.frames, "frame");
    let words = [begun, Some(seconds), Some(text::size(report.bytes)), Some(messages), Some(frames), sensors];
    let words = words.into_iter().chain([end.map(str::to_owned)]).flatten();
    words.collect::<Vec<_>>().join("  ·  ")
}

fn notes(noted: &Notes) -> String {
    let label = noted.label.map(|label| match noted.label_reason.as_str() {
        "" => format!("label {}", Label::word(label)),
        reason => format!("label {}: {reason}", Label::word(label)),
    });
    let note = Some(noted.note.clone()).filter(|note| !note.is_empty());
    [label, note].into_iter().flatten().collect::<Vec<_>>().join("  ·  ")
}

/// `words` in lines of at most `columns`; a longer word is cut.
fn wrapped(words: &str, columns: usize) -> Vec<String> {
    let mut lines: Vec<String> = Vec::new();
    for word in text::plain(words).split(' ') {
        let word = text::cut(word, columns, "…");
        let is_last = lines.len() == LINES;
        match lines.last_mut() {
            Some(line) if text::width(line) + 1 + text::width(&word) <= columns => {
                line.push(' ');
                line.push_str(&word);
            }
            Some(_) if is_last => break,
            _ => lines.push(word.into_owned()),
        }
    }
    lines.retain(|line| !line.trim().is_empty());
    lines
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_wrapped_at_words_and_are_few() {
        assert_eq!(wrapped("one two three", 7), ["one two", "three"]);
        assert_eq!(wrapped("abcdefgh", 4), ["abc…"]);
        assert!(wrapped("", 4).is_empty());
        assert_eq!(wrapped(&"word ".repeat(100), 9).len(), 3);
    }
}
