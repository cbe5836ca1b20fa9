//! Reading the text of a configuration file safely, and TOML tables by key, with every problem noted at its line and
//! column.
//!
//! A getter returns `None` both for an absent key and for an invalid value, which has
//! been reported: the reader continues with the default either way, so that one pass finds all
//! problems, and the result is discarded if there were any.

use std::cell::RefCell;
use std::fs::{File, OpenOptions};
use std::io::ErrorKind;
use std::ops::RangeInclusive;
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;
use std::sync::LazyLock;
use std::time::Duration;

use rapid_system::limited::read_bytes;
use toml::Spanned;
use toml::de::{DeInteger, DeTable, DeValue};

use super::diagnostic::{Diagnostic, RegistryErrors, did_you_mean};
use super::keys::Keys;
use super::trust::distrust;
use super::units::{parse_duration, parse_size, show_duration, show_size};

/// The problems found so far in one text, and what works but may be unexpected.
#[derive(Debug)]
struct Problems<'a> {
    file: String,
    text: &'a str,
    /// Byte offset of each line.
    lines: Vec<usize>,
    found: RefCell<Vec<Diagnostic>>,
    warnings: RefCell<Vec<Diagnostic>>,
}

/// A file with more problems than this is not a registry; reading ends there.
const MOST_PROBLEMS: usize = 500;

impl<'a> Problems<'a> {
    fn new(file: String, text: &'a str) -> Self {
        let lines = std::iter::once(0).chain(text.match_indices('\n').map(|(at, _)| at + 1)).collect();
        Self { file, text, lines, found: RefCell::default(), warnings: RefCell::default() }
    }

    /// Notes a problem at a byte offset of the text.
    fn report(&self, at: usize, entry: &str, message: impl Into<String>, fix: impl Into<String>) {
        let mut found = self.found.borrow_mut();
        if found.len() < MOST_PROBLEMS {
            found.push(self.diagnostic(at, entry, message.into(), fix.into()));
        }
    }

    /// A diagnostic at a byte offset, not noted.
    fn diagnostic(&self, at: usize, entry: &str, message: String, fix: String) -> Diagnostic {
        let (line, column) = self.position(at);
        let entry = (!entry.is_empty()).then(|| entry.to_owned());
        Diagnostic { file: self.file.clone(), line, column, entry, message, fix: Some(fix) }
    }

    /// Line from 1 and column in characters from 1.
    fn position(&self, at: usize) -> (usize, usize) {
        let line = self.lines.partition_point(|start| *start <= at).max(1);
        let start = self.lines.get(line - 1).copied().unwrap_or(0);
        (line, self.text.get(start..at).unwrap_or_default().chars().count() + 1)
    }

    /// `Err` with all problems so far in the order of the file, if there are any.
    fn check(&self) -> Result<(), RegistryErrors> {
        let mut diagnostics = self.found.take();
        diagnostics.sort_by_key(|diagnostic| (diagnostic.line, diagnostic.column));
        if diagnostics.is_empty() { Ok(()) } else { Err(RegistryErrors { diagnostics }) }
    }
}

/// The result of `reader` for a TOML text, or all problems that were noted. `file` names it in messages.
pub(super) fn read<T>(
    file: &str,
    text: &str,
    reader: impl FnOnce(&Section<'_>) -> Result<T, RegistryErrors>,
) -> Result<T, RegistryErrors> {
    let problems = Problems::new(file.to_owned(), text);
    let document = parsed(text, &problems);
    problems.check()?;
    let root = Section { table: document.get_ref(), at: 0, entry: String::new(), problems: &problems };
    let read = reader(&root)?;
    problems.check()?;
    Ok(read)
}

/// The result of `reader` for an empty table: what applies without any key.
pub(super) fn of_nothing<T>(reader: impl FnOnce(&Section<'_>) -> T) -> T {
    let problems = Problems::new(String::new(), "");
    reader(&Section { table: &EMPTY, at: 0, entry: String::new(), problems: &problems })
}

static EMPTY: LazyLock<DeTable<'static>> = LazyLock::new(DeTable::new);

/// How a file is named in messages.
pub(super) fn file_label(path: Option<&Path>, otherwise: &str) -> String {
    // A path may contain any byte: unprintable ones are escaped.
    let shown = path.map_or_else(|| otherwise.to_owned(), |path| path.display().to_string());
    printable(&shown)
}

/// Parses a TOML text. Syntax errors are noted; with any of them the table must not be used.
fn parsed<'a>(text: &'a str, problems: &Problems<'a>) -> Spanned<DeTable<'a>> {
    /// Further errors are mostly consequences.
    const SHOWN: usize = 10;
    let (table, errors) = DeTable::parse_recoverable(text);
    let source: Vec<&str> = if errors.is_empty() { Vec::new() } else { text.lines().map(str::trim).collect() };
    let line_at = |line: usize| source.get(line.saturating_sub(1)).copied().unwrap_or_default();
    let mut lines = Vec::new();
    // Up to this line a repeated table makes each of its keys a duplicate.
    let mut repeated_until = 0;
    for error in errors {
        if lines.len() == SHOWN {
            break;
        }
        let at = error.span().map_or(0, |span| span.start);
        let (line, _) = problems.position(at);
        let duplicate = error.message() == "duplicate key";
        // Further errors of the same line are consequences.
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
            Some(earlier) => format!("not TOML: already defined on line {}", earlier + 1),
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
        "a key may appear only once in an entry: `serial` is the device's serial number, and the table of a serial line is \
         called [device.NAME.tty]"
            .to_owned()
    } else if message == "duplicate key" {
        "a name may appear only once: rename or remove one of the two".to_owned()
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

/// One table of the text.
#[derive(Debug)]
pub(super) struct Section<'a> {
    table: &'a DeTable<'a>,
    /// Byte offset of the table's beginning.
    pub(super) at: usize,
    /// Its name for messages, for example `device.cam_wrist`; empty for the whole text.
    pub(super) entry: String,
    problems: &'a Problems<'a>,
}

impl<'a> Section<'a> {
    /// `Err` with all problems so far in the order of the file, if there are any.
    pub(super) fn check(&self) -> Result<(), RegistryErrors> {
        self.problems.check()
    }

    pub(super) fn is_faultless(&self) -> bool {
        self.problems.found.borrow().is_empty()
    }

    /// Notes every key that is not among these.
    pub(super) fn known(&self, keys: Keys) {
        let names: Vec<&str> = keys.iter().copied().flatten().map(|key| key.name).collect();
        self.allow(&names);
    }

    /// Notes every key that is not in `known`.
    pub(super) fn allow(&self, known: &[&str]) {
        for (at, key, _) in self.fields() {
            if !known.contains(&key) {
                let fix = did_you_mean(key, known, "known keys here");
                self.report_at(at, format!("unknown key {key:?}"), fix);
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

    pub(super) fn field(&self, key: &str) -> Option<&'a Spanned<DeValue<'a>>> {
        self.table.get(key)
    }

    pub(super) fn has(&self, key: &str) -> bool {
        self.table.contains_key(key)
    }

    pub(super) fn is_table(&self, key: &str) -> bool {
        self.field(key).is_some_and(|value| value.get_ref().is_table())
    }

    /// Position of the value of `key`, or of the table if it has none.
    pub(super) fn at_of(&self, key: &str) -> usize {
        self.field(key).map_or(self.at, |value| value.span().start)
    }

    /// The line of the value of `key`.
    pub(super) fn line_of(&self, key: &str) -> usize {
        self.problems.position(self.at_of(key)).0
    }

    /// The line where the table begins.
    pub(super) fn line(&self) -> usize {
        self.problems.position(self.at).0
    }

    /// Notes a problem with `key`.
    pub(super) fn report(&self, key: &str, message: impl Into<String>, fix: impl Into<String>) {
        self.report_at(self.at_of(key), message, fix);
    }

    /// Notes a problem at a byte offset of the text.
    pub(super) fn report_at(&self, at: usize, message: impl Into<String>, fix: impl Into<String>) {
        self.problems.report(at, &self.entry, message, fix);
    }

    /// Notes a problem of the table `name` below this one, at a byte offset of the text.
    pub(super) fn report_child(&self, at: usize, name: &str, message: impl Into<String>, fix: impl Into<String>) {
        self.problems.report(at, &self.child(name), message, fix);
    }

    /// Notes a problem with `key`, which then has no value.
    pub(super) fn refuse<T>(&self, key: &str, message: impl Into<String>, fix: impl Into<String>) -> Option<T> {
        self.report(key, message, fix);
        None
    }

    /// Notes at a byte offset of the text what works but may be unexpected.
    pub(super) fn warn_at(&self, at: usize, message: impl Into<String>, fix: impl Into<String>) {
        let diagnostic = self.problems.diagnostic(at, &self.entry, message.into(), fix.into());
        self.problems.warnings.borrow_mut().push(diagnostic);
    }

    /// Notes the tables of `keys`, which are for other kinds of node; `own` is the one for this kind, `what`.
    pub(super) fn no_tables(&self, keys: &[&str], what: &str, own: &str) {
        for key in keys.iter().filter(|key| self.is_table(key)) {
            let message = format!("{what} has no table [{}]", self.child(key));
            self.report(key, message, format!("write its settings into [{}]", self.child(own)));
        }
    }

    /// What works but may be unexpected, as noted so far.
    pub(super) fn warnings(&self) -> Vec<Diagnostic> {
        self.problems.warnings.take()
    }

    /// Notes that a required key is missing.
    pub(super) fn missing(&self, key: &str, fix: &str) {
        self.report_at(self.at, format!("{key} is missing"), fix);
    }

    /// Notes that a required key is missing, if it is.
    pub(super) fn need(&self, key: &str, fix: &str) {
        if !self.has(key) {
            self.missing(key, fix);
        }
    }

    pub(super) fn text(&self, key: &str) -> Option<&'a str> {
        match self.field(key)?.get_ref() {
            DeValue::String(text) => Some(text.as_ref()),
            _ => self.wrong_type(key, "text", "put it in double quotes"),
        }
    }

    /// The text of `key`, if it is one; otherwise nothing is noted.
    pub(super) fn word(&self, key: &str) -> Option<&'a str> {
        self.field(key)?.get_ref().as_str()
    }

    pub(super) fn flag(&self, key: &str) -> Option<bool> {
        match self.field(key)?.get_ref() {
            DeValue::Boolean(flag) => Some(*flag),
            _ => self.wrong_type(key, "true or false", "write true or false without quotes"),
        }
    }

    pub(super) fn integer<T: TryFrom<i64>>(&self, key: &str, range: RangeInclusive<i64>) -> Option<T> {
        let value = self.field(key)?;
        let fix = if *range.end() == i64::MAX {
            "write a whole number without quotes".to_owned()
        } else {
            format!("write a whole number from {} to {}, without quotes", range.start(), range.end())
        };
        let DeValue::Integer(integer) = value.get_ref() else {
            return self.wrong_type(key, "a whole number", fix);
        };
        let number = as_i64(integer).filter(|number| range.contains(number));
        let Some(number) = number.and_then(|number| number.try_into().ok()) else {
            return self.refuse(key, format!("{key} = {integer} is out of range"), fix);
        };
        Some(number)
    }

    pub(super) fn number(&self, key: &str, range: RangeInclusive<f64>) -> Option<f64> {
        let fix = if *range.end() >= f64::MAX {
            "write a finite number, without quotes".to_owned()
        } else {
            format!("write a number from {} to {}, without quotes", range.start(), range.end())
        };
        let value = self.field(key)?.get_ref();
        let shown = match value {
            DeValue::Integer(integer) => integer.to_string(),
            DeValue::Float(float) => float.to_string(),
            _ => return self.wrong_type(key, "a number", fix),
        };
        let inside = as_f64(value).filter(|number| range.contains(number));
        inside.or_else(|| self.refuse(key, format!("{key} = {shown} is out of range"), fix))
    }

    pub(super) fn duration(&self, key: &str, range: RangeInclusive<Duration>) -> Option<Duration> {
        let bounds = format!("{} to {}", show_duration(*range.start()), show_duration(*range.end()));
        let fix = format!("write {bounds} with a unit (us, ms, s, min, h), for example {key} = \"25ms\"");
        self.with_unit(key, "a duration", &range, parse_duration, fix)
    }

    pub(super) fn size(&self, key: &str, range: RangeInclusive<u64>) -> Option<u64> {
        let bounds = format!("{} to {}", show_size(*range.start()), show_size(*range.end()));
        let fix = format!("write {bounds} with a unit (B, KiB, MiB, GiB, TiB), for example {key} = \"4MiB\"");
        self.with_unit(key, "a size", &range, parse_size, fix)
    }

    fn with_unit<T: PartialOrd>(
        &self,
        key: &str,
        what: &str,
        range: &RangeInclusive<T>,
        parse: fn(&str) -> Option<T>,
        fix: String,
    ) -> Option<T> {
        match self.field(key)?.get_ref() {
            DeValue::String(text) => match parse(text) {
                Some(value) if range.contains(&value) => Some(value),
                Some(_) => self.refuse(key, format!("{key} = {text:?} is out of range"), fix),
                None => self.refuse(key, format!("{key} = {text:?} is not {what}"), fix),
            },
            DeValue::Integer(_) | DeValue::Float(_) => self.refuse(key, format!("{key} has no unit"), fix),
            _ => self.wrong_type(key, what, fix),
        }
    }

    pub(super) fn texts(&self, key: &str) -> Option<Vec<String>> {
        let text = |value: &DeValue<'_>| value.as_str().map(str::to_owned);
        self.list(key, text, "a list of texts", "write it as [\"a\", \"b\"]")
    }

    pub(super) fn numbers(&self, key: &str) -> Option<Vec<f64>> {
        self.list(key, as_f64, "a list of numbers", "write it as [0, 1.5]")
    }

    fn list<T>(&self, key: &str, item: impl Fn(&DeValue<'_>) -> Option<T>, what: &str, fix: &str) -> Option<Vec<T>> {
        let array = self.field(key)?.get_ref().as_array();
        let items = array.and_then(|array| array.iter().map(|value| item(value.get_ref())).collect());
        items.or_else(|| self.wrong_type(key, what, fix))
    }

    /// One of a fixed set of names.
    pub(super) fn choice<T: Copy>(&self, key: &str, names: &[(&str, T)]) -> Option<T> {
        let text = self.text(key)?;
        if let Some((_, value)) = names.iter().find(|(name, _)| *name == text) {
            return Some(*value);
        }
        let fix = did_you_mean(text, names.iter().map(|(name, _)| *name), "write one of");
        self.refuse(key, format!("unknown {key} {text:?}"), fix)
    }

    /// A USB vendor or product id: four hexadecimal digits.
    pub(super) fn usb_id(&self, key: &str) -> Option<u16> {
        let fix = format!("write the four hexadecimal digits lsusb shows, for example {key} = \"046d\"");
        let (id, shown) = match self.field(key)?.get_ref() {
            DeValue::String(text) => {
                let digits = text.strip_prefix("0x").or_else(|| text.strip_prefix("0X")).unwrap_or(text);
                let hex = (1..=4).contains(&digits.len()) && digits.bytes().all(|byte| byte.is_ascii_hexdigit());
                (hex.then(|| u16::from_str_radix(digits, 16).ok()).flatten(), format!("{text:?}"))
            }
            DeValue::Integer(integer) if integer.radix() == 16 => {
                (as_i64(integer).and_then(|number| u16::try_from(number).ok()), integer.to_string())
            }
            DeValue::Integer(integer) => {
                return self.refuse(key, format!("{key} = {integer} is decimal; USB ids are hexadecimal"), fix);
            }
            _ => return self.wrong_type(key, "a USB id", fix),
        };
        id.or_else(|| self.refuse(key, format!("{key} = {shown} is not a USB id"), fix))
    }

    pub(super) fn table(&self, key: &str) -> Option<Section<'a>> {
        let value = self.field(key)?;
        let entry = self.child(key);
        let DeValue::Table(table) = value.get_ref() else {
            return self.wrong_type(key, "a table", format!("write it as a table [{entry}]"));
        };
        Some(self.part(table, value.span().start, entry))
    }

    /// The table of `key`; without one, an empty table.
    pub(super) fn table_or_empty(&self, key: &str) -> Section<'a> {
        self.table(key).unwrap_or_else(|| self.part(&EMPTY, self.at, self.child(key)))
    }

    /// A table below this one.
    pub(super) fn part(&self, table: &'a DeTable<'a>, at: usize, entry: String) -> Self {
        Self { table, at, entry, problems: self.problems }
    }

    /// The tables of `[[key]]`, named `key 1`, `key 2`, ..., below this one's name.
    pub(super) fn tables(&self, key: &str) -> Option<Vec<Section<'a>>> {
        let value = self.field(key)?;
        let name = self.child(key);
        let DeValue::Array(array) = value.get_ref() else {
            return self.wrong_type(key, "a list of tables", format!("write [[{name}]] with two brackets"));
        };
        let mut sections = Vec::new();
        for (index, item) in array.iter().enumerate() {
            let entry = format!("{name} {}", index + 1);
            if let DeValue::Table(table) = item.get_ref() {
                sections.push(self.part(table, item.span().start, entry));
            } else {
                self.problems.report(item.span().start, &entry, "not a table", format!("write [[{name}]] tables"));
            }
        }
        Some(sections)
    }

    /// The name of a table below this one, quoted where TOML requires it.
    pub(super) fn child(&self, key: &str) -> String {
        let bare = !key.is_empty() && key.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'_' || b == b'-');
        let key = if bare { key.to_owned() } else { format!("{key:?}") };
        if self.entry.is_empty() { key } else { format!("{}.{key}", self.entry) }
    }

    fn wrong_type<T>(&self, key: &str, expected: &str, fix: impl Into<String>) -> Option<T> {
        let found = self.field(key).map_or("nothing", |value| match value.get_ref() {
            DeValue::String(_) => "text",
            DeValue::Integer(_) => "a whole number",
            DeValue::Float(_) => "a decimal number",
            DeValue::Boolean(_) => "true or false",
            DeValue::Datetime(_) => "a date",
            DeValue::Array(_) => "a list",
            DeValue::Table(_) => "a table",
        });
        self.refuse(key, format!("{key} must be {expected}, but is {found}"), fix)
    }
}

fn as_i64(integer: &DeInteger<'_>) -> Option<i64> {
    i64::from_str_radix(&integer.as_str().replace('_', ""), integer.radix()).ok()
}

fn as_f64(value: &DeValue<'_>) -> Option<f64> {
    match value {
        DeValue::Integer(integer) => as_i64(integer).map(|number| number as f64),
        DeValue::Float(float) => float.as_str().replace('_', "").parse().ok(),
        _ => None,
    }
}

/// No registry is this large; the wrong file may be.
const LARGEST: u64 = 1 << 20;

/// The text of a file written by a person. `when_missing` is the fix when there is none.
///
/// # Errors
/// When it cannot be read, is not an ordinary text file, or may be changed by others while this process is root.
pub fn read_file(path: &Path, when_missing: &str) -> Result<String, RegistryErrors> {
    let label = file_label(Some(path), "");
    let problem = |message: String, fix: String| RegistryErrors::whole_file(label.clone(), message, fix);
    // Without waiting: opening a named pipe would wait for its writer.
    let opened = OpenOptions::new().read(true).custom_flags(libc::O_NONBLOCK | libc::O_NOCTTY).open(path);
    let file: File = opened.map_err(|error| match error.kind() {
        ErrorKind::NotFound => problem("there is no such file".to_owned(), when_missing.to_owned()),
        ErrorKind::PermissionDenied => problem(
            "it may not be read by this user".to_owned(),
            format!("ls -l {label} shows who may; chmod a+r {label} lets everyone"),
        ),
        _ => problem(format!("it cannot be opened: {error}"), "name another file".to_owned()),
    })?;
    let cannot_read =
        |error: std::io::Error| problem(format!("it cannot be read: {error}"), "name another file".into());
    let metadata = file.metadata().map_err(cannot_read)?;
    if metadata.is_dir() {
        return Err(problem("it is a directory".to_owned(), format!("name the file in it: {label}/devices.toml")));
    }
    if !metadata.is_file() {
        return Err(problem("it is not a regular file".to_owned(), "name a file on disk".to_owned()));
    }
    // As root, a user who may change the file would gain the rights of this process.
    if rustix::process::geteuid().is_root()
        && let Some(reason) = distrust(path).map_err(cannot_read)?
    {
        return Err(problem(reason.to_string(), reason.fix()));
    }
    let bytes = read_bytes(&file, LARGEST).map_err(cannot_read)?;
    String::from_utf8(bytes).map_err(|error| {
        let line = error.as_bytes().iter().take(error.utf8_error().valid_up_to()).filter(|b| **b == b'\n').count() + 1;
        let bytes = error.as_bytes();
        // Text of another encoding has no such bytes.
        let is_text = !bytes.iter().any(|byte| byte.is_ascii_control() && !byte.is_ascii_whitespace());
        let fix =
            if is_text { format!("iconv -f latin1 -t utf-8 {label}") } else { "is it the right file?".to_owned() };
        problem(format!("it is not UTF-8 text (line {line})"), fix)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn non_text_files_are_rejected_with_a_reason() {
        let dir = tempfile::tempdir().unwrap();
        let message = |path: &Path| read_file(path, "write one").unwrap_err().to_string();
        let missing = dir.path().join("none.toml");
        assert_eq!(message(&missing), format!("{}: there is no such file\n    fix: write one", missing.display()));
        assert!(message(dir.path()).contains("it is a directory"));
        let path = dir.path().join("devices.toml");
        std::fs::write(&path, b"a = 1\nb = \"\xff\"\n").unwrap();
        assert!(message(&path).contains("it is not UTF-8 text (line 2)"), "{}", message(&path));
        std::fs::write(&path, vec![b'#'; 1 + (1 << 20)]).unwrap();
        assert!(message(&path).contains("larger than 1.0 MB"), "{}", message(&path));
        std::fs::write(&path, "a = 1\n").unwrap();
        assert_eq!(read_file(&path, "").unwrap(), "a = 1\n");
        std::fs::set_permissions(&path, std::os::unix::fs::PermissionsExt::from_mode(0o666)).unwrap();
        let is_root = rustix::process::geteuid().is_root();
        assert_eq!(read_file(&path, "").is_err(), is_root, "only root distrusts a file all may write");
        let pipe = dir.path().join("pipe");
        rustix::fs::mknodat(rustix::fs::CWD, &pipe, rustix::fs::FileType::Fifo, 0o600.into(), 0).unwrap();
        assert!(message(&pipe).contains("not a regular file"));
    }
}
