//! `rapid register` and `rapid unregister`: an entry of `devices.toml` for what is plugged in.
//!
//! What is not given is asked, if there is somebody to ask; the text that comes out is what the parser
//! takes, or nothing is written.

mod ask;
mod import;
mod sample;
pub mod units;
mod wish;
mod write;

use std::io::{self, Write};
use std::path::PathBuf;

use serde::Serialize;

use self::units::unregistered;
use self::wish::{Meant, choose, comments, free_bit, identity, name, node, settings, slot};
use super::Format;
use super::artifacts::ArtifactsError;
use crate::cli::{RegisterArgs, UnregisterArgs};
use crate::folder::FolderError;
use crate::registry::edit::{self, EditError, NewEntry, Setting};
use crate::registry::{Attachment, RegistryErrors};
use crate::text;

pub use ask::Dialogue;
pub use import::ImportError;
pub use write::Target;

/// Why nothing was registered.
#[derive(Debug, thiserror::Error)]
pub enum RegisterError {
    /// The new text would not be a registry.
    #[error("{0}\nnothing was written")]
    Refused(RegistryErrors),
    /// A key cannot be written.
    #[error("{0}")]
    Edit(#[from] EditError),
    /// Something is not given and there is nobody to ask.
    #[error("{} must be given: this is no terminal where it could be asked", .0.join(", "))]
    Missing(Vec<&'static str>),
    /// Several units are meant.
    #[error("several units that are plugged in are meant: name one with --serial or --port{}", .0.iter().flat_map(|unit| ["\n  ", unit]).collect::<String>())]
    Several(Vec<String>),
    /// The answers ended.
    #[error("no answer: nothing was written")]
    Ended,
    /// Another entry would get another bit.
    #[error(
        "taking out [device.{name}] would move {moved}, and a policy is trained on bits\n    fix: write the bits of \
         these entries down first (`rapid check` says which have none)"
    )]
    BitsMove {
        /// The entry.
        name: String,
        /// Which bits, for people.
        moved: String,
    },
    /// Somebody else wrote the file meanwhile.
    #[error("{}: it has changed since it was read; nothing was written, start again", .0.display())]
    Changed(PathBuf),
    /// The file cannot be read or written.
    #[error("{}: {error}", path.display())]
    File {
        /// Which.
        path: PathBuf,
        /// Why.
        error: io::Error,
    },
    /// The folder of the file cannot be used.
    #[error(transparent)]
    Folder(#[from] FolderError),
    /// The registry is written, and what follows from it is not.
    #[error("the registry is written, and what follows from it is not: {0}")]
    Artifacts(#[from] ArtifactsError),
    /// The file to import.
    #[error(transparent)]
    Import(#[from] ImportError),
    /// The output.
    #[error("output: {0}")]
    Output(#[from] io::Error),
}

impl RegisterError {
    /// Was it asked for something that cannot be?
    #[must_use]
    pub const fn is_bad_argument(&self) -> bool {
        !matches!(
            self,
            Self::Ended | Self::Changed(_) | Self::File { .. } | Self::Folder(_) | Self::Artifacts(_) | Self::Output(_)
        )
    }
}

/// What is done with a text.
#[derive(Debug, Clone, Copy)]
struct Manner {
    format: Format,
    dry_run: bool,
    yes: bool,
}

/// Registers what `args` and the answers say.
///
/// # Errors
/// When something is missing or the parser does not take the entry: then nothing is written.
pub async fn register(
    target: &Target,
    attached: &[Attachment],
    args: &RegisterArgs,
    mut talk: Option<Dialogue<'_>>,
    format: Format,
    out: &mut dyn Write,
) -> Result<(), RegisterError> {
    let units = unregistered(target.registry.as_ref(), attached);
    let manner = Manner { format, dry_run: args.dry_run, yes: args.yes };
    if let Some(file) = &args.import {
        let entries = import::read(file, args.layout.as_deref(), args.node.as_deref(), attached, target)?;
        return commit(target, &entries, talk.as_mut(), manner, out);
    }
    let unit = match choose(&units, args, talk.as_mut(), format, out)? {
        Meant::Nothing => return Ok(()),
        Meant::NotPlugged => None,
        Meant::Unit(unit) => Some(unit),
    };
    let unit = unit.as_deref();
    let name = name(target.registry.as_ref(), unit, args, talk.as_mut())?;
    let node = node(unit, args, talk.as_mut())?;
    let mut entry = NewEntry { name, comments: comments(unit), keys: Vec::new(), held_back: None };
    let text = |key: &str, value: String| (key.to_owned(), Setting::Text(value));
    let (vid, pid) = (unit.map(|unit| unit.usb.vid).or(args.vid), unit.map(|unit| unit.usb.pid).or(args.pid));
    entry.keys.extend(vid.map(|vid| text("vid", format!("{vid:04x}"))));
    entry.keys.extend(pid.map(|pid| text("pid", format!("{pid:04x}"))));
    let reads_lines = node == "serial" || args.set.iter().any(|(key, _)| key.starts_with("serial."));
    for (key, value) in identity(unit, args, talk.as_mut())? {
        // Beside a table of the serial line the key has another name.
        let key = if key == "serial" && reads_lines { "serial_number" } else { key };
        entry.keys.push(text(key, value));
    }
    entry.keys.push(text("node", node.clone()));
    entry.keys.extend(slot(args, talk.as_mut())?.map(|slot| text("slot", slot)));
    let bit = args.bit.or_else(|| free_bit(target.registry.as_ref(), &[]));
    entry.keys.extend(bit.map(|bit| ("bit".to_owned(), Setting::Whole(bit.into()))));
    entry.keys.extend(settings(unit, &node, args, talk.as_mut()).await?);
    entry.keys.extend(args.set.iter().map(|(key, value)| (key.clone(), Setting::Typed(value.clone()))));
    if let Some(node) = unit.and_then(|unit| unit.node(&node).or_else(|| unit.nodes.first()))
        && (args.test || talk.is_some())
    {
        let parsed = target.parse(&edit::append(target.base(), std::slice::from_ref(&entry))?);
        let parsed = parsed.map_err(RegisterError::Refused)?;
        if let Some(spec) = parsed.registry.named(&entry.name) {
            let said = sample::look(spec, &node.node).await;
            match (talk.as_mut(), format) {
                (Some(talk), _) => talk.say(&said)?,
                (None, Format::Text) => writeln!(out, "{}", text::plain(&said))?,
                (None, Format::Json) => {}
            }
        }
    }
    commit(target, &[entry], talk.as_mut(), manner, out)
}

/// Takes an entry out.
///
/// # Errors
/// When there is no such entry, or what is left would be no registry.
pub fn unregister(
    target: &Target,
    args: &UnregisterArgs,
    talk: Option<Dialogue<'_>>,
    format: Format,
    out: &mut dyn Write,
) -> Result<(), RegisterError> {
    let new = edit::remove(&target.text, &args.name)?;
    let left = target.parse(&new).map_err(RegisterError::Refused)?.registry;
    let before = target.registry.as_ref().map(|registry| registry.devices.as_slice()).unwrap_or_default();
    let moved: Vec<String> = before
        .iter()
        .filter_map(|entry| Some((entry, left.named(&entry.name)?)))
        .filter(|(entry, now)| entry.id != now.id)
        .map(|(entry, now)| format!("[device.{}] from bit {} to bit {}", entry.name, entry.id.bit(), now.id.bit()))
        .collect();
    if !moved.is_empty() {
        return Err(RegisterError::BitsMove { name: args.name.clone(), moved: moved.join(", ") });
    }
    if let Some(mut talk) = talk.filter(|_| !args.yes && !args.dry_run)
        && !talk.agrees(&format!("Take [device.{}] out of {}", args.name, target.path.display()))?
    {
        talk.say("Nothing was written.")?;
        return Ok(());
    }
    let mut said = Vec::new();
    if !args.dry_run {
        target.write(&new, &left, &mut said)?;
    }
    match format {
        Format::Json => {
            let file = target.path.to_string_lossy();
            let line = serde_json::json!({ "event": "unregistered", "name": args.name, "file": file, "dry_run": args.dry_run });
            writeln!(out, "{}", text::json(&line).map_err(io::Error::from)?)?;
        }
        Format::Text if args.dry_run => out.write_all(new.as_bytes())?,
        Format::Text => {
            out.write_all(&said)?;
            writeln!(out, "[device.{}] is no entry any more", args.name)?;
        }
    }
    Ok(())
}

/// Parses, shows, asks, writes.
fn commit(
    target: &Target,
    entries: &[NewEntry],
    talk: Option<&mut Dialogue<'_>>,
    manner: Manner,
    out: &mut dyn Write,
) -> Result<(), RegisterError> {
    let new = edit::append(target.base(), entries)?;
    let parsed = target.parse(&new).map_err(RegisterError::Refused)?;
    let written: Vec<String> = entries.iter().map(edit::written).collect::<Result<_, _>>()?;
    let shown = written.join("\n");
    if let Some(talk) = talk.filter(|_| !manner.yes && !manner.dry_run) {
        talk.say(&format!("\n{shown}"))?;
        if !talk.agrees(&format!("Add this to {}", target.path.display()))? {
            talk.say("Nothing was written.")?;
            return Ok(());
        }
    } else if manner.format == Format::Text {
        for line in shown.lines() {
            writeln!(out, "{}", text::plain(line))?;
        }
    }
    let mut said = Vec::new();
    if !manner.dry_run {
        target.write(&new, &parsed.registry, &mut said)?;
    }
    if manner.format == Format::Text {
        out.write_all(&said)?;
        if !manner.dry_run {
            writeln!(out, "for the stable names: sudo rapid artifacts --install")?;
        }
        return Ok(());
    }
    for (entry, text) in entries.iter().zip(&written) {
        let spec = parsed.registry.named(&entry.name);
        let line = Registered {
            event: if entry.held_back.is_some() { "held_back" } else { "registered" },
            name: &entry.name,
            bit: spec.map(|spec| spec.id.bit()),
            file: target.path.to_string_lossy().into_owned(),
            entry: text,
            dry_run: manner.dry_run,
        };
        writeln!(out, "{}", text::json(&line).map_err(io::Error::from)?)?;
    }
    Ok(())
}

/// An entry that was added, as JSON.
#[derive(Serialize)]
struct Registered<'a> {
    event: &'static str,
    name: &'a str,
    bit: Option<u8>,
    file: String,
    entry: &'a str,
    dry_run: bool,
}

#[cfg(test)]
mod tests;
