//! Reading JSON objects by name, with every problem noted under its key.
//!
//! A getter returns `None` both for a key that is absent and for one whose value was wrong; either
//! has been reported, where it is one: the reader goes on, so that one look finds all problems, and
//! the result is thrown away if there were any.
//!
//! Invariant: text taken from the file is shown without control characters.

#![expect(clippy::option_option, reason = "`None` is a value that was wrong, `Some(None)` one that is null")]

use std::ops::{Range, RangeInclusive};

use serde_json::{Map, Value};

use super::spec::BundleErrors;
use crate::registry::{Diagnostic, did_you_mean};
use crate::text;

/// A file with more problems than this is not one of ours; nobody reads on.
const MOST_PROBLEMS: usize = 500;

/// The problems found so far.
#[derive(Debug)]
pub(super) struct Problems {
    file: String,
    found: Vec<Diagnostic>,
}

impl Problems {
    pub(super) fn new(file: &str) -> Self {
        Self { file: text::plain(file).into_owned(), found: Vec::new() }
    }

    /// Notes a problem of the object `entry`; of the whole file if that is empty.
    pub(super) fn report(&mut self, entry: &str, message: impl AsRef<str>, fix: impl AsRef<str>) {
        self.report_at((0, 0), entry, message.as_ref(), fix.as_ref());
    }

    /// Notes a problem at a line and column, both from 1.
    pub(super) fn report_at(&mut self, (line, column): (usize, usize), entry: &str, message: &str, fix: &str) {
        if self.found.len() < MOST_PROBLEMS {
            self.found.push(Diagnostic {
                file: self.file.clone(),
                line,
                column,
                entry: (!entry.is_empty()).then(|| text::plain(entry).into_owned()),
                message: text::plain(message).into_owned(),
                fix: Some(text::plain(fix).into_owned()),
            });
        }
    }

    /// `Err` with all problems so far, if there are any.
    pub(super) fn check(self) -> Result<(), BundleErrors> {
        if self.found.is_empty() { Ok(()) } else { Err(BundleErrors { diagnostics: self.found }) }
    }
}

/// A key and what to write there.
pub(super) type Key = (&'static str, &'static str);

/// An object, and where it stands.
#[derive(Debug, Clone)]
pub(super) struct Object<'v> {
    /// `action.limits`; empty for the file itself.
    pub(super) entry: String,
    map: &'v Map<String, Value>,
    keys: &'static [Key],
}

impl<'v> Object<'v> {
    /// `value` as an object that has no other keys than `keys`.
    pub(super) fn new(entry: String, value: &'v Value, keys: &'static [Key], problems: &mut Problems) -> Option<Self> {
        let Value::Object(map) = value else {
            let message = format!("must be an object, but is {}", kind(value));
            problems.report(&entry, message, format!("write {{...}} with {}", names(keys).join(", ")));
            return None;
        };
        for given in map.keys().filter(|given| keys.iter().all(|(name, _)| name != given)) {
            let fix = did_you_mean(given, &names(keys), "the keys here are");
            problems.report(&entry, format!("unknown key \"{given}\""), fix);
        }
        Some(Self { entry, map, keys })
    }

    /// Where the value of `name` stands.
    pub(super) fn path(&self, name: &str) -> String {
        if self.entry.is_empty() { name.to_owned() } else { format!("{}.{name}", self.entry) }
    }

    pub(super) fn has(&self, name: &str) -> bool {
        self.map.contains_key(name)
    }

    /// The value of `name`, which must be there.
    pub(super) fn value(&self, name: &str, problems: &mut Problems) -> Option<&'v Value> {
        let value = self.map.get(name);
        if value.is_none() {
            problems.report(&self.entry, format!("{name} is missing"), self.fix(name));
        }
        value
    }

    /// Notes that the value of `name` is wrong.
    pub(super) fn report(&self, name: &str, message: &str, problems: &mut Problems) {
        let space = if message.starts_with('[') { "" } else { " " };
        problems.report(&self.entry, format!("{name}{space}{message}"), self.fix(name));
    }

    fn fix(&self, name: &str) -> String {
        let what = self.keys.iter().find(|(key, _)| *key == name).map_or("", |(_, what)| what);
        format!("write \"{name}\": {what}")
    }

    fn wrong_kind(&self, name: &str, wanted: &str, value: &Value, problems: &mut Problems) {
        self.report(name, &format!("must be {wanted}, but is {}", kind(value)), problems);
    }

    /// The object under `name`.
    pub(super) fn object(&self, name: &str, keys: &'static [Key], problems: &mut Problems) -> Option<Object<'v>> {
        Object::new(self.path(name), self.value(name, problems)?, keys, problems)
    }

    /// The same where it may be null.
    pub(super) fn object_or_null(
        &self,
        name: &str,
        keys: &'static [Key],
        problems: &mut Problems,
    ) -> Option<Option<Object<'v>>> {
        let value = self.value(name, problems)?;
        if value.is_null() { Some(None) } else { Object::new(self.path(name), value, keys, problems).map(Some) }
    }

    /// The elements of the list under `name`.
    pub(super) fn list(&self, name: &str, problems: &mut Problems) -> Option<&'v [Value]> {
        let value = self.value(name, problems)?;
        if let Value::Array(list) = value {
            return Some(list);
        }
        self.wrong_kind(name, "a list", value, problems);
        None
    }

    /// A text that can be shown and is not empty.
    pub(super) fn text(&self, name: &str, problems: &mut Problems) -> Option<String> {
        match self.value(name, problems)? {
            Value::String(text) => match unfit(text) {
                Some(unfit) => self.report(name, unfit, problems),
                None => return Some(text.clone()),
            },
            value => self.wrong_kind(name, "text", value, problems),
        }
        None
    }

    /// `true` or `false`.
    pub(super) fn flag(&self, name: &str, problems: &mut Problems) -> Option<bool> {
        let value = self.value(name, problems)?;
        if let Value::Bool(flag) = value {
            return Some(*flag);
        }
        self.wrong_kind(name, "true or false", value, problems);
        None
    }

    /// One of `words`.
    pub(super) fn word<T: Copy>(&self, name: &str, words: &[(&str, T)], problems: &mut Problems) -> Option<T> {
        let value = self.value(name, problems)?;
        let Value::String(given) = value else {
            self.wrong_kind(name, "text", value, problems);
            return None;
        };
        let found = words.iter().find(|(word, _)| word == given).map(|(_, meaning)| *meaning);
        if found.is_none() {
            let known: Vec<&str> = words.iter().map(|(word, _)| *word).collect();
            let fix = did_you_mean(given, &known, "write one of");
            problems.report(&self.entry, format!("unknown {name} \"{given}\""), fix);
        }
        found
    }

    /// The same where it may be null.
    pub(super) fn word_or_null<T: Copy>(
        &self,
        name: &str,
        words: &[(&str, T)],
        problems: &mut Problems,
    ) -> Option<Option<T>> {
        if self.map.get(name).is_some_and(Value::is_null) {
            return Some(None);
        }
        self.word(name, words, problems).map(Some)
    }

    /// A whole number within `range`.
    pub(super) fn integer(&self, name: &str, range: RangeInclusive<usize>, problems: &mut Problems) -> Option<usize> {
        let value = self.value(name, problems)?;
        let Value::Number(number) = value else {
            self.wrong_kind(name, "a whole number", value, problems);
            return None;
        };
        let found = number.as_u64().and_then(|number| usize::try_from(number).ok()).filter(|n| range.contains(n));
        if found.is_none() {
            let wanted = if number.is_f64() { "is no whole number".to_owned() } else { within(&range) };
            self.report(name, &format!("= {number} {wanted}"), problems);
        }
        found
    }

    /// A number within `range`.
    pub(super) fn number(&self, name: &str, range: RangeInclusive<f64>, problems: &mut Problems) -> Option<f64> {
        let value = self.value(name, problems)?;
        let Some(number) = value.as_f64() else {
            self.wrong_kind(name, "a number", value, problems);
            return None;
        };
        if range.contains(&number) {
            return Some(number);
        }
        self.report(name, &format!("= {number} {}", within(&range)), problems);
        None
    }

    /// `len` numbers that an f32 can hold, if their number is known.
    pub(super) fn numbers(&self, name: &str, len: Option<usize>, problems: &mut Problems) -> Option<Vec<f32>> {
        let list = self.list(name, problems)?;
        let mut whole = true;
        if let Some(len) = len.filter(|len| *len != list.len()) {
            let dimensions = if len == 1 { "dimension" } else { "dimensions" };
            self.report(name, &format!("has {} numbers for {len} {dimensions}", list.len()), problems);
            whole = false;
        }
        let mut numbers = Vec::with_capacity(list.len());
        for (at, value) in list.iter().enumerate() {
            #[expect(clippy::cast_possible_truncation, reason = "what becomes infinite is refused")]
            match value.as_f64().map(|number| number as f32) {
                Some(number) if number.is_finite() => numbers.push(number),
                Some(_) => {
                    self.report(name, &format!("[{at}] = {value} is beyond the range of a 32-bit float"), problems);
                    whole = false;
                }
                None => {
                    self.report(name, &format!("[{at}] must be a number, but is {}", kind(value)), problems);
                    whole = false;
                }
            }
        }
        whole.then_some(numbers)
    }

    /// Texts that can be shown, none of them empty.
    pub(super) fn texts(&self, name: &str, problems: &mut Problems) -> Option<Vec<String>> {
        let list = self.list(name, problems)?;
        let mut texts = Vec::with_capacity(list.len());
        for (at, value) in list.iter().enumerate() {
            match value {
                Value::String(text) => match unfit(text) {
                    Some(unfit) => self.report(name, &format!("[{at}] {unfit}"), problems),
                    None => texts.push(text.clone()),
                },
                value => self.report(name, &format!("[{at}] must be text, but is {}", kind(value)), problems),
            }
        }
        (texts.len() == list.len()).then_some(texts)
    }

    /// A list of whole numbers within `range`, `len` of them.
    pub(super) fn integers(
        &self,
        name: &str,
        len: usize,
        range: RangeInclusive<usize>,
        problems: &mut Problems,
    ) -> Option<Vec<usize>> {
        let list = self.list(name, problems)?;
        let read = |value: &Value| value.as_u64().and_then(|number| usize::try_from(number).ok());
        let numbers: Option<Vec<usize>> = list.iter().map(|value| read(value).filter(|n| range.contains(n))).collect();
        let numbers = numbers.filter(|numbers| numbers.len() == len);
        if numbers.is_none() {
            let (least, most) = range.into_inner();
            let wanted = if len == 1 { "a whole number".to_owned() } else { format!("{len} whole numbers") };
            self.report(name, &format!("must be a list of {wanted} from {least} to {most}"), problems);
        }
        numbers
    }

    /// `[height, width]`, or null.
    pub(super) fn size_or_null(&self, name: &str, problems: &mut Problems) -> Option<Option<[usize; 2]>> {
        if self.map.get(name).is_some_and(Value::is_null) {
            return Some(None);
        }
        let size = self.integers(name, 2, 1..=super::parse::MAX_SIDE, problems)?;
        Some(<[usize; 2]>::try_from(size).ok())
    }

    /// `[begin, end]`, end not included, not empty.
    pub(super) fn slice(&self, name: &str, problems: &mut Problems) -> Option<Range<usize>> {
        let ends = self.integers(name, 2, 0..=super::parse::MAX_VALUES, problems)?;
        if ends[0] < ends[1] {
            return Some(ends[0]..ends[1]);
        }
        self.report(name, &format!("= [{}, {}] is empty", ends[0], ends[1]), problems);
        None
    }
}

pub(super) fn names(keys: &[Key]) -> Vec<&'static str> {
    keys.iter().map(|(name, _)| *name).collect()
}

/// Why a text cannot be a name that is shown.
fn unfit(given: &str) -> Option<&'static str> {
    match given {
        "" => Some("is empty"),
        given if text::plain(given) != given => Some("holds control characters"),
        _ => None,
    }
}

fn within<T: std::fmt::Debug>(range: &RangeInclusive<T>) -> String {
    format!("is not within {:?} and {:?}", range.start(), range.end())
}

fn kind(value: &Value) -> &'static str {
    match value {
        Value::Null => "null",
        Value::Bool(_) => "true or false",
        Value::Number(number) if number.is_f64() => "a decimal number",
        Value::Number(_) => "a number",
        Value::String(_) => "text",
        Value::Array(_) => "a list",
        Value::Object(_) => "an object",
    }
}
