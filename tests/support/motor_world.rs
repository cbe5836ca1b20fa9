//! The state machine of motors, simulated motors with bodies, and a judge who sees every frame; in virtual time.
//!
//! A world is controlled by lines: the emulator's orders for motors (`vbench::emu::order`, device 0), and
//!
//! ```text
//! arm   disarm   stop               what an operator orders, or the end of the program
//! target Q..                        from now on an action with this target comes ten times a second
//! silence                           no action comes any more
//! away MS   die                     the program does not run for so long, or never again, and its guard neither
//! killed                            the program does not run again, and its guard stops the motors
//! foreign ID HEX                    another program sends this frame: everybody on the bus receives it
//! rewrite MOTOR RID VALUE           a register is written in a frame that the program does not receive
//! damage MOTOR COUNT RAD            so many of its next frames have a position that is off by this
//! chip 0|1                          the chip of the brakes is unplugged, and all engage, or is back
//! stuck 0|1                         brakes stay as they are, at any level of their lines
//! ```
//!
//! MOTOR counts from 1, like its id.

#![allow(dead_code, reason = "tests and the bench each use a part")]
#![allow(clippy::cast_possible_truncation, reason = "numbers of scenarios, and ids of 11 bits")]

#[path = "motor_spec.rs"]
#[allow(clippy::duplicate_mod, reason = "the bench has it a second time, for motors behind a line")]
pub(crate) mod motor_spec;

use std::time::Duration;

use rapid_core::time::Stamp;
use rapid_devices::driver::can::guard::KEEP_FOR;
use rapid_motors::control::can::CanFrame;
use rapid_motors::control::damiao::codec;
use rapid_motors::control::damiao::parameter::Reply;
use rapid_motors::control::motors::{Brakes, BusState, Fault, MotorBus, Notice, Reason};
use rapid_registry::{BrakeSpec, DamiaoSpec, MotorMode, Stop};
use vbench::emu::can::Frame;
use vbench::emu::can::motion::{Mit, from_unsigned, to_unsigned};
use vbench::emu::can::motor::Motor;
use vbench::emu::can::registers::Type;
use vbench::emu::order::{self, Order};

/// Time between two steps of the program.
pub(crate) const CYCLE: Duration = Duration::from_millis(5);
/// Time between two actions.
const ACTIONS: Duration = Duration::from_millis(100);
/// Ranges of motors of this kind: PMAX, VMAX, TMAX.
const RANGES: [f64; 3] = [12.5, 30.0, 10.0];
/// A motor that can receive is off this soon after nothing allows it to be on.
const OFF_WITHIN: Duration = Duration::from_millis(50);
/// A joint is stopped in its configured way this soon after a fault.
const KIND_WITHIN: Duration = Duration::from_millis(20);

/// Inputs of a program in a cycle.
pub(crate) struct Input<'a> {
    /// Frames received from the bus.
    pub(crate) frames: &'a [CanFrame],
    /// The received action.
    pub(crate) action: Option<&'a [f64]>,
    /// A disarm was ordered at any time.
    pub(crate) is_disarmed: bool,
    pub(crate) now: Stamp,
}

/// A program that drives the motors instead of the state machine: returns the frames that it sends in a cycle.
pub(crate) type Program = Box<dyn FnMut(&Input<'_>) -> Vec<CanFrame>>;

/// See the module's comment.
pub(crate) struct World {
    pub(crate) bus: MotorBus,
    pub(crate) motors: Vec<Motor>,
    pub(crate) spec: DamiaoSpec,
    pub(crate) now: Stamp,
    /// Each notice with its time and text.
    pub(crate) notices: Vec<(Stamp, Notice, String)>,
    pub(crate) judge: Judge,
    /// Drives the motors from now on, without a judge.
    pub(crate) instead: Option<Program>,
    /// The current target.
    pub(crate) followed: Option<Vec<f64>>,
    /// Frames that reach the program in its next cycle.
    arriving: Vec<CanFrame>,
    target: Option<Vec<f64>>,
    action_due: Stamp,
    away_until: Option<Stamp>,
    killed: Option<Stamp>,
    brakes: Brakes,
    are_brakes_stuck: bool,
    /// For each joint, whether its brake lets it turn, and since when its line has the other level.
    turns: Vec<(bool, Option<Stamp>)>,
    damage: Vec<(usize, usize, f64)>,
}

/// Conditions that must never occur, judged by frames, by the motors themselves, and by the orders.
#[derive(Default)]
#[expect(clippy::struct_excessive_bools, reason = "each is a fact of its own")]
pub(crate) struct Judge {
    /// The violations seen.
    pub(crate) wrong: Vec<String>,
    pub(crate) axes: Vec<Axis>,
    /// An arm was ordered, and nothing has ended it since.
    may_move: bool,
    /// An arm was ordered, and no disarm came since: a joint may be kept from falling.
    may_keep: bool,
    stopped: bool,
    was_armed: bool,
}

/// The commands to a motor and its answers.
#[derive(Clone, Default)]
#[expect(clippy::struct_excessive_bools, reason = "each is a fact of its own")]
pub(crate) struct Axis {
    /// Its newest received positions, the newest last, rad.
    reported: Vec<f64>,
    /// Its newest velocity, rad/s.
    pub(crate) velocity: f64,
    /// The newest command: rad or rad/s.
    pub(crate) command: Option<(f64, Stamp)>,
    /// The torque requested by the newest MIT frame at its newest position, Nm.
    pub(crate) torque: f64,
    /// Number of commands that may equal the joint's position, because it is being enabled.
    enabling: u8,
    /// The newest frame is a damping one.
    is_damped: bool,
    /// It neither receives nor answers.
    pub(crate) is_deaf: bool,
    /// Another program commands it after ours has ended.
    is_foreign: bool,
    /// Since when nothing has allowed it to be on.
    forbidden: Option<Stamp>,
    /// How it must be stopped, and by when.
    kind: Option<(Stop, Stamp)>,
    /// It is stopping with its brake.
    brakes: bool,
}

impl Axis {
    /// Its newest received position, rad.
    pub(crate) fn position(&self) -> Option<f64> {
        self.reported.last().copied()
    }
}

impl World {
    /// Motors with the slave ids 1, 2, ... and a body; none has answered yet.
    pub(crate) fn new(spec: DamiaoSpec) -> Self {
        let now = Stamp(1_000_000_000_000);
        let kind = Type::named("DM4310").expect("the emulator knows it");
        let motors = spec.motors.iter().map(|motor| Motor::new(kind, motor.slave, motor.master)).collect();
        let axes = vec![Axis::default(); spec.motors.len()];
        let mut world = Self {
            bus: MotorBus::new(&spec, now),
            motors,
            spec,
            now,
            notices: Vec::new(),
            judge: Judge { axes, ..Judge::default() },
            instead: None,
            followed: None,
            arriving: Vec::new(),
            target: None,
            action_due: now,
            away_until: None,
            killed: None,
            brakes: Brakes::default(),
            are_brakes_stuck: false,
            turns: Vec::new(),
            damage: Vec::new(),
        };
        world.play("inertia 0 0.02");
        world.turns = vec![(true, None); world.motors.len()];
        world.drive_brakes(0);
        world
    }

    /// Advances this many milliseconds.
    pub(crate) fn run(&mut self, ms: u64) {
        let until = self.now.after(Duration::from_millis(ms));
        while self.now < until {
            self.cycle();
        }
    }

    /// Waits until the motors have answered, and arms them; joints are held from outside until they hold themselves.
    ///
    /// # Panics
    /// When they are not armed within a second.
    pub(crate) fn arm(&mut self) {
        self.play("block 0 1");
        self.run(100);
        self.play("arm");
        for _ in 0..200 {
            if self.bus.is_armed() {
                self.play("block 0 0");
                return;
            }
            self.cycle();
        }
        panic!("not armed: {:?}, {:?}", self.bus.state(), self.notices);
    }

    /// Executes a line.
    ///
    /// # Panics
    /// When the line has no effect.
    pub(crate) fn play(&mut self, line: &str) {
        let words: Vec<&str> = line.split_whitespace().collect();
        let number = |at: usize| words.get(at).and_then(|word| word.parse::<f64>().ok()).expect(line);
        let whole = |at: usize| words.get(at).and_then(|word| word.parse::<usize>().ok()).expect(line);
        match words[..] {
            ["arm"] => {
                self.bus.arm(self.now);
                if !self.judge.stopped {
                    (self.judge.may_move, self.judge.may_keep) = (true, true);
                    self.judge.axes.iter_mut().for_each(|axis| (axis.kind, axis.brakes) = (None, false));
                }
            }
            ["disarm"] => {
                self.bus.disarm(self.now);
                self.judge.forbid();
                self.judge.was_armed = false;
            }
            ["stop"] => {
                let frames: Vec<CanFrame> = self.bus.stop_frames().collect();
                self.judge.forbid();
                self.judge.stopped = true;
                for frame in frames {
                    self.deliver(&frame);
                }
            }
            ["target", ..] => self.target = Some((1..words.len()).map(number).collect()),
            ["silence"] => self.target = None,
            ["away", _] => self.away_until = Some(self.now.after(Duration::from_millis(whole(1) as u64))),
            ["killed"] => (self.killed, self.away_until) = (Some(self.now), Some(Stamp(u64::MAX))),
            ["die"] => self.away_until = Some(Stamp(u64::MAX)),
            ["foreign", id, bytes] => {
                let id = u16::from_str_radix(id, 16).expect(line);
                let bytes = u64::from_str_radix(bytes, 16).expect(line).to_be_bytes();
                self.foreign(id, bytes);
            }
            ["rewrite", ..] => {
                let mut bytes = [whole(1) as u8, 0, 0x55, whole(2) as u8, 0, 0, 0, 0];
                bytes[4..].copy_from_slice(&(whole(3) as u32).to_le_bytes());
                let now = self.now.0;
                for motor in &mut self.motors {
                    let _no_answer = motor.receive(&Frame::data(0x7ff, bytes), now);
                }
            }
            ["chip", flag] => {
                self.brakes.broken = if flag == "1" { 0 } else { u16::MAX };
                self.drive_brakes(0);
            }
            ["stuck", flag] => self.are_brakes_stuck = flag == "1",
            ["damage", ..] => self.damage.push((whole(1) - 1, whole(2), number(3))),
            _ => self.apply_line(line),
        }
    }

    fn apply_line(&mut self, line: &str) {
        let mut words = line.split_whitespace();
        let (target, order) = words.next().and_then(|name| order::parse(name, &mut words)).expect(line);
        for (motor, axis) in self.motors.iter_mut().zip(&mut self.judge.axes) {
            if target.motor.is_none_or(|wanted| u32::from(wanted) == motor.slave()) {
                motor.apply(order, self.now.0);
                match order {
                    Order::Mute(is_deaf) => axis.is_deaf = is_deaf,
                    Order::Power(is_powered) => axis.is_deaf = !is_powered,
                    // The motor disables itself.
                    Order::Fault(_) | Order::Hot(_) => {}
                    _ => continue,
                }
                (axis.kind, axis.forbidden) = (None, None);
            }
        }
    }

    fn foreign(&mut self, id: u16, bytes: [u8; 8]) {
        self.arriving.push(CanFrame::standard(id, bytes));
        let frame = Frame::data(id, bytes);
        for (motor, axis) in self.motors.iter_mut().zip(&mut self.judge.axes) {
            if let Some(answer) = motor.receive(&frame, self.now.0) {
                // Another program enabled or disabled it.
                (axis.forbidden, axis.kind) = (None, None);
                axis.is_foreign = self.judge.stopped;
                self.arriving.push(CanFrame::standard(answer.id as u16, answer.padded()));
            }
        }
    }

    /// Delivers a frame of the program to the motors.
    fn deliver(&mut self, frame: &CanFrame) {
        let sent = Frame::data(frame.id as u16, frame.data);
        for motor in &mut self.motors {
            if let Some(answer) = motor.receive(&sent, self.now.0) {
                self.arriving.push(CanFrame::standard(answer.id as u16, answer.padded()));
            }
        }
    }

    /// A cycle of the program.
    pub(crate) fn cycle(&mut self) {
        self.now = self.now.after(CYCLE);
        let now = self.now;
        for motor in &mut self.motors {
            motor.tend(now.0);
            motor.reported().for_each(drop);
        }
        self.turn_brakes();
        if self.away_until.is_some_and(|until| now < until) {
            self.guard();
            return;
        }
        if self.away_until.take().is_some() {
            self.judge.axes.iter_mut().for_each(|axis| (axis.forbidden, axis.kind) = (None, None));
        }
        let mut arriving = std::mem::take(&mut self.arriving);
        for frame in &mut arriving {
            self.arrive(frame);
        }
        self.arriving = arriving;
        if self.instead.is_some() {
            return self.cycle_instead();
        }
        self.bus.look_for_stall(now);
        for frame in std::mem::take(&mut self.arriving) {
            self.bus.feed(&frame, now);
        }
        if now >= self.action_due
            && let Some(target) = &self.target
        {
            self.action_due = now.after(ACTIONS);
            if self.bus.target(target, now, now) {
                self.followed = Some(target.clone());
            }
        }
        let mut sent = Vec::new();
        self.bus.feed_brakes(self.brakes, now);
        self.bus.step(now, |frame| sent.push(frame));
        self.drive_brakes(self.bus.releases());
        for frame in sent {
            self.judge.look(&frame, &self.spec, now);
            self.deliver(&frame);
        }
        let first = self.notices.len();
        while let Some(notice) = self.bus.take_notice() {
            let words = notice.words(self.bus.names()).to_string();
            self.notices.push((now, notice, words));
        }
        if !matches!(self.bus.state(), BusState::Following) {
            self.followed = None;
        }
        self.judge.end_of_cycle(&self.bus, &self.motors, &self.spec, &self.notices[first..], now);
        let let_go = self.motors.iter().zip(&self.turns).map(|(motor, (turns, _))| !motor.is_on() && *turns);
        self.judge.judge_brakes(&let_go.collect::<Vec<_>>(), self.are_brakes_stuck, &self.spec, now);
    }

    /// The levels of the brakes' lines.
    fn drive_brakes(&mut self, released: u16) {
        if self.are_brakes_stuck {
            return;
        }
        let (before, now) = (self.brakes.released, self.now);
        self.brakes.released = if self.brakes.broken == 0 { released } else { 0 };
        for (index, (_, since)) in self.turns.iter_mut().enumerate() {
            if (before ^ self.brakes.released) >> index & 1 == 1 || before == 0 && since.is_none() {
                *since = Some(now);
            }
        }
    }

    /// Brakes engage and release some time after their lines change.
    fn turn_brakes(&mut self) {
        for (index, ((turns, since), spec)) in self.turns.iter_mut().zip(&self.spec.motors).enumerate() {
            let Some(brake) = &spec.brake else { continue };
            let is_released = self.brakes.released >> index & 1 == 1;
            let takes = if is_released { brake.releases_in } else { brake.engages_in };
            if *turns != is_released && since.is_some_and(|since| self.now.since(since) >= takes) {
                (*turns, *since) = (is_released, None);
                self.motors[index].apply(Order::Block(!is_released), self.now.0);
            }
        }
    }

    /// The frames that the guard of a killed program sends. A program other than ours has none.
    fn guard(&mut self) {
        let Some(killed) = self.killed.filter(|_| self.instead.is_none()) else { return };
        let is_late = self.now.since(killed) + BrakeSpec::SLOWEST >= KEEP_FOR;
        let engages = if is_late { u16::MAX } else { self.bus.engages_at_death() };
        self.drive_brakes(self.brakes.released & !engages);
        let mut will: Vec<CanFrame> = self.bus.last_will().into_iter().flatten().collect();
        if self.now.since(killed) >= KEEP_FOR {
            will = self.spec.motors.iter().map(|motor| codec::StateCommand::Disable.frame(motor.slave)).collect();
        }
        for frame in will {
            self.deliver(&frame);
        }
        // The program no longer reads answers.
        self.arriving.clear();
    }

    /// Delivers a frame to the program.
    fn arrive(&mut self, frame: &mut CanFrame) {
        if Reply::decode(frame).is_none() {
            let sender = self.spec.motors.iter().position(|motor| u32::from(motor.master) == frame.id);
            if let Some(motor) = sender {
                if let Some((_, left, by)) = self.damage.iter_mut().find(|(of, left, _)| *of == motor && *left > 0) {
                    *left -= 1;
                    let position = position_of(frame) + *by;
                    let [high, low] = (to_unsigned(position, RANGES[0], 16) as u16).to_be_bytes();
                    (frame.data[1], frame.data[2]) = (high, low);
                }
                let axis = &mut self.judge.axes[motor];
                axis.reported.push(position_of(frame));
                if axis.reported.len() > 6 {
                    axis.reported.remove(0);
                }
                let [.., d3, d4, _, _, _] = frame.data;
                axis.velocity = from_unsigned(u32::from(d3) << 4 | u32::from(d4) >> 4, RANGES[1], 12);
            }
        }
    }

    /// A cycle of a program that replaces the state machine.
    fn cycle_instead(&mut self) {
        let frames = std::mem::take(&mut self.arriving);
        let is_due = self.now >= self.action_due && self.target.is_some();
        if is_due {
            self.action_due = self.now.after(ACTIONS);
        }
        let action = self.target.as_deref().filter(|_| is_due);
        let input = Input { frames: &frames, action, is_disarmed: !self.judge.may_keep, now: self.now };
        let sent = self.instead.as_mut().map(|program| program(&input)).unwrap_or_default();
        for frame in sent {
            self.deliver(&frame);
        }
    }

    /// How a joint is stopped, if it is.
    pub(crate) fn kind(&self, motor: usize) -> &'static str {
        if !self.motors[motor].is_on() {
            return "limp";
        }
        if self.killed.is_some() {
            // Its guard sends only this.
            let frame = self.bus.last_will().and_then(|mut will| will.nth(motor)).expect("it is on");
            let damps = frame.id == self.motors[motor].slave() && Mit::decode(frame.data, RANGES).kp == 0.0;
            return if damps { "damp" } else { "hold" };
        }
        match self.bus.state() {
            // It continues with its last command.
            _ if self.judge.axes[motor].is_deaf => "on",
            BusState::Following => "follow",
            BusState::Faulted(_) if self.judge.axes[motor].is_damped => "damp",
            BusState::Holding | BusState::Faulted(_) => "hold",
            _ => "on",
        }
    }

    /// The first notice since `since` with these words: how long after.
    pub(crate) fn named(&self, words: &str, since: Stamp) -> Option<Duration> {
        let found = self.notices.iter().find(|(at, _, text)| *at >= since && text.contains(words));
        found.map(|(at, ..)| at.since(since))
    }

    /// The first fault since `since`: its text, and how long after.
    pub(crate) fn fault(&self, since: Stamp) -> Option<(&str, Duration)> {
        let is_fault = |notice: &Notice| matches!(notice, Notice::Fault(_));
        let found = self.notices.iter().find(|(at, notice, _)| *at >= since && is_fault(notice));
        found.map(|(at, _, text)| (text.as_str(), at.since(since)))
    }
}

fn position_of(frame: &CanFrame) -> f64 {
    from_unsigned(u32::from(u16::from_be_bytes([frame.data[1], frame.data[2]])), RANGES[0], 16)
}

impl Judge {
    /// Nothing may move from now on.
    fn forbid(&mut self) {
        (self.may_move, self.may_keep) = (false, false);
        self.axes.iter_mut().for_each(|axis| axis.kind = None);
    }

    fn note(&mut self, now: Stamp, text: &str) {
        if self.wrong.len() < 20 {
            self.wrong.push(format!("{} ms: {text}", now.0 / 1_000_000 - 1_000_000));
        }
    }

    /// Examines a frame of the program.
    fn look(&mut self, frame: &CanFrame, spec: &DamiaoSpec, now: Stamp) {
        if self.stopped {
            self.note(now, &format!("{frame:x?} after a stop"));
        }
        let place =
            |slave: u16| frame.id.checked_sub(u32::from(slave)).filter(|place| [0, 0x100, 0x200].contains(place));
        let found = spec.motors.iter().enumerate().find_map(|(at, motor)| Some((at, motor, place(motor.slave)?)));
        let Some((at, motor, place)) = found else { return };
        let mut axis = std::mem::take(&mut self.axes[at]);
        let mut wrong = Vec::new();
        if place == 0 && frame.data.starts_with(&[0xff; 7]) {
            (axis.command, axis.is_damped, axis.torque) = (None, false, 0.0);
            // The command with the order, and the first one after the motor reports that it is enabled.
            axis.enabling = if frame.data[7] == 0xfc { 2 } else { 0 };
            if frame.data[7] == 0xfc && !self.may_move {
                wrong.push("it is enabled without an arm".to_owned());
            }
        } else {
            let mit = Mit::decode(frame.data, RANGES);
            let real = f32::from_le_bytes([frame.data[0], frame.data[1], frame.data[2], frame.data[3]]);
            axis.is_damped = place == 0 && mit.kp == 0.0;
            let value = if place == 0 { mit.position } else { f64::from(real) };
            let rests = place == 0x200 && value == 0.0;
            let stays = axis.command.is_some_and(|(before, _)| (before - value).abs() < 1e-6);
            if !self.may_move && !(self.may_keep && (axis.is_damped || rests || stays)) {
                wrong.push(format!("it is commanded {value:.4} while nothing may move"));
            }
            if !axis.is_damped {
                wrong.extend(axis.judge_command(value, mit.kp * f64::from(u8::from(place == 0)), motor, now));
                axis.command = Some((value, now));
            }
        }
        for text in wrong {
            self.note(now, &format!("{}: {text}", motor.name));
        }
        self.axes[at] = axis;
    }

    fn end_of_cycle(
        &mut self,
        bus: &MotorBus,
        motors: &[Motor],
        spec: &DamiaoSpec,
        notices: &[(Stamp, Notice, String)],
        now: Stamp,
    ) {
        let faults: Vec<Fault> = notices.iter().filter_map(|(_, notice, _)| fault_of(notice)).collect();
        let ended = |reason| notices.iter().any(|(_, notice, _)| *notice == Notice::Disabled(reason));
        if self.was_armed && !bus.is_armed() {
            let is_known = match bus.state() {
                BusState::Faulted(_) => !faults.is_empty(),
                BusState::Disabling | BusState::Disarmed => true,
                BusState::Stopped => self.stopped,
                _ => false,
            };
            if !is_known {
                self.note(now, &format!("a stop without its kind: {:?}", bus.state()));
            }
        }
        if matches!(bus.state(), BusState::Disabling | BusState::Disarmed) || ended(Reason::Deadman) {
            self.forbid();
        }
        for (place, fault) in faults.into_iter().enumerate() {
            self.may_move = false;
            let own = fault.own();
            if !fault.motor().is_none_or(|own| fault.words(bus.names()).to_string().contains(&spec.motors[own].name)) {
                self.note(now, &format!("{fault:?} does not name its motor"));
            }
            for (at, (axis, motor)) in self.axes.iter_mut().zip(motors).enumerate() {
                let stop = spec.motors[at].stop;
                let kind = if Some(at) == own { stop.own_fault } else { stop.other_fault };
                // A motor that was stopped before stays so; one that is off, or does not receive, cannot be held.
                if place == 0 && self.was_armed && motor.is_on() && !axis.is_deaf && self.may_keep {
                    axis.kind = Some((kind, now.after(KIND_WITHIN)));
                    axis.brakes = kind == Stop::Brake;
                } else if Some(at) == own {
                    (axis.kind, axis.brakes) = (None, false);
                }
            }
        }
        if !self.may_move && bus.is_armed() {
            self.note(now, "armed without an order");
        }
        self.was_armed = bus.is_armed();
        self.judge_joints(motors, spec, now);
    }

    /// Checks that a joint that stops with its brake is held until the brake is engaged.
    fn judge_brakes(&mut self, let_go: &[bool], are_stuck: bool, spec: &DamiaoSpec, now: Stamp) {
        for (at, motor) in spec.motors.iter().enumerate().filter(|(_, motor)| motor.brake.is_some()) {
            let axis = &mut self.axes[at];
            // A disarm releases at once, and a motor that disables itself cannot be held.
            let is_braking = axis.brakes && self.may_keep && !axis.is_deaf && !are_stuck;
            if is_braking && let_go[at] && axis.command.is_none() && motor.stop.hold_for.is_none() {
                axis.brakes = false;
                self.note(now, &format!("{} is let go before its brake holds", motor.name));
            }
        }
    }

    fn judge_joints(&mut self, motors: &[Motor], spec: &DamiaoSpec, now: Stamp) {
        let mut wrong = Vec::new();
        for (at, (axis, motor)) in self.axes.iter_mut().zip(motors).enumerate() {
            let name = &spec.motors[at].name;
            if let Some((kind, _)) = axis.kind.filter(|(_, due)| now >= *due) {
                axis.kind = None;
                let has_damping = matches!(spec.motors[at].mode, MotorMode::Mit { .. });
                let is = match (motor.is_on(), axis.is_damped) {
                    (false, _) => Stop::Limp,
                    (true, true) => Stop::Damp,
                    (true, false) => Stop::Hold,
                };
                let expected = match kind {
                    Stop::Damp if !has_damping => Stop::Hold,
                    // Until the brake is engaged.
                    Stop::Brake => Stop::Hold,
                    kind => kind,
                };
                // A motor that disabled itself by then is not the program's mistake.
                if is != expected && !(is == Stop::Limp && axis.command.is_none()) {
                    wrong.push(format!("{name} stops {is:?} and not {expected:?}"));
                }
            }
            if self.may_move || self.may_keep || axis.is_deaf || axis.is_foreign || !motor.is_on() {
                axis.forbidden = None;
            } else if now.since(*axis.forbidden.get_or_insert(now)) > OFF_WITHIN {
                axis.forbidden = Some(now);
                wrong.push(format!("{name} is on, and nothing allows it"));
            }
        }
        for text in wrong {
            self.note(now, &text);
        }
    }
}

impl Axis {
    /// The violation of a command.
    fn judge_command(&mut self, value: f64, kp: f64, motor: &rapid_registry::MotorSpec, now: Stamp) -> Option<String> {
        const ROUNDING: f64 = 2.0 * 25.0 / 65_535.0;
        if motor.mode == MotorMode::Velocity {
            return (value.abs() > motor.velocity + 1e-6).then(|| format!("is commanded {value} rad/s"));
        }
        let errors = self.reported.iter().map(|position| (value - position).abs());
        let Some(error) = errors.fold(None, |least: Option<f64>, error| Some(least.map_or(error, |l| l.min(error))))
        else {
            return Some("is commanded before it has answered".to_owned());
        };
        self.torque = kp * self.position().map_or(0.0, |position| value - position);
        if kp * error > motor.torque * 1.001 + kp * ROUNDING {
            return Some(format!("is pushed with {:.3} Nm", kp * error));
        }
        let [low, high] = motor.position;
        let is_enabling = self.enabling > 0;
        self.enabling = self.enabling.saturating_sub(1);
        let before = self.command.filter(|_| !is_enabling);
        let Some((before, at)) = before else {
            let jumps = error > ROUNDING + motor.slew * 2.0 * CYCLE.as_secs_f64();
            return jumps.then(|| format!("is first commanded {value:.4}, {error:.4} from where it is"));
        };
        if value < low.min(before) - ROUNDING || value > high.max(before) + ROUNDING {
            return Some(format!("is commanded {value:.4}, outside its limits"));
        }
        let most = motor.slew.min(motor.velocity) * now.since(at).min(2 * CYCLE).as_secs_f64();
        ((value - before).abs() > most + ROUNDING).then(|| format!("is commanded from {before:.4} to {value:.4}"))
    }
}

/// The fault that a notice reports.
pub(crate) const fn fault_of(notice: &Notice) -> Option<Fault> {
    match notice {
        Notice::Fault(fault) => Some(*fault),
        _ => None,
    }
}
