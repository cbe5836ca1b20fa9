//! The options of a run: what it records, what others see of it, how it is shown, and the simulated task.

use std::net::{IpAddr, SocketAddr};
use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, ValueHint};

use super::{duration, tag, time};

/// Options of a run.
#[derive(Debug, Clone, Args)]
#[command(next_help_heading = RUN)]
#[expect(clippy::struct_excessive_bools, reason = "each is a switch of the command line")]
pub struct RunArgs {
    /// Print events as plain text (no monitor)
    #[arg(long)]
    pub headless: bool,
    /// Record from the start, into episodes/ (see --out)
    #[arg(long)]
    pub record: bool,
    /// End after recording (or running) this long: 30s, 5m
    #[arg(long, value_name = "TIME", value_parser = duration, hide_short_help = true)]
    pub duration: Option<Duration>,
    /// Folder for episodes
    #[arg(long, value_name = "DIR", default_value = "episodes", value_hint = ValueHint::DirPath, hide_short_help = true)]
    pub out: PathBuf,
    /// Task, part of the file's name
    #[arg(long, value_name = "TEXT", default_value = "episode", value_parser = task, hide_short_help = true)]
    pub task: String,
    /// Property of the episode, such as finger=soft; repeatable
    #[arg(long, value_name = "KEY=VALUE", value_parser = tag, hide_short_help = true)]
    pub tag: Vec<(String, String)>,
    /// Module that is mounted and has no sensor of its own; repeatable
    #[arg(long, value_name = "NAME", hide_short_help = true)]
    pub module: Vec<String>,
    /// Episodes wanted; the session is complete once so many are kept and not BAD
    #[arg(long, value_name = "COUNT", value_parser = clap::value_parser!(u32).range(1..), conflicts_with = "duration", hide_short_help = true)]
    pub goal: Option<u32>,
    /// End each episode after this time
    #[arg(long, value_name = "TIME", value_parser = duration, conflicts_with = "duration", hide_short_help = true)]
    pub episode_time: Option<Duration>,
    /// Begin the next episode this long after the end of the last, for which the scene is reset
    #[arg(long, value_name = "TIME", value_parser = duration, conflicts_with = "duration", hide_short_help = true)]
    pub reset_time: Option<Duration>,
    /// Count down this long before each episode
    #[arg(long, value_name = "TIME", value_parser = duration, hide_short_help = true)]
    pub countdown: Option<Duration>,
    /// Observations per second [default: from the registry]
    #[arg(long, value_name = "HZ", value_parser = rate, hide_short_help = true)]
    pub rate: Option<f64>,
    /// Let members of this process's group attach and control, as its user may
    ///
    /// They may attach monitors, make requests to the session, and arm and disarm. The service that `rapid artifacts`
    /// writes has it: members of group rapid use it.
    #[arg(long, hide_short_help = true)]
    pub group_control: bool,
    /// Enable the actuator as soon as it is connected, instead of by `rapid arm` or the monitor
    #[arg(long, hide_short_help = true)]
    pub arm: bool,
    /// Let the monitor guide you through a first episode of the simulated rig, or with --infer through a policy's loss of a
    /// sensor
    #[arg(long, requires = "sim", hide_short_help = true)]
    pub tour: bool,
    /// Half width of the synchronisation window of an observation [default: from the registry]
    #[arg(long, value_name = "TIME", value_parser = window, hide_short_help = true)]
    pub window: Option<Duration>,
    /// What other programs see live.
    #[command(flatten)]
    pub foxglove_server: FoxgloveArgs,
    /// The page for a phone.
    #[command(flatten)]
    pub web: WebArgs,
    /// How the monitor is shown.
    #[command(flatten)]
    pub shown: ShownArgs,
}

/// What other programs see live.
#[derive(Debug, Clone, Args)]
pub struct FoxgloveArgs {
    /// Show all topics live in Foxglove, as they are recorded [default address: 127.0.0.1:8765]
    ///
    /// In Foxglove: open connection, `ws://localhost:8765`. From another machine: `ssh -L 8765:localhost:8765 RIG`. With an
    /// address that other machines can reach, such as 0.0.0.0:8765, whoever reaches the port sees what the sensors see.
    #[arg(long, value_name = "ADDR", num_args = 0..=1, value_parser = foxglove_address, default_missing_value = "127.0.0.1:8765", hide_short_help = true)]
    pub foxglove: Option<SocketAddr>,
    /// Let Foxglove begin and end episodes, arm and disarm
    ///
    /// There is no password: every program and every user that reaches the port may do so. Web pages may not, but for the
    /// app's own and those of --foxglove-origin.
    #[arg(long, requires = "foxglove", hide_short_help = true)]
    pub foxglove_control: bool,
    /// Let pages of this site connect too: scheme, host and port, as `http://localhost:8080`; may be repeated
    #[arg(long, value_name = "URL", requires = "foxglove", value_parser = origin, hide_short_help = true)]
    pub foxglove_origin: Vec<String>,
}

/// The page for a phone.
#[derive(Debug, Clone, Args)]
pub struct WebArgs {
    /// Serve a page for a phone: bits, pictures, verdict, buttons [default address: 127.0.0.1:8766]
    ///
    /// For a phone in the same network: `--web 0.0.0.0`. Such an address needs the link with a token, which the monitor shows
    /// as a QR code (key W) and a run without a monitor prints. Whoever has the link sees the cameras and begins, ends and
    /// discards episodes; it neither arms nor disarms motors.
    #[arg(long, value_name = "ADDR", num_args = 0..=1, value_parser = web_address, default_missing_value = "127.0.0.1:8766", hide_short_help = true)]
    pub web: Option<SocketAddr>,
    /// Keep the page's token in this file, so that links remain valid; rapid writes it
    #[arg(long, value_name = "FILE", requires = "web", value_hint = ValueHint::FilePath, hide_short_help = true)]
    pub web_token: Option<PathBuf>,
}

/// How the monitor is shown.
#[derive(Debug, Clone, Copy, Args)]
pub struct ShownArgs {
    /// Show times in UTC in the monitor, not in the zone of this machine
    #[arg(long, hide_short_help = true)]
    pub utc: bool,
    /// Select and scroll with the mouse in the monitor (text is then selected with shift)
    #[arg(long, hide_short_help = true)]
    pub mouse: bool,
}

/// Options of the simulated task.
#[derive(Debug, Clone, Args)]
#[command(next_help_heading = "Options of the simulated task")]
pub struct TaskArgs {
    /// Seed of the first trial of `--sim task`, and of the noise of a policy
    #[arg(long, value_name = "N", default_value_t = 0, hide_short_help = true)]
    pub seed: u64,
    /// With `--sim task --record`: record demonstrations of a scripted expert, faster than real time
    #[arg(long, requires = "record", conflicts_with_all = ["duration", "rate", "window", "infer", "arm", "foxglove", "web"], hide_short_help = true)]
    pub expert: bool,
    /// Handheld gripper: its pose and opening are recorded, but no arm and no action
    #[arg(long, requires = "expert", hide_short_help = true)]
    pub handheld: bool,
    /// Demonstrations to record, one trial each
    #[arg(long, value_name = "COUNT", default_value_t = 1, requires = "expert", hide_short_help = true)]
    pub episodes: usize,
}

fn foxglove_address(text: &str) -> Result<SocketAddr, String> {
    address(text, 8765)
}

/// The origin of a page, as browsers send it: scheme and host, and a port that is not the scheme's.
fn origin(text: &str) -> Result<String, String> {
    let is_host = |host: &str| !host.is_empty() && !host.contains(['/', '?', '#', ' ', '@']);
    let origin = text.strip_suffix('/').unwrap_or(text).to_ascii_lowercase();
    let host = origin.strip_prefix("http://").or_else(|| origin.strip_prefix("https://"));
    if host.is_some_and(is_host) {
        Ok(origin)
    } else {
        Err("write scheme and host of the page: http://localhost:8080".to_owned())
    }
}

fn web_address(text: &str) -> Result<SocketAddr, String> {
    address(text, 8766)
}

/// An address to listen on: an IP address and a port, or one of them.
fn address(text: &str, port: u16) -> Result<SocketAddr, String> {
    let address = text.parse().ok();
    let address = address.or_else(|| Some(SocketAddr::new(text.parse::<IpAddr>().ok()?, port)));
    let address = address.or_else(|| Some(SocketAddr::from(([127, 0, 0, 1], text.parse().ok()?))));
    address.ok_or_else(|| format!("write an IP address and a port, such as 127.0.0.1:{port}, or one of them"))
}

/// The name of a task.
fn task(text: &str) -> Result<String, String> {
    if text.trim().is_empty() {
        Err("write a name, for example \"place block\"".to_owned())
    } else {
        Ok(text.to_owned())
    }
}

fn window(text: &str) -> Result<Duration, String> {
    time(text, Duration::from_millis(1)..=Duration::from_secs(10), "must be between 1ms and 10s", "25ms")
}

fn rate(text: &str) -> Result<f64, String> {
    let hertz: f64 = text.parse().map_err(|_| "write a number, for example 30".to_owned())?;
    if (0.1..=1000.0).contains(&hertz) { Ok(hertz) } else { Err("must be between 0.1 and 1000 Hz".to_owned()) }
}

pub(super) const RUN: &str = "Run options";
