use super::*;
use DeviceState::{Absent, Backoff, Failed, Opening, Stalled, Streaming};
use proptest::prelude::*;

const COOLDOWN: Duration = Duration::from_secs(2);

fn ms(ms: u64) -> Stamp {
    Stamp(1_000_000_000_000 + ms * 1_000_000)
}

/// A lifecycle brought into `state` by legal inputs, at 0 ms, with attachment `a` and epoch 1 where it
/// has run.
fn lifecycle_in(state: DeviceState) -> Lifecycle<char> {
    let mut lifecycle = Lifecycle::new(COOLDOWN);
    let inputs: &[Input<char>] = match state {
        Absent => &[],
        Opening => &[Input::Attached('a')],
        Streaming => &[Input::Attached('a'), Input::Started(Epoch(1))],
        Stalled => &[Input::Attached('a'), Input::Started(Epoch(1)), Input::Stalled(Epoch(1))],
        Backoff => &[Input::Attached('a'), Input::Ended(Epoch(1), End::Retry)],
        Failed => &[Input::Attached('a'), Input::Ended(Epoch(1), End::Fatal)],
    };
    for input in inputs {
        lifecycle.apply(input.clone(), ms(0));
    }
    assert_eq!(lifecycle.state(), state);
    lifecycle
}

fn stop(epoch: u32) -> Effects<char> {
    Effects { stop: Some(Epoch(epoch)), start: None }
}

fn start(epoch: u32, attachment: char) -> Effects<char> {
    Effects { stop: None, start: Some((Epoch(epoch), attachment)) }
}

#[test]
fn every_transition_of_the_current_epoch() {
    let e = Epoch(1);
    let none = Effects::NONE;
    let replace = Effects { stop: Some(e), start: Some((Epoch(2), 'b')) };
    // (from, input, to, effects), every state with every input, all at 10 ms. The back-off in state Backoff ends at 500
    // ms.
    let table = [
        (Absent, Input::Attached('b'), Opening, start(1, 'b')),
        (Absent, Input::Detached, Absent, none.clone()),
        (Absent, Input::Started(e), Absent, none.clone()),
        (Absent, Input::Stalled(e), Absent, none.clone()),
        (Absent, Input::Resumed(e), Absent, none.clone()),
        (Absent, Input::Ended(e, End::Gone), Absent, none.clone()),
        (Absent, Input::Ended(e, End::Retry), Absent, none.clone()),
        (Absent, Input::Ended(e, End::LinkDown), Absent, none.clone()),
        (Absent, Input::Ended(e, End::Fatal), Absent, none.clone()),
        (Absent, Input::Restart, Absent, none.clone()),
        (Absent, Input::Timer, Absent, none.clone()),
        (Opening, Input::Attached('b'), Opening, replace.clone()),
        (Opening, Input::Detached, Absent, stop(1)),
        (Opening, Input::Started(e), Streaming, none.clone()),
        (Opening, Input::Stalled(e), Opening, none.clone()),
        (Opening, Input::Resumed(e), Opening, none.clone()),
        (Opening, Input::Ended(e, End::Gone), Absent, none.clone()),
        (Opening, Input::Ended(e, End::Retry), Backoff, none.clone()),
        (Opening, Input::Ended(e, End::LinkDown), Backoff, none.clone()),
        (Opening, Input::Ended(e, End::Fatal), Failed, none.clone()),
        (Opening, Input::Restart, Opening, none.clone()),
        (Opening, Input::Timer, Opening, none.clone()),
        (Streaming, Input::Attached('b'), Opening, replace.clone()),
        (Streaming, Input::Detached, Absent, stop(1)),
        (Streaming, Input::Started(e), Streaming, none.clone()),
        (Streaming, Input::Stalled(e), Stalled, none.clone()),
        (Streaming, Input::Resumed(e), Streaming, none.clone()),
        (Streaming, Input::Ended(e, End::Gone), Absent, none.clone()),
        (Streaming, Input::Ended(e, End::Retry), Backoff, none.clone()),
        (Streaming, Input::Ended(e, End::LinkDown), Backoff, none.clone()),
        (Streaming, Input::Ended(e, End::Fatal), Failed, none.clone()),
        (Streaming, Input::Restart, Streaming, none.clone()),
        (Streaming, Input::Timer, Streaming, none.clone()),
        (Stalled, Input::Attached('b'), Opening, replace),
        (Stalled, Input::Detached, Absent, stop(1)),
        (Stalled, Input::Started(e), Stalled, none.clone()),
        (Stalled, Input::Stalled(e), Stalled, none.clone()),
        (Stalled, Input::Resumed(e), Streaming, none.clone()),
        (Stalled, Input::Ended(e, End::Gone), Absent, none.clone()),
        (Stalled, Input::Ended(e, End::Retry), Backoff, none.clone()),
        (Stalled, Input::Ended(e, End::LinkDown), Backoff, none.clone()),
        (Stalled, Input::Ended(e, End::Fatal), Failed, none.clone()),
        (Stalled, Input::Restart, Stalled, none.clone()),
        (Stalled, Input::Timer, Stalled, none.clone()),
        (Backoff, Input::Attached('b'), Opening, start(2, 'b')),
        (Backoff, Input::Detached, Absent, none.clone()),
        (Backoff, Input::Started(e), Backoff, none.clone()),
        (Backoff, Input::Stalled(e), Backoff, none.clone()),
        (Backoff, Input::Resumed(e), Backoff, none.clone()),
        (Backoff, Input::Ended(e, End::Gone), Backoff, none.clone()),
        (Backoff, Input::Ended(e, End::Retry), Backoff, none.clone()),
        (Backoff, Input::Ended(e, End::LinkDown), Backoff, none.clone()),
        (Backoff, Input::Ended(e, End::Fatal), Backoff, none.clone()),
        (Backoff, Input::Restart, Opening, start(2, 'a')),
        (Backoff, Input::Timer, Backoff, none.clone()),
        (Failed, Input::Attached('b'), Opening, start(2, 'b')),
        (Failed, Input::Detached, Absent, none.clone()),
        (Failed, Input::Started(e), Failed, none.clone()),
        (Failed, Input::Stalled(e), Failed, none.clone()),
        (Failed, Input::Resumed(e), Failed, none.clone()),
        (Failed, Input::Ended(e, End::Gone), Failed, none.clone()),
        (Failed, Input::Ended(e, End::Retry), Failed, none.clone()),
        (Failed, Input::Ended(e, End::LinkDown), Failed, none.clone()),
        (Failed, Input::Ended(e, End::Fatal), Failed, none.clone()),
        (Failed, Input::Restart, Opening, start(2, 'a')),
        (Failed, Input::Timer, Failed, none),
    ];
    assert_eq!(table.len(), 6 * 11);
    for (from, input, to, effects) in table {
        let mut lifecycle = lifecycle_in(from);
        let got = lifecycle.apply(input.clone(), ms(10));
        assert_eq!((lifecycle.state(), &got), (to, &effects), "{from:?} {input:?}");
        assert_eq!(lifecycle.is_present(), matches!(to, Streaming | Stalled), "{from:?} {input:?}");
    }
}

#[test]
fn an_older_epoch_changes_nothing_in_any_state() {
    for state in [Absent, Opening, Streaming, Stalled, Backoff, Failed] {
        for old in [Epoch(0), Epoch(9)] {
            for input in [
                Input::Started(old),
                Input::Stalled(old),
                Input::Resumed(old),
                Input::Ended(old, End::Gone),
                Input::Ended(old, End::Retry),
                Input::Ended(old, End::LinkDown),
                Input::Ended(old, End::Fatal),
            ] {
                let mut lifecycle = lifecycle_in(state);
                let deadline = lifecycle.deadline();
                assert_eq!(lifecycle.apply(input.clone(), ms(10)), Effects::NONE);
                assert_eq!((lifecycle.state(), lifecycle.deadline()), (state, deadline), "{input:?}");
            }
        }
    }
}

#[test]
fn a_cooldown_delays_a_replug_and_counts_from_the_first_witness() {
    let mut lifecycle = lifecycle_in(Streaming);
    lifecycle.apply(Input::Ended(Epoch(1), End::Gone), ms(1000));
    assert_eq!(lifecycle.state(), Absent);
    assert_eq!(lifecycle.apply(Input::Detached, ms(1050)), Effects::NONE);
    assert_eq!(lifecycle.apply(Input::Attached('b'), ms(1300)), Effects::NONE);
    assert_eq!((lifecycle.state(), lifecycle.deadline()), (Backoff, Some(ms(3000))));
    assert_eq!(lifecycle.apply(Input::Timer, ms(2999)), Effects::NONE);
    assert_eq!(lifecycle.apply(Input::Timer, ms(3000)), start(2, 'b'));
    assert_eq!(lifecycle.deadline(), None);
}

#[test]
fn after_the_cooldown_a_replug_starts_at_once() {
    let mut lifecycle = lifecycle_in(Streaming);
    lifecycle.apply(Input::Detached, ms(1000));
    assert_eq!(lifecycle.apply(Input::Attached('b'), ms(3000)), start(2, 'b'));
}

#[test]
fn bounces_within_the_cooldown_settle_on_the_last_attachment() {
    let mut lifecycle = lifecycle_in(Streaming);
    lifecycle.apply(Input::Detached, ms(0));
    lifecycle.apply(Input::Attached('b'), ms(100));
    lifecycle.apply(Input::Detached, ms(200));
    lifecycle.apply(Input::Attached('c'), ms(300));
    assert_eq!(lifecycle.deadline(), Some(ms(2200)));
    assert_eq!(lifecycle.apply(Input::Timer, ms(2200)), start(2, 'c'));
}

#[test]
fn a_stream_that_was_wrong_about_an_unplug_is_started_again() {
    let mut lifecycle = lifecycle_in(Streaming);
    lifecycle.apply(Input::Ended(Epoch(1), End::Gone), ms(0));
    assert_eq!(lifecycle.apply(Input::Timer, ms(2000)), start(2, 'a'));
}

#[test]
fn a_stream_that_is_repeatedly_wrong_about_an_unplug_fails_until_a_replug() {
    let mut lifecycle = lifecycle_in(Opening);
    let mut now = 0;
    for (n, wait) in [2000, 2000, 2000, 4000, 8000].into_iter().enumerate() {
        let epoch = Epoch(u32::try_from(n).expect("small") + 1);
        lifecycle.apply(Input::Ended(epoch, End::Gone), ms(now));
        assert_eq!((lifecycle.state(), lifecycle.deadline()), (Absent, Some(ms(now + wait))));
        now += wait;
        assert_eq!(lifecycle.apply(Input::Timer, ms(now)), start(epoch.0 + 1, 'a'));
    }
    lifecycle.apply(Input::Ended(Epoch(6), End::Gone), ms(now));
    assert_eq!((lifecycle.state(), lifecycle.deadline()), (Absent, Some(ms(now + 2000))));
    assert_eq!(lifecycle.apply(Input::Timer, ms(now + 2000)), Effects::NONE);
    assert_eq!((lifecycle.state(), lifecycle.deadline()), (Failed, None));
    let mut by_hand = lifecycle.clone();
    assert_eq!(by_hand.apply(Input::Restart, ms(now + 2001)), start(7, 'a'));
    lifecycle.apply(Input::Detached, ms(now + 3000));
    lifecycle.apply(Input::Attached('b'), ms(now + 3100));
    assert_eq!(lifecycle.apply(Input::Timer, ms(now + 5000)), start(7, 'b'));
    // A stream that ran for a minute resets the back-off.
    lifecycle.apply(Input::Ended(Epoch(7), End::Gone), ms(now + 70_000));
    assert_eq!(lifecycle.deadline(), Some(ms(now + 72_000)));
}

#[test]
fn restarts_back_off_and_give_up_after_five_in_a_minute() {
    let mut lifecycle = lifecycle_in(Opening);
    let mut now = 0;
    for (n, backoff) in [500, 1000, 2000, 4000, 8000].into_iter().enumerate() {
        let epoch = Epoch(u32::try_from(n).expect("small") + 1);
        lifecycle.apply(Input::Ended(epoch, End::Retry), ms(now));
        assert_eq!(lifecycle.deadline(), Some(ms(now + backoff)));
        now += backoff;
        assert_eq!(lifecycle.apply(Input::Timer, ms(now)), start(epoch.0 + 1, 'a'));
    }
    lifecycle.apply(Input::Ended(Epoch(6), End::Retry), ms(now));
    assert_eq!((lifecycle.state(), lifecycle.deadline()), (Failed, None));
}

#[test]
fn a_cable_may_be_pulled_any_number_of_times() {
    let mut lifecycle = lifecycle_in(Opening);
    for n in 1..20 {
        let now = 600 * u64::from(n);
        lifecycle.apply(Input::Ended(Epoch(n), End::LinkDown), ms(now));
        assert_eq!((lifecycle.state(), lifecycle.deadline()), (Backoff, Some(ms(now + 500))));
        assert_eq!(lifecycle.apply(Input::Timer, ms(now + 500)), start(n + 1, 'a'));
    }
}

#[test]
fn a_stream_stable_for_a_minute_resets_the_backoff() {
    let mut lifecycle = lifecycle_in(Backoff);
    lifecycle.apply(Input::Timer, ms(500));
    lifecycle.apply(Input::Started(Epoch(2)), ms(600));
    lifecycle.apply(Input::Ended(Epoch(2), End::Retry), ms(61_000));
    assert_eq!(lifecycle.deadline(), Some(ms(61_500)));
}

/// An event that a lifecycle reacts to.
#[derive(Debug, Clone)]
enum Event {
    Attach(char),
    Detach,
    Report(u32, u8),
    Restart,
    Wait(u64),
}

fn event() -> impl Strategy<Value = Event> {
    prop_oneof![
        proptest::char::range('a', 'd').prop_map(Event::Attach),
        Just(Event::Detach),
        (0_u32..6, 0_u8..7).prop_map(|(age, kind)| Event::Report(age, kind)),
        Just(Event::Restart),
        (0_u64..4000).prop_map(Event::Wait),
    ]
}

/// Lets a lifecycle settle with a working device: timers run, a started stream delivers samples.
fn settle(lifecycle: &mut Lifecycle<char>, now: &mut Stamp) {
    for _ in 0..32 {
        let effects = match (lifecycle.state(), lifecycle.deadline()) {
            (Opening, _) => lifecycle.apply(Input::Started(lifecycle.epoch()), *now),
            (Stalled, _) => lifecycle.apply(Input::Resumed(lifecycle.epoch()), *now),
            (_, Some(deadline)) => {
                *now = (*now).max(deadline);
                lifecycle.apply(Input::Timer, *now)
            }
            _ => return,
        };
        assert!(effects.stop.is_none(), "settling never stops a stream");
    }
    panic!("the lifecycle never settles: {lifecycle:?}");
}

proptest! {
    /// After any sequence of events, with reports of old and new streams: once a working device has been attached, the
    /// lifecycle streams; once it is gone, the lifecycle is Absent.
    #[test]
    fn the_settled_state_depends_only_on_the_attachments(
        history in proptest::collection::vec(event(), 0..60),
        last in proptest::option::of(proptest::char::range('a', 'd')),
    ) {
        let mut lifecycle = Lifecycle::new(COOLDOWN);
        let mut now = ms(0);
        let mut running = None;
        let mut attached = None;
        for event in history {
            let input = match event {
                Event::Attach(device) if attached.is_none() => { attached = Some(device); Input::Attached(device) }
                Event::Attach(_) => continue,
                Event::Detach => { attached = None; Input::Detached }
                Event::Restart => Input::Restart,
                Event::Wait(wait) => { now = now.after(Duration::from_millis(wait)); Input::Timer }
                Event::Report(age, kind) => {
                    let epoch = Epoch(lifecycle.epoch().0.saturating_sub(age));
                    match kind {
                        0 => Input::Started(epoch),
                        1 => Input::Stalled(epoch),
                        2 => Input::Resumed(epoch),
                        3 => Input::Ended(epoch, End::Gone),
                        4 => Input::Ended(epoch, End::Retry),
                        5 => Input::Ended(epoch, End::LinkDown),
                        _ => Input::Ended(epoch, End::Fatal),
                    }
                }
            };
            let before = lifecycle.epoch();
            let effects = lifecycle.apply(input, now);
            // At most one stream runs, and a new one always has a new epoch.
            if let Some(epoch) = effects.stop { prop_assert_eq!(running.take(), Some(epoch)); }
            if let Some((epoch, device)) = effects.start {
                prop_assert!(epoch > before);
                prop_assert_eq!(Some(device), attached, "only what is attached is started");
                running = Some(epoch);
            }
            if !lifecycle.is_running() { running = None; }
            prop_assert!(attached.is_some() || lifecycle.state() == Absent, "nothing attached, yet {:?}", lifecycle.state());
            prop_assert!(!lifecycle.is_present() || attached.is_some());
        }
        // The final events: the device is unplugged, and perhaps one is plugged in.
        lifecycle.apply(Input::Detached, now);
        if let Some(device) = last { lifecycle.apply(Input::Attached(device), now); }
        settle(&mut lifecycle, &mut now);
        prop_assert_eq!(lifecycle.attached().copied(), last);
        prop_assert_eq!(lifecycle.state(), if last.is_some() { Streaming } else { Absent });
    }

    /// As above without the final events: a history in which no stream failed needs none.
    #[test]
    fn no_replug_is_lost_however_fast(history in proptest::collection::vec(event(), 0..60)) {
        let mut lifecycle = Lifecycle::new(COOLDOWN);
        let mut now = ms(0);
        let mut attached = None;
        for event in history {
            let input = match event {
                Event::Attach(device) => { attached = Some(device); Input::Attached(device) }
                Event::Detach => { attached = None; Input::Detached }
                Event::Wait(wait) => { now = now.after(Duration::from_millis(wait)); Input::Timer }
                Event::Report(age, 3) => Input::Ended(Epoch(lifecycle.epoch().0.saturating_sub(age)), End::Gone),
                Event::Report(age, _) => Input::Started(Epoch(lifecycle.epoch().0.saturating_sub(age))),
                Event::Restart => Input::Restart,
            };
            lifecycle.apply(input, now);
        }
        settle(&mut lifecycle, &mut now);
        // Failed after its driver reported too often that it is gone: only the user can end that.
        if lifecycle.state() == Failed {
            lifecycle.apply(Input::Restart, now);
            settle(&mut lifecycle, &mut now);
        }
        prop_assert_eq!(lifecycle.attached().copied(), attached);
        prop_assert_eq!(lifecycle.state(), if attached.is_some() { Streaming } else { Absent });
    }
}
