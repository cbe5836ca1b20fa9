//! The side of the program that gives an order.

use std::fs;
use std::io::{self, BufRead, BufReader, ErrorKind, Read, Write};
use std::os::unix::fs::MetadataExt as _;
use std::os::unix::net::UnixStream;
use std::time::Duration;

use rapid_core::action::Order;
use rapid_core::text::{plain, unanswered};
use rapid_core::time::Stamp;
use rapid_status::attach::ATTACH;
use rapid_system::peer::{Peer, ProcessState};
use rustix::net::{AddressFamily, SocketAddrUnix, SocketFlags, SocketType, socket_with};
use serde::Serialize;

use super::{Answer, DONE, LONGEST, LONGEST_ANSWER, instance_part, line, this_user};

/// A run answers within milliseconds; a stopped process does not.
const ANSWER_LIMIT: Duration = Duration::from_secs(2);
/// How long a run is retried whose socket accepts no connection at the moment, if no other can be reached...
const BUSY_LIMIT: Duration = Duration::from_secs(1);
/// ...and how often.
const BUSY_AGAIN: Duration = Duration::from_millis(2);
/// The sockets of this network namespace, see proc(5). An abstract name begins with `@` there.
const SOCKETS: &str = "/proc/net/unix";
/// The flag there of a socket that accepts connections (`__SO_ACCEPTCON`, linux/net.h).
const ACCEPTS: u32 = 1 << 16;

/// Why an order was not carried out.
#[derive(Debug, thiserror::Error)]
pub enum GiveError {
    /// No run of that instance and user.
    #[error("{}", no_run(.instance.as_deref(), .others))]
    NoRun {
        /// The instance.
        instance: Option<String>,
        /// Runs of other instances and users.
        others: Vec<Other>,
    },
    /// Several runs.
    #[error(
        "several runs are active (processes {0:?}): run this as the user of one of them, or name it with --instance"
    )]
    Several(Vec<u32>),
    /// The run refused it.
    #[error("process {process}: {why}")]
    Refused {
        /// Its process.
        process: u32,
        /// Its reason.
        why: String,
    },
    /// The run does not answer.
    #[error(
        "process {process} {}: if it has motors they may still move, so cut their power, or end it with `kill -9 \
         {process}`, after which its guard stops them", standstill(*.process, .error)
    )]
    NoAnswer {
        /// Its process.
        process: u32,
        /// Why not.
        error: io::Error,
    },
    /// The run did not answer a request.
    #[error("process {process}: {}", unanswered(.error))]
    Unanswered {
        /// Its process.
        process: u32,
        /// Why not.
        error: io::Error,
    },
    /// The run is stopped, and has a request that it will carry out once it continues.
    #[error(
        "process {0} is stopped (by ctrl-z, or `kill -STOP`) and carries this out only when it continues: \
         `kill -CONT {0}`, or `fg` in its terminal"
    )]
    Stopped(u32),
    /// The running instances cannot be determined.
    #[error("{SOCKETS}: {0}")]
    Sockets(#[from] io::Error),
}

fn standstill(process: u32, error: &io::Error) -> String {
    if ProcessState::read(process) == ProcessState::Stopped {
        format!("is stopped (`kill -CONT {process}` continues it) and does not answer")
    } else {
        format!("does not answer ({})", unanswered(error))
    }
}

fn no_run(instance: Option<&str>, others: &[Other]) -> String {
    let what = instance.map_or_else(|| "no rapid".to_owned(), |name| format!("no rapid of instance {name}"));
    if others.is_empty() {
        return format!("{what} runs here: start it");
    }
    let others: Vec<String> = others.iter().map(ToString::to_string).collect();
    format!("{what} runs here for this user, but {}", others.join(", "))
}

/// A run of another instance or user.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Other {
    process: String,
    user: String,
    /// `None`: it has no name.
    instance: Option<String>,
}

impl std::fmt::Display for Other {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { process, user, instance } = self;
        let is_this_user = user.parse() == Ok(this_user());
        let of_user = if is_this_user { String::new() } else { format!(" of user {user}") };
        write!(f, "process {process}{of_user} does")?;
        // Any user can create a socket of any name.
        instance.iter().try_for_each(|name| write!(f, " (`--instance {}`)", plain(name)))
    }
}

/// Gives an order to the run of `instance`, and returns once it was carried out; a disarm goes to every one, if root
/// gives it and several users run one.
///
/// # Errors
/// When no run has carried it out.
pub fn give(instance: Option<&str>, order: Order) -> Result<(), GiveError> {
    let given = Stamp::now();
    // Names are arbitrary bytes, chosen by any user.
    let sockets = String::from_utf8_lossy(&fs::read(SOCKETS)?).into_owned();
    let (runs, busy) = runs(&sockets, instance)?;
    // Of a process that is not a run of this user only the name of its socket is known.
    let busy = busy.into_iter().find(|process| is_of_this_user(*process));
    let unreached = busy.map(|process| GiveError::NoAnswer { process, error: ErrorKind::WouldBlock.into() });
    if runs.is_empty() {
        if let Some(error) = unreached {
            return Err(error);
        }
        let others = sockets.lines().filter_map(|line| other_of(line, instance)).collect();
        return Err(GiveError::NoRun { instance: instance.map(str::to_owned), others });
    }
    if matches!(order, Order::Arm | Order::ArmBack) {
        if runs.len() > 1 {
            return Err(GiveError::Several(runs.iter().map(|run| run.process).collect()));
        }
        // If several run, one of them is not armed either while another cannot be reached.
        if let Some(error) = unreached {
            return Err(error);
        }
    }
    let sent: Vec<_> = runs.into_iter().map(|run| (run.process, run.send(order, given))).collect();
    // All of them receive the order before the first answer is waited for.
    sent.into_iter().try_for_each(|(process, sent)| {
        let why = sent.and_then(answer).map_err(|error| GiveError::NoAnswer { process, error })?;
        if why == DONE { Ok(()) } else { Err(GiveError::Refused { process, why }) }
    })?;
    unreached.map_or(Ok(()), Err)
}

/// Makes a request to the run of `instance`, a [`SessionRequest`](rapid_status::session::SessionRequest) or a
/// [`RegistryRequest`](rapid_status::RegistryRequest); the answer, once it is carried out.
///
/// # Errors
/// When no run has carried it out.
pub fn request(instance: Option<&str>, request: &impl Serialize) -> Result<String, GiveError> {
    let run = the_run(instance)?;
    let process = run.process;
    let answer = run.ask(request)?;
    if answer.ok { Ok(answer.text) } else { Err(GiveError::Refused { process, why: answer.text }) }
}

/// Attaches a screen to the run of `instance`: the link to it and its process.
///
/// # Errors
/// When there is no such run, or several.
pub fn attach(instance: Option<&str>, read_only: bool) -> Result<(UnixStream, u32), GiveError> {
    let Run { mut stream, process, .. } = the_run(instance)?;
    let word = ATTACH[usize::from(read_only)];
    let asked = stream.write_all(format!("{word}\n").as_bytes());
    asked.map_err(|error| GiveError::Unanswered { process, error })?;
    Ok((stream, process))
}

/// The one run of `instance`.
fn the_run(instance: Option<&str>) -> Result<Run, GiveError> {
    let sockets = String::from_utf8_lossy(&fs::read(SOCKETS)?).into_owned();
    let (mut runs, _) = runs(&sockets, instance)?;
    match (runs.pop(), runs.is_empty()) {
        (Some(run), true) => Ok(run),
        (Some(last), false) => Err(GiveError::Several(runs.iter().chain([&last]).map(|run| run.process).collect())),
        (None, _) => {
            let others = sockets.lines().filter_map(|line| other_of(line, instance)).collect();
            Err(GiveError::NoRun { instance: instance.map(str::to_owned), others })
        }
    }
}

fn is_of_this_user(process: u32) -> bool {
    fs::metadata(format!("/proc/{process}")).is_ok_and(|about| about.uid() == this_user())
}

/// A run that may be given orders.
struct Run {
    stream: UnixStream,
    process: u32,
    user: u32,
    group: u32,
}

impl Run {
    /// Whether a run of another user may accept what this one sends.
    fn is_permitted(&self) -> bool {
        let is_member =
            || rustix::process::getgroups().is_ok_and(|all| all.iter().any(|one| one.as_raw() == self.group));
        this_user() == 0 || rustix::process::getegid().as_raw() == self.group || is_member()
    }

    fn send(mut self, order: Order, given: Stamp) -> io::Result<UnixStream> {
        self.stream.write_all(line(order, given).as_bytes())?;
        Ok(self.stream)
    }

    /// Waits as long as the run does not stand still: an episode may take minutes to be closed, or to begin.
    fn ask(mut self, request: &impl Serialize) -> Result<Answer, GiveError> {
        let process = self.process;
        let failed = |error| GiveError::Unanswered { process, error };
        let line = format!("{}\n", serde_json::to_string(request).map_err(|error| failed(error.into()))?);
        if line.len() > LONGEST {
            return Ok(Answer {
                ok: false,
                text: format!(
                    "the text is too long: {} bytes with the rest of the request, of at most {LONGEST}",
                    line.len()
                ),
            });
        }
        self.stream.write_all(line.as_bytes()).map_err(failed)?;
        let mut from = BufReader::new(self.stream.take(LONGEST_ANSWER));
        let mut line = Vec::new();
        // What was read before a limit is kept.
        while let Err(error) = from.read_until(b'\n', &mut line) {
            if error.kind() != ErrorKind::WouldBlock {
                return Err(failed(error));
            }
            if ProcessState::read(process) == ProcessState::Stopped {
                return Err(GiveError::Stopped(process));
            }
        }
        if line.is_empty() {
            return Err(failed(ErrorKind::UnexpectedEof.into()));
        }
        // An older rapid knows no requests; its answer is its reason.
        let other = |_| failed(io::Error::other(String::from_utf8_lossy(&line).trim_end().to_owned()));
        serde_json::from_slice(&line).map_err(other)
    }
}

/// Those of this user; if it has none, those of a group that it is a member of, and for root everyone's. And the process numbers, taken from the names of their sockets,
/// of those that accepted no connection.
///
/// Any user can create a socket with such a name and accept nothing: none is waited for while another can be reached.
fn runs(sockets: &str, instance: Option<&str>) -> io::Result<(Vec<Run>, Vec<u32>)> {
    let mut names: Vec<&str> = sockets.lines().filter_map(|line| name_of(line, instance)).collect();
    let (mut ours, mut others) = (Vec::new(), Vec::new());
    let end = Stamp::now().after(BUSY_LIMIT);
    loop {
        let mut busy = Vec::new();
        for name in names {
            match connect(name) {
                Ok(run) if run.user == this_user() => ours.push(run),
                Ok(run) => others.push(run),
                Err(error) if error.kind() == ErrorKind::WouldBlock => busy.push(name),
                // One that has ended meanwhile does not count.
                Err(_) => {}
            }
        }
        if busy.is_empty() || !ours.is_empty() || Stamp::now() >= end {
            let busy = busy.iter().filter_map(|name| process_of(name)).collect();
            if ours.is_empty() {
                ours = others;
                ours.retain(Run::is_permitted);
            }
            return Ok((ours, busy));
        }
        names = busy;
        std::thread::sleep(BUSY_AGAIN);
    }
}

/// Connects to the run that owns this socket, without waiting.
fn connect(name: &str) -> io::Result<Run> {
    let address = SocketAddrUnix::new_abstract_name(name.as_bytes())?;
    let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
    let socket = socket_with(AddressFamily::UNIX, SocketType::STREAM, flags, None)?;
    rustix::net::connect(&socket, &address)?;
    let stream = UnixStream::from(socket);
    stream.set_nonblocking(false)?;
    stream.set_read_timeout(Some(ANSWER_LIMIT))?;
    stream.set_write_timeout(Some(ANSWER_LIMIT))?;
    let Peer { process, user, group } = Peer::from_stream(&stream)?;
    // The number in the socket's name, where its processes are not visible from here.
    let process = process.or_else(|| process_of(name)).unwrap_or_default();
    Ok(Run { stream, process, user, group })
}

/// The process in the name of a socket.
fn process_of(name: &str) -> Option<u32> {
    name.rsplit('/').next()?.parse().ok()
}

/// The name in a line of [`SOCKETS`], if a run of `instance` listens there.
fn name_of<'a>(line: &'a str, instance: Option<&str>) -> Option<&'a str> {
    parts_of(line).filter(|[_, _, of, _]| *of == instance_part(instance)).map(|[name, ..]| name)
}

/// The run of another instance or user in a line of [`SOCKETS`], if one listens there.
fn other_of(line: &str, instance: Option<&str>) -> Option<Other> {
    let [_, user, of, process] = parts_of(line)?;
    let is_meant = of == instance_part(instance) && user.parse() == Ok(this_user());
    let instance = (of != instance_part(None)).then(|| of.to_owned());
    (!is_meant).then(|| Other { process: process.to_owned(), user: user.to_owned(), instance })
}

/// Name, user, instance and process in a line of [`SOCKETS`], if a run listens there.
fn parts_of(line: &str) -> Option<[&str; 4]> {
    let mut columns = line.split_ascii_whitespace();
    let flags = u32::from_str_radix(columns.nth(3)?, 16).ok()?;
    // A connection has the name of the socket that accepted it.
    let name = columns.nth(3).filter(|_| flags & ACCEPTS != 0)?.strip_prefix('@')?;
    let mut parts = name.strip_prefix("rapid/")?.split('/');
    let (user, of, process) = (parts.next()?, parts.next()?, parts.next()?);
    let is_number = |part: &str| part.parse::<u32>().is_ok();
    (is_number(user) && is_number(process) && parts.next().is_none()).then_some([name, user, of, process])
}

fn answer(stream: UnixStream) -> io::Result<String> {
    let mut line = String::new();
    BufReader::new(stream.take(LONGEST as u64)).read_line(&mut line)?;
    if line.ends_with('\n') { Ok(line.trim_end().to_owned()) } else { Err(io::ErrorKind::UnexpectedEof.into()) }
}

#[cfg(test)]
mod tests {
    use std::os::linux::net::SocketAddrExt as _;
    use std::os::unix::net::{SocketAddr, UnixListener};

    use super::*;

    fn listener(name: &[u8]) -> UnixListener {
        UnixListener::bind_addr(&SocketAddr::from_abstract_name(name).unwrap()).unwrap()
    }

    #[test]
    fn a_socket_whose_name_is_not_text_blocks_no_order() {
        let name = [format!("rapid-give-{}-", std::process::id()).as_bytes(), &[0xff, 0xfe]].concat();
        let _listener = listener(&name);
        let given = give(Some("no-such-rig"), Order::Disarm);
        assert!(matches!(given, Err(GiveError::NoRun { .. })), "{given:?}");
    }

    #[test]
    fn a_run_that_accepts_nothing_is_named() {
        let (instance, process) = ("accepts-nothing", std::process::id());
        let name = format!("rapid/{}/{}/{process}", this_user(), instance_part(Some(instance)));
        let listener = listener(name.as_bytes());
        // As few wait as possible: the system's own number is above the usual limit of open files.
        rustix::net::listen(&listener, 0).unwrap();
        let mut waiting = Vec::new();
        while let Ok(run) = connect(&name) {
            waiting.push(run);
        }
        let given = give(Some(instance), Order::Disarm);
        assert!(matches!(given, Err(GiveError::NoAnswer { process: named, .. }) if named == process), "{given:?}");
    }

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
