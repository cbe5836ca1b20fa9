//! Actions: what a policy, an expert or another program wants an actuator to do next.
//!
//! An action travels as a sample of numbers, like the state of an arm: little-endian 64-bit floats in the
//! order of the actuator's `[device.NAME.action]` table, in its units. Its capture time is the tick of
//! the control grid it is the action of.

/// Topic of actions, on the bus and in recordings.
pub const ACTION_TOPIC: &str = "/action";
/// Numbers in an action, at most.
pub const MAX_ACTION: usize = 64;
