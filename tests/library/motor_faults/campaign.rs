//! Random sequences of faults, orders and actions over motors with bodies; after every cycle is checked what must always
//! hold: disarmed means off, enabled means ordered, every command within limits and slew, no stop without its kind (all by
//! the judge of `motor_world`), and every fault that can be seen is named in time (here).
//!
//! `RAPID_FAULT_SEQUENCES=10000 make one TEST=no_sequence_of_faults` plays so many, `RAPID_FAULT_SEED=N` one of them and
//! shows it.

use std::env;
use std::fmt::Write as _;
use std::time::Duration;

use rapid_core::random::Random;
use rapid_core::time::Stamp;
use rapid_motors::control::motors::Notice;
use rapid_registry::{DamiaoSpec, MotorMode, Stop};

use crate::support::motor_world::motor_spec::{brake, bus, motor};
use crate::support::motor_world::{CYCLE, World};

/// Sequences of a run that names no other number.
const SEQUENCES: u64 = 400;
/// Failed sequences that are shown.
const SHOWN: usize = 10;
/// What can be seen of a joint is named so long after it can be.
const NAMED_WITHIN: Duration = Duration::from_millis(50);
/// A notice is not repeated within this.
const AGAIN: Duration = Duration::from_secs(1);
/// The program looks at parameters of motors again within this.
const READ_AGAIN: Duration = Duration::from_millis(850);
/// Of a motor that does not answer any fault may be named, whichever comes first.
const SILENT: &str = "";
/// After a pause of the program its first frames prove little.
const SETTLED: Duration = Duration::from_millis(100);

#[test]
fn no_sequence_of_faults_breaks_an_invariant() {
    let number = |name: &str| env::var(name).ok().and_then(|text| text.parse::<u64>().ok());
    if let Some(seed) = number("RAPID_FAULT_SEED") {
        let (wrong, story) = play(seed);
        super::show(&story);
        assert!(wrong.is_empty(), "sequence {seed}:\n  {}", wrong.join("\n  "));
        return;
    }
    let count = number("RAPID_FAULT_SEQUENCES").unwrap_or(SEQUENCES);
    let (mut armed, mut failed) = (0, Vec::new());
    for seed in 0..count {
        let (wrong, story) = play(seed);
        armed += u64::from(story.contains("motors are armed"));
        if !wrong.is_empty() {
            failed.push(format!("sequence {seed}:\n  {}", wrong.join("\n  ")));
        }
    }
    assert!(
        failed.is_empty(),
        "{} of {count} sequences failed. Again, with all that happens in it: RAPID_FAULT_SEED=N make one \
         TEST=no_sequence_of_faults\n{}",
        failed.len(),
        failed.get(..SHOWN).unwrap_or(&failed).join("\n")
    );
    assert!(armed * 10 > count * 9, "only {armed} of {count} sequences armed any motor");
}

/// Something that happened and is to be named.
struct Due {
    what: String,
    motor: usize,
    words: &'static str,
    since: Stamp,
    within: Duration,
}

/// Since when something can be seen of a motor.
#[derive(Clone, Copy, Default)]
struct Seen {
    since: [Option<Stamp>; 6],
    newest: [Stamp; 6],
}

struct Campaign {
    world: World,
    random: Random,
    dues: Vec<Due>,
    seen: Vec<Seen>,
    /// Positions and speeds that did not change, since when.
    still: Vec<(f64, Stamp)>,
    paused: Stamp,
    /// When the motors were not armed last.
    armed: Stamp,
    story: String,
    wrong: Vec<String>,
}

/// Plays the sequence of a seed: what was wrong, and what happened.
fn play(seed: u64) -> (Vec<String>, String) {
    let mut random = Random::new(seed, 0);
    let world = World::new(spec(&mut random));
    let now = world.now;
    let count = world.motors.len();
    let mut campaign = Campaign {
        world,
        random,
        dues: Vec::new(),
        seen: vec![Seen::default(); count],
        still: vec![(f64::NAN, now); count],
        paused: now,
        armed: now,
        story: String::new(),
        wrong: Vec::new(),
    };
    campaign.run();
    let Campaign { world, wrong, mut story, .. } = campaign;
    for (at, _, words) in &world.notices {
        let _ = writeln!(story, "{:6} ms: {words}", at.0 / 1_000_000 - 1_000_000);
    }
    let mut lines: Vec<&str> = story.lines().collect();
    lines.sort_by_key(|line| line.trim_start().split(' ').next().and_then(|ms| ms.parse::<u64>().ok()));
    (world.judge.wrong.iter().cloned().chain(wrong).collect(), lines.join("\n"))
}

fn spec(random: &mut Random) -> DamiaoSpec {
    let stops = [Stop::Limp, Stop::Damp, Stop::Hold, Stop::Brake];
    let motors = (1..=2).map(|slave| {
        let mut spec = motor(slave);
        let pick = |random: &mut Random| stops[usize::try_from(random.below(4)).expect("small")];
        spec.mode = match random.below(5) {
            0 => MotorMode::PositionVelocity,
            1 => MotorMode::Velocity,
            _ => MotorMode::Mit { kp: random.uniform(10.0, 60.0), kd: random.uniform(0.5, 2.0) },
        };
        (spec.velocity, spec.torque, spec.slew) =
            (random.uniform(1.5, 5.0), random.uniform(2.0, 5.0), random.uniform(0.5, 6.0));
        (spec.stop.own_fault, spec.stop.other_fault) = (pick(random), pick(random));
        let stops_by_it = [spec.stop.own_fault, spec.stop.other_fault].contains(&Stop::Brake);
        spec.brake = (stops_by_it || random.below(3) == 0).then(|| brake(slave));
        spec.stop.hold_for = (random.below(3) == 0).then_some(Duration::from_millis(200));
        if random.below(4) == 0 {
            spec.watch.blocked_after = None;
        }
        spec
    });
    let mut spec = bus(motors.collect());
    if random.below(3) == 0 {
        spec.disable_after = None;
    }
    spec
}

impl Campaign {
    fn run(&mut self) {
        let end = if self.random.below(4) == 0 { 2.6 } else { 1.95 };
        for motor in 1..=2 {
            let load = self.random.uniform(0.0, 1.5);
            let lever = if self.random.below(2) == 0 { "" } else { "lever" };
            self.order(&format!("load 0.{motor} {load:.2} {lever}"));
            self.order(&format!("ends 0.{motor} -{end} {end}"));
        }
        self.order("block 0 1");
        self.pass(100);
        self.order("arm");
        self.pass(100);
        self.order("block 0 0");
        let count = 3 + self.random.below(12);
        for _ in 0..count {
            let gap = if self.random.below(3) == 0 { self.random.below(900) } else { self.random.below(120) };
            self.pass(gap);
            self.happen();
        }
        self.pass(300);
        // Whatever came before: nothing is on some time after a disarm, and all that can be received.
        for line in ["mute 0 0", "power 0 1", "disarm"] {
            self.order(line);
        }
        self.pass(700);
        if self.world.motors.iter().any(vbench::emu::can::motor::Motor::is_on) {
            self.note("a motor is on at the end");
        }
    }

    fn order(&mut self, line: &str) {
        let _ = writeln!(self.story, "{:6} ms:     > {line}", self.world.now.0 / 1_000_000 - 1_000_000);
        self.world.play(line);
    }

    fn note(&mut self, text: &str) {
        self.wrong.push(format!("{} ms: {text}", self.world.now.0 / 1_000_000 - 1_000_000));
    }

    fn pass(&mut self, ms: u64) {
        let until = self.world.now.after(Duration::from_millis(ms));
        while self.world.now < until {
            self.world.cycle();
            self.look();
        }
    }

    /// An order, an action, or a fault.
    fn happen(&mut self) {
        let motor = usize::try_from(self.random.below(2)).expect("small");
        let id = motor + 1;
        match self.random.below(24) {
            0..=2 => self.order("arm"),
            3 => self.order("disarm"),
            4..=7 => {
                let targets = [0, 1].map(|_: u8| self.random.uniform(-2.5, 2.5));
                self.order(&format!("target {:.3} {:.3}", targets[0], targets[1]));
            }
            8 => self.order("silence"),
            9 => {
                let ms = self.random.below(700);
                self.order(&format!("away {ms}"));
                self.dues.clear();
                self.pause(ms);
            }
            10 => {
                let (count, by) = (1 + self.random.below(4), self.far());
                self.order(&format!("damage {id} {count} {by:.2}"));
                self.owe(motor, "reports", NAMED_WITHIN);
            }
            11 => {
                let by = self.far();
                self.order(&format!("zero 0.{id} {by:.2}"));
                self.owe(motor, "reports", NAMED_WITHIN);
                self.pause(0);
            }
            12 => {
                let code = 8 + self.random.below(7);
                self.order(&format!("fault 0.{id} {code:x}"));
                self.owe(motor, "reports", NAMED_WITHIN);
            }
            13 => {
                let word = ["mute", "power"][usize::try_from(self.random.below(2)).expect("small")];
                let on = u8::from(word == "mute");
                self.order(&format!("{word} 0.{id} {on}"));
                self.owe(motor, SILENT, NAMED_WITHIN);
                let ms = self.random.below(600);
                self.pass(ms);
                self.order(&format!("{word} 0.{id} {}", 1 - on));
                self.pause(0);
            }
            14 => {
                let degrees = 101 + self.random.below(10);
                self.order(&format!("hot 0.{id} {degrees}"));
                self.owe(motor, "°C", NAMED_WITHIN);
                self.pass(100);
                self.order(&format!("hot 0.{id} 40"));
            }
            15 => {
                let orders = ["fffffffffffffffc", "fffffffffffffffd", "fffffffffffffffe", "7fff7ff0000007ff"];
                let bytes = orders[usize::try_from(self.random.below(4)).expect("small")];
                self.order(&format!("foreign 00{id} {bytes}"));
                self.owe(motor, "another program", NAMED_WITHIN);
            }
            16 => {
                let parameter = if self.random.below(2) == 0 { (9, 0) } else { (10, 4) };
                self.order(&format!("rewrite {id} {} {}", parameter.0, parameter.1));
                self.owe(motor, "another program set it", READ_AGAIN);
            }
            17 | 18 => self.for_a_while(&format!("block 0.{id}")),
            19 => self.for_a_while(&format!("freeze 0.{id}")),
            20 | 21 => {
                let load = self.random.uniform(-6.0, 6.0);
                self.order(&format!("load 0.{id} {load:.2}"));
            }
            22 => {
                let [coulomb, viscous] = [0.5, 0.3].map(|most| self.random.uniform(0.0, most));
                self.order(&format!("friction 0.{id} {coulomb:.2} {viscous:.2}"));
            }
            _ if self.random.below(4) == 0 => self.order("stop"),
            _ => self.order("load 0 0.5"),
        }
    }

    /// Farther than a joint can have come between two frames.
    fn far(&mut self) -> f64 {
        let by = self.random.uniform(3.0, 4.0);
        if self.random.below(2) == 0 { by } else { -by }
    }

    fn for_a_while(&mut self, line: &str) {
        self.order(&format!("{line} 1"));
        let ms = self.random.below(1500);
        self.pass(ms);
        self.order(&format!("{line} 0"));
        // What a frozen encoder hid comes at once.
        self.pause(0);
    }

    /// What is seen from now on, and for so long, is not news of the joints.
    fn pause(&mut self, ms: u64) {
        self.paused = self.paused.max(self.world.now.after(Duration::from_millis(ms)));
    }

    /// What just happened is to be named, if all motors are on and answer.
    fn owe(&mut self, motor: usize, words: &'static str, within: Duration) {
        let what = self.story.lines().last().unwrap_or_default().trim().to_owned();
        if self.is_seen(motor) {
            self.dues.push(Due { what, motor, words, since: self.world.now, within });
        }
    }

    /// The program runs, the motors are on, and it receives from this one.
    fn is_seen(&self, motor: usize) -> bool {
        self.world.now >= self.paused.after(SETTLED) && self.world.bus.is_armed() && {
            !self.world.judge.axes[motor].is_deaf && self.world.motors[motor].is_on()
        }
    }

    /// Was there a notice of it since?
    fn is_named(&self, motor: usize, words: &str, since: Stamp) -> bool {
        let name = &self.world.spec.motors[motor].name;
        let of_it = |notice: &Notice| matches!(notice, Notice::Strange { .. } | Notice::Fault(_) | Notice::Warm { .. });
        let mut notices = self.world.notices.iter().rev().take_while(|(at, ..)| *at >= since);
        notices.any(|(_, notice, text)| of_it(notice) && text.contains(name.as_str()) && text.contains(words))
    }

    fn look(&mut self) {
        let now = self.world.now;
        if !self.world.bus.is_armed() {
            self.armed = now;
        }
        if !self.world.bus.is_armed() || now < self.paused {
            // Something else stopped them, or the program does not run.
            self.dues.clear();
        }
        let (past, rest) =
            std::mem::take(&mut self.dues).into_iter().partition::<Vec<_>, _>(|due| now.since(due.since) >= due.within);
        self.dues = rest;
        for due in past {
            let is_over = due.words == SILENT && !self.world.judge.axes[due.motor].is_deaf;
            if !is_over && !self.is_named(due.motor, due.words, due.since.before(AGAIN)) {
                self.note(&format!("`{}` is not named", due.what));
            }
        }
        for motor in 0..self.seen.len() {
            self.look_at(motor);
        }
    }

    /// What can be seen of a motor by its frames and the commands to it.
    fn look_at(&mut self, motor: usize) {
        let (now, spec, axis) = (self.world.now, &self.world.spec.motors[motor], &self.world.judge.axes[motor]);
        let Some(position) = axis.position() else { return };
        let velocity = axis.velocity;
        let has_moved = self.still[motor].0.to_bits() != position.to_bits() || velocity.abs() < 0.6;
        if has_moved {
            self.still[motor] = (position, now);
        }
        let pushed = self.pushed(motor, position).map(|sign| sign * velocity);
        let lag = axis.command.map(|(command, _)| match spec.mode {
            MotorMode::Mit { .. } => 0.0,
            MotorMode::PositionVelocity => (command - position).abs() - spec.watch.lag - 0.02,
            MotorMode::Velocity => (command - velocity).abs() - 0.25 * spec.velocity - 0.55,
        });
        let [low, high] = spec.position;
        let margin = spec.watch.margin + 0.005;
        let table = [
            ("outside its limits", position < low - margin || position > high + margin),
            ("too fast", velocity.abs() > spec.velocity * 1.25 + 0.55),
            ("pushed back", pushed.is_some_and(|speed| speed < -0.07)),
            ("blocked", pushed.is_some_and(|speed| speed.abs() < 0.03)),
            ("frozen", !has_moved),
            ("lagging", lag.is_some_and(|lag| lag > 0.0)),
        ];
        let (is_seen, is_armed) = (self.is_seen(motor), self.world.bus.is_armed());
        for (at, (what, is)) in table.into_iter().enumerate() {
            let Seen { since, newest } = &mut self.seen[motor];
            if is {
                newest[at] = now;
            }
            // A cycle in which it is not so, for noise or for an action that comes, ends nothing.
            since[at] = since[at].or(Some(now)).filter(|_| is_armed && now.since(newest[at]) < CYCLE * 3);
            let Some(since) = since[at].filter(|_| is_seen) else { continue };
            // The frame that shows it, and the cycle that reports it.
            let is_late = now.since(since.max(self.paused)) > NAMED_WITHIN + CYCLE * 2;
            // A notice of a joint that is blocked comes once for as long as that lasts, which may have begun before.
            let is_old = what == "blocked" && self.is_named(motor, "does not move", self.armed);
            if is_late && !is_old && !self.is_named(motor, "", since.before(AGAIN)) {
                self.seen[motor].since[at] = None;
                self.note(&format!("joint_{} is {what} and not named", motor + 1));
            }
        }
    }

    /// Towards where a joint is pushed with all the torque that it may have and should come.
    fn pushed(&self, motor: usize, position: f64) -> Option<f64> {
        let spec = &self.world.spec.motors[motor];
        let MotorMode::Mit { kp, .. } = spec.mode else { return None };
        let target = self.world.followed.as_ref()?;
        let [low, high] = spec.position;
        let error = target.get(motor)?.clamp(low, high) - position;
        let torque = self.world.judge.axes[motor].torque;
        let is_pushed =
            error * torque > 0.0 && torque.abs() > 0.95 * spec.torque && error.abs() * kp > 1.3 * spec.torque;
        is_pushed.then(|| error.signum())
    }
}
