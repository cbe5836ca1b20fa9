//! Faults of motors, each as a file of `tests/faults`: played over the state machine of motors and simulated motors with
//! bodies, in virtual time. `campaign` plays random sequences of them.
//!
//! `make one TEST=every_fault_of_the_table` shows what each came to.

#![expect(clippy::expect_used, reason = "helpers of tests")]

mod campaign;

use std::fmt::Write as _;
use std::fs;
use std::path::Path;
use std::time::Duration;

use rapid_registry::{DamiaoSpec, MotorMode, Stop};

use crate::support::motor_world::World;
use crate::support::motor_world::motor_spec::{brake, bus, motor};
use serde::Deserialize;

/// A file of `tests/faults`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Scenario {
    /// What happens, for people.
    about: String,
    #[serde(default)]
    rig: Rig,
    /// Lines of `motor_world`, some time after the arm.
    event: Vec<Event>,
    expect: Expect,
}

/// Two motors, the first of which is what it is about.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct Rig {
    /// `mit`, `position` or `velocity`, of each.
    modes: [String; 2],
    /// Nm/rad.
    kp: f64,
    /// Nm s/rad.
    kd: f64,
    /// rad.
    position: [f64; 2],
    /// rad/s.
    velocity: f64,
    /// Nm.
    torque: f64,
    /// rad/s.
    slew: f64,
    /// `limp`, `damp`, `hold` or `brake`.
    own_fault: String,
    other_fault: String,
    hold_for_ms: Option<u64>,
    /// Each joint has a brake.
    brakes: bool,
    /// 0 is never.
    blocked_after_ms: u64,
    timeout_ms: u64,
    /// Lines before the arm.
    before: Vec<String>,
    /// It is armed, and the time of events begins then.
    arm: bool,
    /// Published from then on.
    target: Vec<f64>,
}

impl Default for Rig {
    fn default() -> Self {
        Self {
            modes: ["mit".to_owned(), "mit".to_owned()],
            kp: 30.0,
            kd: 1.0,
            position: [-2.0, 2.0],
            velocity: 5.0,
            torque: 3.0,
            slew: 2.0,
            own_fault: "limp".to_owned(),
            other_fault: "damp".to_owned(),
            hold_for_ms: None,
            brakes: false,
            blocked_after_ms: 2000,
            timeout_ms: 400,
            before: vec!["load 0 1.5".to_owned(), "ends 0 -2.5 2.5".to_owned()],
            arm: true,
            target: vec![0.3, 0.3],
        }
    }
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Event {
    ms: u64,
    #[serde(rename = "do")]
    what: String,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Expect {
    /// When it can be seen first; the first event without.
    from_ms: Option<u64>,
    /// A notice that has these words; without, there is no notice of a problem at all.
    named: Option<String>,
    /// It comes within this time.
    within_ms: Option<u64>,
    /// The fault that stops the motors, in words; none without.
    fault: Option<String>,
    fault_within_ms: Option<u64>,
    /// How the joints are at the end: `limp`, `damp`, `hold`, `follow`.
    joints: [String; 2],
    /// How far from the first event on each joint may be from where it was then, rad.
    moves: [f64; 2],
    /// The end.
    until_ms: u64,
}

impl Rig {
    fn spec(&self) -> DamiaoSpec {
        let stop = |word: &str| match word {
            "limp" => Stop::Limp,
            "damp" => Stop::Damp,
            "hold" => Stop::Hold,
            "brake" => Stop::Brake,
            other => panic!("a joint does not stop `{other}`"),
        };
        let mode = |word: &str| match word {
            "mit" => MotorMode::Mit { kp: self.kp, kd: self.kd },
            "position" => MotorMode::PositionVelocity,
            "velocity" => MotorMode::Velocity,
            other => panic!("a motor has no mode `{other}`"),
        };
        let motors = self.modes.iter().zip(1..).map(|(word, slave)| {
            let mut spec = motor(slave);
            spec.mode = mode(word);
            spec.position = self.position;
            (spec.velocity, spec.torque, spec.slew) = (self.velocity, self.torque, self.slew);
            (spec.stop.own_fault, spec.stop.other_fault) = (stop(&self.own_fault), stop(&self.other_fault));
            spec.brake = self.brakes.then(|| brake(slave));
            spec.stop.hold_for = self.hold_for_ms.map(Duration::from_millis);
            let blocked_after = Duration::from_millis(self.blocked_after_ms);
            spec.watch.blocked_after = Some(blocked_after).filter(|after| !after.is_zero());
            spec
        });
        let spec = bus(motors.collect());
        DamiaoSpec { timeout: Duration::from_millis(self.timeout_ms), ..spec }
    }
}

/// How a scenario ended.
struct ScenarioResult {
    named_ms: Option<u64>,
    problems: usize,
    fault: Option<(String, u64)>,
    joints: [&'static str; 2],
    moved: [f64; 2],
    notices: String,
    wrong: Vec<String>,
}

fn play(scenario: &Scenario) -> ScenarioResult {
    let Rig { before, arm, target, .. } = &scenario.rig;
    let mut world = World::new(scenario.rig.spec());
    world.play("block 0 1");
    for line in before {
        world.play(line);
    }
    world.run(200);
    if *arm {
        world.arm();
        if !target.is_empty() {
            let words: Vec<String> = target.iter().map(ToString::to_string).collect();
            world.play(&format!("target {}", words.join(" ")));
        }
    }
    let begun = world.now;
    let mut first = None;
    let mut from = [0.0; 2];
    let mut moved = [0.0_f64; 2];
    let mut events = scenario.event.iter().peekable();
    while world.now.since(begun) < Duration::from_millis(scenario.expect.until_ms) {
        while let Some(event) = events.next_if(|event| world.now.since(begun) >= Duration::from_millis(event.ms)) {
            if first.is_none() {
                first = Some(world.now);
                from = [0, 1].map(|motor: usize| world.motors[motor].angle());
            }
            world.play(&event.what);
        }
        world.cycle();
        if first.is_some() {
            for motor in 0..2 {
                moved[motor] = moved[motor].max((world.motors[motor].angle() - from[motor]).abs());
            }
        }
    }
    assert!(events.next().is_none(), "an event is after the end");
    let first = first.expect("an event");
    let seen = scenario.expect.from_ms.map_or(first, |ms| begun.after(Duration::from_millis(ms)));
    let ms = |after: Duration| u64::try_from(after.as_millis()).expect("short");
    let mut notices = String::new();
    for (at, _, words) in &world.notices {
        let after = i128::from(at.0) - i128::from(begun.0);
        let _ = writeln!(notices, "  {:6} ms  {words}", after / 1_000_000);
    }
    ScenarioResult {
        named_ms: scenario.expect.named.as_ref().and_then(|words| world.named(words, seen)).map(ms),
        problems: world.notices.iter().filter(|(at, notice, _)| *at >= first && notice.is_problem()).count(),
        fault: world.fault(seen).map(|(words, after)| (words.to_owned(), ms(after))),
        joints: [world.kind(0), world.kind(1)],
        moved,
        notices,
        wrong: world.judge.wrong,
    }
}

/// What is not as it is to be.
fn compare(expect: &Expect, outcome: &ScenarioResult) -> Vec<String> {
    let mut wrong = outcome.wrong.clone();
    match (outcome.named_ms, expect.within_ms) {
        (Some(ms), Some(most)) if ms <= most => {}
        (None, None) if outcome.problems == 0 => {}
        (found, most) => wrong.push(format!("named after {found:?} ms, and {most:?} is expected")),
    }
    match (&expect.fault, &outcome.fault) {
        (None, None) => {}
        (Some(words), Some((is, ms)))
            if is.contains(words.as_str()) && expect.fault_within_ms.is_none_or(|most| *ms <= most) => {}
        (expected, found) => {
            wrong.push(format!("fault {found:?}, and {expected:?} within {:?} is expected", expect.fault_within_ms));
        }
    }
    for motor in 0..2 {
        let [is, expected] = [outcome.joints[motor], expect.joints[motor].as_str()];
        if is != expected {
            wrong.push(format!("joint_{} is `{is}` at the end and not `{expected}`", motor + 1));
        }
        if outcome.moved[motor] > expect.moves[motor] {
            let [moved, may] = [outcome.moved[motor], expect.moves[motor]];
            wrong.push(format!("joint_{} moves {moved:.3} rad, and may {may}", motor + 1));
        }
    }
    wrong
}

/// What a sensible table has: every fault of motors that was ever found.
const LEAST: usize = 30;

#[test]
fn every_fault_of_the_table_is_named_and_stops_joints_as_configured() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/faults");
    let mut files: Vec<_> =
        fs::read_dir(&folder).expect("the folder").map(|entry| entry.expect("one").path()).collect();
    files.retain(|path| path.extension().is_some_and(|extension| extension == "toml"));
    files.sort();
    assert!(files.len() >= LEAST, "{} files", files.len());
    let (mut table, mut wrong) = (String::new(), String::new());
    for path in files {
        let name = path.file_stem().and_then(|stem| stem.to_str()).expect("a name").to_owned();
        let text = fs::read_to_string(&path).expect("readable");
        let scenario: Scenario = toml::from_str(&text).unwrap_or_else(|error| panic!("{name}: {error}"));
        assert!(!scenario.about.is_empty(), "{name}: no subject");
        let outcome = play(&scenario);
        let ScenarioResult { named_ms, fault, joints, moved, .. } = &outcome;
        let named = named_ms.map_or("-".to_owned(), |ms| ms.to_string());
        let fault = fault.as_ref().map_or("-".to_owned(), |(words, ms)| format!("{ms} ms: {words}"));
        let _ = writeln!(
            table,
            "{name:32} named {named:>5} ms  {:6} {:6}  moved {:6.3} {:6.3}  fault {fault}",
            joints[0], joints[1], moved[0], moved[1]
        );
        let differs = compare(&scenario.expect, &outcome);
        if !differs.is_empty() {
            let _ = writeln!(wrong, "{name}:\n  {}\n{}", differs.join("\n  "), outcome.notices);
        }
    }
    show(&table);
    assert!(wrong.is_empty(), "{wrong}");
}

#[expect(clippy::print_stdout, reason = "the table of a test that is run by hand")]
fn show(table: &str) {
    println!("{table}");
}
