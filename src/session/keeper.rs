//! The keeper: the thread that carries out what a session changes on the disk, one operation after another.
//!
//! Invariant: only this thread, and whoever closes the keeper, waits for the disk of the journal.
//! Invariant: what is answered is on the disk, or the answer names why it is not.

use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::mpsc;
use std::thread::{Builder, JoinHandle};

use rapid_episode::partial::TRASH;
use tokio::sync::mpsc::{UnboundedReceiver, UnboundedSender, unbounded_channel};
use tokio::sync::oneshot;

use super::journal::{Journal, SessionFile};
use super::trash;

/// A change of the disk.
#[derive(Debug, Clone, PartialEq)]
pub enum Operation {
    /// Save the journal.
    Save(SessionFile),
    /// Give the journal the final name of the session that began then.
    Archive(String),
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

/// Operations of one request, in order, and its answer.
#[derive(Debug, Default)]
struct Work {
    operations: Vec<Operation>,
    answer: Option<Pending>,
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
}

/// A handle to the thread, which ends when this is dropped.
#[derive(Debug)]
pub struct Keeper {
    operations: Option<mpsc::Sender<Work>>,
    thread: Option<JoinHandle<()>>,
}

impl Keeper {
    /// Starts the thread for the sessions in `folder`; returns its outcomes too.
    ///
    /// # Errors
    /// When the system provides no thread.
    pub fn start(folder: &Path, journal: Journal) -> io::Result<(Self, UnboundedReceiver<Outcome>)> {
        let (operations, inbox) = mpsc::channel();
        let (outcomes, to_owner) = unbounded_channel();
        let desk =
            Desk { folder: folder.to_owned(), journal, failing: BTreeSet::new(), unmoved: BTreeMap::new(), outcomes };
        let thread = Builder::new().name("session".to_owned()).spawn(move || desk.run(&inbox))?;
        Ok((Self { operations: Some(operations), thread: Some(thread) }, to_owner))
    }

    /// Requests operations, and an answer after them. Does not wait.
    pub fn request(&self, operations: Vec<Operation>, answer: Option<Pending>) {
        if let Some(work) = &self.operations {
            // The thread ends only when this is dropped.
            let _ = work.send(Work { operations, answer });
        }
    }

    /// Lets the thread end once all operations are carried out; returns it, to be joined.
    pub fn close(&mut self) -> Option<JoinHandle<()>> {
        self.operations = None;
        self.thread.take()
    }
}

/// The thread's own state.
struct Desk {
    folder: PathBuf,
    journal: Journal,
    /// Errors that were reported: a full disk is reported once, and not at each change.
    failing: BTreeSet<String>,
    /// Episodes that could not be moved the last time, and why.
    unmoved: BTreeMap<String, String>,
    outcomes: UnboundedSender<Outcome>,
}

impl Desk {
    fn run(mut self, inbox: &mpsc::Receiver<Work>) {
        while let Ok(Work { operations, answer }) = inbox.recv() {
            let (mut failed, mut unsaved) = (None, None);
            for operation in operations {
                let is_note = matches!(operation, Operation::Save(_) | Operation::Archive(_));
                let outcome = self.carry_out(operation).err();
                let place = if is_note { &mut unsaved } else { &mut failed };
                *place = place.take().or(outcome);
            }
            let Some(Pending { text, is_done, replaces, is_shown, to }) = answer else { continue };
            let failed = failed.or_else(|| self.unmoved.get(&replaces?).cloned());
            let answer = match (failed, unsaved) {
                (None, None) => Ok(text),
                // It is in effect, and noted as soon as the journal can be written: who repeats it does it twice.
                (None, Some(why)) => Ok(format!("{text}; {why}")),
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
    }

    fn report(&self, outcome: Outcome) {
        // The owner may have ended.
        let _ = self.outcomes.send(outcome);
    }

    /// An error is reported too.
    fn carry_out(&mut self, operation: Operation) -> Result<(), String> {
        let saved = match operation {
            Operation::Discard(file) => {
                let moved = trash::discard(&self.folder, &file);
                return self.moved(file, moved, Outcome::Discarded);
            }
            Operation::Restore(file) => {
                let moved = trash::restore(&self.folder, &file);
                return self.moved(file, moved, Outcome::Restored);
            }
            Operation::Close(file, gone) => return self.end(&file, &gone),
            Operation::Archive(begun) => self.journal.archive(&begun).map(drop),
            Operation::Save(file) => self.journal.save(&file),
            Operation::Summarise(file) => self.journal.summarise(&file),
        };
        let Err(error) = saved else {
            self.failing.clear();
            return Ok(());
        };
        let why = format!("the session is not saved: {error}");
        if self.failing.insert(why.clone()) {
            self.report(Outcome::Failed(why.clone()));
        }
        Err(why)
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

    /// The journal first: nothing is deleted of a session that is not closed.
    fn end(&mut self, file: &SessionFile, gone: &[String]) -> Result<(), String> {
        let closed = self.journal.close(file).map_err(|error| format!("the session is not ended: {error}"));
        self.report(Outcome::Closed(closed.clone()));
        closed?;
        let emptied = trash::empty(&self.folder, gone.iter().map(String::as_str));
        let why = |error| {
            let trash = self.folder.join(TRASH);
            format!("the session is ended, but its trash is not deleted: {}; remove it by hand", at(&trash, &error))
        };
        emptied.map_err(why).inspect_err(|why| self.report(Outcome::Failed(why.clone())))
    }
}

/// The error with its path, which some have already.
fn at(path: &Path, error: &io::Error) -> String {
    let (path, text) = (path.display().to_string(), error.to_string());
    if text.starts_with(&path) { text } else { format!("{path}: {text}") }
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
        let (journal, ..) = Journal::open(folder);
        let (mut keeper, mut outcomes) = Keeper::start(folder, journal).unwrap();
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
        let (journal, ..) = Journal::open(&folder);
        let (keeper, mut outcomes) = Keeper::start(&folder, journal).unwrap();
        let saved = |task: &str| vec![Operation::Save(session(task))];
        assert_eq!(answer(&keeper, saved("one"), false), Ok("done".to_owned()));
        assert!(folder.join("session.toml").exists());
        // The disk does not accept anything any more.
        std::fs::remove_dir_all(&folder).unwrap();
        std::fs::write(&folder, "").unwrap();
        // What is only not noted is in effect.
        for is_done in [false, true] {
            let answered = answer(&keeper, saved("two"), is_done).unwrap();
            assert!(answered.starts_with("done; the session is not saved: "), "{answered}");
        }
        for operations in [
            vec![Operation::Discard("a.mcap".to_owned()), Operation::Archive("t".to_owned())],
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
        assert!(matches!(&found[..], [Outcome::Failed(why)] if why.contains("no/such/folder")), "{found:?}");
    }
}
