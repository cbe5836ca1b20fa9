//! Simulated motors: once armed, each is at its last target.

use std::sync::Arc;

use rapid_core::action::{ActuatorNotice, Arming, Order};
#[cfg(feature = "motors")]
use rapid_core::action::{MAX_ACTION, NoAction};
#[cfg(feature = "motors")]
use rapid_motors::kinematics::{Arm, Solver};
use rapid_registry::{CanProtocol, CanSpec, MOTOR_CHANNELS};
use tokio::sync::mpsc;

use crate::driver::DriverError;

/// Queue length for notices.
const NOTICES: usize = 16;

#[derive(Debug, Default)]
pub(in crate::driver) struct Joints {
    positions: Vec<f64>,
    is_armed: bool,
    has_moved: bool,
    notices: Option<mpsc::Sender<ActuatorNotice>>,
    /// Names of the emergency stops to which orders refer.
    stops: Arc<[Arc<str>]>,
    /// The arm that they move, if actions are poses of its tip.
    #[cfg(feature = "motors")]
    arm: Option<(Arm, Solver)>,
}

impl Joints {
    /// `count` motors, disarmed.
    pub(super) fn new(count: usize) -> Self {
        Self { positions: vec![0.0; count], ..Self::default() }
    }

    /// The motors of an adapter.
    ///
    /// # Errors
    /// When the description of their arm does not fit.
    #[cfg_attr(not(feature = "motors"), expect(clippy::unnecessary_wraps, reason = "the same as with motors"))]
    pub(super) fn from_spec(can: &CanSpec) -> Result<Self, DriverError> {
        let CanProtocol::Damiao(motors) = &can.protocol else { return Ok(Self::default()) };
        let joints = Self::new(motors.motors.len());
        #[cfg(feature = "motors")]
        if let Some(effector) = &motors.effector {
            let arm = Arm::open(effector, &motors.motors).map_err(|error| DriverError::Fatal(error.to_string()))?;
            let solver = arm.solver();
            return Ok(Self { arm: Some((arm, solver)), ..joints });
        }
        Ok(joints)
    }

    pub(super) const fn count(&self) -> usize {
        self.positions.len()
    }

    /// Takes an action; false if it does not fit these motors.
    pub(super) fn command(&mut self, target: &[f64]) -> bool {
        #[cfg(feature = "motors")]
        if let Some((_, solver)) = &mut self.arm {
            let targets = solver.targets(target, &self.positions);
            if self.is_armed
                && let Ok(targets) = targets
            {
                self.positions.iter_mut().zip(targets).for_each(|(position, target)| *position = target);
                self.has_moved = true;
            }
            return targets != Err(NoAction::Length);
        }
        if self.positions.is_empty() || self.positions.len() != target.len() {
            return false;
        }
        if self.is_armed {
            self.positions.copy_from_slice(target);
            self.has_moved = true;
        }
        true
    }

    pub(in crate::driver) fn name_stops(&mut self, stops: &Arc<[Arc<str>]>) {
        self.stops = Arc::clone(stops);
    }

    pub(in crate::driver) fn order(&mut self, order: Order) {
        if self.positions.is_empty() {
            return;
        }
        let was_armed = std::mem::replace(&mut self.is_armed, matches!(order, Order::Arm | Order::ArmBack));
        let (arming, text) = match order {
            Order::Arm | Order::ArmBack => (Arming::Armed, "simulated motors follow actions".to_owned()),
            Order::Disarm => (Arming::Disarmed, "simulated motors are disabled".to_owned()),
            Order::Emergency(_) if !was_armed => return,
            Order::Emergency(trip) => {
                (Arming::Faulted, format!("{}: simulated motors are stopped", trip.text(&self.stops)))
            }
        };
        if let Some(notices) = &self.notices {
            // If the queue is closed, its reader has ended.
            let _ = notices.try_send(ActuatorNotice { arming, text, is_problem: arming == Arming::Faulted });
        }
    }

    /// The results of orders from now on.
    pub(in crate::driver) fn notices(&mut self) -> mpsc::Receiver<ActuatorNotice> {
        let (notices, receiver) = mpsc::channel(NOTICES);
        self.notices = Some(notices);
        receiver
    }

    /// Writes each position before the motor's other values in a sample, once there was a target; and behind them the pose
    /// of the tip of their arm.
    pub(super) fn write(&self, payload: &mut [u8]) {
        let motors = payload.chunks_exact_mut(8 * MOTOR_CHANNELS).zip(&self.positions);
        for (motor, position) in motors.filter(|_| self.has_moved) {
            if let Some((place, _)) = motor.split_first_chunk_mut() {
                *place = position.to_le_bytes();
            }
        }
        self.write_tip(payload);
    }

    #[cfg(not(feature = "motors"))]
    #[expect(clippy::unused_self, reason = "the same as with motors")]
    fn write_tip(&self, _: &mut [u8]) {}

    #[cfg(feature = "motors")]
    fn write_tip(&self, payload: &mut [u8]) {
        let Some((arm, _)) = &self.arm else { return };
        let (mut motors, mut tip) = ([0.0; MAX_ACTION], [0.0; MAX_ACTION]);
        let count = self.positions.len() * MOTOR_CHANNELS;
        for (number, bytes) in motors.iter_mut().zip(payload.as_chunks().0).take(count) {
            *number = f64::from_le_bytes(*bytes);
        }
        arm.state(&motors, &mut tip);
        for (bytes, number) in payload.as_chunks_mut().0.iter_mut().skip(count).zip(tip).take(arm.numbers()) {
            *bytes = number.to_le_bytes();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn joints_move_only_when_armed() {
        let mut joints = Joints::new(2);
        let mut notices = joints.notices();
        let mut payload = [0; 2 * 8 * MOTOR_CHANNELS];
        let first = |payload: &[u8]| f64::from_le_bytes(payload[..8].try_into().expect("8 bytes"));
        assert!(joints.command(&[1.0, 2.0]) && !joints.command(&[1.0]));
        joints.write(&mut payload);
        assert!(first(&payload).abs() < f64::EPSILON, "not armed");
        joints.order(Order::Arm);
        assert_eq!(notices.try_recv().map(|notice| notice.arming), Ok(Arming::Armed));
        assert!(joints.command(&[1.0, 2.0]));
        joints.write(&mut payload);
        assert!((first(&payload) - 1.0).abs() < f64::EPSILON);
        joints.order(Order::Disarm);
        assert!(joints.command(&[3.0, 2.0]));
        joints.write(&mut payload);
        assert!((first(&payload) - 1.0).abs() < f64::EPSILON, "disarmed");
    }

    #[test]
    fn an_emergency_stop_is_reported_if_something_moved() {
        let mut joints = Joints::new(1);
        let mut notices = joints.notices();
        joints.name_stops(&["pendant".into()].into());
        let trip = Order::Emergency(rapid_core::action::Trip { stop: 0, is_lost: true });
        joints.order(trip);
        assert!(notices.try_recv().is_err());
        joints.order(Order::Arm);
        joints.order(trip);
        assert_eq!(notices.try_recv().map(|notice| notice.arming), Ok(Arming::Armed));
        let notice = notices.try_recv().expect("a notice");
        assert_eq!((notice.arming, notice.is_problem), (Arming::Faulted, true));
        assert_eq!(notice.text, "emergency stop pendant lost: simulated motors are stopped");
    }
}
