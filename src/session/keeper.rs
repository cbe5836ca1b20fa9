//! The keeper: the thread that carries out what a session changes on the disk, one operation after another.
//!
//! What somebody ordered is carried out whole or not at all. What the session decided by itself, that an episode ended say,
//! is tried again until the end of the run.
//!
//! Invariant: only this thread, and whoever closes the keeper, waits for the disk of the journal.
//! Invariant: what is answered is on the disk, or the answer names why it is not.

use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::path::Path;
use std::sync::mpsc::{self, RecvTimeoutError};
use std::thread::{Builder, JoinHandle};
use std::time::Duration;

use rapid_episode::notes::{self, NotesError};
use rapid_episode::partial::TRASH;
use rapid_status::session::{Notes, NotesChange};
use tokio::sync::mpsc::{UnboundedReceiver, UnboundedSender, unbounded_channel};
use tokio::sync::oneshot;

use super::journal::{Journal, SessionFile};
use super::trash;

/// How long after a failure what could not be saved is tried again.
const AGAIN: Duration = Duration::from_secs(2);

/// A change of the disk.
#[derive(Debug, Clone, PartialEq)]
pub enum Operation {
    /// Save the journal.
    Save(SessionFile),
    /// Change what is noted beside this episode; without a file for that, it begins with these notes.
    Note(String, Notes, Vec<NotesChange>),
    /// Move this episode to the trash.
    Discard(String),
    /// Take this episode back.
    Restore(String),
    /// Write the summary of the session.
    Summarise(SessionFile),
    /// Delete these from the trash, and give the journal its final contents and name.
    Close(SessionFile, Vec<String>),
}

/// An answer that is given once the operations before it are carried out.
#[derive(Debug)]
pub struct Pending {
    /// What was done.
    pub text: String,
    /// It was done, also if an episode cannot be moved: another has begun, say.
    pub is_done: bool,
    /// The episode that the request replaces: it is not done while that one is not in the trash.
    pub replaces: Option<String>,
    /// It is shown on screens too.
    pub is_shown: bool,
    /// Programs that wait for it.
    pub to: Vec<oneshot::Sender<Result<String, String>>>,
}

/// Why an order was not carried out.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Undone {
    /// In words.
    pub why: String,
    /// What it changed could not be taken back, and stands.
    pub stands: bool,
}

/// What is to be done, in order.
#[derive(Debug)]
enum Work {
    /// What the session decided by itself, and an answer afterwards.
    Own(Vec<Operation>, Option<Pending>),
    /// What somebody ordered, and who is told what became of it.
    Order(Vec<Operation>, oneshot::Sender<Result<(), Undone>>),
}

/// What became of an operation, where that is of interest.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Outcome {
    /// A request was answered so.
    Answered(Result<String, String>),
    /// The session is closed, or why it is not.
    Closed(Result<(), String>),
    /// The episode is in the trash.
    Discarded(String),
    /// The episode is back.
    Restored(String),
    /// The episode stays where it was, and why.
    NotMoved(String, String),
    /// Another operation failed, and why.
    Failed(String),
    /// What had failed is on the disk by now.
    Saved,
    /// The run ends, and this was never saved.
    Lost(String),
}

/// A handle to the thread, which ends when this is dropped.
#[derive(Debug)]
pub struct Keeper {
    operations: Option<mpsc::Sender<Work>>,
    thread: Option<JoinHandle<()>>,
}

impl Keeper {
    /// Starts the thread for the sessions of this journal's folder; returns its outcomes too.
    ///
    /// # Errors
    /// When the system provides no thread.
    pub fn start(journal: Journal) -> io::Result<(Self, UnboundedReceiver<Outcome>)> {
        let (operations, inbox) = mpsc::channel();
        let (outcomes, to_owner) = unbounded_channel();
        let desk = Desk {
            journal,
            failing: BTreeSet::new(),
            unmoved: BTreeMap::new(),
            unsaved: None,
            unnoted: BTreeMap::new(),
            outcomes,
        };
        let thread = Builder::new().name("session".to_owned()).spawn(move || desk.run(&inbox))?;
        Ok((Self { operations: Some(operations), thread: Some(thread) }, to_owner))
    }

    /// Requests operations, and an answer after them. Does not wait.
    pub fn request(&self, operations: Vec<Operation>, answer: Option<Pending>) {
        if let Some(work) = &self.operations {
            // The thread ends only when this is dropped.
            let _ = work.send(Work::Own(operations, answer));
        }
    }

    /// Orders operations, all or none of which are carried out; without any, the end of those before is waited for. Does not
    /// wait. No answer means that the thread has ended.
    pub fn order(&self, operations: Vec<Operation>) -> oneshot::Receiver<Result<(), Undone>> {
        let (told, outcome) = oneshot::channel();
        if let Some(work) = &self.operations {
            let _ = work.send(Work::Order(operations, told));
        }
        outcome
    }

    /// Lets the thread end once all operations are carried out; returns it, to be joined.
    pub fn close(&mut self) -> Option<JoinHandle<()>> {
        self.operations = None;
        self.thread.take()
    }
}

/// The thread's own state.
struct Desk {
    journal: Journal,
    /// Errors that were reported: a full disk is reported once, and not at each change.
    failing: BTreeSet<String>,
    /// Episodes that could not be moved the last time, and why.
    unmoved: BTreeMap<String, String>,
    /// What the journal is to hold and does not.
    unsaved: Option<SessionFile>,
    /// What is to be noted beside episodes and is not.
    unnoted: BTreeMap<String, (Notes, Vec<NotesChange>)>,
    outcomes: UnboundedSender<Outcome>,
}

impl Desk {
    fn run(mut self, inbox: &mpsc::Receiver<Work>) {
        loop {
            let work = if self.is_behind() {
                inbox.recv_timeout(AGAIN)
            } else {
                inbox.recv().map_err(|_| RecvTimeoutError::Disconnected)
            };
            match work {
                Ok(Work::Own(operations, answer)) => self.own(operations, answer),
                Ok(Work::Order(operations, told)) => {
                    let done = self.order(operations);
                    // Its owner may have ended.
                    let _ = told.send(done);
                }
                Err(RecvTimeoutError::Timeout) => drop(self.catch_up()),
                Err(RecvTimeoutError::Disconnected) => break,
            }
        }
        if let Err(why) = self.catch_up() {
            self.report(Outcome::Lost(why));
        }
    }

    fn is_behind(&self) -> bool {
        self.unsaved.is_some() || !self.unnoted.is_empty()
    }

    /// Tries again what failed.
    fn catch_up(&mut self) -> Result<(), String> {
        let was_behind = self.is_behind();
        let saved = self.unsaved.take().map_or(Ok(()), |file| self.save(file));
        let noted = std::mem::take(&mut self.unnoted)
            .into_iter()
            .map(|(episode, (before, changes))| self.note(episode, before, changes))
            .fold(Ok(()), Result::and);
        saved.and(noted).inspect(|()| {
            if was_behind {
                self.report(Outcome::Saved);
            }
        })
    }

    fn own(&mut self, operations: Vec<Operation>, answer: Option<Pending>) {
        let (mut failed, mut unsaved) = (None, None);
        for operation in operations {
            let is_note = matches!(operation, Operation::Save(_) | Operation::Note(..));
            let outcome = self.carry_out(operation).err();
            let place = if is_note { &mut unsaved } else { &mut failed };
            *place = place.take().or(outcome);
        }
        let Some(Pending { text, is_done, replaces, is_shown, to }) = answer else { return };
        let failed = failed.or_else(|| self.unmoved.get(&replaces?).cloned());
        let answer = match (failed, unsaved) {
            (None, None) => Ok(text),
            // It is in effect, and noted as soon as the journal can be written: who repeats it does it twice.
            (None, Some(why)) if is_done => Ok(format!("{text}; {why}, which is tried again")),
            (None, Some(why)) => Err(format!("{why}, which is tried again; {text}")),
            (Some(why), _) if is_done => Err(format!("{why}; {text}")),
            (Some(why), _) => Err(why),
        };
        for program in to {
            // It may have ended.
            let _ = program.send(answer.clone());
        }
        if is_shown {
            self.report(Outcome::Answered(answer));
        }
    }

    fn report(&self, outcome: Outcome) {
        // The owner may have ended.
        let _ = self.outcomes.send(outcome);
    }

    /// An error is reported too.
    fn carry_out(&mut self, operation: Operation) -> Result<(), String> {
        match operation {
            Operation::Discard(file) => {
                let moved = self.discard(&file);
                self.moved(file, moved, Outcome::Discarded)
            }
            Operation::Restore(file) => {
                let moved = self.restore(&file);
                self.moved(file, moved, Outcome::Restored)
            }
            Operation::Close(file, gone) => self.end(&file, &gone).map_err(|undone| undone.why),
            Operation::Save(file) => self.save(file),
            Operation::Note(episode, before, changes) => self.note(episode, before, changes),
            Operation::Summarise(file) => {
                let summarised =
                    self.journal.summarise(&file).map_err(|error| format!("the summary is not written: {error}"));
                summarised.inspect_err(|why| self.fail(why))
            }
        }
    }

    fn fail(&mut self, why: &str) {
        if self.failing.insert(why.to_owned()) {
            self.report(Outcome::Failed(why.to_owned()));
        }
    }

    /// What cannot be saved is kept, to be tried again.
    fn save(&mut self, file: SessionFile) -> Result<(), String> {
        let saved = self.try_save(&file);
        match &saved {
            Ok(()) => self.failing.clear(),
            Err(why) => {
                self.unsaved = Some(file);
                self.fail(why);
            }
        }
        saved
    }

    /// The journal holds this instead of what it lacked before.
    fn try_save(&mut self, file: &SessionFile) -> Result<(), String> {
        self.journal.save(file).map_err(|error| format!("the session is not saved: {error}"))?;
        self.unsaved = None;
        Ok(())
    }

    /// As [`Self::save`].
    fn note(&mut self, episode: String, before: Notes, changes: Vec<NotesChange>) -> Result<(), String> {
        let noted = self.try_note(&episode, &before, &changes);
        if let Err(why) = &noted {
            let waiting = self.unnoted.entry(episode).or_insert_with(|| (before, Vec::new()));
            waiting.1.extend(changes);
            self.fail(why);
        }
        noted
    }

    fn try_note(&mut self, episode: &str, before: &Notes, changes: &[NotesChange]) -> Result<(), String> {
        let earlier = self.unnoted.get(episode).map(|(_, changes)| changes.clone()).unwrap_or_default();
        let changes = [&earlier, changes].concat();
        let change = || {
            let folder = self.journal.folder().map_err(|error| error.to_string())?;
            let name = Path::new(episode);
            notes::change(folder, name, || before.clone(), &changes).map_err(|error: NotesError| error.to_string())
        };
        let mut change = change;
        change().map_err(|why| format!("the notes are not saved: {why}"))?;
        self.unnoted.remove(episode);
        Ok(())
    }

    fn discard(&mut self, file: &str) -> io::Result<()> {
        trash::discard(self.journal.folder()?, file)
    }

    fn restore(&mut self, file: &str) -> io::Result<()> {
        trash::restore(self.journal.folder()?, file)
    }

    fn moved(&mut self, file: String, moved: io::Result<()>, done: fn(String) -> Outcome) -> Result<(), String> {
        let why = moved.map_err(|error| reason(&error));
        let failed = why.clone().map_err(|why| format!("{file} was not moved: {why}"));
        match &failed {
            Ok(()) => self.unmoved.remove(&file),
            Err(why) => self.unmoved.insert(file.clone(), why.clone()),
        };
        self.report(match why {
            Ok(()) => done(file),
            Err(why) => Outcome::NotMoved(file, why),
        });
        failed
    }

    /// Carries out all of these or none: only the first can fail, or the end of a session after it was saved as it is.
    fn order(&mut self, operations: Vec<Operation>) -> Result<(), Undone> {
        let undone = |why| Undone { why, stands: false };
        if let Some(to) = self.journal.moved_to().filter(|_| !operations.is_empty()) {
            let to = to.display();
            return Err(undone(format!(
                "the folder of this session was moved to {to} while it lasts: move it back, or end this run and begin \
                 another with --out {to}"
            )));
        }
        // What was moved, or is noted beside the episode, counts whatever the journal says: that follows.
        let mut is_done = false;
        for operation in operations {
            match operation {
                Operation::Discard(file) => {
                    self.discard(&file).map_err(|error| undone(not_moved(&file, &error)))?;
                    self.unmoved.remove(&file);
                    self.report(Outcome::Discarded(file));
                }
                Operation::Restore(file) => {
                    self.restore(&file).map_err(|error| undone(not_moved(&file, &error)))?;
                    self.unmoved.remove(&file);
                    self.report(Outcome::Restored(file));
                }
                Operation::Note(episode, before, changes) => {
                    self.try_note(&episode, &before, &changes).map_err(undone)?;
                }
                Operation::Save(file) if is_done => drop(self.save(file)),
                Operation::Save(file) => self.try_save(&file).map_err(undone)?,
                Operation::Close(file, gone) => self.end(&file, &gone)?,
                // Nobody orders one.
                Operation::Summarise(_) => {}
            }
            is_done = true;
        }
        Ok(())
    }

    /// The journal first: nothing is deleted of a session that is not closed.
    fn end(&mut self, file: &SessionFile, gone: &[String]) -> Result<(), Undone> {
        let closed = self.journal.close(file).map_err(|error| format!("the session is not ended: {error}"));
        self.report(Outcome::Closed(closed.clone()));
        closed.map_err(|why| Undone { why, stands: false })?;
        let trash = |error: &io::Error| {
            let trash = format!("{}/{TRASH}", self.journal.path().display());
            let text = error.to_string();
            if text.starts_with(&trash) { text } else { format!("{trash}: {text}") }
        };
        let emptied = match self.journal.open_folder() {
            Some(folder) => trash::empty(folder, gone.iter().map(String::as_str)),
            None => Ok(()),
        };
        let why = emptied.map_err(|error| {
            format!("the session is ended, but its trash is not deleted: {}; remove it by hand", trash(&error))
        });
        why.inspect_err(|why| self.report(Outcome::Failed(why.clone()))).map_err(|why| Undone { why, stands: true })
    }
}

fn not_moved(file: &str, error: &io::Error) -> String {
    format!("{file} was not moved: {}", reason(error))
}

/// Why an episode was not moved, in the words of what is moved.
fn reason(error: &io::Error) -> String {
    match error.kind() {
        io::ErrorKind::NotFound => "it is not there any more".to_owned(),
        io::ErrorKind::AlreadyExists => "another file of its name is there".to_owned(),
        io::ErrorKind::CrossesDevices => format!("{TRASH} is on another disk"),
        _ => error.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::session::journal::Plan;

    fn session(task: &str) -> SessionFile {
        let plan = Plan { task: task.to_owned(), ..Plan::default() };
        SessionFile { begun: "2026-11-24T14:02:00.000Z".to_owned(), plan, ..SessionFile::default() }
    }

    /// Carries out the operations in `folder`; the outcomes.
    fn outcomes(folder: &Path, operations: impl IntoIterator<Item = Operation>) -> Vec<Outcome> {
        let (journal, ..) = Journal::open(folder, "one");
        let (mut keeper, mut outcomes) = Keeper::start(journal).unwrap();
        operations.into_iter().for_each(|operation| keeper.request(vec![operation], None));
        keeper.close().unwrap().join().unwrap();
        let mut all = Vec::new();
        while let Some(outcome) = outcomes.blocking_recv() {
            all.push(outcome);
        }
        all
    }

    fn names(folder: &Path) -> Vec<String> {
        let entries = std::fs::read_dir(folder).unwrap();
        let mut names: Vec<_> = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }

    #[test]
    fn everything_is_done_in_order_before_the_thread_ends() {
        let folder = tempfile::tempdir().unwrap();
        let name = |name: &str| name.to_owned();
        for file in ["a.mcap", "b.mcap"] {
            std::fs::write(folder.path().join(file), "x").unwrap();
        }
        let operations = [
            Operation::Save(session("one")),
            Operation::Discard(name("a.mcap")),
            Operation::Discard(name("missing.mcap")),
            Operation::Discard(name("b.mcap")),
            Operation::Restore(name("b.mcap")),
            Operation::Close(session("one"), vec![name("a.mcap")]),
            Operation::Save(session("two")),
        ];
        let found = outcomes(folder.path(), operations);
        assert_eq!(found.len(), 5, "{found:?}");
        assert_eq!(found[0], Outcome::Discarded(name("a.mcap")));
        assert!(matches!(&found[1], Outcome::NotMoved(file, _) if file == "missing.mcap"));
        assert_eq!(found[3..], [Outcome::Restored(name("b.mcap")), Outcome::Closed(Ok(()))]);
        let stem = "session-2026-11-24T140200000Z";
        let expected = ["b.mcap", &format!("{stem}.md"), &format!("{stem}.toml"), "session.toml"];
        assert_eq!(names(folder.path()), expected);
    }

    /// What a request with these operations is answered.
    fn answer(keeper: &Keeper, operations: Vec<Operation>, is_done: bool) -> Result<String, String> {
        let (to, answered) = oneshot::channel();
        let pending = Pending { text: "done".to_owned(), is_done, replaces: None, is_shown: false, to: vec![to] };
        keeper.request(operations, Some(pending));
        answered.blocking_recv().unwrap()
    }

    #[test]
    fn what_is_answered_is_on_the_disk_and_what_is_not_is_an_error() {
        let place = tempfile::tempdir().unwrap();
        let folder = place.path().join("episodes");
        std::fs::create_dir(&folder).unwrap();
        let (journal, ..) = Journal::open(&folder, "one");
        let (keeper, mut outcomes) = Keeper::start(journal).unwrap();
        let saved = |task: &str| vec![Operation::Save(session(task))];
        assert_eq!(answer(&keeper, saved("one"), false), Ok("done".to_owned()));
        assert!(folder.join("session.toml").exists());
        // The disk does not accept anything any more.
        std::fs::remove_dir_all(&folder).unwrap();
        std::fs::write(&folder, "").unwrap();
        // What was done and is only not noted is in effect; anything else is an error.
        let answered = answer(&keeper, saved("two"), true).unwrap();
        assert!(answered.starts_with("done; the session is not saved: "), "{answered}");
        let answered = answer(&keeper, saved("two"), false).unwrap_err();
        assert!(answered.starts_with("the session is not saved: "), "{answered}");
        for operations in [
            vec![Operation::Discard("a.mcap".to_owned()), Operation::Save(session("two"))],
            vec![Operation::Close(session("two"), Vec::new())],
        ] {
            let why = answer(&keeper, operations.clone(), false).unwrap_err();
            assert!(why.contains("not"), "{why}");
            assert_eq!(answer(&keeper, operations, true), Err(format!("{why}; done")));
        }
        drop(keeper);
        let mut all = Vec::new();
        while let Ok(outcome) = outcomes.try_recv() {
            all.push(outcome);
        }
        assert!(all.iter().any(|outcome| matches!(outcome, Outcome::Closed(Err(_)))), "{all:?}");
        assert!(!all.iter().any(|outcome| matches!(outcome, Outcome::Closed(Ok(())))), "{all:?}");
    }

    #[test]
    fn an_error_is_reported_once_until_it_is_gone() {
        let folder = tempfile::tempdir().unwrap();
        let missing = folder.path().join("no/such/folder");
        let found = outcomes(&missing, [Operation::Save(session("a")), Operation::Save(session("b"))]);
        // And at the end, where it is an error of the run.
        let is_so = matches!(&found[..], [Outcome::Failed(why), Outcome::Lost(last)] if why.contains("no/such/folder") && why == last);
        assert!(is_so, "{found:?}");
    }
}
