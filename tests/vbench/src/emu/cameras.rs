//! The cameras of one USB device. Most devices have one; a depth camera has one for depth and one for colour.
//!
//! Invariant: there are at most `spec::CAMERAS`, each with its own pair of interfaces, endpoint, stream and numbers; a
//! request changes only one.

use super::descriptor::{Answer, Configuration, DeviceClass, Setup};
use super::frame::NUMBERS_PER_CAMERA;
use super::uvc::{Content, Uvc};

/// The cameras of a device, in the order of their interfaces.
#[derive(Debug)]
pub struct Cameras(Vec<Uvc>);

impl Cameras {
    /// A camera for each content; the first frame of the device has number `first`.
    pub fn new(contents: Vec<Content>, first: u32) -> Self {
        let camera = |(place, content): (u8, Content)| {
            Uvc::new(content, place, first.wrapping_add(u32::from(place) * NUMBERS_PER_CAMERA))
        };
        Self((0..).zip(contents).map(camera).collect())
    }

    /// Miscellaneous device with interface associations, like every UVC camera.
    pub fn class(&self) -> DeviceClass {
        DeviceClass { class: [0xef, 2, 1], release: 0x0100 }
    }

    /// The configuration descriptor.
    pub fn configuration(&self) -> Vec<u8> {
        let mut configuration = Configuration::default();
        self.0.iter().for_each(|camera| camera.describe(&mut configuration));
        configuration.finish()
    }

    /// Answers a class request to one of their interfaces.
    pub fn control(&mut self, setup: Setup, data: &[u8]) -> Answer {
        let [interface, _] = setup.index.to_le_bytes();
        let addressed = self.0.iter_mut().find(|camera| camera.has_interface(interface));
        addressed.map_or(Answer::Stall, |camera| camera.control(setup, data))
    }

    /// The host has cleared the halt of the endpoint at this address: its stream has ended.
    pub fn halt_cleared(&mut self, address: u8) {
        self.0.iter_mut().filter(|camera| camera.address() == address).for_each(Uvc::stop);
    }

    /// All streams have ended.
    pub fn stop(&mut self) {
        self.0.iter_mut().for_each(Uvc::stop);
    }

    /// How many there are.
    pub fn count(&self) -> u8 {
        u8::try_from(self.0.len()).expect("a handful of cameras")
    }

    /// The camera with this place in the device, counted from 0.
    pub fn at(&mut self, place: u8) -> Option<&mut Uvc> {
        self.0.get_mut(usize::from(place))
    }
}

#[cfg(test)]
#[path = "cameras_tests.rs"]
mod tests;
