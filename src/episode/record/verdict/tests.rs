//! Which figures lead to which grade and which reasons.

use std::time::Duration;

use proptest::prelude::*;
use rapid_core::modality::ModalityKind;

use super::*;

/// Ten seconds of a camera of 30 Hz, away for three of them, without a fault.
fn good() -> Quality {
    Quality {
        samples: 210,
        bytes: 6_000_000,
        lateness: Some(crate::record::Spread { p50: 20.0, p95: 25.0, p99: 40.0, max: 240.0 }),
        clock_drift: Some(0.2),
        presence: Some(0.7),
        present: 7.0,
        plugged: 7.5,
        opening: 0.5,
        hz: Some(30.0),
        nominal_hz: Some(30.0),
        longest_gap: 0.04,
        frames_present: 210,
        frames_valid: 210,
        ..Quality::default()
    }
}

/// No epochs.
static NOWHERE: Epochs = Epochs::new();

fn limits() -> VerdictSpec {
    VerdictSpec::defaults(ModalityKind::Image, Duration::from_millis(500), Some(30.0))
}

/// Of an episode of ten seconds in which nothing went missing.
fn facts<'a>(modalities: &'a [Judged<'a>], file: FileState<'a>) -> Facts<'a> {
    Facts {
        modalities,
        missing: Missing::default(),
        expect: &[],
        publishers: &[],
        seconds: 10.0,
        losses: Losses::Apart,
        file,
        findings: &[],
        epochs: &NOWHERE,
    }
}

fn verdict_on(quality: &Quality, file: FileState<'_>) -> Verdict {
    judge(&facts(&[Judged { name: "cam", quality, limits: limits() }], file))
}

#[track_caller]
fn is(change: impl Fn(&mut Quality), grade: Grade, reasons: &[&str]) {
    let mut quality = good();
    change(&mut quality);
    let verdict = verdict_on(&quality, FileState::Whole);
    assert_eq!(
        (verdict.grade, verdict.reasons.as_slice()),
        (grade, reasons.iter().map(ToString::to_string).collect::<Vec<_>>().as_slice())
    );
}

#[test]
fn an_absence_that_the_mask_explains_is_good() {
    is(|_| {}, Grade::Good, &[]);
    assert_eq!(verdict_on(&good(), FileState::Whole).why(), "");
}

#[test]
fn every_check_has_its_text_and_its_two_limits() {
    use Grade::{Bad, Good, Suspect};
    is(|q| q.dropped = 1, Suspect, &["cam: 1 of 211 samples dropped on the way to the file (limit 0 %)"]);
    is(|q| q.dropped = 30, Bad, &["cam: 30 of 240 samples dropped on the way to the file (limit 5 %)"]);
    is(|q| q.lost = 2, Good, &[]);
    is(|q| q.lost = 3, Suspect, &["cam: 3 of 213 samples lost by the device (limit 1 %)"]);
    is(|q| q.damaged = 11, Bad, &["cam: 11 of 210 samples damaged (limit 5 %)"]);
    is(
        |q| (q.damaged, q.truncated) = (4, 3),
        Suspect,
        &["cam: 4 of 210 samples damaged, 3 of them not whole pictures (limit 1 %)"],
    );
    is(|q| (q.damaged, q.truncated) = (4, 4), Suspect, &["cam: 4 of 210 samples not whole pictures (limit 1 %)"]);
    is(
        |q| (q.damaged, q.other_shape) = (4, 4),
        Suspect,
        &["cam: 4 of 210 samples with a picture of another size or kind (limit 1 %)"],
    );
    is(
        |q| (q.damaged, q.truncated, q.other_shape) = (4, 2, 1),
        Suspect,
        &["cam: 4 of 210 samples damaged, 2 of them not whole pictures, 1 of another size or kind (limit 1 %)"],
    );
    is(
        |q| q.duplicates = 1,
        Suspect,
        &["cam: 1 of 210 samples with a non-increasing sequence number or capture time (limit 0.1 %)"],
    );
    is(|q| q.repeated = 105, Suspect, &["cam: 105 of 210 samples byte for byte the one before (limit 10 %)"]);
    is(
        |q| (q.frozen, q.frozen_samples, q.repeated) = (0.8, 24, 24),
        Suspect,
        &["cam: frozen for 800 ms: 25 samples byte for byte the same (limit 500 ms)"],
    );
    is(
        |q| (q.frozen, q.frozen_samples, q.repeated) = (5.0, 150, 150),
        Bad,
        &["cam: frozen for 5.0 s: 151 samples byte for byte the same (limit 2.0 s)"],
    );
    is(
        |q| q.late = 3,
        Suspect,
        &["cam: 3 of 210 samples too late for their frame, up to 240 ms after capture (limit 1 %)"],
    );
    is(|q| q.longest_gap = 3.0, Suspect, &["cam: no sample for 3.0 s while present (limit 500 ms)"]);
    is(|q| q.longest_gap = 5.5, Bad, &["cam: no sample for 5.5 s while present (limit 5.0 s)"]);
    is(
        |q| q.clock_drift = Some(-30.0),
        Suspect,
        &["cam: its clock ran ahead of this machine's by 30 ms (limit 10 ms)"],
    );
    is(|q| q.clock_drift = Some(150.0), Bad, &["cam: its clock fell behind this machine's by 150 ms (limit 100 ms)"]);
    is(|q| q.clock_ahead = 12.0, Suspect, &["cam: captured up to 12 ms after it was received (limit 10 ms)"]);
    // Only how well the clock of a phone or of another computer is known is judged. It is followed, so what drifts is the delay.
    is(|q| q.clock_uncertainty = Some(1e6), Good, &[]);
    is(|q| (q.clock_uncertainty, q.clock_drift) = (Some(1.0), Some(150.0)), Good, &[]);
    is(
        |q| (q.clock_uncertainty, q.clock_drift, q.clock_ahead) = (Some(1.0), Some(150.0), 12.0),
        Suspect,
        &["cam: captured up to 12 ms after it was received (limit 10 ms)"],
    );
    let far = limits().of_another_clock(Duration::from_millis(25));
    let judged = |ms| {
        let quality = Quality { clock_uncertainty: Some(ms), ..good() };
        uncertain(&quality, &far)
    };
    assert_eq!(judged(12.5), None);
    let text = "capture times uncertain by ±13 ms (limit 12 ms)";
    assert_eq!(judged(12.6), Some((Suspect, text.to_owned())));
    is(|q| q.hz = Some(15.04), Suspect, &["cam: 15.0 samples a second while present, of 30 (limit 90 %)"]);
    is(|q| q.hz = Some(14.9), Bad, &["cam: 14.9 samples a second while present, of 30 (limit 50 %)"]);
    // The gap implies the low rate, unless that is the graver of the two.
    is(
        |q| (q.longest_gap, q.hz) = (3.0, Some(20.0)),
        Suspect,
        &["cam: no sample for 3.0 s while present (limit 500 ms)"],
    );
    let ticks = |valid, missed| move |q: &mut Quality| (q.frames_valid, q.frames_missed) = (valid, missed);
    let states = |valid, ticks, limit| {
        format!("cam: {valid} of {ticks} ticks have a valid sample while present (limit {limit} %; see sync_window)")
    };
    is(ticks(90, 10), Good, &[]);
    is(ticks(89, 11), Suspect, &[&states(89, 100, 90)]);
    is(ticks(50, 50), Suspect, &[&states(50, 100, 90)]);
    is(ticks(49, 51), Bad, &[&states(49, 100, 50)]);
    // As T8 has it: none of 140.
    is(ticks(0, 138), Bad, &[&states(0, 138, 50)]);
    // Too short to have a rate.
    is(|q| (q.present, q.hz) = (0.9, Some(3.0)), Good, &[]);
}

#[test]
fn a_very_short_episode_is_bad_and_missing_actions_are_suspect() {
    let quality = good();
    let modalities = [Judged { name: "cam", quality: &quality, limits: limits() }];
    let of = |seconds, actions| {
        let missing = Missing { actions, ..Missing::default() };
        let report = judge(&Facts { missing, seconds, ..facts(&modalities, FileState::Whole) });
        (report.grade, report.why())
    };
    assert_eq!(of(0.0, 0), (Grade::Bad, "too short: 0 ms (limit 500 ms)".to_owned()));
    assert_eq!(of(0.499, 0).0, Grade::Bad);
    assert_eq!(of(0.5, 0), (Grade::Good, String::new()));
    assert_eq!(of(9.0, 3), (Grade::Suspect, "3 actions are not in the file (limit 0)".to_owned()));
}

#[test]
fn an_expected_sensor_without_samples_is_suspect_and_verdicts_name_missing_ones() {
    let (talks, never) = (good(), Quality { samples: 0, present: 0.0, plugged: 0.0, opening: 0.0, ..good() });
    let of = |name| Judged { name, quality: if name == "cam" { &talks } else { &never }, limits: limits() };
    let modalities = [of("cam"), of("tof"), of("gel")];
    let names = |names: &[&str]| names.iter().map(|name| (*name).to_owned()).collect::<Vec<_>>();
    for (expect, reasons) in [
        (names(&[]), vec![]),
        (names(&["cam"]), vec![]),
        (names(&["cam", "gel"]), vec!["gel: took no part, and is expected (expect under [rig])"]),
    ] {
        let report = judge(&Facts { expect: &expect, ..facts(&modalities, FileState::Whole) });
        assert_eq!(report.reasons, reasons);
        assert_eq!(report.grade == Grade::Suspect, !reasons.is_empty());
        assert_eq!(report.remarks(), "0 of 3 sensors, without tof, gel, cam away 3.0 s of 10.0 s");
    }
}

#[test]
fn an_expected_sensor_is_judged_by_its_share_of_the_episode_and_an_absence_is_always_named() {
    use Grade::{Bad, Good, Suspect};
    let expect = ["cam".to_owned()];
    // Share of ten seconds, samples; as one of `expect`: grade and reason; what is said of it in any case.
    for (presence, samples, grade, reason, named) in [
        (1.0, 300, Good, "", "1 of 1 sensor"),
        (0.99, 297, Good, "", "0 of 1 sensor, cam away 100 ms of 10.0 s"),
        (0.9, 270, Good, "", "0 of 1 sensor, cam away 1.0 s of 10.0 s"),
        (
            0.899,
            269,
            Suspect,
            "cam: away 1.0 s of 10.0 s: present for 89 % (limit 90 %)",
            "0 of 1 sensor, cam away 1.0 s of 10.0 s",
        ),
        (
            0.5,
            150,
            Suspect,
            "cam: away 5.0 s of 10.0 s: present for 50 % (limit 90 %)",
            "0 of 1 sensor, cam away 5.0 s of 10.0 s",
        ),
        (
            0.1,
            30,
            Bad,
            "cam: away 9.0 s of 10.0 s: present for 10 % (limit 50 %)",
            "0 of 1 sensor, cam away 9.0 s of 10.0 s",
        ),
        (0.0, 0, Bad, "cam: took no part, and is expected (expect under [rig])", "0 of 1 sensor, without cam"),
    ] {
        let present = 10.0 * presence;
        let quality = Quality { samples, presence: Some(presence), present, plugged: present, opening: 0.0, ..good() };
        let of = |limits: VerdictSpec, expect| {
            let modalities = [Judged { name: "cam", quality: &quality, limits }];
            judge(&Facts { expect, ..facts(&modalities, FileState::Whole) })
        };
        let verdict = of(limits().of_an_expected_sensor(), &expect);
        assert_eq!((verdict.grade, verdict.why().as_str()), (grade, reason), "{presence}");
        assert_eq!(verdict.remarks(), named, "{presence}");
        // Of a sensor that may come and go.
        let verdict = of(limits(), &[]);
        assert_eq!((verdict.grade == Good, verdict.remarks().as_str()), (samples > 0, named), "{presence}");
    }
    // Without a mask nothing is known of its presence.
    let unknown = Quality { presence: None, ..good() };
    let modalities = [Judged { name: "cam", quality: &unknown, limits: limits().of_an_expected_sensor() }];
    let verdict = judge(&facts(&modalities, FileState::Whole));
    assert_eq!((verdict.grade, verdict.remarks().as_str()), (Good, "1 of 1 sensor"));
}

#[test]
fn a_present_modality_without_samples_is_bad_and_an_absent_one_is_not_missed() {
    let silent = |present: f64| Quality { samples: 0, present, longest_gap: present, hz: Some(0.0), ..good() };
    let both = |quiet: &Quality| {
        let talks = good();
        let modalities = [
            Judged { name: "cam", quality: &talks, limits: limits() },
            Judged { name: "tof", quality: quiet, limits: limits() },
        ];
        judge(&facts(&modalities, FileState::Whole))
    };
    let report = both(&silent(3.0));
    assert_eq!(report.reasons, ["tof: nothing was received, although it was present for 3.0 s"]);
    assert_eq!(report.grade, Grade::Bad);
    // Plugged in a moment before the end; never plugged in.
    assert_eq!(both(&silent(0.3)).grade, Grade::Good);
    assert_eq!(both(&silent(0.0)).grade, Grade::Good);
    // Without any finding.
    let empty = verdict_on(&silent(0.0), FileState::Whole);
    assert_eq!((empty.grade, empty.why().as_str()), (Grade::Bad, "nothing was received from any modality"));
}

#[test]
fn a_plugged_device_that_never_runs_is_missed_and_one_that_starts_is_not() {
    use Grade::{Good, Suspect};
    let states = |seconds: f64, quality: Quality, limits: VerdictSpec| {
        let talks = good();
        let modalities =
            [Judged { name: "cam", quality: &talks, limits }, Judged { name: "tof", quality: &quality, limits }];
        let report = judge(&Facts { seconds, ..facts(&modalities, FileState::Whole) });
        (report.grade, report.why())
    };
    let never = |plugged| Quality { samples: 0, present: 0.0, plugged, opening: plugged, hz: None, ..good() };
    for (seconds, plugged, report) in [
        (10.0, 10.0, Some("tof: plugged in for 10.0 s and sent nothing (limit 5.0 s)")),
        (60.0, 5.1, Some("tof: plugged in for 5.1 s and sent nothing (limit 5.0 s)")),
        (3.0, 3.0, Some("tof: plugged in for 3.0 s and sent nothing (limit half the episode)")),
        // Plugged in towards the end; never plugged in.
        (10.0, 4.9, None),
        (3.0, 1.4, None),
        (10.0, 0.0, None),
    ] {
        let expected = report.map_or((Good, String::new()), |report| (Suspect, report.to_owned()));
        assert_eq!(states(seconds, never(plugged), limits()), expected, "{plugged} of {seconds} s");
    }
    // One that ran, and was started again for too long.
    let restarted = |opening| Quality { plugged: 9.0, opening, ..good() };
    assert_eq!(states(10.0, restarted(4.9), limits()).0, Good);
    let report = "tof: plugged in for 5.5 s without running (limit 5.0 s)";
    assert_eq!(states(10.0, restarted(5.5), limits()), (Suspect, report.to_owned()));
    let mut off = limits();
    off.suspect.opening = None;
    assert_eq!(states(10.0, never(10.0), off).0, Good);
}

#[test]
fn the_file_and_its_losses_count_and_the_most_severe_reason_comes_first() {
    let quality = Quality { lost: 5, ..good() };
    let modalities = [Judged { name: "cam", quality: &quality, limits: limits() }];
    let of =
        |file| Facts { missing: Missing { masks: 2, events: 1, ..Missing::default() }, ..facts(&modalities, file) };
    let report = judge(&of(FileState::NotWhole("it was recovered")));
    let lost = "cam: 5 of 215 samples lost by the device (limit 1 %)";
    let missing = ["2 publications of the mask are not in the file (limit 0)", "1 event is not in the file (limit 0)"];
    assert_eq!(report.reasons, ["the file is not whole: it was recovered", lost, missing[0], missing[1]]);
    assert_eq!(report.grade, Grade::Suspect);
    let report = judge(&of(FileState::Failed("no space left on device")));
    assert_eq!(report.reasons[0], "the file could not be written: no space left on device");
    assert_eq!(report.grade, Grade::Bad);
    let together = Quality { dropped: 5, ..good() };
    let modalities = [Judged { name: "cam", quality: &together, limits: limits() }];
    let facts = Facts { losses: Losses::Together, ..facts(&modalities, FileState::Whole) };
    let why = judge(&facts).why();
    assert_eq!(why, "cam: 5 of 215 samples missing, lost by the device or dropped on the way to the file (limit 0 %)");
}

#[test]
fn a_disabled_check_gives_no_reason() {
    let off = Limits {
        lost: None,
        dropped: None,
        damaged: None,
        duplicate: None,
        repeated: None,
        frozen: None,
        late: None,
        gap: None,
        opening: None,
        clock: None,
        uncertain: None,
        rate: None,
        valid: None,
        present: None,
    };
    let quality = Quality {
        presence: Some(0.1),
        lost: 50,
        dropped: 50,
        damaged: 50,
        duplicates: 50,
        repeated: 50,
        frozen: 9.0,
        late: 50,
        longest_gap: 9.0,
        opening: 9.0,
        clock_drift: Some(999.0),
        clock_ahead: 999.0,
        clock_uncertainty: Some(999.0),
        hz: Some(1.0),
        frames_missed: 500,
        ..good()
    };
    let limits = VerdictSpec { suspect: off, bad: off, hz: Some(30.0) };
    let modalities = [Judged { name: "cam", quality: &quality, limits }];
    let report = judge(&facts(&modalities, FileState::Whole));
    assert_eq!((report.grade, report.reasons.len()), (Grade::Good, 0));
}

proptest! {
    /// More of a fault never makes a better episode, and a word other than GOOD has a reason.
    #[test]
    fn a_worse_measurement_never_improves_the_verdict(counts in prop::array::uniform6(0_u64..300), more in prop::array::uniform6(0_u64..300), gap in 0.0_f64..9.0) {
        let with = |add: [u64; 6], gap: f64| Quality {
            lost: counts[0] + add[0],
            dropped: counts[1] + add[1],
            damaged: counts[2] + add[2],
            duplicates: counts[3] + add[3],
            repeated: counts[4] + add[4],
            late: counts[5] + add[5],
            longest_gap: gap,
            ..good()
        };
        let mild = verdict_on(&with([0; 6], gap), FileState::Whole);
        for which in 0..6 {
            let mut add = [0; 6];
            add[which] = more[which];
            // More samples are also expected where some are missing: other shares fall with it.
            if which >= 2 {
                let worse = verdict_on(&with(add, gap + 1.0), FileState::Whole);
                prop_assert!(worse.grade >= mild.grade, "{mild:?} {worse:?}");
            }
        }
        prop_assert_eq!(mild.grade == Grade::Good, mild.reasons.is_empty());
        prop_assert!(mild.reasons.iter().all(|reason| reason.starts_with("cam: ") && reason.contains("limit")));
    }
}
