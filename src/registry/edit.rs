//! Changing `devices.toml` without touching text that a person wrote in it: entries are added at its end
//! and removed as a whole.
//!
//! Pure: from one text to the next; the caller that writes the file parses it first.
//!
//! Invariant: every byte of the old text is in the new one, except those of a removed entry and of a renamed key.
//! Invariant: a value, which a device may have chosen, is written as TOML text that evaluates to it, and a comment is
//! one line.

use std::ops::Range;

use toml_edit::{Document, DocumentMut, Item, Table, Value};

/// A value of a key.
#[derive(Debug, Clone, PartialEq)]
pub enum Setting {
    /// Text.
    Text(String),
    /// A whole number.
    Whole(i64),
    /// As typed by a person: a number, a list, true or false if TOML parses it as one, otherwise text.
    Typed(String),
}

impl Setting {
    /// As a person would type it: TOML that evaluates to it.
    pub fn typed(&self) -> String {
        value(self).to_string()
    }
}

/// An entry to be added.
#[derive(Debug, Clone, PartialEq)]
pub struct NewEntry {
    /// Name: the table is `[device.NAME]`.
    pub name: String,
    /// Lines above it.
    pub comments: Vec<String>,
    /// Keys and values in their order; `camera.width` goes into the table `[device.NAME.camera]`.
    pub keys: Vec<(String, Setting)>,
    /// The reason why the entry is written as a comment, for a person to complete.
    pub held_back: Option<String>,
}

/// Why a text cannot be changed.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum EditError {
    /// It is not TOML.
    #[error("not TOML: {0}")]
    Syntax(String),
    /// A key of a new entry is invalid.
    #[error("{key:?} cannot be set: {reason}")]
    Key {
        /// The key.
        key: String,
        /// Why.
        reason: &'static str,
    },
    /// There is no such entry.
    #[error("no entry [device.{0}]")]
    NoEntry(String),
    /// It is not written as a separate table.
    #[error("[device.{0}] is not written as a table under its own header: take it out by hand")]
    NoHeader(String),
}

/// `text` with the entries at its end.
///
/// # Errors
/// When a key is invalid, or is given twice with different meanings.
pub fn append(text: &str, entries: &[NewEntry]) -> Result<String, EditError> {
    let parts: Vec<String> = entries.iter().map(written).collect::<Result<_, _>>()?;
    Ok(append_lines(text, &parts))
}

/// `text` with these parts at its end, each after an empty line.
pub fn append_lines(text: &str, parts: &[String]) -> String {
    let added: String = parts.iter().flat_map(|part| ["\n", part]).collect();
    let mut new = text.to_owned();
    if !new.is_empty() && !new.ends_with('\n') {
        new.push('\n');
    }
    let added = if new.is_empty() { added.trim_start_matches('\n') } else { &added };
    // The existing kind of line ends is kept.
    if text.contains("\r\n") {
        new.push_str(&added.replace('\n', "\r\n"));
    } else {
        new.push_str(added);
    }
    new
}

/// The lines of a `[module.NAME]`, including line ends.
///
/// # Errors
/// When a key is invalid.
pub fn module(
    name: &str,
    slot: &str,
    (tags, devices): (&[String], &[String]),
    transforms: &[(String, Vec<(String, Setting)>)],
) -> Result<String, EditError> {
    let mut table = Table::new();
    put(&mut table, "slot", &Setting::Text(slot.to_owned()))?;
    for (key, texts) in [("tags", tags), ("devices", devices)].into_iter().filter(|(_, texts)| !texts.is_empty()) {
        table.insert(key, Item::Value(texts.iter().map(String::as_str).collect::<Value>()));
    }
    for (sensor, place) in transforms {
        for (key, setting) in place {
            put(&mut table, &format!("transform.{sensor}.{key}"), setting)?;
        }
    }
    let mut modules = Table::new();
    modules.set_implicit(true);
    modules.insert(name, Item::Table(table));
    let mut document = DocumentMut::new();
    document.insert("module", Item::Table(modules));
    Ok(format!("{}\n", document.to_string().trim_matches('\n')))
}

/// The lines of one entry, including line ends.
///
/// # Errors
/// As [`append`].
pub fn written(entry: &NewEntry) -> Result<String, EditError> {
    let mut device = Table::new();
    for (key, setting) in &entry.keys {
        put(&mut device, key, setting)?;
    }
    let mut devices = Table::new();
    devices.set_implicit(true);
    devices.insert(&entry.name, Item::Table(device));
    let mut document = DocumentMut::new();
    document.insert("device", Item::Table(devices));
    let table = document.to_string();
    let mut lines: Vec<String> = entry.comments.iter().map(|comment| commented(one_line(comment))).collect();
    match &entry.held_back {
        Some(reason) => {
            lines.push(commented(format!("Not in use: {}", one_line(reason))));
            lines.extend(table.trim_matches('\n').lines().map(commented));
        }
        None => lines.extend(table.trim_matches('\n').lines().map(str::to_owned)),
    }
    let mut text = lines.join("\n");
    text.push('\n');
    Ok(text)
}

/// `text` without the entry `name`: its tables, the text between them, and the comment directly
/// above. Comments separated from it by an empty line stay.
///
/// # Errors
/// When there is no such entry or it is not written under separate headers.
pub fn remove(text: &str, name: &str) -> Result<String, EditError> {
    let document = Document::parse(text).map_err(|error| EditError::Syntax(error.message().to_owned()))?;
    let entry = document.as_table().get("device").and_then(|devices| devices.get(name));
    if entry.is_none() {
        return Err(EditError::NoEntry(name.to_owned()));
    }
    let mut tables = Vec::new();
    collect(document.as_table(), &mut Vec::new(), &mut tables);
    tables.sort_by_key(|table| table.header.start);
    let is_own = |table: &Placed| {
        let path: Vec<&str> = table.path.iter().map(String::as_str).collect();
        path.starts_with(&["device", name])
    };
    if !tables.iter().any(is_own) {
        return Err(EditError::NoHeader(name.to_owned()));
    }
    let mut gone: Vec<Range<usize>> = Vec::new();
    for (at, table) in tables.iter().enumerate().filter(|(_, table)| is_own(table)) {
        let follows = at > 0 && tables.get(at - 1).is_some_and(is_own);
        let begin =
            if follows { gone.pop().map_or(0, |last| last.start) } else { with_comment(text, table.header.start) };
        let next = tables.get(at + 1).map_or(text.len(), |next| with_comment(text, next.header.start));
        gone.push(begin..end_of_paragraph(text, table.end).min(next.max(begin)));
    }
    let mut new = String::with_capacity(text.len());
    let mut at = 0;
    for range in gone {
        new.push_str(text.get(at..range.start).unwrap_or_default());
        at = range.end;
        // One of the two empty lines around it is removed.
        if new.is_empty() || new.ends_with("\n\n") || new.ends_with("\n\r\n") {
            let rest = text.get(at..).unwrap_or_default();
            at += rest.len() - rest.strip_prefix("\r\n").or(rest.strip_prefix('\n')).unwrap_or(rest).len();
        }
    }
    let rest = text.get(at..).unwrap_or_default();
    new.push_str(rest);
    // The empty line between it and the text above is removed.
    if rest.is_empty() {
        let end = new.trim_end_matches(['\n', '\r']).len();
        new.truncate(end);
        if end > 0 {
            new.push_str(if text.contains("\r\n") { "\r\n" } else { "\n" });
        }
    }
    Ok(new)
}

/// `text` with each table of a serial line that has its old name, `[device.NAME.serial]`, under the present one,
/// `[device.NAME.tty]`. One of which a part cannot be renamed stays, and so does a text that is not TOML.
pub fn renamed(text: &str) -> String {
    let names = |text: &str| -> Option<Vec<String>> {
        let document = Document::parse(text).ok()?;
        Some(document.get("device")?.as_table_like()?.iter().map(|(name, _)| name.to_owned()).collect())
    };
    names(text).into_iter().flatten().fold(text.to_owned(), |text, name| with_tty(&text, &name).unwrap_or(text))
}

/// `text` with that table of this device renamed; `None` if it has none, or has both.
fn with_tty(text: &str, name: &str) -> Option<String> {
    let document = Document::parse(text).ok()?;
    let device = document.get("device")?.get(name)?.as_table_like().filter(|device| !device.contains_key("tty"))?;
    let (key, item) = device.get_key_value("serial")?;
    let is_dotted = item.as_table().is_some_and(Table::is_dotted)
        || item.as_inline_table().is_some_and(toml_edit::InlineTable::is_dotted);
    let table = item.as_table_like()?;
    let mut spans: Vec<_> = if is_dotted {
        // A name for each key, of which the parser keeps one.
        let before = |(key, _)| name_before(text, table.key(key)?.span()?.start);
        table.iter().map(before).collect::<Option<_>>()?
    } else {
        vec![key.span()?]
    };
    spans.sort_by_key(|span| std::cmp::Reverse(span.start));
    let mut new = text.to_owned();
    for span in spans {
        new.replace_range(span, "tty");
    }
    let is_whole = Document::parse(&new).is_ok_and(|new| {
        let device = new.get("device").and_then(|devices| devices.get(name));
        device.is_some_and(|device| device.get("serial").is_none() && device.get("tty").is_some())
    });
    is_whole.then_some(new)
}

/// Where `serial` is that stands with a dot before the key that starts here.
fn name_before(text: &str, key: usize) -> Option<Range<usize>> {
    let before = text.get(..key)?.trim_end().strip_suffix('.')?.trim_end();
    let name = ["serial", "\"serial\"", "'serial'"].into_iter().find(|name| before.ends_with(name))?;
    Some(before.len() - name.len()..before.len())
}

/// Whether `text` contains no device yet. False for a text that is not TOML.
pub fn has_no_entries(text: &str) -> bool {
    Document::parse(text).is_ok_and(|document| !document.as_table().contains_key("device"))
}

/// A table under a separate header.
struct Placed {
    path: Vec<String>,
    header: Range<usize>,
    /// End of its last value, or of its header.
    end: usize,
}

fn collect(table: &Table, path: &mut Vec<String>, found: &mut Vec<Placed>) {
    if let Some(header) = table.span().filter(|_| !table.is_implicit() && !table.is_dotted() && !path.is_empty()) {
        found.push(Placed { path: path.clone(), end: end_of_values(table).unwrap_or(header.end), header });
    }
    for (key, item) in table {
        path.push(key.to_owned());
        match item {
            Item::Table(table) => collect(table, path, found),
            Item::ArrayOfTables(tables) => tables.iter().for_each(|table| collect(table, path, found)),
            Item::Value(_) | Item::None => {}
        }
        path.pop();
    }
}

fn end_of_values(table: &Table) -> Option<usize> {
    let end = |item: &Item| match item {
        Item::Table(inner) if inner.is_dotted() => end_of_values(inner),
        Item::Value(value) => value.span().map(|span| span.end),
        _ => None,
    };
    table.iter().filter_map(|(_, item)| end(item)).max()
}

/// The beginning of the line of `at`, or of the comment directly above it.
fn with_comment(text: &str, at: usize) -> usize {
    let line = |at: usize| text.get(..at).and_then(|before| before.rfind('\n')).map_or(0, |newline| newline + 1);
    let mut begin = line(at);
    while begin > 0 {
        let above = line(begin - 1);
        if !text.get(above..begin).is_some_and(|line| line.trim_start().starts_with('#')) {
            break;
        }
        begin = above;
    }
    begin
}

/// The end of the line of `at`, or of the comment directly below it.
fn end_of_paragraph(text: &str, at: usize) -> usize {
    let after =
        |at: usize| text.get(at..).and_then(|rest| rest.find('\n')).map_or(text.len(), |newline| at + newline + 1);
    let mut end = after(at);
    while text.get(end..after(end)).is_some_and(|line| line.trim_start().starts_with('#')) {
        end = after(end);
    }
    end
}

fn put(device: &mut Table, key: &str, setting: &Setting) -> Result<(), EditError> {
    let refused = |reason| EditError::Key { key: key.to_owned(), reason };
    let mut parts: Vec<&str> = key.split('.').collect();
    let last = parts.pop().unwrap_or_default();
    let legal =
        |part: &&str| !part.is_empty() && part.bytes().all(|b| b.is_ascii_alphanumeric() || matches!(b, b'_' | b'-'));
    if !parts.iter().chain([&last]).all(legal) {
        return Err(refused("write letters, digits and `_`, with dots between the tables, as camera.width"));
    }
    let mut table = device;
    for part in parts {
        let mut inner = Table::new();
        // Its line is written only if it has values of its own.
        inner.set_implicit(true);
        let item = table.entry(part).or_insert(Item::Table(inner));
        table = item.as_table_mut().ok_or_else(|| refused("its parent is not a table"))?;
    }
    if table.contains_table(last) {
        return Err(refused("it is a table"));
    }
    table.insert(last, Item::Value(value(setting)));
    Ok(())
}

fn value(setting: &Setting) -> Value {
    match setting {
        Setting::Text(text) => text.as_str().into(),
        Setting::Whole(number) => (*number).into(),
        Setting::Typed(typed) => match typed.trim().parse::<Value>() {
            Ok(mut value) => {
                value.decor_mut().clear();
                value
            }
            Err(_) => typed.as_str().into(),
        },
    }
}

fn commented(line: impl AsRef<str>) -> String {
    let line = line.as_ref();
    if line.is_empty() { "#".to_owned() } else { format!("# {line}") }
}

fn one_line(text: &str) -> String {
    text.replace(|c: char| c.is_control() || matches!(c, '\u{2028}' | '\u{2029}'), " ")
}

#[cfg(test)]
mod tests;
