//! Faults of motors: how soon motors stop, and how loaded joints move meanwhile.
//!
//! In virtual time: the state machine of `rapid` in cycles of 5 ms with simulated motors with bodies. Nothing here
//! depends on the machine.

#[path = "../../support/motor_world.rs"]
mod motor_world;

use std::cell::Cell;
use std::rc::Rc;
use std::time::Duration;

use rapid_core::time::Stamp;
use rapid_motors::control::can::CanFrame;
use rapid_motors::control::damiao::codec::{self, Feedback, Mit, MotorStatus, Ranges, StateCommand};
use rapid_motors::control::damiao::parameter::Reply;
use rapid_registry::{DamiaoSpec, MotorMode, Stop};

use self::motor_world::motor_spec::{brake, bus, motor};
use self::motor_world::{CYCLE, Input, Program, World};
use crate::figure::Figure;
use crate::{Bench, Failure};

/// Stiffness and damping of the joints, Nm/rad and Nm s/rad.
const GAINS: [f64; 2] = [30.0, 1.0];
/// Their load, Nm.
const LOAD: f64 = 1.5;
/// Time limit of a stop.
const WINDOW: Duration = Duration::from_secs(3);
/// Time over which a joint's motion is measured.
const FIRST: Duration = Duration::from_secs(1);
/// Without an action for this long the bare loop holds, and disables the motors after the second time.
const DEADMAN: [Duration; 2] = [Duration::from_millis(200), Duration::from_secs(1)];
/// A motor that leaves frames unanswered for this long counts as silent in the bare loop.
const SILENT: Duration = Duration::from_millis(50);

/// An event at the first of two joints.
struct Event {
    name: &'static str,
    /// Lines of `motor_world`.
    lines: &'static [&'static str],
    /// The torque limit, Nm, and the load before the event, Nm.
    torque: [f64; 2],
    /// The motors must stop.
    stops: bool,
    /// How the other joint stops.
    other: Stop,
}

const fn event(name: &'static str, lines: &'static [&'static str]) -> Event {
    Event { name, lines, torque: [3.0, LOAD], stops: true, other: Stop::Damp }
}

const EVENTS: [Event; 23] = [
    Event { stops: false, ..event("a damaged frame", &["damage 1 1 6.283"]) },
    event("damaged frames", &["damage 1 20 0.3"]),
    event("its zero is set by another", &["foreign 001 fffffffffffffffe"]),
    event("its zero changes unseen", &["zero 0.1 0.3"]),
    Event { torque: [0.7, 0.5], ..event("a load of 1.5 Nm, limit 0.7", &["load 0.1 1.5"]) },
    event("pushed out of its limits", &["load 0.1 8"]),
    event("blocked", &["block 0.1 1", "target 0.9 0.3"]),
    event("encoder frozen", &["freeze 0.1 1", "target 0.9 0.3"]),
    event("TIMEOUT rewritten", &["foreign 7ff 0100550900000000"]),
    event("TIMEOUT rewritten unseen", &["rewrite 1 9 0"]),
    event("PMAX rewritten", &["foreign 7ff 010055150000c841"]),
    event("mode rewritten unseen", &["rewrite 1 10 3"]),
    event("another master", &["foreign 001 7fff7ff0000007ff"]),
    event("mute", &["mute 0.1 1"]),
    event("over-current", &["fault 0.1 a"]),
    Event { other: Stop::Hold, ..event("over-current, others hold", &["fault 0.1 a"]) },
    Event { other: Stop::Brake, ..event("over-current, others brake", &["fault 0.1 a"]) },
    event("too hot", &["hot 0.1 101"]),
    event("power lost for 0.02 s", &["power 0.1 0", "wait 20", "power 0.1 1"]),
    event("publisher killed", &["silence"]),
    event("disarm", &["disarm"]),
    event("program killed", &["killed"]),
    Event { other: Stop::Brake, ..event("program killed, brakes", &["killed"]) },
];

pub(crate) fn measure(_bench: &Bench) -> Result<Vec<Figure>, Failure> {
    let mut figures = Vec::new();
    for event in &EVENTS {
        let [ours, plain] = [false, true].map(|is_plain| play(event, is_plain));
        let name = |what: &str| format!("safety/{}: {what}", event.name);
        let has_none = if plain.stopped.is_none() && event.stops { ". The baseline does not stop" } else { "" };
        let words = ours.words.as_ref().map_or_else(String::new, |words| format!("\"{words}\". "));
        let note = format!("{words}Then {} and {}{has_none}", ours.joints[0], ours.joints[1]);
        let ms = |outcome: &Outcome| outcome.stopped.map(|after| after.as_secs_f64() * 1e3);
        if event.stops {
            figures.push(Figure::new(name("both stopped"), "ms", ms(&ours)).baseline(ms(&plain)).note(note));
        }
        for (joint, what) in ["this joint, first second", "the other joint"].into_iter().enumerate() {
            figures.push(Figure::new(name(what), "rad", Some(ours.moved[joint])).baseline(Some(plain.moved[joint])));
        }
    }
    if let Some(first) = figures.first_mut() {
        first.note = format!(
            "virtual time, cycles of {} ms: two simulated joints of 0.02 kg m² with a load of {LOAD} Nm each, end stops at 2.5 rad, \
             a torque limit of 3 Nm unless it is named, held at 0.3 rad by actions at 10 Hz; how far they move at the most within \
             a second. Baseline: a plain loop on the same motors, which keeps the command within the torque limit around what the \
             motor reports, and disables all motors when one is silent, off or too hot, and a second after the actions end",
            CYCLE.as_millis()
        );
    }
    Ok(figures)
}

struct Outcome {
    /// Time from the event until both joints are off, damped or held.
    stopped: Option<Duration>,
    /// How far each joint moved from its position.
    moved: [f64; 2],
    joints: [&'static str; 2],
    /// The notice that names the event.
    words: Option<String>,
}

fn spec(event: &Event) -> DamiaoSpec {
    let motors = (1..=2).map(|slave| {
        let mut spec = motor(slave);
        let [kp, kd] = GAINS;
        spec.mode = MotorMode::Mit { kp, kd };
        (spec.torque, spec.velocity, spec.slew) = (event.torque[0], 5.0, 2.0);
        (spec.stop.own_fault, spec.stop.other_fault) = (Stop::Limp, event.other);
        spec.brake = (event.other == Stop::Brake).then(|| brake(slave));
        spec
    });
    bus(motors.collect())
}

fn play(event: &Event, is_plain: bool) -> Outcome {
    let spec = spec(event);
    let mut world = World::new(spec.clone());
    world.play(&format!("load 0 {}", event.torque[1]));
    world.play("ends 0 -2.5 2.5");
    world.arm();
    let holds = Rc::new(Cell::new(false));
    if is_plain {
        world.instead = Some(plain(spec, Rc::clone(&holds)));
    }
    world.play("target 0.3 0.3");
    world.run(1_000);
    let begun = world.now;
    let from = [0, 1].map(|joint: usize| world.motors[joint].angle());
    let mut outcome = Outcome { stopped: None, moved: [0.0; 2], joints: ["", ""], words: None };
    let (mut lines, mut due) = (event.lines.iter(), begun);
    while world.now.since(begun) < WINDOW {
        while world.now >= due
            && let Some(line) = lines.next()
        {
            match line.strip_prefix("wait ").and_then(|ms| ms.parse().ok()) {
                Some(ms) => due = world.now.after(Duration::from_millis(ms)),
                None => world.play(line),
            }
        }
        world.cycle();
        let after = world.now.since(begun);
        let is_kept = |joint| if is_plain { holds.get() } else { matches!(world.kind(joint), "damp" | "hold") };
        if (0..2).all(|joint: usize| !world.motors[joint].is_on() || is_kept(joint)) {
            outcome.stopped.get_or_insert(after);
        }
        for joint in (0..2).filter(|_| after <= FIRST) {
            let moved: &mut f64 = &mut outcome.moved[joint];
            *moved = moved.max((world.motors[joint].angle() - from[joint]).abs());
        }
    }
    outcome.joints = [world.kind(0), world.kind(1)];
    let problem = world.notices.iter().find(|(at, notice, _)| *at >= begun && notice.is_problem());
    outcome.words = problem.map(|(.., words)| words.clone());
    outcome
}

/// The bare loop's state of a motor.
#[derive(Clone)]
struct Axis {
    feedback: Option<Feedback>,
    asked: Option<Stamp>,
    command: Option<f64>,
    target: Option<f64>,
}

/// The baseline: trusts the motors' reports. `holds`: because no action arrived.
fn plain(spec: DamiaoSpec, holds: Rc<Cell<bool>>) -> Program {
    let mut axes = vec![Axis { feedback: None, asked: None, command: None, target: None }; spec.motors.len()];
    let mut acted: Option<Stamp> = None;
    let mut is_off = false;
    Box::new(move |input: &Input<'_>| {
        let Some(ranges) = Ranges::new(12.5, 30.0, 10.0) else { return Vec::new() };
        let now = input.now;
        for frame in input.frames.iter().filter(|frame| Reply::decode(frame).is_none()) {
            let sender = spec.motors.iter().position(|motor| u32::from(motor.master) == frame.id);
            if let (Some(sender), Some(feedback)) = (sender, Feedback::decode(frame, &ranges)) {
                (axes[sender].feedback, axes[sender].asked) = (Some(feedback), None);
            }
        }
        if let Some(action) = input.action {
            acted = Some(now);
            axes.iter_mut().zip(action).for_each(|(axis, target)| axis.target = Some(*target));
        }
        let age = acted.map_or(Duration::ZERO, |acted| now.since(acted));
        holds.set(age >= DEADMAN[0]);
        if holds.get() {
            axes.iter_mut().for_each(|axis| axis.target = axis.command);
        }
        is_off |= input.is_disarmed || age >= DEADMAN[0] + DEADMAN[1];
        for (axis, motor) in axes.iter().zip(&spec.motors) {
            let is_bad = |feedback: &Feedback| {
                feedback.status != MotorStatus::Enabled
                    || f64::from(feedback.mos) >= motor.max_mos
                    || f64::from(feedback.rotor) >= motor.max_rotor
            };
            let is_silent = axis.asked.is_some_and(|asked| now.since(asked) >= SILENT);
            is_off |= is_silent || axis.feedback.as_ref().is_some_and(is_bad);
        }
        let axes = axes.iter_mut().zip(&spec.motors);
        axes.filter_map(|(axis, motor)| {
            axis.asked.get_or_insert(now);
            if is_off { Some(StateCommand::Disable.frame(motor.slave)) } else { axis.follow(motor, &ranges) }
        })
        .collect()
    })
}

impl Axis {
    /// The frame of a cycle: towards the target, as far from the motor's reported position as the torque limit allows.
    fn follow(&mut self, motor: &rapid_registry::MotorSpec, ranges: &Ranges) -> Option<CanFrame> {
        let [kp, kd] = GAINS;
        // The first frame queries the position: without gains nothing moves, and a joint held by hand stays.
        let Some(feedback) = self.feedback else {
            return codec::mit(motor.slave, &Mit { kp: 0.0, kd, ..Mit::default() }, ranges).ok();
        };
        let before = self.command.unwrap_or(feedback.q);
        let most = motor.slew * CYCLE.as_secs_f64();
        let wanted = before + (self.target.unwrap_or(before) - before).clamp(-most, most);
        let reach = motor.torque / kp;
        let command = wanted.clamp(feedback.q - reach, feedback.q + reach);
        self.command = Some(command);
        codec::mit(motor.slave, &Mit { kp, kd, q: command, dq: 0.0, tau: 0.0 }, ranges).ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_event_is_measured_and_motion_stops() {
        for event in &EVENTS {
            let outcome = play(event, false);
            assert_eq!(outcome.stopped.is_some(), event.stops, "{}", event.name);
            assert!(
                outcome.words.is_some() || event.lines == ["killed"] || event.lines == ["disarm"],
                "{}",
                event.name
            );
        }
    }
}
