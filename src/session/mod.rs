//! A session: what is to be collected, what was collected, and what of it can be undone; and what happens before, between
//! and after its episodes.
//!
//! [`Session`] alone has these three: the plan, the entries of the episodes with the names that are taken, and the order in
//! which episodes were discarded. It is a pure core: requests, begins and ends of episodes and the time go in, [`Effect`]s
//! come out. Its owner carries them out and reports how they ended.
//!
//! Invariant: pure: no clock, no file, no recorder. [`journal`] is its file, [`trash`] its folder, and [`keeper`] the
//! thread that changes both.
//! Invariant: an episode is never deleted before the session ends: discarding moves it to the trash.
//! Invariant: the journal is saved at every change, before anything else happens to the episode.

pub mod journal;
pub mod keeper;
pub mod noted;
pub mod trash;

use std::path::{Path, PathBuf};
use std::time::Duration;

use rapid_core::text;
use rapid_core::time::Stamp;

use journal::{Plan, SessionFile};
use rapid_status::session::{EpisodeEntry, Label, Mark, Notes, NotesChange, Phase, SessionRequest, SessionStatus};
use rapid_status::{Grade, Verdict};

/// Episodes that a screen lists.
const LISTED: usize = 200;
/// Longest text of a note, a mark or a reason, in bytes.
const LONGEST_TEXT: usize = 2000;

/// What the owner of a session is to do, in order.
#[derive(Debug, Clone, PartialEq)]
pub enum Effect {
    /// Save the journal.
    Save,
    /// Change the file beside this episode; without one, it begins with these notes.
    Note(String, Notes, Vec<NotesChange>),
    /// Begin an episode, and report it with [`Session::began`].
    Begin,
    /// End the episode in progress at this moment. Its end is reported with [`Session::ended`].
    End(Stamp),
    /// Move this episode to the trash; report a failure with [`Session::not_moved`].
    Discard(String),
    /// Take this episode back; report a failure with [`Session::not_moved`].
    Restore(String),
    /// Record a mark of the episode in progress.
    Mark(String),
    /// Delete these from the trash and give the journal its final name.
    Close(Vec<String>),
}

/// When a request is answered.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Answer {
    /// At once, with this text.
    Now(String),
    /// When the episode has begun.
    AtBegin,
    /// When the episode in progress is closed.
    AtEnd,
}

/// Why a request is refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum Refusal {
    /// There is an episode in progress.
    #[error("an episode is being recorded")]
    Busy,
    /// There is none.
    #[error("no episode is being recorded")]
    Idle,
    /// The session has no episode to which the request could apply.
    #[error("this session has no episode")]
    NoEpisode,
    /// Nothing was discarded.
    #[error("nothing was discarded in this session")]
    NothingDiscarded,
    /// A text is too long.
    #[error("the text is longer than {LONGEST_TEXT} bytes")]
    TooLong,
    /// The session is being closed.
    #[error("the session is being ended")]
    Closing,
    /// There is no such episode.
    #[error("this session has no such episode; `rapid session` lists what it has")]
    Unknown,
    /// The task is empty.
    #[error("a task needs a name")]
    NoTask,
}

/// What happens to the episode in progress once it is closed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
struct After {
    discard: bool,
    next: Next,
}

/// What follows the episode in progress.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
enum Next {
    /// By the plan: a reset and the next episode, or nothing.
    #[default]
    Planned,
    /// Another episode.
    Begin,
    Wait,
}

/// A session as it is shown to other programs, with the kind of the object (docs/schema.json).
#[derive(serde::Serialize)]
struct Shown<'a> {
    event: &'static str,
    #[serde(flatten)]
    session: &'a SessionStatus,
}

/// See the module's comment. A copy is what it was, for an order that cannot be carried out.
#[derive(Debug, Clone)]
pub struct Session {
    folder: PathBuf,
    file: SessionFile,
    /// The plan with which it was made has a goal.
    has_own_goal: bool,
    /// Names of the episodes of earlier sessions.
    earlier: Vec<String>,
    phase: Phase,
    after: After,
    /// The entry of the episode in progress, and when it began.
    current: Option<(usize, Stamp)>,
    /// Entries that were discarded, in that order.
    discarded: Vec<usize>,
    /// The end of the session was requested, and its file is not closed yet.
    closing: bool,
}

impl Session {
    /// A session in `folder` by `plan`. It continues `before`, a session in progress there, if that has the same task;
    /// otherwise the second value is true. No episode gets a name of `earlier` ones.
    pub fn new(
        folder: &Path,
        plan: Plan,
        before: Option<SessionFile>,
        earlier: Vec<String>,
        begun: String,
    ) -> (Self, bool) {
        let continued = before.filter(|before| before.has(&plan.task));
        let is_new = continued.is_none();
        let episodes = continued.as_ref().map(|before| before.episodes.clone()).unwrap_or_default();
        let begun = continued.as_ref().map_or(begun, |before| before.begun.clone());
        let has_own_goal = plan.goal.is_some();
        // A goal is one of a task.
        let goal = plan.goal.or_else(|| continued.filter(|before| before.plan.task == plan.task)?.plan.goal);
        let discarded = (0..episodes.len()).filter(|index| episodes.get(*index).is_some_and(|e| e.discarded)).collect();
        let file = SessionFile { begun, plan: Plan { goal, ..plan }, episodes, ..SessionFile::default() };
        let session = Self {
            folder: folder.to_owned(),
            file,
            has_own_goal,
            earlier,
            phase: Phase::Idle,
            after: After::default(),
            current: None,
            discarded,
            closing: false,
        };
        (session, is_new)
    }

    /// What is to be saved.
    pub fn file(&self) -> &SessionFile {
        &self.file
    }

    /// The names that no further episode gets: those of all its episodes, discarded or not, and of earlier sessions.
    pub fn taken(&self) -> Vec<String> {
        let own = self.file.episodes.iter().map(|entry| &entry.file);
        self.earlier.iter().chain(own).cloned().collect()
    }

    /// The episode that a request without a name is about: the one in progress, or the last that is kept.
    pub fn newest(&self) -> Option<&str> {
        let index = self.current.map(|(index, _)| index).or_else(|| self.last())?;
        self.file.episodes.get(index).map(|entry| &*entry.file)
    }

    /// What the next episode is of.
    pub fn plan(&self) -> &Plan {
        &self.file.plan
    }

    /// Whether an episode is in progress, or begins at this moment.
    pub fn phase(&self) -> Phase {
        self.phase
    }

    /// How many episodes of the task count for the goal.
    pub fn counted(&self) -> usize {
        let task = &self.file.plan.task;
        self.file.episodes.iter().filter(|episode| episode.counts() && episode.task == *task).count()
    }

    /// Whether there is a goal and it is reached.
    pub fn is_complete(&self) -> bool {
        self.file.plan.goal.is_some_and(|goal| self.counted() >= usize::try_from(goal).unwrap_or(usize::MAX))
    }

    /// Whether the goal of the plan with which it was made is reached.
    pub fn is_done(&self) -> bool {
        self.has_own_goal && self.is_complete()
    }

    /// When [`Self::tick`] is to be called next, if at all.
    pub fn due(&self) -> Option<Stamp> {
        match self.phase {
            Phase::Countdown { until } | Phase::Reset { until } => Some(until),
            Phase::Idle | Phase::Recording | Phase::Ending => None,
        }
    }

    /// Carries out what is due at `now`.
    pub fn tick(&mut self, now: Stamp) -> Vec<Effect> {
        match self.phase {
            Phase::Reset { until } if now >= until => self.approach(now),
            Phase::Countdown { until } if now >= until => vec![Effect::Begin],
            _ => Vec::new(),
        }
    }

    /// Handles a request made at `now`.
    ///
    /// # Errors
    /// When it does not apply at the moment; nothing has changed then.
    pub fn request(&mut self, request: &SessionRequest, now: Stamp) -> Result<(Answer, Vec<Effect>), Refusal> {
        if self.closing && *request != SessionRequest::Show {
            return Err(Refusal::Closing);
        }
        match request {
            SessionRequest::Toggle if self.phase == Phase::Recording => self.end(After::default(), now),
            SessionRequest::Toggle | SessionRequest::Start => self.start(now),
            SessionRequest::Stop => self.stop(now),
            SessionRequest::Next => self.next(now),
            SessionRequest::Redo => self.redo(now),
            SessionRequest::Discard { episode: None } => self.discard(now),
            SessionRequest::Discard { episode: Some(file) } => self.discard_other(file, now),
            SessionRequest::Undo => self.undo(),
            SessionRequest::Mark { text } => self.mark(text, now),
            SessionRequest::Label { episode, label, reason } => {
                let change = NotesChange::Label(Some(*label), reason.clone());
                self.note(episode.as_deref(), reason, change, &label.to_string())
            }
            SessionRequest::Note { episode, text } => {
                let done = if text.is_empty() { "note removed" } else { "noted" };
                self.note(episode.as_deref(), text, NotesChange::Note(text.clone()), done)
            }
            SessionRequest::Plan { task: Some(task), .. } if task.trim().is_empty() => Err(Refusal::NoTask),
            SessionRequest::Plan { task, tags, goal, .. } => Ok(self.change_plan(task.as_deref(), tags, *goal)),
            SessionRequest::EndSession => self.end_session(),
            SessionRequest::Show => {
                let shown = Shown { event: "session", session: &self.status() };
                Ok((Answer::Now(text::json(&shown).unwrap_or_default()), Vec::new()))
            }
        }
    }

    /// The episode that [`Effect::Begin`] asked for has begun as `file`, or not.
    pub fn began(&mut self, file: Option<&Path>, begun: String, now: Stamp) -> Vec<Effect> {
        let Some(file) = file else {
            // The reason is shown elsewhere; a plan that failed once is not repeated without a request.
            self.phase = Phase::Idle;
            return Vec::new();
        };
        self.phase = Phase::Recording;
        self.after = After::default();
        self.current = Some((self.file.episodes.len(), now));
        let task = self.file.plan.task.clone();
        self.file.episodes.push(EpisodeEntry { task, ..EpisodeEntry::begin(name(file), begun) });
        vec![Effect::Save]
    }

    /// The episode in progress was closed as `file`, for whatever reason.
    pub fn ended(&mut self, file: &Path, seconds: f64, verdict: &Verdict, now: Stamp) -> Vec<Effect> {
        let Some((index, _)) = self.current.take() else { return Vec::new() };
        let After { discard, next } = std::mem::take(&mut self.after);
        if let Some(entry) = self.file.episodes.get_mut(index) {
            entry.file = name(file);
            entry.close(seconds, verdict);
        }
        let mut effects = vec![Effect::Save];
        effects.extend(self.file.episodes.get(index).and_then(note_beside));
        if discard {
            effects.extend(self.put_away(index));
        }
        self.phase = Phase::Idle;
        effects.extend(match next {
            Next::Begin => self.approach(now),
            Next::Wait => Vec::new(),
            Next::Planned => self.follow_plan(now),
        });
        effects
    }

    /// Whether the episode in progress will be discarded.
    pub fn discards(&self) -> bool {
        self.after.discard
    }

    /// The episodes of which no end was noted, apart from the one in progress: the run was killed then.
    pub fn unfinished(&self) -> Vec<String> {
        let current = self.current.map(|(index, _)| index);
        let all = self.file.episodes.iter().enumerate();
        all.filter(|(index, entry)| entry.verdict.is_none() && Some(*index) != current)
            .map(|(_, entry)| entry.file.clone())
            .collect()
    }

    /// What became of an unfinished episode: its length and verdict, or `None` if there is no file with samples.
    pub fn examined(&mut self, file: &str, found: Option<(f64, &Verdict)>) -> Vec<Effect> {
        let is_it = |entry: &EpisodeEntry| entry.file == file && entry.verdict.is_none();
        let Some(index) = self.file.episodes.iter().position(is_it) else { return Vec::new() };
        let Some(entry) = self.file.episodes.get_mut(index) else { return Vec::new() };
        let Some((seconds, verdict)) = found else {
            entry.reasons = vec!["nothing of it was recorded".to_owned()];
            return vec![Effect::Save];
        };
        entry.close(seconds, verdict);
        [Effect::Save].into_iter().chain(note_beside(entry)).collect()
    }

    /// The session that was to be closed is, at `now`, and another follows by the same plan; or it is not.
    pub fn closed(&mut self, is_closed: bool, now: String) {
        self.closing = false;
        if is_closed {
            self.earlier = self.taken();
            self.file = SessionFile { begun: now, plan: self.file.plan.clone(), ..SessionFile::default() };
            self.discarded.clear();
        }
    }

    /// An episode could not be moved: it is where it was.
    pub fn not_moved(&mut self, file: &str) -> Vec<Effect> {
        let Some(index) = self.file.episodes.iter().rposition(|entry| entry.file == file) else { return Vec::new() };
        let Some(entry) = self.file.episodes.get_mut(index) else { return Vec::new() };
        entry.discarded = !entry.discarded;
        self.discarded.retain(|other| *other != index);
        if entry.discarded {
            self.discarded.push(index);
        }
        vec![Effect::Save]
    }

    /// For a screen.
    pub fn status(&self) -> SessionStatus {
        let episodes = &self.file.episodes;
        let mut verdicts = [0; 3];
        for entry in episodes.iter().filter(|entry| !entry.discarded) {
            if let Some(count) = entry.verdict.and_then(|grade| verdicts.get_mut(grade as usize)) {
                *count += 1;
            }
        }
        SessionStatus {
            folder: self.folder.clone(),
            task: self.file.plan.task.clone(),
            tags: self.file.plan.tags.iter().map(|(key, value)| (key.clone(), value.clone())).collect(),
            goal: self.file.plan.goal,
            phase: self.phase,
            counted: self.counted(),
            verdicts,
            discarded: self.discarded.len(),
            episodes: episodes.get(episodes.len().saturating_sub(LISTED)..).unwrap_or_default().to_vec(),
            answer: None,
        }
    }

    fn start(&mut self, now: Stamp) -> Result<(Answer, Vec<Effect>), Refusal> {
        match self.phase {
            Phase::Idle => {
                let effects = self.approach(now);
                Ok((Answer::AtBegin, effects))
            }
            // Who does not want to wait asks again.
            Phase::Countdown { .. } | Phase::Reset { .. } => Ok((Answer::AtBegin, vec![Effect::Begin])),
            Phase::Recording => Err(Refusal::Busy),
            Phase::Ending => {
                self.after.next = Next::Begin;
                Ok((Answer::AtBegin, Vec::new()))
            }
        }
    }

    /// Begins an episode, after the countdown if there is one.
    fn approach(&mut self, now: Stamp) -> Vec<Effect> {
        match self.file.plan.countdown.filter(|countdown| !countdown.is_zero()) {
            Some(countdown) => {
                self.phase = Phase::Countdown { until: now.after(countdown) };
                Vec::new()
            }
            None => vec![Effect::Begin],
        }
    }

    fn follow_plan(&mut self, now: Stamp) -> Vec<Effect> {
        if let Some(reset) = self.file.plan.reset_time.filter(|_| !self.is_complete()) {
            self.phase = Phase::Reset { until: now.after(reset) };
        }
        Vec::new()
    }

    fn end(&mut self, after: After, now: Stamp) -> Result<(Answer, Vec<Effect>), Refusal> {
        self.after = After { discard: self.after.discard || after.discard, next: after.next };
        match self.phase {
            Phase::Recording => {
                self.phase = Phase::Ending;
                Ok((Answer::AtEnd, vec![Effect::End(now)]))
            }
            Phase::Ending => Ok((Answer::AtEnd, Vec::new())),
            Phase::Idle | Phase::Countdown { .. } | Phase::Reset { .. } => Err(Refusal::Idle),
        }
    }

    /// Ends the episode in progress, and begins another.
    fn end_and_begin(&mut self, discard: bool, now: Stamp) -> Result<(Answer, Vec<Effect>), Refusal> {
        let (_, effects) = self.end(After { discard, next: Next::Begin }, now)?;
        Ok((Answer::AtBegin, effects))
    }

    fn stop(&mut self, now: Stamp) -> Result<(Answer, Vec<Effect>), Refusal> {
        match self.phase {
            Phase::Countdown { .. } | Phase::Reset { .. } => {
                self.phase = Phase::Idle;
                Ok((Answer::Now("no further episode begins by itself".to_owned()), Vec::new()))
            }
            _ => self.end(After { discard: false, next: Next::Wait }, now),
        }
    }

    fn next(&mut self, now: Stamp) -> Result<(Answer, Vec<Effect>), Refusal> {
        match self.phase {
            Phase::Recording | Phase::Ending => self.end_and_begin(false, now),
            _ => self.start(now),
        }
    }

    fn redo(&mut self, now: Stamp) -> Result<(Answer, Vec<Effect>), Refusal> {
        if matches!(self.phase, Phase::Recording | Phase::Ending) {
            return self.end_and_begin(true, now);
        }
        let last = self.last().ok_or(Refusal::NoEpisode)?;
        let mut effects = self.put_away(last);
        let (answer, begin) = self.start(now)?;
        effects.extend(begin);
        Ok((answer, effects))
    }

    fn discard(&mut self, now: Stamp) -> Result<(Answer, Vec<Effect>), Refusal> {
        if matches!(self.phase, Phase::Recording | Phase::Ending) {
            return self.end(After { discard: true, next: Next::Wait }, now);
        }
        let last = self.last().ok_or(Refusal::NoEpisode)?;
        // The scene of a discarded episode is not reset in a hurry.
        self.phase = Phase::Idle;
        let effects = self.put_away(last);
        let file = self.file.episodes.get(last).map(|entry| entry.file.clone()).unwrap_or_default();
        Ok((Answer::Now(format!("{file} is in the trash")), effects))
    }

    /// Discards an episode of this session that may not be the last one.
    fn discard_other(&mut self, file: &str, now: Stamp) -> Result<(Answer, Vec<Effect>), Refusal> {
        let index = self.find(file)?;
        if self.current.is_some_and(|(current, _)| current == index) || self.last() == Some(index) {
            return self.discard(now);
        }
        let effects = self.put_away(index);
        Ok((Answer::Now(format!("{file} is in the trash")), effects))
    }

    /// A kept episode.
    fn find(&self, file: &str) -> Result<usize, Refusal> {
        let is_it = |entry: &EpisodeEntry| entry.file == file && !entry.discarded;
        self.file.episodes.iter().rposition(is_it).ok_or(Refusal::Unknown)
    }

    fn undo(&mut self) -> Result<(Answer, Vec<Effect>), Refusal> {
        let index = self.discarded.pop().ok_or(Refusal::NothingDiscarded)?;
        let entry = self.file.episodes.get_mut(index).ok_or(Refusal::NothingDiscarded)?;
        entry.discarded = false;
        let file = entry.file.clone();
        Ok((Answer::Now(format!("{file} is back")), vec![Effect::Restore(file), Effect::Save]))
    }

    fn mark(&mut self, text: &str, now: Stamp) -> Result<(Answer, Vec<Effect>), Refusal> {
        let (index, begun) = self.current.filter(|_| self.phase == Phase::Recording).ok_or(Refusal::Idle)?;
        if text.len() > LONGEST_TEXT {
            return Err(Refusal::TooLong);
        }
        let at = (now.since(begun).as_secs_f64() * 1000.0).round() / 1000.0;
        if let Some(entry) = self.file.episodes.get_mut(index) {
            entry.marks.push(Mark { at, text: text.to_owned() });
        }
        Ok((Answer::Now(format!("marked at {at:.1} s")), vec![Effect::Mark(text.to_owned()), Effect::Save]))
    }

    /// Changes what is noted about an episode. While it is recorded, that is in the journal alone.
    fn note(
        &mut self,
        episode: Option<&str>,
        text: &str,
        change: NotesChange,
        done: &str,
    ) -> Result<(Answer, Vec<Effect>), Refusal> {
        if text.len() > LONGEST_TEXT {
            return Err(Refusal::TooLong);
        }
        let current = self.current.map(|(index, _)| index);
        let newest = || current.or_else(|| self.last()).ok_or(Refusal::NoEpisode);
        let index = episode.map_or_else(newest, |file| self.find(file))?;
        let entry = self.file.episodes.get_mut(index).ok_or(Refusal::NoEpisode)?;
        let before = entry.notes();
        let mut notes = before.clone();
        notes.apply(&change);
        entry.set_notes(notes);
        let (answer, file) = (Answer::Now(format!("{}: {done}", entry.file)), entry.file.clone());
        let beside = (current != Some(index)).then(|| Effect::Note(file, before, vec![change]));
        Ok((answer, beside.into_iter().chain([Effect::Save]).collect()))
    }

    /// The last episode that is kept.
    fn last(&self) -> Option<usize> {
        self.file.episodes.iter().rposition(|entry| !entry.discarded)
    }

    fn put_away(&mut self, index: usize) -> Vec<Effect> {
        let Some(entry) = self.file.episodes.get_mut(index) else { return Vec::new() };
        entry.discarded = true;
        self.discarded.push(index);
        vec![Effect::Discard(entry.file.clone()), Effect::Save]
    }

    fn change_plan(
        &mut self,
        task: Option<&str>,
        tags: &[(String, String)],
        goal: Option<u32>,
    ) -> (Answer, Vec<Effect>) {
        let plan = &mut self.file.plan;
        if let Some(task) = task {
            task.clone_into(&mut plan.task);
        }
        for (key, value) in tags {
            if value.is_empty() {
                plan.tags.remove(key);
            } else {
                plan.tags.insert(key.clone(), value.clone());
            }
        }
        if let Some(goal) = goal {
            plan.goal = (goal > 0).then_some(goal);
        }
        let tags: Vec<String> = plan.tags.iter().map(|(key, value)| format!(" {key}={value}")).collect();
        let goal = plan.goal.map(|goal| format!(", {} wanted", text::counted(goal.into(), "episode")));
        let goal = goal.unwrap_or_default();
        let text = format!("task {:?}{}{goal}", plan.task, tags.concat());
        (Answer::Now(text), vec![Effect::Save])
    }

    fn end_session(&mut self) -> Result<(Answer, Vec<Effect>), Refusal> {
        if matches!(self.phase, Phase::Recording | Phase::Ending) {
            return Err(Refusal::Busy);
        }
        if self.file.episodes.is_empty() {
            return Err(Refusal::NoEpisode);
        }
        let (is_gone, kept): (Vec<_>, Vec<_>) = self.file.episodes.iter().partition(|entry| entry.discarded);
        let gone: Vec<String> = is_gone.into_iter().map(|entry| entry.file.clone()).collect();
        // Of a run that was killed at once there may be nothing.
        let recorded = kept.iter().filter(|entry| entry.verdict.is_some()).count();
        let kept = text::counted(recorded as u64, "episode");
        let text = format!("session ended: {kept} kept, {} deleted", gone.len());
        self.phase = Phase::Idle;
        self.closing = true;
        Ok((Answer::Now(text), vec![Effect::Save, Effect::Close(gone)]))
    }

    /// What is saved of a session that ends at `ended`: without what is deleted.
    pub fn at_end(&self, ended: String) -> SessionFile {
        let (gone, episodes): (Vec<_>, Vec<_>) = self.file.episodes.iter().cloned().partition(|entry| entry.discarded);
        let deleted = gone.into_iter().map(|entry| entry.file).collect();
        SessionFile { ended: Some(ended), episodes, deleted, ..self.file.clone() }
    }
}

/// The summary of a session, as Markdown.
pub fn markdown(file: &SessionFile) -> String {
    use std::fmt::Write as _;
    let cell = |text: &str| text::plain(text).replace('|', "\\|");
    let kept: Vec<_> = file.episodes.iter().filter(|entry| !entry.discarded).collect();
    let of = |grade: Grade| kept.iter().filter(|entry| entry.verdict == Some(grade)).count();
    let seconds: f64 = kept.iter().filter_map(|entry| entry.seconds).sum();
    let mut page = format!("# {}\n\n", cell(&file.plan.task));
    let counted = kept.iter().filter(|entry| entry.counts()).count();
    let goal = file.plan.goal.map(|goal| format!("; {counted} of {goal} wanted")).unwrap_or_default();
    // Writing to a string does not fail.
    let _ = writeln!(
        page,
        "{}, {} in all: {} GOOD, {} SUSPECT, {} BAD{goal}. Begun {}.\n",
        text::counted(kept.len() as u64, "episode"),
        text::about(Duration::try_from_secs_f64(seconds).unwrap_or_default()),
        of(Grade::Good),
        of(Grade::Suspect),
        of(Grade::Bad),
        file.begun,
    );
    page.push_str("| episode | length | verdict | sensors | label | remarks |\n|---|---|---|---|---|---|\n");
    for entry in kept {
        let length = entry.seconds.map(|seconds| format!("{seconds:.1} s")).unwrap_or_default();
        let verdict = entry.verdict.map_or("not closed", Grade::word);
        let sensors = entry.sensors.as_ref().map(ToString::to_string).unwrap_or_default();
        let label = entry.label.map(Label::word).unwrap_or_default();
        let remarks = [&entry.reasons.join("; "), &entry.label_reason, &entry.note];
        let remarks: Vec<_> = remarks.into_iter().filter(|text| !text.is_empty()).map(|text| cell(text)).collect();
        let _ = writeln!(
            page,
            "| {} | {length} | {verdict} | {} | {label} | {} |",
            cell(&entry.file),
            cell(&sensors),
            remarks.join("; ")
        );
    }
    page
}

/// What people noted about an episode while it was recorded, for the file beside it.
fn note_beside(entry: &EpisodeEntry) -> Option<Effect> {
    let changes = entry.notes().into_changes();
    (!changes.is_empty()).then(|| Effect::Note(entry.file.clone(), Notes::default(), changes))
}

fn name(file: &Path) -> String {
    file.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

#[cfg(test)]
mod tests;
