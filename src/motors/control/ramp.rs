//! A commanded position that starts, speeds up and stops softly.
//!
//! Speed and acceleration are limited; the command brakes in time to stop at the target and overshoots it only if the
//! target reverses. After an arm the maximum speed grows from 0 over the soft start. Jerk is not limited.
//!
//! Invariant: a command never changes faster than [`Limits`] allow, whatever the acceleration.

use std::time::Duration;

use super::limits::Limits;

/// See the module's comment.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ramp {
    /// rad/s²; infinite means no limit.
    acceleration: f64,
    soft_start: Duration,
    /// How fast the command changes, rad/s.
    speed: f64,
    /// How long it has moved since the start.
    moved: Duration,
}

impl Ramp {
    /// With an acceleration in rad/s², above 0, and the time in which the highest speed is reached after a start.
    pub const fn new(acceleration: f64, soft_start: Duration) -> Self {
        Self { acceleration, soft_start, speed: 0.0, moved: Duration::ZERO }
    }

    /// Rests, and starts softly from here.
    pub const fn restart(&mut self) {
        (self.speed, self.moved) = (0.0, Duration::ZERO);
    }

    /// Moves the previous command towards `wanted`, in the elapsed time.
    pub fn next(&self, limits: &Limits, before: f64, wanted: f64, passed: Duration) -> f64 {
        let seconds = passed.as_secs_f64();
        if passed.is_zero() || !(wanted.is_finite() && before.is_finite()) {
            return before;
        }
        let distance = wanted - before;
        let change = self.acceleration * seconds;
        let speed = (distance.abs() / seconds).min(self.stopping(distance.abs(), seconds)).copysign(distance);
        let speed = speed.clamp(self.speed - change, self.speed + change);
        // A target within reach is reached without rounding.
        let next = if (speed * seconds - distance).abs() < 1e-12 { wanted } else { before + speed * seconds };
        limits.slew(before, next, passed.mul_f64(self.share(passed)))
    }

    /// Records a change of the command in the elapsed time; `is_led`: by an action, after the first one since the
    /// start.
    pub fn took(&mut self, change: f64, passed: Duration, is_led: bool) {
        self.speed = if passed.is_zero() { 0.0 } else { change / passed.as_secs_f64() };
        if is_led && (change != 0.0 || !self.moved.is_zero()) {
            self.moved = self.moved.saturating_add(passed);
        }
    }

    /// Where a command at `command` can stop.
    pub fn stops_at(&self, command: f64) -> f64 {
        command + self.speed * self.speed.abs() / (2.0 * self.acceleration)
    }

    /// The highest speed from which the command stops within `distance`, in steps of this many seconds.
    fn stopping(&self, distance: f64, seconds: f64) -> f64 {
        if self.acceleration.is_infinite() {
            return f64::INFINITY;
        }
        let half = self.acceleration * seconds / 2.0;
        (half * half + 2.0 * self.acceleration * distance).sqrt() - half
    }

    /// The share of the maximum speed that the soft start allows.
    fn share(&self, passed: Duration) -> f64 {
        let moved = self.moved.saturating_add(passed);
        if moved >= self.soft_start { 1.0 } else { moved.as_secs_f64() / self.soft_start.as_secs_f64() }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const STEP: Duration = Duration::from_millis(5);

    /// Commands from 0 towards what `wanted` returns, until `steps` are over.
    fn play(ramp: &mut Ramp, limits: &Limits, steps: usize, wanted: impl Fn(usize) -> f64) -> Vec<f64> {
        let mut commands = vec![0.0];
        for step in 0..steps {
            let before = commands[step];
            let next = ramp.next(limits, before, wanted(step), STEP);
            ramp.took(next - before, STEP, true);
            commands.push(next);
        }
        commands
    }

    fn speeds(commands: &[f64]) -> Vec<f64> {
        commands.windows(2).map(|pair| (pair[1] - pair[0]) / STEP.as_secs_f64()).collect()
    }

    #[test]
    fn a_target_is_reached_without_overshoot_and_kept() {
        let limits = Limits::new(-2.0, 2.0, 4.0);
        let mut ramp = Ramp::new(40.0, Duration::ZERO);
        let commands = play(&mut ramp, &limits, 400, |_| 1.5);
        assert!(commands.iter().all(|command| *command <= 1.5));
        assert_eq!(commands.last(), Some(&1.5));
        assert!(speeds(&commands).iter().fold(0.0, |most: f64, speed| most.max(*speed)) > 3.9);
        assert!((ramp.stops_at(1.5) - 1.5).abs() < 1e-9);
    }

    #[test]
    fn the_first_motion_is_slow_and_later_ones_are_not() {
        let limits = Limits::new(-10.0, 10.0, 4.0);
        let mut ramp = Ramp::new(f64::INFINITY, Duration::from_secs(1));
        // It rests for a while first: that is no motion.
        let commands = play(&mut ramp, &limits, 400, |step| if step < 100 { 0.0 } else { 9.0 });
        let speeds = speeds(&commands);
        for (step, speed) in [(99, 0.0), (100, 0.02), (120, 0.42), (200, 2.02), (310, 4.0)] {
            assert!((speeds[step] - speed).abs() < 1e-6, "{step}: {}", speeds[step]);
        }
        ramp.restart();
        assert!(ramp.next(&limits, 0.0, 9.0, STEP) <= 4.0 * 0.005 * 0.005 + 1e-12);
    }

    #[test]
    fn without_time_and_without_a_number_nothing_moves() {
        let limits = Limits::new(-2.0, 2.0, 4.0);
        for acceleration in [40.0, f64::INFINITY] {
            let mut ramp = Ramp::new(acceleration, Duration::from_secs(1));
            ramp.took(0.01, STEP, true);
            for (wanted, passed) in
                [(1.0, Duration::ZERO), (0.5, Duration::ZERO), (f64::NAN, STEP), (f64::INFINITY, STEP)]
            {
                let next = ramp.next(&limits, 0.5, wanted, passed);
                assert_eq!(next.to_bits(), 0.5_f64.to_bits(), "{acceleration} {wanted} {passed:?}");
            }
        }
    }

    proptest! {
        #[test]
        fn speed_and_acceleration_are_limited_whatever_the_target(
            wanted in prop::collection::vec((-3.0..3.0, 1_usize..60), 1..12), slew in 0.1..20.0, share in 1.0..200.0,
            soft in 0_u64..1500,
        ) {
            let limits = Limits::new(-2.0, 2.0, slew);
            let acceleration = slew * share;
            let mut ramp = Ramp::new(acceleration, Duration::from_millis(soft));
            let plan: Vec<f64> = wanted.iter().flat_map(|(to, steps): &(f64, usize)| std::iter::repeat_n(to.clamp(-2.0, 2.0), *steps)).collect();
            let commands = play(&mut ramp, &limits, plan.len(), |step| plan[step]);
            let speeds = speeds(&commands);
            for (step, speed) in speeds.iter().enumerate() {
                prop_assert!(speed.abs() <= slew * (1.0 + 1e-9));
                prop_assert!(commands[step + 1].abs() <= 2.0 + 1e-9);
                let before = if step == 0 { 0.0 } else { speeds[step - 1] };
                // The end of the range stops it at once.
                let stopped = commands[step + 1].abs() >= 2.0 - 1e-9;
                let change = (speed - before).abs();
                prop_assert!(stopped || change <= acceleration * STEP.as_secs_f64() * (1.0 + 1e-6) + 1e-9, "{change}");
            }
            // What is wanted for long enough is reached.
            let last = *plan.last().unwrap();
            let more = play(&mut Ramp::new(acceleration, Duration::ZERO), &limits, 20_000, |_| last);
            prop_assert!((more.last().unwrap() - last).abs() < 1e-9);
        }
    }
}
