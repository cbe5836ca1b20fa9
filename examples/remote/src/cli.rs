//! The command line.

use std::path::PathBuf;

use clap::{Args, Parser, Subcommand};

/// Sensors of a rapid on one computer as devices of a rapid on another.
#[derive(Debug, Parser)]
#[command(version, about, after_help = EXAMPLES, max_term_width = 110)]
pub struct Cli {
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
}

const EXAMPLES: &str = "\
Examples:
  on the computer with the camera (robot-b), beside a running `rapid --headless`:
    rapid-remote serve --config devices.toml --name robot-b
  on the computer that records:
    rapid-remote join --connect tcp/192.168.1.20:7447

  in devices.toml of the computer that records:
    [device.cam_far]
    node = \"lan\"
    bit = 5
    [device.cam_far.lan]
    protocol = \"remote\"
    host = \"robot-b\"
    device = \"cam_wrist\"

Whoever reaches the port of `serve` can see its sensors, and whoever `join` connects to can
send it samples: use a network of your own, an SSH tunnel or WireGuard, or passwords and access
lists in a configuration file of zenoh's (--zenoh).";

/// See [`Cli`].
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Put the sensors of the rapid on this computer on the network
    #[command(after_help = "Examples:
  rapid-remote serve --config devices.toml --name robot-b
  rapid-remote serve --config devices.toml --device cam_wrist --listen tcp/10.0.0.2:7447
  rapid-remote serve --config devices.toml --router tcp/192.168.1.1:7447      # zenohd between the two")]
    Serve(Serve),
    /// Offer the sensors of other computers to the rapid on this one
    #[command(after_help = "Examples:
  rapid-remote join --connect tcp/192.168.1.20:7447
  rapid-remote join --connect tcp/robot-b:7447 --connect tcp/robot-c:7447
  ssh -N -L 7447:127.0.0.1:7447 robot-b & rapid-remote join --connect tcp/127.0.0.1:7447
  rapid-remote join --router tcp/192.168.1.1:7447                             # zenohd between the two")]
    Join(Join),
}

/// Options of `serve`.
#[derive(Debug, Args)]
pub struct Serve {
    /// The registry of the rapid on this computer
    #[arg(long, value_name = "FILE", default_value = "devices.toml")]
    pub config: PathBuf,
    /// Name of this computer, `host` in the entries of the other one [default: its host name]
    #[arg(long)]
    pub name: Option<String>,
    /// Only these devices of the registry [default: all]
    #[arg(long = "device", value_name = "NAME")]
    pub devices: Vec<String>,
    /// What that rapid was given as --instance
    #[arg(long, env = "RAPID_INSTANCE")]
    pub instance: Option<String>,
    /// Where to wait for the other computer, an endpoint of zenoh [default: tcp/[::]:7447 without --router]
    #[arg(long, value_name = "ENDPOINT")]
    pub listen: Vec<String>,
    /// Options of the network.
    #[command(flatten)]
    pub network: Network,
}

/// Options of `join`.
#[derive(Debug, Args)]
pub struct Join {
    /// A computer that serves, an endpoint of zenoh; once for each
    #[arg(long, value_name = "ENDPOINT")]
    pub connect: Vec<String>,
    /// Port of this computer at which rapid reads, on 127.0.0.1 only; `port` in its entries
    #[arg(long, default_value_t = rapid_core::remote::PORT)]
    pub port: u16,
    /// A computer from which nothing came for this long is absent, milliseconds
    #[arg(long, value_name = "MS", default_value_t = 700, value_parser = clap::value_parser!(u64).range(200..=60_000))]
    pub lease: u64,
    /// Options of the network.
    #[command(flatten)]
    pub network: Network,
}

/// Options of the network.
#[derive(Debug, Args)]
pub struct Network {
    /// Through a router (zenohd) at this endpoint
    #[arg(long, value_name = "ENDPOINT")]
    pub router: Option<String>,
    /// A configuration file of zenoh, for passwords and access lists; what is given here goes before it
    #[arg(long, value_name = "FILE")]
    pub zenoh: Option<PathBuf>,
}
