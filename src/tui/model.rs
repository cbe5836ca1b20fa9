//! The model: what the screen remembers from one moment to the next.
//!
//! Snapshots and keys come in as [`Msg`], what the rest of the program is to do goes out as
//! [`Effect`]; the views only read.
//!
//! Invariant: pure: no clock, no terminal, no channel; time is what the snapshots say.

mod arming;
mod dropping;

use std::time::Duration;

use crossterm::event::{KeyCode, KeyEvent, KeyEventKind, KeyModifiers};

use self::dropping::Asked;
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

/// Something that happened.
#[derive(Debug)]
pub enum Msg {
    /// A newer snapshot.
    Snapshot(Box<Snapshot>),
    /// A key.
    Key(KeyEvent),
    /// A command could not be handed over because the program is busy.
    Refused,
    /// The actuator is not armed, and why.
    Void(Void),
}

/// What is to be done about it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Effect {
    /// Nothing beyond showing the model.
    None,
    /// Hand this over.
    Send(Command),
    /// Order this of the actuator.
    Order(Order),
    /// Disarm the actuator, then end the program.
    Leave,
}

/// Has the user asked to quit?
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Quit {
    /// No.
    #[default]
    No,
    /// Yes, while an episode is being recorded: the next time counts.
    Asked,
    /// Yes; the program is ending.
    Ending,
}

/// Measured figures of one device, refreshed a few times a second so that they can be read.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Reading {
    /// Samples a second.
    pub hz: f64,
    /// Age of the newest sample.
    pub age: Option<Duration>,
}

/// Figures of the whole, refreshed likewise.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Totals {
    /// Publications of the mask a second.
    pub publications: f64,
    /// Bytes a second into the episode.
    pub recorded: f64,
}

/// See the module's comment.
#[derive(Debug)]
pub struct Model {
    latest: Snapshot,
    frozen: Option<Box<Snapshot>>,
    rates: Rates,
    readings: [Reading; MAX_MODALITIES],
    totals: Totals,
    edges: [Option<Stamp>; MAX_MODALITIES],
    /// When a device was pulled out, as far as this screen has seen it.
    pulled: [Option<Stamp>; MAX_MODALITIES],
    selected: usize,
    scroll: usize,
    help: bool,
    quit: Quit,
    /// When the user asked to arm the actuator: the next key counts.
    arming: Option<Stamp>,
    /// The user has asked to drop the last episode: the next key counts.
    dropping: Option<Asked>,
    notice: Option<(String, Stamp)>,
}

impl Model {
    /// A screen that begins with this snapshot.
    #[must_use]
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
            pulled: [None; MAX_MODALITIES],
            selected: 0,
            scroll: 0,
            help: false,
            quit: Quit::No,
            arming: None,
            dropping: None,
            notice: None,
        };
        model.read();
        model
    }

    /// Takes in what happened.
    pub fn update(&mut self, msg: Msg) -> Effect {
        match msg {
            Msg::Snapshot(snapshot) => {
                self.take(*snapshot);
                Effect::None
            }
            Msg::Key(key) if key.kind == KeyEventKind::Release => Effect::None,
            Msg::Key(key) => self.key(key),
            Msg::Refused => {
                self.say("busy: not taken, try again");
                Effect::None
            }
            Msg::Void(why) => {
                self.say(&format!("not armed: {why}"));
                Effect::None
            }
        }
    }

    fn take(&mut self, snapshot: Snapshot) {
        for (bit, edge) in self.edges.iter_mut().enumerate() {
            if (snapshot.mask.0 ^ self.latest.mask.0) >> bit & 1 == 1 {
                *edge = Some(snapshot.taken);
            }
        }
        for device in &snapshot.devices {
            let before = self.latest.devices.iter().find(|before| before.id == device.id);
            let was_attached = before.is_some_and(|before| before.state != SlotState::Absent);
            if let Some(pulled) = self.pulled.get_mut(device.id.index())
                && device.state == SlotState::Absent
                && was_attached
            {
                *pulled = Some(snapshot.taken);
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
        if self.notice.as_ref().is_some_and(|(_, said)| self.latest.taken.since(*said) > NOTICE_SHOWN) {
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
        // Only the key after the first asks for it.
        let arming = self.arming.take();
        match key.code {
            KeyCode::Char('c') if control => {
                // Nothing moves while the question is answered.
                let effect = self.ask_to_quit();
                return if effect == Effect::None { Effect::Order(Order::Disarm) } else { effect };
            }
            KeyCode::Char('y') if control && key.kind == KeyEventKind::Press => return self.arm(arming),
            // What stops motion works everywhere, whatever else is held down.
            KeyCode::Char('d' | 'D') | KeyCode::Esc => return self.disarm(key.code == KeyCode::Esc),
            KeyCode::Char(_) if control || key.modifiers.contains(KeyModifiers::ALT) => return Effect::None,
            KeyCode::Char('q') => return self.ask_to_quit(),
            _ => {}
        }
        // Any other key says that the user has thought again.
        if self.quit == Quit::Asked {
            self.quit = Quit::No;
        }
        let dropping = self.dropping.take();
        if self.help {
            // A key that closes the help does nothing else.
            self.help = false;
            return Effect::None;
        }
        match key.code {
            // A key held down must not start and stop episodes at the keyboard's repeat rate.
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
        let text = if self.latest.recording.is_some() { "finishing the episode" } else { "starting an episode" };
        self.say(text);
        Effect::Send(Command::ToggleRecording)
    }

    fn restart(&mut self) -> Effect {
        let Some(device) = self.shown().devices.get(self.selected) else { return Effect::None };
        let id = device.id;
        // What is shown may be frozen: what counts is the state now.
        let Some(now) = self.latest.devices.iter().find(|device| device.id == id) else { return Effect::None };
        if now.state == SlotState::Failed {
            let text = format!("restarting {}", now.name);
            self.say(&text);
            return Effect::Send(Command::Restart(id));
        }
        let text = format!("{} has not failed: nothing to restart", now.name);
        self.say(&text);
        Effect::None
    }

    fn toggle_pause(&mut self) {
        if self.frozen.take().is_some() {
            self.read();
        } else {
            self.frozen = Some(Box::new(self.latest.clone()));
        }
    }

    fn say(&mut self, text: &str) {
        self.notice = Some((text.to_owned(), self.latest.taken));
    }

    fn keep_in_bounds(&mut self) {
        let (devices, lines) = (self.shown().devices.len(), self.shown().log.len());
        self.selected = self.selected.min(devices.saturating_sub(1));
        self.scroll = self.scroll.min(lines.saturating_sub(1));
    }

    /// The snapshot to show: the newest, or the one at which the view was paused.
    #[must_use]
    pub fn shown(&self) -> &Snapshot {
        self.frozen.as_deref().unwrap_or(&self.latest)
    }

    /// Is the view paused?
    #[must_use]
    pub fn is_paused(&self) -> bool {
        self.frozen.is_some()
    }

    /// Is an episode being recorded now, paused or not?
    #[must_use]
    pub fn is_recording(&self) -> bool {
        self.latest.recording.is_some()
    }

    /// Figures of a device.
    #[must_use]
    pub fn reading(&self, id: ModalityId) -> Reading {
        self.readings.get(id.index()).copied().unwrap_or_default()
    }

    /// Figures of the whole.
    #[must_use]
    pub fn totals(&self) -> Totals {
        self.totals
    }

    /// Has the bit of `id` just changed?
    #[must_use]
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
    #[must_use]
    pub fn unplugged_for(&self, device: &DeviceStatus) -> Option<Duration> {
        let pulled = self.pulled.get(device.id.index()).copied().flatten()?;
        let shown = self.shown().taken;
        (device.state == SlotState::Absent && pulled <= shown).then(|| shown.since(pulled))
    }

    /// Row of the selected device.
    #[must_use]
    pub fn selected(&self) -> usize {
        self.selected
    }

    /// The selected device.
    #[must_use]
    pub fn selected_device(&self) -> Option<&DeviceStatus> {
        self.shown().devices.get(self.selected)
    }

    /// Lines of the log below what is shown.
    #[must_use]
    pub fn scroll(&self) -> usize {
        self.scroll
    }

    /// Is the help open?
    #[must_use]
    pub fn is_help_open(&self) -> bool {
        self.help
    }

    /// Has the user asked to quit?
    #[must_use]
    pub fn quit(&self) -> Quit {
        self.quit
    }

    /// The answer to the last key, while it is fresh.
    #[must_use]
    pub fn notice(&self) -> Option<&str> {
        self.notice.as_ref().map(|(text, _)| text.as_str())
    }
}

/// Lines by which a page key scrolls the log.
const SCROLL_STEP: usize = 5;

/// How many lines were added to the log. The oldest are dropped from it, so it is the last line known
/// that tells; when even that is gone, all are new.
fn lines_since(before: &Snapshot, after: &Snapshot) -> usize {
    let Some(known) = before.log.last() else { return after.log.len() };
    after.log.iter().rev().take_while(|line| *line != known).count()
}

#[cfg(test)]
mod tests;
