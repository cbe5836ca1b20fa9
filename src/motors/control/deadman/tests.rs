use super::*;

const MS: u64 = 1_000_000;
const CYCLE: Duration = Duration::from_millis(5);

fn at(ms: u64) -> Stamp {
    Stamp(ms * MS)
}

#[test]
fn when_actions_stop_the_joint_holds_and_is_then_disabled() {
    let period = Duration::from_millis(100);
    for (configured, hold_ms) in [(None, 200), (Some(Duration::from_millis(50)), 50)] {
        let mut deadman = Deadman::new(configured, Some(Duration::from_secs(1)), CYCLE);
        deadman.arm(at(0));
        deadman.feed(at(500));
        // One that is older than what is known changes nothing.
        deadman.feed(at(400));
        for (ms, verdict) in [
            (500, Verdict::Follow),
            (500 + hold_ms - 1, Verdict::Follow),
            (500 + hold_ms, Verdict::Hold),
            (500 + hold_ms + 999, Verdict::Hold),
            (500 + hold_ms + 1000, Verdict::Disable),
        ] {
            assert_eq!(deadman.verdict(at(ms), period), verdict, "{configured:?} {ms}");
        }
        deadman.feed(at(9000));
        assert_eq!(deadman.verdict(at(9000), period), Verdict::Follow);
    }
}

#[test]
fn an_armed_motor_without_an_action_holds_and_is_then_disabled() {
    let mut deadman = Deadman::new(None, Some(Duration::from_secs(1)), CYCLE);
    deadman.feed(at(9));
    deadman.arm(at(10));
    for (ms, verdict) in [(10, Verdict::Hold), (1009, Verdict::Hold), (1010, Verdict::Disable)] {
        assert_eq!(deadman.verdict(at(ms), Duration::from_millis(100)), verdict);
    }
}

#[test]
fn actions_faster_than_commands_still_have_time_to_arrive() {
    let mut deadman = Deadman::new(None, Some(Duration::from_secs(1)), CYCLE);
    let period = Duration::from_millis(1);
    assert_eq!(deadman.patience(period), Duration::from_millis(30), "two cycles, and 20 ms on its way");
    deadman.arm(at(0));
    deadman.feed(at(100));
    for (ms, verdict) in [(129, Verdict::Follow), (130, Verdict::Hold)] {
        assert_eq!(deadman.verdict(at(ms), period), verdict);
    }
    // What is configured is as it is.
    let deadman = Deadman::new(Some(Duration::from_millis(12)), Some(Duration::from_secs(1)), CYCLE);
    assert_eq!(deadman.patience(period), Duration::from_millis(12));
}

#[test]
fn an_arm_without_a_hold_limit_is_held_forever() {
    let mut deadman = Deadman::new(None, None, CYCLE);
    deadman.arm(at(10));
    deadman.feed(at(100));
    for ms in [300, 2_000, 100_000_000] {
        assert_eq!(deadman.verdict(at(ms), Duration::from_millis(100)), Verdict::Hold);
    }
}
