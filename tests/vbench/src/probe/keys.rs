//! A keyboard created through the kernel (uinput), and a program that grabs another's events.

use std::io::BufRead;
use std::path::Path;
use std::str::FromStr;

use evdev::uinput::VirtualDevice;
use evdev::{AttributeSet, Device, EventType, InputEvent, KeyCode};

type Failure = Box<dyn std::error::Error>;

fn code(word: &str) -> Result<KeyCode, Failure> {
    KeyCode::from_str(word).map_err(|_| format!("there is no key {word}").into())
}

/// An input device called `name` with these keys, which follows the input lines `press KEY` and `release KEY` to their
/// end. Prints `ready`, and `done` after each.
pub fn serve(name: &str, keys: &[&str], lines: impl BufRead) -> Result<(), Failure> {
    let mut set = AttributeSet::<KeyCode>::new();
    for word in keys {
        set.insert(code(word)?);
    }
    let mut device = VirtualDevice::builder()?.name(name).with_keys(&set)?.build()?;
    println!("ready");
    for line in lines.lines() {
        let line = line?;
        let pressed = match line.split_once(' ') {
            Some(("press", key)) => (key, 1),
            Some(("release", key)) => (key, 0),
            _ => return Err(format!("{line:?} is neither `press KEY` nor `release KEY`").into()),
        };
        device.emit(&[InputEvent::new(EventType::KEY.0, code(pressed.0)?.code(), pressed.1)])?;
        println!("done");
    }
    Ok(())
}

/// Grabs the events of the device at `node` for as long as this program runs.
pub fn grab(node: &Path) -> Result<(), Failure> {
    let mut device = Device::open(node)?;
    device.grab()?;
    println!("grabbed");
    loop {
        std::thread::park();
    }
}
