//! The model: the state of the screen between frames.
//!
//! Snapshots and keys come in as [`Msg`], requests to the rest of the program go out as [`Effect`]; the
//! views only read.
//!
//! Invariant: only the file named in the question is deleted, and only while that is still offered. Keys that arrive
//! immediately, such as text pasted into a terminal that does not mark it, confirm nothing.
//! Invariant: pure: no clock, no terminal, no channel; time comes from the snapshots.

use std::path::PathBuf;
use std::time::Duration;

use crossterm::event::{KeyCode, KeyEvent, KeyEventKind, KeyModifiers};

use super::theme::Edge;
use crate::action::Order;
use crate::modality::{MAX_MODALITIES, ModalityId};
use crate::permission::Void;
use crate::status::rates::Rates;
use crate::status::{Command, DeviceStatus, SlotState, Snapshot};
use crate::time::Stamp;

/// How long a changed bit is highlighted.
const EDGE_SHOWN: Duration = Duration::from_secs(1);
/// How long the answer to a key stays in the footer.
const NOTICE_SHOWN: Duration = Duration::from_secs(4);
/// A press of the space bar so soon after the last one is the repeat of a held key, which few terminals distinguish, or
/// a hand that trembles.
const PRESS_AGAIN: Duration = Duration::from_millis(400);

/// Something that happened.
#[derive(Debug)]
pub enum Msg {
    /// A newer snapshot.
    Snapshot(Box<Snapshot>),
    /// A key.
    Key(KeyEvent),
    /// A command could not be sent because the program is busy.
    Refused,
    /// The actuator was not armed, and why.
    Void(Void),
}

/// A request of the model to the rest of the program.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Effect {
    /// Nothing beyond showing the model.
    None,
    /// Send this command.
    Send(Command),
    /// Give this order to the actuator.
    Order(Order),
    /// Disarm the actuator, then end the program.
    Leave,
}

/// Whether the user asked to quit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Quit {
    /// No.
    #[default]
    No,
    /// Yes, while an episode is being recorded: the next request counts.
    Asked,
    /// Yes; the program is ending.
    Ending,
}

/// Measured figures of one device, refreshed a few times a second so that they can be read.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Reading {
    /// Samples per second.
    pub hz: f64,
    /// Age of the newest sample.
    pub age: Option<Duration>,
}

/// Figures of the whole rig, refreshed at the same rate.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Totals {
    /// Publications of the mask per second.
    pub publications: f64,
    /// Bytes per second written to the episode.
    pub recorded: f64,
}

/// The state of the screen.
#[derive(Debug)]
pub struct Model {
    latest: Snapshot,
    frozen: Option<Box<Snapshot>>,
    rates: Rates,
    readings: [Reading; MAX_MODALITIES],
    /// Figures of the whole rig.
    pub(super) totals: Totals,
    edges: [Option<Stamp>; MAX_MODALITIES],
    /// When a device was unplugged, if the screen was open then.
    unplugged: [Option<Stamp>; MAX_MODALITIES],
    /// Row of the selected device.
    pub(super) selected: usize,
    /// Lines of the log below what is shown.
    pub(super) scroll: usize,
    /// The help is open.
    pub(super) help: bool,
    /// Whether the user has asked to quit.
    pub(super) quit: Quit,
    /// When the user asked to arm the actuator: the next key confirms or cancels.
    arming: Option<Stamp>,
    /// The user asked to drop the last episode: the next key confirms or cancels.
    dropping: Option<DropQuestion>,
    /// When the space bar was last pressed.
    pressed: Option<Stamp>,
    notice: Option<Notice>,
}

/// The answer to a key.
#[derive(Debug)]
struct Notice {
    text: String,
    shown: Stamp,
    /// It announces that a recording begins (`true`) or ends, and is obsolete once that is so.
    awaits: Option<bool>,
}

impl Notice {
    fn is_over(&self, now: &Snapshot) -> bool {
        let has_failed = self.awaits == Some(true) && now.not_started.is_some();
        let has_happened = self.awaits.is_some_and(|recording| now.recording.is_some() == recording);
        has_failed || has_happened || now.taken.since(self.shown) > NOTICE_SHOWN
    }
}

impl Model {
    /// A screen that starts with this snapshot.
    pub fn new(snapshot: Snapshot) -> Self {
        let mut rates = Rates::default();
        rates.update(&snapshot);
        let mut model = Self {
            latest: snapshot,
            frozen: None,
            rates,
            readings: [Reading::default(); MAX_MODALITIES],
            totals: Totals::default(),
            edges: [None; MAX_MODALITIES],
            unplugged: [None; MAX_MODALITIES],
            selected: 0,
            scroll: 0,
            help: false,
            quit: Quit::No,
            arming: None,
            dropping: None,
            pressed: None,
            notice: None,
        };
        model.read();
        model
    }

    /// Applies a message.
    pub fn update(&mut self, msg: Msg) -> Effect {
        match msg {
            Msg::Snapshot(snapshot) => self.advance(*snapshot),
            Msg::Key(key) if key.kind == KeyEventKind::Release => {}
            Msg::Key(key) => return self.key(key),
            Msg::Refused => self.notify("busy: request dropped, try again"),
            Msg::Void(why) => self.notify(&format!("not armed: {why}")),
        }
        Effect::None
    }

    fn advance(&mut self, snapshot: Snapshot) {
        for (bit, edge) in self.edges.iter_mut().enumerate() {
            if (snapshot.mask.0 ^ self.latest.mask.0) >> bit & 1 == 1 {
                *edge = Some(snapshot.taken);
            }
        }
        for device in &snapshot.devices {
            let before = self.latest.devices.iter().find(|before| before.id == device.id);
            let was_attached = before.is_some_and(|before| before.state != SlotState::Absent);
            if let Some(unplugged) = self.unplugged.get_mut(device.id.index())
                && device.state == SlotState::Absent
                && was_attached
            {
                *unplugged = Some(snapshot.taken);
            }
        }
        if self.scroll > 0 && self.frozen.is_none() {
            self.scroll += lines_since(&self.latest, &snapshot);
        }
        let refresh = self.rates.update(&snapshot);
        self.latest = snapshot;
        if refresh && self.frozen.is_none() {
            self.read();
        }
        if self.quit == Quit::Asked && self.latest.recording.is_none() {
            self.quit = Quit::No;
        }
        if self.notice.as_ref().is_some_and(|notice| notice.is_over(&self.latest)) {
            self.notice = None;
        }
        self.keep_in_bounds();
    }

    fn read(&mut self) {
        self.totals = Totals { publications: self.rates.publications(), recorded: self.rates.recorded() };
        for device in &self.latest.devices {
            if let Some(reading) = self.readings.get_mut(device.id.index()) {
                let age = device.newest.map(|newest| self.latest.taken.since(newest));
                *reading = Reading { hz: self.rates.samples(device.id), age };
            }
        }
    }

    fn key(&mut self, key: KeyEvent) -> Effect {
        let control = key.modifiers.contains(KeyModifiers::CONTROL);
        // Only the next key confirms.
        let arming = self.arming.take();
        match key.code {
            KeyCode::Char('c') if control => {
                // Nothing moves while the user is being asked.
                let effect = self.ask_to_quit();
                return if effect == Effect::None { Effect::Order(Order::Disarm) } else { effect };
            }
            KeyCode::Char('y') if control && key.kind == KeyEventKind::Press => return self.arm(arming),
            // The keys that stop motion work everywhere, with any modifier.
            KeyCode::Char('d' | 'D') | KeyCode::Esc => return self.disarm(key.code == KeyCode::Esc),
            KeyCode::Char(_) if control || key.modifiers.contains(KeyModifiers::ALT) => return Effect::None,
            KeyCode::Char('q') => return self.ask_to_quit(),
            _ => {}
        }
        // Any other key cancels.
        if self.quit == Quit::Asked {
            self.quit = Quit::No;
        }
        let dropping = self.dropping.take();
        if self.help {
            // The key that closes the help has no other effect.
            self.help = false;
            return Effect::None;
        }
        match key.code {
            // A held key must not start and stop episodes at the keyboard's repeat rate.
            KeyCode::Char(' ') if key.kind == KeyEventKind::Press => return self.toggle_recording(),
            KeyCode::Char('r') => return self.restart(),
            KeyCode::Char('a') if key.kind == KeyEventKind::Press => self.ask_to_arm(),
            KeyCode::Char('x') if key.kind == KeyEventKind::Press => self.ask_to_drop(),
            KeyCode::Char('y') if key.kind == KeyEventKind::Press => return self.drop_episode(dropping),
            KeyCode::Char('p') => self.toggle_pause(),
            KeyCode::Char('?') | KeyCode::F(1) => self.help = true,
            KeyCode::Up | KeyCode::Char('k') => self.selected = self.selected.saturating_sub(1),
            KeyCode::Down | KeyCode::Char('j') => self.selected += 1,
            KeyCode::Home => self.selected = 0,
            KeyCode::End => self.selected = usize::MAX,
            KeyCode::PageUp => self.scroll += SCROLL_STEP,
            KeyCode::PageDown => self.scroll = self.scroll.saturating_sub(SCROLL_STEP),
            _ => {}
        }
        self.keep_in_bounds();
        Effect::None
    }

    fn ask_to_quit(&mut self) -> Effect {
        if self.quit == Quit::No && self.latest.recording.is_some() {
            self.quit = Quit::Asked;
            return Effect::None;
        }
        self.quit = Quit::Ending;
        Effect::Leave
    }

    fn toggle_recording(&mut self) -> Effect {
        let now = self.latest.taken;
        // Each press counts from itself: while a key is held, nothing happens.
        if self.pressed.replace(now).is_some_and(|before| now.since(before) < PRESS_AGAIN) {
            return Effect::None;
        }
        let begins = self.latest.recording.is_none();
        self.notify(if begins { "starting an episode" } else { "finishing the episode" });
        if let Some(notice) = &mut self.notice {
            notice.awaits = Some(begins);
        }
        Effect::Send(Command::ToggleRecording)
    }

    fn restart(&mut self) -> Effect {
        let Some(device) = self.shown().devices.get(self.selected) else { return Effect::None };
        let id = device.id;
        // The view may be paused: the current state counts.
        let Some(now) = self.latest.devices.iter().find(|device| device.id == id) else { return Effect::None };
        if now.state == SlotState::Failed {
            let text = format!("restarting {}", now.name);
            self.notify(&text);
            return Effect::Send(Command::Restart(id));
        }
        let text = format!("{} has not failed: nothing to restart", now.name);
        self.notify(&text);
        Effect::None
    }

    fn toggle_pause(&mut self) {
        if self.frozen.take().is_some() {
            self.read();
        } else {
            self.frozen = Some(Box::new(self.latest.clone()));
        }
    }

    fn notify(&mut self, text: &str) {
        self.notice = Some(Notice { text: text.to_owned(), shown: self.latest.taken, awaits: None });
    }

    fn keep_in_bounds(&mut self) {
        let (devices, lines) = (self.shown().devices.len(), self.shown().log.len());
        self.selected = self.selected.min(devices.saturating_sub(1));
        self.scroll = self.scroll.min(lines.saturating_sub(1));
    }

    /// The snapshot to show: the newest, or that of the moment the view was paused.
    pub fn shown(&self) -> &Snapshot {
        self.frozen.as_deref().unwrap_or(&self.latest)
    }

    /// The newest snapshot, paused or not.
    pub const fn latest(&self) -> &Snapshot {
        &self.latest
    }

    /// Is the view paused?
    pub fn is_paused(&self) -> bool {
        self.frozen.is_some()
    }

    /// Is an episode being recorded now, paused or not?
    pub fn is_recording(&self) -> bool {
        self.latest.recording.is_some()
    }

    /// Figures of a device.
    pub fn reading(&self, id: ModalityId) -> Reading {
        self.readings.get(id.index()).copied().unwrap_or_default()
    }

    /// Has the bit of `id` just changed?
    pub fn edge(&self, id: ModalityId) -> Edge {
        let changed = self.edges.get(id.index()).copied().flatten();
        match changed {
            Some(changed) if changed <= self.shown().taken && self.shown().taken.since(changed) < EDGE_SHOWN => {
                Edge::Recent
            }
            _ => Edge::None,
        }
    }

    /// How long a device has been unplugged; `None` if it is not, or was never seen plugged in.
    pub fn unplugged_for(&self, device: &DeviceStatus) -> Option<Duration> {
        let unplugged = self.unplugged.get(device.id.index()).copied().flatten()?;
        let shown = self.shown().taken;
        (device.state == SlotState::Absent && unplugged <= shown).then(|| shown.since(unplugged))
    }

    /// The selected device.
    pub fn selected_device(&self) -> Option<&DeviceStatus> {
        self.shown().devices.get(self.selected)
    }

    /// The answer to the last key, while it is fresh.
    pub fn notice(&self) -> Option<&str> {
        self.notice.as_ref().map(|notice| notice.text.as_str())
    }
}

/// Lines by which a page key scrolls the log.
const SCROLL_STEP: usize = 5;

/// How many lines were added to the log. The oldest are dropped, so the count starts at the last known line;
/// when that is gone too, all are new.
fn lines_since(before: &Snapshot, after: &Snapshot) -> usize {
    let Some(known) = before.log.last() else { return after.log.len() };
    after.log.iter().rev().take_while(|line| *line != known).count()
}

/// How long after the question an arm may be confirmed.
const CONFIRM_WITHIN: Duration = Duration::from_secs(2);

impl Model {
    /// Asks for confirmation: the actuator is about to move.
    fn ask_to_arm(&mut self) {
        self.arming = Some(self.latest.taken);
        self.notify("ctrl-y within 2 s arms the actuator, any other key cancels");
    }

    /// The confirming key occurs neither in pasted text nor in the repeats of a held key.
    fn arm(&mut self, asked: Option<Stamp>) -> Effect {
        let in_time = asked.is_some_and(|asked| self.latest.taken.since(asked) <= CONFIRM_WITHIN);
        self.notify(if in_time { "arming the actuator" } else { "not armed: a first, then ctrl-y within 2 s" });
        if in_time { Effect::Order(Order::Arm) } else { Effect::None }
    }

    /// Disarms, and closes any open dialog, as Esc usually does.
    fn disarm(&mut self, is_escape: bool) -> Effect {
        (self.help, self.dropping) = (false, None);
        if self.quit == Quit::Asked {
            self.quit = Quit::No;
        }
        if is_escape {
            self.scroll = 0;
        } else {
            self.notify("disarming the actuator");
        }
        Effect::Order(Order::Disarm)
    }
}

/// Shortest time between question and confirmation: a person does not read faster, and pasted text arrives immediately.
const SHORTEST: Duration = Duration::from_millis(150);

/// The question shown to the user.
#[derive(Debug)]
struct DropQuestion {
    file: PathBuf,
    at: Stamp,
}

impl DropQuestion {
    /// Whether a confirmation at `now` answers this question.
    fn is_answered_at(&self, now: &Snapshot) -> bool {
        let waited = now.taken.since(self.at);
        (SHORTEST..=NOTICE_SHOWN).contains(&waited)
            && now.short_episode.as_ref().is_some_and(|short| short.file == self.file)
    }
}

impl Model {
    fn ask_to_drop(&mut self) {
        let Some(short) = &self.latest.short_episode else {
            return self.notify("nothing to delete: the last episode is not too short");
        };
        let file = short.file.clone();
        let text = format!("y deletes {}, any other key keeps it", name(&file));
        self.dropping = Some(DropQuestion { file, at: self.latest.taken });
        self.notify(&text);
    }

    fn drop_episode(&mut self, asked: Option<DropQuestion>) -> Effect {
        let Some(asked) = asked else { return Effect::None };
        if !asked.is_answered_at(&self.latest) {
            self.notify("nothing deleted");
            return Effect::None;
        }
        let text = format!("deleting {}", name(&asked.file));
        self.notify(&text);
        Effect::Send(Command::DropEpisode(asked.file))
    }
}

fn name(file: &std::path::Path) -> String {
    file.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

#[cfg(test)]
mod tests;
