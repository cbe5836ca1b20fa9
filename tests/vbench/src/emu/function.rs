//! The function of a device, above its port: cameras, a serial line or a protocol device, behind chapter 9's requests.
//!
//! Invariant: no clock, no socket, no thread; requests and times are inputs, answers and packets are outputs.

use std::collections::HashMap;
use std::ops::Range;
use std::path::Path;

use thiserror::Error;

use super::cameras::Cameras;
use super::can::adapter::Adapter;
use super::descriptor::{self, Answer, Setup};
use super::feed::{self, FeedError, Records};
use super::frame;
use super::gpio::Gpio;
use super::lan::ecm::Ecm;
use super::serial::{Flavour, Serial};
use super::source::{Live, Source};
use super::spec::{DeviceSpec, Format, Identity, Kind, Mode};
use super::talker::Talker;
use super::uvc::{self, Content, Pictures};

/// Address of the bulk endpoint that carries every kind's data to the host; further cameras of a device have the next ones.
pub const DATA_IN: u8 = 0x81;
/// Its number, without the direction bit.
const DATA_ENDPOINT: u8 = DATA_IN & 0x0f;

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
        source: rapid_pictures::jpeg::EncodeError,
    },
    /// The feed cannot be read.
    #[error(transparent)]
    Feed(#[from] FeedError),
    /// A record of the feed is not a picture for this camera.
    #[error("record {0} of the feed is not a whole JPEG that fits {1}x{2}")]
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
    Uvc(Cameras),
    Serial(Serial),
    Talker(Box<dyn Talker>),
}

impl Function {
    /// Creates the device of a specification; encodes the pictures it needs, or reads its feed. Its frames or lines are
    /// numbered from `first`.
    pub fn new(spec: &DeviceSpec, first: u32, store: &mut PictureStore) -> Result<Self, ContentError> {
        let given = (!spec.feed.is_empty()).then(|| feed::load(Path::new(&spec.feed))).transpose()?;
        let role = match &spec.kind {
            Kind::Uvc(cameras) => {
                let contents: Result<_, _> =
                    cameras.iter().map(|modes| content(modes, given.as_ref(), store)).collect();
                Role::Uvc(Cameras::new(contents?, first))
            }
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
            Role::Uvc(cameras) => cameras.stop(),
            Role::Serial(_) => {}
            Role::Talker(talker) => talker.reset(),
        }
    }

    /// Answers a control request; `data` is its data stage towards the device.
    pub fn control(&mut self, setup: Setup, data: &[u8], now_ns: u64) -> Answer {
        if setup.is_standard() {
            return self.standard(setup);
        }
        match &mut self.role {
            Role::Uvc(cameras) => cameras.control(setup, data),
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

    /// Numbers of the endpoints through which it sends on its own clock.
    pub fn endpoints(&self) -> Range<u8> {
        let count = match &self.role {
            Role::Uvc(cameras) => cameras.count(),
            Role::Serial(_) => 1,
            Role::Talker(_) => 0,
        };
        DATA_ENDPOINT..DATA_ENDPOINT.saturating_add(count)
    }

    /// What sends on its own clock through the endpoint with this number.
    pub fn source(&mut self, endpoint: u8) -> Option<&mut dyn Source> {
        let place = endpoint.checked_sub(DATA_ENDPOINT)?;
        match &mut self.role {
            Role::Uvc(cameras) => cameras.at(place).map(|camera| camera as &mut dyn Source),
            Role::Serial(serial) if place == 0 => Some(serial),
            Role::Serial(_) | Role::Talker(_) => None,
        }
    }

    /// The running stream of the endpoint with this number, if there is one.
    pub fn live(&mut self, endpoint: u8) -> Option<Live> {
        self.source(endpoint)?.live()
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
                if let Role::Uvc(cameras) = &mut self.role {
                    let [address, _] = setup.index.to_le_bytes();
                    cameras.halt_cleared(address);
                }
                Answer::Done
            }
            _ if setup.is_in() => Answer::Stall,
            _ => Answer::Done,
        }
    }

    fn descriptor(&self, setup: Setup) -> Answer {
        let [index, kind] = setup.value.to_le_bytes();
        let (class, configuration) = match &self.role {
            Role::Uvc(cameras) => (cameras.class(), cameras.configuration()),
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

/// The modes of a camera with their pictures: made, or those of its device's feed.
fn content(modes: &[Mode], given: Option<&Records>, store: &mut PictureStore) -> Result<Content, ContentError> {
    let default = [Mode { format: Format::Mjpg, width: 640, height: 480, fps: vec![30] }];
    let modes = if modes.is_empty() { &default } else { modes };
    let mut with_pictures = Vec::with_capacity(modes.len());
    for mode in modes {
        let size @ (width, height) = (mode.width, mode.height);
        let pictures = match (mode.format, given, store.get(&size)) {
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
    Ok(with_pictures)
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
            DeviceSpec::uvc(0x8086, 0x0b07).mode(Format::Z16, 64, 48, &[15]).also(Format::Yuyv, 64, 48, &[15]),
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

    #[test]
    fn a_cleared_halt_ends_the_stream_of_its_endpoint_alone() {
        let spec = DeviceSpec::uvc(0x8086, 0x0b07).mode(Format::Z16, 64, 48, &[15]).also(Format::Yuyv, 64, 48, &[30]);
        let mut function = Function::new(&spec, 0, &mut PictureStore::new()).unwrap();
        assert_eq!(function.endpoints(), 1..3);
        for interface in [1, 3] {
            let commit = Setup { kind: 0x21, request: 1, value: 0x0200, index: interface, length: 26 };
            assert_eq!(function.control(commit, &[], 0), Answer::Done);
        }
        let live = |function: &mut Function| [1, 2].map(|endpoint| function.live(endpoint).is_some());
        assert_eq!(live(&mut function), [true, true]);
        let clear = |address| Setup { kind: 0x02, request: 1, value: 0, index: address, length: 0 };
        for (address, expected) in [(0x83, [true, true]), (0x82, [true, false]), (0x81, [false, false])] {
            assert_eq!(function.control(clear(address), &[], 0), Answer::Done);
            assert_eq!(live(&mut function), expected, "{address:#x}");
        }
    }

    #[test]
    fn there_is_a_source_for_each_endpoint_and_no_other() {
        let specs = [(DeviceSpec::uvc(1, 2), 1), (DeviceSpec::acm(1, 2, 1.0), 1), (DeviceSpec::gpio(), 0)];
        for (spec, count) in specs {
            let mut function = Function::new(&spec, 0, &mut PictureStore::new()).unwrap();
            let found: Vec<u8> = (0..16).filter(|endpoint| function.source(*endpoint).is_some()).collect();
            assert_eq!(found.len(), count);
            assert_eq!(found, function.endpoints().collect::<Vec<_>>());
        }
    }
}
