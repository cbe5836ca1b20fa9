//! The parameters of a Damiao motor: read, written and saved over the bus by register number (RID).
//!
//! Numbers, types and the table of limits as in the vendor's `DM_CAN.py` and LeRobot's `motors/damiao/tables.py`. The
//! unit of TIMEOUT, 50 us, is the one assumed by public drivers; neither of the two sources states it.

use std::time::Duration;

/// Torque and position loop, `CTRL_MODE` 1.
pub const MIT: u32 = 1;
/// Position with a velocity limit, `CTRL_MODE` 2.
pub const POS_VEL: u32 = 2;
/// Velocity, `CTRL_MODE` 3.
pub const VEL: u32 = 3;

const TIMEOUT_UNIT: Duration = Duration::from_micros(50);

/// Factory settings of each type of motor: name, PMAX (rad), VMAX (rad/s), TMAX (Nm).
const TYPES: [(&str, f32, f32, f32); 13] = [
    ("DM3507", 12.5, 30.0, 10.0),
    ("DM4310", 12.5, 30.0, 10.0),
    ("DM4310_48V", 12.5, 50.0, 10.0),
    ("DM4340", 12.5, 8.0, 28.0),
    ("DM4340_48V", 12.5, 10.0, 28.0),
    ("DM6006", 12.5, 45.0, 20.0),
    ("DM8006", 12.5, 45.0, 40.0),
    ("DM8009", 12.5, 45.0, 54.0),
    ("DM10010L", 12.5, 25.0, 200.0),
    ("DM10010", 12.5, 20.0, 200.0),
    ("DMH3510", 12.5, 280.0, 1.0),
    ("DMH6215", 12.5, 45.0, 10.0),
    ("DMG6220", 12.5, 45.0, 10.0),
];

/// A type of motor, by its index in the table.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Type(usize);

impl Type {
    /// The type with this name.
    pub fn named(name: &str) -> Option<Self> {
        TYPES.iter().position(|(known, ..)| *known == name).map(Self)
    }

    /// Its name.
    pub fn name(self) -> &'static str {
        TYPES[self.0].0
    }
}

/// One motor's registers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Registers {
    /// 7 MST_ID: identifier of its answers.
    pub master: u32,
    /// 8 ESC_ID: identifier of commands to it.
    pub slave: u32,
    /// 9 TIMEOUT, units of 50 us; 0: none.
    pub timeout: u32,
    /// 10 CTRL_MODE.
    pub mode: u32,
    /// 21 PMAX, rad.
    pub pmax: f32,
    /// 22 VMAX, rad/s.
    pub vmax: f32,
    /// 23 TMAX, Nm.
    pub tmax: f32,
}

impl Registers {
    /// A new motor of this type, in MIT mode and without a timeout.
    pub fn new(kind: Type, slave: u16, master: u16) -> Self {
        let (_, pmax, vmax, tmax) = TYPES[kind.0];
        Self { master: master.into(), slave: slave.into(), timeout: 0, mode: MIT, pmax, vmax, tmax }
    }

    /// How long it waits for a frame; `None`: without limit.
    pub fn patience(&self) -> Option<Duration> {
        (self.timeout != 0).then(|| TIMEOUT_UNIT * self.timeout)
    }

    /// The four bytes of a register; `None` if there is no such register.
    pub fn read(&self, rid: u8) -> Option<[u8; 4]> {
        const CAN_RATE_1M: u32 = 4;
        let word = |value: u32| Some(value.to_le_bytes());
        let real = |value: f32| Some(value.to_le_bytes());
        match rid {
            7 => word(self.master),
            8 => word(self.slave),
            9 => word(self.timeout),
            10 => word(self.mode),
            13 => word(0x10),
            14 => word(0x2015),
            15 => word(0x0bec_0000 | self.slave),
            21 => real(self.pmax),
            22 => real(self.vmax),
            23 => real(self.tmax),
            35 => word(CAN_RATE_1M),
            _ => None,
        }
    }

    /// Writes a register; false if there is no such writable register, or the value is invalid.
    pub fn write(&mut self, rid: u8, bytes: [u8; 4]) -> bool {
        let word = u32::from_le_bytes(bytes);
        let real = f32::from_le_bytes(bytes);
        let is_limit = real.is_finite() && real > 0.0;
        match rid {
            7 if word < 0x800 => self.master = word,
            8 if word < 0x100 => self.slave = word,
            9 => self.timeout = word,
            10 if (1..=4).contains(&word) => self.mode = word,
            21 if is_limit => self.pmax = real,
            22 if is_limit => self.vmax = real,
            23 if is_limit => self.tmax = real,
            _ => return false,
        }
        true
    }
}
