//! Reading TOML tables by name, with every problem noted at its line and column.
//!
//! A getter returns `None` both for a key that is absent and for one whose value was wrong and has
//! been reported: the reader goes on with the default either way, so that one look finds all
//! problems, and the result is thrown away if there were any.

mod list;

use std::ops::RangeInclusive;
use std::path::Path;
use std::time::Duration;

use toml::Spanned;
use toml::de::{DeInteger, DeTable, DeValue};

use super::diagnostic::{Diagnostic, RegistryErrors, did_you_mean};
use super::units::{parse_duration, parse_size, show_duration, show_size};

/// The problems found so far in one text.
#[derive(Debug)]
pub(super) struct Problems<'a> {
    file: String,
    text: &'a str,
    /// Byte offset of each line.
    lines: Vec<usize>,
    found: Vec<Diagnostic>,
}

/// A file with more problems than this is not one of ours; nobody reads on.
const MOST_PROBLEMS: usize = 500;

impl<'a> Problems<'a> {
    pub(super) fn new(file: String, text: &'a str) -> Self {
        let lines = std::iter::once(0).chain(text.match_indices('\n').map(|(at, _)| at + 1)).collect();
        Self { file, text, lines, found: Vec::new() }
    }

    /// Notes a problem at a byte offset of the text.
    pub(super) fn report(&mut self, at: usize, entry: &str, message: impl Into<String>, fix: impl Into<String>) {
        if self.found.len() < MOST_PROBLEMS {
            let diagnostic = self.diagnostic(at, entry, message.into(), fix.into());
            self.found.push(diagnostic);
        }
    }

    /// A diagnostic at a byte offset, not noted.
    pub(super) fn diagnostic(&self, at: usize, entry: &str, message: String, fix: String) -> Diagnostic {
        let (line, column) = self.position(at);
        let entry = (!entry.is_empty()).then(|| entry.to_owned());
        Diagnostic { file: self.file.clone(), line, column, entry, message, fix: Some(fix) }
    }

    /// Line from 1 and column in characters from 1.
    pub(super) fn position(&self, at: usize) -> (usize, usize) {
        let line = self.lines.partition_point(|start| *start <= at).max(1);
        let start = self.lines.get(line - 1).copied().unwrap_or(0);
        (line, self.text.get(start..at).unwrap_or_default().chars().count() + 1)
    }

    pub(super) fn line(&self, at: usize) -> usize {
        self.position(at).0
    }

    pub(super) fn is_empty(&self) -> bool {
        self.found.is_empty()
    }

    /// `Err` with all problems so far in the order of the file, if there are any.
    pub(super) fn check(&mut self) -> Result<(), RegistryErrors> {
        if self.found.is_empty() {
            return Ok(());
        }
        let mut diagnostics = std::mem::take(&mut self.found);
        diagnostics.sort_by_key(|diagnostic| (diagnostic.line, diagnostic.column));
        Err(RegistryErrors { diagnostics })
    }
}

/// How a file is named in messages.
pub(super) fn file_label(path: Option<&Path>, otherwise: &str) -> String {
    // A path may hold any byte: what would not print is escaped.
    let shown = path.map_or_else(|| otherwise.to_owned(), |path| path.display().to_string());
    printable(&shown)
}

/// Reads a TOML text. Syntax errors are noted; with any of them the table is not to be used.
pub(super) fn read<'a>(text: &'a str, problems: &mut Problems<'a>) -> Spanned<DeTable<'a>> {
    /// More than this many follow from one another.
    const SHOWN: usize = 10;
    let (table, errors) = DeTable::parse_recoverable(text);
    let source: Vec<&str> = if errors.is_empty() { Vec::new() } else { text.lines().map(str::trim).collect() };
    let line_at = |line: usize| source.get(line.saturating_sub(1)).copied().unwrap_or_default();
    let mut lines = Vec::new();
    // Until this line a table that stands twice makes each of its keys a duplicate.
    let mut repeated_until = 0;
    for error in errors {
        if lines.len() == SHOWN {
            break;
        }
        let at = error.span().map_or(0, |span| span.start);
        let line = problems.line(at);
        let duplicate = error.message() == "duplicate key";
        // The rest of a line that is wrong is wrong in consequence.
        if lines.contains(&line) || (duplicate && line < repeated_until) {
            continue;
        }
        lines.push(line);
        if duplicate && line_at(line).starts_with('[') {
            let next = source.iter().skip(line).position(|line| line.starts_with('['));
            repeated_until = next.map_or(usize::MAX, |next| line + 1 + next);
        }
        let earlier = source.iter().take(line - 1).position(|earlier| *earlier == line_at(line));
        let message = match earlier.filter(|_| duplicate) {
            Some(earlier) => format!("not TOML: the same stands already on line {}", earlier + 1),
            None => format!("not TOML: {}", printable(error.message().trim_end_matches(", expected nothing"))),
        };
        problems.report(at, "", message, syntax_fix(error.message(), line_at(line)));
    }
    table
}

fn syntax_fix(message: &str, source: &str) -> String {
    let (key, value) = source.split_once('=').unwrap_or((source, ""));
    let digits = value.split_whitespace().next().unwrap_or_default();
    let is_serial_table = (message == "duplicate key" && source.starts_with('[') && source.contains("serial"))
        || (message.starts_with("cannot extend value") && source.contains("serial."));
    if is_serial_table {
        "`serial` can stand only once in an entry: beside a [device.NAME.serial] table write the device's serial \
         number as `serial_number = \"...\"`"
            .to_owned()
    } else if message == "duplicate key" {
        "a name can stand only once: rename or remove one of the two".to_owned()
    } else if matches!(key.trim(), "vid" | "pid") && digits.bytes().all(|b| b.is_ascii_hexdigit()) && !digits.is_empty()
    {
        format!("write USB ids as text: {} = \"{digits}\"", key.trim())
    } else {
        "write one `key = value` a line, text in double quotes, tables as [device.NAME]".to_owned()
    }
}

/// Without control characters.
pub(super) fn printable(text: &str) -> String {
    text.chars().flat_map(|c| if c.is_control() { c.escape_default().collect() } else { vec![c] }).collect()
}

/// A value and where it stands.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct At<T> {
    pub(super) at: usize,
    pub(super) value: T,
}

/// One table of the text.
#[derive(Debug)]
pub(super) struct Section<'a> {
    table: &'a DeTable<'a>,
    /// Byte offset of the table's beginning.
    pub(super) at: usize,
    /// Its name for messages, for example `device.cam_wrist`; empty for the whole text.
    pub(super) entry: String,
}

impl<'a> Section<'a> {
    pub(super) fn new(table: &'a DeTable<'a>, at: usize, entry: String) -> Self {
        Self { table, at, entry }
    }

    /// Notes every key that is not in `known`.
    pub(super) fn allow(&self, problems: &mut Problems<'_>, known: &[&str]) {
        for (at, key, _) in self.fields() {
            if !known.contains(&key) {
                let fix = did_you_mean(key, known, "known keys here");
                problems.report(at, &self.entry, format!("unknown key {key:?}"), fix);
            }
        }
    }

    /// Offset of the key, key and value, in the order of the file.
    pub(super) fn fields(&self) -> Vec<(usize, &'a str, &'a Spanned<DeValue<'a>>)> {
        let mut fields: Vec<_> =
            self.table.iter().map(|(key, value)| (key.span().start, key.get_ref().as_ref(), value)).collect();
        fields.sort_by_key(|(at, ..)| *at);
        fields
    }

    fn field(&self, key: &str) -> Option<&'a Spanned<DeValue<'a>>> {
        self.table.get(key)
    }

    pub(super) fn has(&self, key: &str) -> bool {
        self.table.contains_key(key)
    }

    pub(super) fn is_table(&self, key: &str) -> bool {
        self.field(key).is_some_and(|value| value.get_ref().is_table())
    }

    /// Where the value of `key` stands, or the table if it has none.
    pub(super) fn at_of(&self, key: &str) -> usize {
        self.field(key).map_or(self.at, |value| value.span().start)
    }

    pub(super) fn report(&self, problems: &mut Problems<'_>, key: &str, message: String, fix: impl Into<String>) {
        problems.report(self.at_of(key), &self.entry, message, fix);
    }

    /// Notes that a key must be there.
    pub(super) fn missing(&self, problems: &mut Problems<'_>, key: &str, fix: &str) {
        problems.report(self.at, &self.entry, format!("{key} is missing"), fix);
    }

    pub(super) fn text(&self, problems: &mut Problems<'_>, key: &str) -> Option<At<&'a str>> {
        let value = self.field(key)?;
        let DeValue::String(text) = value.get_ref() else {
            self.wrong_type(problems, key, "text", "put it in double quotes");
            return None;
        };
        Some(At { at: value.span().start, value: text.as_ref() })
    }

    pub(super) fn flag(&self, problems: &mut Problems<'_>, key: &str) -> Option<bool> {
        let DeValue::Boolean(flag) = self.field(key)?.get_ref() else {
            self.wrong_type(problems, key, "true or false", "write true or false without quotes");
            return None;
        };
        Some(*flag)
    }

    pub(super) fn integer(
        &self,
        problems: &mut Problems<'_>,
        key: &str,
        range: RangeInclusive<i64>,
    ) -> Option<At<i64>> {
        let value = self.field(key)?;
        let fix = if *range.end() == i64::MAX {
            "write a whole number without quotes".to_owned()
        } else {
            format!("write a whole number from {} to {}, without quotes", range.start(), range.end())
        };
        let DeValue::Integer(integer) = value.get_ref() else {
            self.wrong_type(problems, key, "a whole number", fix);
            return None;
        };
        let Some(number) = as_i64(integer).filter(|number| range.contains(number)) else {
            self.report(problems, key, format!("{key} = {integer} is out of range"), fix);
            return None;
        };
        Some(At { at: value.span().start, value: number })
    }

    pub(super) fn number(&self, problems: &mut Problems<'_>, key: &str, range: RangeInclusive<f64>) -> Option<f64> {
        let fix = format!("write a number from {} to {}, without quotes", range.start(), range.end());
        let (number, shown) = match self.field(key)?.get_ref() {
            DeValue::Integer(integer) => (as_i64(integer).map(|number| number as f64), integer.to_string()),
            DeValue::Float(float) => (float.as_str().replace('_', "").parse().ok(), float.to_string()),
            _ => {
                self.wrong_type(problems, key, "a number", fix);
                return None;
            }
        };
        let inside = number.filter(|number| range.contains(number));
        if inside.is_none() {
            self.report(problems, key, format!("{key} = {shown} is out of range"), fix);
        }
        inside
    }

    pub(super) fn duration(
        &self,
        problems: &mut Problems<'_>,
        key: &str,
        range: RangeInclusive<Duration>,
    ) -> Option<Duration> {
        let bounds = format!("{} to {}", show_duration(*range.start()), show_duration(*range.end()));
        let example = format!("write {bounds} with a unit (us, ms, s, min, h), for example {key} = \"25ms\"");
        let value = self.field(key)?.get_ref();
        match value {
            DeValue::String(text) => match parse_duration(text) {
                Some(duration) if range.contains(&duration) => return Some(duration),
                Some(_) => self.report(problems, key, format!("{key} = {text:?} is out of range"), example),
                None => self.report(problems, key, format!("{key} = {text:?} is not a duration"), example),
            },
            DeValue::Integer(_) | DeValue::Float(_) => {
                self.report(problems, key, format!("{key} has no unit"), example);
            }
            _ => self.wrong_type(problems, key, "a duration", example),
        }
        None
    }

    pub(super) fn size(&self, problems: &mut Problems<'_>, key: &str, range: RangeInclusive<u64>) -> Option<u64> {
        let bounds = format!("{} to {}", show_size(*range.start()), show_size(*range.end()));
        let example = format!("write {bounds} with a unit (B, KiB, MiB, GiB, TiB), for example {key} = \"4MiB\"");
        match self.field(key)?.get_ref() {
            DeValue::String(text) => match parse_size(text) {
                Some(size) if range.contains(&size) => return Some(size),
                Some(_) => self.report(problems, key, format!("{key} = {text:?} is out of range"), example),
                None => self.report(problems, key, format!("{key} = {text:?} is not a size"), example),
            },
            DeValue::Integer(_) | DeValue::Float(_) => {
                self.report(problems, key, format!("{key} has no unit"), example);
            }
            _ => self.wrong_type(problems, key, "a size", example),
        }
        None
    }

    /// One of a fixed set of names.
    pub(super) fn choice<T: Copy>(&self, problems: &mut Problems<'_>, key: &str, names: &[(&str, T)]) -> Option<T> {
        let text = self.text(problems, key)?.value;
        if let Some((_, value)) = names.iter().find(|(name, _)| *name == text) {
            return Some(*value);
        }
        let known: Vec<&str> = names.iter().map(|(name, _)| *name).collect();
        let fix = did_you_mean(text, &known, "write one of");
        self.report(problems, key, format!("unknown {key} {text:?}"), fix);
        None
    }

    /// A USB vendor or product id: four hexadecimal digits.
    pub(super) fn usb_id(&self, problems: &mut Problems<'_>, key: &str) -> Option<u16> {
        let fix = format!("write the four hexadecimal digits lsusb shows, for example {key} = \"046d\"");
        match self.field(key)?.get_ref() {
            DeValue::String(text) => {
                let digits = text.strip_prefix("0x").or_else(|| text.strip_prefix("0X")).unwrap_or(text);
                let hex = (1..=4).contains(&digits.len()) && digits.bytes().all(|byte| byte.is_ascii_hexdigit());
                if let Some(id) = hex.then(|| u16::from_str_radix(digits, 16).ok()).flatten() {
                    return Some(id);
                }
                self.report(problems, key, format!("{key} = {text:?} is not a USB id"), fix);
            }
            DeValue::Integer(integer) if integer.radix() == 16 => {
                if let Some(id) = as_i64(integer).and_then(|number| u16::try_from(number).ok()) {
                    return Some(id);
                }
                self.report(problems, key, format!("{key} = {integer} is not a USB id"), fix);
            }
            DeValue::Integer(integer) => {
                self.report(problems, key, format!("{key} = {integer} is decimal; USB ids are hexadecimal"), fix);
            }
            _ => self.wrong_type(problems, key, "a USB id", fix),
        }
        None
    }

    pub(super) fn table(&self, problems: &mut Problems<'_>, key: &str) -> Option<Section<'a>> {
        let value = self.field(key)?;
        let entry = self.child(key);
        let DeValue::Table(table) = value.get_ref() else {
            self.wrong_type(problems, key, "a table", format!("write it as a table [{entry}]"));
            return None;
        };
        Some(Section::new(table, value.span().start, entry))
    }

    /// The tables of `[[key]]`, named `key 1`, `key 2`, ..., below this one's name.
    pub(super) fn tables(&self, problems: &mut Problems<'_>, key: &str) -> Vec<Section<'a>> {
        let Some(value) = self.field(key) else { return Vec::new() };
        let name = self.child(key);
        let DeValue::Array(array) = value.get_ref() else {
            self.wrong_type(problems, key, "a list of tables", format!("write [[{name}]] with two brackets"));
            return Vec::new();
        };
        let mut sections = Vec::new();
        for (index, item) in array.iter().enumerate() {
            let entry = format!("{name} {}", index + 1);
            if let DeValue::Table(table) = item.get_ref() {
                sections.push(Section::new(table, item.span().start, entry));
            } else {
                problems.report(item.span().start, &entry, "not a table", format!("write [[{name}]] tables"));
            }
        }
        sections
    }

    /// The name of a table below this one, quoted where TOML would have to quote it.
    pub(super) fn child(&self, key: &str) -> String {
        let bare = !key.is_empty() && key.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'_' || b == b'-');
        let key = if bare { key.to_owned() } else { format!("{key:?}") };
        if self.entry.is_empty() { key } else { format!("{}.{key}", self.entry) }
    }

    fn wrong_type(&self, problems: &mut Problems<'_>, key: &str, expected: &str, fix: impl Into<String>) {
        let found = self.field(key).map_or("nothing", |value| match value.get_ref() {
            DeValue::String(_) => "text",
            DeValue::Integer(_) => "a whole number",
            DeValue::Float(_) => "a decimal number",
            DeValue::Boolean(_) => "true or false",
            DeValue::Datetime(_) => "a date",
            DeValue::Array(_) => "a list",
            DeValue::Table(_) => "a table",
        });
        self.report(problems, key, format!("{key} must be {expected}, but is {found}"), fix);
    }
}

fn as_i64(integer: &DeInteger<'_>) -> Option<i64> {
    i64::from_str_radix(&integer.as_str().replace('_', ""), integer.radix()).ok()
}
