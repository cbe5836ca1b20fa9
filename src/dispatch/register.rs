//! Registering: which file, which devices, and whether there is somebody to ask.

use std::io::{self, IsTerminal, Write};
use std::path::PathBuf;

use super::{Failure, Source, block_on, find_registry, plugged};
use crate::cli::{Global, RegisterArgs, SimArgs, UnregisterArgs};
use crate::commands::Format;
use crate::commands::register::{self, Dialogue, Target};
use crate::hotplug::udev;

/// Adds an entry.
pub(super) fn register(
    global: &Global,
    before: SimArgs,
    args: &RegisterArgs,
    format: Format,
    out: &mut dyn Write,
) -> Result<(), Failure> {
    let target = Target::read(find_registry(global).unwrap_or_else(|| PathBuf::from("devices.toml")))?;
    let simulation = if args.simulation.sim.is_some() { args.simulation.clone() } else { before };
    let attached = match Source::of(simulation) {
        // An entry for a device that is not plugged in can be made on any machine.
        Source::Machine if args.vid.is_some() => udev::enumerate().unwrap_or_default(),
        Source::Machine => udev::enumerate()?,
        simulated => plugged(global, simulated)?.1,
    };
    let (input, said) = (&mut io::stdin().lock(), &mut io::stdout());
    let talk = has_somebody(format).then_some(Dialogue { input, out: said });
    Ok(block_on(register::register(&target, &attached, args, talk, format, out))??)
}

/// Takes one out.
pub(super) fn unregister(
    global: &Global,
    args: &UnregisterArgs,
    format: Format,
    out: &mut dyn Write,
) -> Result<(), Failure> {
    let target = Target::read(super::registry_path(global)?)?;
    let (input, said) = (&mut io::stdin().lock(), &mut io::stdout());
    let talk = has_somebody(format).then_some(Dialogue { input, out: said });
    Ok(register::unregister(&target, args, talk, format, out)?)
}

fn has_somebody(format: Format) -> bool {
    format == Format::Text && io::stdin().is_terminal() && io::stdout().is_terminal()
}
