//! The function of a device, above its port: a camera, a serial line or a protocol device, behind chapter 9's requests.
//!
//! Invariant: no clock, no socket, no thread; requests and times are inputs, answers and packets are outputs.

use std::collections::HashMap;
use std::path::Path;
use std::time::Duration;

use thiserror::Error;

use super::can::adapter::Adapter;
use super::descriptor::{self, Answer, Setup};
use super::feed::{self, FeedError, Records};
use super::frame;
use super::gpio::Gpio;
use super::lan::ecm::Ecm;
use super::serial::{Flavour, Serial};
use super::spec::{DeviceSpec, Format, Identity, Kind, Mode};
use super::talker::Talker;
use super::uvc::{self, Pictures, Uvc};

/// Address of the bulk endpoint that carries every kind's data to the host.
pub const DATA_IN: u8 = 0x81;

/// A device that has data to send, and how often.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Live {
    /// Changes when the host starts another stream.
    pub stream: u32,
    /// Time between two frames or lines.
    pub period: Duration,
}

/// Pictures by size, so that cameras of one size share them.
pub type PictureStore = HashMap<(u16, u16), Pictures>;

/// Why there is nothing to send.
#[derive(Debug, Error)]
pub enum ContentError {
    /// A picture could not be made.
    #[error("encoding a {width}x{height} picture: {source}")]
    Picture {
        /// Pixels across.
        width: u16,
        /// Pixels down.
        height: u16,
        /// Why.
        source: jpeg_encoder::EncodingError,
    },
    /// The feed cannot be read.
    #[error(transparent)]
    Feed(#[from] FeedError),
    /// A record of the feed is not a picture for this camera.
    #[error("record {0} of the feed is no whole JPEG that fits {1}x{2}")]
    NotPicture(usize, u16, u16),
}

/// A device, independent of its port.
#[derive(Debug)]
pub struct Function {
    identity: Identity,
    configured: u8,
    role: Role,
}

#[derive(Debug)]
enum Role {
    Uvc(Uvc),
    Serial(Serial),
    Talker(Box<dyn Talker>),
}

impl Function {
    /// Creates the device of a specification; encodes the pictures it needs, or reads its feed. Its frames or lines are
    /// numbered from `first`.
    pub fn new(spec: &DeviceSpec, first: u32, store: &mut PictureStore) -> Result<Self, ContentError> {
        let given = (!spec.feed.is_empty()).then(|| feed::load(Path::new(&spec.feed))).transpose()?;
        let role = match &spec.kind {
            Kind::Uvc(modes) => Role::Uvc(camera(modes, first, given, store)?),
            Kind::Acm { hz } => Role::Serial(Serial::new(Flavour::Acm, *hz, first, given)),
            Kind::Ftdi { hz } => Role::Serial(Serial::new(Flavour::Ftdi, *hz, first, given)),
            Kind::Can { protocol, motors } => Role::Talker(Box::new(Adapter::new(*protocol, motors))),
            Kind::Gpio => Role::Talker(Box::new(Gpio::default())),
            Kind::Ecm(net) => Role::Talker(Box::new(Ecm::new(net, &spec.identity.serial, first))),
        };
        Ok(Self { identity: spec.identity.clone(), configured: 0, role })
    }

    /// Resets to the state of a device that was just plugged in. Numbers continue.
    pub fn reset(&mut self) {
        self.configured = 0;
        match &mut self.role {
            Role::Talker(talker) => talker.reset(),
            Role::Uvc(_) | Role::Serial(_) => self.stop(),
        }
    }

    /// Answers a control request; `data` is its data stage towards the device.
    pub fn control(&mut self, setup: Setup, data: &[u8], now_ns: u64) -> Answer {
        if setup.is_standard() {
            return self.standard(setup);
        }
        match &mut self.role {
            Role::Uvc(camera) => camera.control(setup, data),
            Role::Serial(serial) => serial.control(setup, data),
            Role::Talker(talker) => talker.control(setup, data, now_ns),
        }
    }

    /// Whether it has a protocol; otherwise it sends on its own clock.
    pub fn talks(&self) -> bool {
        matches!(self.role, Role::Talker(_))
    }

    /// The device as a protocol device.
    pub fn talker(&mut self) -> Option<&mut dyn Talker> {
        match &mut self.role {
            Role::Talker(talker) => Some(talker.as_mut()),
            Role::Uvc(_) | Role::Serial(_) => None,
        }
    }

    /// The running stream, if there is one.
    pub fn live(&self) -> Option<Live> {
        match &self.role {
            Role::Uvc(camera) => camera.live(),
            Role::Serial(serial) => Some(serial.live()),
            Role::Talker(_) => None,
        }
    }

    /// Writes the next frame or line over `out`.
    pub fn produce(&mut self, sent_ns: u64, out: &mut Vec<u8>) {
        match &mut self.role {
            Role::Uvc(camera) => camera.frame(sent_ns, out),
            Role::Serial(serial) => serial.line(sent_ns, out),
            Role::Talker(_) => out.clear(),
        }
    }

    /// Appends the packet (at most `room` bytes) that continues `whole` at `at`; returns where the next one continues.
    pub fn packet(&self, whole: &[u8], at: usize, room: usize, out: &mut Vec<u8>) -> usize {
        match &self.role {
            Role::Uvc(camera) => camera.payload(whole, at, room, out),
            Role::Serial(serial) => serial.packet(whole, at, room, out),
            Role::Talker(_) => whole.len(),
        }
    }

    /// The output of `produce` was sent completely.
    pub fn sent(&mut self) {
        match &mut self.role {
            Role::Uvc(camera) => camera.sent(),
            Role::Serial(serial) => serial.sent(),
            Role::Talker(_) => {}
        }
    }

    fn stop(&mut self) {
        if let Role::Uvc(camera) = &mut self.role {
            camera.stop();
        }
    }

    /// Chapter 9. The host controller handles the address, and interfaces have one setting.
    fn standard(&mut self, setup: Setup) -> Answer {
        const GET_STATUS: u8 = 0;
        const CLEAR_FEATURE: u8 = 1;
        const GET_DESCRIPTOR: u8 = 6;
        const GET_CONFIGURATION: u8 = 8;
        const SET_CONFIGURATION: u8 = 9;
        const GET_INTERFACE: u8 = 10;
        const TO_ENDPOINT: u8 = 0x02;
        match setup.request {
            GET_DESCRIPTOR => self.descriptor(setup),
            GET_STATUS => Answer::Data(vec![0, 0]),
            GET_CONFIGURATION => Answer::Data(vec![self.configured]),
            GET_INTERFACE => Answer::Data(vec![0]),
            SET_CONFIGURATION => {
                self.configured = setup.value.to_le_bytes()[0];
                Answer::Done
            }
            CLEAR_FEATURE if setup.kind == TO_ENDPOINT => {
                self.stop();
                Answer::Done
            }
            _ if setup.is_in() => Answer::Stall,
            _ => Answer::Done,
        }
    }

    fn descriptor(&self, setup: Setup) -> Answer {
        let [index, kind] = setup.value.to_le_bytes();
        let (class, configuration) = match &self.role {
            Role::Uvc(camera) => (camera.class(), camera.configuration()),
            Role::Serial(serial) => (serial.class(), serial.configuration()),
            Role::Talker(talker) => (talker.class(), talker.configuration()),
        };
        let own = match &self.role {
            Role::Talker(talker) => talker.string(index),
            Role::Uvc(_) | Role::Serial(_) => None,
        };
        match kind {
            descriptor::DEVICE => Answer::Data(descriptor::device(&self.identity, class)),
            descriptor::CONFIGURATION => Answer::Data(configuration),
            descriptor::STRING => own
                .map(descriptor::text)
                .or_else(|| descriptor::string(&self.identity, index))
                .map_or(Answer::Stall, Answer::Data),
            _ => Answer::Stall,
        }
    }
}

fn camera(modes: &[Mode], first: u32, given: Option<Records>, store: &mut PictureStore) -> Result<Uvc, ContentError> {
    let default = [Mode { format: Format::Mjpg, width: 640, height: 480, fps: vec![30] }];
    let modes = if modes.is_empty() { &default } else { modes };
    let mut with_pictures = Vec::with_capacity(modes.len());
    for mode in modes {
        let size @ (width, height) = (mode.width, mode.height);
        let pictures = match (mode.format, &given, store.get(&size)) {
            (Format::Yuyv | Format::Z16, ..) => Pictures::default(),
            (Format::Mjpg, Some(given), _) => {
                let fits = |jpeg: &Vec<u8>| frame::is_whole_jpeg(jpeg) && jpeg.len() + frame::STAMP <= uvc::room(mode);
                match given.iter().position(|jpeg| !fits(jpeg)) {
                    Some(record) => return Err(ContentError::NotPicture(record, width, height)),
                    None => given.clone(),
                }
            }
            (Format::Mjpg, None, Some(known)) => known.clone(),
            (Format::Mjpg, None, None) => {
                let failed = |source| ContentError::Picture { width, height, source };
                let made = frame::jpegs(width, height).map_err(failed)?;
                store.entry(size).or_insert(Pictures::new(made)).clone()
            }
        };
        with_pictures.push((mode.clone(), pictures));
    }
    Ok(Uvc::new(with_pictures, first))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::emu::can::adapter::Protocol;

    fn get(kind: u8, index: u8) -> Setup {
        Setup { kind: 0x80, request: 6, value: u16::from_le_bytes([index, kind]), index: 0, length: 255 }
    }

    #[test]
    fn every_kind_enumerates() {
        let specs = [
            DeviceSpec::uvc(0x046d, 0x0825),
            DeviceSpec::acm(0x2e8a, 0xa, 1.0),
            DeviceSpec::ftdi(0x0403, 0x6001, 1.0),
            DeviceSpec::can(Protocol::GsUsb),
            DeviceSpec::can(Protocol::Slcan),
            DeviceSpec::ecm(),
            DeviceSpec::gpio(),
        ];
        for spec in specs {
            let mut function = Function::new(&spec, 0, &mut PictureStore::new()).unwrap();
            let Answer::Data(device) = function.control(get(1, 0), &[], 0) else { panic!("no device descriptor") };
            assert_eq!(device.len(), 18);
            let Answer::Data(configuration) = function.control(get(2, 0), &[], 0) else { panic!("no configuration") };
            descriptor::check_configuration(&configuration);
            assert_eq!(function.control(get(3, 3), &[], 0), Answer::Stall, "no serial, no descriptor");
            assert_eq!(function.control(get(6, 0), &[], 0), Answer::Stall, "no device qualifier");
            function.control(Setup { kind: 0, request: 9, value: 1, index: 0, length: 0 }, &[], 0);
            let configured = Setup { kind: 0x80, request: 8, value: 0, index: 0, length: 1 };
            assert_eq!(function.control(configured, &[], 0), Answer::Data(vec![1]));
            function.reset();
            assert_eq!(function.control(configured, &[], 0), Answer::Data(vec![0]));
        }
    }
}
