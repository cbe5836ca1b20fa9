//! Keys of an input device of the kernel (evdev): a foot switch, a button, a keyboard.

use std::io::ErrorKind;
use std::os::fd::{AsFd as _, BorrowedFd};
use std::time::Duration;

use evdev::{Device, EventSummary, InputEvent, KeyCode};
use rapid_core::text::not_opened;
use rapid_registry::KeyInput;

/// The keys are queried at least this often.
pub(super) const LOOK: Duration = Duration::from_millis(50);

/// An open device.
#[derive(Debug)]
pub(super) struct Keys {
    device: Device,
    shown: String,
    /// Keys, each with the level at which it is on.
    wanted: Vec<(KeyCode, bool)>,
}

impl Keys {
    /// Opens the device at its path, or the first with its name and all of these keys, which are of one device.
    pub(super) fn open(specs: &[KeyInput]) -> Result<Self, String> {
        let Some(shown) = specs.first().map(|spec| spec.device.clone()) else { return Err("no key".to_owned()) };
        let wanted = specs.iter().map(|spec| (KeyCode(spec.number), spec.on_while_pressed)).collect();
        let missing = |device: &Device| {
            let has = |spec: &&KeyInput| device.supported_keys().is_some_and(|all| all.contains(KeyCode(spec.number)));
            specs.iter().find(|spec| !has(spec))
        };
        let fail = |error: std::io::Error| not_opened(&shown, "input", &error);
        let mut device = if shown.starts_with('/') {
            Device::open(&shown).map_err(fail)?
        } else {
            let mut named = evdev::enumerate().map(|(_, device)| device);
            named.find(|device| device.name() == Some(&shown) && missing(device).is_none()).ok_or_else(|| {
                let codes: Vec<&str> = specs.iter().map(|spec| spec.code.as_str()).collect();
                format!(
                    "no input device is called {shown:?} and has {}: plug it in, or add the user to group input",
                    codes.join(" and ")
                )
            })?
        };
        if let Some(spec) = missing(&device) {
            return Err(format!("{shown} has no key {}", spec.code));
        }
        device.set_nonblocking(true).map_err(fail)?;
        if specs.iter().any(|spec| spec.grab) {
            device.grab().map_err(|error| match error.kind() {
                ErrorKind::ResourceBusy => {
                    format!("{shown} is grabbed by another program: end that one, or write grab = false")
                }
                _ => fail(error),
            })?;
        }
        Ok(Self { device, shown, wanted })
    }

    pub(super) fn fd(&self) -> BorrowedFd<'_> {
        self.device.as_fd()
    }

    pub(super) fn drain(&mut self, report: &mut dyn FnMut(usize, bool)) -> Result<(), String> {
        let Self { device, shown, wanted } = self;
        let fail = |error: std::io::Error| not_opened(shown, "input", &error);
        match device.fetch_events() {
            // After an overflow of the kernel's queue, the crate synthesizes the changes.
            Ok(events) => events.for_each(|event| judge(event, wanted, report)),
            Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted) => {}
            Err(error) => return Err(fail(error)),
        }
        // A device that another program has grabbed delivers no events.
        let pressed = device.get_key_state().map_err(fail)?;
        for (which, (code, on_while_pressed)) in wanted.iter().enumerate() {
            report(which, pressed.contains(*code) == *on_while_pressed);
        }
        Ok(())
    }
}

/// The value of a key event: 1 is a press, 2 an autorepeat, 0 a release.
fn judge(event: InputEvent, keys: &[(KeyCode, bool)], report: &mut dyn FnMut(usize, bool)) {
    let EventSummary::Key(_, code, value) = event.destructure() else { return };
    for (which, (_, on_while_pressed)) in keys.iter().enumerate().filter(|(_, (key, _))| *key == code) {
        report(which, (value != 0) == *on_while_pressed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_events_of_the_keys_count() {
        let event = |kind: evdev::EventType, code: KeyCode, value| InputEvent::new(kind.0, code.0, value);
        let (key, absolute) = (evdev::EventType::KEY, evdev::EventType::ABSOLUTE);
        let events = [
            event(key, KeyCode::KEY_A, 1),
            event(key, KeyCode::KEY_B, 1),
            event(key, KeyCode::KEY_B, 2),
            event(key, KeyCode::KEY_C, 1),
            event(absolute, KeyCode::KEY_B, 0),
            event(key, KeyCode::KEY_B, 0),
        ];
        let mut levels = Vec::new();
        let keys = [(KeyCode::KEY_B, true), (KeyCode::KEY_C, false)];
        for event in events {
            judge(event, &keys, &mut |which, is_on| levels.push((which, is_on)));
        }
        assert_eq!(levels, [(0, true), (0, true), (1, false), (0, false)]);
    }

    #[test]
    fn a_missing_device_or_key_is_reported() {
        let spec = |device: &str| KeyInput {
            device: device.to_owned(),
            code: "KEY_B".to_owned(),
            number: KeyCode::KEY_B.0,
            on_while_pressed: true,
            grab: true,
        };
        let why = |device: &str| Keys::open(&[spec(device)]).unwrap_err();
        assert_eq!(why("/dev/input/by-id/none"), "/dev/input/by-id/none is not plugged in");
        assert!(why("no such pedal").contains("no input device is called"), "{}", why("no such pedal"));
        // Not an input device.
        assert!(why("/dev/null").starts_with("/dev/null"), "{}", why("/dev/null"));
    }
}
