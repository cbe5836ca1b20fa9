//! Text that is typed: the questions of the screen, and what follows from their answers.
//!
//! Invariant: while a text is typed, letters are text: none of them begins, ends or discards anything.

use crossterm::event::{KeyCode, KeyEvent, KeyModifiers};
use rapid_status::session::{EpisodeEntry, Label, SessionRequest, SessionStatus};
use rapid_status::{Command, UnregisteredDevice};

use super::{Effect, Model, Quit};

/// Devices without an entry, and their names.
#[derive(Debug, Default)]
pub(super) struct Naming {
    /// The rig had no entry when the screen began: names are asked for as devices are plugged in.
    pub(super) is_new_rig: bool,
    /// Devices that were asked about.
    pub(super) asked: Vec<String>,
    /// The device whose name is typed.
    pub(super) unnamed: Option<UnregisteredDevice>,
}

/// Longest text that is typed, in bytes.
const LONGEST_TEXT: usize = 500;

/// What is typed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Question {
    /// A note on the episode.
    Note,
    /// Why the episode is a failure.
    WhyFailed,
    /// The task of the next episodes.
    Task,
    /// Whether the session is to end.
    EndSession,
    /// What lines of the log contain.
    Search,
    /// The name of a device that has no entry.
    Name,
    /// A control of the selected camera, and its value.
    Control,
}

impl Question {
    const fn text(self) -> &'static str {
        match self {
            Self::Note => "note: ",
            Self::WhyFailed => "why it failed (may be empty): ",
            Self::Task => "task: ",
            Self::Control => "control of the camera, such as exposure=120: ",
            Self::Search => "lines of the log with: ",
            Self::Name => "name of the new device (empty: none): ",
            Self::EndSession => "type \"end\": ends the session, deletes its trash: ",
        }
    }
}

/// A question, and the text typed so far.
#[derive(Debug)]
pub(super) struct Prompt {
    question: Question,
    text: String,
    /// The text is a suggestion: what is typed first replaces it.
    is_suggested: bool,
    /// The episode that it is about: another may begin while it is typed.
    episode: Option<String>,
}

impl Prompt {
    /// Whether it narrows the log while it is typed.
    pub(super) const fn is_search(&self) -> bool {
        matches!(self.question, Question::Search)
    }
}

impl Model {
    /// The question and the answer typed so far.
    pub fn prompt(&self) -> Option<(String, &str)> {
        let prompt = self.prompt.as_ref()?;
        let question = match &self.naming.unnamed {
            Some(unit) if prompt.question == Question::Name => {
                format!("name of the {} {} (empty: none): ", unit.node, unit.device)
            }
            _ => match &prompt.episode {
                Some(file) => format!("{file}, {}", prompt.question.text()),
                None => prompt.question.text().to_owned(),
            },
        };
        Some((question, prompt.text.as_str()))
    }

    /// `NAME=VALUE`.
    fn set_control(&mut self, text: &str) -> Effect {
        let parts = text.split_once('=').and_then(|(name, value)| Some((name.trim(), value.trim().parse().ok()?)));
        match (parts, self.selected_device().map(|device| device.id)) {
            (Some((name, value)), Some(device)) if !name.is_empty() => {
                self.notify("setting it; the log has the result");
                Effect::Send(Command::Control { device, name: name.to_owned(), value })
            }
            _ => {
                self.notify("not set: write NAME=VALUE, with a whole number");
                Effect::None
            }
        }
    }

    /// Devices without an entry that were not asked about.
    fn unasked(&self) -> impl Iterator<Item = &UnregisteredDevice> {
        self.latest.unregistered.iter().filter(|unit| !self.naming.asked.contains(&unit.device))
    }

    /// In a rig without entries, asks for the name of each device that is plugged in, one after the other.
    pub(super) fn ask_for_names(&mut self) {
        let is_free = self.prompt.is_none() && self.overlay.is_none() && self.quit == Quit::No;
        if self.naming.is_new_rig && is_free && self.unasked().next().is_some() {
            self.ask_for_name();
        }
    }

    /// Asks for the name of the next device without an entry; of those that were asked about, the first again.
    pub(super) fn ask_for_name(&mut self) {
        let Some(unit) = self.unasked().next().or_else(|| self.latest.unregistered.first()).cloned() else {
            return self.notify("no device without an entry is plugged in");
        };
        self.naming.asked.push(unit.device.clone());
        self.naming.unnamed = Some(unit);
        self.ask(Question::Name);
    }

    pub(super) fn ask(&mut self, question: Question) {
        let session = self.latest.session.as_ref();
        let is_about = matches!(question, Question::Note | Question::WhyFailed);
        let newest = |session: &SessionStatus| {
            session.episodes.iter().rev().find(|entry| !entry.discarded).map(|entry| entry.file.clone())
        };
        let episode = if is_about { self.marked_episode().or_else(|| newest(session?)) } else { None };
        if is_about && episode.is_none() {
            return self.notify("this session has no episode");
        }
        let noted = |session: &SessionStatus| {
            let is_it = |entry: &&EpisodeEntry| episode.as_ref() == Some(&entry.file);
            session.episodes.iter().rev().find(is_it).map(|entry| entry.note.clone())
        };
        let text = match question {
            Question::Note => session.and_then(noted).unwrap_or_default(),
            Question::Task => session.map(|session| session.task.clone()).unwrap_or_default(),
            Question::Search => self.log.search.clone(),
            Question::Name => self.naming.unnamed.as_ref().and_then(|unit| unit.name.clone()).unwrap_or_default(),
            _ => String::new(),
        };
        let is_suggested = matches!(question, Question::Task | Question::Name) && !text.is_empty();
        self.prompt = Some(Prompt { question, text, is_suggested, episode });
    }

    /// Adds pasted text to the answer, in one line and without other control characters.
    pub(super) fn paste(&mut self, text: &str) {
        let line = text.split_whitespace().collect::<Vec<_>>().join(" ");
        for c in line.chars().filter(|c| !c.is_control()) {
            let Some(prompt) = self.prompt.take() else { return };
            let _only_text = self.type_into(prompt, KeyEvent::new(KeyCode::Char(c), KeyModifiers::NONE));
        }
    }

    pub(super) fn type_into(&mut self, mut prompt: Prompt, key: KeyEvent) -> Effect {
        let is_text = !key.modifiers.intersects(KeyModifiers::CONTROL | KeyModifiers::ALT);
        match key.code {
            KeyCode::Enter => return self.answer(prompt),
            KeyCode::Backspace => {
                prompt.is_suggested = false;
                prompt.text.pop();
            }
            KeyCode::Char('u') if key.modifiers.contains(KeyModifiers::CONTROL) => prompt.text.clear(),
            KeyCode::Char(c) if is_text && prompt.text.len() + c.len_utf8() <= LONGEST_TEXT => {
                if std::mem::take(&mut prompt.is_suggested) {
                    prompt.text.clear();
                }
                prompt.text.push(c);
            }
            _ => {}
        }
        if prompt.question == Question::Search {
            // What matches is seen while it is typed.
            self.log.search.clone_from(&prompt.text);
        }
        self.prompt = Some(prompt);
        Effect::None
    }

    fn answer(&mut self, Prompt { question, text, episode, .. }: Prompt) -> Effect {
        let request = match question {
            Question::Note => SessionRequest::Note { episode, text },
            Question::WhyFailed => SessionRequest::Label { episode, label: Label::Failure, reason: text },
            Question::Task => {
                SessionRequest::Plan { task: Some(text), tags: Vec::new(), goal: None, modules: Vec::new() }
            }
            Question::Search => {
                self.log.search = text;
                return Effect::None;
            }
            Question::Control => return self.set_control(&text),
            Question::Name => {
                let (Some(unit), false) = (self.naming.unnamed.take(), text.trim().is_empty()) else {
                    self.notify("no entry; N asks again");
                    return Effect::None;
                };
                self.notify("writing the entry");
                return Effect::Send(Command::Register { device: unit.device, name: text.trim().to_owned() });
            }
            Question::EndSession if text.trim() == "end" => SessionRequest::EndSession,
            Question::EndSession => {
                self.notify("the session continues");
                return Effect::None;
            }
        };
        Effect::Send(Command::Session(request))
    }
}
