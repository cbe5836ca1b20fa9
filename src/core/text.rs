//! Text for the user: what fits in a column, and how durations, sizes, rates and times are written.
//!
//! Owns the one place where text of a device is made safe for a terminal. Widths are columns of a
//! terminal, not bytes or characters.
//!
//! Invariant: no text is cut within a character, and nothing that moves a cursor or turns the
//! direction of writing leaves [`plain`], [`escaped`] or [`json`].

use std::borrow::Cow;
use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

use rustix::io::Errno;
use serde::{Serialize, Serializer};
use serde_json::ser::Formatter;
use unicode_segmentation::UnicodeSegmentation;
use unicode_width::UnicodeWidthStr;

/// Why another process of this machine did not answer, where the system's words are those of its calls.
pub fn unanswered(error: &io::Error) -> String {
    match error.kind() {
        io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut => "no answer in time".to_owned(),
        io::ErrorKind::UnexpectedEof => "it ended, or closed the connection, without an answer".to_owned(),
        _ => error.to_string(),
    }
}

/// The message about a failed open, read or write of a device; `group` is the one that may open it.
pub fn not_opened(what: &str, group: &str, error: &io::Error) -> String {
    match Errno::from_io_error(error) {
        Some(Errno::NOENT | Errno::NODEV | Errno::NXIO | Errno::IO) => format!("{what} is not plugged in"),
        Some(Errno::ACCESS | Errno::PERM) => {
            format!("{what} may not be opened: add the user to group {group} (`sudo usermod -aG {group} $USER`)")
        }
        Some(Errno::BUSY | Errno::AGAIN) => {
            format!("{what} is held by another program: end it (`fuser {what}` names it)")
        }
        _ => format!("{what}: {error}"),
    }
}

/// Columns `text` takes.
pub fn width(text: &str) -> usize {
    UnicodeWidthStr::width(text)
}

/// `text` without control characters and without the invisible characters that reorder a line
/// (Unicode bidirectional controls, zero-width characters, line and paragraph separators): each
/// becomes a space.
pub fn plain(text: &str) -> Cow<'_, str> {
    if text.contains(is_unsafe) { Cow::Owned(text.replace(is_unsafe, " ")) } else { Cow::Borrowed(text) }
}

/// `text` with the characters that [`plain`] removes, except line ends, written as escapes (`\u{d}`), so that
/// the mistake in a file stays visible.
pub fn escaped(text: &str) -> Cow<'_, str> {
    let is_hidden = |c: char| is_unsafe(c) && c != '\n';
    if !text.contains(is_hidden) {
        return Cow::Borrowed(text);
    }
    let mut shown = String::with_capacity(text.len() + 8);
    for c in text.chars() {
        if is_hidden(c) { shown.extend(c.escape_unicode()) } else { shown.push(c) }
    }
    Cow::Owned(shown)
}

/// `value` as one line of JSON, without a line end, in which the characters that [`plain`] removes are
/// written as `\u` escapes: the same value to a program, safe for a terminal.
///
/// # Errors
/// When `value` cannot be represented in JSON: a map whose keys are not strings.
pub fn json(value: &impl Serialize) -> serde_json::Result<String> {
    let mut line = Vec::new();
    value.serialize(&mut serde_json::Serializer::with_formatter(&mut line, Escaped))?;
    Ok(String::from_utf8_lossy(&line).into_owned())
}

/// A path in JSON, for `serialize_with`: in a name that is not UTF-8, which serde rejects, the invalid
/// bytes become U+FFFD.
///
/// # Errors
/// Those of the serializer.
pub fn lossy<S: Serializer>(path: &impl AsRef<Path>, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_str(&path.as_ref().display())
}

/// [`lossy`], or null.
///
/// # Errors
/// Those of the serializer.
pub fn lossy_option<S: Serializer>(path: &Option<PathBuf>, serializer: S) -> Result<S::Ok, S::Error> {
    match path {
        Some(path) => lossy(path, serializer),
        None => serializer.serialize_none(),
    }
}

struct Escaped;

impl Formatter for Escaped {
    /// A part of a text without characters that JSON itself escapes.
    fn write_string_fragment<W: io::Write + ?Sized>(&mut self, out: &mut W, fragment: &str) -> io::Result<()> {
        let mut rest = fragment;
        while let Some(at) = rest.find(is_unsafe) {
            let (before, from) = rest.split_at(at);
            out.write_all(before.as_bytes())?;
            let mut after = from.chars();
            for unit in after.next().into_iter().flat_map(|c| c.encode_utf16(&mut [0; 2]).to_vec()) {
                write!(out, "\\u{unit:04x}")?;
            }
            rest = after.as_str();
        }
        out.write_all(rest.as_bytes())
    }
}

fn is_unsafe(c: char) -> bool {
    c.is_control()
        || matches!(c, '\u{200b}' | '\u{200e}' | '\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2060}'..='\u{206f}' | '\u{feff}' | '\u{61c}')
}

/// `text` with every character outside ASCII as `?`, for terminals that cannot show it.
pub fn ascii(text: &str) -> String {
    text.chars().map(|c| if c.is_ascii() { c } else { '?' }).collect()
}

/// `text` in at most `columns` columns; when it is longer, its beginning and `ellipsis`.
pub fn cut<'a>(text: &'a str, columns: usize, ellipsis: &str) -> Cow<'a, str> {
    if width(text) <= columns {
        return Cow::Borrowed(text);
    }
    let Some(room) = columns.checked_sub(width(ellipsis)) else { return Cow::Borrowed("") };
    let mut used = 0;
    let mut kept = String::new();
    for grapheme in text.graphemes(true) {
        used += width(grapheme);
        if used > room {
            break;
        }
        kept.push_str(grapheme);
    }
    kept.push_str(ellipsis);
    Cow::Owned(kept)
}

/// `text` in exactly `columns` columns, at the left.
pub fn left(text: &str, columns: usize, ellipsis: &str) -> String {
    let text = cut(text, columns, ellipsis);
    let missing = columns.saturating_sub(width(&text));
    format!("{text}{:missing$}", "")
}

/// Hours, minutes and seconds: `1:02:03`, below an hour `02:03`.
pub fn clock(duration: Duration) -> String {
    let seconds = duration.as_secs();
    let (hours, minutes, seconds) = (seconds / 3600, seconds / 60 % 60, seconds % 60);
    if hours > 0 { format!("{hours}:{minutes:02}:{seconds:02}") } else { format!("{minutes:02}:{seconds:02}") }
}

/// An age, for quick reading: `12 ms`, from one second `1.2 s`, from 100 seconds as a clock.
pub fn age(duration: Duration) -> String {
    match duration.as_millis() {
        ms @ 0..1_000 => format!("{ms} ms"),
        1_000..100_000 => format!("{:.1} s", duration.as_secs_f64()),
        _ => clock(duration),
    }
}

/// A time rounded down to its largest unit: `3 s`, `12 min`, `2 h`.
pub fn about(duration: Duration) -> String {
    match duration.as_secs() {
        seconds @ 0..60 => format!("{seconds} s"),
        seconds @ 60..3600 => format!("{} min", seconds / 60),
        seconds => format!("{} h", seconds / 3600),
    }
}

/// A number of bytes in decimal units: `512 B`, `1.5 kB`, `12.3 MB`.
pub fn size(bytes: u64) -> String {
    const UNITS: [&str; 5] = ["kB", "MB", "GB", "TB", "PB"];
    if bytes < 1000 {
        return format!("{bytes} B");
    }
    let mut value = bytes as f64 / 1000.0;
    for unit in UNITS {
        // What would be written as 1000.0 gets the next unit.
        if value < 999.95 {
            return format!("{value:.1} {unit}");
        }
        value /= 1000.0;
    }
    format!("{value:.1} EB")
}

/// A number with thousands separators: `9,312`.
pub fn count(number: u64) -> String {
    let digits = number.to_string();
    let mut text = String::with_capacity(digits.len() + digits.len() / 3);
    for (at, digit) in digits.chars().enumerate() {
        if at > 0 && (digits.len() - at).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}

/// A number with its noun: `1 message`, `9,312 messages`.
pub fn counted(number: u64, what: &str) -> String {
    format!("{} {what}{}", count(number), if number == 1 { "" } else { "s" })
}

/// Bytes as hexadecimal digits, two each.
pub fn hexadecimal(bytes: &[u8]) -> String {
    let digit = |nibble: u8| char::from_digit(nibble.into(), 16).unwrap_or_default();
    bytes.iter().flat_map(|byte| [digit(byte >> 4), digit(byte & 0xf)]).collect()
}

/// Samples per second, with one decimal below 1000.
pub fn hertz(hz: f64) -> String {
    if hz < 999.95 { format!("{hz:.1}") } else { format!("{hz:.0}") }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn text_is_cut_at_columns_not_bytes() {
        assert_eq!(cut("camera", 6, "…"), "camera");
        assert_eq!(cut("camera", 5, "…"), "came…");
        assert_eq!(cut("相机手腕", 5, "…"), "相机…");
        assert_eq!(cut("naïve-ü", 4, "..."), "n...");
        assert_eq!(cut("camera", 0, "…"), "");
        assert_eq!(left("相机", 6, "…"), "相机  ");
    }

    #[test]
    fn device_strings_cannot_move_the_cursor() {
        assert_eq!(plain("a\x1b[2Jb\r\nc\u{202e}d\u{9b}e"), "a [2Jb  c d e");
        assert!(matches!(plain("streaming ü 相机"), Cow::Borrowed(_)));
        assert_eq!(ascii("µm 相"), "?m ?");
    }

    #[test]
    fn json_is_safe_for_a_terminal_and_unchanged_for_a_program() {
        let hostile = "a\u{9b}2J\u{7f}\u{202e}b\"\\\n\0ü\u{feff}";
        let line = json(&serde_json::json!({ "serial": hostile })).unwrap();
        assert_eq!(line, r#"{"serial":"a\u009b2J\u007f\u202eb\"\\\n\u0000ü\ufeff"}"#);
        let read: serde_json::Value = serde_json::from_str(&line).unwrap();
        assert_eq!(read["serial"], hostile);
    }

    #[test]
    fn quantities_are_short() {
        assert_eq!(clock(Duration::from_secs(123)), "02:03");
        assert_eq!(clock(Duration::from_secs(3723)), "1:02:03");
        assert_eq!(age(Duration::from_millis(999)), "999 ms");
        assert_eq!(age(Duration::from_millis(1250)), "1.2 s");
        assert_eq!(age(Duration::from_secs(123)), "02:03");
        assert_eq!(about(Duration::from_millis(3900)), "3 s");
        assert_eq!(about(Duration::from_secs(150)), "2 min");
        assert_eq!(about(Duration::from_hours(30)), "30 h");
        assert_eq!(size(999), "999 B");
        assert_eq!(size(999_999), "1.0 MB");
        assert_eq!(size(12_345_678), "12.3 MB");
        assert_eq!(size(u64::MAX), "18.4 EB");
        assert_eq!([0, 999, 1000, 9312, 1_234_567].map(count), ["0", "999", "1,000", "9,312", "1,234,567"]);
        assert_eq!(hertz(29.97), "30.0");
        assert_eq!(hertz(1000.2), "1000");
    }

    proptest! {
        #[test]
        fn a_column_has_exactly_the_requested_width(text in ".*", columns in 0_usize..40) {
            let text = plain(&text).into_owned();
            prop_assert_eq!(width(&left(&text, columns, "~")), columns.max(width(&cut(&text, columns, "~"))));
            prop_assert!(width(&cut(&text, columns, "…")) <= columns);
            prop_assert!(!plain(&text).contains(char::is_control));
        }

        #[test]
        fn json_of_any_text_round_trips_and_contains_nothing_unsafe(text in any::<String>()) {
            let line = json(&text).unwrap();
            prop_assert!(!line.contains(is_unsafe));
            prop_assert_eq!(serde_json::from_str::<String>(&line).unwrap(), text);
        }
    }
}
