//! What a motor is asked for before it is enabled, what is set, and what is read again while it is on.
//!
//! Invariant: its ranges are those that it reported; until it has, it has none.

use std::time::Duration;

use rapid_core::time::Stamp;
use rapid_registry::MotorMode;

use super::joint::Joint;
use crate::control::can::CanFrame;
use crate::control::damiao::codec::Ranges;
use crate::control::damiao::model;
use crate::control::damiao::parameter::{self, ControlMode, Parameter, Reply, TIMEOUT_UNIT_US, Value};
use crate::control::motors::fault::Fault;
use crate::control::motors::notice::Notice;
use crate::control::motors::notices::Notices;

/// What is read, in this order.
const PROBE: [Parameter; 5] =
    [Parameter::ControlMode, Parameter::PMax, Parameter::VMax, Parameter::TMax, Parameter::Timeout];
/// One of them is read again each time that this has passed while a motor is on, so that each is within a second: without
/// its time limit nothing stops a motor once this program is dead, and in other ranges it goes elsewhere.
const LOOK_AGAIN: Duration = Duration::from_millis(150);

#[derive(Debug)]
pub(super) struct Probe {
    /// The number of [`Parameter::Timeout`].
    timeout: u32,
    /// It is asked for `PROBE[at]`...
    at: usize,
    /// ...or ordered to change it from this value.
    setting: Option<Value>,
    /// PMAX, VMAX and TMAX as it reported them last.
    read: [f64; 3],
    ranges: Option<Ranges>,
    /// Its ranges are not those that it is shipped with.
    differs: bool,
    /// When the next parameter is read again, and which.
    look: Option<Stamp>,
    looks: usize,
    /// That it has not answered yet was reported.
    missed: bool,
}

impl Probe {
    /// Of a motor that is to stop by itself without a frame for `timeout`.
    pub(super) fn new(timeout: Duration) -> Self {
        let units = timeout.as_micros().div_ceil(u128::from(TIMEOUT_UNIT_US)).max(1);
        Self {
            timeout: u32::try_from(units).unwrap_or(u32::MAX),
            at: 0,
            setting: None,
            read: [0.0; 3],
            ranges: None,
            differs: false,
            look: None,
            looks: 0,
            missed: false,
        }
    }

    /// The ranges it encodes.
    pub(super) const fn ranges(&self) -> Option<&Ranges> {
        self.ranges.as_ref()
    }

    /// Begins with the first parameter.
    pub(super) const fn start(&mut self) {
        (self.at, self.setting) = (0, None);
        (self.look, self.looks) = (None, 0);
    }

    pub(super) fn asked_for(&self) -> Parameter {
        PROBE.get(self.at).copied().unwrap_or(Parameter::ControlMode)
    }

    /// The frame that asks for it, or sets it.
    pub(super) fn question(&self, joint: &Joint) -> CanFrame {
        let (slave, parameter) = (joint.spec.slave, self.asked_for());
        match self.wanted(joint, parameter).filter(|_| self.setting.is_some()) {
            Some(value) => parameter::write(slave, parameter, value),
            None => parameter::read(slave, parameter),
        }
    }

    /// It has not answered all, and that was not reported yet.
    pub(super) const fn misses(&mut self) -> bool {
        !std::mem::replace(&mut self.missed, true)
    }

    /// Takes an answer, if it is to what was asked for. Returns whether it was the last one.
    ///
    /// # Errors
    /// The parameter cannot be used, or changed.
    pub(super) fn accept(&mut self, joint: &Joint, reply: &Reply, notices: &mut Notices) -> Result<bool, Fault> {
        // What comes late, to an earlier question or to one that was repeated, answers nothing.
        if PROBE.get(self.at) != Some(&reply.parameter) || reply.written != self.setting.is_some() {
            return Ok(false);
        }
        let (motor, parameter) = (joint.index, reply.parameter);
        let unusable = Fault::Unusable { motor, parameter, value: reply.value };
        match self.wanted(joint, parameter) {
            Some(wanted) if reply.value == wanted => {
                if let Some(was) = self.setting.take() {
                    notices.notify(Notice::ParameterSet { motor, parameter, was, is: wanted });
                }
            }
            Some(_) if self.setting.is_none() => {
                self.setting = Some(reply.value);
                return Ok(false);
            }
            Some(_) => return Err(unusable),
            // A range: PROBE[1..=3].
            None => {
                let value = reply.value.number();
                if let Some(read) = range(parameter).and_then(|range| self.read.get_mut(range)) {
                    *read = value;
                }
                Ranges::new(value, value, value).ok_or(unusable)?;
                let [low, high] = joint.within(value);
                if parameter == Parameter::PMax && low > high {
                    return Err(unusable);
                }
            }
        }
        self.at += 1;
        let is_last = self.at == PROBE.len();
        if is_last {
            self.take_ranges(joint, notices);
        }
        Ok(is_last)
    }

    fn take_ranges(&mut self, joint: &Joint, notices: &mut Notices) {
        let [p, v, t] = self.read;
        self.ranges = Ranges::new(p, v, t);
        let (motor, kind) = (joint.index, joint.spec.kind);
        let Some(read) = self.ranges else { return };
        let differs = !model::is_shipped(kind, &read);
        if differs && !self.differs {
            notices.notify(Notice::RangesDiffer { motor, read, shipped: model::shipped(kind) });
        }
        self.differs = differs;
    }

    /// Takes the answer of a motor that is on.
    ///
    /// # Errors
    /// It is not what it was when it was enabled: with another range, every position means something else.
    pub(super) fn compare(&self, joint: &Joint, reply: &Reply) -> Result<(), Fault> {
        let Reply { parameter, value, .. } = *reply;
        let read = range(parameter).and_then(|range| self.read.get(range));
        let is_changed = self.wanted(joint, parameter).is_some_and(|wanted| wanted != value)
            || read.is_some_and(|read| read.to_bits() != value.number().to_bits());
        if is_changed { Err(Fault::Changed { motor: joint.index, parameter, value }) } else { Ok(()) }
    }

    /// Asks a motor that is on, now and then, for what another program may have changed.
    pub(super) fn look_again(&mut self, joint: &Joint, now: Stamp) -> Option<CanFrame> {
        // Not all motors of a bus at once.
        let turn = LOOK_AGAIN / 16 * u32::try_from(joint.index % 16).unwrap_or(0);
        if now < *self.look.get_or_insert_with(|| now.after(turn)) {
            return None;
        }
        self.look = Some(now.after(LOOK_AGAIN));
        self.looks = (self.looks + 1) % PROBE.len();
        Some(parameter::read(joint.spec.slave, PROBE.get(self.looks).copied().unwrap_or(Parameter::Timeout)))
    }

    /// The value a parameter is to have, if we set it.
    fn wanted(&self, joint: &Joint, parameter: Parameter) -> Option<Value> {
        match parameter {
            Parameter::ControlMode => Some(Value::Whole(match joint.spec.mode {
                MotorMode::Mit { .. } => ControlMode::Mit,
                MotorMode::PositionVelocity => ControlMode::PositionVelocity,
                MotorMode::Velocity => ControlMode::Velocity,
            } as u32)),
            Parameter::Timeout => Some(Value::Whole(self.timeout)),
            _ => None,
        }
    }
}

/// Which of the ranges a parameter is, if it is one.
const fn range(parameter: Parameter) -> Option<usize> {
    match parameter {
        Parameter::PMax => Some(0),
        Parameter::VMax => Some(1),
        Parameter::TMax => Some(2),
        _ => None,
    }
}
