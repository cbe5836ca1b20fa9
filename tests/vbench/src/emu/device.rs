//! A device and its port: plugging and unplugging, by notifying the kernel's `vhci_hcd`.

use std::fs::OpenOptions;
use std::io::{self, Write};
use std::ops::Range;
use std::os::fd::AsRawFd;
use std::os::unix::net::UnixStream;
use std::path::PathBuf;
use std::sync::Arc;
use std::thread;
use std::time::{Duration, Instant};

use rustix::net::sockopt::set_socket_send_buffer_size;
use serde_json::json;
use thiserror::Error;

use super::attachment::{Shared, State};
use super::function::Function;
use super::log::{Log, Moment};
use super::order::Order;

const VHCI: &str = "/sys/devices/platform/vhci_hcd.0";
/// A port answers EBUSY until the kernel has finished with the device that left it.
const PORT_FREE_WITHIN: Duration = Duration::from_mins(1);
const HIGH_SPEED: u32 = 3;
/// Space for a large frame, so that sending never waits for the kernel to fetch the first half.
const SOCKET_BUFFER: usize = 1 << 20;

/// Why a device could not be plugged or unplugged.
#[derive(Debug, Error)]
pub enum PortError {
    /// It is plugged already.
    #[error("already plugged into port {0}")]
    Plugged(u8),
    /// It is not plugged.
    #[error("not plugged")]
    Unplugged,
    /// The order does not apply to it.
    #[error("it has no such part")]
    Order,
    /// No socket pair.
    #[error("socket pair: {0}")]
    Socket(#[source] io::Error),
    /// The kernel refused.
    #[error("{VHCI}/{file} `{text}`: {source} (is vhci_hcd loaded, are we root?)")]
    Vhci {
        /// attach or detach.
        file: &'static str,
        /// What was written.
        text: String,
        /// The kernel's answer.
        source: io::Error,
    },
}

/// One emulated device.
pub struct Device {
    index: usize,
    next_port: u8,
    plugged: Option<u8>,
    /// Those that send on the device's own clock.
    endpoints: Range<u8>,
    shared: Arc<Shared>,
}

impl Device {
    /// A device that is not plugged yet.
    pub fn new(index: usize, port: u8, function: Function, log: Arc<Log>) -> Self {
        let (talks, endpoints) = (function.talks(), function.endpoints());
        let shared = Arc::new(Shared::new(index, function, log));
        if talks {
            let talking = Arc::clone(&shared);
            thread::spawn(move || talking.talk());
        }
        Self { index, next_port: port, plugged: None, endpoints, shared }
    }

    /// The next plug goes to this port.
    pub fn set_port(&mut self, port: u8) {
        self.next_port = port;
    }

    /// Makes it silent: it stays attached and sends nothing.
    pub fn set_silent(&self, silent: bool) {
        self.shared.lock().silent = silent;
        self.shared.changed.notify_all();
    }

    /// Applies an order to it, or to a motor behind it.
    pub fn apply(&self, motor: Option<u16>, order: Order) -> Result<(), PortError> {
        if self.shared.apply(motor, order) { Ok(()) } else { Err(PortError::Order) }
    }

    /// Plugs it in. The logged time is the one right before the kernel was notified.
    pub fn plug(&mut self) -> Result<(), PortError> {
        if let Some(port) = self.plugged {
            return Err(PortError::Plugged(port));
        }
        self.await_free();
        self.await_forgotten();
        let (ours, kernels) = UnixStream::pair().map_err(PortError::Socket)?;
        for end in [&ours, &kernels] {
            set_socket_send_buffer_size(end, SOCKET_BUFFER).map_err(|e| PortError::Socket(e.into()))?;
        }
        let reader = ours.try_clone().map_err(PortError::Socket)?;
        let epoch = {
            let mut state = self.shared.lock();
            state.function.reset();
            state.line = Some(ours);
            state.epoch += 1;
            state.epoch
        };
        let serving = Arc::clone(&self.shared);
        thread::spawn(move || serving.serve(reader, epoch));
        for endpoint in self.endpoints.clone() {
            let beating = Arc::clone(&self.shared);
            thread::spawn(move || beating.beat(epoch, endpoint));
        }

        // devid is bus and device number of the exporting side; nothing uses it here, but it must be unique.
        let text = format!("{} {} {} {HIGH_SPEED}", self.next_port, kernels.as_raw_fd(), (1 << 16) | (self.index + 2));
        let give_up = Instant::now() + PORT_FREE_WITHIN;
        let mut tries = 0;
        let moment = loop {
            tries += 1;
            let moment = Moment::now();
            match tell_vhci("attach", &text) {
                Ok(()) => break moment,
                Err(error) if error.raw_os_error() == Some(16) && Instant::now() < give_up => {
                    thread::sleep(Duration::from_millis(5));
                }
                Err(source) => {
                    self.shared.hang_up(epoch);
                    return Err(PortError::Vhci { file: "attach", text, source });
                }
            }
        };
        self.plugged = Some(self.next_port);
        self.shared.log.write("plug", moment, json!({"device": self.index, "port": self.next_port, "tries": tries}));
        Ok(())
    }

    /// Unplugs it: to the kernel, the cable is gone.
    pub fn unplug(&mut self) -> Result<(), PortError> {
        let port = self.plugged.take().ok_or(PortError::Unplugged)?;
        let moment = Moment::now();
        let reported = tell_vhci("detach", &port.to_string());
        self.shared.log.write("unplug", moment, json!({"device": self.index, "port": port}));
        reported.map_err(|source| PortError::Vhci { file: "detach", text: port.to_string(), source })
    }

    /// Waits until the kernel has released the device that was in the port. A hub disables a port that loses its
    /// device, so that the kernel cannot confuse it with the next one; `vhci_hcd` leaves the port enabled, and a device
    /// that returns before the kernel's hub thread has run is taken for the one that left, with that one's settings.
    fn await_forgotten(&self) {
        let give_up = Instant::now() + PORT_FREE_WITHIN;
        while kernels_device(self.next_port).exists() && Instant::now() < give_up {
            thread::sleep(Duration::from_millis(2));
        }
    }

    /// Waits until the threads of the last attachment have ended; closes the connection if the kernel has not.
    fn await_free(&self) {
        let free = |state: &mut State| state.line.is_some();
        let (state, timeout) = self
            .shared
            .changed
            .wait_timeout_while(self.shared.lock(), PORT_FREE_WITHIN, free)
            .unwrap_or_else(|poisoned| poisoned.into_inner());
        let epoch = state.epoch;
        drop(state);
        if timeout.timed_out() {
            self.shared.hang_up(epoch);
        }
    }
}

impl Drop for Device {
    fn drop(&mut self) {
        self.shared.lock().ended = true;
        self.shared.changed.notify_all();
    }
}

/// Unplugs everything that is plugged in, as fast as the kernel can be notified; returns which devices these were.
pub fn unplug_together(devices: &mut [Device]) -> Result<Vec<usize>, PortError> {
    let reported = |text: &str, source| PortError::Vhci { file: "detach", text: text.into(), source };
    let mut detach =
        OpenOptions::new().write(true).open(format!("{VHCI}/detach")).map_err(|error| reported("", error))?;
    let mut pulled = Vec::new();
    // Nothing is logged before the last one is unplugged.
    for device in devices.iter_mut() {
        let Some(port) = device.plugged.take() else { continue };
        let moment = Moment::now();
        detach.write_all(port.to_string().as_bytes()).map_err(|error| reported(&port.to_string(), error))?;
        pulled.push((device.index, port, moment));
    }
    for (index, port, moment) in &pulled {
        devices[*index].shared.log.write("unplug", *moment, json!({"device": index, "port": port}));
    }
    Ok(pulled.into_iter().map(|(index, ..)| index).collect())
}

/// The kernel's sysfs entry for the device in a port, if any. `vhci_hcd.0` is the machine's only USB 2 bus.
fn kernels_device(port: u8) -> PathBuf {
    PathBuf::from(format!("/sys/bus/usb/devices/1-{}", port + 1))
}

fn tell_vhci(file: &str, text: &str) -> io::Result<()> {
    OpenOptions::new().write(true).open(format!("{VHCI}/{file}"))?.write_all(text.as_bytes())
}
