//! The session's core, driven by requests and by an owner that carries out its effects.

use std::collections::BTreeSet;

use proptest::prelude::*;

use super::*;

const SECOND: Duration = Duration::from_secs(1);

/// An owner that does what it is asked to, and what is on its disk.
struct Owner {
    session: Session,
    now: Stamp,
    recording: Option<String>,
    /// The end of the episode in progress was requested.
    ending: bool,
    begun: usize,
    files: BTreeSet<String>,
    trash: BTreeSet<String>,
    saved: SessionFile,
    /// Moving a file fails.
    stuck: bool,
}

fn plan() -> Plan {
    Plan { task: "place block".to_owned(), ..Plan::default() }
}

impl Owner {
    fn new(plan: Plan) -> Self {
        let (session, is_new) = Session::new(Path::new("episodes"), plan, None, Vec::new(), "t0".to_owned());
        assert!(is_new);
        Self {
            saved: session.file().clone(),
            session,
            now: Stamp(1_000_000_000),
            recording: None,
            ending: false,
            begun: 0,
            files: BTreeSet::new(),
            trash: BTreeSet::new(),
            stuck: false,
        }
    }

    #[expect(clippy::needless_pass_by_value, reason = "each call makes its own")]
    fn request(&mut self, request: SessionRequest) -> Result<Answer, Refusal> {
        let (answer, effects) = self.session.request(&request, self.now)?;
        self.carry_out(effects);
        Ok(answer)
    }

    fn carry_out(&mut self, effects: Vec<Effect>) {
        for effect in effects {
            match effect {
                Effect::Save => self.saved = self.session.file().clone(),
                Effect::Begin => {
                    assert_eq!(self.recording, None, "an episode begins in another");
                    self.begun += 1;
                    let file = format!("{:03}.mcap", self.begun);
                    self.recording = Some(file.clone());
                    let effects = self.session.began(Some(Path::new(&file)), "t".to_owned(), self.now);
                    self.carry_out(effects);
                }
                Effect::End(_) => {
                    assert!(self.recording.is_some() && !self.ending, "the end of nothing");
                    self.ending = true;
                }
                Effect::Discard(file) if !self.stuck => {
                    assert!(self.files.remove(&file), "{file} is not there");
                    self.trash.insert(file);
                }
                Effect::Restore(file) if !self.stuck => {
                    assert!(self.trash.remove(&file), "{file} is not in the trash");
                    self.files.insert(file);
                }
                Effect::Discard(file) | Effect::Restore(file) => {
                    let effects = self.session.not_moved(&file);
                    self.carry_out(effects);
                }
                Effect::Mark(_) => assert!(self.recording.is_some()),
                Effect::Note(file, ..) => assert_ne!(self.recording.as_ref(), Some(&file), "it has no name yet"),
                Effect::Close(_) if self.stuck => self.session.closed(false, "t1".to_owned()),
                Effect::Close(gone) => {
                    for file in gone {
                        assert!(self.trash.remove(&file), "{file} is not in the trash");
                    }
                    self.session.closed(true, "t1".to_owned());
                    self.saved = self.session.file().clone();
                }
            }
        }
    }

    /// The file of the episode in progress is closed.
    fn close(&mut self, grade: Grade) {
        let Some(file) = self.recording.take() else { return };
        self.ending = false;
        self.files.insert(file.clone());
        let verdict = Verdict { grade, reasons: Vec::new(), sensors: None, replay_of: Vec::new() };
        let effects = self.session.ended(Path::new(&file), 1.0, &verdict, self.now);
        self.carry_out(effects);
    }

    fn wait(&mut self, time: Duration) {
        self.now = self.now.after(time);
        let effects = self.session.tick(self.now);
        self.carry_out(effects);
    }

    /// Records one whole episode.
    fn record(&mut self) {
        self.request(SessionRequest::Start).unwrap();
        self.request(SessionRequest::Stop).unwrap();
        self.close(Grade::Good);
    }

    fn check(&self) {
        let session = &self.session;
        let recording = matches!(session.phase, Phase::Recording | Phase::Ending);
        assert_eq!(recording, self.recording.is_some(), "{:?}", session.phase);
        assert_eq!(session.current.is_some(), recording);
        assert_eq!(session.phase == Phase::Ending, self.ending);
        let of = |discarded| {
            let of = session.file.episodes.iter().filter(move |entry| entry.discarded == discarded);
            of.map(|entry| entry.file.clone()).collect::<BTreeSet<_>>()
        };
        assert_eq!(of(true), self.trash);
        let mut kept = self.files.clone();
        kept.extend(self.recording.clone());
        assert!(of(false).is_subset(&kept), "{:?} {kept:?}", of(false));
        assert_eq!(session.discarded.len(), self.trash.len());
        assert_eq!(&self.saved.episodes, &session.file.episodes, "a change was not saved");
    }
}

#[test]
fn an_episode_is_discarded_and_comes_back() {
    let mut owner = Owner::new(plan());
    owner.record();
    owner.record();
    assert_eq!(owner.session.counted(), 2);
    owner.request(SessionRequest::Discard { episode: None }).unwrap();
    owner.request(SessionRequest::Discard { episode: None }).unwrap();
    assert_eq!((owner.session.counted(), owner.trash.len()), (0, 2));
    assert_eq!(owner.request(SessionRequest::Discard { episode: None }), Err(Refusal::NoEpisode));
    owner.request(SessionRequest::Undo).unwrap();
    assert_eq!(owner.files, ["001.mcap".to_owned()].into(), "what was discarded last comes back first");
    owner.request(SessionRequest::Undo).unwrap();
    assert_eq!(owner.request(SessionRequest::Undo), Err(Refusal::NothingDiscarded));
    owner.check();
}

#[test]
fn redo_replaces_the_episode_in_progress_or_the_last() {
    let mut owner = Owner::new(plan());
    owner.request(SessionRequest::Start).unwrap();
    assert_eq!(owner.request(SessionRequest::Redo), Ok(Answer::AtBegin));
    owner.close(Grade::Good);
    assert_eq!((owner.trash.len(), owner.recording.as_deref()), (1, Some("002.mcap")));
    owner.request(SessionRequest::Stop).unwrap();
    owner.close(Grade::Good);
    assert_eq!(owner.request(SessionRequest::Redo), Ok(Answer::AtBegin));
    assert_eq!((owner.trash.len(), owner.recording.as_deref()), (2, Some("003.mcap")));
    owner.check();
}

#[test]
fn a_plan_runs_by_itself_until_its_goal() {
    let spans = (Some(3 * SECOND), Some(10 * SECOND));
    let mut owner = Owner::new(Plan { goal: Some(2), countdown: spans.0, reset_time: spans.1, ..plan() });
    assert_eq!(owner.request(SessionRequest::Start), Ok(Answer::AtBegin));
    assert_eq!(owner.session.phase(), Phase::Countdown { until: owner.now.after(3 * SECOND) });
    owner.wait(2 * SECOND);
    assert_eq!(owner.recording, None);
    owner.wait(SECOND);
    assert_eq!(owner.recording.as_deref(), Some("001.mcap"));
    // By its own length. A BAD one does not count.
    owner.close(Grade::Bad);
    for _ in 0..2 {
        assert_eq!(owner.session.phase(), Phase::Reset { until: owner.now.after(10 * SECOND) });
        owner.wait(10 * SECOND);
        owner.wait(3 * SECOND);
        owner.close(Grade::Suspect);
    }
    assert!(owner.session.is_complete());
    assert_eq!((owner.session.phase(), owner.session.due()), (Phase::Idle, None));
    owner.check();
}

#[test]
fn a_reset_and_a_countdown_can_be_skipped_or_ended() {
    let mut owner = Owner::new(Plan { countdown: Some(3 * SECOND), reset_time: Some(10 * SECOND), ..plan() });
    owner.request(SessionRequest::Toggle).unwrap();
    owner.request(SessionRequest::Toggle).unwrap();
    assert_eq!(owner.recording.as_deref(), Some("001.mcap"));
    owner.close(Grade::Good);
    owner.request(SessionRequest::Toggle).unwrap();
    assert_eq!(owner.recording.as_deref(), Some("002.mcap"));
    // A toggle ends the episode, and the plan continues; a stop ends the plan too.
    owner.request(SessionRequest::Toggle).unwrap();
    owner.close(Grade::Good);
    assert!(matches!(owner.session.phase(), Phase::Reset { .. }));
    owner.request(SessionRequest::Stop).unwrap();
    assert_eq!(owner.session.phase(), Phase::Idle);
    assert_eq!(owner.request(SessionRequest::Stop), Err(Refusal::Idle));
}

#[test]
fn a_request_to_begin_while_an_episode_is_closed_is_kept() {
    let mut owner = Owner::new(plan());
    owner.request(SessionRequest::Toggle).unwrap();
    owner.request(SessionRequest::Toggle).unwrap();
    assert_eq!(owner.request(SessionRequest::Toggle), Ok(Answer::AtBegin));
    owner.close(Grade::Good);
    assert_eq!(owner.recording.as_deref(), Some("002.mcap"));
    assert_eq!(owner.request(SessionRequest::Start), Err(Refusal::Busy));
}

#[test]
fn an_episode_that_does_not_begin_ends_the_plan() {
    let mut owner = Owner::new(Plan { reset_time: Some(SECOND), ..plan() });
    assert_eq!(owner.session.request(&SessionRequest::Start, owner.now).unwrap().1, [Effect::Begin]);
    assert_eq!(owner.session.began(None, "t".to_owned(), owner.now), []);
    assert_eq!((owner.session.phase(), owner.session.due()), (Phase::Idle, None));
    assert!(owner.session.file().episodes.is_empty());
}

#[test]
fn labels_notes_and_marks_are_of_the_episode_in_progress_or_the_last() {
    let mut owner = Owner::new(plan());
    let label = SessionRequest::Label { episode: None, label: Label::Failure, reason: "slipped".to_owned() };
    assert_eq!(owner.request(label.clone()), Err(Refusal::NoEpisode));
    assert_eq!(owner.request(SessionRequest::Mark { text: String::new() }), Err(Refusal::Idle));
    owner.record();
    owner.request(label).unwrap();
    owner.request(SessionRequest::Start).unwrap();
    owner.wait(2 * SECOND);
    owner.request(SessionRequest::Mark { text: "grasp".to_owned() }).unwrap();
    owner.request(SessionRequest::Note { episode: None, text: "new gripper".to_owned() }).unwrap();
    let long = SessionRequest::Note { episode: None, text: "x".repeat(LONGEST_TEXT + 1) };
    assert_eq!(owner.request(long), Err(Refusal::TooLong));
    let [first, second] = &owner.session.file().episodes[..] else { panic!("two episodes") };
    assert_eq!((first.label, first.label_reason.as_str()), (Some(Label::Failure), "slipped"));
    assert_eq!((second.label, second.note.as_str()), (None, "new gripper"));
    assert_eq!(second.marks, [Mark { at: 2.0, text: "grasp".to_owned() }]);
    owner.check();
}

#[test]
fn a_session_is_continued_by_the_same_task_only() {
    let mut owner = Owner::new(Plan { goal: Some(5), ..plan() });
    owner.record();
    owner.record();
    owner.request(SessionRequest::Discard { episode: None }).unwrap();
    let before = Some(owner.saved.clone());
    let (mut again, is_new) = Session::new(Path::new("episodes"), plan(), before.clone(), Vec::new(), "t2".to_owned());
    assert!(!is_new);
    assert_eq!((again.counted(), again.plan().goal, again.file().begun.as_str()), (1, Some(5), "t0"));
    let undone = again.request(&SessionRequest::Undo, owner.now).unwrap();
    assert_eq!(undone.1.first(), Some(&Effect::Restore("002.mcap".to_owned())));
    let other = Plan { task: "pour".to_owned(), ..plan() };
    let (other, is_new) = Session::new(Path::new("episodes"), other, before, Vec::new(), "t2".to_owned());
    assert!(is_new && other.file().episodes.is_empty());
}

#[test]
fn ending_a_session_deletes_what_was_discarded_and_nothing_else() {
    let mut owner = Owner::new(plan());
    assert_eq!(owner.request(SessionRequest::EndSession), Err(Refusal::NoEpisode));
    owner.record();
    owner.record();
    owner.request(SessionRequest::Discard { episode: None }).unwrap();
    assert_eq!(owner.session.at_end("t9".to_owned()).episodes.len(), 1);
    let answer = owner.request(SessionRequest::EndSession).unwrap();
    assert_eq!(answer, Answer::Now("session ended: 1 episode kept, 1 deleted".to_owned()));
    assert_eq!((owner.files.len(), owner.trash.len()), (1, 0));
    assert!(owner.session.file().episodes.is_empty());
    owner.request(SessionRequest::Start).unwrap();
    assert_eq!(owner.session.taken(), ["001.mcap", "002.mcap", "003.mcap"], "no name is given again");
    assert_eq!(owner.request(SessionRequest::EndSession), Err(Refusal::Busy));
}

#[test]
fn a_session_that_cannot_be_closed_continues_with_all_that_was_noted() {
    let mut owner = Owner::new(plan());
    owner.record();
    owner.record();
    owner.request(SessionRequest::Discard { episode: None }).unwrap();
    owner.request(SessionRequest::Note { episode: None, text: "pads".to_owned() }).unwrap();
    let before = owner.session.file().clone();
    let (_, effects) = owner.session.request(&SessionRequest::EndSession, owner.now).unwrap();
    for request in [SessionRequest::Start, SessionRequest::Undo, SessionRequest::EndSession] {
        assert_eq!(owner.request(request), Err(Refusal::Closing));
    }
    owner.stuck = true;
    owner.carry_out(effects);
    assert_eq!((owner.session.file(), owner.trash.len()), (&before, 1));
    owner.stuck = false;
    owner.request(SessionRequest::Undo).unwrap();
    owner.check();
}

#[test]
fn an_episode_of_a_killed_run_counts_once_it_is_known_what_became_of_it() {
    let mut owner = Owner::new(Plan { goal: Some(2), ..plan() });
    owner.record();
    owner.request(SessionRequest::Start).unwrap();
    assert_eq!((owner.session.counted(), owner.session.unfinished().len()), (1, 0), "it is being recorded");
    // Killed, and started again.
    let (mut again, _) =
        Session::new(Path::new("episodes"), plan(), Some(owner.saved.clone()), Vec::new(), "t2".to_owned());
    assert_eq!((again.counted(), again.unfinished()), (1, vec!["002.mcap".to_owned()]));
    assert!(!again.is_complete());
    let nothing = again.examined("002.mcap", None);
    assert_eq!((nothing, again.counted()), (vec![Effect::Save], 1));
    assert!(markdown(again.file()).contains("| 002.mcap |  | not closed |  |  | nothing of it was recorded |"));
    let verdict =
        Verdict { grade: Grade::Suspect, reasons: vec!["cut off".to_owned()], sensors: None, replay_of: Vec::new() };
    again.examined("002.mcap", Some((1.5, &verdict)));
    assert!(again.is_complete() && again.unfinished().is_empty());
    assert_eq!(again.examined("001.mcap", None), [], "it is closed");
}

#[test]
fn an_older_episode_is_named() {
    let mut owner = Owner::new(plan());
    for _ in 0..3 {
        owner.record();
    }
    let first = || Some("001.mcap".to_owned());
    owner.request(SessionRequest::Label { episode: first(), label: Label::Success, reason: String::new() }).unwrap();
    owner.request(SessionRequest::Start).unwrap();
    let discarded = owner.request(SessionRequest::Discard { episode: first() }).unwrap();
    assert_eq!(discarded, Answer::Now("001.mcap is in the trash".to_owned()));
    assert!(owner.recording.is_some() && owner.trash.contains("001.mcap"));
    assert_eq!(owner.session.file().episodes[0].label, Some(Label::Success));
    assert_eq!(owner.request(SessionRequest::Discard { episode: first() }), Err(Refusal::Unknown));
    let current = owner.recording.clone();
    assert_eq!(owner.request(SessionRequest::Discard { episode: current }), Ok(Answer::AtEnd));
    owner.close(Grade::Good);
    owner.request(SessionRequest::Undo).unwrap();
    owner.check();
}

#[test]
fn the_summary_lists_what_is_kept() {
    let mut owner = Owner::new(Plan { goal: Some(3), ..plan() });
    owner.record();
    owner.record();
    let label = SessionRequest::Label { episode: None, label: Label::Failure, reason: "a | b\u{1b}[2J".to_owned() };
    owner.request(label).unwrap();
    owner.record();
    owner.request(SessionRequest::Discard { episode: None }).unwrap();
    insta::assert_snapshot!(markdown(owner.session.file()));
}

#[derive(Debug, Clone)]
enum Step {
    Request(SessionRequest),
    Close(Grade),
    Wait(u64),
    Stick(bool),
}

fn step() -> impl Strategy<Value = Step> {
    let text = String::new;
    prop_oneof![
        prop::sample::select(vec![
            SessionRequest::Toggle,
            SessionRequest::Start,
            SessionRequest::Stop,
            SessionRequest::Next,
            SessionRequest::Redo,
            SessionRequest::Discard { episode: None },
            SessionRequest::Undo,
            SessionRequest::Mark { text: text() },
            SessionRequest::Note { episode: None, text: text() },
            SessionRequest::EndSession,
        ])
        .prop_map(Step::Request),
        prop::sample::select(vec![Grade::Good, Grade::Bad]).prop_map(Step::Close),
        (0..4000_u64).prop_map(Step::Wait),
        any::<bool>().prop_map(Step::Stick),
    ]
}

proptest! {
    #[test]
    fn any_requests_keep_the_invariants(
        steps in prop::collection::vec(step(), 1..80),
        countdown in prop::option::of(0..3_u64),
        reset in prop::option::of(0..3_u64),
    ) {
        let span = |seconds: Option<u64>| seconds.map(Duration::from_secs);
        let mut owner = Owner::new(Plan { countdown: span(countdown), reset_time: span(reset), ..plan() });
        for step in steps {
            match step {
                Step::Request(request) => {
                    let before = owner.session.file().clone();
                    if owner.request(request).is_err() {
                        prop_assert_eq!(&before, owner.session.file(), "a refused request changed something");
                    }
                }
                Step::Close(grade) => owner.close(grade),
                Step::Wait(ms) => owner.wait(Duration::from_millis(ms)),
                Step::Stick(stuck) => owner.stuck = stuck,
            }
            owner.check();
        }
    }
}
