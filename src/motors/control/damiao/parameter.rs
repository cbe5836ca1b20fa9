//! A motor's parameters: reading, writing and keeping them, over the id 0x7ff.
//!
//! A reply has the id of feedback. It looks like feedback of a motor at one of the first positions of its range (two of
//! 65,536) that turns backwards at more than a third of its speed range. While parameters are read, such a frame counts
//! as a reply: a reply taken for feedback would invent a position; feedback taken for a reply is one lost of hundreds a
//! second.

use std::fmt;

use crate::control::can::CanFrame;

use super::codec;

/// The id that all motors listen to.
const BROADCAST: u16 = 0x7ff;
const READ: u8 = 0x33;
const WRITE: u8 = 0x55;
const SAVE: u8 = 0xaa;
const REFRESH: u8 = 0xcc;
/// One unit of [`Parameter::Timeout`], µs.
pub const TIMEOUT_UNIT_US: u32 = 50;

/// A parameter, by its number (RID).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Parameter {
    /// The id the motor answers with.
    MasterId = 7,
    /// The id it listens to.
    SlaveId = 8,
    /// Without a frame for this long an enabled motor stops and latches
    /// [`codec::MotorStatus::CommunicationLost`]; in [`TIMEOUT_UNIT_US`], 0 for never.
    Timeout = 9,
    /// See [`ControlMode`].
    ControlMode = 10,
    /// Version of its firmware.
    SoftwareVersion = 14,
    /// Serial number.
    SerialNumber = 15,
    /// Range of position, rad.
    PMax = 21,
    /// Range of velocity, rad/s.
    VMax = 22,
    /// Range of torque, Nm.
    TMax = 23,
}

/// All parameters that are read here.
const ALL: [Parameter; 9] = [
    Parameter::MasterId,
    Parameter::SlaveId,
    Parameter::Timeout,
    Parameter::ControlMode,
    Parameter::SoftwareVersion,
    Parameter::SerialNumber,
    Parameter::PMax,
    Parameter::VMax,
    Parameter::TMax,
];

impl Parameter {
    /// Its number.
    pub const fn rid(self) -> u8 {
        self as u8
    }

    /// The parameter of this number, if it is listed here.
    pub fn from_rid(rid: u8) -> Option<Self> {
        ALL.into_iter().find(|parameter| parameter.rid() == rid)
    }

    /// Is it a 32-bit float? The others are unsigned whole numbers of 32 bits.
    pub const fn is_float(self) -> bool {
        matches!(self, Self::PMax | Self::VMax | Self::TMax)
    }
}

impl fmt::Display for Parameter {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::MasterId => "MST_ID",
            Self::SlaveId => "ESC_ID",
            Self::Timeout => "TIMEOUT",
            Self::ControlMode => "CTRL_MODE",
            Self::SoftwareVersion => "sw_ver",
            Self::SerialNumber => "SN",
            Self::PMax => "PMAX",
            Self::VMax => "VMAX",
            Self::TMax => "TMAX",
        })
    }
}

/// Values of [`Parameter::ControlMode`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u32)]
pub enum ControlMode {
    /// Impedance.
    Mit = 1,
    /// Position, with a highest velocity.
    PositionVelocity = 2,
    /// Velocity.
    Velocity = 3,
}

/// The value of a parameter.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Value {
    /// A whole number.
    Whole(u32),
    /// A float, of any bits.
    Float(f32),
}

impl Value {
    /// As it is in a frame.
    pub const fn to_le_bytes(self) -> [u8; 4] {
        match self {
            Self::Whole(value) => value.to_le_bytes(),
            Self::Float(value) => value.to_le_bytes(),
        }
    }

    /// As a number.
    pub fn number(self) -> f64 {
        match self {
            Self::Whole(value) => f64::from(value),
            Self::Float(value) => f64::from(value),
        }
    }
}

impl fmt::Display for Value {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Whole(value) => value.fmt(f),
            Self::Float(value) => value.fmt(f),
        }
    }
}

/// Asks a motor for a parameter.
pub const fn read(slave: u16, parameter: Parameter) -> CanFrame {
    request(slave, READ, parameter.rid(), [0; 4])
}

/// Sets a parameter until the motor loses power. A motor accepts this only while disabled.
pub const fn write(slave: u16, parameter: Parameter, value: Value) -> CanFrame {
    request(slave, WRITE, parameter.rid(), value.to_le_bytes())
}

/// Asks a motor for its feedback, and for nothing else.
pub const fn refresh(slave: u16) -> CanFrame {
    request(slave, REFRESH, 0, [0; 4])
}

/// The motor whose parameters this frame sets or saves, if it is a request to.
pub const fn is_write(frame: &CanFrame) -> Option<u16> {
    match frame.data {
        [low, high, WRITE | SAVE, ..] if frame.id == BROADCAST as u32 && !frame.extended => {
            Some(u16::from_le_bytes([low, high]))
        }
        _ => None,
    }
}

const fn request(slave: u16, verb: u8, rid: u8, value: [u8; 4]) -> CanFrame {
    let [low, high] = slave.to_le_bytes();
    let [a, b, c, d] = value;
    CanFrame::standard(BROADCAST, [low, high, verb, rid, a, b, c, d])
}

/// A motor's answer: the value of a parameter after it was read or written.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reply {
    /// The motor.
    pub slave: u16,
    /// It was written, not read.
    pub written: bool,
    /// Which one.
    pub parameter: Parameter,
    /// Its value.
    pub value: Value,
}

impl Reply {
    /// Reads a frame that a motor sent; `None` unless it is a reply about a parameter listed here.
    pub fn decode(frame: &CanFrame) -> Option<Self> {
        let [low, high, verb @ (READ | WRITE), rid, value @ ..] = codec::data_of(frame)? else { return None };
        let parameter = Parameter::from_rid(rid)?;
        let slave = u16::from_le_bytes([low, high]);
        (slave <= BROADCAST).then_some(Self {
            slave,
            written: verb == WRITE,
            parameter,
            value: if parameter.is_float() {
                Value::Float(f32::from_le_bytes(value))
            } else {
                Value::Whole(u32::from_le_bytes(value))
            },
        })
    }

    /// As a motor would send it from `master`. For simulated motors.
    pub const fn encode(&self, master: u16) -> CanFrame {
        let verb = if self.written { WRITE } else { READ };
        let request = request(self.slave, verb, self.parameter.rid(), self.value.to_le_bytes());
        CanFrame::standard(master, request.data)
    }
}

#[cfg(test)]
mod tests;
