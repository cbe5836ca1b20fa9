//! The guard of a bus of motors: a process that stops them when this one cannot.
//!
//! Motors that are enabled follow their last command until their own time limit, and then fall. A process that is
//! killed, crashes or is stopped sends nothing more; the guard holds the bus too and, within milliseconds of its death
//! or once it has been silent for [`stalled_after`], sends each motor its last will: the frame that stops it as
//! configured for the fault of another motor, repeatedly for [`KEEP_FOR`], and then the command to disable. The motors'
//! own time limit remains as the second line of defence.
//!
//! The guard is this program started once more, under the name [`NAME`], when an adapter with motors is opened. It has one
//! end of a pair of sockets as its standard input, the adapter as its standard output, and no other open file of ours.
//! What it is told is in `message`.
//!
//! Invariant: the guard sends nothing while cycles arrive or no motor is on.
//! Invariant: the guard leaves the answers of motors to the guarded process while that runs.
//! Invariant: the guard has ended, or was killed, before the adapter is closed here: a serial line that it kept open
//! would get another name when replugged.

mod held;
mod message;
mod process;

use std::io::{self, IoSlice};
use std::mem::MaybeUninit;
use std::os::fd::{BorrowedFd, OwnedFd};
use std::os::unix::process::CommandExt as _;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use rapid_motors::control::motors::{MotorBus, stalled_after};
use rapid_registry::device::DeviceNode;
use rapid_registry::{CanSpec, DamiaoSpec};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;
use rustix::net::{
    AddressFamily, SendAncillaryBuffer, SendAncillaryMessage, SendFlags, SocketFlags, SocketType, send, sendmsg,
    socketpair,
};
use rustix::process::{Pid, PidfdFlags, pidfd_open, setsid};

use super::link::Link;
use crate::driver::process::leak_nothing;

use message::{BRAKE, DISMISSED, FRAME, LONGEST, OFF, ON, encode};
pub use message::{KEEP_FOR, NAME};
pub use process::run;

/// When dismissed it ends within this, or is killed.
const ENDS_WITHIN: Duration = Duration::from_millis(200);

/// The guard, as seen from the process that it guards.
#[derive(Debug)]
pub(super) struct Guard {
    socket: OwnedFd,
    process: Child,
    /// The kind of the last message it received.
    received: u8,
    /// Its failure to receive was reported.
    is_reported: bool,
}

impl Guard {
    /// Starts the guard of the motors of an entry, whose adapter is open.
    ///
    /// # Errors
    /// When the system gives no socket or no process.
    pub(super) fn start(link: &Link, can: &CanSpec, motors: &DamiaoSpec, node: &DeviceNode) -> io::Result<Self> {
        let (ours, theirs) = socketpair(AddressFamily::UNIX, SocketType::SEQPACKET, SocketFlags::CLOEXEC, None)?;
        let interface = match node {
            DeviceNode::Net(name) => name.as_str(),
            _ => "-",
        };
        let mut command = Command::new("/proc/self/exe");
        command
            .arg0(NAME)
            .arg(can.adapter.word())
            .arg(stalled_after(motors).as_millis().to_string())
            .arg(interface)
            .args(motors.motors.iter().map(|motor| motor.slave.to_string()))
            .current_dir("/")
            .stdin(theirs)
            .stdout(Stdio::from(link.duplicate()?));
        // SAFETY: between fork and exec only system calls are made: no allocation, no lock. Errors are plain numbers.
        unsafe { command.pre_exec(prepare) };
        Ok(Self { socket: ours, process: command.spawn()?, received: OFF, is_reported: false })
    }

    /// Reports a finished cycle, which costs one system call, and neither allocates nor waits. Returns why the guard has
    /// become useless, once.
    pub(super) fn cycle(&mut self, bus: &MotorBus) -> Option<&'static str> {
        let mut message = [0; LONGEST];
        let mut length = 1;
        if let Some(frames) = bus.last_will() {
            message[0] = ON;
            [message[1], message[2]] = bus.engages_at_death().to_le_bytes();
            length = 3;
            for frame in frames {
                if let Some(place) = message.get_mut(length..length + FRAME) {
                    place.copy_from_slice(&encode(&frame));
                    length += FRAME;
                }
            }
        }
        if message[0] == OFF && self.received == OFF {
            return None;
        }
        let sent = send(&self.socket, message.get(..length)?, SendFlags::DONTWAIT | SendFlags::NOSIGNAL);
        let problem = match sent {
            Ok(_) => {
                self.received = message[0];
                return None;
            }
            Err(Errno::INTR | Errno::NOMEM | Errno::NOBUFS) => return None,
            Err(Errno::AGAIN) => "does not run",
            Err(_) => "has ended",
        };
        (!std::mem::replace(&mut self.is_reported, true)).then_some(problem)
    }

    /// Another descriptor of its socket, for [`hand_over`].
    ///
    /// # Errors
    /// When the system gives none.
    pub(super) fn socket(&self) -> io::Result<OwnedFd> {
        self.socket.try_clone()
    }

    /// Ends the guard, once the motors are off or were ordered off. Returns when it has ended.
    pub(super) fn dismiss(mut self) {
        self.end();
    }

    fn end(&mut self) {
        let _ = send(&self.socket, &[DISMISSED], SendFlags::DONTWAIT | SendFlags::NOSIGNAL);
        let process = Pid::from_raw(self.process.id().cast_signed());
        if let Some(Ok(process)) = process.map(|process| pidfd_open(process, PidfdFlags::empty())) {
            let limit = Timespec { tv_sec: 0, tv_nsec: ENDS_WITHIN.subsec_nanos().into() };
            let _ = poll(&mut [PollFd::new(&process, PollFlags::IN)], Some(&limit));
        }
        // Killing a process that has ended does no harm.
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

impl Drop for Guard {
    fn drop(&mut self) {
        if matches!(self.process.try_wait(), Ok(None)) {
            self.end();
        }
    }
}

/// Hands the line of a brake to the guard, or has it closed there. Returns whether that succeeded; otherwise retry.
pub(super) fn hand_over(guard: &OwnedFd, motors: u16, engaged_high: bool, line: Option<BorrowedFd<'_>>) -> bool {
    let [low, high] = motors.to_le_bytes();
    let message = [BRAKE, low, high, engaged_high.into()];
    let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(1))];
    let mut control = SendAncillaryBuffer::new(&mut space);
    let lines = line.into_iter().collect::<Vec<_>>();
    if !lines.is_empty() && !control.push(SendAncillaryMessage::ScmRights(&lines)) {
        return false;
    }
    let sent = sendmsg(guard, &[IoSlice::new(&message)], &mut control, SendFlags::DONTWAIT | SendFlags::NOSIGNAL);
    // A guard that has ended holds no line.
    !matches!(sent, Err(Errno::INTR | Errno::NOMEM | Errno::NOBUFS | Errno::AGAIN))
}

/// Runs in the guard before its program does.
fn prepare() -> io::Result<()> {
    setsid()?;
    // What ends the guarded process in order ends the guard by its message.
    for signal in [libc::SIGINT, libc::SIGTERM, libc::SIGHUP, libc::SIGQUIT] {
        // SAFETY: no handler of ours is involved.
        unsafe { libc::signal(signal, libc::SIG_IGN) };
    }
    leak_nothing();
    Ok(())
}
