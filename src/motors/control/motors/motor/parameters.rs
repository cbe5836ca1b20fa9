//! What a motor is asked for before it is enabled, what is set, and what is read again while it is on.

use std::time::Duration;

use rapid_core::time::Stamp;
use rapid_registry::MotorMode;

use super::frames::within;
use super::{Motor, Phase};
use crate::control::can::CanFrame;
use crate::control::damiao::codec::Ranges;
use crate::control::damiao::model;
use crate::control::damiao::parameter::{self, ControlMode, Parameter, Reply, Value};
use crate::control::motors::fault::Fault;
use crate::control::motors::notice::Notice;
use crate::control::motors::notices::Notices;

/// What is read, in this order.
pub(super) const PROBE: [Parameter; 5] =
    [Parameter::ControlMode, Parameter::PMax, Parameter::VMax, Parameter::TMax, Parameter::Timeout];
/// One of them is read again each time that this has passed while a motor is on, so that each is within a second: without
/// its time limit nothing stops a motor once this program is dead, and in other ranges it goes elsewhere.
const LOOK_AGAIN: Duration = Duration::from_millis(150);

impl Motor {
    /// Reads its parameters, from the first.
    pub(in crate::control::motors) const fn probe(&mut self) {
        (self.look, self.looks) = (None, 0);
        self.phase = Phase::Asked { at: 0, setting: None };
    }

    /// The parameter it is asked for.
    pub(in crate::control::motors) fn asked_for(&self) -> Option<Parameter> {
        let Phase::Asked { at, .. } = self.phase else { return None };
        PROBE.get(at).copied()
    }

    /// Takes its answer about a parameter, if it is the one that was asked for.
    pub(in crate::control::motors) fn take_reply(&mut self, reply: &Reply, notices: &mut Notices) -> Result<(), Fault> {
        self.asked = None;
        let motor = self.index;
        if matches!(self.phase, Phase::On | Phase::Kept(_)) {
            let changed = Fault::Changed { motor, parameter: reply.parameter, value: reply.value };
            let is_changed = self.wanted(reply.parameter).is_some_and(|wanted| wanted != reply.value)
                || self.range(reply.parameter).is_some_and(|range| range.to_bits() != reply.value.number().to_bits());
            return if is_changed { Err(changed) } else { Ok(()) };
        }
        let Phase::Asked { at, setting } = self.phase else { return Ok(()) };
        // What comes late, to an earlier question or to one that was repeated, answers nothing.
        if PROBE.get(at) != Some(&reply.parameter) || reply.written != setting.is_some() {
            return Ok(());
        }
        let unusable = Fault::Unusable { motor, parameter: reply.parameter, value: reply.value };
        match self.wanted(reply.parameter) {
            Some(wanted) if reply.value == wanted => {
                if let Some(was) = setting {
                    notices.notify(Notice::ParameterSet { motor, parameter: reply.parameter, was, is: wanted });
                }
            }
            Some(_) if setting.is_none() => {
                self.phase = Phase::Asked { at, setting: Some(reply.value) };
                return Ok(());
            }
            Some(_) => return Err(unusable),
            // A range: PROBE[1..=3].
            None => {
                let value = reply.value.number();
                let [p, v, t] = &mut self.read;
                let slot = match reply.parameter {
                    Parameter::PMax => p,
                    Parameter::VMax => v,
                    _ => t,
                };
                *slot = value;
                Ranges::new(value, value, value).ok_or(unusable)?;
                let [low, high] = within(&self.spec, value);
                if reply.parameter == Parameter::PMax && low > high {
                    return Err(unusable);
                }
            }
        }
        self.phase = if at + 1 < PROBE.len() { Phase::Asked { at: at + 1, setting: None } } else { Phase::Probed };
        if self.phase == Phase::Probed {
            self.take_ranges(notices);
        }
        Ok(())
    }

    fn take_ranges(&mut self, notices: &mut Notices) {
        let [p, v, t] = self.read;
        let ranges = Ranges::new(p, v, t);
        if self.ranges != ranges {
            // Counted in other ranges, it means something else.
            self.feedback = None;
            self.is_new = false;
        }
        self.ranges = ranges;
        let Some(read) = ranges else { return };
        let differs = !model::is_shipped(self.spec.kind, &read);
        if differs && !self.differs {
            notices.notify(Notice::RangesDiffer { motor: self.index, read, shipped: model::shipped(self.spec.kind) });
        }
        self.differs = differs;
    }

    /// The value a parameter is to have, if we set it.
    pub(super) fn wanted(&self, parameter: Parameter) -> Option<Value> {
        match parameter {
            Parameter::ControlMode => Some(Value::Whole(match self.spec.mode {
                MotorMode::Mit { .. } => ControlMode::Mit,
                MotorMode::PositionVelocity => ControlMode::PositionVelocity,
                MotorMode::Velocity => ControlMode::Velocity,
            } as u32)),
            Parameter::Timeout => Some(Value::Whole(self.timeout)),
            _ => None,
        }
    }

    /// The range it reported for positions, if it is one: with another, every position means something else.
    fn range(&self, parameter: Parameter) -> Option<f64> {
        let [p, v, t] = self.read;
        match parameter {
            Parameter::PMax => Some(p),
            Parameter::VMax => Some(v),
            Parameter::TMax => Some(t),
            _ => None,
        }
    }

    /// Asks now and then for what another program may have changed.
    pub(super) fn look_again(&mut self, now: Stamp, send: &mut impl FnMut(CanFrame)) {
        // Not all motors of a bus at once.
        let turn = LOOK_AGAIN / 16 * u32::try_from(self.index % 16).unwrap_or(0);
        if now < *self.look.get_or_insert_with(|| now.after(turn)) {
            return;
        }
        self.look = Some(now.after(LOOK_AGAIN));
        self.looks = (self.looks + 1) % PROBE.len();
        send(parameter::read(self.spec.slave, PROBE.get(self.looks).copied().unwrap_or(Parameter::Timeout)));
    }
}
