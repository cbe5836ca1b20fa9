//! `rapid monitor`: the monitor of a run of another process.
//!
//! Invariant: whatever happens here, the run continues; and a run that has ended is waited for, since a service is started
//! again within seconds.

use std::io::{BufReader, Write as _};
use std::os::unix::net::UnixStream;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::thread;
use std::time::Duration;

use rapid_core::action::Order;
use rapid_core::mask::PhysicalMask;
use rapid_core::time::Stamp;
use rapid_screens::tui::model::{Effect, Msg};
use rapid_screens::tui::{self, Closed, LinkState, RigLink, ScreenOptions, TuiError};
use rapid_status::attach::{Decoder, LinkError};
use rapid_status::{Command, DeviceState, Snapshot};
use rapid_system::peer::ProcessState;
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

use crate::app::signals::Signals;
use crate::orders::give::{self, GiveError};

/// Time between two attempts to reach the next run.
const AGAIN: Duration = Duration::from_secs(1);
/// Time between two attempts to reach the same run.
const SOON: Duration = Duration::from_millis(200);
/// A run sends ten snapshots a second: one that sends nothing for this long is stopped.
const SILENT: Duration = Duration::from_secs(3);
/// A run that takes no request for this long is stopped.
const WRITE_LIMIT: Duration = Duration::from_secs(2);

/// Why there is no monitor.
#[derive(Debug, thiserror::Error)]
pub enum MonitorError {
    /// No run can be reached.
    #[error(transparent)]
    Give(#[from] GiveError),
    /// The run does not send what it should.
    #[error("process {process}: {error}")]
    Link {
        /// The run.
        process: u32,
        /// What is wrong.
        error: LinkError,
    },
    /// The run is stopped.
    #[error(
        "process {0} is stopped (by ctrl-z, or `kill -STOP`): `kill -CONT {0}`, or `fg` in its terminal, continues it"
    )]
    Stopped(u32),
    /// No terminal, or it is gone.
    #[error(transparent)]
    Screen(#[from] TuiError),
}

/// Shows the run of `instance` until the user leaves.
///
/// # Errors
/// When there is no such run at the start, or no terminal.
pub async fn monitor(instance: Option<&str>, read_only: bool, shown: ScreenOptions) -> Result<(), MonitorError> {
    let mut signals = Signals::listen().map_err(TuiError::NoTerminal)?;
    let link = Remote::open(Wanted { instance: instance.map(str::to_owned), read_only })?;
    let shutdown = CancellationToken::new();
    let ended = shutdown.clone();
    tokio::spawn(async move {
        signals.next().await;
        ended.cancel();
    });
    match tui::show(link, shown, shutdown).await {
        // The connection of the user has ended, as with SIGHUP.
        Err(TuiError::Gone(_)) => Ok(()),
        outcome => Ok(outcome?),
    }
}

/// The run to be shown.
#[derive(Debug, Clone)]
pub(super) struct Wanted {
    pub(super) instance: Option<String>,
    pub(super) read_only: bool,
}

/// What the reading thread knows.
#[derive(Debug, Clone)]
struct View {
    snapshot: Snapshot,
    state: LinkState,
}

/// The link to the run.
struct Remote {
    wanted: Wanted,
    view: watch::Receiver<View>,
    requests: Sender<Outgoing>,
    answers: (Sender<Msg>, Receiver<Msg>),
}

/// For the writing thread.
enum Outgoing {
    /// From now on, this is the link.
    Link(UnixStream),
    Command(Command),
}

pub(super) struct Connection {
    process: u32,
    stream: UnixStream,
    decoder: Decoder,
    reader: BufReader<UnixStream>,
}

impl Connection {
    /// Connects; returns the first snapshot too.
    pub(super) fn open(wanted: &Wanted) -> Result<(Self, Snapshot), MonitorError> {
        let (stream, process) = give::attach(wanted.instance.as_deref(), wanted.read_only)?;
        let of = |error: LinkError| MonitorError::Link { process, error };
        let limits = stream.set_read_timeout(Some(SILENT)).and_then(|()| stream.set_write_timeout(Some(WRITE_LIMIT)));
        let reader = limits.and_then(|()| stream.try_clone()).map_err(|error| of(error.into()))?;
        let mut connection = Self { process, stream, decoder: Decoder::default(), reader: BufReader::new(reader) };
        let first = connection.read().map_err(|error| match ProcessState::read(process) {
            ProcessState::Stopped => MonitorError::Stopped(process),
            ProcessState::Alive | ProcessState::Ended => of(error),
        })?;
        Ok((connection, first))
    }

    pub(super) fn read(&mut self) -> Result<Snapshot, LinkError> {
        self.decoder.read(&mut self.reader)
    }
}

impl Remote {
    fn open(wanted: Wanted) -> Result<Self, MonitorError> {
        let (connection, snapshot) = Connection::open(&wanted)?;
        let process = connection.process;
        let state = LinkState::Attached { process, read_only: wanted.read_only };
        let (shown, view) = watch::channel(View { snapshot, state });
        let (requests, outgoing) = channel();
        let answers = channel();
        let (of, failures, of_link) = (wanted.clone(), answers.0.clone(), answers.0.clone());
        let to_writer = requests.clone();
        let threads = thread::Builder::new()
            .name("link".to_owned())
            .spawn(move || follow(connection, &of, &shown, &to_writer, &of_link))
            .and_then(|_| thread::Builder::new().name("requests".to_owned()).spawn(move || send(&outgoing, &failures)));
        threads.map_err(|error| MonitorError::Link { process, error: error.into() })?;
        Ok(Self { wanted, view, requests, answers })
    }

    /// Gives an order beside the link: one that is stuck must not hold up a disarm.
    fn order(&self, order: Order) {
        let (instance, answers) = (self.wanted.instance.clone(), self.answers.0.clone());
        // Without a thread there is no answer, and the log of the run shows no disarm.
        let _ = thread::Builder::new().name("order".to_owned()).spawn(move || {
            if let Err(error) = give::give(instance.as_deref(), order) {
                let is_arm = matches!(order, Order::Arm | Order::ArmBack);
                let answer = if is_arm { Msg::NotArmed } else { Msg::Failed };
                let _ = answers.send(answer(error.to_string()));
            }
        });
    }
}

/// Reads snapshots of the run, and of the next when it has ended. Ends with the screen.
fn follow(
    mut connection: Connection,
    wanted: &Wanted,
    shown: &watch::Sender<View>,
    requests: &Sender<Outgoing>,
    failures: &Sender<Msg>,
) {
    let read_only = wanted.read_only;
    loop {
        if let Ok(stream) = connection.stream.try_clone() {
            let _ = requests.send(Outgoing::Link(stream));
        }
        while let Ok(snapshot) = connection.read() {
            let state = LinkState::Attached { process: connection.process, read_only };
            if shown.send(View { snapshot, state }).is_err() {
                return;
            }
        }
        let since = Stamp::now();
        let mut failed = String::new();
        let (next, snapshot) = loop {
            let runs = ProcessState::read(connection.process) != ProcessState::Ended;
            shown.send_modify(|view| {
                view.state = LinkState::Lost { since, read_only, runs };
                if !runs {
                    ended(&mut view.snapshot);
                }
            });
            thread::sleep(if runs { SOON } else { AGAIN });
            if shown.is_closed() {
                return;
            }
            match Connection::open(wanted) {
                Ok(next) => break next,
                // Why a run that is there cannot be shown; once, and not at each attempt.
                Err(error) if runs && error.to_string() != failed => {
                    failed = error.to_string();
                    let _ = failures.send(Msg::Failed(failed.clone()));
                }
                Err(_) => {}
            }
        };
        connection = next;
        let state = LinkState::Attached { process: connection.process, read_only };
        shown.send_modify(|view| *view = View { snapshot, state });
    }
}

/// What is true of a run that has ended: nothing streams, and nothing is recorded.
fn ended(snapshot: &mut Snapshot) {
    (snapshot.recording, snapshot.mask) = (None, PhysicalMask::EMPTY);
    for device in &mut snapshot.devices {
        device.state = DeviceState::Absent;
        "the run has ended".clone_into(&mut device.detail);
    }
}

/// Writes requests to the link; ends with the screen.
fn send(outgoing: &Receiver<Outgoing>, failures: &Sender<Msg>) {
    let mut link: Option<UnixStream> = None;
    for one in outgoing {
        let command = match one {
            Outgoing::Link(stream) => {
                link = Some(stream);
                continue;
            }
            Outgoing::Command(command) => command,
        };
        // Commands have no maps with keys that are not text, the only thing that JSON refuses.
        let request = serde_json::to_string(&command).unwrap_or_default() + "\n";
        let sent = link.as_mut().map(|link| link.write_all(request.as_bytes()));
        if !matches!(sent, Some(Ok(()))) {
            let _ = failures.send(Msg::Failed("the run does not take this request".to_owned()));
        }
    }
}

impl RigLink for Remote {
    fn snapshot(&mut self) -> Snapshot {
        let View { mut snapshot, state } = self.view.borrow().clone();
        if matches!(state, LinkState::Lost { runs: false, .. }) {
            // Its clock is that of this machine and continues.
            snapshot.taken = Stamp::now();
        }
        snapshot
    }

    fn state(&self) -> LinkState {
        self.view.borrow().state
    }

    fn answer(&mut self) -> Option<Msg> {
        self.answers.1.try_recv().ok()
    }

    fn carry_out(&mut self, effect: Effect) -> Result<Option<Msg>, Closed> {
        match effect {
            Effect::None => {}
            Effect::Leave => return Err(Closed),
            Effect::Order(order) => self.order(order),
            // The writing thread ends only with this.
            Effect::Send(command) => drop(self.requests.send(Outgoing::Command(command))),
        }
        Ok(None)
    }
}
