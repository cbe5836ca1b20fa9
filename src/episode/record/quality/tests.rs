//! Each measure by a table, and all of them against a plain count over any episode.

use std::time::Duration;

use proptest::prelude::*;
use rapid_core::modality::ModalityKind;

use super::*;

const MS: u64 = 1_000_000;
const BEGIN: u64 = 5_000 * MS;

fn id(bit: u8) -> ModalityId {
    ModalityId::new(bit).unwrap()
}

fn measures(kind: ModalityKind) -> Measures {
    measures_at(30.0, kind)
}

fn measures_at(hz: f64, kind: ModalityKind) -> Measures {
    let limits = VerdictSpec::defaults(kind, Duration::from_millis(500), Some(30.0));
    let measured = [0, 3].map(|bit| Measured { name: String::new(), id: id(bit), limits, latency_ns: 0 });
    Measures::new(
        &measured,
        Frames { begin_ns: BEGIN, hz, window: Duration::from_millis(25), wait: Duration::from_millis(125) },
    )
}

/// A sample captured `at` ms after the beginning and received `late` ms later.
fn seen(seq: u64, at: u64, late: u64, payload: &[u8]) -> SampleFacts<'_> {
    let capture_ns = BEGIN + at * MS;
    SampleFacts {
        seq,
        capture_ns,
        recv_ns: capture_ns + late * MS,
        flagged: false,
        again: false,
        picture: Judgement::Usable,
        payload,
        repeated: None,
    }
}

fn quality_at(measures: &Measures, end_ms: u64) -> Quality {
    measures.quality(id(0), BEGIN + end_ms * MS).unwrap()
}

#[test]
fn damaged_counts_flagged_samples_and_torn_pictures_once() {
    use Judgement::{NotWhole, OtherShape, Usable};

    let mut measures = measures(ModalityKind::Image);
    for (n, (flagged, picture)) in
        (0_u64..).zip([(false, Usable), (true, Usable), (false, NotWhole), (true, NotWhole), (false, OtherShape)])
    {
        measures.sample(id(0), &SampleFacts { flagged, picture, ..seen(n, n * 10, 1, b"picture") });
    }
    let report = quality_at(&measures, 100);
    assert_eq!((report.samples, report.damaged, report.truncated, report.other_shape, report.bytes), (5, 4, 2, 1, 35));
}

#[test]
fn plugged_time_comes_from_events_and_opening_is_its_longest_part_outside_the_mask() {
    // Of ten seconds: events (ms, in or out), masks (ms, bit 0), plugged in, longest without the bit.
    type Row<'a> = (&'a [(u64, bool)], &'a [(u64, u64)], u64, u64);
    let table: &[Row<'_>] = &[
        (&[], &[(0, 0)], 0, 0),
        (&[(0, true)], &[(0, 0)], 10_000, 10_000),
        (&[(0, true)], &[(0, 1)], 10_000, 0),
        (&[(0, true), (4_000, false)], &[(0, 1), (4_000, 0)], 4_000, 0),
        (&[(2_000, true)], &[(0, 0), (3_000, 1)], 8_000, 1_000),
        // Restarted in between, and once more at the end.
        (&[(0, true)], &[(0, 1), (2_000, 0), (5_000, 1), (9_000, 0)], 10_000, 3_000),
        // Pulled out and put back: what it takes each time counts for itself.
        (&[(0, true), (3_000, false), (5_000, true)], &[(0, 0), (1_000, 1), (3_000, 0), (7_000, 1)], 8_000, 2_000),
        // Reported twice, and out before it was in.
        (&[(1_000, false), (2_000, true), (3_000, true)], &[(0, 0)], 8_000, 8_000),
        // Without a mask nothing is known of its running.
        (&[(0, true)], &[], 10_000, 0),
        // Beyond the end.
        (&[(11_000, true)], &[(0, 0)], 0, 0),
    ];
    for (events, masks, plugged, opening) in table {
        let mut measures = measures(ModalityKind::Image);
        for (at, mask) in *masks {
            measures.mask(BEGIN + at * MS, PhysicalMask(*mask));
        }
        for (at, there) in *events {
            measures.plugged(id(0), BEGIN + at * MS, *there);
        }
        let report = quality_at(&measures, 10_000);
        let seconds = |ms: u64| ms as f64 / 1e3;
        assert_eq!((report.plugged, report.opening), (seconds(*plugged), seconds(*opening)), "{events:?} {masks:?}");
    }
}

#[test]
fn a_non_increasing_number_or_time_is_a_duplicate() {
    let mut measures = measures(ModalityKind::Scalars);
    // A new number at an old time, an old number at a new time; a restarted publisher is neither.
    for (seq, at, duplicates) in [(7, 10, 0), (8, 20, 0), (9, 20, 1), (9, 30, 2), (10, 25, 3), (0, 40, 3), (1, 50, 3)] {
        measures.sample(id(0), &seen(seq, at, 1, b""));
        assert_eq!(quality_at(&measures, 100).duplicates, duplicates, "{seq} at {at} ms");
    }
}

#[test]
fn samples_whose_source_repeats_its_number_are_duplicates() {
    let mut measures = measures(ModalityKind::Scalars);
    for (n, again) in [(0_u64, false), (1, true), (2, true), (3, false)] {
        measures.sample(id(0), &SampleFacts { again, ..seen(n, 10 * n, 1, b"") });
    }
    assert_eq!(quality_at(&measures, 100).duplicates, 2);
}

#[test]
fn the_time_that_a_device_recorded_by_itself_comes_from_events() {
    use ClipState::{Asked, Recording, Refused, Stopped};
    // Of ten seconds: events (ms), recorded and first (ms), refused, stopped.
    type Row<'a> = (&'a [(u64, ClipState)], u64, Option<u64>, u64, u64);
    let table: &[Row<'_>] = &[
        (&[(100, Asked)], 0, None, 0, 0),
        (&[(100, Asked), (500, Recording)], 9_500, Some(500), 0, 0),
        (&[(100, Asked), (200, Refused), (3_000, Refused), (9_000, Recording)], 1_000, Some(9_000), 2, 0),
        (&[(100, Asked), (500, Recording), (4_500, Stopped), (5_000, Recording)], 9_000, Some(500), 0, 1),
        // Connected again, and found to record on: in between nothing is known.
        (&[(100, Asked), (500, Recording), (4_500, Asked), (6_500, Recording)], 7_500, Some(500), 0, 0),
    ];
    for (events, recorded, began, refused, stopped) in table {
        let mut measures = measures(ModalityKind::Bytes);
        assert_eq!(quality_at(&measures, 10_000).clip, None, "it was not asked");
        events.iter().for_each(|(at, state)| measures.clip(id(0), BEGIN + at * MS, *state));
        let seconds = |ms: u64| ms as f64 / 1e3;
        let (recorded, began) = (seconds(*recorded), began.map(seconds));
        let expected = ClipQuality { recorded, began, refused: *refused, stopped: *stopped };
        assert_eq!(quality_at(&measures, 10_000).clip, Some(expected), "{events:?}");
    }
    // Unplugged: it may have recorded on.
    let mut measures = measures(ModalityKind::Bytes);
    measures.plugged(id(0), BEGIN, true);
    measures.clip(id(0), BEGIN, Recording);
    measures.plugged(id(0), BEGIN + 4_000 * MS, false);
    assert_eq!(quality_at(&measures, 10_000).clip.map(|clip| clip.recorded), Some(4.0));
}

#[test]
fn equal_pictures_are_frozen_and_equal_numbers_are_not() {
    let payloads = [b"aa", b"aa", b"ab", b"bb", b"bb", b"bb", b"bb", b"aa", b"aa"];
    for (kind, repeated, frozen_samples, frozen) in
        [(ModalityKind::Image, 5, 3, 0.3), (ModalityKind::Scalars, 0, 0, 0.0), (ModalityKind::Bytes, 0, 0, 0.0)]
    {
        let mut measures = measures(kind);
        for (n, payload) in payloads.iter().enumerate() {
            let n = n as u64;
            measures.sample(id(0), &seen(n, n * 100, 1, *payload));
        }
        let report = quality_at(&measures, 1000);
        assert_eq!((report.repeated, report.frozen_samples), (repeated, frozen_samples), "{kind:?}");
        assert!((report.frozen - frozen).abs() < 1e-9, "{kind:?}: {}", report.frozen);
    }
}

#[test]
fn a_picture_that_is_the_same_after_an_absence_is_not_frozen() {
    // Masks (ms, bit 0) between pictures at 0, 100, 2,600 and 2,700 ms; longest frozen, ms.
    for (masks, frozen_samples, frozen) in [
        (&[(0, 1)][..], 3, 2.7),
        (&[(0, 1), (500, 0), (2500, 1)], 3, 0.7),
        (&[(0, 1), (99, 0), (2601, 1)], 3, 0.198),
        (&[(0, 1), (500, 3), (2500, 1)], 3, 2.7),
        (&[(0, 1), (2800, 0)], 3, 2.7),
    ] {
        // The recorder takes the samples of a turn before its masks.
        for every in [1, 2, 4] {
            let mut measures = measures(ModalityKind::Image);
            let mut masks = masks.iter().peekable();
            for (n, at) in [0, 100, 2600, 2700].into_iter().enumerate() {
                measures.sample(id(0), &seen(n as u64, at, 1, b"aa"));
                if (n + 1) % every == 0 {
                    while let Some((at, mask)) = masks.next_if(|(mask_at, _)| *mask_at <= at) {
                        measures.mask(BEGIN + at * MS, PhysicalMask(*mask));
                    }
                    measures.settle();
                }
            }
            let report = quality_at(&measures, 3000);
            assert_eq!((report.repeated, report.frozen_samples), (3, frozen_samples), "{masks:?}, {every}");
            assert!((report.frozen - frozen).abs() < 1e-9, "{}, {every}", report.frozen);
        }
    }
}

#[test]
fn late_samples_miss_the_deadline_of_the_nearest_tick() {
    // Ticks at 0, 33.3, 66.7 ms; each waits 125 ms.
    for (at, late_by, late) in
        [(0, 125, 0), (0, 126, 1), (16, 109, 0), (16, 110, 1), (17, 141, 0), (17, 142, 1), (60, 131, 0), (60, 132, 1)]
    {
        let mut measures = measures(ModalityKind::Scalars);
        measures.sample(id(0), &seen(0, at, late_by, b""));
        assert_eq!(quality_at(&measures, 1000).late, late, "captured at {at} ms, {late_by} ms late");
    }
}

/// A frame waits for the samples of its window; those between the windows of a slow grid are in none.
#[test]
fn a_sample_between_frame_windows_has_its_own_deadline() {
    for hz in [0.1, 1.0, 4.0, 10.0] {
        for at in (0..1000).step_by(7) {
            for (late_by, late) in [(2, 0), (99, 0), (200, 1)] {
                let mut measures = measures_at(hz, ModalityKind::Scalars);
                measures.sample(id(0), &seen(0, at, late_by, b""));
                assert_eq!(quality_at(&measures, 1000).late, late, "{hz} Hz: captured at {at} ms, {late_by} ms late");
            }
        }
    }
}

#[test]
fn an_absence_counts_neither_as_a_gap_nor_as_a_loss_of_rate() {
    let mut measures = measures(ModalityKind::Scalars);
    measures.mask(BEGIN - MS, PhysicalMask(0b1001));
    for (seq, at) in (0..).zip((0..1000).step_by(10).chain((4000..5000).step_by(10))) {
        if at == 4000 {
            measures.mask(BEGIN + 4000 * MS, PhysicalMask(0b1001));
        }
        measures.sample(id(0), &seen(seq, at, 1, b""));
        measures.settle();
        if at == 990 {
            measures.mask(BEGIN + 1000 * MS, PhysicalMask(0b1000));
        }
    }
    let report = quality_at(&measures, 5000);
    assert_eq!((report.presence, report.present, report.hz), (Some(0.4), 2.0, Some(100.0)));
    assert!((report.longest_gap - 0.01).abs() < 1e-9, "{}", report.longest_gap);
    // The other one was there all the time and never sent.
    let other = measures.quality(id(3), BEGIN + 5000 * MS).unwrap();
    assert_eq!((other.samples, other.presence, other.longest_gap, other.hz), (0, Some(1.0), 5.0, Some(0.0)));
    assert!(measures.quality(id(1), BEGIN).is_none(), "not measured");
}

#[test]
fn gaps_at_both_ends_count_and_samples_wait_for_a_late_mask() {
    let mut late_mask = measures(ModalityKind::Scalars);
    late_mask.mask(BEGIN, PhysicalMask(1));
    // A backlog: all samples first, then all masks.
    for (seq, at) in [(0, 300), (1, 400), (2, 3000), (3, 3100)] {
        late_mask.sample(id(0), &seen(seq, at, 1, b""));
    }
    late_mask.mask(BEGIN + 450 * MS, PhysicalMask(0));
    late_mask.mask(BEGIN + 3000 * MS, PhysicalMask(1));
    late_mask.settle();
    assert!((quality_at(&late_mask, 3200).longest_gap - 0.3).abs() < 1e-9, "the one at the beginning");
    assert!((quality_at(&late_mask, 3500).longest_gap - 0.4).abs() < 1e-9, "the one at the end");
}

#[test]
fn a_clock_at_another_rate_drifts_and_one_that_is_ahead_is_in_the_future() {
    let run = |ppm: i64, jitter_ms: u64, seconds: u64| {
        let mut measures = measures(ModalityKind::Scalars);
        for n in 0..seconds * 30 {
            let at = BEGIN + n * 33 * MS;
            let error = i64::try_from(n * 33 * MS).unwrap() * ppm / 1_000_000;
            let capture_ns = at.checked_add_signed(error).unwrap();
            let recv_ns = at + 20 * MS + n % 7 * jitter_ms * MS;
            let seen = SampleFacts {
                again: false,
                seq: n,
                capture_ns,
                recv_ns,
                flagged: false,
                picture: Judgement::Usable,
                payload: b"",
                repeated: None,
            };
            measures.sample(id(0), &seen);
        }
        quality_at(&measures, seconds * 1000)
    };
    for seconds in [4, 30, 600] {
        let report = run(0, 5, seconds);
        assert!(report.clock_drift.unwrap().abs() < 1e-9, "jitter is not drift: {report:?}");
        assert!(report.clock_ahead.abs() < 1e-9);
    }
    // From the earliest of the first quarter to that of the last lie three quarters of an episode.
    let slow = run(-1000, 5, 30).clock_drift.unwrap();
    assert!((19.0..31.0).contains(&slow), "{slow}");
    let fast = run(1000, 0, 30);
    assert!((-31.0..-19.0).contains(&fast.clock_drift.unwrap()), "{fast:?}");
    assert!((9.0..11.0).contains(&fast.clock_ahead), "30 ms ahead of a way of 20: {fast:?}");
    assert_eq!(run(1000, 0, 0).clock_drift, None);
}

#[test]
fn drift_has_a_fixed_size_and_survives_any_time() {
    let mut drift = Drift::default();
    for since in [0, 1, 250 * MS, 4000 * MS, u64::MAX, u64::MAX / 2, 0] {
        drift.push(since, i64::MIN);
    }
    assert_eq!(drift.over_the_episode(), None);
}

#[test]
fn frames_give_sample_offsets_from_the_tick_and_their_spread() {
    let mut measures = measures(ModalityKind::Scalars);
    let ms = |ms: i64| Some(ms * 1_000_000);
    for (a, b) in [(ms(5), ms(-5)), (ms(10), ms(10)), (ms(3), None), (None, None)] {
        measures.frame([(id(0), true, a), (id(3), b.is_some(), b), (id(9), true, ms(900))].into_iter());
    }
    let report = quality_at(&measures, 100);
    assert_eq!((report.frames_present, report.frames_valid), (4, 3));
    assert!((report.offset.unwrap().max - 10.0).abs() < 1e-9);
    assert!((report.offset.unwrap().p50 - 5.0).abs() < 0.1, "{report:?}");
    let skew = measures.skew().unwrap();
    assert!((skew.max - 10.0).abs() < 1e-9 && skew.p50 < 1e-9, "{skew:?}");
}

/// Samples (time, modality, offset) and masks (time, bits).
type Made = (Vec<(u64, u8, u64)>, Vec<(u64, u64)>);

/// Any samples and masks, in the order of their times.
fn episode() -> impl Strategy<Value = Made> {
    let samples = prop::collection::vec((0_u64..3000, 0_u8..3, 0_u64..300), 0..60);
    let masks = prop::collection::vec((0_u64..3000, 0_u64..4), 0..12);
    (samples, masks).prop_map(|(mut samples, mut masks)| {
        samples.sort_unstable();
        masks.sort_unstable();
        // An absence of no length would begin a new gap, which milliseconds cannot show.
        masks.dedup_by_key(|(at, _)| *at);
        (samples, masks)
    })
}

proptest! {
    /// Against the definition: count by count, and gaps millisecond by millisecond.
    #[test]
    fn measures_match_their_definitions((samples, masks) in episode()) {
        let mut measures = measures(ModalityKind::Image);
        for (n, (at, byte, late)) in samples.iter().enumerate() {
            measures.sample(id(0), &seen(n as u64, *at, *late, &[*byte]));
        }
        for (at, mask) in &masks {
            measures.mask(BEGIN + at * MS, PhysicalMask(*mask));
        }
        measures.settle();
        let report = quality_at(&measures, 3000);
        prop_assert_eq!(report.samples, samples.len() as u64);
        let repeated = samples.windows(2).filter(|pair| pair[0].1 == pair[1].1).count();
        prop_assert_eq!(report.repeated, repeated as u64);
        let duplicates = samples.windows(2).filter(|pair| pair[0].0 == pair[1].0).count();
        prop_assert_eq!(report.duplicates, duplicates as u64);

        let is_present = |ms: u64| match masks.iter().rfind(|(at, _)| *at <= ms) {
            Some((_, mask)) => mask & 1 == 1,
            None => masks.is_empty(),
        };
        let (mut frozen, mut same) = (0, 0);
        for pair in samples.windows(2) {
            let between = (pair[0].0..pair[1].0).filter(|ms| is_present(*ms)).count();
            same = if pair[0].1 == pair[1].1 { same + between } else { 0 };
            frozen = frozen.max(same);
        }
        prop_assert!((report.frozen - frozen as f64 / 1e3).abs() < 1e-6, "{} {frozen}", report.frozen);
        let (mut longest, mut run, mut present) = (0, 0, 0);
        for ms in 0..3000 {
            if samples.iter().any(|(at, ..)| *at == ms) {
                run = 0;
            }
            run = if is_present(ms) { run + 1 } else { 0 };
            present += u64::from(is_present(ms));
            longest = longest.max(run);
        }
        prop_assert!((report.present - present as f64 / 1e3).abs() < 1e-6, "{} {present}", report.present);
        prop_assert!((report.longest_gap - f64::from(longest) / 1e3).abs() < 1e-6, "{} {longest}", report.longest_gap);
    }

    /// Hostile numbers: nothing panics, and no count exceeds the number of samples.
    #[test]
    fn no_sample_causes_a_panic(samples in prop::collection::vec(any::<(u64, u64, u64, bool)>(), 0..40), end in any::<u64>()) {
        let mut measures = measures(ModalityKind::Image);
        for (seq, capture_ns, recv_ns, cut) in &samples {
            let seen = SampleFacts { again: false, seq: *seq, capture_ns: *capture_ns, recv_ns: *recv_ns, flagged: false, picture: if *cut { Judgement::NotWhole } else { Judgement::Usable }, payload: b"", repeated: None };
            measures.sample(id(0), &seen);
            measures.mask(*capture_ns, PhysicalMask(*seq));
            measures.missing(id(0), *seq, *recv_ns);
            measures.frame([(id(0), *cut, Some(seq.cast_signed()))].into_iter());
        }
        let report = measures.quality(id(0), end).unwrap();
        let most = samples.len() as u64;
        prop_assert!(report.samples == most && report.late <= most && report.duplicates <= most && report.truncated <= most);
        prop_assert!(serde_json::to_string(&report).is_ok());
    }
}

#[test]
fn the_largest_uncertainty_of_a_clock_counts() {
    let mut measures = measures(ModalityKind::Image);
    assert_eq!(quality_at(&measures, 0).clock_uncertainty, None);
    for ns in [3 * MS, 7 * MS, 5 * MS] {
        measures.uncertainty(id(0), ns);
    }
    measures.uncertainty(id(9), MS);
    assert_eq!(quality_at(&measures, 0).clock_uncertainty, Some(7.0));
}

#[test]
fn only_a_frame_at_the_edge_of_a_presence_may_lack_a_sample() {
    // Present with (v) and without (-) a valid sample, absent (.).
    for (frames, missed) in [
        ("vvvvvv", 0),
        ("-vvvv-", 0),
        ("v-vv-v", 2),
        ("--vv--", 2),
        ("v-..-v", 0),
        ("v--..--v", 2),
        ("......", 0),
        ("----------", 8),
        ("-", 0),
    ] {
        let mut meter = Meter::new(0, false);
        for frame in frames.chars() {
            meter.frame(frame != '.', frame == 'v');
        }
        assert_eq!(meter.counts.frames_missed, missed, "{frames}");
    }
}

#[test]
fn samples_waiting_for_the_mask_are_bounded_and_judged() {
    let mut measures = measures(ModalityKind::Scalars);
    measures.mask(BEGIN, PhysicalMask(1));
    let mut at = 0;
    for seq in 0..3 * MOST_PENDING as u64 {
        // Longer from one to the next.
        at += seq;
        measures.sample(id(0), &seen(seq, at, 0, b"x"));
        assert!(measures.modalities[0].as_ref().is_some_and(|modality| modality.pending.len() <= MOST_PENDING));
    }
    // The last is the longest.
    let longest = (3 * MOST_PENDING as u64 - 1) as f64 / 1e3;
    assert_eq!(format!("{:.3}", quality_at(&measures, at).longest_gap), format!("{longest:.3}"));
}
