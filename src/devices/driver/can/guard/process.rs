//! The guard's own process: its state machine, and the loop around it.

use std::ffi::OsString;
use std::io::IoSliceMut;
use std::mem::MaybeUninit;
use std::process::ExitCode;
use std::time::Duration;

use rapid_core::time::Stamp;
use rapid_motors::control::can::CanFrame;
use rapid_motors::control::damiao::codec::StateCommand;
use rapid_registry::{BrakeSpec, CanAdapter, MAX_MOTORS};
use rapid_system::realtime::{CONTROL_PRIORITY, lock_memory, use_fifo};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fd::{AsFd, BorrowedFd, OwnedFd};
use rustix::io::Errno;
use rustix::net::{RecvAncillaryBuffer, RecvAncillaryMessage, RecvFlags, RecvMsg, recvmsg};

use super::held::Held;
use super::message::{BRAKE, DISMISSED, FRAME, KEEP_FOR, LONGEST, NAME, ON, decode};
use crate::driver::can::claim::Claim;
use crate::driver::can::{damiao_serial, slcan, socket};

/// From one round of frames to the next.
const ROUND: Duration = Duration::from_millis(5);
/// How long the disable frames are repeated: one may be lost.
const DISABLE_FOR: Duration = Duration::from_millis(100);

/// The arguments of the guard.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Post {
    adapter: CanAdapter,
    stalled_after: Duration,
    /// The network interface, if the adapter is one.
    interface: Option<String>,
    off: Vec<CanFrame>,
}

impl Post {
    fn read(args: impl Iterator<Item = OsString>) -> Option<Self> {
        let mut args = args.map(OsString::into_string).map_while(Result::ok);
        let adapter = args.next()?;
        let (_, adapter) = CanAdapter::WORDS.into_iter().find(|(word, _)| *word == adapter)?;
        let stalled_after = Duration::from_millis(args.next()?.parse().ok()?);
        let interface = args.next().filter(|name| name != "-");
        let off =
            args.map(|slave| Some(StateCommand::Disable.frame(slave.parse().ok()?))).collect::<Option<Vec<_>>>()?;
        (1..=MAX_MOTORS).contains(&off.len()).then_some(Self { adapter, stalled_after, interface, off })
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum State {
    /// No motor is on.
    Idle,
    /// Motors are on; the last cycle finished at this time.
    Watching(Stamp),
    /// It has been stopping the motors since this time.
    Stopping(Stamp),
    /// It stopped them, and the guarded process does not run.
    Stopped,
    Done,
}

/// The state machine of the guard, without I/O.
#[derive(Debug)]
struct Ward {
    post: Post,
    state: State,
    will: Vec<CanFrame>,
    /// Bits of motors whose brakes are engaged first.
    engages_first: u16,
    /// The guarded process has ended.
    is_orphan: bool,
}

impl Ward {
    fn new(post: Post) -> Self {
        Self { post, state: State::Idle, will: Vec::with_capacity(MAX_MOTORS), engages_first: 0, is_orphan: false }
    }

    fn receive(&mut self, message: &[u8], now: Stamp) {
        match message {
            [ON, low, high, frames @ ..] => {
                self.engages_first = u16::from_le_bytes([*low, *high]);
                self.will.clear();
                self.will.extend(frames.as_chunks::<FRAME>().0.iter().map(decode));
                self.state = State::Watching(now);
            }
            [DISMISSED, ..] => self.state = State::Done,
            _ => self.state = State::Idle,
        }
    }

    /// The guarded process has ended.
    fn lose(&mut self, now: Stamp) {
        self.is_orphan = true;
        self.state = match self.state {
            State::Watching(_) => State::Stopping(now),
            State::Stopping(since) => State::Stopping(since),
            State::Idle | State::Stopped | State::Done => State::Done,
        };
    }

    /// How long motors are kept on: not at all if all go limp.
    fn keep_for(&self) -> Duration {
        if self.will.iter().all(|frame| self.post.off.contains(frame)) { Duration::ZERO } else { KEEP_FOR }
    }

    /// The frames to send now, if any.
    fn due(&mut self, now: Stamp) -> &[CanFrame] {
        if let State::Watching(received) = self.state
            && now.since(received) >= self.post.stalled_after
        {
            self.state = State::Stopping(now);
        }
        let State::Stopping(since) = self.state else { return &[] };
        let (passed, keep_for) = (now.since(since), self.keep_for());
        if passed >= keep_for + DISABLE_FOR {
            self.state = if self.is_orphan { State::Done } else { State::Stopped };
        }
        if passed < keep_for { &self.will } else { &self.post.off }
    }

    /// Bits of the motors whose brakes are to be engaged by now. All are engaged early enough for the slowest to hold
    /// its joint when motors are disabled.
    fn engages(&self, now: Stamp) -> u16 {
        match self.state {
            State::Stopping(since) if now.since(since) + BrakeSpec::SLOWEST < self.keep_for() => self.engages_first,
            State::Stopping(_) | State::Stopped => u16::MAX,
            State::Done if self.is_orphan => u16::MAX,
            State::Idle | State::Watching(_) | State::Done => 0,
        }
    }

    /// When to call [`Self::due`] again without a message; `None` means never.
    fn next(&self, now: Stamp) -> Option<Duration> {
        match self.state {
            State::Watching(received) => Some(received.after(self.post.stalled_after).since(now)),
            State::Stopping(_) => Some(ROUND),
            State::Done => Some(Duration::ZERO),
            State::Idle | State::Stopped => None,
        }
    }
}

/// Guards the adapter on standard output until standard input closes; `args` are those after argument 0.
pub fn run(args: impl Iterator<Item = OsString>) -> ExitCode {
    let Some(post) = Post::read(args) else { return ExitCode::from(2) };
    // Sets /proc/PID/comm, which is otherwise the name of the executable.
    let _ = std::fs::write("/proc/self/comm", NAME);
    // Neither is needed on an idle machine; thread `control` has reported missing permissions.
    let _ = use_fifo(CONTROL_PRIORITY);
    let _ = lock_memory();
    let (input, output, error) = (std::io::stdin(), std::io::stdout(), std::io::stderr());
    let mut ward = Ward::new(post);
    if !guard(&mut ward, input.as_fd(), output.as_fd()) {
        return ExitCode::SUCCESS;
    }
    // The motors are off: logging may block now.
    let kept = if ward.keep_for().is_zero() { "disabled" } else { "stopped as `other_fault` states, then disabled" };
    let text = format!("rapid ended while its motors were on: its guard {kept} them\n");
    let _ = rustix::io::write(error.as_fd(), text.as_bytes());
    ExitCode::SUCCESS
}

/// Returns when nothing is left to guard: whether it stopped the motors of a process that has ended.
fn guard(ward: &mut Ward, input: BorrowedFd<'_>, output: BorrowedFd<'_>) -> bool {
    let mut claim = None;
    let mut has_sent = false;
    let mut brakes = Held::default();
    loop {
        listen(ward, &mut brakes, input);
        let now = Stamp::now();
        let adapter = ward.post.adapter;
        let frames = ward.due(now);
        if !frames.is_empty() {
            if !std::mem::replace(&mut has_sent, true) && adapter == CanAdapter::Slcan {
                // The last write may have sent half a line.
                let _ = rustix::io::write(output, b"\r");
            }
            for frame in frames {
                transmit(adapter, frame, output);
            }
            discard(adapter, output);
        }
        brakes.engage(ward.engages(now));
        if ward.is_orphan && claim.is_none() {
            // Until the motors are off no other program may command them.
            claim = ward.post.interface.as_deref().and_then(|name| Claim::acquire(name).ok());
        }
        if ward.state == State::Done {
            if ward.is_orphan && adapter == CanAdapter::Slcan {
                let _ = rustix::io::write(output, slcan::Command::Close.encode().bytes());
            }
            return has_sent && ward.is_orphan;
        }
        wait(ward.next(now), input, ward.is_orphan);
    }
}

/// Takes all messages that wait.
fn listen(ward: &mut Ward, brakes: &mut Held, input: BorrowedFd<'_>) {
    let mut message = [0; LONGEST];
    while !ward.is_orphan {
        let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(1))];
        let mut control = RecvAncillaryBuffer::new(&mut space);
        let mut parts = [IoSliceMut::new(&mut message)];
        match recvmsg(input, &mut parts, &mut control, RecvFlags::DONTWAIT | RecvFlags::CMSG_CLOEXEC) {
            Ok(RecvMsg { bytes: 0, .. }) | Err(Errno::CONNRESET) => ward.lose(Stamp::now()),
            Ok(RecvMsg { bytes, .. }) => match message.get(..bytes).unwrap_or_default() {
                [BRAKE, low, high, level] => {
                    brakes.set_line(u16::from_le_bytes([*low, *high]), *level == 1, descriptor(&mut control));
                }
                message => ward.receive(message, Stamp::now()),
            },
            Err(Errno::INTR) => {}
            Err(_) => return,
        }
    }
}

/// The descriptor of a message.
fn descriptor(control: &mut RecvAncillaryBuffer<'_>) -> Option<OwnedFd> {
    control.drain().find_map(|message| match message {
        RecvAncillaryMessage::ScmRights(mut descriptors) => descriptors.next(),
        _ => None,
    })
}

/// Waits for a message, up to this long.
fn wait(limit: Option<Duration>, input: BorrowedFd<'_>, is_orphan: bool) {
    let limit = limit.map(|limit| Timespec {
        tv_sec: limit.as_secs().try_into().unwrap_or(i64::MAX),
        tv_nsec: limit.subsec_nanos().into(),
    });
    let mut fds = [PollFd::from_borrowed_fd(input, PollFlags::IN)];
    // The end of the input stays readable.
    let count = usize::from(!is_orphan);
    let _ = poll(fds.get_mut(..count).unwrap_or_default(), limit.as_ref());
}

/// Sends a frame, if there is room for it: it is sent again in the next round.
fn transmit(adapter: CanAdapter, frame: &CanFrame, output: BorrowedFd<'_>) {
    let _ = match adapter {
        CanAdapter::SocketCan => socket::put(output, frame),
        CanAdapter::Slcan => rustix::io::write(output, slcan::encode(frame).bytes()),
        CanAdapter::Damiao => damiao_serial::encode(frame).map_or(Ok(0), |bytes| rustix::io::write(output, &bytes)),
    };
}

/// Discards the answers of motors: an adapter on a serial line that cannot deliver them may accept no more frames.
fn discard(adapter: CanAdapter, output: BorrowedFd<'_>) {
    // The queue of a socket drops frames when full.
    let is_line = adapter != CanAdapter::SocketCan;
    let mut bytes = [0; 4096];
    while is_line && rustix::io::read(output, &mut bytes).is_ok_and(|count| count == bytes.len()) {}
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::driver::can::guard::message::{OFF, encode};

    fn ward() -> Ward {
        let args = ["socketcan", "75", "can0", "5", "6"].map(OsString::from);
        Ward::new(Post::read(args.into_iter()).unwrap())
    }

    fn will(frames: &[CanFrame]) -> Vec<u8> {
        [ON, 2, 0].into_iter().chain(frames.iter().flat_map(encode)).collect()
    }

    fn damping(slave: u16) -> CanFrame {
        CanFrame::standard(slave, [1, 2, 3, 4, 0, 5, 6, 7])
    }

    const START: Stamp = Stamp(1_000_000_000);

    fn at(ms: u64) -> Stamp {
        START.after(Duration::from_millis(ms))
    }

    #[test]
    fn its_arguments_are_parsed_back() {
        let post = ward().post;
        assert_eq!((post.adapter, post.stalled_after), (CanAdapter::SocketCan, Duration::from_millis(75)));
        assert_eq!((post.interface.as_deref(), post.off.len()), (Some("can0"), 2));
        for bad in [&["socketcan", "75", "can0"][..], &["usb", "75", "-", "5"], &["slcan", "x", "-", "5"], &["slcan"]] {
            assert_eq!(Post::read(bad.iter().map(OsString::from)), None, "{bad:?}");
        }
    }

    #[test]
    fn encoded_frames_round_trip() {
        let frame = damping(0x123);
        assert_eq!(decode(&encode(&frame)), frame);
    }

    #[test]
    fn nothing_is_sent_while_cycles_arrive_or_no_motor_is_on() {
        let mut ward = ward();
        for ms in 0..200 {
            ward.receive(&will(&[damping(5), damping(6)]), at(ms * 74));
            assert_eq!(ward.due(at(ms * 74 + 74)), &[], "{ms}");
        }
        ward.receive(&[OFF], at(20_000));
        assert_eq!(ward.due(at(30_000)), &[]);
        assert_eq!(ward.next(at(30_000)), None);
        ward.lose(at(30_000));
        assert_eq!(ward.due(at(30_000)), &[]);
        assert_eq!(ward.state, State::Done);
    }

    #[test]
    fn at_the_death_of_the_process_motors_stop_as_configured_and_are_later_disabled() {
        let mut ward = ward();
        let frames = [damping(5), damping(6)];
        ward.receive(&will(&frames), at(0));
        ward.lose(at(3));
        for ms in [3, 8, 5_002] {
            assert_eq!(ward.due(at(ms)), frames, "{ms}");
            assert_eq!(ward.next(at(ms)), Some(ROUND));
        }
        let off = ward.post.off.clone();
        assert_eq!(ward.due(at(5_003)), off);
        assert_eq!(ward.due(at(5_103)), off);
        assert_eq!(ward.state, State::Done);
    }

    #[test]
    fn brakes_engage_before_motors_that_were_kept_on_are_disabled() {
        let mut ward = ward();
        ward.receive(&will(&[damping(5), damping(6)]), at(0));
        assert_eq!(ward.engages(at(0)), 0);
        ward.lose(at(0));
        ward.due(at(0));
        for (ms, engages) in [(0, 2), (2_999, 2), (3_000, u16::MAX), (5_000, u16::MAX)] {
            assert_eq!(ward.engages(at(ms)), engages, "{ms}");
        }
        // If no motor is kept on there is no time for brakes.
        let mut ward = ward_of_limp();
        ward.due(at(1));
        assert_eq!(ward.engages(at(1)), u16::MAX);
    }

    fn ward_of_limp() -> Ward {
        let mut ward = ward();
        let off = ward.post.off.clone();
        ward.receive(&will(&off), at(0));
        ward.lose(at(1));
        ward
    }

    #[test]
    fn motors_that_are_to_be_limp_are_disabled_at_once() {
        let mut ward = ward_of_limp();
        let off = ward.post.off.clone();
        assert_eq!(ward.due(at(1)), off);
        ward.due(at(101));
        assert_eq!(ward.state, State::Done);
    }

    #[test]
    fn motors_of_a_stalled_process_are_stopped_and_it_is_watched_again_once_it_runs() {
        let mut ward = ward();
        let frames = [damping(5), damping(6)];
        ward.receive(&will(&frames), at(0));
        assert_eq!(ward.next(at(0)), Some(Duration::from_millis(75)));
        assert_eq!(ward.due(at(75)), frames);
        ward.receive(&will(&frames), at(300));
        assert_eq!(ward.due(at(301)), &[]);
        // It stalls permanently.
        assert_eq!(ward.due(at(375)), frames);
        let off = ward.post.off.clone();
        assert_eq!(ward.due(at(5_375)), off);
        ward.due(at(5_475));
        assert_eq!((ward.state, ward.next(at(5_475))), (State::Stopped, None));
        ward.receive(&will(&frames), at(9_000));
        assert_eq!(ward.state, State::Watching(at(9_000)));
        ward.receive(&[DISMISSED], at(9_001));
        assert_eq!(ward.state, State::Done);
    }
}
