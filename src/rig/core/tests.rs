//! The core under long random sequences of inputs.

mod simulator;
