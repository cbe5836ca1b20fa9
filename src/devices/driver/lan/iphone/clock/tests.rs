//! The clock against the truth, on simulated phones and networks.

use std::collections::VecDeque;

use proptest::prelude::*;
use rapid_core::random::Random;

use super::*;

const MS: f64 = 1e6;
const S: f64 = 1e9;

/// What happens to a phone and its network from a moment on.
#[derive(Debug, Clone, Copy, PartialEq)]
enum What {
    /// All frames take this much longer, ms.
    Slower(f64),
    /// For this long nothing arrives, s; then all of it does.
    Stall(f64),
    /// The phone disconnects and is back after so many seconds; its clocks run on.
    Reconnect(f64),
    /// The same, and its own clock stood still for as long.
    Asleep(f64),
    /// It was started again: its clock begins at 0.
    Restart,
    /// So many frames have a time that is wrong by so many seconds.
    Wrong(u32, f64),
    /// Its wall clock is set, by so many seconds.
    WallSet(f64),
}

/// Ascending, s.
type Events = &'static [(f64, What)];

#[derive(Debug, Clone)]
struct Scenario {
    seed: u64,
    fps: f64,
    seconds: f64,
    /// Drift of the phone's clock, millionths.
    ppm: f64,
    /// Shortest delay, ms.
    base: f64,
    /// Mean of what a frame takes longer, ms, distributed exponentially.
    jitter: f64,
    /// Ascending, s.
    events: Vec<(f64, What)>,
}

impl Scenario {
    fn new(events: &[(f64, What)]) -> Self {
        let events = events.to_vec();
        Self { seed: 1, fps: 30.0, seconds: 120.0, ppm: 0.0, base: 5.0, jitter: 3.0, events }
    }
}

/// A frame as it was judged.
#[derive(Debug, Clone, Copy)]
struct Seen {
    /// When it was captured in truth, s.
    at: f64,
    /// Stamp minus true capture, less the shortest delay; ms.
    error: f64,
    /// The stated uncertainty, ms.
    uncertainty: f64,
    is_damaged: bool,
    is_wrong: bool,
    /// Arrival minus true capture, ms.
    delay: f64,
}

/// Plays a scenario.
fn play(scenario: &Scenario) -> Vec<Seen> {
    let mut random = Random::new(scenario.seed, 0);
    let mut clock = PhoneClock::default();
    clock.connected();
    let mut events: VecDeque<_> = scenario.events.iter().copied().collect();
    let (mut slower, mut stalled, mut away, mut wrong) = (0.0, 0.0, 0.0, (0, 0.0));
    // What its clock shows less, and its wall clock more, s.
    let (mut behind, mut wall_ahead) = (-77.0, 1.7e9);
    let (mut last, mut seen) = (0.0, Vec::new());
    for frame in 0_u32.. {
        let at = f64::from(frame) / scenario.fps;
        if at > scenario.seconds {
            return seen;
        }
        while events.front().is_some_and(|(begins, _)| *begins <= at) {
            match events.pop_front().expect("one").1 {
                What::Slower(ms) => slower = ms,
                What::Stall(seconds) => stalled = at + seconds,
                What::Wrong(count, by) => wrong = (count, by),
                What::WallSet(by) => wall_ahead += by,
                What::Reconnect(seconds) => (away, stalled) = (at + seconds, 0.0),
                What::Asleep(seconds) => {
                    (away, stalled) = (at + seconds, 0.0);
                    behind += seconds;
                }
                What::Restart => {
                    (away, stalled) = (at + 20.0, 0.0);
                    behind = at + 20.0;
                }
            }
            if away > at {
                clock.connected();
            }
        }
        if at < away {
            continue;
        }
        let device = (at - behind) * (1.0 + scenario.ppm / 1e6);
        let is_wrong = wrong.0 > 0;
        let device_time = if is_wrong { device + wrong.1 } else { device };
        wrong.0 = wrong.0.saturating_sub(1);
        let longer = -random.uniform(f64::EPSILON, 1.0).ln() * scenario.jitter;
        let arrival = (at + (scenario.base + slower + longer) / 1e3).max(stalled).max(last);
        last = arrival;
        let captured = 1000.0 * S + at * S;
        let arrived = 1000.0 * S + arrival * S;
        let frame = Frame { pose: [0.0; 16], device_time, wall_clock: device + behind + wall_ahead };
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "of some minutes")]
        let arrival = Stamp(arrived as u64);
        let Captured { at: stamp, is_damaged } = clock.captured(&frame, arrival);
        assert!(stamp <= arrival, "later than the arrival");
        seen.push(Seen {
            at,
            error: (stamp.0 as f64 - captured) / MS - scenario.base,
            uncertainty: clock.offset().map_or(0.0, |offset| offset.uncertainty_ns as f64 / MS),
            is_damaged,
            is_wrong,
            delay: (arrived - captured) / MS,
        });
    }
    seen
}

/// The largest error of a good sample from a moment on.
fn worst(seen: &[Seen], from: f64) -> f64 {
    seen.iter().filter(|seen| seen.at >= from && !seen.is_damaged).map(|seen| seen.error.abs()).fold(0.0, f64::max)
}

fn is_within_what_is_stated(scenario: &Scenario, seen: &[Seen], from: f64) {
    for seen in seen.iter().filter(|seen| seen.at >= from && !seen.is_damaged) {
        assert!(seen.error.abs() <= seen.uncertainty + 0.5, "{seen:?} of {scenario:?}");
    }
}

#[test]
fn the_zero_is_kept_whatever_happens_to_the_delay() {
    use What::{Asleep, Reconnect, Slower, Stall, WallSet, Wrong};
    // What happens, the greatest error after ten seconds and the greatest uncertainty at the end, ms.
    let table: [(Events, f64, f64); 12] = [
        (&[], 1.0, 5.5),
        (&[(20.0, Slower(400.0))], 3.0, 13.0),
        (&[(20.0, Slower(30.0))], 3.0, 13.0),
        // How far the clocks drifted meanwhile stays unknown.
        (&[(20.0, Slower(400.0)), (80.0, Slower(0.0))], 3.0, 10.0),
        (&[(20.0, Slower(5000.0)), (60.0, Slower(0.0))], 3.0, 10.0),
        (&[(20.0, Stall(5.5)), (40.0, Stall(1.0))], 1.0, 5.5),
        (&[(20.0, Reconnect(3.0))], 1.0, 5.5),
        // It comes back with a worse connection.
        (&[(80.0, Slower(400.0)), (85.0, Reconnect(3.0))], 3.0, 8.0),
        (&[(20.0, Asleep(30.0))], 12.0, 5.5),
        (&[(20.0, Wrong(1, 5.0)), (30.0, Wrong(3, -5.0)), (40.0, Wrong(1, 1e6))], 1.0, 5.5),
        (&[(20.0, WallSet(3600.0)), (40.0, WallSet(-1.0))], 1.0, 5.5),
        (&[(20.0, WallSet(3600.0)), (40.0, Slower(400.0))], 3.0, 13.0),
    ];
    for (events, error, uncertainty) in table {
        for (seed, ppm) in [(1, 0.0), (2, 20.0), (3, -20.0)] {
            let scenario = Scenario { seed, ppm, ..Scenario::new(events) };
            let seen = play(&scenario);
            assert!(worst(&seen, 10.0) <= error, "{} of {scenario:?}", worst(&seen, 10.0));
            let last = seen.last().expect("frames");
            assert!(last.uncertainty <= uncertainty, "{last:?} of {scenario:?}");
            let damaged: Vec<_> = seen.iter().filter(|seen| seen.is_damaged).collect();
            assert!(damaged.len() <= 5 && damaged.iter().all(|seen| seen.is_wrong), "{damaged:?} of {scenario:?}");
            assert_eq!(seen.iter().filter(|seen| seen.is_wrong && !seen.is_damaged).count(), 0, "{scenario:?}");
        }
    }
}

#[test]
fn a_first_minute_of_long_delays_is_stated_when_it_is_known() {
    let scenario = Scenario::new(&[(0.0, What::Slower(400.0)), (60.0, What::Slower(0.0))]);
    let seen = play(&scenario);
    let (before, after): (Vec<Seen>, Vec<Seen>) = seen.iter().partition(|seen| seen.at < 60.0);
    assert!(worst(&before, 10.0) > 399.0, "nothing shows it");
    assert!(worst(&after, 62.0) < 2.0);
    let stated = after.iter().map(|seen| seen.uncertainty).fold(0.0, f64::max);
    assert!((395.0..410.0).contains(&stated), "{stated}");
    assert!(after.last().expect("frames").uncertainty < 5.0);
}

#[test]
fn a_sample_is_late_or_damaged_never_fresh() {
    for (ms, is_damaged) in [(5000.0, false), (9900.0, false), (12_000.0, true), (3_600_000.0, true)] {
        let seen = play(&Scenario::new(&[(20.0, What::Slower(ms)), (60.0, What::Slower(0.0))]));
        let slow = |seen: &&Seen| (20.0..60.0).contains(&seen.at);
        assert!(seen.iter().filter(slow).all(|seen| seen.is_damaged == is_damaged), "{ms}");
        assert!(worst(&seen, 10.0) < 3.0, "{ms}");
    }
}

#[test]
fn a_clock_that_began_again_is_believed_once_it_persists() {
    for what in [What::Wrong(u32::MAX, -60.0), What::Wrong(u32::MAX, 60.0), What::Restart] {
        let seen = play(&Scenario::new(&[(20.0, what)]));
        let damaged = seen.iter().filter(|seen| seen.is_damaged).count();
        assert_eq!(damaged, PERSISTS as usize - 1, "{what:?}");
        let good = seen.iter().filter(|seen| !seen.is_damaged);
        let worst = good.map(|seen| seen.error - seen.uncertainty).fold(0.0, f64::max);
        assert!(worst < 12.0, "{worst}: {what:?}");
    }
}

/// Some minutes of delay in every ten, for three hours.
#[test]
fn hours_of_it_do_not_add_up() {
    let events: Vec<_> = (1..18_u32)
        .flat_map(|tenth| [(0.0, 400.0), (200.0, 0.0)].map(|(s, ms)| (f64::from(tenth) * 600.0 + s, What::Slower(ms))))
        .collect();
    for (seed, ppm) in [(1, 0.0), (2, 40.0), (3, -40.0)] {
        let scenario = Scenario { seed, ppm, seconds: 10_800.0, fps: 15.0, ..Scenario::new(&events) };
        let seen = play(&scenario);
        is_within_what_is_stated(&scenario, &seen, 5.0);
        let largest = seen.iter().map(|seen| seen.uncertainty).fold(0.0, f64::max);
        assert!(largest < 12.5, "{largest} ms of {scenario:?}");
    }
}

#[test]
fn any_time_is_survived() {
    let mut clock = PhoneClock::default();
    for time in [f64::NAN, f64::INFINITY, -1.0, 1e300, 0.0, 12.0, 0.0, 3e9, 5.0] {
        for wall_clock in [f64::NAN, f64::NEG_INFINITY, 0.0, 1.7e9, f64::MAX] {
            let frame = Frame { pose: [0.0; 16], device_time: time, wall_clock };
            let Captured { at, is_damaged } = clock.captured(&frame, Stamp(9_000_000_000));
            assert!(at <= Stamp(9_000_000_000), "{time}");
            assert!((0.0..3.2e9).contains(&time) || is_damaged, "{time}");
        }
    }
}

#[test]
fn a_clock_is_kept_between_connections_by_the_entry() {
    let frame = Frame { pose: [0.0; 16], device_time: 5.0, wall_clock: 1.7e9 };
    let mut clock = PhoneClock::recall("kept");
    assert_eq!(clock.offset(), None);
    clock.captured(&frame, Stamp(9_000_000_000));
    let offset = clock.offset();
    assert_eq!(offset.map(|offset| offset.offset_ns), Some(-4_000_000_000));
    clock.keep("kept");
    assert_eq!(PhoneClock::recall("another").offset(), None);
    assert_eq!(PhoneClock::recall("kept").offset(), offset);
}

fn happening() -> impl Strategy<Value = What> {
    prop_oneof![
        (10.0..1000.0).prop_map(What::Slower),
        Just(What::Slower(0.0)),
        (0.1..4.9).prop_map(What::Stall),
        (0.3..20.0).prop_map(What::Reconnect),
        (1_u32..9, prop_oneof![-1e4..-150.0, 20.0..1e5]).prop_map(|(count, by)| What::Wrong(count, by)),
        (-1e4..1e4).prop_map(What::WallSet),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig { cases: crate::effort::cases(300), failure_persistence: None, ..ProptestConfig::default() })]
    #[test]
    fn the_true_error_is_within_the_stated_uncertainty(
        seed: u64, fps in prop_oneof![Just(15.0), Just(30.0), Just(60.0)], ppm in -80.0..80.0, base in 1.0..50.0,
        jitter in prop_oneof![Just(0.0), 0.1..20.0], what in prop::collection::vec((1.0..30.0, happening()), 0..6),
    ) {
        // Ten seconds in which the zero is seen come first.
        let mut begins = 10.0;
        let mut events = Vec::new();
        for (pause, what) in what {
            begins += pause;
            events.push((begins, what));
        }
        let scenario = Scenario { seed, fps, seconds: begins + 30.0, ppm, base, jitter, events };
        let seen = play(&scenario);
        is_within_what_is_stated(&scenario, &seen, 5.0);
        for seen in &seen {
            prop_assert!(!seen.is_damaged || seen.is_wrong, "{:?} of {:?}", seen, scenario);
            prop_assert!(seen.delay >= 0.0);
        }
    }
}
