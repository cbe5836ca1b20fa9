//! Simulated motors, a bus between them and the machine, and a judge who sees every frame.

use std::collections::VecDeque;

use rapid_core::action::Trip;
use rapid_registry::{BrakeSpec, MotionSpec, MotorKind, MotorSpec, Mounting, Stop, StopSpec, WatchSpec};

use super::*;
use crate::control::damiao::codec::{Feedback, MotorStatus, Ranges};
use crate::control::damiao::parameter::{Parameter, Value};

pub(super) const CYCLE: Duration = Duration::from_millis(5);

/// A motor as the public drivers know it, and its joint: `q`, `dq` and `tau` are of the joint, what it sends and takes is
/// of the motor.
#[derive(Debug, Clone)]
pub(super) struct Sim {
    pub(super) slave: u16,
    pub(super) master: u16,
    /// What the motor reports at the zero of the joint, rad.
    pub(super) zero: f64,
    /// -1 if it turns against the joint.
    pub(super) sign: f64,
    pub(super) ranges: [f64; 3],
    pub(super) q: f64,
    pub(super) dq: f64,
    pub(super) tau: f64,
    pub(super) status: MotorStatus,
    /// A fault that comes back as soon as it is cleared.
    pub(super) broken: Option<MotorStatus>,
    pub(super) mode: u32,
    pub(super) timeout: u32,
    pub(super) mos: u8,
    pub(super) rotor: u8,
    /// It has no power.
    pub(super) silent: bool,
    /// It does not move, whatever the command...
    pub(super) stuck: bool,
    /// ...but is moved so fast, rad/s.
    pub(super) drift: f64,
    /// It takes no orders to turn on, or off.
    pub(super) deaf: Option<StateCommand>,
    /// It keeps its control mode, whatever is written.
    pub(super) stubborn: bool,
    /// The last command that it took: its id, and its first number.
    pub(super) command: Option<(u32, f64)>,
}

impl Sim {
    pub(super) fn new(slave: u16, master: u16) -> Self {
        Self {
            slave,
            master,
            zero: 0.0,
            sign: 1.0,
            ranges: [12.5, 30.0, 10.0],
            q: 0.25,
            dq: 0.0,
            tau: 0.0,
            status: MotorStatus::Disabled,
            broken: None,
            mode: 1,
            timeout: 0,
            mos: 30,
            rotor: 31,
            silent: false,
            stuck: false,
            drift: 0.0,
            deaf: None,
            stubborn: false,
            command: None,
        }
    }

    /// Mounted as in its entry.
    fn mounted(motor: &MotorSpec) -> Self {
        let sign = if motor.mounting.reversed { -1.0 } else { 1.0 };
        Self { zero: motor.mounting.zero, sign, ..Self::new(motor.slave, motor.master) }
    }

    /// As it was at first.
    pub(super) fn renewed(&self) -> Self {
        Self { zero: self.zero, sign: self.sign, ..Self::new(self.slave, self.master) }
    }

    pub(super) fn is_on(&self) -> bool {
        self.status == MotorStatus::Enabled
    }

    /// The first number of a command, of the joint: position or velocity.
    fn commanded(&self, frame: &CanFrame) -> f64 {
        let number = command_of(frame, self.slave, self.ranges);
        if frame.id == u32::from(self.slave) + 0x200 { number * self.sign } else { self.joint(number) }
    }

    /// Where the joint is with the motor there, rad.
    fn joint(&self, motor: f64) -> f64 {
        (motor - self.zero) * self.sign
    }

    pub(super) fn answer(&mut self, frame: &CanFrame) -> Option<CanFrame> {
        if self.silent {
            return None;
        }
        let slave = u32::from(self.slave);
        if frame.id == 0x7ff {
            let [low, high, verb, rid, value @ ..] = frame.data;
            if u16::from_le_bytes([low, high]) != self.slave {
                return None;
            }
            if !self.is_on() {
                self.dq = 0.0;
            }
            return if verb == 0xcc { self.feedback() } else { self.parameter(verb, rid, value) };
        }
        if frame.id == slave && frame.data.starts_with(&[0xff; 7]) {
            let command = match frame.data[7] {
                0xfc => StateCommand::Enable,
                0xfd => StateCommand::Disable,
                0xfe => StateCommand::SetZero,
                _ => StateCommand::ClearError,
            };
            if self.deaf != Some(command) {
                match command {
                    StateCommand::Enable if self.status == MotorStatus::Disabled => self.status = MotorStatus::Enabled,
                    StateCommand::Disable if self.is_on() => self.status = MotorStatus::Disabled,
                    StateCommand::ClearError if self.status.is_fault() => {
                        self.status = self.broken.unwrap_or(MotorStatus::Disabled);
                    }
                    _ => {}
                }
            }
            return self.feedback();
        }
        if ![slave, slave + 0x100, slave + 0x200].contains(&frame.id) {
            return None;
        }
        let number = self.commanded(frame);
        self.dq = 0.0;
        if self.is_on() {
            self.command = Some((frame.id, number));
            let before = self.q;
            match frame.id - slave {
                0x200 if !self.stuck => self.q += number * CYCLE.as_secs_f64(),
                0 | 0x100 if !self.stuck => self.q = number,
                _ => {}
            }
            self.q += self.drift * CYCLE.as_secs_f64();
            self.dq = (self.q - before) / CYCLE.as_secs_f64();
        }
        self.feedback()
    }

    fn parameter(&mut self, verb: u8, rid: u8, value: [u8; 4]) -> Option<CanFrame> {
        let parameter = Parameter::from_rid(rid)?;
        let written = verb == 0x55;
        if written {
            let whole = u32::from_le_bytes(value);
            match parameter {
                Parameter::ControlMode if !self.stubborn => self.mode = whole,
                Parameter::Timeout => self.timeout = whole,
                _ => {}
            }
        }
        let [p, v, t] = self.ranges;
        #[allow(clippy::cast_possible_truncation)]
        let value = match parameter {
            Parameter::ControlMode => Value::Whole(self.mode),
            Parameter::Timeout => Value::Whole(self.timeout),
            Parameter::PMax => Value::Float(p as f32),
            Parameter::VMax => Value::Float(v as f32),
            Parameter::TMax => Value::Float(t as f32),
            _ => Value::Whole(0),
        };
        Some(Reply { slave: self.slave, written, parameter, value }.encode(self.master))
    }

    pub(super) fn feedback(&self) -> Option<CanFrame> {
        let [p, v, t] = self.ranges;
        let id = self.slave.to_le_bytes()[0] & 0xf;
        let (mos, rotor) = (self.mos, self.rotor);
        let (q, dq, tau) = (self.zero + self.sign * self.q, self.sign * self.dq, self.sign * self.tau);
        let feedback = Feedback { id, status: self.status, q, dq, tau, mos, rotor };
        feedback.encode(self.master, &Ranges::new(p, v, t)?)
    }
}

/// The first number of a command, of the motor: position or velocity.
fn command_of(frame: &CanFrame, slave: u16, [range, ..]: [f64; 3]) -> f64 {
    let [a, b, c, d, ..] = frame.data;
    if frame.id == u32::from(slave) {
        f64::from(u16::from_be_bytes([a, b])) / 65_535.0 * 2.0 * range - range
    } else {
        f64::from(f32::from_le_bytes([a, b, c, d]))
    }
}

pub(super) fn motor(slave: u16, master: u16, mode: MotorMode) -> MotorSpec {
    MotorSpec {
        name: format!("joint_{slave}"),
        slave,
        master,
        kind: MotorKind::Dm4310,
        mode,
        mounting: Mounting::default(),
        position: [-2.0, 2.0],
        velocity: 20.0,
        torque: 1000.0,
        slew: 5.0,
        // How a joint starts has tests of its own.
        motion: MotionSpec { acceleration: f64::INFINITY, soft_start: Duration::ZERO, first_target: 100.0 },
        watch: WatchSpec::default(),
        // A joint that stops otherwise has tests of its own.
        stop: StopSpec { own_fault: Stop::Limp, other_fault: Stop::Limp, emergency: Stop::Limp, hold_for: None },
        brake: None,
        max_mos: 80.0,
        max_rotor: 100.0,
    }
}

/// A brake that is neither quick nor as quick in both directions.
pub(super) fn brake() -> BrakeSpec {
    let ms = Duration::from_millis;
    BrakeSpec { chip: "/dev/gpiochip0".into(), line: 4, released_high: true, engages_in: ms(60), releases_in: ms(40) }
}

pub(super) const MIT: MotorMode = MotorMode::Mit { kp: 10.0, kd: 1.0 };

pub(super) fn spec(motors: Vec<MotorSpec>) -> DamiaoSpec {
    DamiaoSpec {
        motors,
        hz: 200,
        deadman: None,
        disable_after: Some(Duration::from_secs(1)),
        timeout: Duration::from_millis(400),
        silent_after: Duration::from_millis(40),
        effector: None,
    }
}

/// The machine, its motors, and the time.
pub(super) struct World {
    pub(super) bus: MotorBus,
    pub(super) sims: Vec<Sim>,
    pub(super) spec: DamiaoSpec,
    pub(super) now: Stamp,
    pub(super) notices: Vec<Notice>,
    /// Cycles that an answer is on its way.
    pub(super) latency: usize,
    /// The frames of the last cycle.
    pub(super) sent: Vec<CanFrame>,
    /// What motors sent, and when.
    answers: VecDeque<(Stamp, Vec<CanFrame>)>,
    judge: Judge,
    pub(super) brakes: Brakes,
    /// They stay as they are.
    pub(super) are_brakes_stuck: bool,
}

/// What must never happen, from the frames and from what was asked for alone.
#[derive(Debug, Default)]
struct Judge {
    /// An arm was asked for, and nothing has ended it since.
    may_move: bool,
    /// It was, and no disarm came since: a joint may be kept from falling.
    may_keep: bool,
    stopped: bool,
    axes: Vec<Axis>,
}

#[derive(Debug, Clone, Default)]
struct Axis {
    /// The last position the machine received, without impossible ones, and when it received anything.
    reported: Option<f64>,
    /// Likewise how fast.
    speed: f64,
    received: Option<Stamp>,
    /// It ordered the motor to turn on.
    notified: bool,
    /// It has received since that the motor is enabled.
    is_on: bool,
    /// The last command to a motor that is on, and when.
    command: Option<(f64, Stamp)>,
    unanswered: Option<Stamp>,
    /// When it was last ordered to turn off.
    off: Stamp,
}

impl World {
    pub(super) fn new(spec: DamiaoSpec) -> Self {
        let now = Stamp(1_000_000_000_000);
        let axes = spec.motors.len();
        Self {
            bus: MotorBus::new(&spec, now),
            sims: spec.motors.iter().map(Sim::mounted).collect(),
            spec,
            now,
            notices: Vec::new(),
            latency: 0,
            sent: Vec::new(),
            answers: VecDeque::new(),
            judge: Judge { axes: vec![Axis::default(); axes], ..Judge::default() },
            brakes: Brakes::default(),
            are_brakes_stuck: false,
        }
    }

    /// Two motors in MIT mode that have answered.
    pub(super) fn ready() -> Self {
        let mut world = Self::new(spec(vec![motor(1, 0x11, MIT), motor(2, 0x12, MIT)]));
        world.run_until(BusState::Disarmed);
        world
    }

    /// Two motors in MIT mode that are armed.
    pub(super) fn armed() -> Self {
        let mut world = Self::ready();
        world.arm();
        world.run_until(BusState::Holding);
        world
    }

    /// Armed, and on the way to a target of both motors.
    pub(super) fn following(spec: DamiaoSpec) -> Self {
        let mut world = Self::new(spec);
        world.run_until(BusState::Disarmed);
        world.arm();
        world.run_until(BusState::Holding);
        world.target(&[0.5, 0.5]);
        world.run(15);
        world
    }

    pub(super) fn arm(&mut self) {
        let was_arming = self.bus.state() == BusState::Arming;
        self.bus.arm(self.now);
        if !self.judge.may_move || !was_arming && self.bus.state() == BusState::Arming {
            // What motors reported before is of the past: the bus may have seen a fault in a frame that cannot be, of
            // which the judge takes nothing.
            self.judge.axes.iter_mut().for_each(|axis| (axis.notified, axis.is_on) = (false, false));
        }
        (self.judge.may_move, self.judge.may_keep) = (true, true);
    }

    pub(super) fn disarm(&mut self) {
        self.bus.disarm(self.now);
        (self.judge.may_move, self.judge.may_keep) = (false, false);
    }

    pub(super) fn emergency(&mut self, trip: Trip) {
        self.bus.emergency(trip, self.now);
        self.judge.may_move = false;
    }

    pub(super) fn stop(&mut self) -> Vec<CanFrame> {
        self.judge.stopped = true;
        self.bus.stop_frames().collect()
    }

    /// What a motor is commanded.
    pub(super) fn command(&self, motor: usize) -> f64 {
        self.bus.commands().nth(motor).unwrap()
    }

    pub(super) fn target(&mut self, target: &[f64]) -> bool {
        self.bus.target(target, self.now, self.now)
    }

    /// A frame reaches the machine.
    pub(super) fn feed(&mut self, frame: &CanFrame, sent: Stamp) {
        self.bus.feed(frame, self.now);
        if Reply::decode(frame).is_some() {
            return;
        }
        for ((axis, sim), motor) in self.judge.axes.iter_mut().zip(&self.sims).zip(&self.spec.motors) {
            let id = u16::from(frame.data[0] & 0xf);
            if frame.id != u32::from(sim.master) || id != sim.slave & 0xf {
                continue;
            }
            let [p, v, t] = sim.ranges;
            let own = Feedback::decode(frame, &Ranges::new(p, v, t).unwrap()).unwrap();
            let report = Feedback { q: sim.joint(own.q), dq: own.dq * sim.sign, ..own };
            axis.unanswered = None;
            let passed = axis.received.replace(self.now).map_or(Duration::ZERO, |received| self.now.since(received));
            let fastest = (axis.speed.abs() + 1.25 * motor.velocity + 0.5).min(v);
            let reach = fastest * (passed.as_secs_f64() + 0.02) + 4.0 * p / 65_535.0;
            let is_possible = !axis.notified || axis.reported.is_none_or(|before| (report.q - before).abs() <= reach);
            if is_possible {
                (axis.reported, axis.speed) = (Some(report.q), report.dq);
            }
            // Reports from before the order to turn off are of the past; nothing is taken from an impossible frame.
            if sent < axis.off || !is_possible {
                continue;
            }
            // Once armed, and once it was on, whatever is not on ends it all.
            let was_on = axis.is_on;
            axis.is_on = axis.notified && report.status == MotorStatus::Enabled;
            let too_hot = f64::from(report.mos) >= motor.max_mos || f64::from(report.rotor) >= motor.max_rotor;
            self.judge.may_move &= !(was_on && (!axis.is_on || too_hot));
        }
    }

    pub(super) fn cycle(&mut self) {
        self.now = self.now.after(CYCLE);
        if self.answers.len() > self.latency {
            let (sent, frames) = self.answers.pop_front().unwrap_or_default();
            for frame in frames {
                self.feed(&frame, sent);
            }
        }
        let mut sent = Vec::new();
        self.bus.feed_brakes(self.brakes, self.now);
        self.bus.step(self.now, |frame| sent.push(frame));
        self.turn_brakes();
        assert!(sent.len() <= 2 * self.sims.len());
        let mut answers = Vec::new();
        for frame in &sent {
            self.judge_frame(frame);
            answers.extend(self.sims.iter_mut().filter_map(|sim| sim.answer(frame)));
        }
        self.answers.push_back((self.now, answers));
        self.sent = sent;
        while let Some(notice) = self.bus.take_notice() {
            assert!(!notice.words(self.bus.names()).to_string().is_empty());
            self.notices.push(notice);
        }
    }

    /// The brakes do what they are to do, unless they are stuck, or hang in the air.
    fn turn_brakes(&mut self) {
        let released = self.bus.releases();
        for (index, (sim, motor)) in self.sims.iter().zip(&self.spec.motors).enumerate() {
            let notified = self.judge.axes[index].notified || sim.is_on();
            assert!(
                released >> index & 1 == 0 || notified,
                "the brake of {} is released, and its motor off",
                motor.name
            );
        }
        if !self.are_brakes_stuck {
            self.brakes.released = released;
        }
    }

    fn judge_frame(&mut self, frame: &CanFrame) {
        assert!(!self.judge.stopped, "{frame:x?} after a stop");
        let silent_after = self.spec.silent_after.max(CYCLE * 3) + CYCLE * 2;
        for ((axis, sim), motor) in self.judge.axes.iter_mut().zip(&self.sims).zip(&self.spec.motors) {
            let slave = u32::from(sim.slave);
            let is_order = frame.id == slave && frame.data.starts_with(&[0xff; 7]);
            let is_mine = frame.id == 0x7ff && u16::from_le_bytes([frame.data[0], frame.data[1]]) == sim.slave;
            if frame.id == slave || frame.id == slave + 0x100 || frame.id == slave + 0x200 || is_mine {
                axis.unanswered.get_or_insert(self.now);
            }
            let unanswered = axis.unanswered.map_or(Duration::ZERO, |since| self.now.since(since));
            if is_order && frame.data[7] == 0xfd {
                *axis = Axis { notified: false, is_on: false, command: None, off: self.now, ..axis.clone() };
            }
            if is_order && frame.data[7] == 0xfc {
                (axis.notified, axis.command) = (true, None);
                assert!(self.judge.may_move, "a motor was enabled without an arm");
            }
            if is_order || ![slave, slave + 0x100, slave + 0x200].contains(&frame.id) {
                continue;
            }
            let kp = f64::from(u16::from_be_bytes([frame.data[3] & 0xf, frame.data[4]])) / 4095.0 * 500.0;
            let damps = frame.id == slave && kp == 0.0;
            let before = axis.command.map(|(before, _)| before);
            let rests = frame.id == slave + 0x200 && frame.data == [0; 8];
            let keeps = damps || rests || before.is_some_and(|before| (sim.commanded(frame) - before).abs() < 1e-9);
            assert!(self.judge.may_move || self.judge.may_keep && keeps, "{frame:x?} while nothing may move");
            assert!(unanswered < silent_after, "a command to a motor that is silent for {unanswered:?}");
            if damps {
                continue;
            }
            let command = sim.commanded(frame);
            let measured = axis.reported.expect("a command before any answer");
            let quantum = 25.0 / 65_535.0;
            if frame.id == slave + 0x200 {
                assert!(command.abs() <= motor.velocity + 1e-6);
                let beyond =
                    measured > motor.position[1] && command > 0.0 || measured < motor.position[0] && command < 0.0;
                assert!(!beyond, "{command} rad/s at {measured}");
                continue;
            }
            if !axis.is_on {
                // A single frame may have reported it as off.
                if keeps && !self.judge.may_move {
                    continue;
                }
                assert!((command - measured).abs() <= quantum, "first command {command} at {measured}");
                continue;
            }
            let [low, high] = motor.position;
            let range = low.min(measured) - quantum..=high.max(measured) + quantum;
            if frame.id == slave {
                let torque = kp * (command - measured).abs();
                assert!(torque <= motor.torque + 2.0 * quantum * kp, "{torque} Nm for {command} at {measured}");
            }
            if let Some((before, at)) = axis.command {
                let step = motor.slew * self.now.since(at).min(CYCLE * 2).as_secs_f64() + 2.0 * quantum;
                assert!((command - before).abs() <= step, "from {before} to {command}");
                // A joint that starts beyond the limits may stay there and come back, no more.
                let back = command.abs() <= before.abs() + quantum;
                assert!(range.contains(&command) || back, "{command} is beyond the limits, at {measured}");
            }
            axis.command = Some((command, self.now));
        }
    }

    pub(super) fn run(&mut self, cycles: usize) {
        for _ in 0..cycles {
            self.cycle();
        }
    }

    pub(super) fn run_until(&mut self, state: BusState) {
        for _ in 0..1000 {
            if self.bus.state() == state {
                return;
            }
            self.cycle();
        }
        panic!("{:?} and not {state:?} after 5 s; {:?}", self.bus.state(), self.notices);
    }

    pub(super) fn run_to_fault(&mut self) -> Fault {
        for _ in 0..1000 {
            if let BusState::Faulted(fault) = self.bus.state() {
                assert!(self.notices.contains(&Notice::Fault(fault)));
                return fault;
            }
            self.cycle();
        }
        panic!("{:?} and no fault after 5 s", self.bus.state());
    }

    /// Was anything but orders to turn off and requests sent in the last cycle?
    pub(super) fn moved(&self) -> bool {
        let harmless = |frame: &CanFrame| frame.id == 0x7ff || frame.data == [255, 255, 255, 255, 255, 255, 255, 0xfd];
        !self.sent.iter().all(harmless)
    }

    pub(super) fn notified(&self, notice: Notice) -> usize {
        self.notices.iter().filter(|notified| **notified == notice).count()
    }
}
