//! What is typed to register devices.

use std::path::PathBuf;

use clap::{Args, ValueHint};

use super::SimArgs;

pub(super) const REGISTER: &str = "\
On a terminal it asks for what is not given. Without --serial and --port an entry means the unit that is \
plugged in by its serial number, or by its port if it has none of its own and is not the only one.

Examples:
  rapid register
  rapid register --vid 046d --pid 0825 --name cam_left --node camera --set camera.width=1280
  rapid register --import ~/.config/rapid_driver/registry.toml --dry-run
  rapid register --sim scenario.toml          how it goes, without a device";

/// What to register.
#[derive(Debug, Clone, Args)]
pub struct RegisterArgs {
    /// USB vendor id
    #[arg(long, value_name = "HEX", value_parser = usb_id)]
    pub vid: Option<u16>,
    /// USB product id
    #[arg(long, value_name = "HEX", value_parser = usb_id)]
    pub pid: Option<u16>,
    /// Serial number of the unit
    #[arg(long, value_name = "TEXT")]
    pub serial: Option<String>,
    /// Port instead, as 1-2.3
    #[arg(long, value_name = "PORT")]
    pub port: Option<String>,
    /// Name of the entry, such as gripper
    #[arg(long)]
    pub name: Option<String>,
    /// camera, serial, can, lan or the name of a program [default: by the nodes it offers]
    #[arg(long)]
    pub node: Option<String>,
    /// Its bit in the mask [default: the lowest free one]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u8).range(0..64))]
    pub bit: Option<u8>,
    /// Where its module sits: front, tip, top or bottom
    #[arg(long)]
    pub slot: Option<String>,
    /// Any other key of the entry, as camera.width=1280; may be repeated
    #[arg(long, value_name = "KEY=VALUE", value_parser = super::tag)]
    pub set: Vec<(String, String)>,
    /// Read the device for up to 2 s first, and show what it sends
    #[arg(long)]
    pub test: bool,
    /// Do not ask before writing
    #[arg(long, short)]
    pub yes: bool,
    /// Show what would be written, and write nothing
    #[arg(long)]
    pub dry_run: bool,
    /// Take over the devices of a registry.toml of `rapid_driver`
    #[arg(long, help = "Take over the devices of a registry.toml of rapid_driver", value_name = "FILE", value_hint = ValueHint::FilePath, conflicts_with_all = ["vid", "pid", "serial", "port", "name", "bit", "slot", "set"])]
    pub import: Option<PathBuf>,
    /// Its `mask_layout.toml`, for the bits
    #[arg(long, help = "Its mask_layout.toml, for the bits", value_name = "FILE", value_hint = ValueHint::FilePath, requires = "import")]
    pub layout: Option<PathBuf>,
    /// Where devices come from.
    #[command(flatten)]
    pub simulation: SimArgs,
}

/// What to take out.
#[derive(Debug, Clone, Args)]
pub struct UnregisterArgs {
    /// Name of the entry
    pub name: String,
    /// Do not ask before writing
    #[arg(long, short)]
    pub yes: bool,
    /// Show what would be left, and write nothing
    #[arg(long)]
    pub dry_run: bool,
}

fn usb_id(text: &str) -> Result<u16, String> {
    let digits = text.strip_prefix("0x").unwrap_or(text);
    let hex = (1..=4).contains(&digits.len()) && digits.bytes().all(|byte| byte.is_ascii_hexdigit());
    let id = hex.then(|| u16::from_str_radix(digits, 16).ok()).flatten();
    id.ok_or_else(|| "write the four hexadecimal digits that lsusb shows, for example 046d".to_owned())
}
