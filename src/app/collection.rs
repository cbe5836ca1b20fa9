//! What a run collects: its session, with the recorder and the keeper that carry out what the session decides.
//!
//! What is to be collected, what was collected and what can be undone is the [`Session`]'s, and nothing of it is kept here:
//! this owns the recorder and the keeper, the requesters that wait for an answer, and what of the disk is the run's choice:
//! the folder, the modules that are mounted, and whether the session gets a file.
//!
//! Invariant: the recorder alone knows whether an episode is in progress; the session follows what it reports.
//! Invariant: a request is answered once, also when what it waits for does not happen; and when what it changed is on the
//! disk, not before.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use rapid_core::time::{Stamp, realtime_ns, rfc3339};
use rapid_episode::record::inspect::{self, Judgement, Listed};
use rapid_episode::record::{EpisodeRequest, RecordError, Recorder};
use rapid_registry::{ModuleError, ModuleSpec};
use rapid_status::session::{Answered, Phase, SessionRequest, SessionStatus};
use rapid_status::{Board, EpisodeCounts, EpisodeReport, EventKind, Level, Verdict};
use rapid_system::folder::{Folder, Links, Missing};
use tokio::sync::mpsc::{UnboundedReceiver, UnboundedSender, unbounded_channel};
use tokio::sync::{oneshot, watch};
use tokio::time::timeout;

use super::AppError;
use super::requests::Reply;
use super::stage::join;
use crate::session::journal::{self, Journal, Plan, SessionFile};
use crate::session::keeper::{Keeper, Operation, Outcome, Pending, Undone};
use crate::session::{Answer, Effect, Session};

/// The last samples of an episode have this long to arrive: the longest `latency` of a device is a second.
const LAST_SAMPLES: Duration = Duration::from_secs(2);

/// Answers that wait for an episode to begin, or to end.
type Waiting = Vec<oneshot::Sender<Result<String, String>>>;
/// Those that wait for a beginning, each with the episode that its request replaces, if it does.
type Beginning = Vec<(oneshot::Sender<Result<String, String>>, Option<String>)>;

fn reply_all(to: Waiting, answer: &Result<String, String>) {
    for reply in to {
        // The requester may have ended.
        let _ = reply.send(answer.clone());
    }
}

/// What became of an episode of which no end was noted.
struct ExaminedEpisode {
    file: String,
    /// Its length in seconds and its verdict; `None` if nothing was recorded.
    end: Option<(f64, Verdict)>,
}

/// Reads an episode of which no end was noted: the run was killed then. Blocks. One that waits to be repaired stays as it is.
fn examine(folder: &Path, file: String, found: &UnboundedSender<ExaminedEpisode>) {
    let is_there = |ending: &str| folder.join(format!("{file}{ending}")).symlink_metadata().is_ok();
    let end = if is_there("") {
        let Listed { verdict: Judgement::Episode(verdict), seconds, .. } = inspect::list(&folder.join(&file)) else {
            return;
        };
        Some((seconds, verdict))
    } else if is_there(".partial") || is_there(".damaged") {
        return;
    } else {
        None
    };
    // The run may have ended.
    let _ = found.send(ExaminedEpisode { file, end });
}

/// Dismounts every declared module.
const NO_MODULE: &str = "none";

/// What is mounted once these are: each in place of the one in its slot.
fn mounted(now: &[String], requested: &[String], known: &[ModuleSpec]) -> Result<Vec<String>, ModuleError> {
    let names: Vec<String> = requested.iter().filter(|name| *name != NO_MODULE).cloned().collect();
    let new = rapid_registry::mounted(known, &names)?;
    let is_dismounted = requested.len() > names.len();
    let slot_of = |name: &String| known.iter().find(|module| module.name == *name).map(|module| module.mount);
    let stays = |name: &&String| !is_dismounted && new.iter().all(|module| slot_of(name) != Some(module.mount));
    let kept = now.iter().filter(stays).cloned();
    Ok(kept.chain(new.iter().map(|module| module.name.clone())).collect())
}

pub(super) struct Collection {
    board: Arc<Board>,
    recorder: Recorder,
    /// Folder, modules and duration of each episode; task and tags are the session's.
    episode: EpisodeRequest,
    /// The modules of the registry.
    mountable: watch::Receiver<Vec<ModuleSpec>>,
    session: Session,
    keeper: Keeper,
    /// What the keeper is to do for the request that is being carried out.
    operations: Vec<Operation>,
    outcomes: UnboundedReceiver<Outcome>,
    /// What became of episodes of which no end was noted.
    found: UnboundedReceiver<ExaminedEpisode>,
    /// For those who examine them.
    to_found: UnboundedSender<ExaminedEpisode>,
    at_begin: Beginning,
    at_end: Waiting,
    answer: Option<Answered>,
    /// The episodes of this run.
    episodes: EpisodeCounts,
    /// The session has a file. A run that records one episode by itself leaves that episode and nothing beside it, unless
    /// something is requested of it.
    is_kept: bool,
    /// An order whose outcome is not known yet.
    ordered: Option<Ordered>,
    /// The folder, once it is known to be there.
    folder: Option<Folder>,
    /// What was never saved.
    lost: Option<String>,
}

/// What the keeper says of an order.
type KeeperAnswer = oneshot::Receiver<Result<(), Undone>>;

/// An order that the keeper carries out, and what is to be said and done afterwards.
struct Ordered {
    outcome: KeeperAnswer,
    /// What is the case again if it is not carried out.
    before: (Session, Vec<String>),
    text: String,
    /// A mark of the episode in progress, made then.
    mark: Option<(Stamp, String)>,
    reply: Reply,
}

/// Whether this changes only what is noted, planned or kept: it is carried out whole, or not at all. Whatever begins or ends
/// an episode does so at once, whether or not the disk lets it be noted.
fn is_order(request: &SessionRequest, phase: Phase) -> bool {
    match request {
        SessionRequest::Discard { episode } => episode.is_some() || !matches!(phase, Phase::Recording | Phase::Ending),
        SessionRequest::Undo
        | SessionRequest::Mark { .. }
        | SessionRequest::Label { .. }
        | SessionRequest::Note { .. }
        | SessionRequest::Plan { .. }
        | SessionRequest::EndSession => true,
        SessionRequest::Toggle
        | SessionRequest::Start
        | SessionRequest::Stop
        | SessionRequest::Next
        | SessionRequest::Redo
        | SessionRequest::Show => false,
    }
}

impl Collection {
    /// Continues the session of the folder of `episode`, or begins one by `plan`.
    ///
    /// # Errors
    /// When the system provides no thread.
    pub(super) fn new(
        recorder: Recorder,
        episode: EpisodeRequest,
        plan: Plan,
        is_kept: bool,
        board: &Arc<Board>,
        mountable: watch::Receiver<Vec<ModuleSpec>>,
    ) -> Result<Self, AppError> {
        let (journal, before, error) = Journal::open(&episode.out, &plan.task);
        if let Some(error) = error {
            tracing::warn!(%error, "an earlier session is not continued");
        }
        let names = journal::sessions(&episode.out).0.into_iter().flat_map(SessionFile::into_names).collect();
        let (session, _) = Session::new(&episode.out, plan, before, names, rfc3339(realtime_ns()));
        let (keeper, outcomes) = Keeper::start(journal)?;
        let (to_found, found) = unbounded_channel();
        let collection = Self {
            board: Arc::clone(board),
            recorder,
            episode,
            mountable,
            session,
            keeper,
            operations: Vec::new(),
            outcomes,
            found,
            to_found,
            at_begin: Vec::new(),
            at_end: Vec::new(),
            answer: None,
            episodes: EpisodeCounts::default(),
            is_kept,
            ordered: None,
            folder: None,
            lost: None,
        };
        collection.show();
        Ok(collection)
    }

    /// What this run was to collect was collected before.
    pub(super) fn was_complete(&self) -> bool {
        self.session.is_done()
    }

    pub(super) fn is_complete(&self) -> bool {
        self.session.is_complete()
    }

    /// How many of this run's episodes are kept and BAD, and the file of the last; `None` if there is none.
    pub(super) fn bad(&self) -> Option<(usize, PathBuf)> {
        self.episodes.bad()
    }

    /// When [`Self::tick`] is to be called next, if at all.
    pub(super) fn due(&self) -> Option<Stamp> {
        self.session.due()
    }

    /// Carries out what is due.
    ///
    /// # Errors
    /// When an episode could not begin.
    pub(super) async fn tick(&mut self) -> Result<(), RecordError> {
        let effects = self.session.tick(Stamp::now());
        self.carry_out(effects, None).await
    }

    /// Begins an episode, as the command line requested.
    ///
    /// # Errors
    /// When it could not begin.
    pub(super) async fn start(&mut self) -> Result<(), RecordError> {
        match self.session.request(&SessionRequest::Start, Stamp::now()) {
            Ok((_, effects)) => self.carry_out(effects, None).await,
            // One is in progress already.
            Err(_) => Ok(()),
        }
    }

    /// Carries out a request made at `at`.
    ///
    /// # Errors
    /// When an episode could not begin; the requester has been answered.
    pub(super) async fn request(
        &mut self,
        request: &SessionRequest,
        at: Stamp,
        reply: Reply,
    ) -> Result<(), RecordError> {
        self.settle().await;
        let is_shown = *request != SessionRequest::Show;
        let replaces = self.session.newest().filter(|_| *request == SessionRequest::Redo).map(str::to_owned);
        self.is_kept |= is_shown;
        let mounted = match request {
            SessionRequest::Plan { modules, .. } => mounted(&self.episode.modules, modules, &self.mountable.borrow()),
            _ => Ok(self.episode.modules.clone()),
        };
        let mounted = match mounted {
            Ok(mounted) => mounted,
            Err(error) => {
                self.answer(Err(error.to_string()), reply);
                self.show();
                return Ok(());
            }
        };
        if is_order(request, self.session.phase()) {
            // What was decided before is on the disk by then, or is known not to be.
            let earlier = self.keeper.order(Vec::new());
            let _ = earlier.await;
            self.take_outcomes();
        }
        let before = (self.session.clone(), self.episode.modules.clone());
        match self.session.request(request, at) {
            Ok((answer, effects)) => {
                self.episode.modules = mounted;
                let pending = match answer {
                    Answer::Now(mut text) => {
                        if matches!(request, SessionRequest::Plan { .. }) && !self.episode.modules.is_empty() {
                            text = format!("{text}, with {}", self.episode.modules.join(", "));
                        }
                        if is_order(request, before.0.phase()) {
                            let (outcome, mark) = self.order(effects, at);
                            self.ordered = Some(Ordered { outcome, before, text, mark, reply });
                            self.settle().await;
                            return Ok(());
                        }
                        let to = reply.into_iter().collect();
                        Some(Pending { text, is_done: false, replaces: None, is_shown, to })
                    }
                    Answer::AtBegin => {
                        self.at_begin.extend(reply.map(|reply| (reply, replaces)));
                        None
                    }
                    Answer::AtEnd => {
                        self.at_end.extend(reply);
                        None
                    }
                };
                self.carry_out(effects, pending).await
            }
            Err(refusal) => {
                self.answer(Err(refusal.to_string()), reply);
                self.show();
                Ok(())
            }
        }
    }

    /// Hands an order made at `at` to the keeper; its outcome, and the mark to be made then.
    fn order(&mut self, effects: Vec<Effect>, at: Stamp) -> (KeeperAnswer, Option<(Stamp, String)>) {
        let mut mark = None;
        for effect in effects {
            match effect {
                Effect::Mark(text) => mark = Some((at, text)),
                effect => self.change(effect),
            }
        }
        (self.keeper.order(std::mem::take(&mut self.operations)), mark)
    }

    /// Waits until the order in progress, if there is one, is carried out or not, and answers it. Cancel-safe.
    async fn settle(&mut self) {
        let Some(ordered) = &mut self.ordered else { return };
        let outcome = (&mut ordered.outcome).await;
        let Some(Ordered { before, text, mark, reply, .. }) = self.ordered.take() else { return };
        self.take_outcomes();
        let ended = || Undone { why: "thread `session` has ended: restart this run".to_owned(), stands: false };
        let answer = match outcome.unwrap_or_else(|_| Err(ended())) {
            Ok(()) => {
                if let Some((at, text)) = mark {
                    self.board.announce_at(at, EventKind::Mark { text });
                }
                Ok(text)
            }
            Err(Undone { why, stands }) => {
                if !stands {
                    (self.session, self.episode.modules) = before;
                }
                Err(why)
            }
        };
        self.answer(answer, reply);
        self.show();
    }

    /// Takes what the keeper has reported so far.
    fn take_outcomes(&mut self) {
        while let Ok(outcome) = self.outcomes.try_recv() {
            self.apply_outcome(outcome);
        }
    }

    /// Waits for the end of the episode in progress, which is to be [noted](Self::note_end); meanwhile, it takes what the
    /// keeper reports, and what became of episodes of which no end was noted. Cancel-safe.
    pub(super) async fn ended(&mut self) -> EpisodeReport {
        loop {
            tokio::select! {
                biased;
                Some(end) = self.recorder.ended() => return end,
                Some(outcome) = self.outcomes.recv() => self.apply_outcome(outcome),
                // This holds a sender: it does not end.
                Some(found) = self.found.recv() => self.examined(&found),
            }
        }
    }

    /// An episode has ended.
    ///
    /// # Errors
    /// When the next one could not begin.
    pub(super) async fn note_end(&mut self, end: &EpisodeReport) -> Result<(), RecordError> {
        let (effects, answer) = self.end_noted(end);
        self.carry_out(effects, answer).await
    }

    fn end_noted(&mut self, end: &EpisodeReport) -> (Vec<Effect>, Option<Pending>) {
        self.episodes.note(&EventKind::Episode(end.clone()));
        let file = end.file.display();
        let to = std::mem::take(&mut self.at_end);
        let answer = if let Some(error) = &end.error {
            reply_all(to, &Err(format!("{file}: {error}")));
            None
        } else {
            let is_discarded = self.session.discards();
            let length = format!("{}, {:.1} s", end.verdict.grade.word(), end.seconds);
            let text = if is_discarded { format!("{file}: in the trash") } else { format!("{file}: {length}") };
            Some(Pending { text, is_done: !is_discarded, replaces: None, is_shown: false, to })
        };
        (self.session.ended(&end.file, end.seconds, &end.verdict, Stamp::now()), answer)
    }

    /// Examines the episodes of which no end was noted: the run was killed then. It is to be called where blocking is allowed.
    pub(super) fn examination(&self) -> impl FnOnce() + Send + 'static {
        let (folder, unfinished, found) = (self.episode.out.clone(), self.session.unfinished(), self.to_found.clone());
        move || unfinished.into_iter().for_each(|file| examine(&folder, file, &found))
    }

    /// What became of an episode of which no end was noted.
    fn examined(&mut self, ExaminedEpisode { file, end }: &ExaminedEpisode) {
        let end = end.as_ref().map(|(seconds, verdict)| (*seconds, verdict));
        for effect in self.session.examined(file, end) {
            self.change(effect);
        }
        self.submit(None);
        self.show();
    }

    /// Takes an outcome of the keeper.
    fn apply_outcome(&mut self, outcome: Outcome) {
        match outcome {
            Outcome::Discarded(file) => self.moved(EventKind::Discarded { file: self.episode.out.join(file) }),
            Outcome::Restored(file) => self.moved(EventKind::Restored { file: self.episode.out.join(file) }),
            Outcome::NotMoved(file, why) => {
                for effect in self.session.not_moved(&file) {
                    self.change(effect);
                }
                self.submit(None);
                self.fail(format!("{file} was not moved: {why}"));
            }
            Outcome::Failed(why) => self.fail(why),
            Outcome::Saved => {
                let text = "the session is saved again".to_owned();
                self.board.announce(EventKind::Log { level: Level::Info, text });
            }
            Outcome::Lost(why) => self.lost = Some(why),
            Outcome::Closed(closed) => {
                self.session.closed(closed.is_ok(), rfc3339(realtime_ns()));
                if let Err(why) = closed {
                    self.fail(why);
                }
            }
            Outcome::Answered(answer) => self.answer(answer, None),
        }
        self.show();
    }

    fn moved(&mut self, what: EventKind) {
        self.episodes.note(&what);
        self.board.announce(what);
    }

    fn fail(&mut self, text: String) {
        self.board.announce(EventKind::Log { level: Level::Error, text: text.clone() });
        self.answer(Err(text), None);
    }

    /// Carries out effects in order, and answers when they are on the disk.
    async fn carry_out(&mut self, effects: Vec<Effect>, mut answer: Option<Pending>) -> Result<(), RecordError> {
        let mut outcome = Ok(());
        for effect in effects {
            match effect {
                Effect::Begin => {
                    self.submit(answer.take());
                    outcome = self.begin().await;
                }
                effect => self.change(effect),
            }
        }
        self.submit(answer);
        if self.session.phase() == Phase::Idle {
            // Whatever they waited for was called off.
            let waiting = std::mem::take(&mut self.at_begin).into_iter().map(|(to, _)| to).collect();
            reply_all(waiting, &Err("no episode begins".to_owned()));
        }
        self.show();
        outcome
    }

    /// Carries out an effect other than the beginning of an episode.
    fn change(&mut self, effect: Effect) {
        match effect {
            Effect::Begin => {}
            Effect::Save if !self.is_kept => {}
            Effect::Save => self.operations.push(Operation::Save(self.session.file().clone())),
            Effect::Note(file, before, changes) => self.operations.push(Operation::Note(file, before, changes)),
            Effect::End(at) => self.recorder.end(at),
            Effect::Discard(file) => self.operations.push(Operation::Discard(file)),
            Effect::Restore(file) => self.operations.push(Operation::Restore(file)),
            Effect::Mark(text) => self.board.announce(EventKind::Mark { text }),
            Effect::Close(gone) => {
                self.operations.push(Operation::Close(self.session.at_end(rfc3339(realtime_ns())), gone));
            }
        }
    }

    /// Hands what was collected to the keeper, with the answer that is to follow it.
    fn submit(&mut self, answer: Option<Pending>) {
        let operations = std::mem::take(&mut self.operations);
        match answer {
            // What changes nothing on the disk does not wait for it.
            Some(Pending { text, is_shown, to, replaces: None, .. }) if operations.is_empty() => {
                reply_all(to, &Ok(text.clone()));
                if is_shown {
                    self.answer(Ok(text), None);
                }
            }
            None if operations.is_empty() => {}
            answer => self.keeper.request(operations, answer),
        }
    }

    async fn begin(&mut self) -> Result<(), RecordError> {
        let plan = self.session.plan();
        let request = EpisodeRequest {
            task: plan.task.clone(),
            tags: plan.tags.iter().map(|(key, value)| (key.clone(), value.clone())).collect(),
            taken: self.session.taken(),
            ..self.episode.clone()
        };
        let moved = self.folder.as_ref().and_then(Folder::moved_to);
        let started = match moved {
            // The session stays with its episodes.
            Some(to) => Err(RecordError::Moved { from: self.episode.out.clone(), to }),
            None => self.recorder.start(request).await,
        };
        if started.is_ok() && self.folder.as_ref().is_none_or(Folder::is_removed) {
            self.folder = Folder::open(&self.episode.out, Links::Own, Missing::Refused).ok();
        }
        self.board.set_not_started(started.as_ref().err().map(ToString::to_string));
        let begun = rfc3339(realtime_ns());
        for effect in self.session.began(started.as_deref().ok(), begun, Stamp::now()) {
            self.change(effect);
        }
        let waiting = std::mem::take(&mut self.at_begin);
        match &started {
            Ok(file) => {
                let text = format!("recording {}", file.display());
                for (to, replaces) in waiting {
                    let (text, to) = (text.clone(), vec![to]);
                    self.submit(Some(Pending { text, is_done: true, replaces, is_shown: false, to }));
                }
                self.submit(None);
            }
            Err(error) => {
                reply_all(waiting.into_iter().map(|(to, _)| to).collect(), &Err(error.to_string()));
                self.submit(None);
            }
        }
        started.map(|_| ())
    }

    fn answer(&mut self, text: Result<String, String>, reply: Reply) {
        let (refused, shown) = match &text {
            Ok(text) => (false, text.clone()),
            Err(text) => (true, text.clone()),
        };
        self.answer = Some(Answered { at: Stamp::now(), text: shown, refused });
        // The requester may have ended.
        let _ = reply.map(|reply| reply.send(text));
    }

    fn show(&self) {
        self.board.set_session(SessionStatus { answer: self.answer.clone(), ..self.session.status() });
    }

    /// Ends the episode in progress at this moment, and waits until its last samples are written: those captured before
    /// may still be in transit.
    pub(super) async fn end_episode(&self) {
        self.recorder.end(Stamp::now());
        let mut episode = self.recorder.episode();
        // A stalled disk delays the file, and nothing else.
        let _ = timeout(LAST_SAMPLES, episode.wait_for(Option::is_none)).await;
    }

    /// Ends the episode in progress, if there is one, waits until its file is closed, and notes it; no other begins.
    pub(super) async fn finish_episode(&mut self) -> Option<EpisodeReport> {
        self.settle().await;
        let end = self.recorder.stop().await?;
        let (effects, answer) = self.end_noted(&end);
        for effect in effects {
            self.change(effect);
        }
        self.submit(answer);
        Some(end)
    }

    /// Writes the summary and waits until everything about the session is on the disk.
    ///
    /// # Errors
    /// When the keeper panicked, or something was never saved.
    pub(super) async fn close(&mut self) -> Result<(), AppError> {
        self.settle().await;
        if self.is_kept && !self.session.file().episodes.is_empty() {
            self.keeper.request(vec![Operation::Summarise(self.session.file().clone())], None);
        }
        let outcome = match self.keeper.close() {
            Some(thread) => join(thread, "thread `session`").await,
            None => Ok(()),
        };
        while let Some(outcome) = self.outcomes.recv().await {
            self.apply_outcome(outcome);
        }
        outcome.and(self.lost.take().map_or(Ok(()), |why| Err(AppError::Unsaved(why))))
    }
}

#[cfg(test)]
mod tests {
    use rapid_registry::Registry;

    use super::*;

    #[test]
    fn a_module_is_mounted_in_place_of_the_one_in_its_slot() {
        let text = "[device.a]\nvid = \"1\"\npid = \"2\"\nnode = \"camera\"\nbit = 0\n\
            [module.soft]\nslot = \"tip\"\n[module.rigid]\nslot = \"tip\"\n[module.handle]\nslot = \"bottom\"\n";
        let known = Registry::parse(text, None).unwrap().registry.modules;
        let after = |now: &[&str], requested: &[&str]| {
            let names = |names: &[&str]| names.iter().map(|name| (*name).to_owned()).collect::<Vec<_>>();
            mounted(&names(now), &names(requested), &known)
                .map(|names| names.join(" "))
                .map_err(|error| error.to_string())
        };
        assert_eq!(after(&[], &["soft"]).as_deref(), Ok("soft"));
        assert_eq!(after(&["soft", "handle"], &["rigid"]).as_deref(), Ok("handle rigid"));
        assert_eq!(after(&["soft"], &[]).as_deref(), Ok("soft"));
        assert_eq!(after(&["soft", "handle"], &["none"]).as_deref(), Ok(""));
        assert_eq!(after(&["soft", "handle"], &["none", "rigid"]).as_deref(), Ok("rigid"));
        assert!(after(&["soft"], &["sofd"]).is_err_and(|error| error.contains("did you mean \"soft\"?")));
        assert!(after(&[], &["soft", "rigid"]).is_err_and(|error| error.contains("both sit in the slot tip")));
    }
}
