//! The return of joints outside their limits, which an operator requests with an arm that drives back.

use rapid_core::time::Stamp;

use super::MotorBus;
use super::motor::Motor;
use super::notice::Notice;

impl MotorBus {
    /// Ends the return once every joint is within its limits.
    pub(super) fn look_for_return(&mut self, now: Stamp) {
        // The return needs no actions, however long it takes.
        self.deadman.arm(now);
        if self.motors.iter().all(Motor::is_back) {
            self.is_returning = false;
            self.hold(now);
            self.notices.notify(Notice::Returned);
        }
    }
}
