//! The keeper: the thread that carries out what a session changes on the disk, one operation after another.
//!
//! Invariant: only this thread, and whoever closes the keeper, waits for the disk of the journal.

use std::collections::BTreeSet;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::mpsc;
use std::thread::{Builder, JoinHandle};

use tokio::sync::mpsc::{UnboundedReceiver, UnboundedSender, unbounded_channel};

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

/// What became of an operation, where that is of interest.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Outcome {
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
    operations: Option<mpsc::Sender<Operation>>,
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
        let desk = Desk { folder: folder.to_owned(), journal, failing: BTreeSet::new(), outcomes };
        let thread = Builder::new().name("session".to_owned()).spawn(move || desk.run(&inbox))?;
        Ok((Self { operations: Some(operations), thread: Some(thread) }, to_owner))
    }

    /// Requests an operation. Does not wait.
    pub fn request(&self, operation: Operation) {
        if let Some(operations) = &self.operations {
            // The thread ends only when this is dropped.
            let _ = operations.send(operation);
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
    outcomes: UnboundedSender<Outcome>,
}

impl Desk {
    fn run(mut self, inbox: &mpsc::Receiver<Operation>) {
        while let Ok(operation) = inbox.recv() {
            if let Some(outcome) = self.carry_out(operation) {
                // The owner may have ended.
                let _ = self.outcomes.send(outcome);
            }
        }
    }

    fn carry_out(&mut self, operation: Operation) -> Option<Outcome> {
        let failed = match operation {
            Operation::Discard(file) => {
                return Some(match trash::discard(&self.folder, &file) {
                    Ok(()) => Outcome::Discarded(file),
                    Err(error) => Outcome::NotMoved(file, error.to_string()),
                });
            }
            Operation::Restore(file) => {
                return Some(match trash::restore(&self.folder, &file) {
                    Ok(()) => Outcome::Restored(file),
                    Err(error) => Outcome::NotMoved(file, error.to_string()),
                });
            }
            Operation::Archive(begun) => self.journal.archive(&begun).err().map(|error| error.to_string()),
            Operation::Save(file) => self.journal.save(&file).err().map(|error| error.to_string()),
            Operation::Summarise(file) => self.journal.summarise(&file).err().map(|error| error.to_string()),
            Operation::Close(file, gone) => self.end(&file, &gone).err(),
        };
        let Some(why) = failed else {
            self.failing.clear();
            return None;
        };
        self.failing.insert(why.clone()).then_some(Outcome::Failed(why))
    }

    /// The journal first: it still names what is deleted if that fails.
    fn end(&mut self, file: &SessionFile, gone: &[String]) -> Result<(), String> {
        let emptied = trash::empty(&self.folder, gone.iter().map(String::as_str));
        let emptied = emptied.map_err(|error| format!("{}: {error}", self.folder.display()));
        let written = self.journal.save(file).and_then(|()| self.journal.summarise(file));
        let archived = written.and_then(|()| self.journal.archive(&file.begun));
        emptied.and(archived.map_err(|error| error.to_string()))
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
        operations.into_iter().for_each(|operation| keeper.request(operation));
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
        assert_eq!(found.len(), 4, "{found:?}");
        assert_eq!(found[0], Outcome::Discarded(name("a.mcap")));
        assert!(matches!(&found[1], Outcome::NotMoved(file, _) if file == "missing.mcap"));
        assert_eq!(found[3], Outcome::Restored(name("b.mcap")));
        let stem = "session-2026-11-24T140200000Z";
        let expected = ["b.mcap", &format!("{stem}.md"), &format!("{stem}.toml"), "session.toml"];
        assert_eq!(names(folder.path()), expected);
    }

    #[test]
    fn an_error_is_reported_once_until_it_is_gone() {
        let folder = tempfile::tempdir().unwrap();
        let missing = folder.path().join("no/such/folder");
        let found = outcomes(&missing, [Operation::Save(session("a")), Operation::Save(session("b"))]);
        assert!(matches!(&found[..], [Outcome::Failed(why)] if why.contains("no/such/folder")), "{found:?}");
    }
}
