//! The thread of a place: opens it, follows the levels of its inputs, and reopens it after a loss.
//!
//! Invariant: between two levels it sleeps in the kernel, and wakes when there is something to read, when the input has
//! been silent for too long, when it has to be queried, or at the end.

use std::os::fd::{AsFd, OwnedFd};
use std::time::Duration;

use rapid_core::time::Stamp;
use rustix::event::{PollFd, PollFlags, Timespec, poll};

use super::source::InputSource;
use super::{InputGroup, Report, lost_at_a_panic};

/// Time between a loss of a place and its reopening.
const AGAIN: Duration = Duration::from_millis(500);

#[derive(Debug, PartialEq, Eq)]
pub(super) enum Woken {
    /// The run ends.
    Stop,
    /// There is something to read, or with `true` the input has ended.
    Ready(bool),
    /// The moment has been reached.
    Late,
}

/// Sleeps until the end of the run, until `input` can be read, or until a moment.
pub(super) fn wait(stop: &OwnedFd, input: Option<&dyn AsFd>, until: Option<Stamp>) -> Woken {
    loop {
        let left = until.map(|until| until.since(Stamp::now()));
        let limit = left.and_then(|left| Timespec::try_from(left).ok());
        let mut all = vec![PollFd::new(stop, PollFlags::IN)];
        all.extend(input.map(|input| PollFd::from_borrowed_fd(input.as_fd(), PollFlags::IN)));
        match poll(&mut all, limit.as_ref()) {
            Ok(_) | Err(rustix::io::Errno::INTR) => {}
            // Out of memory for the moment; an immediate retry would only add to it.
            Err(_) => std::thread::sleep(Duration::from_millis(10)),
        }
        let mut happened = all.iter().map(PollFd::revents);
        if happened.next().is_some_and(|events| !events.is_empty()) {
            return Woken::Stop;
        }
        // Before the input is read: one that sends again has still been silent.
        if until.is_some_and(|until| Stamp::now() >= until) {
            return Woken::Late;
        }
        if let Some(events) = happened.next().filter(|events| !events.is_empty()) {
            return Woken::Ready(!events.contains(PollFlags::IN));
        }
    }
}

/// Follows `place` until `stop`.
pub(super) fn watch(place: &InputGroup, report: &dyn Report, stop: &OwnedFd) {
    let _lost = lost_at_a_panic(report);
    loop {
        let why = match InputSource::open(place) {
            Ok(mut source) => follow(&mut source, report, stop),
            Err(why) => Some(why),
        };
        let Some(why) = why else { return };
        report.lost(&why);
        if wait(stop, None, Some(Stamp::now().after(AGAIN))) == Woken::Stop {
            return;
        }
    }
}

/// Why an open place was lost; `None` at the end of the run.
fn follow(source: &mut InputSource, report: &dyn Report, stop: &OwnedFd) -> Option<String> {
    let silence = source.silence();
    let mut received_at = Stamp::now();
    let mut is_silent = false;
    loop {
        let mut has_reported = false;
        let taken = source.drain(&mut |which, is_on| {
            has_reported = true;
            report.level(which, is_on);
        });
        if let Err(why) = taken {
            return Some(why);
        }
        if has_reported {
            (received_at, is_silent) = (Stamp::now(), false);
        }
        let look = source.look_after().map(|after| Stamp::now().after(after));
        let until = look.or(silence.filter(|_| !is_silent).map(|silence| received_at.after(silence)));
        match wait(stop, Some(&source.fd()), until) {
            Woken::Stop => return None,
            Woken::Ready(false) => {}
            Woken::Late if look.is_some() => {}
            Woken::Ready(true) => return Some("unplugged".to_owned()),
            Woken::Late => {
                is_silent = true;
                report.lost(&source.why_silent());
            }
        }
    }
}
