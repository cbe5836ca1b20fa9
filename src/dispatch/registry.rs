//! Where the registry is, and the commands about it and about the devices that it matches.

use std::io::{self, IsTerminal, Write};
use std::path::{Path, PathBuf};

use rapid_devices::driver::camera;
use rapid_devices::hotplug::udev::{Ask, enumerate};
use rapid_registry::Registry;
use rapid_registry::device::Attachment;
use rapid_status::palette::Palette;

use super::{Failure, block_on, rig};
use crate::app::Devices;
use crate::cli::{Global, RegisterArgs, UnregisterArgs};
use crate::commands::devices::{Entries, Formats};
use crate::commands::register::{self, Dialogue};
use crate::commands::{self, Format};
use crate::registration::Target;

pub(super) fn registry_or_builtin(global: &Global) -> Result<Registry, Failure> {
    find_registry(global).map_or_else(|| Ok(Registry::builtin()), |path| load(&path))
}

/// Reads a registry; its warnings go to standard error.
pub(super) fn load(path: &Path) -> Result<Registry, Failure> {
    let loaded = Registry::load(path)?;
    for warning in &loaded.warnings {
        print_warning(warning);
    }
    Ok(loaded.registry)
}

pub(super) fn print_warning(warning: &dyn std::fmt::Display) {
    let _ = writeln!(io::stderr(), "{} {warning}", Palette::for_output(&io::stderr()).warn("warning:"));
}

pub(super) fn registry_path(global: &Global) -> Result<PathBuf, Failure> {
    find_registry(global).ok_or_else(Failure::no_registry)
}

/// The registry named, or the first that exists in the usual places.
pub(super) fn find_registry(global: &Global) -> Option<PathBuf> {
    if let Some(path) = &global.config {
        return Some(path.clone());
    }
    usual_places().into_iter().find(|path| path.exists())
}

pub(super) fn usual_places() -> Vec<PathBuf> {
    let home = || std::env::var_os("HOME").map(|home| PathBuf::from(home).join(".config"));
    let config = std::env::var_os("XDG_CONFIG_HOME").map(PathBuf::from).filter(|path| path.is_absolute());
    let mut places = vec![PathBuf::from("devices.toml")];
    places.extend(config.or_else(home).map(|folder| folder.join("rapid/devices.toml")));
    places.push(PathBuf::from("/etc/rapid/devices.toml"));
    places
}

pub(super) fn register(
    global: &Global,
    args: &RegisterArgs,
    format: Format,
    out: &mut dyn Write,
) -> Result<(), Failure> {
    let target = Target::read(find_registry(global).unwrap_or_else(|| PathBuf::from("devices.toml")))?;
    let attached = match enumerate(&asked(target.registry.as_ref())) {
        _ if global.sim.is_some() => connected(global)?.1,
        // An entry for a device that is not plugged in can be created on any machine.
        Err(_) if args.vid.is_some() => Vec::new(),
        attached => attached?,
    };
    let (input, output) = (&mut io::stdin().lock(), &mut io::stdout());
    let talk = is_interactive(format).then_some(Dialogue { input, out: output });
    Ok(block_on(register::register(&target, &attached, args, talk, format, out))??)
}

pub(super) fn unregister(
    global: &Global,
    args: &UnregisterArgs,
    format: Format,
    out: &mut dyn Write,
) -> Result<(), Failure> {
    let target = Target::read(registry_path(global)?)?;
    let (input, output) = (&mut io::stdin().lock(), &mut io::stdout());
    let talk = is_interactive(format).then_some(Dialogue { input, out: output });
    Ok(register::unregister(&target, args, talk, format, out)?)
}

fn is_interactive(format: Format) -> bool {
    format == Format::Text && io::stdin().is_terminal() && io::stdout().is_terminal()
}

/// The registry, and the devices that are connected.
pub(super) fn connected(global: &Global) -> Result<(Registry, Vec<Attachment>), Failure> {
    let (registry, devices) = rig(global, 0)?;
    let attached = match devices {
        Devices::Machine => enumerate(&asked(Some(&registry)))?,
        Devices::Simulated(scenario) => rapid_devices::hotplug::script::attached(&scenario),
    };
    Ok((registry, attached))
}

/// What capture nodes are asked in order to assign them.
fn asked(registry: Option<&Registry>) -> Ask {
    registry.map_or(Ask::NOTHING, |registry| Ask::from_registry(registry, camera::formats))
}

/// Lists connected devices first, even if the registry is invalid.
pub(super) fn devices(global: &Global, formats: Formats, format: Format, out: &mut dyn Write) -> Result<(), Failure> {
    if global.sim.is_some() {
        let (registry, attached) = connected(global)?;
        let listed = commands::devices::list(Entries::Of(&registry), &attached, formats);
        return Ok(commands::devices::print(&listed, Some(&registry), format, out)?);
    }
    let registry = find_registry(global).map(|path| load(&path)).transpose();
    let known = match &registry {
        Ok(Some(registry)) => Entries::Of(registry),
        Ok(None) => Entries::NoFile,
        Err(_) => Entries::Wrong,
    };
    let ask = asked(registry.as_ref().ok().and_then(Option::as_ref));
    let mut listed = commands::devices::list(known, &enumerate(&ask)?, formats);
    listed.extend(commands::devices::other_cameras(formats));
    commands::devices::print(&listed, registry.as_ref().ok().and_then(Option::as_ref), format, out)?;
    registry.map(drop)
}
