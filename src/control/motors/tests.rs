//! The machine against simulated motors.
