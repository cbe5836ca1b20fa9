//! The limits of the verdict: `[verdict]`, `[verdict.bad]`, `[device.NAME.verdict]` and
//! `[device.NAME.verdict.bad]`.
//!
//! 1. A limit that is written nowhere is that of [`VerdictSpec::of`].
//! 2. `[verdict]` changes what is on by default; a check that is off for a kind of modality (two
//!    equal vectors of numbers are no fault) is only turned on by the device's own table.
//! 3. A limit for SUSPECT beyond the one for BAD moves that one along, unless both are written: then
//!    the file contradicts itself. "off" turns both off, unless BAD is written.

use std::time::Duration;

use crate::registry::limits::{Limits, VerdictSpec};
use crate::registry::section::{Problems, Section};

type Share = fn(&mut Limits) -> &mut Option<f64>;
type Time = fn(&mut Limits) -> &mut Option<Duration>;

/// Checks whose limit is a share, and whether more of it is worse.
const SHARES: [(&str, Share, Worse); 8] = [
    ("lost", |limits| &mut limits.lost, Worse::More),
    ("dropped", |limits| &mut limits.dropped, Worse::More),
    ("damaged", |limits| &mut limits.damaged, Worse::More),
    ("duplicate", |limits| &mut limits.duplicate, Worse::More),
    ("repeated", |limits| &mut limits.repeated, Worse::More),
    ("late", |limits| &mut limits.late, Worse::More),
    ("rate", |limits| &mut limits.rate, Worse::Less),
    ("valid", |limits| &mut limits.valid, Worse::Less),
];
/// Checks whose limit is a time; longer is worse.
const TIMES: [(&str, Time); 4] = [
    ("frozen", |limits| &mut limits.frozen),
    ("gap", |limits| &mut limits.gap),
    ("opening", |limits| &mut limits.opening),
    ("clock", |limits| &mut limits.clock),
];

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Worse {
    More,
    Less,
}

/// A limit as it was written; `None` is "off".
type Given<T> = Option<T>;

/// The limits of one grade as they were written, as far as they were.
#[derive(Debug, Default, Clone, Copy)]
struct Written {
    shares: [Option<Given<f64>>; SHARES.len()],
    times: [Option<Given<Duration>>; TIMES.len()],
}

/// A verdict table as it was written.
#[derive(Debug, Default, Clone, Copy)]
pub(super) struct VerdictTable {
    suspect: Written,
    bad: Written,
    hz: Option<f64>,
}

/// Whose table it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Whose {
    /// All devices'.
    Rig,
    /// One device's.
    Device,
}

/// Reads the table `verdict` of `section`.
pub(super) fn read(section: &Section<'_>, whose: Whose, problems: &mut Problems<'_>) -> VerdictTable {
    let mut table = VerdictTable::default();
    let Some(section) = section.table(problems, "verdict") else { return table };
    let checks = SHARES.iter().map(|(key, ..)| *key).chain(TIMES.iter().map(|(key, _)| *key));
    let mut known: Vec<&str> = checks.collect();
    let of_bad = known.clone();
    known.push("bad");
    if whose == Whose::Device {
        known.push("hz");
        table.hz = section.number(problems, "hz", 0.001..=100_000.0);
    } else if section.has("hz") {
        known.push("hz");
        let fix = "write it as hz = 100 in [device.NAME.verdict]";
        section.report(problems, "hz", "hz is the rate of one device".to_owned(), fix);
    }
    section.allow(problems, &known);
    table.suspect = limits(&section, problems);
    if let Some(bad) = section.table(problems, "bad") {
        bad.allow(problems, &of_bad);
        table.bad = limits(&bad, problems);
        contradictions(&table, &section, &bad, problems);
    }
    table
}

fn limits(section: &Section<'_>, problems: &mut Problems<'_>) -> Written {
    let mut written = Written::default();
    for ((key, ..), share) in SHARES.iter().zip(&mut written.shares) {
        *share = read_share(section, key, problems);
    }
    for ((key, _), time) in TIMES.iter().zip(&mut written.times) {
        *time = match text(section, key) {
            Some("off") => Some(None),
            _ => section.duration(problems, key, Duration::from_millis(1)..=Duration::from_hours(1)).map(Some),
        };
    }
    written
}

/// The text of `key`, if it is one.
fn text<'a>(section: &Section<'a>, key: &str) -> Option<&'a str> {
    section.fields().into_iter().find(|(_, name, _)| *name == key)?.2.get_ref().as_str()
}

/// `"0.1%"`, `"0.1 %"`, or `"off"`.
fn read_share(section: &Section<'_>, key: &str, problems: &mut Problems<'_>) -> Option<Given<f64>> {
    let usual = if ["rate", "valid"].contains(&key) { "90%" } else { "0.5%" };
    let fix = format!("write 0% to 100%, or \"off\", for example {key} = \"{usual}\"");
    if !section.has(key) {
        return None;
    }
    let Some(written) = text(section, key) else {
        section.report(problems, key, format!("{key} is not a share in percent"), fix);
        return None;
    };
    if written == "off" {
        return Some(None);
    }
    let number = written.strip_suffix('%').map(str::trim);
    let is_plain = |number: &&str| number.bytes().all(|byte| byte.is_ascii_digit() || byte == b'.');
    let percent: Option<f64> = number.filter(is_plain).and_then(|number| number.parse().ok());
    match percent {
        Some(percent) if (0.0..=100.0).contains(&percent) => return Some(Some(percent / 100.0)),
        Some(_) => section.report(problems, key, format!("{key} = {written:?} is out of range"), fix),
        None => section.report(problems, key, format!("{key} = {written:?} is not a share in percent"), fix),
    }
    None
}

fn contradictions(table: &VerdictTable, section: &Section<'_>, bad: &Section<'_>, problems: &mut Problems<'_>) {
    let mut report = |key: &str| {
        let line = problems.line(section.at_of(key));
        let message = format!("{key} is BAD before it is SUSPECT by [{}] on line {line}", section.entry);
        bad.report(problems, key, message, "make the limit for BAD the graver of the two");
    };
    for (index, (key, _, worse)) in SHARES.iter().enumerate() {
        let written = |of: &Written| of.shares.get(index).copied().flatten().flatten();
        if let (Some(suspect), Some(bad)) = (written(&table.suspect), written(&table.bad))
            && worse.is_beyond(&suspect, &bad)
        {
            report(key);
        }
    }
    for (index, (key, _)) in TIMES.iter().enumerate() {
        let written = |of: &Written| of.times.get(index).copied().flatten().flatten();
        if let (Some(suspect), Some(bad)) = (written(&table.suspect), written(&table.bad))
            && suspect > bad
        {
            report(key);
        }
    }
}

impl Worse {
    /// Is `a` a graver value than `b`?
    fn is_beyond<T: PartialOrd>(self, a: &T, b: &T) -> bool {
        match self {
            Self::More => a > b,
            Self::Less => a < b,
        }
    }
}

/// The limits of a device: `spec`, the defaults, changed by the rig's table, then by its own.
pub(super) fn changed(mut spec: VerdictSpec, rig: &VerdictTable, own: &VerdictTable) -> VerdictSpec {
    spec.hz = own.hz.or(spec.hz);
    for (table, whose) in [(rig, Whose::Rig), (own, Whose::Device)] {
        for (index, (_, of, worse)) in SHARES.iter().enumerate() {
            let written = |of: &Written| of.shares.get(index).copied().flatten();
            change(
                of(&mut spec.suspect),
                of(&mut spec.bad),
                written(&table.suspect),
                written(&table.bad),
                whose,
                *worse,
            );
        }
        for (index, (_, of)) in TIMES.iter().enumerate() {
            let written = |of: &Written| of.times.get(index).copied().flatten();
            let (suspect, bad) = (written(&table.suspect), written(&table.bad));
            change(of(&mut spec.suspect), of(&mut spec.bad), suspect, bad, whose, Worse::More);
        }
    }
    spec
}

fn change<T: PartialOrd + Copy>(
    suspect: &mut Option<T>,
    bad: &mut Option<T>,
    new_suspect: Option<Given<T>>,
    new_bad: Option<Given<T>>,
    whose: Whose,
    worse: Worse,
) {
    if whose == Whose::Rig && suspect.is_none() && bad.is_none() {
        return;
    }
    if let Some(new) = new_suspect {
        *suspect = new;
        match (new, *bad) {
            (None, _) => *bad = None,
            (Some(new), Some(old)) if worse.is_beyond(&new, &old) => *bad = Some(new),
            _ => {}
        }
    }
    if let Some(new) = new_bad {
        *bad = new;
    }
}
