//! The limits of the verdict: `[verdict]`, `[verdict.bad]`, `[device.NAME.verdict]` and
//! `[device.NAME.verdict.bad]`.
//!
//! 1. A limit that is not written is that of [`VerdictSpec::of`].
//! 2. `[verdict]` changes what is on by default; a check that is off for a kind of modality (two
//!    equal vectors of numbers are not a fault) is only turned on by the device's own table.
//! 3. A limit for SUSPECT beyond the one for BAD moves that one too, unless both are written: then
//!    the file contradicts itself. "off" turns both off, unless BAD is written.

use std::iter::zip;
use std::time::Duration;

use crate::section::Section;
use crate::spec::{Limits, VerdictSpec};

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
const TIMES: [(&str, Time); 5] = [
    ("frozen", |limits| &mut limits.frozen),
    ("gap", |limits| &mut limits.gap),
    ("opening", |limits| &mut limits.opening),
    ("clock", |limits| &mut limits.clock),
    ("uncertain", |limits| &mut limits.uncertain),
];

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Worse {
    More,
    Less,
}

/// A limit as written; `None` is "off".
type Given<T> = Option<T>;

/// The written limits of one grade.
#[derive(Debug, Default, Clone, Copy)]
struct Written {
    shares: [Option<Given<f64>>; SHARES.len()],
    times: [Option<Given<Duration>>; TIMES.len()],
}

/// A verdict table as written.
#[derive(Debug, Default, Clone, Copy)]
pub(super) struct VerdictTable {
    suspect: Written,
    bad: Written,
    hz: Option<f64>,
}

/// The owner of the table.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Whose {
    /// All devices.
    Rig,
    /// One device.
    Device,
}

/// Reads the table `verdict` of `section`.
pub(super) fn read(section: &Section<'_>, whose: Whose) -> VerdictTable {
    let mut table = VerdictTable::default();
    let Some(section) = section.table("verdict") else { return table };
    let checks = SHARES.iter().map(|(key, ..)| *key).chain(TIMES.iter().map(|(key, _)| *key));
    let mut known: Vec<&str> = checks.collect();
    let of_bad = known.clone();
    known.push("bad");
    if whose == Whose::Device {
        known.push("hz");
        table.hz = section.number("hz", 0.001..=100_000.0);
    } else if section.has("hz") {
        known.push("hz");
        let fix = "write it as hz = 100 in [device.NAME.verdict]";
        section.report("hz", "hz is the rate of one device".to_owned(), fix);
    }
    section.allow(&known);
    table.suspect = limits(&section);
    if let Some(bad) = section.table("bad") {
        bad.allow(&of_bad);
        table.bad = limits(&bad);
        contradictions(&table, &section, &bad);
    }
    table
}

fn limits(section: &Section<'_>) -> Written {
    let mut written = Written::default();
    for ((key, ..), share) in SHARES.iter().zip(&mut written.shares) {
        *share = read_share(section, key);
    }
    for ((key, _), time) in TIMES.iter().zip(&mut written.times) {
        *time = match section.word(key) {
            Some("off") => Some(None),
            _ => section.duration(key, Duration::from_millis(1)..=Duration::from_hours(1)).map(Some),
        };
    }
    written
}

/// `"0.1%"`, `"0.1 %"`, or `"off"`.
fn read_share(section: &Section<'_>, key: &str) -> Option<Given<f64>> {
    let usual = if ["rate", "valid"].contains(&key) { "90%" } else { "0.5%" };
    let fix = format!("write 0% to 100%, or \"off\", for example {key} = \"{usual}\"");
    if !section.has(key) {
        return None;
    }
    let Some(written) = section.word(key) else {
        return section.refuse(key, format!("{key} is not a share in percent"), fix);
    };
    if written == "off" {
        return Some(None);
    }
    let number = written.strip_suffix('%').map(str::trim);
    let is_plain = |number: &&str| number.bytes().all(|byte| byte.is_ascii_digit() || byte == b'.');
    let percent: Option<f64> = number.filter(is_plain).and_then(|number| number.parse().ok());
    match percent {
        Some(percent) if (0.0..=100.0).contains(&percent) => Some(Some(percent / 100.0)),
        Some(_) => section.refuse(key, format!("{key} = {written:?} is out of range"), fix),
        None => section.refuse(key, format!("{key} = {written:?} is not a share in percent"), fix),
    }
}

fn contradictions(table: &VerdictTable, section: &Section<'_>, bad: &Section<'_>) {
    let report = |key: &str| {
        let line = section.line_of(key);
        let message = format!("{key} is BAD before it is SUSPECT by [{}] on line {line}", section.entry);
        bad.report(key, message, "make the limit for BAD the more severe of the two");
    };
    for ((key, _, worse), written) in SHARES.iter().zip(zip(table.suspect.shares, table.bad.shares)) {
        if matches!(written, (Some(Some(suspect)), Some(Some(bad))) if worse.is_beyond(&suspect, &bad)) {
            report(key);
        }
    }
    for ((key, _), written) in TIMES.iter().zip(zip(table.suspect.times, table.bad.times)) {
        if matches!(written, (Some(Some(suspect)), Some(Some(bad))) if suspect > bad) {
            report(key);
        }
    }
}

impl Worse {
    /// Whether `a` is more severe than `b`.
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
        for ((_, of, worse), written) in SHARES.iter().zip(zip(table.suspect.shares, table.bad.shares)) {
            change(of(&mut spec.suspect), of(&mut spec.bad), written, whose, *worse);
        }
        for ((_, of), written) in TIMES.iter().zip(zip(table.suspect.times, table.bad.times)) {
            change(of(&mut spec.suspect), of(&mut spec.bad), written, whose, Worse::More);
        }
    }
    spec
}

fn change<T: PartialOrd + Copy>(
    suspect: &mut Option<T>,
    bad: &mut Option<T>,
    (new_suspect, new_bad): (Option<Given<T>>, Option<Given<T>>),
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
