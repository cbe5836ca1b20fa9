//! The verdict on an episode: measurements compared with the limits of the registry.
//!
//! 1. Each check of a modality has a limit for SUSPECT and one for BAD; the more severe one that is exceeded counts. An
//!    episode is as good as its worst check.
//! 2. A modality that is absent by the mask is not missing, unless its device was plugged in: longer than a limit, or
//!    for half the episode without ever starting.
//! 3. A present modality without a sample is BAD. So is an episode without any sample: GOOD has at least one.
//! 4. A file that is not whole, or not proven unchanged, is SUSPECT; one that the disk refused is BAD. A check that
//!    could not be measured has its own finding.
//! 5. An episode in which another program published on one of our topics is SUSPECT.
//! 6. An episode shorter than [`SHORTEST`] is BAD: too short for a demonstration.
//! 7. A modality listed in `expect` is judged by its share of the episode; one without a sample has none. With that check
//!    off, such an episode is SUSPECT.
//! 8. A replay is no better than the recording that was replayed; an episode in which another unit of the model took over
//!    is SUSPECT.
//! 9. If one fault fails two checks, only the more specific one is reported: a frozen camera also repeats its pictures,
//!    a silent one also has a low rate.
//!
//! Invariant: pure.

#[cfg(test)]
mod tests;

use std::time::Duration;

use rapid_core::text;
use rapid_registry::{Limits, VerdictSpec};
use rapid_status::{Absence, Finding, Grade, Sensors, Verdict};

use super::publishers::Publisher;
use super::quality::Quality;
use super::sources::{self, Epochs};

/// A modality with its limits.
#[derive(Debug, Clone)]
pub(super) struct Judged<'a> {
    pub(super) name: &'a str,
    pub(super) quality: &'a Quality,
    pub(super) limits: VerdictSpec,
}

/// The state of an episode's file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum FileState<'a> {
    /// It holds everything that was recorded.
    Whole,
    /// Something is missing at its end; the text is the reason.
    NotWhole(&'a str),
    /// It could not be written; the text is the reason.
    Failed(&'a str),
}

/// Who lost the missing samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Losses {
    /// Known: device and `rapid` are counted separately.
    Apart,
    /// Unknown: all are counted as dropped.
    Together,
}

/// Losses of an episode other than samples.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Missing {
    /// Publications of the mask.
    pub(super) masks: u64,
    pub(super) actions: u64,
    /// Actions in the file with a number that is not finite: no actuator carries them out.
    pub(super) unusable_actions: u64,
    pub(super) events: u64,
}

/// The facts that an episode is judged by.
#[derive(Debug, Clone, Copy)]
pub(super) struct Facts<'a> {
    pub(super) modalities: &'a [Judged<'a>],
    /// Losses other than samples.
    pub(super) missing: Missing,
    /// Names of the modalities that every episode must have.
    pub(super) expect: &'a [String],
    /// Other programs that published on our topics.
    pub(super) publishers: &'a [Publisher],
    /// Its length, seconds.
    pub(super) seconds: f64,
    /// Whether losses are distinguished.
    pub(super) losses: Losses,
    pub(super) file: FileState<'a>,
    /// Further reasons for SUSPECT, found outside this module.
    pub(super) findings: &'a [String],
    /// What its samples come from.
    pub(super) epochs: &'a Epochs,
}

/// With fewer expected samples, or less time, the rate is not judged.
const LEAST_SAMPLES: f64 = 10.0;
const LEAST_PRESENCE: f64 = 1.0;

/// A shorter episode is an accident, such as a key pressed twice.
const SHORTEST: Duration = Duration::from_millis(500);

/// Is an episode of this length, in seconds, too short to be used?
pub(super) fn is_short(seconds: f64) -> bool {
    seconds < SHORTEST.as_secs_f64()
}

pub(super) fn judge(facts: &Facts<'_>) -> Verdict {
    let found = findings(facts);
    let grade = found.first().map_or(Grade::Good, |finding| finding.grade);
    let without: Vec<String> = facts
        .modalities
        .iter()
        .filter(|judged| judged.quality.samples == 0)
        .map(|judged| judged.name.to_owned())
        .collect();
    let registered = facts.modalities.len();
    let away = facts.modalities.iter().filter_map(|judged| away(judged, facts.seconds)).collect();
    let sensors = Sensors { registered, recorded: registered - without.len(), without, away };
    let reasons = found.iter().map(Finding::sentence).collect();
    let replay_of = sources::replayed(facts.epochs).iter().map(|replayed| replayed.name().to_owned()).collect();
    Verdict { grade, reasons, sensors: Some(sensors), replay_of }
}

/// How long a modality with a sample was away, if it was.
fn away(judged: &Judged<'_>, length: f64) -> Option<Absence> {
    let presence = judged.quality.presence.filter(|_| judged.quality.samples > 0)?;
    let to_ms = |seconds: f64| (seconds * 1e3).round() / 1e3;
    let seconds = to_ms((1.0 - presence) * length);
    (seconds > 0.0).then(|| Absence { name: judged.name.to_owned(), seconds, of: to_ms(length) })
}

/// Every failed check, the most severe first.
pub(super) fn findings(facts: &Facts<'_>) -> Vec<Finding> {
    let of_all = |grade: Grade, text: String| Finding { grade, modality: None, text };
    let mut found: Vec<Finding> = Vec::new();
    match facts.file {
        FileState::Whole => {}
        FileState::NotWhole(why) => found.push(of_all(Grade::Suspect, format!("the file is not whole: {why}"))),
        FileState::Failed(why) => found.push(of_all(Grade::Bad, format!("the file could not be written: {why}"))),
    }
    found.extend(facts.findings.iter().map(|finding| of_all(Grade::Suspect, finding.clone())));
    let of_sources = sources::reasons(facts.epochs, facts.seconds).into_iter();
    found.extend(of_sources.map(|(grade, text)| of_all(grade, text)));
    if is_short(facts.seconds) {
        let limit = seconds(SHORTEST.as_secs_f64());
        found.push(of_all(Grade::Bad, format!("too short: {} (limit {limit})", seconds(facts.seconds))));
    }
    for judged in facts.modalities {
        let mut of_it = modality(judged, facts);
        if judged.quality.samples == 0 && facts.expect.iter().any(|name| name == judged.name) {
            let never = Quality { presence: Some(0.0), ..*judged.quality };
            let grade = present(&never, &judged.limits, facts.seconds).map_or(Grade::Suspect, |(grade, _)| grade);
            // Another finding is more exact, unless it is less severe.
            if of_it.iter().all(|(found, _)| *found < grade) {
                of_it.push((grade, "took no part, and is expected (expect under [rig])".to_owned()));
            }
        }
        let modality = || Some(judged.name.to_owned());
        found.extend(of_it.into_iter().map(|(grade, text)| Finding { grade, modality: modality(), text }));
    }
    let silent = facts.modalities.iter().all(|judged| judged.quality.samples == 0);
    if silent && !found.iter().any(|finding| finding.grade == Grade::Bad) {
        found.push(of_all(Grade::Bad, "nothing was received from any modality".to_owned()));
    }
    let missing = [
        (facts.missing.actions, "action is", "actions are"),
        (facts.missing.masks, "publication of the mask is", "publications of the mask are"),
        (facts.missing.events, "event is", "events are"),
    ];
    for (count, is, are) in missing.into_iter().filter(|(count, ..)| *count > 0) {
        let are = if count == 1 { is } else { are };
        found.push(of_all(Grade::Suspect, format!("{count} {are} not in the file (limit 0)")));
    }
    if facts.missing.unusable_actions > 0 {
        let actions = text::counted(facts.missing.unusable_actions, "action");
        found.push(of_all(Grade::Suspect, format!("{actions} with a number that is not finite (limit 0)")));
    }
    found.extend(facts.publishers.iter().map(|publisher| of_all(Grade::Suspect, publisher.reason())));
    // Stable: of one grade in the order above.
    found.sort_by_key(|finding| std::cmp::Reverse(finding.grade));
    found
}

/// The findings against a modality.
fn modality(judged: &Judged<'_>, facts: &Facts<'_>) -> Vec<(Grade, String)> {
    let Judged { quality, limits, .. } = judged;
    // A plugged device may be silent for this long.
    let patience = limits.suspect.gap.map_or(0.0, |gap| gap.as_secs_f64());
    if quality.samples == 0 {
        let silent = quality.present > 0.0 && quality.present >= patience;
        let text = format!("nothing was received, although it was present for {}", seconds(quality.present));
        let silent = silent.then_some((Grade::Bad, text));
        return silent.or_else(|| never_ran(quality, limits, facts.seconds)).into_iter().collect();
    }
    let expected = quality.expected();
    let share = |limit: fn(&Limits) -> Option<f64>, count: u64, what: &str| {
        let (grade, limit) =
            exceeded(limits, |limits| limit(limits).filter(|limit| count as f64 > limit * expected as f64))?;
        Some((grade, format!("{count} of {expected} samples {what} (limit {})", percent(limit))))
    };
    let lost = share(|limits| limits.lost, quality.lost, "lost by the device");
    let dropped = share(
        |limits| limits.dropped,
        quality.dropped,
        match facts.losses {
            Losses::Apart => "dropped on the way to the file",
            Losses::Together => "missing, lost by the device or dropped on the way to the file",
        },
    );
    let cut = damaged_text(quality);
    let damaged = share(|limits| limits.damaged, quality.damaged, &cut);
    let duplicate =
        share(|limits| limits.duplicate, quality.duplicates, "with a non-increasing sequence number or capture time");
    let late = quality.lateness.map_or(0.0, |lateness| lateness.max / 1e3);
    let late = format!("too late for their frame, up to {} after capture", seconds(late));
    let late = share(|limits| limits.late, quality.late, &late);
    let frozen = longer(limits, |limits| limits.frozen, quality.frozen).map(|(grade, limit)| {
        let (time, samples) = (seconds(quality.frozen), quality.frozen_samples + 1);
        (grade, format!("frozen for {time}: {samples} samples byte for byte the same (limit {limit})"))
    });
    let repeated = share(|limits| limits.repeated, quality.repeated, "byte for byte the one before")
        .filter(|repeated| unless(repeated, [&frozen]));
    let gap = longer(limits, |limits| limits.gap, quality.longest_gap).map(|(grade, limit)| {
        (grade, format!("no sample for {} while present (limit {limit})", seconds(quality.longest_gap)))
    });
    let opening = longer(limits, |limits| limits.opening, quality.opening).map(|(grade, limit)| {
        (grade, format!("plugged in for {} without running (limit {limit})", seconds(quality.opening)))
    });
    let rate = rate(quality, limits).filter(|rate| unless(rate, [&gap, &lost, &dropped]));
    let valid =
        valid(quality, limits).filter(|valid| unless(valid, [&gap, &lost, &dropped, &damaged, &late, &opening, &rate]));
    let present = present(quality, limits, facts.seconds).filter(|present| unless(present, [&opening]));
    [
        dropped,
        lost,
        damaged,
        duplicate,
        repeated,
        frozen,
        late,
        gap,
        opening,
        clock(quality, limits),
        uncertain(quality, limits),
        rate,
        valid,
        present,
    ]
    .into_iter()
    .flatten()
    .collect()
}

/// How the damaged samples are damaged.
fn damaged_text(quality: &Quality) -> String {
    let Quality { damaged, truncated, other_shape, .. } = *quality;
    match (truncated, other_shape) {
        (0, 0) => "damaged".to_owned(),
        (cut, _) if cut == damaged => "not whole pictures".to_owned(),
        (_, other) if other == damaged => "with a picture of another size or kind".to_owned(),
        (cut, 0) => format!("damaged, {cut} of them not whole pictures"),
        (0, other) => format!("damaged, {other} of them with a picture of another size or kind"),
        (cut, other) => format!("damaged, {cut} of them not whole pictures, {other} of another size or kind"),
    }
}

/// The findings of a modality that sent nothing and was present too briefly to be missing.
fn never_ran(quality: &Quality, limits: &VerdictSpec, length: f64) -> Option<(Grade, String)> {
    let found = longer(limits, |limits| limits.opening, quality.opening).or_else(|| {
        // In a short episode too it is missed.
        limits.suspect.opening?;
        (quality.opening > length / 2.0).then(|| (Grade::Suspect, "half the episode".to_owned()))
    });
    found.map(|(grade, limit)| {
        (grade, format!("plugged in for {} and sent nothing (limit {limit})", seconds(quality.plugged)))
    })
}

fn clock(quality: &Quality, limits: &VerdictSpec) -> Option<(Grade, String)> {
    // A clock that is followed does not drift: what grows is the delay, which is judged as late.
    let drift = quality.clock_drift.filter(|_| quality.clock_uncertainty.is_none()).unwrap_or(0.0) / 1e3;
    let (drifted, ahead) = (drift.abs(), quality.clock_ahead / 1e3);
    let (grade, limit) = longer(limits, |limits| limits.clock, drifted.max(ahead))?;
    let text = if ahead >= drifted {
        format!("captured up to {} after it was received (limit {limit})", seconds(ahead))
    } else {
        let way = if drift > 0.0 { "fell behind" } else { "ran ahead of" };
        format!("its clock {way} this machine's by {} (limit {limit})", seconds(drifted))
    };
    Some((grade, text))
}

fn uncertain(quality: &Quality, limits: &VerdictSpec) -> Option<(Grade, String)> {
    let uncertainty = quality.clock_uncertainty? / 1e3;
    let (grade, limit) = longer(limits, |limits| limits.uncertain, uncertainty)?;
    let text = format!("capture times uncertain by ±{} (limit {limit})", seconds(uncertainty));
    Some((grade, text))
}

fn rate(quality: &Quality, limits: &VerdictSpec) -> Option<(Grade, String)> {
    let (nominal, hz) = (limits.hz?, quality.hz?);
    if quality.present < LEAST_PRESENCE || nominal * quality.present < LEAST_SAMPLES {
        return None;
    }
    let (grade, limit) = exceeded(limits, |limits| limits.rate.filter(|limit| hz < limit * nominal))?;
    Some((grade, format!("{hz:.1} samples a second while present, of {nominal} (limit {})", percent(limit))))
}

fn valid(quality: &Quality, limits: &VerdictSpec) -> Option<(Grade, String)> {
    let valid = quality.frames_valid.min(quality.frames_present);
    let ticks = valid.saturating_add(quality.frames_missed);
    let below = |limit: &f64| (valid as f64) < limit * ticks as f64;
    let (grade, limit) = exceeded(limits, |limits| limits.valid.filter(below))?;
    let limit = percent(limit);
    Some((
        grade,
        format!("{valid} of {ticks} ticks have a valid sample while present (limit {limit}; see sync_window)"),
    ))
}

fn present(quality: &Quality, limits: &VerdictSpec, length: f64) -> Option<(Grade, String)> {
    let presence = quality.presence?;
    let (grade, limit) = exceeded(limits, |limits| limits.present.filter(|limit| presence < *limit))?;
    let (away, length) = (seconds((1.0 - presence) * length), seconds(length));
    let share = (presence * 100.0).floor();
    Some((grade, format!("away {away} of {length}: present for {share} % (limit {})", percent(limit))))
}

/// The more severe grade whose limit `exceeds` reports, and the limit.
fn exceeded<T>(limits: &VerdictSpec, exceeds: impl Fn(&Limits) -> Option<T>) -> Option<(Grade, T)> {
    let bad = exceeds(&limits.bad).map(|limit| (Grade::Bad, limit));
    bad.or_else(|| exceeds(&limits.suspect).map(|limit| (Grade::Suspect, limit)))
}

fn longer(limits: &VerdictSpec, limit: impl Fn(&Limits) -> Option<Duration>, length: f64) -> Option<(Grade, String)> {
    let (grade, limit) = exceeded(limits, |limits| limit(limits).filter(|limit| length > limit.as_secs_f64()))?;
    Some((grade, seconds(limit.as_secs_f64())))
}

/// Is `found` more severe than every finding of the same fault so far?
fn unless<const N: usize>(found: &(Grade, String), others: [&Option<(Grade, String)>; N]) -> bool {
    others.iter().all(|other| other.as_ref().is_none_or(|(grade, _)| *grade < found.0))
}

fn percent(share: f64) -> String {
    // More decimals than any limit has.
    format!("{} %", (share * 1e5).round() / 1e3)
}

fn seconds(seconds: f64) -> String {
    if seconds < 1.0 { format!("{:.0} ms", seconds * 1e3) } else { format!("{seconds:.1} s") }
}
