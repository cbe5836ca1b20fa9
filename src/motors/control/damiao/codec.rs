//! Frames that command a motor, and its answers.
//!
//! Format: the public drivers `DM_CAN.py` and `damiao.h`, which agree; the codes of a motor's status are
//! those of the maker's manual. What the drivers compute is pinned by `tests/golden/damiao.json`.
//!
//! Invariant: a value beyond a range is clamped and never wraps; one that is not finite is not sent.
//! Invariant: a MIT frame is never mistaken for a state command, whose seven bytes 0xff would be a MIT command with
//! every value at its upper end.

use std::fmt;

use thiserror::Error;

use crate::control::can::CanFrame;

/// Highest stiffness of a MIT frame, Nm/rad.
pub const KP_MAX: f64 = 500.0;
/// Highest damping of a MIT frame, Nm s/rad.
pub const KD_MAX: f64 = 5.0;
/// Added to a motor's id in position-velocity mode.
const POSITION_VELOCITY: u16 = 0x100;
/// Added to a motor's id in velocity mode.
const VELOCITY: u16 = 0x200;

/// Share of a quantum: far more than the error of a 64-bit float, far less than a motor resolves.
const HAIR: f64 = 1e-6;

/// A value of a command is infinite or not a number.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
#[error("a command to a motor holds a value that is not a finite number")]
pub struct NotFinite;

/// The ranges that a motor encodes: its parameters PMAX, VMAX and TMAX, each symmetric around 0.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ranges {
    position: f64,
    velocity: f64,
    torque: f64,
}

impl Ranges {
    /// `None` unless each is finite and above 0.
    pub fn new(position: f64, velocity: f64, torque: f64) -> Option<Self> {
        let usable = |end: f64| end.is_finite() && end > 0.0;
        [position, velocity, torque].into_iter().all(usable).then_some(Self { position, velocity, torque })
    }

    /// PMAX, rad.
    pub const fn position(&self) -> f64 {
        self.position
    }

    /// VMAX, rad/s.
    pub const fn velocity(&self) -> f64 {
        self.velocity
    }

    /// TMAX, Nm.
    pub const fn torque(&self) -> f64 {
        self.torque
    }
}

/// A command of MIT mode: torque = `kp` (`q` - position) + `kd` (`dq` - velocity) + `tau`.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Mit {
    /// Stiffness, Nm/rad, `0..=500`.
    pub kp: f64,
    /// Damping, Nm s/rad, `0..=5`.
    pub kd: f64,
    /// Position, rad.
    pub q: f64,
    /// Velocity, rad/s.
    pub dq: f64,
    /// Torque, Nm.
    pub tau: f64,
}

/// The frame of a command of MIT mode.
///
/// # Errors
/// A value is not finite.
pub fn mit(slave: u16, command: &Mit, ranges: &Ranges) -> Result<CanFrame, NotFinite> {
    let q = count(command.q, -ranges.position, ranges.position, 16)?;
    let dq = count(command.dq, -ranges.velocity, ranges.velocity, 12)?;
    let kp = count(command.kp, 0.0, KP_MAX, 12)?;
    let kd = count(command.kd, 0.0, KD_MAX, 12)?;
    let tau = count(command.tau, -ranges.torque, ranges.torque, 12)?;
    let [q1, q0] = q.to_be_bytes();
    let [_, kp0] = kp.to_be_bytes();
    let [tau1, tau0] = tau.to_be_bytes();
    let byte = |bits: u16| bits.to_be_bytes()[1];
    let mut data =
        [q1, q0, byte(dq >> 4), byte((dq & 0xf) << 4 | kp >> 8), kp0, byte(kd >> 4), byte(kd << 4) | tau1, tau0];
    if data.starts_with(&STATE_COMMAND) {
        // One quantum less of damping.
        data[6] &= 0xef;
    }
    Ok(CanFrame::standard(slave, data))
}

/// The frame of position-velocity mode: position in rad, and the highest speed on the way, rad/s.
///
/// # Errors
/// A value is not finite, as a 32-bit float.
pub fn position_velocity(slave: u16, q: f64, speed: f64) -> Result<CanFrame, NotFinite> {
    Ok(CanFrame::standard(slave.saturating_add(POSITION_VELOCITY), join(single(q)?, single(speed)?)))
}

/// The frame of velocity mode, rad/s. It has eight bytes like all others, the last four zero.
///
/// # Errors
/// The value is not finite, as a 32-bit float.
pub fn velocity(slave: u16, dq: f64) -> Result<CanFrame, NotFinite> {
    Ok(CanFrame::standard(slave.saturating_add(VELOCITY), join(single(dq)?, [0; 4])))
}

/// A command that changes the state of a motor and does not move it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StateCommand {
    /// Turn on.
    Enable,
    /// Turn off.
    Disable,
    /// The present position is 0 from now on.
    SetZero,
    /// Forget a latched fault.
    ClearError,
}

/// How the data of a state command begins.
const STATE_COMMAND: [u8; 7] = [0xff; 7];

impl StateCommand {
    /// Its frame.
    pub const fn frame(self, slave: u16) -> CanFrame {
        let last = match self {
            Self::Enable => 0xfc,
            Self::Disable => 0xfd,
            Self::SetZero => 0xfe,
            Self::ClearError => 0xfb,
        };
        CanFrame::standard(slave, [0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, last])
    }
}

/// The state that a motor reports: the ERR of its feedback.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MotorStatus {
    /// 0.
    Disabled,
    /// 1.
    Enabled,
    /// 8, latched.
    OverVoltage,
    /// 9, latched.
    UnderVoltage,
    /// 10, latched.
    OverCurrent,
    /// 11, latched: the transistors.
    MosOverTemperature,
    /// 12, latched: the winding.
    RotorOverTemperature,
    /// 13, latched: no frame for the time of its parameter TIMEOUT.
    CommunicationLost,
    /// 14, latched.
    Overload,
    /// Another one of `0..=15`.
    Other(u8),
}

impl MotorStatus {
    /// Of the low four bits of `code`.
    pub const fn from_code(code: u8) -> Self {
        match code & 0xf {
            0x0 => Self::Disabled,
            0x1 => Self::Enabled,
            0x8 => Self::OverVoltage,
            0x9 => Self::UnderVoltage,
            0xa => Self::OverCurrent,
            0xb => Self::MosOverTemperature,
            0xc => Self::RotorOverTemperature,
            0xd => Self::CommunicationLost,
            0xe => Self::Overload,
            other => Self::Other(other),
        }
    }

    /// As it is in a frame, `0..=15`.
    pub const fn code(self) -> u8 {
        match self {
            Self::Disabled => 0x0,
            Self::Enabled => 0x1,
            Self::OverVoltage => 0x8,
            Self::UnderVoltage => 0x9,
            Self::OverCurrent => 0xa,
            Self::MosOverTemperature => 0xb,
            Self::RotorOverTemperature => 0xc,
            Self::CommunicationLost => 0xd,
            Self::Overload => 0xe,
            Self::Other(code) => code & 0xf,
        }
    }

    /// A fault that the motor latched.
    pub const fn is_fault(self) -> bool {
        self.code() >= 8
    }
}

impl fmt::Display for MotorStatus {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Disabled => "disabled",
            Self::Enabled => "enabled",
            Self::OverVoltage => "over-voltage",
            Self::UnderVoltage => "under-voltage",
            Self::OverCurrent => "over-current",
            Self::MosOverTemperature => "transistors too hot",
            Self::RotorOverTemperature => "winding too hot",
            Self::CommunicationLost => "no command in time",
            Self::Overload => "overload",
            Self::Other(code) => return write!(f, "status {code:#x}"),
        })
    }
}

/// What a motor answers to every command and to a refresh.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Feedback {
    /// The low four bits of the motor's id.
    pub id: u8,
    /// ERR.
    pub status: MotorStatus,
    /// Position, rad.
    pub q: f64,
    /// Velocity, rad/s.
    pub dq: f64,
    /// Torque, Nm.
    pub tau: f64,
    /// Temperature of the transistors, °C.
    pub mos: u8,
    /// Temperature of the winding, °C.
    pub rotor: u8,
}

impl Feedback {
    /// Reads a frame that a motor sent; `None` unless it is a data frame of eight bytes with an 11-bit id.
    pub fn decode(frame: &CanFrame, ranges: &Ranges) -> Option<Self> {
        let [d0, d1, d2, d3, d4, d5, mos, rotor] = data_of(frame)?;
        let wide = |high: u8, low: u8| u16::from_be_bytes([high, low]);
        Some(Self {
            id: d0 & 0xf,
            status: MotorStatus::from_code(d0 >> 4),
            q: value(wide(d1, d2), ranges.position, 16),
            dq: value(wide(d3, d4) >> 4, ranges.velocity, 12),
            tau: value(wide(d4 & 0xf, d5), ranges.torque, 12),
            mos,
            rotor,
        })
    }

    /// As a motor would send it from `master`; `None` if a value is not finite. For simulated motors.
    pub fn encode(&self, master: u16, ranges: &Ranges) -> Option<CanFrame> {
        let q = count(self.q, -ranges.position, ranges.position, 16).ok()?;
        let dq = count(self.dq, -ranges.velocity, ranges.velocity, 12).ok()?;
        let tau = count(self.tau, -ranges.torque, ranges.torque, 12).ok()?;
        let [q1, q0] = q.to_be_bytes();
        let [dq1, dq0] = (dq << 4).to_be_bytes();
        let [tau1, tau0] = tau.to_be_bytes();
        let head = self.status.code() << 4 | self.id & 0xf;
        Some(CanFrame::standard(master, [head, q1, q0, dq1, dq0 | tau1, tau0, self.mos, self.rotor]))
    }
}

/// The data of a frame as motors send and take it: eight bytes, under an 11-bit identifier.
pub fn data_of(frame: &CanFrame) -> Option<[u8; 8]> {
    (!frame.extended && !frame.remote && !frame.error && frame.len == 8).then_some(frame.data)
}

/// `value` in quanta above `low`; `high` is 2^bits - 1 quanta.
fn count(value: f64, low: f64, high: f64, bits: u32) -> Result<u16, NotFinite> {
    if !value.is_finite() {
        return Err(NotFinite);
    }
    let quanta = f64::from((1_u32 << bits) - 1);
    // A position that was read is sent as the same count, although rounding took a hair off it.
    let counted = (value.clamp(low, high) - low) / (high - low) * quanta + HAIR;
    // In `0..=quanta`, cut off as the public drivers do.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    Ok(counted as u16)
}

/// The value `count` quanta above `-end`.
fn value(count: u16, end: f64, bits: u32) -> f64 {
    let quanta = f64::from((1_u32 << bits) - 1);
    f64::from(count) / quanta * (2.0 * end) - end
}

fn single(value: f64) -> Result<[u8; 4], NotFinite> {
    #[allow(clippy::cast_possible_truncation)]
    let value = value as f32;
    if value.is_finite() { Ok(value.to_le_bytes()) } else { Err(NotFinite) }
}

fn join(first: [u8; 4], second: [u8; 4]) -> [u8; 8] {
    (u64::from(u32::from_le_bytes(first)) | u64::from(u32::from_le_bytes(second)) << 32).to_le_bytes()
}

#[cfg(test)]
mod tests;
