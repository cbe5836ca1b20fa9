//! The emulator's commands, one per line:
//!
//! ```text
//! plug N..      unplug N..      silent N 0|1      port N P       hub out|in
//! sleep MS      t0              at MS [COMMAND]   say WORD       quit
//! ```
//!
//! and the orders of `order`.
//!
//! `t0` starts the timeline's clock; `at MS` waits until MS after it. `say` logs the word once everything before it is
//! done. `hub out` unplugs all devices at once, like a hub that loses its own cable; `hub in` plugs them in again. The
//! end of the input means `quit`.
//! Invariant: an invalid line is reported and skipped; it never ends the emulator.

use std::io::BufRead;
use std::str::{FromStr, SplitWhitespace};
use std::sync::Arc;
use std::thread;
use std::time::Duration;

use serde_json::json;
use thiserror::Error;

use super::device::{self, Device, PortError};
use super::log::{Log, Moment};
use super::order::{self, Order, Target};
use super::spec::PORTS;
use crate::clock;

/// A parsed line.
#[derive(Clone, Debug, PartialEq)]
pub enum Command {
    /// Plug these devices, in this order.
    Plug(Vec<usize>),
    /// Unplug these devices, in this order.
    Unplug(Vec<usize>),
    /// Unplug everything at once.
    HubOut,
    /// Plug in the devices that `hub out` unplugged.
    HubIn,
    /// Stop or resume sending.
    Silent(usize, bool),
    /// Port of the next plug.
    Port(usize, u8),
    /// Wait.
    Sleep(Duration),
    /// Start of the timeline.
    Origin,
    /// Wait until this long after the start of the timeline, then run the command.
    At(Duration, Option<Box<Command>>),
    /// Apply an order to a device.
    Befall(Target, Order),
    /// Log a word.
    Say(String),
    /// Unplug everything and end.
    Quit,
}

/// A line that is not a command.
#[derive(Debug, Error, PartialEq, Eq)]
#[error("cannot read `{0}`")]
pub struct CommandError(String);

impl FromStr for Command {
    type Err = CommandError;

    fn from_str(line: &str) -> Result<Self, CommandError> {
        parse(&mut line.split_whitespace()).ok_or_else(|| CommandError(line.trim().into()))
    }
}

fn parse(words: &mut SplitWhitespace<'_>) -> Option<Command> {
    let command = match words.next()? {
        "plug" => Command::Plug(indices(words)?),
        "unplug" => Command::Unplug(indices(words)?),
        "hub" => match words.next()? {
            "out" => Command::HubOut,
            "in" => Command::HubIn,
            _ => return None,
        },
        "silent" => {
            let device = words.next()?.parse().ok()?;
            Command::Silent(device, words.next()?.parse::<u8>().ok()? != 0)
        }
        "port" => {
            let device = words.next()?.parse().ok()?;
            Command::Port(device, words.next()?.parse().ok().filter(|port| *port < PORTS)?)
        }
        "sleep" => Command::Sleep(millis(words)?),
        "t0" => Command::Origin,
        "at" => {
            let when = millis(words)?;
            let then = match words.clone().next() {
                Some(_) => Some(Box::new(parse(words)?)),
                None => None,
            };
            Command::At(when, then)
        }
        "say" => Command::Say(words.next()?.into()),
        "quit" => Command::Quit,
        name => {
            let (target, order) = order::parse(name, words)?;
            Command::Befall(target, order)
        }
    };
    words.next().is_none().then_some(command)
}

fn indices(words: &mut SplitWhitespace<'_>) -> Option<Vec<usize>> {
    let all: Vec<usize> = words.map(|word| word.parse().ok()).collect::<Option<_>>()?;
    (!all.is_empty()).then_some(all)
}

fn millis(words: &mut SplitWhitespace<'_>) -> Option<Duration> {
    words.next()?.parse().ok().map(Duration::from_millis)
}

/// Runs commands from `input` until `quit` or its end, then unplugs all devices.
pub fn run(input: impl BufRead, devices: &mut [Device], log: &Arc<Log>) {
    let mut player = Player { devices, log, origin_ns: clock::mono_ns(), on_hub: Vec::new() };
    for line in input.lines().map_while(Result::ok).filter(|line| !line.trim().is_empty()) {
        match line.parse() {
            Ok(Command::Quit) => break,
            Ok(command) => player.play(command),
            Err(error) => player.report(&error),
        }
    }
    for device in player.devices {
        let _not_plugged = device.unplug();
    }
}

struct Player<'a> {
    devices: &'a mut [Device],
    log: &'a Log,
    origin_ns: u64,
    /// The devices that `hub out` unplugged.
    on_hub: Vec<usize>,
}

impl Player<'_> {
    fn play(&mut self, command: Command) {
        match command {
            Command::Plug(devices) => devices.iter().for_each(|index| self.with(*index, Device::plug)),
            Command::Unplug(devices) => devices.iter().for_each(|index| self.with(*index, Device::unplug)),
            Command::HubOut => match device::unplug_together(self.devices) {
                Ok(pulled) => self.on_hub = pulled,
                Err(error) => self.report(&error),
            },
            Command::HubIn => {
                std::mem::take(&mut self.on_hub).into_iter().for_each(|index| self.with(index, Device::plug));
            }
            Command::Silent(index, silent) => {
                let moment = Moment::now();
                self.with(index, |device| {
                    device.set_silent(silent);
                    Ok(())
                });
                self.log.write("silent", moment, json!({"device": index, "silent": silent}));
            }
            Command::Port(index, port) => self.with(index, |device| {
                device.set_port(port);
                Ok(())
            }),
            Command::Sleep(duration) => thread::sleep(duration),
            Command::Origin => {
                let moment = Moment::now();
                self.origin_ns = moment.mono_ns;
                self.log.write("t0", moment, json!({}));
            }
            Command::At(when, then) => {
                let due_ns = self.origin_ns + u64::try_from(when.as_nanos()).unwrap_or(u64::MAX);
                thread::sleep(clock::until(due_ns));
                if let Some(then) = then {
                    self.play(*then);
                }
            }
            Command::Befall(target, order) => {
                let moment = Moment::now();
                self.with(target.device, |device| device.apply(target.motor, order));
                let fields = json!({"device": target.device, "motor": target.motor, "order": format!("{order:?}")});
                self.log.write("order", moment, fields);
            }
            Command::Say(word) => self.log.write("say", Moment::now(), json!({"word": word})),
            Command::Quit => {}
        }
    }

    fn with(&mut self, index: usize, act: impl FnOnce(&mut Device) -> Result<(), PortError>) {
        match self.devices.get_mut(index).map(act) {
            Some(Ok(())) => {}
            Some(Err(error)) => self.report(&format!("device {index}: {error}")),
            None => self.report(&format!("no device {index}")),
        }
    }

    fn report(&self, error: &dyn std::fmt::Display) {
        self.log.write("error", Moment::now(), json!({"error": error.to_string()}));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_every_command() {
        let ms = Duration::from_millis;
        let cases = [
            ("plug 0 2", Command::Plug(vec![0, 2])),
            ("unplug 1", Command::Unplug(vec![1])),
            ("hub out", Command::HubOut),
            ("hub in", Command::HubIn),
            ("silent 1 1", Command::Silent(1, true)),
            ("port 0 14", Command::Port(0, 14)),
            ("sleep 250", Command::Sleep(ms(250))),
            ("t0", Command::Origin),
            ("at 5000", Command::At(ms(5000), None)),
            ("  at 300 unplug 1 ", Command::At(ms(300), Some(Box::new(Command::Unplug(vec![1]))))),
            ("say done", Command::Say("done".into())),
            ("hot 1.5 95", Command::Befall(Target { device: 1, motor: Some(5) }, Order::Hot(95))),
            ("quit", Command::Quit),
        ];
        for (line, command) in cases {
            assert_eq!(line.parse(), Ok(command), "{line}");
        }
    }

    #[test]
    fn rejects_unreadable_lines() {
        for line in [
            "plug",
            "plug x",
            "hub",
            "hub up",
            "silent 0",
            "port 0 15",
            "sleep",
            "at",
            "at 5 jump",
            "quit now",
            "jump",
            "hot 1",
        ] {
            assert_eq!(line.parse::<Command>(), Err(CommandError(line.into())));
        }
    }
}
