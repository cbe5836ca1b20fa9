//! A device's attachment: its port, the thread that answers the host, and the thread that keeps the beat.
//!
//! Invariant: one mutex per device guards function, transfers and socket; it is never held while waiting for the clock or the host.
//! Invariant: a beat that comes late or finds no reader is skipped, not caught up: a camera does not deliver the past.

use std::collections::VecDeque;
use std::fs::OpenOptions;
use std::io::{self, Read, Write};
use std::net::Shutdown;
use std::os::fd::AsRawFd;
use std::os::unix::net::UnixStream;
use std::path::PathBuf;
use std::sync::{Arc, Condvar, Mutex, MutexGuard};
use std::thread;
use std::time::{Duration, Instant};

use rustix::net::sockopt::set_socket_send_buffer_size;
use serde_json::json;
use thiserror::Error;

use super::descriptor::{Answer, Setup};
use super::function::{DATA_IN, Function};
use super::log::{Log, Moment};
use super::wire::{self, HEADER_LEN, Request, Status, Submit};
use crate::clock;

const VHCI: &str = "/sys/devices/platform/vhci_hcd.0";
/// A port answers EBUSY until the kernel has finished with the device that left it.
const PORT_FREE_WITHIN: Duration = Duration::from_secs(5);
const HIGH_SPEED: u32 = 3;
/// Room for a large frame, so that sending never waits for the kernel to fetch the first half.
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
    shared: Arc<Shared>,
}

struct Shared {
    index: usize,
    state: Mutex<State>,
    changed: Condvar,
    log: Arc<Log>,
}

struct State {
    function: Function,
    line: Option<UnixStream>,
    /// Counts attachments: a thread of an older one that wakes late finds another number and ends.
    epoch: u32,
    /// Transfers to the host that wait for data, by endpoint.
    waiting: [VecDeque<Waiting>; 16],
    silent: bool,
    sent: u64,
    skipped: u64,
    scratch: Vec<u8>,
}

struct Waiting {
    seq: u32,
    room: usize,
}

impl Device {
    /// A device that is not plugged yet.
    pub fn new(index: usize, port: u8, function: Function, log: Arc<Log>) -> Self {
        let state = State {
            function,
            line: None,
            epoch: 0,
            waiting: Default::default(),
            silent: false,
            sent: 0,
            skipped: 0,
            scratch: Vec::new(),
        };
        let shared = Shared { index, state: Mutex::new(state), changed: Condvar::new(), log };
        Self { index, next_port: port, plugged: None, shared: Arc::new(shared) }
    }

    /// The next plug goes to this port.
    pub fn set_port(&mut self, port: u8) {
        self.next_port = port;
    }

    /// A silent device stays attached and sends nothing.
    pub fn set_silent(&self, silent: bool) {
        self.shared.lock().silent = silent;
        self.shared.changed.notify_all();
    }

    /// Plugs it in. The moment that is logged is the one right before the kernel was told.
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
        let (serving, beating) = (Arc::clone(&self.shared), Arc::clone(&self.shared));
        thread::spawn(move || serving.serve(reader, epoch));
        thread::spawn(move || beating.beat(epoch));

        // devid is bus and device number of the exporting side; nothing reads it here, it must only be unique.
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
        self.shared.log.say("plug", moment, json!({"device": self.index, "port": self.next_port, "tries": tries}));
        Ok(())
    }

    /// Pulls it out: the kernel learns of it as of a cable that is gone.
    pub fn unplug(&mut self) -> Result<(), PortError> {
        let port = self.plugged.take().ok_or(PortError::Unplugged)?;
        let moment = Moment::now();
        let told = tell_vhci("detach", &port.to_string());
        self.shared.log.say("unplug", moment, json!({"device": self.index, "port": port}));
        told.map_err(|source| PortError::Vhci { file: "detach", text: port.to_string(), source })
    }

    /// Waits until the kernel has let go of the device that was in the port. A hub disables a port that loses its device, so
    /// that the kernel cannot take the next one for it; `vhci_hcd` leaves the port enabled, and a device that returns before
    /// the kernel's hub thread has looked is taken for the one that left, with the settings of that one.
    fn await_forgotten(&self) {
        let give_up = Instant::now() + PORT_FREE_WITHIN;
        while kernels_device(self.next_port).exists() && Instant::now() < give_up {
            thread::sleep(Duration::from_millis(2));
        }
    }

    /// Waits until the threads of the last attachment have let go; cuts the line when the kernel has not.
    fn await_free(&self) {
        let free = |state: &mut State| state.line.is_some();
        let (state, timeout) = self
            .shared
            .changed
            .wait_timeout_while(self.shared.lock(), Duration::from_secs(2), free)
            .unwrap_or_else(|poisoned| poisoned.into_inner());
        let epoch = state.epoch;
        drop(state);
        if timeout.timed_out() {
            self.shared.hang_up(epoch);
        }
    }
}

/// Pulls everything that is plugged, as fast as the kernel can be told; which devices these were.
pub fn unplug_together(devices: &mut [Device]) -> Result<Vec<usize>, PortError> {
    let told = |text: &str, source| PortError::Vhci { file: "detach", text: text.into(), source };
    let mut detach = OpenOptions::new().write(true).open(format!("{VHCI}/detach")).map_err(|error| told("", error))?;
    let mut pulled = Vec::new();
    // Nothing is logged before the last one is out.
    for device in devices.iter_mut() {
        let Some(port) = device.plugged.take() else { continue };
        let moment = Moment::now();
        detach.write_all(port.to_string().as_bytes()).map_err(|error| told(&port.to_string(), error))?;
        pulled.push((device.index, port, moment));
    }
    for (index, port, moment) in &pulled {
        devices[*index].shared.log.say("unplug", *moment, json!({"device": index, "port": port}));
    }
    Ok(pulled.into_iter().map(|(index, ..)| index).collect())
}

/// What the kernel shows of the device in a port, as long as it knows one there. `vhci_hcd.0` is the machine's only USB 2 bus.
fn kernels_device(port: u8) -> PathBuf {
    PathBuf::from(format!("/sys/bus/usb/devices/1-{}", port + 1))
}

fn tell_vhci(file: &str, text: &str) -> io::Result<()> {
    OpenOptions::new().write(true).open(format!("{VHCI}/{file}"))?.write_all(text.as_bytes())
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(|poisoned| poisoned.into_inner())
    }

    /// Forgets this attachment, unless another has followed it, and lets its threads end.
    fn hang_up(&self, epoch: u32) {
        let mut state = self.lock();
        if state.epoch != epoch {
            return;
        }
        if let Some(line) = state.line.take() {
            let _closed_already = line.shutdown(Shutdown::Both);
        }
        state.waiting = Default::default();
        state.function.reset();
        drop(state);
        self.changed.notify_all();
    }

    /// Answers the host until the line ends.
    fn serve(&self, mut line: UnixStream, epoch: u32) {
        let mut data = Vec::new();
        let mut header = [0; HEADER_LEN];
        while line.read_exact(&mut header).is_ok() {
            let request = match wire::decode(&header) {
                Ok(request) => request,
                Err(error) => {
                    let fields = json!({"device": self.index, "error": error.to_string()});
                    self.log.say("protocol_error", Moment::now(), fields);
                    break;
                }
            };
            data.clear();
            if let Request::Submit(Submit { is_in: false, length, .. }) = request {
                data.resize(length as usize, 0);
                if line.read_exact(&mut data).is_err() {
                    break;
                }
            }
            self.answer(request, &data);
        }
        self.hang_up(epoch);
        let state = self.lock();
        let fields = json!({"device": self.index, "sent": state.sent, "skipped": state.skipped});
        self.log.say("gone", Moment::now(), fields);
    }

    fn answer(&self, request: Request, data: &[u8]) {
        let mut state = self.lock();
        match request {
            Request::Unlink { seq, victim } => {
                let found = state.take_back(victim);
                state.write(&wire::unlink_reply(seq, if found { Status::Unlinked } else { Status::Ok }));
            }
            Request::Submit(submit) if submit.endpoint == 0 => {
                let before = state.function.live();
                let setup = Setup::parse(&submit.setup);
                let answer = state.function.control(setup, data);
                match answer {
                    Answer::Data(mut bytes) => {
                        bytes.truncate(usize::from(setup.length).min(submit.length as usize));
                        state.reply(submit.seq, &bytes);
                    }
                    Answer::Done => state.write(&wire::submit_reply(submit.seq, Status::Ok, data.len())),
                    Answer::Stall => state.write(&wire::submit_reply(submit.seq, Status::Stall, 0)),
                }
                let after = state.function.live();
                if before != after {
                    let action = if after.is_some() { "stream_on" } else { "stream_off" };
                    self.log.say(action, Moment::now(), json!({"device": self.index}));
                }
            }
            Request::Submit(Submit { seq, is_in: true, endpoint, length, .. }) => {
                state.waiting[usize::from(endpoint)].push_back(Waiting { seq, room: length as usize });
            }
            Request::Submit(submit) => state.write(&wire::submit_reply(submit.seq, Status::Ok, data.len())),
        }
        drop(state);
        self.changed.notify_all();
    }

    /// Sends a frame or line at every beat until the line ends.
    fn beat(&self, epoch: u32) {
        let mut whole = Vec::new();
        let mut due_ns = 0;
        let mut state = self.lock();
        while state.is_attached(epoch) {
            let Some(live) = state.function.live().filter(|_| !state.silent) else {
                due_ns = 0;
                state = self.wait(state, Duration::from_secs(1));
                continue;
            };
            let period_ns = u64::try_from(live.period.as_nanos()).unwrap_or(u64::MAX);
            let now_ns = clock::mono_ns();
            if due_ns == 0 {
                due_ns = now_ns;
            }
            if now_ns < due_ns {
                state = self.wait(state, clock::until(due_ns));
                continue;
            }
            let late = (now_ns - due_ns) / period_ns;
            due_ns += (late + 1) * period_ns;
            if state.data_endpoint().is_empty() {
                state.skipped += late + 1;
                continue;
            }
            state.skipped += late;
            state.function.produce(now_ns, &mut whole);
            state = self.send(state, &whole, epoch, live.stream);
        }
    }

    /// Sends `whole` packet by packet as the host asks for them; gives up when the stream or the line ends.
    fn send<'a>(
        &'a self,
        mut state: MutexGuard<'a, State>,
        whole: &[u8],
        epoch: u32,
        stream: u32,
    ) -> MutexGuard<'a, State> {
        let mut at = 0;
        while at < whole.len() {
            if !state.is_attached(epoch) || state.function.live().is_none_or(|live| live.stream != stream) {
                return state;
            }
            let Some(transfer) = state.data_endpoint().pop_front() else {
                state = self.wait(state, Duration::from_secs(1));
                continue;
            };
            let mut packet = std::mem::take(&mut state.scratch);
            packet.clear();
            packet.resize(HEADER_LEN, 0);
            at = state.function.packet(whole, at, transfer.room, &mut packet);
            let length = packet.len() - HEADER_LEN;
            packet[..HEADER_LEN].copy_from_slice(&wire::submit_reply(transfer.seq, Status::Ok, length));
            state.write(&packet);
            state.scratch = packet;
        }
        state.function.sent();
        state.sent += 1;
        state
    }

    fn wait<'a>(&self, state: MutexGuard<'a, State>, limit: Duration) -> MutexGuard<'a, State> {
        self.changed.wait_timeout(state, limit).unwrap_or_else(|poisoned| poisoned.into_inner()).0
    }
}

impl State {
    fn is_attached(&self, epoch: u32) -> bool {
        self.epoch == epoch && self.line.is_some()
    }

    fn data_endpoint(&mut self) -> &mut VecDeque<Waiting> {
        &mut self.waiting[usize::from(DATA_IN & 0x0f)]
    }

    fn take_back(&mut self, victim: u32) -> bool {
        self.waiting.iter_mut().any(|queue| {
            let place = queue.iter().position(|waiting| waiting.seq == victim);
            place.and_then(|place| queue.remove(place)).is_some()
        })
    }

    fn reply(&mut self, seq: u32, data: &[u8]) {
        let header = wire::submit_reply(seq, Status::Ok, data.len());
        self.write(&[&header[..], data].concat());
    }

    /// A write that fails means that the line has ended, which `serve` sees as well.
    fn write(&mut self, bytes: &[u8]) {
        if let Some(line) = &mut self.line {
            let _ended = line.write_all(bytes);
        }
    }
}
