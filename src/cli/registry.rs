//! The grammar of `rapid register` and `rapid unregister`.

use std::path::PathBuf;

use clap::{Args, ValueHint};

use super::tag;

pub(super) const REGISTER: &str = "\
On a terminal it asks for missing values. Without --serial and --port the entry matches the connected unit \
by its serial number, or by its port if it has no unique one and is not the only unit. The udev rules and descriptors \
that `rapid artifacts` writes are written too, to udev/ beside the registry.

Examples:
  rapid register
  rapid register --vid 046d --pid 0825 --name cam_left --node camera --set camera.width=1280
  rapid register --module tip_tactile
  rapid register --import ~/.config/rapid_driver/registry.toml --dry-run
  rapid register --sim scenario.toml          without a device";

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
    /// USB port instead of a serial number, such as 1-2.3
    #[arg(long, value_name = "PORT")]
    pub port: Option<String>,
    /// Name of the entry, such as gripper
    #[arg(long)]
    pub name: Option<String>,
    /// camera, serial, can, lan or a node program [default: from the device's interfaces]
    #[arg(long)]
    pub node: Option<String>,
    /// Bit in the mask [default: the lowest free one]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u8).range(0..64))]
    pub bit: Option<u8>,
    /// Position of its module: front, tip, top or bottom
    #[arg(long)]
    pub slot: Option<String>,
    /// Any other key of the entry, such as camera.width=1280; repeatable
    #[arg(long, value_name = "KEY=VALUE", value_parser = tag)]
    pub set: Vec<(String, String)>,
    /// First read the device for up to 2 s and show its data
    #[arg(long)]
    pub test: bool,
    /// Write without asking
    #[arg(long, short)]
    pub yes: bool,
    /// Print the entry without writing it
    #[arg(long)]
    pub dry_run: bool,
    /// Type of module, from `rapid modules` or a file: its sensor, slot and tags are added with it
    #[arg(long, help = "Type of module (`rapid modules` lists them, or a file): its sensor, slot and tags are added with it", value_name = "NAME", value_hint = ValueHint::FilePath, conflicts_with_all = ["node", "slot"])]
    pub module: Option<String>,
    /// Import the devices of a registry.toml of `rapid_driver`
    #[arg(long, help = "Import the devices of a registry.toml of rapid_driver", value_name = "FILE", value_hint = ValueHint::FilePath, conflicts_with_all = ["vid", "pid", "serial", "port", "name", "bit", "slot", "set", "module"])]
    pub import: Option<PathBuf>,
    /// Its `mask_layout.toml`, for the bits
    #[arg(long, help = "Its mask_layout.toml, for the bits", value_name = "FILE", value_hint = ValueHint::FilePath, requires = "import")]
    pub layout: Option<PathBuf>,
}

/// What to remove.
#[derive(Debug, Clone, Args)]
pub struct UnregisterArgs {
    /// Name of the entry
    pub name: String,
    /// Write without asking
    #[arg(long, short)]
    pub yes: bool,
    /// Print the new registry without writing it
    #[arg(long)]
    pub dry_run: bool,
}

fn usb_id(text: &str) -> Result<u16, String> {
    let digits = text.strip_prefix("0x").unwrap_or(text);
    let hex = (1..=4).contains(&digits.len()) && digits.bytes().all(|byte| byte.is_ascii_hexdigit());
    let id = hex.then(|| u16::from_str_radix(digits, 16).ok()).flatten();
    id.ok_or_else(|| "write the four hexadecimal digits that lsusb shows, for example 046d".to_owned())
}
