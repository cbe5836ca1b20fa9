//! Keys and messages on the network; samples are frames of [`rapid_core::remote`].
//!
//! | key                         |                                                                     |
//! |-----------------------------|---------------------------------------------------------------------|
//! | `rapid/HOST/alive`          | liveliness token of `serve`                                         |
//! | `rapid/HOST/state`          | which sensors are present: at each change and 20 times a second     |
//! | `rapid/HOST/clock`          | answers a query with `CLOCK_MONOTONIC`, 8 bytes, little endian      |
//! | `rapid/HOST/sample/DEVICE`  | its samples, if someone subscribes                                  |
//! | `rapid/HOST/taken/DEVICE`   | from the subscriber: the number of the newest sample, 8 bytes       |
//!
//! Invariant: no bytes of the network make a reader panic, or keep more than it may hold.

use std::collections::BTreeSet;

use rapid_core::modality::MAX_MODALITIES;
use rapid_core::remote::is_name;

/// Keys that `join` subscribes to, of every host.
pub const ALL_ALIVE: &str = "rapid/*/alive";
/// See [`ALL_ALIVE`].
pub const ALL_STATES: &str = "rapid/*/state";
/// The first line of a state, with the version of these messages.
const STATE: &str = "rapid-remote-1";

/// The key of a host.
pub fn key(host: &str, what: &str) -> String {
    format!("rapid/{host}/{what}")
}

/// The key of a device's samples.
pub fn sample_key(host: &str, device: &str) -> String {
    format!("rapid/{host}/sample/{device}")
}

/// The key of what was taken of a device's samples.
pub fn taken_key(host: &str, device: &str) -> String {
    format!("rapid/{host}/taken/{device}")
}

/// The host of a key.
pub fn host_of(key: &str) -> Option<&str> {
    let mut parts = key.split('/');
    let (first, host) = (parts.next()?, parts.next()?);
    (first == "rapid" && is_name(host)).then_some(host)
}

/// The message with the names of the sensors that are present.
pub fn state<'n>(present: impl Iterator<Item = &'n str>) -> String {
    let mut text = STATE.to_owned();
    for name in present {
        text.push('\n');
        text.push_str(name);
    }
    text
}

/// The names in a message.
pub fn read_state(bytes: &[u8]) -> Option<BTreeSet<String>> {
    let mut lines = std::str::from_utf8(bytes).ok()?.split('\n');
    if lines.next() != Some(STATE) {
        return None;
    }
    let names: BTreeSet<String> = lines.take(MAX_MODALITIES + 1).map(str::to_owned).collect();
    (names.len() <= MAX_MODALITIES && names.iter().all(|name| is_name(name))).then_some(names)
}

/// The number in a message: a clock, or a sample.
pub fn read_number(bytes: &[u8]) -> Option<u64> {
    Some(u64::from_le_bytes(bytes.try_into().ok()?))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn a_state_is_read_as_written() {
        for names in [&[][..], &["cam"], &["cam", "motor_state"]] {
            let read = read_state(state(names.iter().copied()).as_bytes()).expect("a state");
            assert_eq!(read.iter().map(String::as_str).collect::<Vec<_>>(), names);
        }
        let many = (0..=MAX_MODALITIES).map(|number| format!("d{number}")).collect::<Vec<_>>();
        assert_eq!(read_state(state(many.iter().map(String::as_str)).as_bytes()), None);
        for wrong in ["", "rapid-remote-2\ncam", "rapid-remote-1\n", "rapid-remote-1\na/b"] {
            assert_eq!(read_state(wrong.as_bytes()), None, "{wrong:?}");
        }
    }

    #[test]
    fn a_key_names_its_host() {
        assert_eq!(host_of(&key("robot-b", "state")), Some("robot-b"));
        assert_eq!(host_of(&sample_key("robot-b", "cam")), Some("robot-b"));
        for wrong in ["", "rapid", "rapid/", "other/robot-b/state", "rapid/*/state"] {
            assert_eq!(host_of(wrong), None, "{wrong:?}");
        }
    }

    proptest! {
        #[test]
        fn any_bytes_are_survived(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
            let _ = (read_state(&bytes), read_number(&bytes));
            let _ = read_state(&[STATE.as_bytes(), &bytes].concat());
        }
    }
}
