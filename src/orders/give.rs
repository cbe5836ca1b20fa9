//! The side of whoever gives an order.

use std::fs;
use std::io::{self, BufRead, BufReader, Read, Write};
use std::os::unix::net::UnixStream;
use std::time::Duration;

use super::{DONE, LONGEST, address, instance_part, line, this_user};
use crate::action::Order;
use crate::peer::Peer;
use crate::time::Stamp;

/// A run answers within milliseconds; one that is stopped does not.
const ANSWER_LIMIT: Duration = Duration::from_secs(2);
/// The sockets of this network namespace, see proc(5). An abstract name begins with `@` there.
const SOCKETS: &str = "/proc/net/unix";
/// Of the flags there: it accepts connections (`__SO_ACCEPTCON`, linux/net.h).
const ACCEPTS: u32 = 1 << 16;

/// Why an order was not carried out.
#[derive(Debug, thiserror::Error)]
pub enum GiveError {
    /// No run of that instance.
    #[error("{}", no_run(.0.as_deref()))]
    NoRun(Option<String>),
    /// Runs of several users.
    #[error("several runs are here (processes {0:?}): arm as the user of one of them")]
    Several(Vec<u32>),
    /// The run answered so.
    #[error("process {process}: {why}")]
    Refused {
        /// Its process.
        process: u32,
        /// Its reason.
        why: String,
    },
    /// The run does not answer.
    #[error(
        "process {process} does not answer ({error}): end it, with `kill -9 {process}` if nothing else does; its motors \
         then stop by their own time limit"
    )]
    NoAnswer {
        /// Its process.
        process: u32,
        /// Why not.
        error: io::Error,
    },
    /// What runs cannot be found out.
    #[error("{SOCKETS}: {0}")]
    Sockets(#[from] io::Error),
}

fn no_run(instance: Option<&str>) -> String {
    match instance {
        None => "no rapid runs here: start it, or name it with --instance".to_owned(),
        Some(name) => format!("no rapid runs here as instance {name}: start it"),
    }
}

/// Gives an order to the run of `instance`, and returns once it was carried out; a disarm to every one, if root gives it
/// and several users run one.
///
/// # Errors
/// When no run has carried it out.
pub fn give(instance: Option<&str>, order: Order) -> Result<(), GiveError> {
    let given = Stamp::now();
    let runs = runs(instance)?;
    if runs.is_empty() {
        return Err(GiveError::NoRun(instance.map(str::to_owned)));
    }
    if matches!(order, Order::Arm | Order::ArmBack) && runs.len() > 1 {
        return Err(GiveError::Several(runs.iter().map(|run| run.process).collect()));
    }
    let sent: Vec<_> = runs.into_iter().map(|run| (run.process, run.send(order, given))).collect();
    // Each has its order before the first is waited for.
    sent.into_iter().try_for_each(|(process, sent)| {
        let why = sent.and_then(answer).map_err(|error| GiveError::NoAnswer { process, error })?;
        if why == DONE { Ok(()) } else { Err(GiveError::Refused { process, why }) }
    })
}

/// A run that may be given orders.
struct Run {
    stream: UnixStream,
    process: u32,
}

impl Run {
    fn send(mut self, order: Order, given: Stamp) -> io::Result<UnixStream> {
        self.stream.write_all(line(order, given).as_bytes())?;
        Ok(self.stream)
    }
}

/// Those of this user; where root has none, everyone's.
fn runs(instance: Option<&str>) -> io::Result<Vec<Run>> {
    let sockets = fs::read_to_string(SOCKETS)?;
    let mut ours = Vec::new();
    let mut others = Vec::new();
    for name in sockets.lines().filter_map(|line| name_of(line, instance)) {
        // One that has ended meanwhile is none.
        let Ok(stream) = address(name).and_then(|address| UnixStream::connect_addr(&address)) else { continue };
        stream.set_read_timeout(Some(ANSWER_LIMIT))?;
        stream.set_write_timeout(Some(ANSWER_LIMIT))?;
        let Peer { process, user } = Peer::of(&stream)?;
        // As it numbers itself, where its processes are not seen from here.
        let process = process.or_else(|| name.rsplit('/').next()?.parse().ok()).unwrap_or_default();
        if user == this_user() { &mut ours } else { &mut others }.push(Run { stream, process });
    }
    Ok(if ours.is_empty() && this_user() == 0 { others } else { ours })
}

/// The name in a line of [`SOCKETS`], if a run of `instance` listens there.
fn name_of<'a>(line: &'a str, instance: Option<&str>) -> Option<&'a str> {
    let mut columns = line.split_ascii_whitespace();
    let flags = u32::from_str_radix(columns.nth(3)?, 16).ok()?;
    // A connection has the name of the socket that accepted it.
    let name = columns.nth(3).filter(|_| flags & ACCEPTS != 0)?.strip_prefix('@')?;
    let mut parts = name.strip_prefix("rapid/")?.split('/');
    let (user, of, process) = (parts.next()?, parts.next()?, parts.next()?);
    let is_number = |part: &str| part.parse::<u32>().is_ok();
    (is_number(user) && of == instance_part(instance) && is_number(process) && parts.next().is_none()).then_some(name)
}

fn answer(stream: UnixStream) -> io::Result<String> {
    let mut line = String::new();
    BufReader::new(stream.take(LONGEST as u64)).read_line(&mut line)?;
    if line.ends_with('\n') { Ok(line.trim_end().to_owned()) } else { Err(io::ErrorKind::UnexpectedEof.into()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_is_found_by_its_instance_among_other_sockets() {
        let line = |name: &str| format!("0000000000000000: 00000002 00000000 00010000 0001 01 26743 {name}");
        let accepted = line("@rapid/1000/-/77").replace("00010000", "00000000");
        assert_eq!(name_of(&accepted, None), None);
        for (name, instance, is_found) in [
            ("@rapid/1000/-/77", None, true),
            ("@rapid/1000/left/77", Some("left"), true),
            ("@rapid/1000/left/77", None, false),
            ("@rapid/1000/-/77", Some("left"), false),
            ("@rapid/1000/left/77", Some("lef"), false),
            ("/rapid/1000/-/77", None, false),
            ("@rapid/1000/-/77/1", None, false),
            ("@rapid/x/-/77", None, false),
            ("@rapid/1000/-/", None, false),
            ("", None, false),
        ] {
            assert_eq!(name_of(&line(name), instance).is_some(), is_found, "{name} for {instance:?}");
        }
    }
}
