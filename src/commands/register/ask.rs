//! Questions on a terminal: a line out, a line in.

use std::io::{self, BufRead, Write};

use super::RegisterError;
use crate::text;

/// Whom to ask. Plain lines: it works on any terminal, over ssh, and from a test.
pub struct Dialogue<'a> {
    /// Answers.
    pub input: &'a mut dyn BufRead,
    /// Questions.
    pub out: &'a mut dyn Write,
}

impl Dialogue<'_> {
    /// Says a line, or several.
    pub(super) fn say(&mut self, line: &str) -> io::Result<()> {
        for line in line.split('\n') {
            writeln!(self.out, "{}", text::plain(line))?;
        }
        self.out.flush()
    }

    /// Asks until `take` makes something of the answer; an empty line is the default.
    pub(super) fn ask<T>(
        &mut self,
        question: &str,
        default: Option<&str>,
        mut take: impl FnMut(&str) -> Result<T, String>,
    ) -> Result<T, RegisterError> {
        /// More than any answer takes.
        const LONGEST: u64 = 4096;
        loop {
            let shown = default.map_or_else(String::new, |default| format!(" [{default}]"));
            write!(self.out, "{}{}: ", text::plain(question), text::plain(&shown))?;
            self.out.flush()?;
            let mut line = Vec::new();
            if io::Read::take(&mut *self.input, LONGEST).read_until(b'\n', &mut line)? == 0 {
                writeln!(self.out)?;
                return Err(RegisterError::Ended);
            }
            let line = String::from_utf8_lossy(&line);
            let answer = match (line.trim(), default) {
                ("", Some(default)) => default,
                (answer, _) => answer,
            };
            match take(answer) {
                Ok(taken) => return Ok(taken),
                Err(why) => self.say(&format!("  {why}"))?,
            }
        }
    }

    /// Yes or no; an empty line is yes.
    pub(super) fn agrees(&mut self, question: &str) -> Result<bool, RegisterError> {
        self.ask(question, Some("y"), |answer| match answer.to_lowercase().as_str() {
            "y" | "yes" => Ok(true),
            "n" | "no" => Ok(false),
            _ => Err("y or n".to_owned()),
        })
    }
}
