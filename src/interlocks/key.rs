//! A key of an input device of the kernel (evdev): a foot switch, a button, a keyboard.

use std::io::ErrorKind;
use std::os::fd::{AsFd as _, BorrowedFd};
use std::time::Duration;

use evdev::{Device, EventSummary, InputEvent, KeyCode};

use super::source::state;
use crate::interlock::InputState;
use crate::registry::KeyInput;
use crate::text::not_opened;

/// The key is queried at least this often.
pub(super) const LOOK: Duration = Duration::from_millis(50);

/// An open device.
#[derive(Debug)]
pub(super) struct Key {
    device: Device,
    shown: String,
    code: KeyCode,
    runs_while_pressed: bool,
}

impl Key {
    /// Opens the device at its path, or the first with its name and the key.
    pub(super) fn open(spec: &KeyInput) -> Result<Self, String> {
        let code = KeyCode(spec.number);
        let has_key = |device: &Device| device.supported_keys().is_some_and(|keys| keys.contains(code));
        let shown = spec.device.clone();
        let fail = |error: std::io::Error| not_opened(&spec.device, "input", &error);
        let device = if shown.starts_with('/') {
            Device::open(&shown).map_err(fail)?
        } else {
            let mut named = evdev::enumerate().map(|(_, device)| device);
            named.find(|device| device.name() == Some(&shown) && has_key(device)).ok_or_else(|| {
                format!(
                    "no input device is called {shown:?} and has {}: plug it in, or add the user to group input",
                    spec.code
                )
            })?
        };
        if !has_key(&device) {
            return Err(format!("{shown} has no key {}", spec.code));
        }
        device.set_nonblocking(true).map_err(fail)?;
        Ok(Self { device, shown, code, runs_while_pressed: spec.runs_while_pressed })
    }

    pub(super) fn fd(&self) -> BorrowedFd<'_> {
        self.device.as_fd()
    }

    pub(super) fn take(&mut self, report: &mut dyn FnMut(InputState)) -> Result<(), String> {
        let Self { device, shown, code, runs_while_pressed } = self;
        let fail = |error: std::io::Error| not_opened(shown, "input", &error);
        match device.fetch_events() {
            // After an overflow of the kernel's queue, the crate synthesizes the changes.
            Ok(events) => events.for_each(|event| judge(event, *code, *runs_while_pressed, report)),
            Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted) => {}
            Err(error) => return Err(fail(error)),
        }
        // A device that another program has grabbed delivers no events.
        let is_pressed = device.get_key_state().map_err(fail)?.contains(*code);
        report(state(is_pressed, *runs_while_pressed));
        Ok(())
    }
}

/// The value of a key event: 1 is a press, 2 an autorepeat, 0 a release.
fn judge(event: InputEvent, key: KeyCode, runs_while_pressed: bool, report: &mut dyn FnMut(InputState)) {
    if let EventSummary::Key(_, code, value) = event.destructure()
        && code == key
    {
        report(state(value != 0, runs_while_pressed));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_events_of_the_key_count() {
        use InputState::{Runs, Stopped};
        let event = |kind: evdev::EventType, code: KeyCode, value| InputEvent::new(kind.0, code.0, value);
        let (key, absolute) = (evdev::EventType::KEY, evdev::EventType::ABSOLUTE);
        let events = [
            event(key, KeyCode::KEY_A, 1),
            event(key, KeyCode::KEY_B, 1),
            event(key, KeyCode::KEY_B, 2),
            event(absolute, KeyCode::KEY_B, 0),
            event(key, KeyCode::KEY_B, 0),
        ];
        for (runs_while_pressed, expected) in [(true, [Runs, Runs, Stopped]), (false, [Stopped, Stopped, Runs])] {
            let mut states = Vec::new();
            for event in events {
                judge(event, KeyCode::KEY_B, runs_while_pressed, &mut |state| states.push(state));
            }
            assert_eq!(states, expected);
        }
    }

    #[test]
    fn a_missing_device_or_key_is_reported() {
        let spec = |device: &str| KeyInput {
            device: device.to_owned(),
            code: "KEY_B".to_owned(),
            number: KeyCode::KEY_B.0,
            runs_while_pressed: true,
        };
        let why = |device: &str| Key::open(&spec(device)).unwrap_err();
        assert_eq!(why("/dev/input/by-id/none"), "/dev/input/by-id/none is not plugged in");
        assert!(why("no such pedal").contains("no input device is called"), "{}", why("no such pedal"));
        // Not an input device.
        assert!(why("/dev/null").starts_with("/dev/null"), "{}", why("/dev/null"));
    }
}
