//! Errors in a file written by a person, worded so that the person can fix them.
//!
//! Invariant: text taken from the file is shown escaped: no file can send control characters to a
//! terminal.

use std::fmt;

use rapid_core::text::escaped;
use serde::Serialize;

/// One problem of a configuration or scenario file.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Diagnostic {
    /// The file as the user named it.
    pub file: String,
    /// Line from 1; 0 when the problem is the file itself.
    pub line: usize,
    /// Column in characters from 1; 0 when the problem is the file itself.
    pub column: usize,
    /// The table it is about, for example `device.cam_wrist`.
    pub entry: Option<String>,
    /// What is wrong.
    pub message: String,
    /// What to do about it.
    pub fix: Option<String>,
}

impl fmt::Display for Diagnostic {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", escaped(&self.file))?;
        if self.line > 0 {
            write!(f, ":{}:{}", self.line, self.column)?;
        }
        write!(f, ": ")?;
        if let Some(entry) = &self.entry {
            write!(f, "[{}] ", escaped(entry))?;
        }
        write!(f, "{}", escaped(&self.message))?;
        if let Some(fix) = &self.fix {
            write!(f, "\n    fix: {}", escaped(fix))?;
        }
        Ok(())
    }
}

/// All problems of one file, in the order of the file. Never empty.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{}", self.listing())]
pub struct RegistryErrors {
    /// The problems.
    pub diagnostics: Vec<Diagnostic>,
}

impl RegistryErrors {
    /// A problem with a file as a whole.
    pub(super) fn whole_file(file: String, message: impl Into<String>, fix: impl Into<String>) -> Self {
        let message = message.into();
        Self { diagnostics: vec![Diagnostic { file, line: 0, column: 0, entry: None, message, fix: Some(fix.into()) }] }
    }

    fn listing(&self) -> String {
        self.diagnostics.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n")
    }
}

/// The name in `known` that was probably meant by `given`.
pub(super) fn nearest<'k>(given: &str, known: impl IntoIterator<Item = &'k str>) -> Option<&'k str> {
    let given = given.to_lowercase();
    // Comparing takes the product of the lengths: no known name is nearly this long.
    if given.len() > 100 {
        return None;
    }
    let allowed = (given.chars().count() / 3).max(1);
    known
        .into_iter()
        .map(|name| (strsim::damerau_levenshtein(&given, &name.to_lowercase()), name))
        .filter(|(distance, _)| *distance <= allowed)
        .min_by_key(|(distance, _)| *distance)
        .map(|(_, name)| name)
}

/// The fix for an unknown name: the nearest known one, or a list of all.
pub fn did_you_mean<S: AsRef<str>>(given: &str, known: impl IntoIterator<Item = S>, what: &str) -> String {
    let known: Vec<S> = known.into_iter().collect();
    let known: Vec<&str> = known.iter().map(AsRef::as_ref).collect();
    match nearest(given, known.iter().copied()) {
        Some(name) => format!("did you mean \"{name}\"?"),
        None => format!("{what}: {}", known.join(", ")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_text_of_a_file_reaches_the_terminal_unescaped() {
        let hostile = "a\r\u{1b}[2J\u{9b}\u{202e}\u{200b}\u{7f}b".to_owned();
        let (file, message) = (hostile.clone(), hostile.clone());
        let diagnostic =
            Diagnostic { file, line: 1, column: 1, entry: Some(hostile.clone()), message, fix: Some(hostile) };
        let shown = r"a\u{d}\u{1b}[2J\u{9b}\u{202e}\u{200b}\u{7f}b";
        assert_eq!(diagnostic.to_string(), format!("{shown}:1:1: [{shown}] {shown}\n    fix: {shown}"));
    }
}
