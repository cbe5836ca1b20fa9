//! Sensors of a `rapid` on one computer as devices of a `rapid` on another, over [zenoh](https://zenoh.io).
//!
//! | module  | owns                                                                                      |
//! |---------|-------------------------------------------------------------------------------------------|
//! | `clock` | how far the clock of another computer is from this one, and within what                   |
//! | `wire`  | keys and messages on the network; samples are frames of `rapid_core::remote`                   |
//! | `link`  | the configuration of zenoh                                                                |
//! | `bus`   | samples and mask of the `rapid` on this computer                                          |
//! | `serve` | puts them on the network                                                                  |
//! | `hosts` | what is known of the other computers: which sensors are present, their clocks             |
//! | `join`  | offers their sensors to the `rapid` on this computer                                      |
//!
//! Invariant: nothing here holds up a bus or a recording: what the network does not take is dropped, the oldest first,
//! and is missing in the numbers of the samples.

mod bus;
mod cli;
mod clock;
mod hosts;
mod join;
mod link;
mod queue;
mod serve;
mod wire;

use std::io::IsTerminal as _;
use std::process::ExitCode;

use clap::Parser as _;
use cli::{Cli, Command};

/// What goes wrong is a text with its fix, for people.
type Fault = Box<dyn std::error::Error + Send + Sync>;

#[tokio::main(flavor = "multi_thread", worker_threads = 2)]
async fn main() -> ExitCode {
    let cli = Cli::parse();
    let filter = tracing_subscriber::EnvFilter::try_from_default_env()
        .unwrap_or_else(|_| tracing_subscriber::EnvFilter::new("rapid_remote=info,zenoh=warn"));
    let is_terminal = std::io::stderr().is_terminal();
    tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(std::io::stderr)
        .with_ansi(is_terminal)
        .with_target(false)
        .init();
    let ended = match cli.command {
        Command::Serve(options) => serve::run(options).await,
        Command::Join(options) => join::run(options).await,
    };
    match ended {
        Ok(()) => ExitCode::SUCCESS,
        Err(fault) => {
            tracing::error!("{fault}");
            ExitCode::FAILURE
        }
    }
}

/// Returns at Ctrl-C or SIGTERM.
async fn asked_to_end() -> Result<(), Fault> {
    use tokio::signal::unix::{SignalKind, signal};
    let mut term = signal(SignalKind::terminate())?;
    tokio::select! {
        asked = tokio::signal::ctrl_c() => asked?,
        _ = term.recv() => {}
    }
    Ok(())
}
