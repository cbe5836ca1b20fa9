//! A simulated Damiao motor: its commands on the bus, its motion, its answers.
//!
//! Frames as in the vendor's `DM_CAN.py` and LeRobot's `motors/damiao`: MIT at its slave id, position with velocity at
//! 0x100 more, velocity at 0x200 more, parameters at 0x7FF; the answer is one feedback or parameter frame at its master
//! id. It follows commands with a first-order lag, never faster than VMAX, without a load; once an order gives it a
//! body (`plant`), it moves as that does under its loops' torque, at most TMAX and none while disabled.
//!
//! Invariant: every frame that a motor can receive gets one answer, except a missing register and a save while enabled.
//! Invariant: it moves by itself only while enabled; a fault or its own timeout disables it until it is enabled again.

use serde_json::{Value, json};

use super::Frame;
use super::motion::{Mit, reach, to_unsigned, turn};
use super::plant::{Body, Drive, MOST_STEPS, Movement, STEP_NS, Trouble};
use super::registers::{self, Registers, Type};
use super::run::Run;
use crate::emu::order::Order;
use crate::emu::reported::Reported;

/// Identifier of parameter frames for all motors.
const PARAMETERS: u32 = 0x7ff;
/// From this temperature on it disables itself, degrees Celsius.
const TOO_HOT: u8 = 120;
const COIL_TOO_HOT: u8 = 0xc;
const COMMUNICATION_LOST: u8 = 0xd;

/// A motor on a bus.
#[derive(Debug)]
pub struct Motor {
    registers: Registers,
    saved: Registers,
    enabled: bool,
    powered: bool,
    muted: bool,
    fault: u8,
    degrees: u8,
    drive: Drive,
    /// By its own encoder.
    movement: Movement,
    body: Option<Body>,
    trouble: Trouble,
    moved_ns: u64,
    received_ns: u64,
    run: Option<Run>,
    reported: Vec<Reported>,
}

impl Motor {
    /// A motor with factory settings, cold, disabled and at its zero.
    pub fn new(kind: Type, slave: u16, master: u16) -> Self {
        let registers = Registers::new(kind, slave, master);
        Self {
            registers,
            saved: registers,
            enabled: false,
            powered: true,
            muted: false,
            fault: 0,
            degrees: 30,
            drive: Drive::Off,
            movement: Movement { position: 0.0, velocity: 0.0, torque: 0.0 },
            body: None,
            trouble: Trouble::default(),
            moved_ns: 0,
            received_ns: 0,
            run: None,
            reported: Vec::new(),
        }
    }

    /// Identifier of commands to it.
    pub fn slave(&self) -> u32 {
        self.registers.slave
    }

    /// The joint's true angle, rad, which a wrong zero and a frozen encoder do not change.
    pub fn angle(&self) -> f64 {
        self.movement.position - self.trouble.offset
    }

    /// Whether it is enabled.
    pub fn is_on(&self) -> bool {
        self.enabled && self.powered
    }

    /// Its events since the last call.
    pub fn reported(&mut self) -> impl Iterator<Item = Reported> + '_ {
        self.reported.drain(..)
    }

    /// Receives a frame; returns its answer if the frame is for it.
    pub fn receive(&mut self, frame: &Frame, now_ns: u64) -> Option<Frame> {
        if frame.extended || frame.remote || frame.len() != 8 || self.muted || !self.powered {
            return None;
        }
        let bytes = frame.padded();
        let slave = self.registers.slave;
        let mode = frame.id.checked_sub(slave).filter(|offset| offset % 0x100 == 0).map(|offset| offset / 0x100 + 1);
        self.tend(now_ns);
        match (frame.id, mode) {
            (PARAMETERS, _) => {
                (u32::from(u16::from_le_bytes([bytes[0], bytes[1]])) == slave).then_some(())?;
                self.received_ns = now_ns;
                self.parameter(bytes)
            }
            (_, Some(mode @ 1..=4)) => {
                self.received_ns = now_ns;
                match bytes {
                    [0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, word @ 0xfb..=0xfe] => self.switch(word),
                    _ if mode == self.registers.mode => self.command(bytes, now_ns),
                    _ => {}
                }
                Some(self.feedback())
            }
            _ => None,
        }
    }

    /// Advances time; returns when it must be called again at the latest.
    pub fn tend(&mut self, now_ns: u64) -> Option<u64> {
        self.advance(now_ns);
        let silence = self.registers.patience().filter(|_| self.enabled && self.powered);
        let mut due_ns = None;
        if let Some(patience) = silence {
            let patience_ns = u64::try_from(patience.as_nanos()).unwrap_or(u64::MAX);
            let give_up_ns = self.received_ns.saturating_add(patience_ns);
            if now_ns >= give_up_ns {
                self.report("motor_timeout", json!({"after_ns": patience_ns, "last_received_ns": self.received_ns}));
                self.latch(COMMUNICATION_LOST);
            } else {
                due_ns = Some(give_up_ns);
            }
        }
        if let Some(run) = self.run {
            let ends_ns = run.ends_ns();
            if now_ns >= ends_ns {
                self.run = None;
                self.report("commands_end", run.summary());
            } else {
                due_ns = Some(due_ns.map_or(ends_ns, |due_ns: u64| due_ns.min(ends_ns)));
            }
        }
        due_ns
    }

    /// Applies an event to it.
    pub fn apply(&mut self, order: Order, now_ns: u64) {
        self.tend(now_ns);
        match order {
            Order::Fault(0) => self.fault = 0,
            Order::Fault(code) => self.latch(code),
            Order::Mute(muted) => self.muted = muted,
            Order::Hot(degrees) => {
                self.degrees = degrees;
                if degrees >= TOO_HOT {
                    self.latch(COIL_TOO_HOT);
                }
            }
            Order::Power(powered) => {
                self.powered = powered;
                self.registers = self.saved;
                self.fault = 0;
                self.stop();
            }
            Order::Load { torque, is_lever } => {
                let body = self.body.get_or_insert_default();
                (body.load, body.is_lever) = (torque, is_lever);
            }
            Order::Friction([coulomb, viscous]) => {
                let body = self.body.get_or_insert_default();
                (body.coulomb, body.viscous) = (coulomb, viscous);
            }
            Order::Inertia(inertia) => self.body.get_or_insert_default().inertia = inertia,
            Order::Ends(ends) => self.body.get_or_insert_default().ends = Some(ends),
            Order::Zero(by) => self.shift(by),
            Order::Freeze(frozen) => {
                let Movement { position, velocity, .. } = self.movement;
                self.trouble.frozen = frozen.then_some([position, velocity]);
            }
            Order::Block(blocked) => self.trouble.is_blocked = blocked,
            Order::Ask => {
                let Movement { position, velocity, .. } = self.movement;
                let state = json!({
                    "enabled": self.enabled, "err": self.err(), "position": position, "velocity": velocity,
                    "angle": self.angle(),
                    "degrees": self.degrees, "mode": self.registers.mode, "timeout": self.registers.timeout,
                });
                self.report("motor_state", state);
            }
            Order::Flood(_) | Order::BusOff(_) | Order::Link(_) | Order::Level(_) => {}
        }
    }

    fn switch(&mut self, word: u8) {
        match word {
            0xfb => {
                self.fault = 0;
                self.report("motor_cleared", json!({}));
            }
            // A latched fault must be cleared first.
            0xfc if self.fault != 0 => self.report("motor_enable_refused", json!({"err": self.err()})),
            0xfc if !self.enabled => {
                self.enabled = true;
                self.report("motor_enabled", json!({}));
            }
            0xfd => {
                // Reported each time: a motor may be stopped more than once.
                self.stop();
                self.report("motor_disabled", json!({}));
            }
            0xfe => {
                self.shift(-self.movement.position);
                self.drive = Drive::Off;
                self.report("motor_zeroed", json!({}));
            }
            _ => {}
        }
    }

    fn command(&mut self, bytes: [u8; 8], now_ns: u64) {
        let limits = [self.registers.pmax, self.registers.vmax, self.registers.tmax].map(f64::from);
        let [pmax, vmax, tmax] = limits;
        let real = |at: usize| {
            let value = f32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]]);
            if value.is_finite() { f64::from(value) } else { 0.0 }
        };
        let drive = match self.registers.mode {
            registers::MIT => Drive::Mit(Mit::decode(bytes, limits)),
            registers::POS_VEL => {
                Drive::Position { position: real(0).clamp(-pmax, pmax), fastest: real(4).abs().min(vmax) }
            }
            registers::VEL => Drive::Velocity(real(0).clamp(-vmax, vmax)),
            _ => Drive::Off,
        };
        if self.enabled {
            self.drive = drive;
            if self.body.is_none() {
                let Movement { position, velocity, .. } = self.movement;
                self.movement.torque = match drive {
                    Drive::Mit(mit) => {
                        mit.kp * (mit.position - position) + mit.kd * (mit.velocity - velocity) + mit.torque
                    }
                    _ => 0.0,
                }
                .clamp(-tmax, tmax);
            }
        }
        let position = match drive {
            Drive::Mit(mit) => (mit.kp > 0.0).then_some(mit.position),
            Drive::Position { position, .. } => Some(position),
            Drive::Off | Drive::Velocity(_) => None,
        };
        let enabled = self.enabled;
        if let Some(run) = &mut self.run {
            run.take(position, enabled, now_ns);
        } else {
            self.run = Some(Run::begin(position, enabled, now_ns));
            self.report("commands_begin", json!({"enabled": enabled, "position": position}));
        }
    }

    fn parameter(&mut self, bytes: [u8; 8]) -> Option<Frame> {
        let [id_low, id_high, word, rid, value @ ..] = bytes;
        let master = self.master();
        let answer = |word, rid, value: [u8; 4]| {
            let [a, b, c, d] = value;
            Some(Frame::data(master, [id_low, id_high, word, rid, a, b, c, d]))
        };
        match word {
            0x33 => answer(word, rid, self.registers.read(rid)?),
            0x55 => {
                if self.registers.write(rid, value) {
                    self.report("motor_written", json!({"rid": rid, "bytes": value}));
                }
                answer(word, rid, self.registers.read(rid)?)
            }
            // It writes its flash only while disabled.
            0xaa if !self.enabled => {
                self.saved = self.registers;
                self.report("motor_saved", json!({}));
                answer(word, 1, [0; 4])
            }
            0xcc => Some(self.feedback()),
            _ => None,
        }
    }

    /// Its feedback frame.
    fn feedback(&self) -> Frame {
        let [pmax, vmax, tmax] = [self.registers.pmax, self.registers.vmax, self.registers.tmax].map(f64::from);
        let Movement { position, velocity, torque } = self.movement;
        let [position, velocity] = self.trouble.frozen.unwrap_or([position, velocity]);
        let [p_high, p_low] = (to_unsigned(position, pmax, 16) as u16).to_be_bytes();
        let [v_high, v_low] = (to_unsigned(velocity, vmax, 12) as u16).to_be_bytes();
        let [t_high, t_low] = (to_unsigned(torque, tmax, 12) as u16).to_be_bytes();
        let [id, ..] = self.registers.slave.to_le_bytes();
        Frame::data(
            self.master(),
            [
                self.err() << 4 | id & 0x0f,
                p_high,
                p_low,
                v_high << 4 | v_low >> 4,
                v_low << 4 | t_high,
                t_low,
                self.degrees,
                self.degrees,
            ],
        )
    }

    fn master(&self) -> u16 {
        u16::try_from(self.registers.master).unwrap_or_default()
    }

    fn err(&self) -> u8 {
        if self.fault != 0 { self.fault } else { u8::from(self.enabled) }
    }

    fn latch(&mut self, code: u8) {
        self.fault = code;
        self.report("motor_fault", json!({"err": code, "was_enabled": self.enabled}));
        self.stop();
    }

    fn stop(&mut self) {
        self.enabled = false;
        self.drive = Drive::Off;
        self.movement.torque = 0.0;
        if self.body.is_none() {
            self.movement.velocity = 0.0;
        }
    }

    /// Moves its zero.
    fn shift(&mut self, by: f64) {
        self.movement.position += by;
        self.trouble.offset += by;
    }

    fn advance(&mut self, now_ns: u64) {
        let passed_ns = now_ns.saturating_sub(self.moved_ns);
        if let Some(body) = self.body {
            let steps = passed_ns / STEP_NS;
            // The rest of a step is left for the next call.
            self.moved_ns += steps * STEP_NS;
            let tmax = self.registers.tmax.into();
            body.pass(steps.min(MOST_STEPS), &mut self.movement, self.drive, &self.trouble, tmax);
            return;
        }
        self.moved_ns = self.moved_ns.max(now_ns);
        if self.trouble.is_blocked {
            self.movement.velocity = 0.0;
            return;
        }
        let Movement { position, velocity, torque } = self.movement;
        let (position, velocity) = self.glide([position, velocity], passed_ns as f64 / 1e9);
        self.movement = Movement { position, velocity, torque };
    }

    /// Position and velocity of a motor without a body, after `seconds`.
    fn glide(&self, [position, velocity]: [f64; 2], seconds: f64) -> (f64, f64) {
        let turned = |wanted| {
            let (moved, reached) = turn(velocity, wanted, seconds);
            (position + moved, reached)
        };
        match self.drive {
            Drive::Mit(mit) if mit.kp > 0.0 => reach(position, mit.position, self.registers.vmax.into(), seconds),
            Drive::Mit(mit) if mit.kd > 0.0 => turned(mit.velocity),
            Drive::Position { position: goal, fastest } => reach(position, goal, fastest, seconds),
            Drive::Velocity(wanted) => turned(wanted),
            Drive::Off | Drive::Mit(_) => (position, 0.0),
        }
    }

    fn report(&mut self, action: &'static str, mut fields: Value) {
        fields["motor"] = json!(self.registers.slave);
        self.reported.push(Reported::new(action, fields));
    }
}

#[cfg(test)]
#[path = "motor_tests.rs"]
mod tests;
