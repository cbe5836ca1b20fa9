//! What is typed about measurements.

use std::path::PathBuf;
use std::time::Duration;

use clap::{Subcommand, ValueHint};

use super::{SimArgs, duration};

const LATENCY: &str = "\
How: stop a running rapid (the camera must be free), darken the room, and point the camera at this
terminal from near by, so that the terminal fills most of its picture; full screen and full
brightness are best. Then start this: the terminal flashes white and black in a pattern that fits at
one delay only, up to three times a second. It ends with the line for the camera's entry.
Switch automatic exposure off (`controls` of the entry) if the pictures do not follow.

What comes out includes what the terminal and its screen take, often 10 to 40 ms. An LED takes next
to nothing: --led takes one of /sys/class/leds (needs the right to write there).

Examples:
  rapid calibrate latency --device cam_wrist
  rapid calibrate latency --device cam_wrist --light-delay 15ms
  sudo rapid calibrate latency --device cam_wrist --led ACT --duration 1m
  rapid calibrate latency --sim --device cam_wrist          how it goes, without a camera";

/// What can be measured.
#[derive(Debug, Subcommand)]
pub enum Calibration {
    /// Measures how late a camera's pictures are, by flashing a light in front of it
    #[command(after_help = LATENCY)]
    Latency {
        /// Entry of the camera [default: the only one that is plugged in]
        #[arg(long, value_name = "NAME")]
        device: Option<String>,
        /// How long to flash: 5s to 10m
        #[arg(long, value_name = "TIME", default_value = "20s", value_parser = flashing)]
        duration: Duration,
        /// Flash an LED instead of this terminal: its name, or its folder
        #[arg(long, value_name = "NAME|DIR", value_hint = ValueHint::DirPath)]
        led: Option<PathBuf>,
        /// How late the light itself is, if you know; taken off
        #[arg(long, value_name = "TIME", default_value = "0ms", value_parser = light_delay)]
        light_delay: Duration,
        /// Where devices come from.
        #[command(flatten)]
        simulation: SimArgs,
    },
}

fn flashing(text: &str) -> Result<Duration, String> {
    match duration(text)? {
        length if (Duration::from_secs(5)..=Duration::from_mins(10)).contains(&length) => Ok(length),
        _ => Err("must lie between 5s and 10m".to_owned()),
    }
}

fn light_delay(text: &str) -> Result<Duration, String> {
    match humantime::parse_duration(text) {
        Ok(delay) if delay <= Duration::from_secs(1) => Ok(delay),
        Ok(_) => Err("must be 1s at most".to_owned()),
        Err(_) => Err("write a number and a unit, for example 15ms".to_owned()),
    }
}
