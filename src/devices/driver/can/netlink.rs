//! Brings a CAN interface up and reads its state.
//!
//! An interface is up with a bit rate that only its administrator may set. `rapid artifacts --install` installs a rule
//! by which udev does it at each plug; for a user with the permission (root, or `CAP_NET_ADMIN`) it is done here.
//!
//! Invariant: an interface that was set down while this program used it stays down until it is set up again from outside:
//! an operator who works on the bus wants no frames on it.

use std::sync::atomic::{AtomicU32, Ordering};

use rapid_registry::CAN_RESTART_MS;
use serde::Serialize;
use socketcan::CanInterface;
use socketcan::nl::{CanState, InterfaceDetails, NlError};

use super::outcome::LinkError;

/// The state of a CAN interface.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Interface {
    /// It is up.
    pub up: bool,
    /// Bits a second; absent without a bus, and before it was set.
    pub bitrate: Option<u32>,
    /// The state of its controller, in the kernel's words.
    pub state: Option<&'static str>,
    /// It left the bus after too many errors.
    pub bus_off: bool,
    /// It returns to the bus by itself after this many ms; 0 means never.
    pub restart_ms: Option<u32>,
    /// Send and receive errors counted by its controller, if it reports them.
    pub errors: Option<(u16, u16)>,
}

/// The steps needed before an interface can be used.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Need {
    Nothing,
    /// It is down.
    Up,
    /// It is up with another bit rate, or has left the bus permanently.
    Restart,
}

/// Indices of interfaces that were set down while in use; 0 is a free place. An interface without a place is brought up
/// again as if it had just been plugged in.
static SET_DOWN: [AtomicU32; 16] = [const { AtomicU32::new(0) }; 16];

/// The interface was set down while it was in use.
pub(super) fn was_set_down(index: u32) {
    if !stays_down(index) {
        replace(0, index);
    }
}

/// Was it set down while it was in use, and not set up again since?
fn stays_down(index: u32) -> bool {
    SET_DOWN.iter().any(|place| place.load(Ordering::SeqCst) == index)
}

/// Replaces the first of these numbers that is present.
fn replace(index: u32, by: u32) {
    let is_replaced = |place: &AtomicU32| place.compare_exchange(index, by, Ordering::SeqCst, Ordering::SeqCst).is_ok();
    let _ = SET_DOWN.iter().any(is_replaced);
}

/// Reads the state of the interface `name`.
///
/// # Errors
/// [`LinkError::Gone`] when there is none.
pub fn read_interface(name: &str) -> Result<Interface, LinkError> {
    let interface = CanInterface::open(name).map_err(|error| refusal(name, &error))?;
    interface.details().map(|details| read(&details)).map_err(|error| refusal(name, &error))
}

/// Was the interface `name` of this index removed, or replaced by a later one of that name?
pub(super) fn is_gone(name: &str, index: u32) -> bool {
    let details = CanInterface::open(name).and_then(|interface| interface.details());
    is_another(details.map(|details| details.index).map_err(|error| refusal(name, &error)), index)
}

/// Without an answer of the kernel the interface counts as the same: a removed one would be brought up again, against
/// the will of an operator who set it down.
fn is_another(found: Result<u32, LinkError>, index: u32) -> bool {
    found.map_or_else(|error| error == LinkError::Gone, |found| found != index)
}

/// An interface that is up.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Ready {
    /// Distinguishes it from a later one of the same name.
    pub(super) index: u32,
    /// It returns from bus-off by itself.
    pub(super) restarts: bool,
}

/// Ensures that the interface `name` is up with `bitrate`.
pub(super) fn bring_up(name: &str, bitrate: u32) -> Result<Ready, LinkError> {
    let interface = CanInterface::open(name).map_err(|error| refusal(name, &error))?;
    let details = interface.details().map_err(|error| refusal(name, &error))?;
    let state = read(&details);
    if state.up {
        replace(details.index, 0);
    }
    match need(&state, bitrate) {
        Need::Nothing => {
            return Ok(Ready { index: details.index, restarts: state.restart_ms.is_some_and(|ms| ms > 0) });
        }
        Need::Up if stays_down(details.index) => return Err(set_down(name)),
        Need::Up => {}
        Need::Restart => {
            tracing::warn!(interface = name, ?state.bitrate, requested = bitrate, "the interface is set up again");
            interface.bring_down().map_err(|error| not_set(name, bitrate, &state, &error))?;
        }
    }
    interface.set_bitrate(bitrate, None).map_err(|error| not_set(name, bitrate, &state, &error))?;
    // Not every driver can.
    let restart = interface.set_restart_ms(CAN_RESTART_MS);
    if let Err(error) = &restart {
        tracing::info!(interface = name, %error, "the interface does not return from bus-off by itself");
    }
    interface.bring_up().map_err(|error| not_set(name, bitrate, &state, &error))?;
    Ok(Ready { index: details.index, restarts: restart.is_ok() })
}

fn need(state: &Interface, bitrate: u32) -> Need {
    // A virtual interface has no bit rate and needs none.
    let fits = state.bitrate.is_none_or(|is| is == bitrate);
    let stuck = state.bus_off && state.restart_ms.is_none_or(|ms| ms == 0);
    match (state.up, fits && !stuck) {
        (true, true) => Need::Nothing,
        (true, false) => Need::Restart,
        (false, _) => Need::Up,
    }
}

fn read(details: &InterfaceDetails) -> Interface {
    let can = &details.can;
    Interface {
        up: details.is_up,
        bitrate: can.bit_timing.map(|timing| timing.bitrate).filter(|bitrate| *bitrate > 0),
        state: can.state.map(|state| match state {
            CanState::ErrorActive => "ERROR-ACTIVE",
            CanState::ErrorWarning => "ERROR-WARNING",
            CanState::ErrorPassive => "ERROR-PASSIVE",
            CanState::BusOff => "BUS-OFF",
            CanState::Stopped => "STOPPED",
            CanState::Sleeping => "SLEEPING",
        }),
        bus_off: can.state == Some(CanState::BusOff),
        restart_ms: can.restart_ms,
        errors: can.berr_counter.map(|errors| (errors.txerr, errors.rxerr)),
    }
}

/// The commands that do by hand what this process may not do.
fn by_hand(name: &str, bitrate: u32, up: bool) -> String {
    let down = if up { format!("sudo ip link set {name} down && ") } else { String::new() };
    format!("{down}sudo ip link set {name} up type can bitrate {bitrate}")
}

fn set_down(name: &str) -> LinkError {
    LinkError::Retry(format!(
        "{name} was set down while it was in use: it is used again once it is up (`sudo ip link set {name} up`)"
    ))
}

fn not_set(name: &str, bitrate: u32, state: &Interface, error: &socketcan::Error) -> LinkError {
    let is = match (state.up, state.bus_off, state.bitrate) {
        (false, ..) => format!("{name} is down"),
        (true, true, _) => format!("{name} has left the bus (bus-off)"),
        (true, false, is) => format!("{name} is up at {} bit/s, not at {bitrate}", is.unwrap_or_default()),
    };
    let command = by_hand(name, bitrate, state.up);
    match errno(error) {
        Some(libc::EPERM | libc::EACCES) => LinkError::Fatal(format!(
            "{is}, and setting it up is for root: run `rapid artifacts --install` once, whose udev rule does it at \
             each plug, or `{command}`"
        )),
        Some(libc::ENODEV | libc::ENXIO) => LinkError::Gone,
        Some(libc::EOPNOTSUPP) => {
            LinkError::Fatal(format!("{is}: {name} is no CAN interface whose bit rate can be set"))
        }
        Some(libc::EINVAL | libc::ERANGE | libc::EDOM) => {
            LinkError::Fatal(format!("{is}: its controller cannot do {bitrate} bit/s ({error}): correct `bitrate`"))
        }
        // socketcan 4.0 has this for every refusal of the kernel, whatever its reason.
        _ if matches!(error, socketcan::Error::Nl(NlError::NoAck)) => LinkError::Retry(format!(
            "{is}, and the kernel refuses to set it up at {bitrate} bit/s: only root may, and not every controller has \
             every bit rate: run `rapid artifacts --install` once, whose udev rule does it at each plug; `{command}` \
             prints the reason"
        )),
        _ => LinkError::Retry(format!("{is}, and setting it up failed: {error}")),
    }
}

fn refusal(name: &str, error: &socketcan::Error) -> LinkError {
    match errno(error) {
        Some(libc::ENODEV | libc::ENXIO) => LinkError::Gone,
        _ => LinkError::Retry(format!("looking at {name}: {error}")),
    }
}

fn errno(error: &socketcan::Error) -> Option<i32> {
    match error {
        socketcan::Error::Io(error) => error.raw_os_error(),
        socketcan::Error::Nl(error) => error.errno(),
        socketcan::Error::Can(_) => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn interface(up: bool, bitrate: Option<u32>, state: CanState, restart_ms: u32) -> Interface {
        let mut details = InterfaceDetails::new(3);
        details.is_up = up;
        details.can.state = Some(state);
        details.can.restart_ms = Some(restart_ms);
        let mut found = read(&details);
        found.bitrate = bitrate;
        found
    }

    #[test]
    fn only_an_interface_in_the_wrong_state_is_set_up() {
        let (active, off) = (CanState::ErrorActive, CanState::BusOff);
        for (state, expected) in [
            (interface(true, Some(500_000), active, 0), Need::Nothing),
            (interface(true, None, active, 0), Need::Nothing),
            (interface(true, Some(500_000), off, 100), Need::Nothing),
            (interface(true, Some(500_000), off, 0), Need::Restart),
            (interface(true, Some(250_000), active, 100), Need::Restart),
            (interface(false, Some(500_000), CanState::Stopped, 0), Need::Up),
            (interface(false, None, CanState::Stopped, 0), Need::Up),
        ] {
            assert_eq!(need(&state, 500_000), expected, "{state:?}");
        }
    }

    #[test]
    fn an_interface_that_was_set_down_is_remembered_until_it_is_up() {
        let index = u32::MAX;
        assert!(!stays_down(index));
        for _ in 0..100 {
            was_set_down(index);
        }
        was_set_down(index - 1);
        assert!(stays_down(index) && stays_down(index - 1));
        replace(index, 0);
        assert!(!stays_down(index) && stays_down(index - 1));
        replace(index - 1, 0);
        assert!(!stays_down(index - 1));
    }

    #[test]
    fn a_missing_interface_is_reported_as_gone() {
        assert_eq!(read_interface("no-such-can0"), Err(LinkError::Gone));
        assert_eq!(bring_up("no-such-can0", 1_000_000), Err(LinkError::Gone));
        assert!(is_gone("no-such-can0", 1));
    }

    #[test]
    fn an_interface_that_the_kernel_does_not_describe_is_not_taken_for_removed() {
        let refused = refusal("can0", &socketcan::Error::from(std::io::Error::from_raw_os_error(libc::ENOBUFS)));
        for (found, expected) in [(Ok(7), false), (Ok(8), true), (Err(LinkError::Gone), true), (Err(refused), false)] {
            assert_eq!(is_another(found.clone(), 7), expected, "{found:?}");
        }
    }

    #[test]
    fn a_missing_permission_names_the_command() {
        let denied = socketcan::Error::from(std::io::Error::from_raw_os_error(libc::EPERM));
        let down = interface(false, None, CanState::Stopped, 0);
        let LinkError::Fatal(text) = not_set("can0", 1_000_000, &down, &denied) else { panic!("fatal") };
        assert!(text.contains("`sudo ip link set can0 up type can bitrate 1000000`"), "{text}");
        assert!(text.contains("rapid artifacts --install"), "{text}");
        // The library's error for refusals of the kernel.
        let refused = socketcan::Error::from(NlError::NoAck);
        let LinkError::Retry(text) = not_set("can0", 1_000_000, &down, &refused) else { panic!("tried again") };
        assert!(text.contains("rapid artifacts --install") && text.contains("`sudo ip link set can0 up"), "{text}");
        let other = interface(true, Some(500_000), CanState::ErrorActive, 0);
        let LinkError::Fatal(text) = not_set("can0", 1_000_000, &other, &denied) else { panic!("fatal") };
        assert!(text.contains("up at 500000 bit/s, not at 1000000"), "{text}");
        assert!(text.contains("sudo ip link set can0 down && sudo"), "{text}");
    }
}
