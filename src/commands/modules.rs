//! `rapid modules`: the module catalogue, and which of it the registry has.

use std::io::{self, Write};
use std::path::Path;

use rapid_core::text;
use rapid_registry::catalogue::{self, CatalogueError, Descriptor};
use rapid_registry::{Registry, RegistryErrors, read_file};

use super::Format;

/// Why there is no descriptor.
#[derive(Debug, thiserror::Error)]
pub enum ModulesError {
    /// It is invalid or unknown.
    #[error(transparent)]
    Catalogue(#[from] CatalogueError),
    /// Its file cannot be read.
    #[error(transparent)]
    File(#[from] RegistryErrors),
    /// The output.
    #[error("output: {0}")]
    Output(#[from] io::Error),
}

/// The descriptor of this name, or in this file: what contains `/`, or has an extension, is a path.
///
/// # Errors
/// When it cannot be read, or is invalid or unknown.
pub fn descriptor(name: &str) -> Result<Descriptor, ModulesError> {
    let is_path = name.contains('/') || Path::new(name).extension().is_some();
    if is_path {
        let text = read_file(Path::new(name), "`rapid modules` lists those of the catalogue")?;
        return Ok(catalogue::parse(&text)?);
    }
    Ok(catalogue::named(name)?)
}

/// Prints one descriptor, or a list of all.
///
/// # Errors
/// When none has this name, or nothing can be written.
pub fn modules(
    name: Option<&str>,
    registry: Option<&Registry>,
    format: Format,
    out: &mut dyn Write,
) -> Result<(), ModulesError> {
    if let Some(name) = name {
        let found = descriptor(name)?;
        match format {
            Format::Json => print_json(&found, registry, out)?,
            Format::Text => found.text.lines().try_for_each(|line| writeln!(out, "{}", text::plain(line)))?,
        }
        return Ok(());
    }
    for descriptor in catalogue::all()? {
        match format {
            Format::Json => print_json(&descriptor, registry, out)?,
            Format::Text => {
                let has_it = if is_declared(&descriptor, registry) { "*" } else { " " };
                let (Descriptor { name, mount, title, .. }, bring_up) = (&descriptor, descriptor.bring_up());
                let mount = mount.word();
                let what = title.split(": rapid").next().unwrap_or_default();
                writeln!(out, "{has_it} {name:20} {mount:7} {bring_up:4} {what}")?;
            }
        }
    }
    if format == Format::Text {
        writeln!(out, "\n*: in the registry. To add one: rapid register --module NAME")?;
    }
    Ok(())
}

fn is_declared(descriptor: &Descriptor, registry: Option<&Registry>) -> bool {
    registry.is_some_and(|registry| registry.modules.iter().any(|module| module.name == descriptor.name))
}

fn print_json(descriptor: &Descriptor, registry: Option<&Registry>, out: &mut dyn Write) -> io::Result<()> {
    let line = serde_json::json!({
        "event": "module_type", "name": descriptor.name, "title": descriptor.title, "slot": descriptor.mount,
        "tags": descriptor.tags, "devices": descriptor.devices, "bring_up": descriptor.bring_up(),
        "registered": is_declared(descriptor, registry),
    });
    writeln!(out, "{}", text::json(&line).map_err(io::Error::from)?)
}
