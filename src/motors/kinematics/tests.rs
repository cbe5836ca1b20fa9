//! Poses against another computation of them, and targets against poses.

use proptest::prelude::*;
use rapid_core::action::NoAction::{Length, OutOfReach};
use rapid_core::rotation;
use rapid_registry::{DamiaoSpec, EffectorSpec, MAX_MOTORS, MOTOR_CHANNELS, TipRotation};

use super::arm::{NEAR_M, NEAR_RAD};
use super::*;
use crate::arms::{COMMANDED, SIX, Y, Z, apart, arm_of, declared, distance, sample};

const URDF: &str = include_str!("../../../tests/arm/arm.urdf");
const JOINTS: [&str; 5] = ["waist", "lift", "elbow", "pitch", "roll"];

/// The motors of the arm of the tests; `more` are further keys of its table.
fn motors(more: &str) -> DamiaoSpec {
    declared(&JOINTS, more)
}

fn arm(more: &str) -> Arm {
    let motors = motors(more);
    Arm::from_urdf(motors.effector.as_deref().expect("an effector"), &motors.motors, URDF).expect("it fits")
}

const SEVEN: [(&str, &str); 7] =
    [("0 0 0.2", Z), ("0 0 0.1", Y), ("0 0 0.2", Z), ("0 0 0.2", Y), ("0 0 0.2", Z), ("0 0 0.2", Y), ("0 0 0.1", Z)];
fn state(arm: &Arm, positions: &[f64]) -> [f64; 8] {
    let mut out = [0.0; 8];
    assert_eq!(arm.numbers(), out.len());
    arm.state(&sample(positions), &mut out);
    out
}

/// Numbers within these ranges, which successive steps fill evenly; the same in every run.
fn spread(step: u32, ranges: &[[f64; 2]]) -> Vec<f64> {
    // No two roots of primes have a common measure.
    let primes = [2.0, 3.0, 5.0, 7.0, 11.0, 13.0, 17.0_f64];
    let share = |prime: f64| (f64::from(step) * prime.sqrt()).fract();
    ranges.iter().zip(primes).map(|([low, high], prime)| low + (high - low) * share(prime)).collect()
}

const DOWN: &str = "rotation = [0, 1, 0, 0]\nyaw = \"free\"";

#[test]
fn a_straight_arm_is_as_long_as_its_links() {
    let found = state(&arm(DOWN), &[0.0, 0.0, 0.0, 0.0, 0.0, 0.5]);
    let wanted = [-0.2, 0.0, 0.3 + 0.75 + 0.65 + 0.08 + 0.12, 0.5, 0.0, 0.0, 0.0, 1.0];
    assert!(distance(&found, &wanted) < 1e-12, "{found:?}");
    // A quarter turn of the lift about y lays it along x.
    let quarter = std::f64::consts::FRAC_PI_2;
    let found = state(&arm(DOWN), &[0.0, quarter, 0.0, 0.0, 0.0, 0.0]);
    assert!(distance(&found[..3], &[1.4, 0.0, 0.3]) < 1e-12, "{found:?}");
    // And a quarter turn of the waist along y.
    let found = state(&arm(DOWN), &[quarter, quarter, 0.0, 0.0, 0.0, 0.0]);
    assert!(distance(&found[..3], &[-0.2, 1.6, 0.3]) < 1e-12, "{found:?}");
}

#[test]
fn a_frame_other_than_the_root_is_where_poses_are_given() {
    let found = state(&arm("frame = \"base\""), &[0.0; 6]);
    assert!(found[0].abs() < 1e-12, "{found:?}");
}

proptest! {
    #[test]
    fn poses_are_those_of_the_crate(positions in proptest::array::uniform5(-2.5..2.5_f64)) {
        let arm = arm("");
        let robot = urdf_rs::read_from_string(URDF).unwrap();
        let chain = k::Chain::<f64>::from(&robot);
        let serial = k::SerialChain::from_end(chain.find("tool").unwrap());
        serial.set_joint_positions(&positions).unwrap();
        let wanted = serial.end_transform();
        let found = state(&arm, &[&positions[..], &[0.0]].concat());
        prop_assert!(distance(&found[..3], wanted.translation.vector.as_slice()) < 1e-9);
        let same = found[4..].iter().zip(wanted.rotation.coords.as_slice()).map(|(one, other)| one * other).sum::<f64>();
        prop_assert!((same.abs() - 1.0).abs() < 1e-9, "{found:?} {wanted:?}");
    }

    /// What the motors are ordered to is where the tip was asked to be, for every pose that the arm has near by.
    #[test]
    fn targets_lead_to_the_pose(
        waist in -2.5..2.5_f64, lift in 0.3..1.2_f64, elbow in 0.5..1.9_f64, roll in -2.0..2.0_f64, by in proptest::array::uniform5(-0.1..0.1_f64), opening in 0.0..1.0_f64,
    ) {
        let arm = arm(DOWN);
        // The tool points down.
        let pitch = std::f64::consts::PI - lift - elbow;
        prop_assume!(pitch.abs() < 2.5);
        let there = [waist, lift, elbow, pitch, roll, 0.0];
        let wanted = state(&arm, &there);
        // Below is outside the box of the registry.
        prop_assume!(wanted[2] > 0.0);
        let mut from = [0.0; MAX_MOTORS];
        for (place, (position, by)) in from.iter_mut().zip(there.iter().zip(by)) {
            *place = position + by;
        }
        let action = [wanted[0], wanted[1], wanted[2], opening];
        let targets = arm.solver().targets(&action, &from).expect("it is there");
        let found = state(&arm, &targets[..6]);
        prop_assert!(distance(&found[..3], &wanted[..3]) < 2e-4, "{found:?} {wanted:?}");
        prop_assert!((found[3] - opening).abs() < 1e-9);
        // The z axis of the tool, which points down.
        let [x, y, ..] = [found[4], found[5]];
        prop_assert!(1.0 - 2.0 * (x * x + y * y) < -0.999, "{found:?}");
        // And near where they were.
        prop_assert!(distance(&targets[..5], &from[..5]) < 1.0, "{targets:?} {from:?}");
    }

    /// No action and no state of the motors gives a target that is not finite or beyond the limits.
    #[test]
    fn targets_are_within_the_limits_or_none(
        action in proptest::collection::vec(proptest::num::f64::ANY, 0..9),
        from in proptest::array::uniform6(proptest::num::f64::ANY),
        kind in 0..3_usize,
    ) {
        let arm = arm(["", DOWN, "rotation = \"commanded\"\nyaw = \"free\""][kind]);
        let mut places = [0.0; MAX_MOTORS];
        places[..6].copy_from_slice(&from);
        if let Ok(targets) = arm.solver().targets(&action, &places) {
            prop_assert!(targets[..5].iter().all(|target| (-3.0..=3.0).contains(target)), "{targets:?}");
            prop_assert!((0.0..=1.0).contains(&targets[5]), "{targets:?}");
        }
    }
}

/// Poses that the tip has with the joints at known positions, ordered with the joints elsewhere.
#[test]
fn targets_lead_to_the_commanded_position_and_rotation() {
    const TURN: [f64; 2] = [-2.4, 2.4];
    const LIFT: [f64; 2] = [-0.8, 0.8];
    // Neither stretched nor with two axes in line: there a direction has no way.
    const ELBOW: [f64; 2] = [0.8, 1.8];
    const WRIST: [f64; 2] = [0.6, 1.6];
    let free = "rotation = \"commanded\"\nyaw = \"free\"";
    let cases: [(Arm, bool, &[[f64; 2]]); 3] = [
        (arm(free), true, &[[-2.5, 2.5], [0.2, 0.8], [0.6, 1.2], [0.2, 1.0], [-2.0, 2.0]]),
        (arm_of(&SIX, COMMANDED), false, &[TURN, LIFT, ELBOW, TURN, WRIST, TURN]),
        (arm_of(&SEVEN, COMMANDED), false, &[TURN, LIFT, TURN, ELBOW, TURN, WRIST, TURN]),
    ];
    for (arm, free_yaw, ranges) in &cases {
        let mut solver = arm.solver();
        for step in 1..=100 {
            let there = spread(step, ranges);
            let wanted = state(arm, &[&there[..], &[0.0]].concat());
            let mut from = [0.0; MAX_MOTORS];
            let by = spread(3 * step + 1, &[[-0.15, 0.15]; 7]);
            for (place, (position, by)) in from.iter_mut().zip(there.iter().zip(by)) {
                *place = position + by;
            }
            let mut turned = [4, 5, 6, 7].map(|at| wanted[at]);
            if *free_yaw {
                // Whatever the angle about z is.
                let half = f64::from(step);
                turned = rotation::product([0.0, 0.0, half.sin(), half.cos()], turned);
            }
            // A quaternion and its negative are one rotation, and none needs to have exactly the length 1.
            let length = if step.is_multiple_of(2) { 1.0 } else { -1.5 };
            let action = [&wanted[..3], &turned.map(|part| length * part), &[0.25]].concat();
            let targets = solver.targets(&action, &from);
            let targets = targets.unwrap_or_else(|error| panic!("pose {step} of {} joints: {error}", ranges.len()));
            let found = state(arm, &targets[..=ranges.len()]);
            let [far, off] = apart(&found, &wanted, *free_yaw);
            assert!(
                far < NEAR_M && off < NEAR_RAD,
                "pose {step} of {} joints: {far} m, {off} rad: {found:?} {wanted:?}",
                ranges.len()
            );
            assert!((found[3] - 0.25).abs() < 1e-9, "the opening of pose {step}: {found:?}");
        }
    }
}

/// Motors at these positions.
fn at(positions: [f64; 6]) -> [f64; MAX_MOTORS] {
    let mut from = [0.0; MAX_MOTORS];
    from[..6].copy_from_slice(&positions);
    from
}

const FOLDED: [f64; 6] = [0.0, 0.8, 1.2, std::f64::consts::PI - 2.0, 0.0, 0.0];

#[test]
fn what_is_out_of_reach_or_singular_gives_no_target() {
    let refused =
        |arm: &Arm, action: &[f64], from: [f64; 6]| arm.solver().targets(action, &at(from)).expect_err("none");
    let down = arm(DOWN);
    assert_eq!(refused(&down, &[1.9, 1.9, 1.9, 0.0], FOLDED), OutOfReach);
    assert_eq!(refused(&down, &[f64::NAN, 0.4, 1.0, 0.0], FOLDED), OutOfReach);
    // Straight up it has no way down: every joint would move the tip sideways.
    assert_eq!(refused(&arm(""), &[-0.2, 0.0, 1.5, 0.0], [0.0; 6]), OutOfReach);
    // Neither a pose with a quaternion nor positions of the motors are actions of this arm.
    for action in [&[0.4, 0.4, 1.0][..], &[0.4, 0.4, 1.0, 0.0, 1.0, 0.0, 0.0, 0.5], &[0.1; 6], &[]] {
        assert_eq!(refused(&down, action, FOLDED), Length, "{action:?}");
    }
    let commanded = arm("rotation = \"commanded\"\nyaw = \"free\"");
    for rotation in [[0.0; 4], [1e200, 0.0, 0.0, 0.0], [f64::INFINITY; 4]] {
        let action = [&[0.4, 0.0, 0.8][..], &rotation, &[0.5]].concat();
        assert_eq!(refused(&commanded, &action, FOLDED), OutOfReach, "{rotation:?}");
    }
}

/// With the tool downwards the last joint only turns it about z, which is free: it stays as it is, whatever the waist is.
#[test]
fn an_arm_that_is_asked_for_one_pose_again_and_again_does_not_move() {
    let (arm, opening) = (arm(DOWN), 0.5);
    for waist in [-2.9, -1.5, 0.0, 0.4, 1.5, 2.9] {
        for roll in [-2.0, 0.0, 1.0] {
            let mut there = FOLDED;
            (there[0], there[4]) = (waist, roll);
            let [x, y, z, ..] = state(&arm, &there);
            let mut solver = arm.solver();
            let mut motors = at(there);
            for _ in 0..200 {
                motors = solver.targets(&[x, y, z, opening], &motors).expect("it is there");
            }
            for (joint, (now, then)) in motors.iter().zip(there).take(5).enumerate() {
                assert!((now - then).abs() < 0.01, "joint {joint} of {there:?}: {motors:?}");
            }
        }
    }
}

/// A path of small steps is followed in small steps.
#[test]
fn no_joint_jumps_on_a_circle() {
    let arm = arm(DOWN);
    let mut solver = arm.solver();
    let mut motors = at(FOLDED);
    let [x, y, z, ..] = state(&arm, &FOLDED);
    for step in 0..200_u32 {
        let angle = f64::from(step) * std::f64::consts::TAU / 100.0;
        let action = [x - 0.3 + 0.3 * angle.cos(), y + 0.3 * angle.sin(), z, 0.0];
        let next = solver.targets(&action, &motors).expect("within reach");
        let far = next.iter().zip(motors).map(|(next, now)| (next - now).abs()).fold(0.0, f64::max);
        assert!(far < 0.15, "step {step}: {motors:?} {next:?}");
        assert!(distance(&state(&arm, &next[..6])[..3], &action[..3]) < 2e-4);
        motors = next;
    }
}

#[test]
fn a_description_that_does_not_fit_is_refused_by_name() {
    let motors = motors(DOWN);
    let effector = motors.effector.as_deref().expect("an effector");
    let refused =
        |spec: &EffectorSpec, urdf: &str| Arm::from_urdf(spec, &motors.motors, urdf).expect_err(urdf).to_string();
    let with = |tip: &str, frame: Option<&str>| EffectorSpec {
        tip: tip.to_owned(),
        frame: frame.map(str::to_owned),
        ..effector.clone()
    };
    let swapped = |from: &str, to: &str| {
        assert!(URDF.contains(from), "{from}");
        URDF.replacen(from, to, 1)
    };
    for (spec, urdf, words) in [
        (effector.clone(), "<robot".to_owned(), "not a robot description"),
        (effector.clone(), String::new(), "not a robot description"),
        (with("hand", None), URDF.to_owned(), "no link \"hand\""),
        (with("tool", Some("floor")), URDF.to_owned(), "no link \"floor\""),
        (with("base", Some("tool")), URDF.to_owned(), "link \"base\" is not attached to link \"tool\""),
        (with("wrist", None), URDF.to_owned(), "motor \"roll\" is no joint"),
        (with("finger", None), URDF.to_owned(), "joint \"jaw\" moves the tip, and its motor is the gripper"),
        (effector.clone(), swapped("name=\"elbow\" type", "name=\"ellbow\" type"), "joint \"ellbow\" moves the tip"),
        (effector.clone(), swapped("<axis xyz=\"0 1 0\"/>", "<axis xyz=\"0 0 0\"/>"), "joint \"lift\" has an axis"),
        (effector.clone(), swapped("lower=\"-2.5\"", "lower=\"NaN\""), "joint \"lift\" has an axis"),
        (effector.clone(), swapped("lower=\"-2.5\"", "lower=\"9\""), "joint \"lift\" has no range"),
        (effector.clone(), swapped("lower=\"-2.5\" upper=\"2.5\" ", ""), "joint \"lift\" has no range"),
        (effector.clone(), swapped("xyz=\"0 0 0.75\"", "xyz=\"0 0 1e308\""), "joint \"elbow\" has an axis"),
        (
            effector.clone(),
            swapped("\"elbow\" type=\"revolute\"", "\"lift\" type=\"revolute\""),
            "two joints have the name \"lift\"",
        ),
        (
            effector.clone(),
            swapped("\"lift\" type=\"revolute\"", "\"lift\" type=\"prismatic\""),
            "joint \"lift\" is neither",
        ),
        (effector.clone(), "<a>".repeat(500_000), "elements are nested"),
        (
            effector.clone(),
            swapped("lower=\"-2.5\" upper=\"2.5\"", "lower=\"4\" upper=\"5\""),
            "the limits of joint \"lift\"",
        ),
        (
            effector.clone(),
            swapped("\"lift\" type=\"revolute\"", "\"lift\" type=\"floating\""),
            "joint \"lift\" is neither",
        ),
        (
            effector.clone(),
            swapped("<parent link=\"table\"/>", "<parent link=\"tool\"/>"),
            "is not attached to link \"the root\"",
        ),
    ] {
        let found = refused(&spec, &urdf);
        assert!(found.starts_with("arm.urdf: ") && found.contains(words), "{words}: {found}");
    }
    let mimic = swapped("<axis xyz=\"0 1 0\"/>", "<axis xyz=\"0 1 0\"/><mimic joint=\"waist\"/>");
    assert!(refused(effector, &mimic).contains("joint \"lift\" mimics another"));
    let absent = Arm::open(effector, &motors.motors).expect_err("there is no such file here").to_string();
    assert!(absent.starts_with("arm.urdf: "), "{absent}");
    assert_eq!(effector.rotation, TipRotation::Held([0.0, 1.0, 0.0, 0.0]));
    assert_eq!(MOTOR_CHANNELS * 6 + effector.numbers(), 44);
}

/// Beginnings of an element, after each of which the next is within it.
const OPENED: [&str; 9] = [
    "<a>",
    "<a\n >",
    "<a b='/>'>",
    "<a b=\"x/>\">",
    "<a><!--</a>-->",
    "<a><![CDATA[</a>]]>",
    "<a><?x </a>?>",
    "<!-- <b/> --><a>",
    "<b/><a>",
];

proptest! {
    /// The parser would overflow its stack, which ends the process.
    #[test]
    fn elements_within_elements_are_refused_however_they_are_written(
        parts in proptest::collection::vec(0..OPENED.len(), 1..6), depth in prop_oneof![Just(65_usize), Just(60_000)]
    ) {
        let opened: String = (0..depth).map(|number| OPENED[parts[number % parts.len()]]).collect();
        let urdf = URDF.replace("</robot>", &format!("{opened}{}</robot>", "</a>".repeat(depth)));
        let why = Chain::read(&urdf, None, "tool").unwrap_err().to_string();
        prop_assert!(why.contains("nested more than 64 deep"), "{}", why);
    }

    /// Whatever stands for a number of the description, what it accepts is finite.
    #[test]
    fn numbers_of_a_description_are_finite_or_refused(
        at in 0_usize..200, number in prop_oneof![
            Just("inf"), Just("-inf"), Just("NaN"), Just("1e400"), Just("1e308"), Just("1e3000000"), Just(""), Just("1 2 3 4 5"),
        ]
    ) {
        let numbers: Vec<_> = URDF.match_indices(|c: char| c.is_ascii_digit()).map(|(at, _)| at).collect();
        let at = numbers[at % numbers.len()];
        let urdf = [&URDF[..at], number, &URDF[at + 1..]].concat();
        if let Ok(chain) = Chain::read(&urdf, None, "tool") {
            let (place, turned) = chain.pose([0.1; 7].into_iter());
            prop_assert!(place.iter().chain(&turned).all(|number| number.is_finite()), "{}", urdf);
        }
    }
}

#[test]
fn what_two_readers_of_xml_could_read_differently_is_refused() {
    for strange in [
        "<!DOCTYPE robot [<!ENTITY x \"<a>\">]>",
        "<a b='<c>'/>",
        "<a '>' />",
        "</a '>",
        "<!--><a>-->",
        "<!---><a>-->",
        "<?><a>?>",
        "<!-- endless",
        "<![CDATA[ endless",
        "<a b='",
    ] {
        let urdf = URDF.replace("</robot>", &format!("{strange}</robot>"));
        let why = Chain::read(&urdf, None, "tool").unwrap_err().to_string();
        assert!(why.contains("not well-formed"), "{strange}: {why}");
    }
}

#[test]
fn a_description_of_very_many_joints_is_read_once() {
    use std::fmt::Write as _;
    let mut urdf = "<robot name='r'><link name='l0'/>".to_owned();
    for number in 1..60_000 {
        let before = number - 1;
        let _ = write!(
            urdf,
            "<link name='l{number}'/><joint name='j{number}' type='fixed'><parent link='l{before}'/><child link='l{number}'/></joint>"
        );
    }
    urdf.push_str("</robot>");
    let chain = Chain::read(&urdf, None, "l59999").unwrap();
    assert!(distance(&chain.pose(std::iter::empty()).0, &[0.0; 3]) < 1e-12);
}
