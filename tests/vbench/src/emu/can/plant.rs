//! The load of a motor: an inertia with friction, load torque and end stops, moved by the torque of the motor's loops.
//!
//! Invariant: time advances in steps of `STEP_NS`, so the motion does not depend on how often it is queried.

use super::motion::Mit;

/// Length of a step, ns: a fifth of the fastest time constant below.
pub const STEP_NS: u64 = 100_000;
/// Maximum number of steps made up for: ten seconds.
pub const MOST_STEPS: u64 = 100_000;
/// Time constant of the motor's own velocity loop, s.
const VELOCITY_LOOP_S: f64 = 0.001;
/// Time constant of the motor's own position loop, s.
const POSITION_LOOP_S: f64 = 0.02;

/// The load of the motor.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Body {
    /// Moment of inertia, kg m².
    pub inertia: f64,
    /// Friction that does not depend on the speed, Nm.
    pub coulomb: f64,
    /// Friction per speed, Nm s/rad.
    pub viscous: f64,
    /// Pulls towards negative angles, Nm.
    pub load: f64,
    /// The load is a weight on a lever that is horizontal at angle 0: it varies with the cosine.
    pub is_lever: bool,
    /// End stops, rad.
    pub ends: Option<[f64; 2]>,
}

impl Default for Body {
    /// A forearm's joint without a load.
    fn default() -> Self {
        Self { inertia: 0.02, coulomb: 0.02, viscous: 0.02, load: 0.0, is_lever: false, ends: None }
    }
}

/// The command to the motor's loops.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Drive {
    /// No torque.
    Off,
    /// Stiffness, damping and torque.
    Mit(Mit),
    /// A position, and the speed limit on the way there.
    Position {
        /// rad.
        position: f64,
        /// rad/s.
        fastest: f64,
    },
    /// A velocity, rad/s.
    Velocity(f64),
}

/// Position by the motor's own encoder, and its motion.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Movement {
    /// rad.
    pub position: f64,
    /// rad/s.
    pub velocity: f64,
    /// Torque of the motor, Nm.
    pub torque: f64,
}

/// Defects of a joint.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Trouble {
    /// The motor's reported position minus the true angle, rad.
    pub offset: f64,
    /// The encoder is stuck at this position and velocity: the motor reports it, and its loops work with it.
    pub frozen: Option<[f64; 2]>,
    /// It does not turn, whatever the torque.
    pub is_blocked: bool,
}

impl Drive {
    /// The motor's torque, Nm, with its encoder at `position` and `velocity`.
    fn torque(self, [position, velocity]: [f64; 2], inertia: f64, tmax: f64) -> f64 {
        let turn = |wanted: f64| inertia / VELOCITY_LOOP_S * (wanted - velocity);
        let torque = match self {
            Self::Off => 0.0,
            Self::Mit(mit) => mit.kp * (mit.position - position) + mit.kd * (mit.velocity - velocity) + mit.torque,
            Self::Position { position: goal, fastest } => {
                turn(((goal - position) / POSITION_LOOP_S).clamp(-fastest, fastest))
            }
            Self::Velocity(wanted) => turn(wanted),
        };
        torque.clamp(-tmax, tmax)
    }
}

impl Body {
    /// Advances this many steps.
    pub fn pass(&self, steps: u64, movement: &mut Movement, drive: Drive, trouble: &Trouble, tmax: f64) {
        for _ in 0..steps.min(MOST_STEPS) {
            let encoder = trouble.frozen.unwrap_or([movement.position, movement.velocity]);
            movement.torque = drive.torque(encoder, self.inertia, tmax);
            if trouble.is_blocked {
                movement.velocity = 0.0;
            } else {
                self.step(movement, trouble.offset);
            }
        }
    }

    fn step(&self, movement: &mut Movement, offset: f64) {
        let seconds = STEP_NS as f64 / 1e9;
        let angle = movement.position - offset;
        let load = if self.is_lever { self.load * angle.cos() } else { self.load };
        let pushed = movement.torque - load;
        let before = movement.velocity;
        movement.velocity = if before == 0.0 {
            // It sticks until the torque exceeds friction.
            pushed.signum() * (pushed.abs() - self.coulomb).max(0.0) / self.inertia * seconds
        } else {
            let friction = self.coulomb * before.signum() + self.viscous * before;
            let after = before + (pushed - friction) / self.inertia * seconds;
            // Friction ends a motion and never starts one.
            if after * before < 0.0 && pushed.abs() <= self.coulomb { 0.0 } else { after }
        };
        movement.position += movement.velocity * seconds;
        let Some([low, high]) = self.ends else { return };
        let angle = movement.position - offset;
        if angle < low || angle > high {
            movement.position = angle.clamp(low, high) + offset;
            movement.velocity = 0.0;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const REST: Movement = Movement { position: 0.0, velocity: 0.0, torque: 0.0 };
    const SECOND: u64 = 10_000;

    fn spring(position: f64) -> Drive {
        Drive::Mit(Mit { position, velocity: 0.0, kp: 20.0, kd: 1.0, torque: 0.0 })
    }

    fn after(body: Body, drive: Drive, trouble: Trouble, steps: u64) -> Movement {
        let mut movement = REST;
        body.pass(steps, &mut movement, drive, &trouble, 10.0);
        movement
    }

    #[test]
    fn a_joint_falls_as_a_body_does_and_rests_at_its_end() {
        let free = Body { coulomb: 0.0, viscous: 0.0, load: 1.5, ..Body::default() };
        let fallen = after(free, Drive::Off, Trouble::default(), 1_000);
        // Half of 75 rad/s² times the square of 0.1 s.
        assert!((fallen.position + 0.375).abs() < 0.001 && (fallen.velocity + 7.5).abs() < 0.01, "{fallen:?}");
        let ended = after(Body { ends: Some([-0.5, 0.5]), ..free }, Drive::Off, Trouble::default(), SECOND);
        assert_eq!((ended.position, ended.velocity), (-0.5, 0.0));
        // A lever that hangs down stays there.
        let lever = Body { is_lever: true, viscous: 0.2, ..free };
        let hanging = after(lever, Drive::Off, Trouble::default(), 10 * SECOND);
        assert!((hanging.position + std::f64::consts::FRAC_PI_2).abs() < 0.01, "{hanging:?}");
    }

    #[test]
    fn friction_resists_smaller_forces() {
        let body = |load| Body { coulomb: 0.3, load, ..Body::default() };
        assert_eq!(after(body(0.29), Drive::Off, Trouble::default(), SECOND), REST);
        assert!(after(body(0.31), Drive::Off, Trouble::default(), SECOND).position < -0.05);
    }

    #[test]
    fn a_spring_sags_under_its_load_and_the_motors_own_loops_hardly() {
        let loaded = Body { load: 1.5, coulomb: 0.0, ..Body::default() };
        let sagged = after(loaded, spring(0.0), Trouble::default(), 3 * SECOND);
        assert!((sagged.position + 1.5 / 20.0).abs() < 0.001 && (sagged.torque - 1.5).abs() < 0.01, "{sagged:?}");
        let driven = after(loaded, Drive::Position { position: 1.0, fastest: 2.0 }, Trouble::default(), SECOND);
        assert!((driven.position - 1.0).abs() < 0.01 && (driven.torque - 1.5).abs() < 0.01, "{driven:?}");
        let turned = after(loaded, Drive::Velocity(2.0), Trouble::default(), SECOND);
        assert!((turned.velocity - 2.0).abs() < 0.1, "{turned:?}");
    }

    #[test]
    fn no_loop_has_more_torque_than_its_motor() {
        let loaded = Body { load: 12.0, viscous: 0.5, ..Body::default() };
        for drive in [spring(9.0), Drive::Position { position: 9.0, fastest: 5.0 }, Drive::Velocity(5.0)] {
            let moved = after(loaded, drive, Trouble::default(), SECOND);
            assert!(moved.torque <= 10.0 && moved.velocity < -3.0, "{drive:?}: {moved:?}");
        }
    }

    #[test]
    fn a_blocked_joint_stays_and_a_frozen_encoder_drives_it_off() {
        let blocked = after(Body::default(), spring(0.3), Trouble { is_blocked: true, ..Trouble::default() }, SECOND);
        assert_eq!((blocked.position, blocked.velocity, blocked.torque), (0.0, 0.0, 6.0));
        let frozen = Trouble { frozen: Some([0.0, 0.0]), ..Trouble::default() };
        let gone = after(Body::default(), spring(0.3), frozen, SECOND);
        assert!(gone.position > 3.0, "{gone:?}: its loop sees no movement");
    }

    #[test]
    fn two_short_steps_equal_one_long_step() {
        let lever = Body { load: 1.0, is_lever: true, ..Body::default() };
        let mut twice = after(lever, spring(0.7), Trouble::default(), 333);
        lever.pass(667, &mut twice, spring(0.7), &Trouble::default(), 10.0);
        assert_eq!(twice, after(lever, spring(0.7), Trouble::default(), 1_000));
    }
}
