//! The fields of an entry: as given, as suggested by the device, or as answered.

use std::io::{self, Write};

use rapid_core::text;
use rapid_devices::driver::camera::query;
use rapid_registry::candidate::Candidate;
use rapid_registry::device::{DeviceNode, UsbIdentity};
use rapid_registry::edit::Setting;
use rapid_registry::{Mount, Registry, name_problem};
use serde::Serialize;

use super::{Dialogue, Format, RegisterError, listen};
use crate::cli::RegisterArgs;
use crate::registration::settings::suggested;

/// A unit that could be registered, as JSON.
#[derive(Serialize)]
struct Listed<'a> {
    event: &'static str,
    #[serde(flatten)]
    usb: &'a UsbIdentity,
    nodes: Vec<String>,
    node: Option<&'static str>,
}

/// The device to register.
pub(super) enum Selection {
    Unit(Box<Candidate>),
    /// A device that is described but not plugged in.
    NotPlugged,
    /// None, which has been reported.
    Nothing,
}

/// Chooses the unit to register.
pub(super) fn choose(
    units: &[Candidate],
    args: &RegisterArgs,
    talk: Option<&mut Dialogue<'_>>,
    format: Format,
    out: &mut dyn Write,
) -> Result<Selection, RegisterError> {
    let matches = |unit: &&Candidate| {
        args.vid.is_none_or(|vid| vid == unit.usb.vid)
            && args.pid.is_none_or(|pid| pid == unit.usb.pid)
            && args.serial.as_ref().is_none_or(|serial| Some(serial) == unit.usb.serial.as_ref())
            && args.port.as_ref().is_none_or(|port| *port == unit.usb.port)
    };
    let matching: Vec<&Candidate> = units.iter().filter(matches).collect();
    let is_described = args.vid.is_some() || args.pid.is_some() || args.serial.is_some() || args.port.is_some();
    match (matching.as_slice(), talk) {
        ([unit], _) if is_described => Ok(Selection::Unit(Box::new((*unit).clone()))),
        ([], _) if args.vid.is_some() && args.pid.is_some() => Ok(Selection::NotPlugged),
        ([], Some(talk)) => {
            talk.print(if is_described {
                "No such device is plugged in, or it is already registered. `rapid devices` lists connected devices."
            } else {
                "No unregistered device is plugged in. `rapid devices` lists connected devices."
            })?;
            Ok(Selection::Nothing)
        }
        (units, Some(talk)) => {
            talk.print("Plugged in and not registered:\n")?;
            for (at, unit) in units.iter().enumerate() {
                talk.print(&format!("  {}  {}", at + 1, line(unit)))?;
            }
            talk.print("")?;
            let most = units.len();
            let which = talk.ask("Which one", Some("1"), |answer| {
                let number = answer.parse::<usize>().ok().and_then(|number| number.checked_sub(1));
                number.filter(|number| *number < most).ok_or_else(|| format!("enter a number from 1 to {most}"))
            })?;
            Ok(units.get(which).map_or(Selection::Nothing, |unit| Selection::Unit(Box::new((*unit).clone()))))
        }
        (units, None) if is_described && !units.is_empty() => {
            Err(RegisterError::Several(units.iter().map(|unit| line(unit)).collect()))
        }
        (units, None) => {
            for unit in units {
                let nodes = unit.nodes.iter().map(|node| node.node.label()).collect();
                let candidate = Listed { event: "unregistered", usb: &unit.usb, nodes, node: unit.guess() };
                match format {
                    Format::Text => writeln!(out, "not registered: {}", line(unit))?,
                    Format::Json => writeln!(out, "{}", text::json(&candidate).map_err(io::Error::from)?)?,
                }
            }
            if format == Format::Json && args.name.is_none() {
                return Ok(Selection::Nothing);
            }
            if units.is_empty() && !is_described {
                return Err(RegisterError::NothingNew);
            }
            let given = [("--vid", args.vid.is_some()), ("--pid", args.pid.is_some()), ("--name", args.name.is_some())];
            Err(RegisterError::Missing(given.iter().filter(|(_, given)| !given).map(|(option, _)| *option).collect()))
        }
    }
}

/// A unit on a line.
fn line(unit: &Candidate) -> String {
    let nodes: Vec<String> = unit.nodes.iter().map(|node| node.node.label()).collect();
    let what = unit.guess().unwrap_or("needs a program");
    text::plain(&format!("{}  {what} at {}", unit.describe(), nodes.join(", "))).into_owned()
}

pub(super) fn name(
    registry: Option<&Registry>,
    unit: Option<&Candidate>,
    args: &RegisterArgs,
    talk: Option<&mut Dialogue<'_>>,
) -> Result<String, RegisterError> {
    let Some(talk) = talk.filter(|_| args.name.is_none()) else {
        return args.name.clone().ok_or_else(|| RegisterError::Missing(vec!["--name"]));
    };
    let is_taken = |name: &str| registry.is_some_and(|registry| registry.named(name).is_some());
    let suggestion = unit.and_then(|unit| unit.suggested_name(registry));
    talk.ask("Name (used by policies, recordings and the monitor)", suggestion.as_deref(), |answer| match name_problem(
        answer,
    ) {
        Some((message, fix)) => Err(format!("{message}: {fix}")),
        None if is_taken(answer) => Err(format!("[device.{answer}] already exists")),
        None => Ok(answer.to_owned()),
    })
}

pub(super) fn node(
    unit: Option<&Candidate>,
    args: &RegisterArgs,
    talk: Option<&mut Dialogue<'_>>,
) -> Result<String, RegisterError> {
    let guess = unit.and_then(Candidate::guess);
    match (&args.node, talk) {
        (Some(node), _) => Ok(node.clone()),
        (None, Some(talk)) => {
            let question = "Node (driver: camera, serial, can, lan, or the name of a program)";
            talk.ask(question, guess, |answer| match answer {
                "" => Err("camera, serial, can, lan, or the name of a program".to_owned()),
                answer => Ok(answer.to_owned()),
            })
        }
        (None, None) => guess.map(str::to_owned).ok_or_else(|| RegisterError::Missing(vec!["--node"])),
    }
}

/// The keys that identify the unit.
pub(super) fn identity(
    unit: Option<&Candidate>,
    args: &RegisterArgs,
    talk: Option<&mut Dialogue<'_>>,
) -> Result<Vec<(&'static str, String)>, RegisterError> {
    if args.serial.is_some() || args.port.is_some() {
        let given = [("serial", &args.serial), ("port", &args.port)];
        return Ok(given.into_iter().filter_map(|(key, value)| Some((key, value.clone()?))).collect());
    }
    let Some(unit) = unit else { return Ok(Vec::new()) };
    let usual = unit.identity();
    let Some(talk) = talk else { return Ok(usual.into_iter().collect()) };
    let port = ("port", unit.usb.port.clone());
    match &unit.own_serial {
        Some(_) if !unit.has_twin => return Ok(usual.into_iter().collect()),
        Some(_) => {
            talk.print("There is another unit of this model: identify this one by its serial number or by its port.")?;
        }
        None if unit.usb.serial.is_some() => {
            talk.print("Its serial number is not unique or not printable: identify it by its port.")?;
        }
        None => talk.print("It has no serial number: the entry can match this port, or any unit of the model.")?,
    }
    let words: &[&str] = if unit.own_serial.is_some() { &["serial", "port"] } else { &["port", "any"] };
    let default = usual.as_ref().map_or("any", |(key, _)| key);
    talk.ask(&format!("Identify by {}", words.join(" or ")), Some(default), |answer| match answer {
        "serial" if words.contains(&"serial") => Ok(usual.clone().into_iter().collect()),
        "port" => Ok(vec![port.clone()]),
        "any" if words.contains(&"any") => Ok(Vec::new()),
        _ => Err(words.join(" or ")),
    })
}

pub(super) fn slot(args: &RegisterArgs, talk: Option<&mut Dialogue<'_>>) -> Result<Option<String>, RegisterError> {
    let Some(talk) = talk.filter(|_| args.slot.is_none()) else { return Ok(args.slot.clone()) };
    let words = Mount::WORDS.map(|(word, _)| word).join(", ");
    talk.ask(&format!("Slot of its module ({words}, or none)"), Some("none"), |answer| match answer {
        "none" => Ok(None),
        word if Mount::WORDS.iter().any(|(known, _)| *known == word) => Ok(Some(word.to_owned())),
        _ => Err(format!("one of {words}, none")),
    })
}

pub(super) async fn settings(
    unit: Option<&Candidate>,
    node: &str,
    args: &RegisterArgs,
    talk: Option<&mut Dialogue<'_>>,
) -> Result<Vec<(String, Setting)>, RegisterError> {
    let is_set = |table: &str| args.set.iter().any(|(key, _)| key.split_once('.').is_some_and(|(set, _)| set == table));
    let Some(attachment) = unit.and_then(|unit| unit.node(node)).filter(|_| !is_set(node)) else {
        return Ok(Vec::new());
    };
    if let DeviceNode::Tty(path) = &attachment.node {
        let Some(talk) = talk else { return Ok(Vec::new()) };
        let baud = talk.ask("Baud", Some("115200"), |answer| {
            answer.parse::<u32>().map_err(|_| "enter bits per second, for example 115200".to_owned())
        })?;
        let mut keys = vec![("tty.baud".to_owned(), Setting::Whole(baud.into()))];
        keys.extend(match listen(path, baud).await {
            Ok(Some(found)) => found,
            Ok(None) => {
                talk.print(
                    "It sends no lines of numbers: it is registered as raw, and its bytes are recorded unchanged.",
                )?;
                vec![("tty.parse".to_owned(), Setting::Text("raw".to_owned()))]
            }
            Err(error) => {
                talk.print(&format!("It cannot be read: {error}"))?;
                vec![("tty.parse".to_owned(), Setting::Text("raw".to_owned()))]
            }
        });
        return Ok(keys);
    }
    let camera = if let DeviceNode::Video(path) = &attachment.node { query(path).ok() } else { None };
    Ok(suggested(&attachment.node, camera.as_ref()))
}
