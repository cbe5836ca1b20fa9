//! The limits of the verdict: `[verdict]`, `[verdict.bad]`, `[device.NAME.verdict]` and
//! `[device.NAME.verdict.bad]`.
//!
//! 1. A limit that is not written is that of [`VerdictSpec::defaults`].
//! 2. `[verdict]` changes what is on by default; a check that is off for a kind of modality (two
//!    equal vectors of numbers are not a fault) is only turned on by the device's own table.
//! 3. A limit for SUSPECT beyond the one for BAD moves that one too, unless both are written: then
//!    the file contradicts itself. "off" turns both off, unless BAD is written.

use std::iter::zip;
use std::time::Duration;

use crate::keys::{About, Keys, Own, Real, keys, text};
use crate::section::Section;
use crate::spec::{Limits, VerdictSpec};

const SHARE: Own<Given<f64>> = text(share, "a share as `\"0.5%\"`, or `\"off\"`");
const TIME: Own<Given<Duration>> = text(time, "a duration, 1ms to 1h, or `\"off\"`");

keys! {
    /// The limits of one grade. The defaults are those for SUSPECT, then those for BAD.
    const LIMITS {
        /// Samples that the device lost before they were received.
        lost = SHARE, usually "1 %, 5 %";
        /// Samples lost between the driver and the file.
        dropped = SHARE, usually "0, 5 %";
        /// Samples that the driver reported as damaged, pictures that are not usable, and samples with a number that is not finite.
        damaged = SHARE, usually "1 %, 5 %";
        /// Samples with a non-increasing sequence number or capture time.
        duplicate = SHARE, usually "0.1 %, 5 %";
        /// Samples that are byte-identical to the one before.
        repeated = SHARE, usually "10 %, 60 % of pictures; others off";
        /// Samples that came too late for their frame.
        late = SHARE, usually "1 %, 20 %";
        /// Least rate while the device was attached, of the nominal one.
        rate = SHARE, usually "90 %, 50 %";
        /// Least share of the ticks while the device was attached that have a sample of it in `sync_window`.
        valid = SHARE, usually "90 %, 50 %";
        /// Least share of the episode in which the device was present.
        present = SHARE, usually "90 %, 50 % of what `expect` names; others off";
        /// Longest time in which every sample is byte-identical to the one before.
        frozen = TIME, usually "500 ms, 2 s of pictures; others off";
        /// Longest time without a sample while the device was attached.
        gap = TIME, usually "`stall_after`, ten times it";
        /// Longest time in which the device was plugged in and did not run.
        opening = TIME, usually "5 s, off";
        /// Change of the stamps against this machine's clock over the episode.
        clock = TIME, usually "10 ms, 100 ms";
        /// How far the capture times of a device with a clock of its own, a phone or another computer, may be wrong.
        uncertain = TIME, usually "half of `sync_window`, off; others off";
        /// Time of the episode that a device which records by itself did not record; one that recorded nothing is always BAD.
        clip = TIME, usually "2 s, off of GoPros; others off";
    }
}

keys! {
    /// More severe limits.
    const BAD {} => {
        /// Limits beyond which an episode is BAD.
        bad = About::Table(&[LIMITS]);
    }
}

keys! {
    /// The nominal rate.
    struct RateKeys {
        /// Samples a second of the device.
        hz: Option<f64> = Real(0.001, 100_000.0), usually "unknown; of a camera its `fps`";
    }
}

/// The keys of `[verdict]`, and those of `[device.NAME.verdict]`.
pub(super) const OF_THE_RIG: Keys = &[LIMITS, BAD];
pub(super) const OF_A_DEVICE: Keys = &[LIMITS, BAD, RateKeys::KEYS];

type Share = fn(&mut Limits) -> &mut Option<f64>;
type Moment = fn(&mut Limits) -> &mut Option<Duration>;

/// The first of the limits: those that are a share, and whether more of it is worse.
const SHARES: [(Share, Worse); 9] = [
    (|limits| &mut limits.lost, Worse::More),
    (|limits| &mut limits.dropped, Worse::More),
    (|limits| &mut limits.damaged, Worse::More),
    (|limits| &mut limits.duplicate, Worse::More),
    (|limits| &mut limits.repeated, Worse::More),
    (|limits| &mut limits.late, Worse::More),
    (|limits| &mut limits.rate, Worse::Less),
    (|limits| &mut limits.valid, Worse::Less),
    (|limits| &mut limits.present, Worse::Less),
];
/// The others: those that are a time; longer is worse.
const TIMES: [Moment; 6] = [
    |limits| &mut limits.frozen,
    |limits| &mut limits.gap,
    |limits| &mut limits.opening,
    |limits| &mut limits.clock,
    |limits| &mut limits.uncertain,
    |limits| &mut limits.clip,
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
    Rig,
    Device,
}

/// Reads the table `verdict` of `section`.
pub(super) fn read(section: &Section<'_>, whose: Whose) -> VerdictTable {
    let mut table = VerdictTable::default();
    let Some(section) = section.table("verdict") else { return table };
    if whose == Whose::Device {
        section.known(OF_A_DEVICE);
        table.hz = RateKeys::values(&section).hz;
    } else if section.has("hz") {
        section.known(OF_A_DEVICE);
        let fix = "write it as hz = 100 in [device.NAME.verdict]";
        section.report("hz", "hz is the rate of one device", fix);
    } else {
        section.known(OF_THE_RIG);
    }
    table.suspect = limits(&section);
    if let Some(bad) = section.table("bad") {
        bad.known(&[LIMITS]);
        table.bad = limits(&bad);
        contradictions(&table, &section, &bad);
    }
    table
}

fn limits(section: &Section<'_>) -> Written {
    let mut written = Written::default();
    let (of_shares, of_times) = LIMITS.split_at(SHARES.len());
    for (key, limit) in zip(of_shares, &mut written.shares) {
        *limit = share(section, key.name);
    }
    for (key, limit) in zip(of_times, &mut written.times) {
        *limit = time(section, key.name);
    }
    written
}

fn time(section: &Section<'_>, key: &str) -> Option<Given<Duration>> {
    match section.word(key) {
        Some("off") => Some(None),
        _ => section.duration(key, Duration::from_millis(1)..=Duration::from_hours(1)).map(Some),
    }
}

/// `"0.1%"`, `"0.1 %"`, or `"off"`.
fn share(section: &Section<'_>, key: &str) -> Option<Given<f64>> {
    let usual = if ["rate", "valid", "present"].contains(&key) { "90%" } else { "0.5%" };
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
    let shares = zip(&SHARES, zip(table.suspect.shares, table.bad.shares)).map(|((_, worse), written)| {
        matches!(written, (Some(Some(suspect)), Some(Some(bad))) if worse.is_beyond(&suspect, &bad))
    });
    let times = zip(table.suspect.times, table.bad.times)
        .map(|written| matches!(written, (Some(Some(suspect)), Some(Some(bad))) if suspect > bad));
    for (key, _) in zip(LIMITS, shares.chain(times)).filter(|(_, is_beyond)| *is_beyond) {
        report(key.name);
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
        for ((of, worse), written) in SHARES.iter().zip(zip(table.suspect.shares, table.bad.shares)) {
            change(of(&mut spec.suspect), of(&mut spec.bad), written, whose, *worse);
        }
        for (of, written) in TIMES.iter().zip(zip(table.suspect.times, table.bad.times)) {
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
