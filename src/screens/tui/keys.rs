//! The keys of the monitor: one table, from which the model, the footer, the help and `docs/monitor.md` derive.
//!
//! Invariant: a key has one meaning, apart from the text of a prompt.

use crossterm::event::{KeyCode, KeyEvent, KeyEventKind, KeyModifiers};
use rapid_status::DeviceState;
use rapid_status::session::Phase;

use super::model::{Model, Page};

/// What a key does.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Act {
    /// Begin an episode, or end the one in progress.
    Toggle,
    /// End the episode and begin the next.
    Next,
    /// Discard the episode, or the last one, and record it again.
    Redo,
    /// End the episode, and begin no other by itself.
    Stop,
    /// Move the episode to the trash.
    Discard,
    /// Take the discarded episode back.
    Undo,
    Mark,
    /// Label the episode as a success.
    Success,
    /// Label the episode as a failure, and ask why.
    Failure,
    /// Ask for a note on the episode.
    Note,
    /// Ask for the task of the next episodes.
    Task,
    /// Ask whether the session is to end.
    EndSession,
    /// Select the device above.
    Up,
    /// Select the device below.
    Down,
    /// Select the first device.
    First,
    /// Select the last device.
    Last,
    /// Ask for the name of a device that has no entry.
    Register,
    /// Restart the selected device.
    Restart,
    /// Unplug the selected simulated device, or plug it in.
    Plug,
    /// List devices in trouble first, or all by their bits.
    Order,
    /// Ring the bell of the terminal, or be silent.
    Bell,
    /// Ask whether to arm the actuator.
    AskToArm,
    /// Arm the actuator, right after the question.
    Arm,
    Disarm,
    /// Disarm the actuator and close whatever is open.
    Escape,
    /// Pause the view.
    Pause,
    /// Show the selected device, or return from it.
    Detail,
    /// Show the log, or return from it.
    Log,
    /// Show the episodes, or return from them.
    Episodes,
    /// Ask what lines of the log are to contain.
    Search,
    /// Show more severe lines only.
    Level,
    /// Show only lines about the selected device, or all.
    OneDevice,
    /// Continue long lines of the log on the next row, or cut them.
    Wrap,
    /// Group repeated lines of the log, or list each.
    Group,
    /// Ask for a control of the selected camera.
    Control,
    /// Show pictures, or not.
    Pictures,
    /// Scroll to older lines of the log.
    Older,
    /// Scroll to newer lines of the log.
    Newer,
    /// Show the link to the page for a phone, or close it.
    Web,
    /// Open or close the help.
    Help,
    Quit,
    /// Disarm the actuator, then end the program.
    Interrupt,
}

impl Act {
    /// Whether it does something about episodes, devices or motion, and not only about the screen.
    pub(super) const fn is_about_the_rig(self) -> bool {
        matches!(
            self,
            Self::Toggle
                | Self::Next
                | Self::Redo
                | Self::Discard
                | Self::Undo
                | Self::Stop
                | Self::Mark
                | Self::Success
                | Self::Failure
                | Self::Note
                | Self::Task
                | Self::EndSession
                | Self::Register
                | Self::Control
                | Self::Restart
                | Self::Plug
                | Self::AskToArm
                | Self::Arm
                | Self::Disarm
                | Self::Quit
                | Self::Interrupt
        )
    }
}

/// When a key counts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum When {
    /// Only when it is pressed: not while it is held.
    Pressed,
    /// Also at each repeat of a held key.
    Repeated,
    /// Likewise, and with any modifier: motion stops.
    Always,
    /// With control, only when it is pressed.
    Control,
    /// With control, also repeated.
    ControlRepeated,
}

/// A row of the table.
#[derive(Debug)]
pub(super) struct Binding {
    /// What it does.
    pub act: Act,
    codes: &'static [KeyCode],
    when: When,
    /// The keys for the help; empty if another row stands for it.
    pub shown: &'static str,
    /// The meaning for the help.
    pub help: &'static str,
    /// The word in the footer, if it applies at the moment.
    footer: fn(&Model) -> Option<&'static str>,
}

const fn row(
    act: Act,
    codes: &'static [KeyCode],
    when: When,
    (shown, help): (&'static str, &'static str),
    footer: fn(&Model) -> Option<&'static str>,
) -> Binding {
    Binding { act, codes, when, shown, help, footer }
}

fn never(_: &Model) -> Option<&'static str> {
    None
}

fn toggles(model: &Model) -> &'static str {
    match (model.is_recording(), phase(model)) {
        (true, _) => "end episode",
        (false, Phase::Countdown { .. } | Phase::Reset { .. }) => "begin now",
        (false, _) => "start episode",
    }
}

fn phase(model: &Model) -> Phase {
    model.latest().session.as_ref().map(|session| session.phase).unwrap_or_default()
}

fn while_recording(model: &Model, word: &'static str) -> Option<&'static str> {
    model.is_recording().then_some(word)
}

fn discards(model: &Model) -> Option<&'static str> {
    let has_episodes = model.latest().session.as_ref().is_some_and(|session| !session.episodes.is_empty());
    (model.is_recording() || has_episodes).then_some("discard")
}

fn restores(model: &Model) -> Option<&'static str> {
    let has_discarded = model.latest().session.as_ref().is_some_and(|session| session.discarded > 0);
    (has_discarded && !model.is_recording()).then_some("undo")
}

fn restarts(model: &Model) -> Option<&'static str> {
    model.selected_device().is_some_and(|device| device.state == DeviceState::Failed).then_some("restart")
}

fn plugs(model: &Model) -> Option<&'static str> {
    let device = model.selected_device().filter(|_| model.latest().simulated)?;
    Some(if device.state == DeviceState::Absent { "plug in" } else { "unplug" })
}

use KeyCode::{Char, Down, End, Esc, F, Home, Left, PageDown, PageUp, Right, Up};
use When::{Always, Control, ControlRepeated, Pressed, Repeated};

/// All keys. The footer shows as many as fit, in this order; the help and the last two always.
pub(super) const TABLE: [Binding; 42] = [
    row(Act::Toggle, &[Char(' ')], Pressed, ("space", "start an episode, end the one in progress"), |m| {
        Some(toggles(m))
    }),
    row(Act::Disarm, &[Char('d'), Char('D')], Always, ("d, esc", "disarm the actuator: motors are off"), never),
    row(Act::Escape, &[Esc], Always, ("", ""), never),
    row(Act::Next, &[Right], Pressed, ("right", "end the episode and begin the next"), |m| while_recording(m, "next")),
    row(Act::Redo, &[Left], Pressed, ("left", "discard the episode and record it again"), |m| {
        while_recording(m, "redo")
    }),
    row(Act::Discard, &[Char('x')], Pressed, ("x", "discard the episode or the last one: trash"), discards),
    row(Act::Undo, &[Char('u')], Pressed, ("u", "take the discarded episode back"), restores),
    row(Act::Stop, &[Char('s')], Pressed, ("s", "end the episode; no other begins by itself"), never),
    row(Act::Mark, &[Char('i')], Pressed, ("i", "mark this moment of the episode"), |m| while_recording(m, "mark")),
    row(Act::Success, &[Char('+')], Pressed, ("+, -", "label it: success, or failure and why"), never),
    row(Act::Failure, &[Char('-')], Pressed, ("", ""), never),
    row(Act::Note, &[Char('n')], Pressed, ("n", "note on the episode"), never),
    row(Act::Task, &[Char('t')], Pressed, ("t", "task of the next episodes"), never),
    row(Act::EndSession, &[Char('E')], Pressed, ("E", "end the session: its trash is emptied"), never),
    row(Act::Up, &[Up, Char('k')], Repeated, ("up, down", "select a device"), |_| Some("select")),
    row(Act::Down, &[Down, Char('j')], Repeated, ("", ""), never),
    row(Act::First, &[Home], Repeated, ("", ""), never),
    row(Act::Last, &[End], Repeated, ("", ""), never),
    row(Act::Register, &[Char('N')], Pressed, ("N", "name a plugged device that has no entry"), |m| {
        (!m.latest().unregistered.is_empty()).then_some("name device")
    }),
    row(Act::Restart, &[Char('r')], Repeated, ("r", "restart the selected device, if it failed"), restarts),
    row(Act::Plug, &[Char('U')], Pressed, ("U", "simulated device: unplug it or plug it in"), plugs),
    row(Act::AskToArm, &[Char('a')], Pressed, ("a, ctrl-y", "arm the actuator: motors follow actions"), never),
    row(Act::Arm, &[Char('y')], Control, ("", ""), never),
    row(Act::Order, &[Char('o')], Pressed, ("o", "order of devices: trouble first, or by bit"), never),
    row(Act::Bell, &[Char('b')], Pressed, ("b", "bell at begin, end and losses: on or off"), never),
    row(Act::Detail, &[KeyCode::Enter], Pressed, ("enter", "the selected device: picture, plots, facts"), |m| {
        Some(if m.page == Page::Device { "back" } else { "device" })
    }),
    row(Act::Log, &[Char('l')], Pressed, ("l", "the log on the whole screen"), |m| {
        Some(if m.page == Page::Log { "back" } else { "log" })
    }),
    row(Act::Episodes, &[Char('e')], Pressed, ("e", "the episodes of the session, with reasons"), never),
    row(Act::Pause, &[Char('p')], Repeated, ("p", "pause the view; everything else continues"), |m| {
        Some(if m.is_paused() { "continue" } else { "pause" })
    }),
    row(Act::Search, &[Char('/')], Pressed, ("/", "only lines of the log that contain a text"), |m| {
        (m.page == Page::Log).then_some("search")
    }),
    row(Act::Level, &[Char('v')], Pressed, ("v", "log: warnings, errors, everything"), |m| {
        (m.page == Page::Log).then_some("level")
    }),
    row(Act::OneDevice, &[Char('f')], Pressed, ("f", "log: of the selected device only"), |m| {
        (m.page == Page::Log).then_some("device only")
    }),
    row(Act::Wrap, &[Char('w')], Pressed, ("w, g", "log: wrap long lines; group repeats"), never),
    row(Act::Group, &[Char('g')], Pressed, ("", ""), never),
    row(Act::Control, &[Char('C')], Pressed, ("C", "set a control of the selected camera"), never),
    row(Act::Pictures, &[Char('c')], Pressed, ("c", "pictures of cameras: on or off"), never),
    row(Act::Older, &[PageUp], Repeated, ("pgup, pgdn", "scroll the log; esc goes to its end"), never),
    row(Act::Newer, &[PageDown], Repeated, ("", ""), never),
    row(Act::Web, &[Char('W')], Pressed, ("W", "page for a phone: its link as a QR code"), never),
    row(Act::Help, &[Char('?'), F(1)], Repeated, ("?", "this help"), |_| Some("help")),
    row(Act::Quit, &[Char('q')], Repeated, ("q, ctrl-c", "quit; ctrl-c disarms first"), |_| Some("quit")),
    row(Act::Interrupt, &[Char('c')], ControlRepeated, ("", ""), never),
];

/// What this key does, if anything.
pub(super) fn act(key: KeyEvent) -> Option<Act> {
    let control = key.modifiers.contains(KeyModifiers::CONTROL);
    let plain = !control && !key.modifiers.contains(KeyModifiers::ALT);
    let pressed = key.kind == KeyEventKind::Press;
    let counts = |when| match when {
        Pressed => plain && pressed,
        Repeated => plain,
        Always => true,
        Control => control && pressed,
        ControlRepeated => control,
    };
    TABLE.iter().find(|row| row.codes.contains(&key.code) && counts(row.when)).map(|row| row.act)
}

/// The keys of the footer at the moment, with a word each; the last two are always to be shown.
pub(super) fn footer(model: &Model) -> Vec<(&'static str, &'static str)> {
    let is_possible = |act: Act| !model.is_read_only() || act == Act::Quit || !act.is_about_the_rig();
    let rows = TABLE.iter().filter(|row| is_possible(row.act));
    rows.filter_map(|row| Some((row.shown.split(", ctrl").next()?, (row.footer)(model)?))).collect()
}

/// The rows of the help: those about episodes and motion, or those about the screen.
pub(super) fn help(is_about_the_rig: bool) -> impl Iterator<Item = (&'static str, &'static str)> {
    let rows = TABLE.iter().filter(move |row| !row.shown.is_empty() && row.act.is_about_the_rig() == is_about_the_rig);
    rows.map(|row| (row.shown, row.help))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_page_about_the_monitor_lists_exactly_these_keys() {
        let page = include_str!("../../../docs/monitor.md");
        let rows: Vec<_> = page.lines().filter(|line| line.starts_with("| `")).collect();
        let expected: Vec<_> = help(true)
            .chain(help(false))
            .map(|(keys, meaning)| format!("| `{}` | {meaning} |", keys.replace(", ", "`, `")))
            .collect();
        assert_eq!(rows, expected);
    }

    #[test]
    fn no_key_has_two_meanings() {
        for modifiers in [KeyModifiers::NONE, KeyModifiers::CONTROL] {
            for code in TABLE.iter().flat_map(|row| row.codes) {
                let key = KeyEvent::new(*code, modifiers);
                let meanings = TABLE.iter().filter(|row| {
                    let control = matches!(row.when, Control | ControlRepeated);
                    row.codes.contains(code) && (row.when == Always || control == (modifiers == KeyModifiers::CONTROL))
                });
                let meanings: Vec<_> = meanings.map(|row| row.act).collect();
                assert!(meanings.len() <= 1, "{code:?}: {meanings:?}");
                assert_eq!(act(key), meanings.first().copied(), "{code:?}");
            }
        }
    }
}
