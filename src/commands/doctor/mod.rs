//! `rapid doctor`: diagnoses this machine, with a fix for each problem.
//!
//! `facts` collects, `judge` decides, this module writes.

mod facts;
mod finding;
mod judge;
mod load;
mod preview;

use std::io::{self, Write};
use std::path::Path;
use std::time::{Duration, Instant};

use rapid_core::text;
use rapid_registry::Registry;
use rapid_registry::system_files::{SystemFileKind as ArtifactKind, system_files as artifacts};
use rapid_system::folder::{Folder, Links, Missing};
use serde::Serialize;

use self::facts::UsbDevice;
use self::facts::{Disk, Facts};
use self::finding::{Finding, Level};
use super::Format;

/// Diagnoses the machine and writes the findings; true if none is bad.
///
/// # Errors
/// When `out` cannot be written to.
pub fn doctor(
    registry: Result<&Registry, &str>,
    episodes: &Path,
    format: Format,
    out: &mut dyn Write,
) -> io::Result<bool> {
    let mut facts = facts::collect(Path::new("/"));
    #[cfg(feature = "motors")]
    facts::query_can(&mut facts.can);
    facts.disk = disk(episodes);
    report(&facts, registry, format, out)
}

/// Writes the findings that follow from the facts.
fn report(facts: &Facts, registry: Result<&Registry, &str>, format: Format, out: &mut dyn Write) -> io::Result<bool> {
    let mut findings = Vec::new();
    if let Err(reason) = registry {
        let fix = Some("rapid check lists the mistakes; rapid register creates a registry".to_owned());
        findings.push(Finding { level: Level::Bad, about: "registry", what: reason.to_owned(), fix });
    }
    let registry = registry.ok();
    let rules = registry.and_then(|registry| {
        artifacts(registry)
            .into_iter()
            .find(|artifact| artifact.kind == ArtifactKind::Rules)
            .map(|rules| rules.contents)
    });
    findings.extend(judge::judge(facts, registry, rules.as_deref()));
    let plugged = judge::plugged(registry, &facts.usb);
    let names = |device: &UsbDevice| -> Vec<&str> {
        plugged.iter().filter(|(_, usb)| usb.port == device.port).map(|(entry, _)| entry.name.as_str()).collect()
    };
    match format {
        Format::Json => {
            for device in &facts.usb {
                let line = Line::new(device, names(device));
                writeln!(out, "{}", text::json(&line).map_err(io::Error::from)?)?;
            }
            for finding in &findings {
                let line = serde_json::json!({ "event": "finding", "level": finding.level, "about": finding.about,
                    "what": finding.what, "fix": finding.fix });
                writeln!(out, "{}", text::json(&line).map_err(io::Error::from)?)?;
            }
        }
        Format::Text => {
            for device in &facts.usb {
                writeln!(out, "{}", tree_line(device, &names(device)))?;
            }
            if facts.usb.is_empty() {
                writeln!(out, "no USB bus")?;
            }
            writeln!(out)?;
            write_findings(&findings, out)?;
        }
    }
    Ok(findings.iter().all(|finding| finding.level != Level::Bad))
}

fn write_findings(findings: &[Finding], out: &mut dyn Write) -> io::Result<()> {
    for finding in findings {
        let word = match finding.level {
            Level::Ok => "ok  ",
            Level::Warn => "WARN",
            Level::Bad => "BAD ",
        };
        writeln!(out, "{word}  {:9}  {}", finding.about, text::plain(&finding.what))?;
        if let Some(fix) = &finding.fix {
            writeln!(out, "                 fix: {}", text::plain(fix))?;
        }
    }
    let count = |level| findings.iter().filter(|finding| finding.level == level).count();
    let warnings = text::counted(count(Level::Warn) as u64, "warning");
    writeln!(out, "\n{} ok, {warnings}, {} bad", count(Level::Ok), count(Level::Bad))
}

fn tree_line(device: &UsbDevice, entries: &[&str]) -> String {
    if device.is_root() {
        return format!("bus {}  {} Mbit/s", device.bus, device.mbit);
    }
    let indent = 2 * (device.depth() + 1);
    let mut line =
        format!("{:indent$}{}  {} Mbit/s  {:04x}:{:04x}", "", device.port, device.mbit, device.vid, device.pid);
    if device.is_hub {
        line.push_str("  hub");
    }
    for entry in entries {
        line += &["  [device.", entry, "]"].concat();
    }
    if let Some(product) = &device.product {
        line.push_str("  ");
        line.push_str(&text::cut(&text::plain(product), 40, "..."));
    }
    line
}

/// A USB device, as JSON.
#[derive(Serialize)]
struct Line<'a> {
    event: &'static str,
    port: &'a str,
    bus: u32,
    mbit: f64,
    vid: String,
    pid: String,
    hub: bool,
    product: Option<&'a str>,
    serial: Option<&'a str>,
    entries: Vec<&'a str>,
}

impl<'a> Line<'a> {
    fn new(device: &'a UsbDevice, entries: Vec<&'a str>) -> Self {
        Self {
            event: "usb",
            port: &device.port,
            bus: device.bus,
            mbit: device.mbit,
            vid: format!("{:04x}", device.vid),
            pid: format!("{:04x}", device.pid),
            hub: device.is_hub,
            product: device.product.as_deref(),
            serial: device.serial.as_deref(),
            entries,
        }
    }
}

/// The disk of the folder for episodes, or of its nearest existing parent.
fn disk(episodes: &Path) -> Option<Disk> {
    let folder = episodes.ancestors().find(|folder| folder.is_dir());
    let folder = folder.map_or_else(|| Path::new(".").to_owned(), Path::to_owned);
    let (size, free) = facts::space(&folder)?;
    let rate = write_rate(&folder).map_err(|error| error.to_string());
    Some(Disk { folder, free, size, rate })
}

/// Writes for up to 2 s, as a recording does, and syncs: bytes per second.
fn write_rate(folder: &Path) -> io::Result<f64> {
    const BLOCK: usize = 1 << 20;
    const MOST: usize = 64;
    const LONGEST: Duration = Duration::from_secs(2);
    let folder = Folder::open(folder, Links::Own, Missing::Refused)?;
    let name = format!(".rapid-doctor.{}", std::process::id());
    let mut file = folder.create_new(&name, 0o600)?;
    // The open file has no name from here on, so nothing is left behind.
    folder.remove(&name)?;
    // Bytes that no file system compresses.
    let block: Vec<u8> = (0..BLOCK as u64).map(|at| (at.wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 56) as u8).collect();
    let begun = Instant::now();
    let mut written = 0;
    while written < MOST * BLOCK && begun.elapsed() < LONGEST {
        file.write_all(&block)?;
        written += BLOCK;
    }
    file.sync_data()?;
    Ok(written as f64 / begun.elapsed().as_secs_f64().max(1e-6))
}

#[cfg(test)]
mod tests;
