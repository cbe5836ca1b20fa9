//! The task of one child process: starts it, waits for its end or ends it, and reaps it.
//!
//! On a stop request the child's process group gets SIGTERM, then after 5 s SIGKILL; processes that outlive the group's
//! leader get SIGKILL at once.

use std::os::unix::process::ExitStatusExt;
use std::process::ExitStatus;
use std::time::Duration;

use rapid_bus::Membership;
use rapid_devices::driver::DriverError;
use rapid_devices::driver::process::{Child, Launch};
use rapid_status::Level;
use tokio::sync::{OwnedMutexGuard, oneshot};
use tokio::time::{sleep, timeout};
use tokio_util::sync::CancellationToken;

use super::super::output::Output;
use super::super::programs::{Programs, TERM_LIMIT};

/// How long a child's last samples are kept for their reader.
const LAST_SAMPLES: Duration = Duration::from_secs(1);

/// Everything the task owns.
#[derive(Debug)]
pub(super) struct Supervisor {
    pub(super) name: String,
    pub(super) programs: Programs,
    pub(super) membership: Membership,
    /// Cancelled when the child must end.
    pub(super) stop: CancellationToken,
    /// The entry's turn: released when the child is gone.
    pub(super) turn: OwnedMutexGuard<()>,
    /// Receives the process id, or why there is none.
    pub(super) started: oneshot::Sender<Result<u32, DriverError>>,
    /// Receives how the child ended.
    pub(super) ended: oneshot::Sender<String>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum End {
    /// By itself, or on SIGTERM.
    Own,
    Killed,
}

impl Supervisor {
    /// From the start of the child to its end.
    pub(super) async fn keep(self, launch: Launch) {
        let Self { name, programs, membership, stop, turn, started, ended } = self;
        let mut child = match programs.spawner.spawn(launch).await {
            Ok(child) => child,
            Err(error) => {
                let _ = started.send(Err(error));
                return;
            }
        };
        let id = child.id();
        // If the stream has been asked to stop meanwhile, there is no receiver, here and below.
        let _ = started.send(Ok(id));
        programs.logbook.write(&name, &format!("started as process {id}"));
        let mut output = Output::new(&name, None, &programs);
        let end = tokio::select! {
            biased;
            end = until_end(&child, &stop, &programs.hurry) => end,
            () = output.follow(&child.stdout, &child.stderr) => End::Own,
        };
        output.finish(&child.stdout, &child.stderr);
        let reason = match child.reap() {
            Ok(status) => describe(status),
            Err(error) => format!("its process {id} cannot be reaped: {error}"),
        };
        if end == End::Killed {
            output.note(Level::Warn, &format!("process {id} did not end on SIGTERM and was killed"));
        }
        programs.logbook.write(&name, &reason);
        tracing::debug!(device = %name, process = id, "{reason}");
        let _ = ended.send(reason);
        // The child's last samples are lost with its memory.
        let _ = timeout(LAST_SAMPLES, stop.cancelled()).await;
        // The runtime reports a panic in there; it only leaves files behind.
        let _ = tokio::task::spawn_blocking(move || membership.sweep()).await;
        drop(turn);
    }
}

/// Waits for the child's end, and causes it on request.
async fn until_end(child: &Child, stop: &CancellationToken, hurry: &CancellationToken) -> End {
    tokio::select! {
        biased;
        () = child.ended() => return End::Own,
        () = stop.cancelled() => child.terminate(),
    }
    tokio::select! {
        biased;
        () = child.ended() => return End::Own,
        () = hurry.cancelled() => {}
        () = sleep(TERM_LIMIT) => {}
    }
    child.kill();
    child.ended().await;
    End::Killed
}

/// How a process ended, for people.
pub(in crate::rig) fn describe(status: ExitStatus) -> String {
    match (status.code(), status.signal()) {
        (Some(code), _) => format!("its process ended with code {code}"),
        (None, Some(signal)) => match rustix::process::Signal::from_named_raw(signal).and_then(name) {
            Some(name) => format!("its process was ended by {name}"),
            None => format!("its process was ended by signal {signal}"),
        },
        (None, None) => format!("its process ended: {status}"),
    }
}

/// Names of the signals that end programs.
fn name(signal: rustix::process::Signal) -> Option<&'static str> {
    use rustix::process::Signal;
    const NAMES: [(Signal, &str); 10] = [
        (Signal::SEGV, "SIGSEGV"),
        (Signal::ABORT, "SIGABRT"),
        (Signal::BUS, "SIGBUS"),
        (Signal::FPE, "SIGFPE"),
        (Signal::ILL, "SIGILL"),
        (Signal::PIPE, "SIGPIPE"),
        (Signal::INT, "SIGINT"),
        (Signal::HUP, "SIGHUP"),
        (Signal::TERM, "SIGTERM"),
        (Signal::KILL, "SIGKILL"),
    ];
    NAMES.iter().find(|(named, _)| *named == signal).map(|(_, name)| *name)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_exit_status_is_described_in_words() {
        // As wait(2) encodes them: the code in the second byte, a signal in the first.
        for (raw, reported) in [
            (0, "its process ended with code 0"),
            (3 << 8, "its process ended with code 3"),
            (11, "its process was ended by SIGSEGV"),
            (128 + 6, "its process was ended by SIGABRT"),
            (34, "its process was ended by signal 34"),
        ] {
            assert_eq!(describe(ExitStatus::from_raw(raw)), reported);
        }
    }
}
