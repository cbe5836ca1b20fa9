//! Orders in every sequence, with and without an actuator, and of two threads at once.

use proptest::prelude::*;

use super::*;
use crate::action::Trip;
use crate::interlock::StopKind;
use Order::{Arm, Disarm};

const fn at(seconds: u64) -> Stamp {
    Stamp(seconds * 1_000_000_000)
}

#[test]
fn a_disarm_without_an_actuator_is_remembered_until_a_newer_arm() {
    let permission = Arc::new(Permission::new(true));
    assert!(!permission.disarm(at(1)));
    let attended = permission.attend();
    assert!(!is_armed(&attended).unwrap());
    assert_eq!(attended.take_pending().count(), 0);
    // Given before the disarm arrived.
    assert_eq!(permission.arm(at(1), at(1)), Err(ArmRefused::Overtaken));
    assert_eq!(attended.take_pending().count(), 0);
    assert_eq!(permission.arm(Stamp(at(1).0 + 1), at(2)), Ok(()));
    assert_eq!(attended.take_pending().collect::<Vec<_>>(), [Arm]);
}

#[test]
fn an_arm_that_is_too_old_or_early_or_without_an_actuator_does_nothing() {
    let permission = Arc::new(Permission::new(false));
    assert_eq!(permission.arm(at(1), at(1)), Err(ArmRefused::NoActuator));
    let attended = permission.attend();
    assert!(!is_armed(&attended).unwrap());
    assert_eq!(permission.arm(at(1), at(3)), Err(ArmRefused::Old(Duration::from_secs(2))));
    assert_eq!(permission.arm(at(4), at(3)), Err(ArmRefused::Early));
    assert_eq!(attended.take_pending().count(), 0);
    assert_eq!(permission.arm(at(2), at(3)), Ok(()));
    drop(attended);
    // Intended for the one that was unplugged.
    assert_eq!(permission.attend().take_pending().count(), 0);
}

/// Whether it is armed as at its plug.
fn is_armed(attended: &Attended) -> Result<bool, Blocked> {
    let mut given = Vec::new();
    let give = |order| {
        given.push(order);
        Ok::<_, ()>(())
    };
    let blocked = attended.arm_at_first_plug(give).unwrap();
    blocked.map_or(Ok(given == [Arm]), Err)
}

#[test]
fn an_arm_at_the_first_plug_is_given_once_and_not_after_an_order() {
    let permission = Arc::new(Permission::new(true));
    let attended = permission.attend();
    assert_eq!(attended.arm_at_first_plug(|_| Err("gone")), Err("gone"));
    assert!(is_armed(&permission.attend()).unwrap() && !is_armed(&attended).unwrap());

    let permission = Arc::new(Permission::new(true));
    let fails = |_| {
        permission.disarm(at(1));
        Err("gone")
    };
    assert_eq!(permission.attend().arm_at_first_plug(fails), Err("gone"));
    assert!(!is_armed(&permission.attend()).unwrap());
}

#[test]
fn a_stop_during_the_arm_at_the_first_plug_is_given_after_it() {
    let disarm = |permission: &Permission| permission.disarm(at(1));
    let lose = |permission: &Permission| permission.report(0, InputState::Lost, at(1));
    let trip = Order::Emergency(Trip { stop: 0, is_lost: true });
    for (stop, expected) in [(disarm as fn(&Permission) -> bool, Disarm), (lose, trip)] {
        let permission = with_stops(true);
        all_run(&permission);
        let attended = permission.attend();
        let mut given = Vec::new();
        let give = |order| {
            if order == Arm {
                stop(&permission);
                // The thread that carries orders out takes the stop before the arm reaches it.
                attended.take_pending().for_each(drop);
            }
            given.push(order);
            Ok::<_, ()>(())
        };
        let _ = attended.arm_at_first_plug(give);
        assert_eq!(given, [Arm, expected]);
    }
}

proptest! {
    /// Whatever is given when, and however long it takes to arrive: the result is a disarm, or an arm that was given
    /// after the last disarm had arrived.
    #[test]
    fn the_safer_of_crossing_orders_counts(
        orders in prop::collection::vec((any::<bool>(), 0..2_000_u64, 0..1_500_u64), 1..12),
        looks in prop::collection::vec(any::<bool>(), 12),
    ) {
        let milli = |ms: u64| Stamp((ms + 1) * 1_000_000);
        let permission = Arc::new(Permission::new(false));
        let attended = permission.attend();
        let mut orders = orders;
        orders.sort_by_key(|(_, given, way)| given + way);
        let (mut is_armed, mut expected, mut last_disarm) = (false, false, None);
        for ((is_arm, given, way), looks) in orders.into_iter().zip(looks) {
            let (given, arrived) = (milli(given), milli(given + way));
            if is_arm {
                let counts = way <= 1000 && last_disarm.is_none_or(|disarm| given > disarm);
                prop_assert_eq!(permission.arm(given, arrived).is_ok(), counts);
                expected |= counts;
            } else {
                permission.disarm(arrived);
                last_disarm = Some(arrived);
                expected = false;
            }
            if looks {
                attended.take_pending().for_each(|order| is_armed = order == Arm);
                prop_assert_eq!(is_armed, expected);
            }
        }
        attended.take_pending().for_each(|order| is_armed = order == Arm);
        prop_assert_eq!(is_armed, expected);
    }
}

#[test]
fn a_disarm_wins_against_a_concurrent_arm() {
    for _ in 0..20_000 {
        let permission = Arc::new(Permission::new(false));
        let attended = permission.attend();
        let given = Stamp::now();
        concurrently(|| permission.arm(given, Stamp::now()), || permission.disarm(Stamp::now()));
        assert_eq!(attended.take_pending().last(), Some(Disarm));
    }
}

const STOPS: [StopKind; 3] = [StopKind::Emergency, StopKind::Enabling, StopKind::Emergency];

fn with_stops(arm: bool) -> Arc<Permission> {
    let stops = ["pendant", "pedal", "door"].into_iter().zip(STOPS);
    Arc::new(Permission::new(arm).with_interlocks(Interlocks::new(stops)))
}

fn all_run(permission: &Permission) {
    for index in 0..STOPS.len() {
        permission.report(index, InputState::Runs, at(1));
    }
}

#[test]
fn an_arm_is_refused_with_the_reason_until_every_input_runs() {
    let permission = with_stops(false);
    let attended = permission.attend();
    let why = |permission: &Permission| permission.arm(at(2), at(2)).map_err(|void| void.to_string());
    let lost = "emergency stop pendant is lost: restore it, the log names the cause, then arm again";
    assert_eq!(why(&permission), Err(lost.to_owned()), "not reported yet");
    all_run(&permission);
    assert_eq!(why(&permission), Ok(()));
    permission.report(1, InputState::Stopped, at(3));
    permission.report(2, InputState::Stopped, at(3));
    let refused = permission.arm(at(4), at(4)).unwrap_err().to_string();
    assert_eq!(refused, "enabling switch pedal is released: hold it, then arm again");
    permission.report(1, InputState::Runs, at(5));
    let refused = permission.arm(at(6), at(6)).unwrap_err().to_string();
    assert_eq!(refused, "emergency stop door is pressed: release it, then arm again");
    let door = Order::Emergency(Trip { stop: 2, is_lost: false });
    assert_eq!(attended.take_pending().collect::<Vec<_>>(), [door, Disarm]);
}

#[test]
fn an_arm_given_before_a_trip_is_void_even_if_the_input_runs_again() {
    let permission = with_stops(false);
    let attended = permission.attend();
    all_run(&permission);
    permission.report(0, InputState::Lost, at(3));
    permission.report(0, InputState::Runs, at(4));
    assert_eq!(permission.arm(at(3), at(4)), Err(ArmRefused::Overtaken));
    assert_eq!(attended.take_pending().collect::<Vec<_>>(), [Order::Emergency(Trip { stop: 0, is_lost: true })]);
    assert_eq!(permission.arm(at(4), at(4)), Ok(()));
}

#[test]
fn an_arm_at_the_first_plug_is_refused_too_and_does_not_wait_for_an_input() {
    for (reports, expected) in [
        (&[][..], None),
        (&[InputState::Runs], Some(true)),
        (&[InputState::Stopped, InputState::Runs], Some(false)),
        (&[InputState::Runs, InputState::Lost, InputState::Runs], Some(false)),
    ] {
        let permission = with_stops(true);
        for state in reports {
            for index in 0..STOPS.len() {
                permission.report(index, *state, at(1));
            }
        }
        let attended = permission.attend();
        assert_eq!(is_armed(&attended).ok(), expected, "{reports:?}");
        all_run(&permission);
        assert_eq!((is_armed(&attended), attended.take_pending().count()), (Ok(false), 0), "once");
    }
}

proptest! {
    /// Whatever inputs and operators do: an actuator that carries out its orders is armed only while every input has
    /// run without interruption since the arm, and is stopped by the same call that reports anything else.
    #[test]
    fn nothing_moves_unless_every_input_runs(
        steps in prop::collection::vec((0..5_usize, 0..3_u8, 0..3_u64), 1..60),
        looks in prop::collection::vec(any::<bool>(), 60),
    ) {
        let permission = with_stops(true);
        let attended = permission.attend();
        let (mut is_armed, mut is_given, mut now) = (is_armed(&attended).unwrap_or(false), false, 1);
        let mut states = [InputState::Lost; 3];
        for ((what, state, back), looks) in steps.into_iter().zip(looks) {
            now += 1;
            let state = [InputState::Runs, InputState::Stopped, InputState::Lost][usize::from(state)];
            if let Some(input) = states.get_mut(what) {
                *input = state;
                let is_news = permission.report(what, state, Stamp(now));
                let orders: Vec<Order> = attended.take_pending().collect();
                is_armed = orders.iter().fold(is_armed, |_, order| *order == Arm);
                if state == InputState::Runs {
                    prop_assert!(!orders.contains(&Arm) || is_given, "an input alone arms nothing");
                } else {
                    prop_assert!(!is_armed);
                    let emergency = orders.iter().any(|order| matches!(order, Order::Emergency(_)));
                    prop_assert!(!is_news || emergency || STOPS[what] == StopKind::Enabling);
                    prop_assert!(!is_news || !orders.is_empty());
                }
                is_given = false;
            } else if what == 3 {
                let armed = permission.arm(Stamp(now - back.min(now)), Stamp(now));
                let runs = states.iter().all(|state| *state == InputState::Runs);
                prop_assert!(runs || armed.is_err());
                is_given |= armed.is_ok();
                if !runs && back == 0 {
                    prop_assert!(matches!(armed, Err(ArmRefused::Blocked(_))));
                }
            } else {
                permission.disarm(Stamp(now));
            }
            if looks {
                is_armed = attended.take_pending().fold(is_armed, |_, order| order == Arm);
                is_given = false;
            }
            prop_assert!(!is_armed || states.iter().all(|state| *state == InputState::Runs));
        }
    }
}

/// What overtakes an arm is seen with its own order, also if its input runs again by then: a disarm in its place would let
/// fall what is to hold.
#[test]
fn a_stop_that_overtakes_an_arm_is_given_as_what_it_is() {
    for (index, kind) in STOPS.into_iter().enumerate() {
        for state in [InputState::Stopped, InputState::Lost] {
            let permission = with_stops(false);
            all_run(&permission);
            assert_eq!(permission.stopped_since(at(2).0), None);
            permission.report(index, state, at(3));
            let (void, order) = permission.stopped_since(at(2).0).unwrap();
            assert!(matches!(void, ArmRefused::Blocked(blocked) if (blocked.index, blocked.state) == (index, state)));
            let stop = u8::try_from(index).unwrap();
            let expected = |is_lost| match kind {
                StopKind::Emergency => Order::Emergency(Trip { stop, is_lost }),
                StopKind::Enabling => Disarm,
            };
            assert_eq!(order, expected(state == InputState::Lost));
            permission.report(index, InputState::Runs, at(4));
            assert_eq!(permission.stopped_since(at(2).0), Some((ArmRefused::Overtaken, expected(false))));
            assert_eq!(permission.stopped_since(at(3).0), None);
            // An operator's, after it.
            permission.disarm(at(5));
            assert_eq!(permission.stopped_since(at(4).0), Some((ArmRefused::Overtaken, Disarm)));
        }
    }
}

#[test]
fn a_trip_wins_against_a_concurrent_arm() {
    for _ in 0..20_000 {
        let permission = with_stops(false);
        let attended = permission.attend();
        all_run(&permission);
        let given = Stamp::now();
        concurrently(
            || permission.arm(given, Stamp::now()),
            || permission.report(0, InputState::Stopped, Stamp::now()),
        );
        let orders: Vec<Order> = attended.take_pending().collect();
        assert_eq!(orders, [Order::Emergency(Trip { stop: 0, is_lost: false })]);
    }
}

/// Both at once, on two processors if there are: neither begins before the other could.
fn concurrently<A, B>(one: impl FnOnce() -> A + Send, other: impl FnOnce() -> B + Send) {
    let ready = AtomicUsize::new(0);
    let meet = || {
        ready.fetch_add(1, Ordering::SeqCst);
        while ready.load(Ordering::SeqCst) < 2 {
            std::thread::yield_now();
        }
    };
    std::thread::scope(|scope| {
        scope.spawn(|| {
            meet();
            one();
        });
        meet();
        other();
    });
}
