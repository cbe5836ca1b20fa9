//! What is answered with success is kept, whichever write fails; what is not changed nothing.

use std::path::Path;

use rapid_status::session::SessionStatus;
use rapid_system::fault;

use super::*;
use crate::session::journal::{Journal, SessionFile};
use crate::session::noted;

/// More changes of the folder than an order makes: the last of them succeeds.
const MOST: u64 = 14;
/// As long as the disk is full.
const ALWAYS: u64 = u64::MAX;

impl Bench {
    /// Makes a request, and follows the episode that it ends.
    async fn ask(&mut self, request: &SessionRequest) -> Result<String, String> {
        let (reply, mut answer) = oneshot::channel();
        let collection = &mut self.conductor.collection;
        collection.request(request, Stamp::now(), Some(reply)).await.map_err(|error| error.to_string())?;
        if *request == SessionRequest::Stop {
            let end = collection.ended().await;
            collection.note_end(&end).await.map_err(|error| error.to_string())?;
        }
        let answer = async { (&mut answer).await.unwrap() };
        tokio::time::timeout(PATIENCE, answer).await.expect("an answer")
    }

    /// Two episodes that are kept, and one in the trash; a fourth is being recorded, if it is wanted.
    async fn recorded(is_recording: bool) -> Self {
        let mut bench = Self::new(false, None, |file| Box::new(file));
        for number in 0..3 {
            bench.ask(&SessionRequest::Start).await.unwrap();
            bench.ask(&SessionRequest::Stop).await.unwrap();
            if number == 0 {
                bench.ask(&SessionRequest::Discard { episode: None }).await.unwrap();
            }
        }
        bench.ask(&SessionRequest::Note { episode: None, text: "of the third".to_owned() }).await.unwrap();
        if is_recording {
            bench.ask(&SessionRequest::Start).await.unwrap();
        }
        bench
    }

    fn status(&self) -> SessionStatus {
        SessionStatus { answer: None, ..self.board.snapshot().session.unwrap() }
    }

    /// What another run finds when this one is killed now.
    fn found(&self) -> Found {
        let copy = tempfile::tempdir().unwrap();
        copy_folder(self.out.path(), copy.path());
        let (_, session, error) = Journal::open(copy.path(), &self.status().task);
        assert!(error.is_none(), "{error:?}");
        let names = files(copy.path()).into_iter().filter(|name| name.contains(".mcap") && !name.contains(".toml"));
        let paths: Vec<_> = names.map(|name| copy.path().join(name)).collect();
        let noted = noted::noted(&paths, &mut |error| panic!("{error}"));
        let noted = noted.into_iter().map(|(path, notes)| (path.file_name().unwrap().to_owned(), notes)).collect();
        let trash = files(&copy.path().join(".trash"));
        Found { session, noted, trash }
    }
}

#[derive(Debug, PartialEq)]
struct Found {
    session: Option<SessionFile>,
    noted: Vec<(std::ffi::OsString, rapid_status::session::Notes)>,
    trash: Vec<String>,
}

fn files(folder: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(folder).into_iter().flatten();
    let mut names: Vec<_> = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    names.retain(|name| !name.contains(".tmp"));
    names.sort();
    names
}

fn copy_folder(from: &Path, to: &Path) {
    for entry in std::fs::read_dir(from).unwrap().map(Result::unwrap) {
        let to = to.join(entry.file_name());
        if entry.path().is_dir() {
            std::fs::create_dir(&to).unwrap();
            copy_folder(&entry.path(), &to);
        } else {
            std::fs::copy(entry.path(), &to).unwrap();
        }
    }
}

/// Orders, each with whether it is about an episode in progress.
fn orders() -> Vec<(SessionRequest, bool)> {
    let second = "_002.mcap";
    let label = |episode: Option<&str>| SessionRequest::Label {
        episode: episode.map(str::to_owned),
        label: Label::Failure,
        reason: "slipped".to_owned(),
    };
    let note = |text: &str| SessionRequest::Note { episode: None, text: text.to_owned() };
    let plan = SessionRequest::Plan {
        task: None,
        tags: vec![("finger".to_owned(), "soft".to_owned())],
        goal: Some(7),
        modules: Vec::new(),
    };
    vec![
        (label(None), false),
        (label(Some(second)), false),
        (label(None), true),
        (note("new pads"), false),
        (note(""), false),
        (note("while it is recorded"), true),
        (SessionRequest::Mark { text: "grasped".to_owned() }, true),
        (SessionRequest::Discard { episode: None }, false),
        (SessionRequest::Discard { episode: Some(second.to_owned()) }, true),
        (SessionRequest::Undo, false),
        (SessionRequest::Undo, true),
        (plan, false),
        (SessionRequest::EndSession, false),
    ]
}

/// The order about the episode of this bench whose name ends so.
fn named(request: SessionRequest, bench: &Bench) -> SessionRequest {
    let full = |episode: Option<String>| {
        let all = bench.status().episodes;
        episode.map(|end| all.iter().find(|entry| entry.file.ends_with(&end)).unwrap().file.clone())
    };
    match request {
        SessionRequest::Label { episode, label, reason } => {
            SessionRequest::Label { episode: full(episode), label, reason }
        }
        SessionRequest::Discard { episode } => SessionRequest::Discard { episode: full(episode) },
        request => request,
    }
}

/// Whatever write fails, once or from then on: an answer of success is found by the next run, and after an answer of failure
/// everything is as before, and the same order succeeds once the disk accepts enough.
#[tokio::test]
async fn an_order_is_on_the_disk_or_changed_nothing_whichever_write_fails() {
    for (order, is_recording) in orders() {
        let (mut failed, mut bench) = (0, Bench::recorded(is_recording).await);
        for (succeed, fail) in (0..MOST).flat_map(|succeed| [(succeed, 1), (succeed, ALWAYS)]) {
            let order = named(order.clone(), &bench);
            let what = format!("{order:?}, {succeed} writes succeed, {fail} fail");
            let before = (bench.status(), bench.found());
            fault::fail_changes(bench.out.path(), succeed, fail);
            let answer = bench.ask(&order).await;
            let (shown, found) = (bench.status(), bench.found());
            let left = fault::fail_changes(bench.out.path(), ALWAYS, 0);
            let Err(why) = answer else {
                assert_ne!(found, before.1, "{what}: success, and nothing is kept");
                check(&shown, &found, &what);
                bench.conductor.finish_episode().await.unwrap();
                bench.end().await;
                bench = Bench::recorded(is_recording).await;
                if left.1 == fail {
                    // None was left that could fail.
                    break;
                }
                continue;
            };
            failed += 1;
            assert!(why.contains("storage") || why.contains("space"), "{what}: {why}");
            assert_eq!(shown, before.0, "{what}: {why}");
            assert_eq!(found, before.1, "{what}: {why}");
        }
        assert!(failed > 0, "{order:?} never failed");
        bench.conductor.finish_episode().await.unwrap();
        bench.end().await;
    }
}

/// What is shown is what is found.
fn check(shown: &SessionStatus, found: &Found, what: &str) {
    let Some(session) = &found.session else {
        assert!(shown.episodes.is_empty() && found.trash.is_empty(), "{what}: {shown:?}");
        return;
    };
    assert_eq!((&session.plan.task, session.plan.goal), (&shown.task, shown.goal), "{what}");
    let tags: Vec<_> = session.plan.tags.clone().into_iter().collect();
    assert_eq!(tags, shown.tags, "{what}");
    assert_eq!(session.episodes, shown.episodes, "{what}");
    for entry in shown.episodes.iter().filter(|entry| !entry.discarded && entry.seconds.is_some()) {
        let noted = found.noted.iter().find(|(name, _)| *name == *entry.file).map(|(_, notes)| notes.clone());
        assert_eq!(noted.unwrap_or_default(), entry.notes(), "{what}");
    }
    let discarded = shown.episodes.iter().filter(|entry| entry.discarded);
    assert!(discarded.clone().all(|entry| found.trash.contains(&entry.file)), "{what}: {:?}", found.trash);
}

/// An episode that ended while the disk was full is noted as soon as it is not, at the latest when the run ends; and a run
/// that cannot do so fails.
#[tokio::test]
async fn what_a_session_decides_by_itself_is_tried_again_until_the_end_of_the_run() {
    for is_lost in [false, true] {
        for noted in [false, true] {
            let mut bench = Bench::recorded(true).await;
            if noted {
                bench.ask(&SessionRequest::Note { episode: None, text: "pads".to_owned() }).await.unwrap();
            }
            // Its file gets its name.
            fault::fail_changes(bench.out.path(), 1, ALWAYS);
            let answer = bench.ask(&SessionRequest::Stop).await.unwrap();
            assert!(answer.contains("the session is not saved: ") && answer.contains("tried again"), "{answer}");
            let last = |found: Found| found.session.unwrap().episodes.pop().unwrap();
            assert_eq!(last(bench.found()).verdict, None);
            if is_lost {
                let why = bench.conductor.collection.close().await.unwrap_err().to_string();
                assert!(why.contains("the session is not saved: ") && why.contains("`rapid list`"), "{why}");
                fault::fail_changes(bench.out.path(), ALWAYS, 0);
                continue;
            }
            fault::fail_changes(bench.out.path(), ALWAYS, 0);
            let Bench { mut conductor, board, out, .. } = bench;
            conductor.collection.close().await.unwrap();
            let copy = tempfile::tempdir().unwrap();
            copy_folder(out.path(), copy.path());
            let task = board.snapshot().session.unwrap().task;
            let session = Journal::open(copy.path(), &task).1.unwrap();
            let entry = session.episodes.last().unwrap();
            assert!(entry.verdict.is_some() && entry.note == if noted { "pads" } else { "" }, "{entry:?}");
            assert_eq!(copy.path().join(format!("{}.toml", entry.file)).exists(), noted);
        }
    }
}
