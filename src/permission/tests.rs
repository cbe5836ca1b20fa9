//! Orders in every sequence, with and without an actuator, and of two threads at once.

use proptest::prelude::*;

use super::*;
use Order::{Arm, Disarm};

const fn at(seconds: u64) -> Stamp {
    Stamp(seconds * 1_000_000_000)
}

#[test]
fn a_disarm_without_an_actuator_is_remembered_until_a_newer_arm() {
    let permission = Arc::new(Permission::new(true));
    assert!(!permission.disarm(at(1)));
    let attended = permission.attend();
    assert!(!attended.is_to_be_armed());
    assert_eq!(attended.take().count(), 0);
    // Given before the disarm arrived.
    assert_eq!(permission.arm(at(1), at(1)), Err(Void::Overtaken));
    assert_eq!(attended.take().count(), 0);
    assert_eq!(permission.arm(Stamp(at(1).0 + 1), at(2)), Ok(()));
    assert_eq!(attended.take().collect::<Vec<_>>(), [Arm]);
}

#[test]
fn an_arm_that_is_old_early_or_for_nothing_does_nothing() {
    let permission = Arc::new(Permission::new(false));
    assert_eq!(permission.arm(at(1), at(1)), Err(Void::NoActuator));
    let attended = permission.attend();
    assert!(!attended.is_to_be_armed());
    assert_eq!(permission.arm(at(1), at(3)), Err(Void::Old(Duration::from_secs(2))));
    assert_eq!(permission.arm(at(4), at(3)), Err(Void::Early));
    assert_eq!(attended.take().count(), 0);
    assert_eq!(permission.arm(at(2), at(3)), Ok(()));
    drop(attended);
    // Meant for the one that was unplugged.
    assert_eq!(permission.attend().take().count(), 0);
}

#[test]
fn an_arm_at_the_first_plug_is_given_once_and_not_after_an_order() {
    let permission = Arc::new(Permission::new(true));
    let attended = permission.attend();
    assert!(attended.is_to_be_armed() && !attended.is_to_be_armed());
    attended.was_not_armed();
    assert!(permission.attend().is_to_be_armed());
    attended.was_not_armed();
    permission.disarm(at(1));
    attended.was_not_armed();
    assert!(!permission.attend().is_to_be_armed());
}

proptest! {
    /// Whatever is given when, and however long it takes to arrive: what is left is disarmed, or an arm that was given
    /// after the last disarm had arrived.
    #[test]
    fn of_orders_that_cross_the_safer_counts(
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
                attended.take().for_each(|order| is_armed = order == Arm);
                prop_assert_eq!(is_armed, expected);
            }
        }
        attended.take().for_each(|order| is_armed = order == Arm);
        prop_assert_eq!(is_armed, expected);
    }
}

#[test]
fn of_two_threads_at_once_the_disarm_counts() {
    for _ in 0..2_000 {
        let permission = Arc::new(Permission::new(false));
        let attended = permission.attend();
        let given = Stamp::now();
        std::thread::scope(|scope| {
            scope.spawn(|| permission.arm(given, Stamp::now()));
            scope.spawn(|| permission.disarm(Stamp::now()));
        });
        assert_eq!(attended.take().last(), Some(Disarm));
    }
}
