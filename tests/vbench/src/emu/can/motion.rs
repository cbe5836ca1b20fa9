//! A motor's numbers: the encoding of values in its frames, and its motion.
//!
//! Invariant: pure; positions in rad, velocities in rad/s, torques in Nm, times in s.

/// Largest stiffness of an MIT frame.
pub const KP_MAX: f64 = 500.0;
/// Largest damping of an MIT frame.
pub const KD_MAX: f64 = 5.0;
/// Time constant of a motor's motion.
const LAG_S: f64 = 0.03;

/// A command of the MIT mode.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mit {
    /// Target position.
    pub position: f64,
    /// Target velocity.
    pub velocity: f64,
    /// Stiffness.
    pub kp: f64,
    /// Damping.
    pub kd: f64,
    /// Additional torque.
    pub torque: f64,
}

impl Mit {
    /// Reads the eight bytes; `limits` are PMAX, VMAX and TMAX.
    pub fn decode(bytes: [u8; 8], limits: [f64; 3]) -> Self {
        let [b0, b1, b2, b3, b4, b5, b6, b7] = bytes.map(u32::from);
        let [pmax, vmax, tmax] = limits;
        Self {
            position: from_unsigned(b0 << 8 | b1, pmax, 16),
            velocity: from_unsigned(b2 << 4 | b3 >> 4, vmax, 12),
            kp: f64::from((b3 & 0xf) << 8 | b4) * KP_MAX / 4095.0,
            kd: f64::from(b5 << 4 | b6 >> 4) * KD_MAX / 4095.0,
            torque: from_unsigned((b6 & 0xf) << 8 | b7, tmax, 12),
        }
    }
}

/// A value within ±`limit` as a number of this many bits, truncated as in the vendor's code.
pub fn to_unsigned(value: f64, limit: f64, bits: u32) -> u32 {
    let top = f64::from((1_u32 << bits) - 1);
    // The format truncates; the clamp keeps it within the bits.
    ((value + limit) / (2.0 * limit) * top).clamp(0.0, top) as u32
}

/// The value of a number of this many bits.
pub fn from_unsigned(value: u32, limit: f64, bits: u32) -> f64 {
    f64::from(value) / f64::from((1_u32 << bits) - 1) * 2.0 * limit - limit
}

/// Position and velocity after `seconds` of moving to `goal`: at full speed while the lag requires more, then decaying.
pub fn reach(from: f64, goal: f64, fastest: f64, seconds: f64) -> (f64, f64) {
    let towards = (goal - from).signum();
    let distance = (goal - from).abs();
    let knee = fastest * LAG_S;
    let straight_s = if fastest > 0.0 { ((distance - knee) / fastest).max(0.0) } else { f64::INFINITY };
    if seconds < straight_s {
        return (from + towards * fastest * seconds, towards * fastest);
    }
    let left = distance.min(knee) * (-(seconds - straight_s) / LAG_S).exp();
    (goal - towards * left, towards * left / LAG_S)
}

/// Movement and velocity after `seconds`, while the velocity approaches `wanted`.
pub fn turn(velocity: f64, wanted: f64, seconds: f64) -> (f64, f64) {
    let fading = (-seconds / LAG_S).exp();
    let moved = wanted * seconds + (velocity - wanted) * LAG_S * (1.0 - fading);
    (moved, wanted + (velocity - wanted) * fading)
}
