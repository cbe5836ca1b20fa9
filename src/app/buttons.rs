//! Buttons: foot pedals, remotes and buttons of a gripper, which request something of the session.
//!
//! Their inputs are read by threads of [`rapid_devices::inputs`] and by the streams of devices; a task makes requests of what they
//! report. A button moves nothing: the only order that it gives is to disarm.
//!
//! Invariant: a request carries the moment of the press, whenever it is decided that it was one.
//! Invariant: a button that is lost is a line of the log and nothing else; it is read again when it returns.

mod press;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU8, Ordering};

use rapid_core::permission::Permission;
use rapid_core::time::Stamp;
use rapid_devices::inputs::tap::Tap;
use rapid_devices::inputs::{InputGroup, Readers, Report};
use rapid_registry::{ButtonAction, ButtonSpec, Registry};
use rapid_status::session::{Label, Phase, SessionRequest};
use rapid_status::{Board, EventKind, Level};
use tokio::sync::{mpsc, oneshot};

use super::conductor::reached;
use super::requests::Request;
use press::{Gesture, Presses, Rules};

/// Reads the buttons until it is dropped.
#[derive(Debug, Default)]
pub(super) struct Buttons {
    readers: Option<Readers>,
    is_ending: Arc<AtomicBool>,
}

impl Buttons {
    /// Reads the buttons of `registry` from now on, and sends what is pressed to the conductor. A button for which the
    /// system has no thread is reported, and the run continues without it.
    pub(super) fn begin(
        registry: &Registry,
        permission: &Arc<Permission>,
        board: &Arc<Board>,
        conductor: &mpsc::UnboundedSender<Request>,
    ) -> Self {
        let mut buttons = Self::default();
        if registry.buttons.is_empty() {
            return buttons;
        }
        let (changes, reported) = mpsc::unbounded_channel();
        let read = Readers::new(false).and_then(|mut readers| {
            for (place, own) in InputGroup::of_all(registry.buttons.iter().map(|button| &button.input)) {
                let names: Vec<&str> =
                    own.iter().filter_map(|at| Some(registry.buttons.get(*at)?.name.as_str())).collect();
                let thread = format!("button-{}", names.first().unwrap_or(&""));
                let sender = Sender {
                    names: names.join(", "),
                    levels: own.iter().map(|at| (*at, AtomicU8::new(UNKNOWN))).collect(),
                    is_lost: AtomicBool::new(false),
                    changes: changes.clone(),
                    is_ending: Arc::clone(&buttons.is_ending),
                };
                readers.read(&thread, place, Arc::new(sender))?;
            }
            Ok(readers)
        });
        match read {
            Ok(readers) => buttons.readers = Some(readers),
            Err(error) => tracing::warn!(%error, "buttons are not read"),
        }
        let desk = Desk {
            buttons: registry.buttons.iter().map(|spec| (spec.clone(), Presses::new(rules(spec)))).collect(),
            permission: Arc::clone(permission),
            board: Arc::clone(board),
            conductor: conductor.clone(),
        };
        tokio::spawn(desk.work(reported));
        buttons
    }

    /// The buttons that are numbers in the samples of a device.
    pub(super) fn taps(&self) -> &[Tap] {
        self.readers.as_ref().map(Readers::taps).unwrap_or_default()
    }

    /// The run ends: nothing more follows from a button, and none is missed.
    pub(super) fn end(&self) {
        self.is_ending.store(true, Ordering::Relaxed);
    }
}

fn rules(spec: &ButtonSpec) -> Rules {
    let actions = [spec.press, spec.hold, spec.double].into_iter().flatten();
    Rules {
        hold_after: spec.hold.map(|_| spec.hold_after),
        has_double: spec.double.is_some(),
        counts_once: actions.filter_map(request).any(|request| request.counts_once()),
    }
}

/// What an action requests of the session; `None` for an order.
fn request(action: ButtonAction) -> Option<SessionRequest> {
    let label = |label| SessionRequest::Label { episode: None, label, reason: String::new() };
    Some(match action {
        ButtonAction::Toggle => SessionRequest::Toggle,
        ButtonAction::Start => SessionRequest::Start,
        ButtonAction::Stop => SessionRequest::Stop,
        ButtonAction::Next => SessionRequest::Next,
        ButtonAction::Redo => SessionRequest::Redo,
        ButtonAction::Discard => SessionRequest::Discard { episode: None },
        ButtonAction::Undo => SessionRequest::Undo,
        ButtonAction::Mark => SessionRequest::Mark { text: String::new() },
        ButtonAction::Success => label(Label::Success),
        ButtonAction::Failure => label(Label::Failure),
        ButtonAction::Disarm => return None,
    })
}

/// What a press asks for, for people.
const fn words(action: ButtonAction, phase: Phase) -> &'static str {
    match action {
        ButtonAction::Toggle | ButtonAction::Stop if matches!(phase, Phase::Recording) => "end episode",
        ButtonAction::Toggle | ButtonAction::Start => "begin episode",
        ButtonAction::Stop => "begin no further episode",
        ButtonAction::Next => "next episode",
        ButtonAction::Redo => "discard episode and record it again",
        ButtonAction::Discard => "discard episode",
        ButtonAction::Undo => "take back the discarded episode",
        ButtonAction::Mark => "mark this moment",
        ButtonAction::Success => "label success",
        ButtonAction::Failure => "label failure",
        ButtonAction::Disarm => "disarm",
    }
}

const UNKNOWN: u8 = 0;
const RELEASED: u8 = 1;
const PRESSED: u8 = 2;

/// What a place reports. Only changes are passed on: it is called for every sample.
#[derive(Debug)]
struct Sender {
    names: String,
    /// Buttons of the registry, with their levels.
    levels: Box<[(usize, AtomicU8)]>,
    is_lost: AtomicBool,
    changes: mpsc::UnboundedSender<Change>,
    /// See [`Buttons::end`].
    is_ending: Arc<AtomicBool>,
}

#[derive(Debug)]
enum Change {
    /// The level of a button of the registry.
    Level(usize, bool, Stamp),
    /// The level of a button is unknown.
    Unknown(usize, Stamp),
    /// For the log.
    Note(Level, String),
}

impl Sender {
    fn send(&self, change: Change) {
        if !self.is_ending.load(Ordering::Relaxed) {
            // The receiver is gone only when the run ends.
            let _ = self.changes.send(change);
        }
    }
}

impl Report for Sender {
    fn level(&self, which: usize, is_on: bool) {
        let Some((button, level)) = self.levels.get(which) else { return };
        let code = if is_on { PRESSED } else { RELEASED };
        if level.swap(code, Ordering::Relaxed) == code {
            return;
        }
        if self.is_lost.swap(false, Ordering::Relaxed) {
            self.send(Change::Note(Level::Info, format!("button {} is back", self.names)));
        }
        self.send(Change::Level(*button, is_on, Stamp::now()));
    }

    fn lost(&self, why: &str) {
        if self.is_lost.swap(true, Ordering::Relaxed) {
            return;
        }
        for (button, level) in &self.levels {
            level.store(UNKNOWN, Ordering::Relaxed);
            self.send(Change::Unknown(*button, Stamp::now()));
        }
        let text = format!("button {} is lost: {why}; it is read again when it returns", self.names);
        self.send(Change::Note(Level::Warn, text));
    }
}

/// The task that makes requests of what the buttons report.
struct Desk {
    buttons: Vec<(ButtonSpec, Presses)>,
    permission: Arc<Permission>,
    board: Arc<Board>,
    conductor: mpsc::UnboundedSender<Request>,
}

impl Desk {
    /// Until no button is read any more.
    async fn work(mut self, mut changes: mpsc::UnboundedReceiver<Change>) {
        loop {
            let due = self.buttons.iter().filter_map(|(_, presses)| presses.due()).min();
            tokio::select! {
                // A release that has been reported is not taken for a hold.
                biased;
                change = changes.recv() => match change {
                    Some(Change::Level(button, is_on, at)) => self.update(button, |presses| presses.level(is_on, at)),
                    Some(Change::Unknown(button, at)) => self.update(button, |presses| presses.lose(at)),
                    Some(Change::Note(level, text)) => self.board.announce(EventKind::Log { level, text }),
                    None => return,
                },
                () = reached(due) => {
                    let now = Stamp::now();
                    for button in 0..self.buttons.len() {
                        self.update(button, |presses| presses.advance(now));
                    }
                }
            }
        }
    }

    fn update(&mut self, button: usize, change: impl FnOnce(&mut Presses) -> Vec<(Gesture, Stamp)>) {
        let done = self.buttons.get_mut(button).map(|(_, presses)| change(presses)).unwrap_or_default();
        let Some((spec, _)) = self.buttons.get(button) else { return };
        for (gesture, at) in done {
            let action = match gesture {
                Gesture::Press => spec.press,
                Gesture::Hold => spec.hold,
                Gesture::Double => spec.double,
            };
            if let Some(action) = action {
                self.act(&spec.name, action, at);
            }
        }
    }

    fn act(&self, name: &str, action: ButtonAction, at: Stamp) {
        let Some(request) = request(action) else {
            self.permission.disarm(Stamp::now());
            return announce(&self.board, Level::Info, name, words(action, Phase::Idle));
        };
        let phase = self.board.snapshot().session.map(|session| session.phase).unwrap_or_default();
        announce(&self.board, Level::Info, name, words(action, phase));
        let (reply, answer) = oneshot::channel();
        // The receiver is gone only when the run ends; so is then the other end of the answer.
        let _ = self.conductor.send(Request::Session(request, at, Some(reply)));
        let (board, name) = (Arc::clone(&self.board), name.to_owned());
        tokio::spawn(async move {
            match answer.await {
                Ok(Ok(text)) => announce(&board, Level::Info, &name, &text),
                Ok(Err(why)) => announce(&board, Level::Warn, &name, &format!("refused: {why}")),
                // The run ends.
                Err(_) => {}
            }
        });
    }
}

fn announce(board: &Board, level: Level, name: &str, text: &str) {
    board.announce(EventKind::Log { level, text: format!("{name}: {text}") });
}
