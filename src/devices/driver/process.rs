//! Child processes: starts them so that no resources leak into them and they do not outlive this process, and ends
//! whole process groups.
//!
//! A child leads a session and group of its own: a Ctrl-C in our terminal does not reach it, and a signal reaches
//! everything it started. It inherits only the standard descriptors: a camera's node held open by an unknowing child
//! would keep the camera busy.
//!
//! Invariant: no shell.
//! Invariant: a group is signalled only before its leader is reaped, while no other process can have got its number.
//! Invariant: when this process ends, for any reason, the kernel kills the children. It does not kill their own
//! children: these end only if this process is still there to end the group. A script whose last command is
//! `exec PROGRAM` becomes that program.

use std::ffi::OsString;
use std::io;
use std::os::fd::OwnedFd;
use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::process::{Command, ExitStatus, Stdio};
use std::sync::mpsc;

use rustix::process::{
    Pid, PidfdFlags, Signal, getpid, getppid, kill_process_group, pidfd_open, set_parent_process_death_signal, setsid,
};
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;
use tokio::net::unix::pipe::Receiver;
use tokio::sync::oneshot;

use super::DriverError;

/// Specification of a process to start.
#[derive(Debug, Clone)]
pub struct Launch {
    /// The program.
    pub program: PathBuf,
    /// Its arguments.
    pub args: Vec<String>,
    /// Variables set in its environment or, with `None`, unset; the rest is inherited.
    pub env: Vec<(&'static str, Option<OsString>)>,
}

/// Starts children on a thread of its own: the kernel kills a child when the *thread* that started it ends (prctl(2),
/// `PR_SET_PDEATHSIG`), and tokio's threads come and go.
#[derive(Debug, Clone)]
pub struct Spawner {
    /// `None` if the thread could not be started.
    orders: Option<mpsc::Sender<Request>>,
}

#[derive(Debug)]
struct Request {
    launch: Launch,
    reply: oneshot::Sender<io::Result<Started>>,
}

/// A child and our ends of its pipes, before tokio knows them.
#[derive(Debug)]
struct Started {
    leader: Leader,
    pidfd: OwnedFd,
    stdout: OwnedFd,
    stderr: OwnedFd,
}

impl Spawner {
    /// Starts the thread, which ends with the last clone of this; children still running then are
    /// killed.
    pub fn start() -> Self {
        let (orders, inbox) = mpsc::channel::<Request>();
        let serve = move || {
            for Request { launch, reply } in inbox {
                // If the receiver is gone, dropping the child kills it.
                let _ = reply.send(start(&launch));
            }
        };
        let thread = std::thread::Builder::new().name("spawner".to_owned()).spawn(serve);
        Self { orders: thread.is_ok().then_some(orders) }
    }

    /// Starts a child.
    /// # Errors
    /// When the program cannot be run, temporarily or at all.
    pub async fn spawn(&self, launch: Launch) -> Result<Child, DriverError> {
        let program = launch.program.display().to_string();
        let (reply, answer) = oneshot::channel();
        let refused = || DriverError::Retry("the system gives no thread to start programs".to_owned());
        self.orders.as_ref().ok_or_else(refused)?.send(Request { launch, reply }).map_err(|_| refused())?;
        let started = answer.await.map_err(|_| refused())?;
        started.and_then(Child::new).map_err(|error| {
            let text = format!("{program}: {error}");
            match error.kind() {
                io::ErrorKind::NotFound | io::ErrorKind::PermissionDenied => DriverError::Fatal(text),
                _ if error.raw_os_error() == Some(libc::ENOEXEC) => DriverError::Fatal(text),
                _ => DriverError::Retry(text),
            }
        })
    }
}

fn start(launch: &Launch) -> io::Result<Started> {
    let mut command = Command::new(&launch.program);
    command.args(&launch.args).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    for (name, value) in &launch.env {
        match value {
            Some(value) => command.env(name, value),
            None => command.env_remove(name),
        };
    }
    let parent = getpid();
    // SAFETY: between fork and exec only system calls are made: no allocation, no lock. Errors are
    // plain numbers.
    unsafe { command.pre_exec(move || prepare(parent)) };
    let mut process = command.spawn()?;
    let (stdout, stderr) = (process.stdout.take(), process.stderr.take());
    let mut leader = Leader { process, reaped: false };
    let pidfd = pidfd_open(leader.pid()?, PidfdFlags::NONBLOCK).map_err(io::Error::from)?;
    let (Some(stdout), Some(stderr)) = (stdout, stderr) else {
        leader.kill();
        return Err(io::Error::other("no pipes"));
    };
    Ok(Started { leader, pidfd, stdout: stdout.into(), stderr: stderr.into() })
}

/// Runs in the child before the program does.
fn prepare(parent: Pid) -> io::Result<()> {
    setsid()?;
    set_parent_process_death_signal(Some(Signal::KILL))?;
    // This process may have ended before the line above.
    if getppid() != Some(parent) {
        return Err(io::Error::from_raw_os_error(libc::ESRCH));
    }
    leak_nothing();
    Ok(())
}

/// Keeps descriptors open here from being open in the program that this process becomes, except the standard ones.
/// Makes only a system call, as required between fork and exec.
pub(super) fn leak_nothing() {
    // Libraries open descriptors without O_CLOEXEC. Linux 5.11; before that they are inherited.
    // SAFETY: closes nothing now and takes no pointers.
    unsafe { libc::syscall(libc::SYS_close_range, 3, libc::c_uint::MAX, libc::CLOSE_RANGE_CLOEXEC) };
}

/// A running child. Dropped before it was reaped, it is killed.
#[derive(Debug)]
pub struct Child {
    leader: Leader,
    /// Readable once the leader has ended.
    pidfd: AsyncFd<OwnedFd>,
    /// Its standard output.
    pub stdout: Receiver,
    /// Its standard error.
    pub stderr: Receiver,
}

impl Child {
    fn new(started: Started) -> io::Result<Self> {
        let Started { leader, pidfd, stdout, stderr } = started;
        // SAFETY: the registered value owns the descriptor.
        let pidfd = unsafe { AsyncFd::register_with_interest(pidfd, Interest::READABLE)? };
        Ok(Self { leader, pidfd, stdout: Receiver::from_owned_fd(stdout)?, stderr: Receiver::from_owned_fd(stderr)? })
    }

    /// Its process id, which is also that of its group.
    pub fn id(&self) -> u32 {
        self.leader.process.id()
    }

    /// Waits for the leader's end without reaping it. Cancel-safe.
    pub async fn ended(&self) {
        // The readiness is never cleared: a process ends only once.
        if self.pidfd.readable().await.is_err() {
            // The tokio runtime is shutting down, and with it the waiting task.
            std::future::pending::<()>().await;
        }
    }

    /// Asks the whole group to end.
    pub fn terminate(&self) {
        self.leader.signal(Signal::TERM);
    }

    /// Kills the whole group.
    pub fn kill(&self) {
        self.leader.signal(Signal::KILL);
    }

    /// Takes the exit status of an ended leader, and kills the rest of its group.
    ///
    /// # Errors
    /// When it has not ended.
    pub fn reap(&mut self) -> io::Result<ExitStatus> {
        self.kill();
        let status = self.leader.process.try_wait()?.ok_or(io::ErrorKind::WouldBlock)?;
        self.leader.reaped = true;
        Ok(status)
    }
}

/// The process that was started: the group's leader.
#[derive(Debug)]
struct Leader {
    process: std::process::Child,
    reaped: bool,
}

impl Leader {
    fn pid(&self) -> io::Result<Pid> {
        Pid::from_raw(self.process.id().cast_signed()).ok_or_else(|| io::ErrorKind::InvalidData.into())
    }

    fn signal(&self, signal: Signal) {
        // An ended process needs no signal.
        if let (false, Ok(pid)) = (self.reaped, self.pid()) {
            let _ = kill_process_group(pid, signal);
        }
    }

    fn kill(&mut self) {
        self.signal(Signal::KILL);
        // A process that survives even this is left to the kernel.
        self.reaped = matches!(self.process.try_wait(), Ok(Some(_)));
    }
}

impl Drop for Leader {
    fn drop(&mut self) {
        if !self.reaped {
            self.kill();
        }
    }
}
