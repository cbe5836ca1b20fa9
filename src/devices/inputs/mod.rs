//! Inputs with two levels: a key, a line of a GPIO chip, lines of text on a serial port, a number in the samples of a
//! device. Emergency stops, enabling switches and buttons are read by it.
//!
//! Inputs that only one reader can have open, the keys of a device and the lines of a port, are one [`InputGroup`]. Each place
//! has a thread, which sleeps until the kernel has something to read or the input has been silent for too long; it opens
//! the place again after a loss. For a number in the samples of a device the thread only waits for silence, and the
//! device's stream evaluates the number ([`tap`]).
//!
//! Invariant: an input is lost from the moment when it cannot be read until it reports a level: unplugged, silent, held
//! by another program, or read by a thread that panicked. What that means is decided by whoever receives the [`Report`].

mod gpio;
mod key;
mod line;
mod source;
pub mod tap;
mod watch;

use std::fmt;
use std::io;
use std::os::fd::OwnedFd;
use std::sync::Arc;
use std::thread::JoinHandle;

use rapid_system::realtime::{CONTROL_PRIORITY, use_fifo};
use rustix::event::{EventfdFlags, eventfd};

use rapid_registry::{FieldInput, GpioInput, InputSpec, KeyInput, LineInput};
use tap::Tap;

/// Receives what the inputs of a place report, from any thread. For a number it is called with every sample: it must not
/// wait, and while nothing changes it must not allocate.
pub trait Report: fmt::Debug + Send + Sync {
    /// Input `which` of its place is on or off. It may have been so before.
    fn level(&self, which: usize, is_on: bool);

    /// All inputs of the place are lost, and why. They may have been so before.
    fn lost(&self, why: &str);
}

/// What one reader reads.
#[derive(Debug, Clone, PartialEq)]
pub enum InputGroup {
    /// Keys of an input device.
    Keys(Vec<KeyInput>),
    /// A line of a GPIO chip.
    Gpio(GpioInput),
    /// Lines of text of a serial port.
    Lines(Vec<LineInput>),
    /// A number in the samples of a device.
    Field(FieldInput),
}

impl InputGroup {
    /// The place of one input.
    pub fn from_spec(input: &InputSpec) -> Self {
        match input.clone() {
            InputSpec::Key(key) => Self::Keys(vec![key]),
            InputSpec::Gpio(gpio) => Self::Gpio(gpio),
            InputSpec::Serial(line) => Self::Lines(vec![line]),
            InputSpec::Field(field) => Self::Field(field),
        }
    }

    /// Adds `input`, if it is read from the same device or port.
    fn add(&mut self, input: &InputSpec) -> bool {
        match (self, input) {
            (Self::Keys(keys), InputSpec::Key(key)) if keys.iter().any(|other| other.device == key.device) => {
                keys.push(key.clone());
            }
            (Self::Lines(lines), InputSpec::Serial(line)) if lines.iter().any(|other| other.path == line.path) => {
                lines.push(line.clone());
            }
            _ => return false,
        }
        true
    }

    /// The places of `inputs`, each with the positions of its inputs, in its own order.
    pub fn of_all<'a>(inputs: impl Iterator<Item = &'a InputSpec>) -> Vec<(Self, Vec<usize>)> {
        let mut all: Vec<(Self, Vec<usize>)> = Vec::new();
        for (index, input) in inputs.enumerate() {
            match all.iter_mut().find_map(|(place, own)| place.add(input).then_some(own)) {
                Some(own) => own.push(index),
                None => all.push((Self::from_spec(input), vec![index])),
            }
        }
        all
    }
}

/// Reads places until it is dropped.
#[derive(Debug)]
pub struct Readers {
    stop: Arc<OwnedFd>,
    threads: Vec<JoinHandle<()>>,
    taps: Vec<Tap>,
    is_realtime: bool,
}

impl Readers {
    /// Without a place; its threads run before those of other programs if `is_realtime` and that is permitted.
    ///
    /// # Errors
    /// When the system has no descriptor left.
    pub fn new(is_realtime: bool) -> io::Result<Self> {
        let stop = Arc::new(eventfd(0, EventfdFlags::CLOEXEC)?);
        Ok(Self { stop, threads: Vec::new(), taps: Vec::new(), is_realtime })
    }

    /// Reads `place` from now on, by a thread with this name, of which the kernel keeps 15 bytes.
    ///
    /// # Errors
    /// When the system provides no thread.
    pub fn read(&mut self, thread: &str, place: InputGroup, report: Arc<dyn Report>) -> io::Result<()> {
        let stop = Arc::clone(&self.stop);
        let work: Box<dyn FnOnce() + Send> = match place {
            InputGroup::Field(field) => {
                let tap = Tap::new(&field, report)?;
                self.taps.push(tap.clone());
                Box::new(move || tap.watch(&stop))
            }
            place => Box::new(move || watch::watch(&place, &*report, &stop)),
        };
        let is_realtime = self.is_realtime;
        let name = thread.chars().take(15).collect();
        self.threads.push(std::thread::Builder::new().name(name).spawn(move || {
            if is_realtime {
                // Without the privilege for it, the motors' thread warns.
                let _ = use_fifo(CONTROL_PRIORITY);
            }
            work();
        })?);
        Ok(())
    }

    /// The inputs that are numbers in the samples of a device.
    pub fn taps(&self) -> &[Tap] {
        &self.taps
    }
}

impl Drop for Readers {
    fn drop(&mut self) {
        // An eventfd always has room for a number.
        let _ = rustix::io::write(&self.stop, &1_u64.to_ne_bytes());
        for thread in self.threads.drain(..) {
            // Its panic has been reported.
            let _ = thread.join();
        }
    }
}

/// Held by a thread or task: if it panics, the inputs are lost.
pub fn lost_at_a_panic(report: &dyn Report) -> impl Drop {
    LostAtPanic(report)
}

struct LostAtPanic<'a>(&'a dyn Report);

impl Drop for LostAtPanic<'_> {
    fn drop(&mut self) {
        if std::thread::panicking() {
            self.0.lost("its thread panicked; please report this");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_of_a_device_and_lines_of_a_port_have_one_reader() {
        let key = |device: &str, number| {
            let (device, code) = (device.to_owned(), "KEY".to_owned());
            InputSpec::Key(KeyInput { device, code, number, on_while_pressed: true, grab: false })
        };
        let line = |path: &str, on: &str| {
            let (path, on, off) = (path.into(), on.to_owned(), rapid_registry::LineOff::AtOnce);
            InputSpec::Serial(LineInput { path, baud: 9600, on, off, silence: None })
        };
        let gpio = |line| InputSpec::Gpio(GpioInput { chip: "/dev/gpiochip0".into(), line, on_while_high: false });
        let all = [key("a", 1), line("/p", "x"), gpio(1), key("b", 1), key("a", 2), gpio(2), line("/p", "y")];
        let places = InputGroup::of_all(all.iter());
        let own: Vec<_> = places.iter().map(|(_, own)| own.as_slice()).collect();
        assert_eq!(own, [&[0, 4][..], &[1, 6], &[2], &[3], &[5]]);
    }
}
