use proptest::prelude::*;

use super::*;

const LENGTH: Duration = Duration::from_nanos(3);

#[derive(Debug, Clone, Copy)]
enum Step {
    /// Something was received at this time.
    Received(u64),
    /// The lease is checked.
    Look(u64),
    /// Goodbye, or the link is down.
    End(u64),
}
use Step::{End, Look, Received};

fn play(lease: &mut Lease, step: Step) -> Option<Change> {
    match step {
        Received(at) => lease.received(Stamp(at)),
        Look(at) => lease.check(Stamp(at)),
        End(at) => lease.end(Stamp(at)),
    }
}

#[test]
fn a_lease_is_renewed_expires_and_restarts() {
    let table: &[(&str, &[Step], &[&str])] = &[
        ("never there", &[Look(5), End(6), Look(100)], &[]),
        ("there, once", &[Received(1), Received(2), Received(2)], &["came"]),
        ("held while answers arrive", &[Received(1), Look(3), Received(3), Look(5)], &["came"]),
        ("over at its end, once", &[Received(1), Look(4), Look(9)], &["came", "went"]),
        ("an older answer does not shorten it", &[Received(5), Received(2), Look(7)], &["came"]),
        ("a goodbye ends it at once", &[Received(1), End(2), Look(9)], &["came", "went"]),
        (
            "an answer from before the goodbye is ignored",
            &[Received(1), End(4), Received(3), Received(5)],
            &["came", "went", "came"],
        ),
        ("and again", &[Received(1), Look(9), Received(10), Look(13)], &["came", "went", "came", "went"]),
    ];
    for (name, steps, expected) in table {
        let mut lease = Lease::new(LENGTH);
        let reported = steps.iter().filter_map(|step| play(&mut lease, *step));
        let reported: Vec<_> = reported.map(|change| if change == Change::Came { "came" } else { "went" }).collect();
        assert_eq!(reported, *expected, "{name}");
    }
}

proptest! {
    #[test]
    fn arrivals_and_departures_take_turns(steps in prop::collection::vec((0_u64..4, 0_u8..3), 0..200)) {
        let mut lease = Lease::new(LENGTH);
        let (mut now, mut received, mut there) = (1, 0, false);
        for (later, kind) in steps {
            now += later;
            let change = play(&mut lease, [Received(now), Look(now), End(now)][usize::from(kind)]);
            if kind == 0 && (there || change.is_some()) {
                received = now;
            }
            match change {
                Some(Change::Came) => { prop_assert!(!there); there = true; }
                Some(Change::Went) => {
                    prop_assert!(there);
                    prop_assert!(kind == 2 || now >= received + 3, "let go within the lease");
                    there = false;
                }
                None => prop_assert!(kind != 1 || !there || now < received + 3, "held beyond the lease"),
            }
            prop_assert_eq!(lease.is_there(), there);
            prop_assert_eq!(lease.ends().is_some(), there);
        }
    }
}
